# SPDX-License-Identifier: Apache-2.0
"""What each node decides, without ROS: when to publish, wait, redo, solve, accept and warn."""
