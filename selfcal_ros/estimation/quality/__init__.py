# SPDX-License-Identifier: Apache-2.0
"""Checks of the readings: outliers, slips of the plate, noisy views, held-out readings."""
