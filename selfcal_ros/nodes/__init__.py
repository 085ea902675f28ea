# SPDX-License-Identifier: Apache-2.0
"""Thin rclpy nodes: the only place that imports rclpy."""
