# SPDX-License-Identifier: Apache-2.0
"""Figure of a plan: how the plate lies on the stage in every view."""

import math

import numpy as np

from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.reporting.figures.maps import WIDTH
from selfcal_ros.reporting.figures.residuals import panels, places_mm
from selfcal_ros.reporting.sheet.drawing import Drawing, Point
from selfcal_ros.reporting.sheet.frame import Frame
from selfcal_ros.reporting.summary.sections import pose_text
from selfcal_ros.units import MM_PER_M


def views_drawing(result: CalibrationResult) -> Drawing:
    """Return the plate in every view: its outline, its marks, and the corner that tells its turn.

    Marks beyond the field of the stage are hollow: no view reads them.
    """
    artifact = result.artifact
    drawing = Drawing("views", "How the plate lies on the stage in every view; hollow marks lie "
                      "beyond the field and are not read.", WIDTH, 0)
    drawing.label(0, 16, "How the plate lies in every view", size=13, bold=True)
    reach = [(half + 2.6) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half]
    titles = [f"{view.name}: {pose_text(view, artifact.grid_pitch_m)}" for view in result.views]
    for (_, frame), view in zip(panels(drawing, titles, reach), result.views, strict=True):
        _plate(drawing, frame, view, result)
        frame.border()
    for line in ("shaded: field of the stage; dot in the corner: mark (h, h) of the plate",
                 "small dots: only angular lines are read; hollow: beyond the field, not read"):
        drawing.height += 18
        drawing.label(46, drawing.height - 12, line, size=11.5, colour="soft")
    return drawing


def _plate(drawing: Drawing, frame: Frame, view: ViewResult, result: CalibrationResult) -> None:
    artifact = result.artifact
    pitch, (hx, hy) = artifact.grid_pitch_m, artifact.half
    field = [(half + 0.3) * pitch * MM_PER_M for half in (hx, hy)]
    low, high = frame.at(-field[0], -field[1]), frame.at(*field)
    drawing.box(low[0], high[1], high[0] - low[0], low[1] - high[1], fill="e2")
    corners = np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]]) * (
        np.array([[hx], [hy]]) + 0.6) * pitch
    drawing.line(_at(frame, places_mm(view, *corners)), stroke="truth", width=1.6)
    place = places_mm(view, artifact.x_m, artifact.y_m)
    quarter = math.degrees(view.rotation) / 90
    if abs(quarter - round(quarter)) > 1e-6:  # angular lines alone: no grid mark is read
        drawing.discs(_at(frame, place.reshape(2, -1)), 1.0, fill="soft")
    else:
        on = (np.abs(place[0]) < field[0]) & (np.abs(place[1]) < field[1])
        drawing.discs(_at(frame, place[:, on]), 1.4, fill="ink")
        drawing.discs(_at(frame, place[:, ~on]), 1.6, stroke="bad")
    drawing.discs(_at(frame, place[:, -1:, -1]), 3.6, fill="truth")


def _at(frame: Frame, places: np.ndarray) -> list[Point]:
    return [frame.at(x, y) for x, y in places.T]
