# SPDX-License-Identifier: Apache-2.0
"""What can be set of each node: declared once, typed, checked."""
