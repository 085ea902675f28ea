# SPDX-License-Identifier: Apache-2.0
"""Figures of places on the stage: the plate in every view, and where readings were rejected."""

import math
from collections import Counter

import numpy as np

from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.reporting.figures.drawing import SERIES, Drawing, Frame, Point
from selfcal_ros.reporting.figures.parts import WIDTH, legend, panels, text_width, titled
from selfcal_ros.reporting.figures.residuals import places_mm
from selfcal_ros.reporting.summary.format import printable
from selfcal_ros.reporting.summary.sections import pose_text
from selfcal_ros.units import MM_PER_M


def views_drawing(result: CalibrationResult) -> Drawing:
    """Return the plate in every view: its outline, its marks, and the corner that tells its turn.

    Marks beyond the field of the stage are hollow: no view reads them.
    """
    artifact = result.artifact
    drawing = titled("views", "How the plate lies in every view")
    reach = [(half + 2.6) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half]
    titles = [f"{view.name}: {pose_text(view, artifact.grid_pitch_m)}" for view in result.views]
    for frame, view in zip(panels(drawing, titles, reach), result.views, strict=True):
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


Place = tuple[str, str, float, float]
"""View, reason, x and y in mm."""


def rejected_in(result: CalibrationResult) -> list[Place]:
    """Return the rejected readings of known place: detections, and marks that `--robust` removed.

    What a file holds in another form is left out.
    """
    found: list[Place] = []
    for row in _rows(result.extra.get("rejected_at")):
        columns = [row.get(key) for key in ("reason", "x", "y")]
        if not all(isinstance(column, list | tuple | np.ndarray) for column in columns):
            continue
        found += [(str(row.get("view")), str(reason), x * MM_PER_M, y * MM_PER_M)
                  for reason, x, y in zip(*columns, strict=False) if _number(x) and _number(y)]
    views = {view.name: view for view in result.views}
    outliers = result.extra.get("outliers")
    removed = outliers.get("removed") if isinstance(outliers, dict) else None
    for row in _rows(removed):
        view = views.get(str(row.get("view")))
        if view is not None and row.get("kind") == "grid":
            found += _marked(result, view, row.get("mark"))
    return found


def _rows(value: object) -> list[dict]:
    return [row for row in value if isinstance(row, dict)] if isinstance(value, list) else []


def _number(value: object) -> bool:
    return isinstance(value, int | float) and math.isfinite(value)


def _marked(result: CalibrationResult, view: ViewResult, mark: object) -> list[Place]:
    if not isinstance(mark, list) or len(mark) != 2 or not all(map(_number, mark)):
        return []
    m, n = (np.array(part * result.artifact.grid_pitch_m) for part in mark)
    x, y = places_mm(view, m, n)
    return [(view.name, "outlier_among_views", float(x), float(y))]


def rejected_map(result: CalibrationResult) -> Drawing | None:
    """Return where readings were rejected, view by view, coloured by reason; None without any."""
    found = rejected_in(result)
    names = [view.name for view in result.views if any(view.name == row[0] for row in found)]
    if not names:
        return None
    artifact = result.artifact
    field = [(half + 0.5) * artifact.grid_pitch_m * MM_PER_M for half in artifact.half]
    reach = [half + 1.2 * artifact.grid_pitch_m * MM_PER_M for half in field]
    colours = {reason: f"c{i % SERIES}" for i, (reason, _) in enumerate(
        Counter(row[1] for row in found).most_common())}
    drawing = titled("rejected", "Rejected grid readings, where they happened")
    for title, frame in zip(names, panels(drawing, names, reach), strict=True):
        low, high = frame.at(-field[0], -field[1]), frame.at(*field)
        drawing.box(low[0], high[1], high[0] - low[0], low[1] - high[1], fill="card")
        for reason, colour in colours.items():
            at = [(x, y) for view, why, x, y in found if (view, why) == (title, reason)]
            inside = [(min(max(x, -reach[0]), reach[0]), min(max(y, -reach[1]), reach[1]))
                      for x, y in at]
            drawing.discs([frame.at(x, y) for x, y in inside], 3.0, fill=colour, opacity=0.8)
        frame.axes(ticks=(4, 4))
    _legend(drawing, {reason: (colour, sum(row[1] == reason for row in found))
                      for reason, colour in colours.items()})
    return drawing


def _legend(drawing: Drawing, entries: dict[str, tuple[str, int]]) -> None:
    """Write the reasons below, as many a row as fit."""
    x, y = 46.0, drawing.height + 14
    for reason, (colour, count) in entries.items():
        words = f"{printable(reason).replace('_', ' ')} ({count})"
        width = 26 + text_width(words, 12)
        if x + width > WIDTH and x > 46:
            x, y = 46.0, y + 18
        legend(drawing, [(colour, words)], (x, y))
        x += width
    drawing.height = y + 10
