# SPDX-License-Identifier: Apache-2.0
"""A simulated step-diagonal laser measurement with known truth."""
