# SPDX-License-Identifier: Apache-2.0
"""From the pixels of an image to mark detections: no ROS, no files."""
