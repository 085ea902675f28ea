# SPDX-License-Identifier: Apache-2.0
"""From encoder samples and detections to readings, without ROS."""
