# SPDX-License-Identifier: Apache-2.0
"""The map that a reader turns and zooms in the page itself: its numbers and its script."""

import base64
import hashlib
import json
import math
from functools import cache
from html import escape
from importlib import resources

import numpy as np

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import MM_PER_M, UM_PER_M

LARGEST = 51 * 51
"""Nodes of a map that a page turns: a telephone draws no more of them in time."""

DECIMALS = 4
"""Of a number in um: 0.1 nm."""


def turning_map(result: CalibrationResult) -> str:
    """Return the element that `script` makes a map of; empty for large and for unknown maps.

    It is hidden until the script has drawn it, so that a page without scripts lacks nothing.
    """
    emap, artifact = result.error_map, result.artifact
    if not emap.valid.any() or emap.valid.size > LARGEST or min(emap.valid.shape) < 2:
        return ""
    expanded = np.fmax(emap.u_gx, emap.u_gy) * result.noise.k_xy
    numbers = {
        "x": _rounded(artifact.x_m[:, 0], MM_PER_M),
        "y": _rounded(artifact.y_m[0], MM_PER_M),
        "gx": _rounded(np.where(emap.valid, emap.gx, np.nan), UM_PER_M),
        "gy": _rounded(np.where(emap.valid, emap.gy, np.nan), UM_PER_M),
        "u": _rounded(expanded, UM_PER_M),
    }
    text = escape(json.dumps(numbers, separators=(",", ":"), allow_nan=False))
    return f'<div class="map3d" data-map="{text}" hidden></div>'


def _rounded(values: np.ndarray, scale: float) -> list:
    """Return numbers as lists, unknown ones as None."""
    if values.ndim > 1:
        return [_rounded(row, scale) for row in values]
    return [
        round(value * scale, DECIMALS) + 0.0 if math.isfinite(value) else None
        for value in values.tolist()
    ]


@cache
def script() -> str:
    """Return the script: three.js and tools/map3d/map3d.js in one."""
    return (
        resources.files("selfcal_ros.reporting")
        .joinpath("assets/map3d.min.js")
        .read_text(encoding="ascii")
    )


@cache
def script_source() -> str:
    """Return what the content security policy allows: this script and no other."""
    digest = hashlib.sha256(script().encode("ascii")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
