# SPDX-License-Identifier: Apache-2.0
"""Datum: origin, rotation, scale and angular constant, and their uncertainties."""
