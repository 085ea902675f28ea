# SPDX-License-Identifier: Apache-2.0
"""What figures are drawn on: items in pixels, colours, axes, and the ways to paper and screen."""
