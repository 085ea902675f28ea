# SPDX-License-Identifier: Apache-2.0
"""What the fit leaves of the readings that a result keeps, and its maps by view."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.reporting.figures.fields import (
    MAX_ARROWS,
    arrow_key,
    arrows,
    enlargement,
    thinned,
)
from selfcal_ros.reporting.figures.maps import WIDTH
from selfcal_ros.reporting.sheet.drawing import Drawing
from selfcal_ros.reporting.sheet.frame import Frame
from selfcal_ros.units import MM_PER_M


@dataclass(frozen=True, eq=False)
class ViewResiduals:
    """Residuals of one view.

    Attributes
    ----------
    view : ViewResult
        The view.
    xy_m : float array (2, nx, ny)
        Grid residuals by mark, stage axes, m; NaN where not read.
    course : float array (4, parts)
        Time (s, from the first reading of the run), mean x and y (m) and number of the readings
        in each part of the view's time; without parts where that is not known.
    theta_rad : float array (K,)
        Angular residuals by line, rad; NaN where not read.
    """

    view: ViewResult
    xy_m: np.ndarray
    course: np.ndarray
    theta_rad: np.ndarray

    def places_mm(self, artifact: Artifact) -> np.ndarray:
        """Return where each mark lies on the stage nominally, mm, (2, nx, ny)."""
        return places_mm(self.view, artifact.x_m, artifact.y_m)


def places_mm(view: ViewResult, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return where places of the plate lie on the stage nominally, mm, (2, ...)."""
    c, s = math.cos(view.rotation), math.sin(view.rotation)
    return np.stack([c * x_m - s * y_m + view.translation_x,
                     s * x_m + c * y_m + view.translation_y]) * MM_PER_M


def residuals_in(result: CalibrationResult) -> list[ViewResiduals]:
    """Return the residuals that a result keeps, view by view; empty if it keeps none.

    A part of another form, in a file that something else has written, counts as not kept.
    """
    kept = result.extra.get("residuals")
    rows = kept.get("views") if isinstance(kept, dict) else None
    if not isinstance(rows, list) or len(rows) != len(result.views):
        return []
    shape, lines = result.artifact.shape, (result.artifact.angular_count,)
    found = []
    for view, row in zip(result.views, rows, strict=True):
        part = row if isinstance(row, dict) else {}
        found.append(ViewResiduals(view, np.stack([_array(part.get(k), shape) for k in
                                                   ("dx", "dy")]),
                                   _course(part.get("course")),
                                   _array(part.get("dtheta"), lines)))
    return found


def _course(value: object) -> np.ndarray:
    part = value if isinstance(value, dict) else {}
    columns = [part.get(key) for key in ("time_s", "dx", "dy", "count")]
    try:
        array = np.array(columns, dtype=float)
    except (TypeError, ValueError):
        return np.zeros((4, 0))
    return array if array.ndim == 2 and np.isfinite(array).all() else np.zeros((4, 0))


def _array(value: object, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        return np.full(shape, np.nan)
    return array if array.shape == shape else np.full(shape, np.nan)


def residual_maps(result: CalibrationResult, found: Sequence[ViewResiduals]) -> Drawing | None:
    """Return the grid residuals of every view as vectors at the marks; None without any."""
    views = [v for v in found if np.isfinite(v.xy_m).any()]
    if not views:
        return None
    artifact = result.artifact
    sites = thinned(artifact, MAX_ARROWS)
    factor = enlargement(np.concatenate([np.hypot(*v.xy_m).ravel() for v in views]),
                         (sites[0].step or 1) * artifact.grid_pitch_m)
    drawing = Drawing("residual-maps", "Residuals of the grid readings, view by view, at the "
                      "marks; one enlargement for all.", WIDTH, 0)
    drawing.label(0, 16, "Residuals of the grid readings by view", size=13, bold=True)
    reach = [max(float(np.abs(v.places_mm(artifact)[axis]).max()) for v in views)
             + 1.3 * artifact.grid_pitch_m * MM_PER_M for axis in (0, 1)]
    frame = None
    for title, frame in panels(drawing, [v.view.name for v in views], reach):
        view = next(v for v in views if v.view.name == title)
        frame.axes(ticks=(4, 4))
        at = view.places_mm(artifact)[:, *sites].reshape(2, -1)
        arrows(frame, at, view.xy_m[:, *sites].reshape(2, -1), factor, width=0.9)
    if frame is None:
        return None
    y = drawing.height + 18
    arrow_key(frame, factor, (46, y))
    drawing.label(150, y + 4, f"enlarged {factor:,.0f} ×; axes in mm", size=12)
    drawing.height = y + 16
    return drawing


def panels(drawing: Drawing, titles: Sequence[str], reach_mm: Sequence[float],
           ) -> list[tuple[str, Frame]]:
    """Return two frames a row of the field, titled, and let the drawing grow around them."""
    side, gap, left, top = 186.0, 42.0, 46.0, 48.0
    height = side * reach_mm[1] / reach_mm[0]
    out = []
    for number, title in enumerate(titles):
        column = number % 2
        box = (left + column * (side + gap), top, side, height)
        drawing.label(box[0], top - 6, shortened(title, 26), size=12, bold=True)
        out.append((title, Frame(drawing, box, (-reach_mm[0], reach_mm[0]),
                                 (-reach_mm[1], reach_mm[1]))))
        if column or number == len(titles) - 1:
            top += height + 50
    drawing.height = top - 26
    return out


def shortened(words: str, most: int) -> str:
    """Return words cut at `most` characters."""
    return words if len(words) <= most else words[:most - 1] + "…"
