# SPDX-License-Identifier: Apache-2.0
"""A calibration in one screen of text: numbers, their form, sections."""
