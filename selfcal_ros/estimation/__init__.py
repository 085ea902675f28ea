# SPDX-License-Identifier: Apache-2.0
"""Estimators: joint least squares, Hu's law, datum, identifiability, uncertainty."""
