# SPDX-License-Identifier: Apache-2.0
"""Summary of a calibration on one screen: key figures, number formats, sections."""
