# SPDX-License-Identifier: Apache-2.0
"""Figure of a controller that has loaded the exported table: its error before and after."""

from typing import NamedTuple

import numpy as np

from selfcal_ros.aerotech.export import table_xy
from selfcal_ros.aerotech.machine import MachineFrame
from selfcal_ros.aerotech.verify import Residual, Verification, verify_tables
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.figures.parts import (
    MAX_ARROWS,
    arrow_key,
    arrows,
    enlargement,
    panels,
    titled,
)
from selfcal_ros.units import MM_PER_M

MAX_SITES = 10_201
"""Sites of a field up to which the table is tried on a simulated controller."""


class Tried(NamedTuple):
    """A simulated controller before and after, or why it was not tried."""

    found: Verification | None
    why_not: str = ""


def tried(result: CalibrationResult) -> Tried:
    """Return what the table that `selfcal cal export` writes leaves of the error.

    As `selfcal cal verify`: the map is the truth at its nodes, the cubic spline through them
    between.
    """
    valid = result.error_map.valid
    if not valid.all():
        return Tried(None, f"{int((~valid).sum())} sites are unknown, and a table has no holes: "
                     "selfcal cal export --fill takes their neighbours")
    if valid.size > MAX_SITES:
        return Tried(None, f"not tried beyond {MAX_SITES} sites: see selfcal cal verify")
    emap = result.error_map
    if max(np.abs(emap.gx).max(), np.abs(emap.gy).max()) > 0.5 * result.artifact.grid_pitch_m:
        return Tried(None, "errors beyond half a pitch are none that a table corrects")
    frame = MachineFrame()
    return Tried(verify_tables(emap, [table_xy(emap, frame)], frame))


def before_and_after(result: CalibrationResult, found: Verification) -> Drawing | None:
    """Return the error of the controller between the nodes before and after, at two scales."""
    residual = found.between or found.sites
    if residual is None:
        return None
    artifact = result.artifact
    drawing = titled("before-after", "Exported table: error of position before and after")
    reach = [(half + 2.0) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half]
    for title, frame in zip(("before", "after"), panels(drawing, ["before", "after"], reach),
                            strict=True):
        frame.axes(ticks=(4, 4))
        place, vectors = _shown(residual, title, artifact)
        factor = enlargement(np.hypot(*vectors), _spacing(artifact))
        arrows(frame, place * MM_PER_M, vectors, factor, width=0.9)
        left, top, _, height = frame.box
        arrow_key(frame, factor, (left, top + height + 40))
    drawing.height += 36
    return drawing


def _step(artifact: Artifact) -> int:
    return max(1, -(-max(artifact.shape) // MAX_ARROWS))


def _spacing(artifact: Artifact) -> float:
    return _step(artifact) * artifact.grid_pitch_m


def _shown(residual: Residual, which: str, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
    """Return places (m) and errors (m) of every second, third, ... point along each side."""
    step = _step(artifact)
    take = np.ones(residual.position.shape[1], dtype=bool)
    for side in residual.position:
        whole = np.round((side - side.min()) / artifact.grid_pitch_m).astype(int)
        take &= whole % step == 0
    vectors = getattr(residual, which)
    return residual.position[:, take], vectors[:, take]
