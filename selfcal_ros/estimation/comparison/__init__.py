# SPDX-License-Identifier: Apache-2.0
"""Whether two maps differ by more than their uncertainties."""
