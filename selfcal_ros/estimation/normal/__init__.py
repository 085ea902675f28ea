# SPDX-License-Identifier: Apache-2.0
"""Normal equations of the readings, and what they determine."""
