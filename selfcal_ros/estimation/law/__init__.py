# SPDX-License-Identifier: Apache-2.0
"""Hu's published law, applied to the same readings."""
