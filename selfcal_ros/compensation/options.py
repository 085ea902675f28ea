# SPDX-License-Identifier: Apache-2.0
"""How a map is put to use: between its nodes, and outside of its field."""

from typing import Literal

Interpolation = Literal["bilinear", "bicubic"]
Outside = Literal["clamp", "refuse"]
