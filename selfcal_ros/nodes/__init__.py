# SPDX-License-Identifier: Apache-2.0
"""Thin rclpy nodes: the only place that imports rclpy."""

import sys

from selfcal_ros.start import begin_node

# python -m selfcal_ros.nodes.NODE, before the node itself is imported
if sys.argv[:1] == ["-m"]:
    begin_node()
