# SPDX-License-Identifier: Apache-2.0
"""Which equations the readings give, and what these equations determine."""
