# SPDX-License-Identifier: Apache-2.0
"""MCAP in and out: the only place that imports mcap or rosbags."""
