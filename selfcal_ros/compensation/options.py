# SPDX-License-Identifier: Apache-2.0
"""Interpolation of a map between its nodes, and treatment outside its field."""

from typing import Literal

Interpolation = Literal["bilinear", "bicubic"]
Outside = Literal["clamp", "refuse"]
