# SPDX-License-Identifier: Apache-2.0
"""What is done with a map, or beside it: the guests of the calibration, one folder each."""
