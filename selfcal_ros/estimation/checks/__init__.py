# SPDX-License-Identifier: Apache-2.0
"""Is the cell set up as it says? Asked before any map is made."""
