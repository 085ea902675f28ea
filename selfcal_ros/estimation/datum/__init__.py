# SPDX-License-Identifier: Apache-2.0
"""What fixes origin, rotation, scale and angular constant, and with which uncertainty."""
