# SPDX-License-Identifier: Apache-2.0
"""From recorded or tabled laser readings to the measurement: units, blocks, noise."""
