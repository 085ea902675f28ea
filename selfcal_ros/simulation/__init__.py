# SPDX-License-Identifier: Apache-2.0
"""A stage, a plate and a machine cell with known truth."""
