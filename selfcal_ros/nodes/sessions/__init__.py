# SPDX-License-Identifier: Apache-2.0
"""Logic of the nodes, without ROS: when to publish, wait, redo, solve, accept and warn."""
