# SPDX-License-Identifier: Apache-2.0
"""A laser measurement along diagonals in steps, with known truth."""
