# SPDX-License-Identifier: Apache-2.0
"""Figures of a calibration, drawn once for HTML, SVG files and PDF."""
