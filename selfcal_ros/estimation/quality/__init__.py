# SPDX-License-Identifier: Apache-2.0
"""Whether readings can be believed: outliers, slips, held-out readings."""
