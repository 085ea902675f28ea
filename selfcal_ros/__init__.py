# SPDX-License-Identifier: Apache-2.0
"""Self-calibration of XY-theta stages for ROS 2."""

__version__ = "0.1.0"
