# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of XY-theta stages for ROS 2."""

__version__ = "0.4.0"
"""The one place of the version; package.xml and CITATION.cff repeat it, and a test compares."""
