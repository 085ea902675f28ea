# SPDX-License-Identifier: Apache-2.0
"""What Hu's published law finds from the same readings."""
