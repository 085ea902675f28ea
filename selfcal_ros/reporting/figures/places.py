# SPDX-License-Identifier: Apache-2.0
"""Figures of places: the plate in every view, rejected readings, the camera's errors, the yaw."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from selfcal_ros.errors import printable
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import cell_label, without_cell
from selfcal_ros.model.result import CalibrationResult, ViewResult
from selfcal_ros.model.view import View
from selfcal_ros.model.visit_order import check_marks
from selfcal_ros.reporting.figures import drawing as draw
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.figures.drawing import SERIES, Drawing, Frame, Point
from selfcal_ros.reporting.figures.residuals import places_mm
from selfcal_ros.reporting.summary.numbers import with_u
from selfcal_ros.reporting.summary.sections import pose_text
from selfcal_ros.units import MM_PER_M, UM_PER_M, URAD_PER_RAD


def plan_figure(artifact: Artifact, views: Sequence[View]) -> Drawing:
    """Return the plate in every view: marks, marked corner, sense of rotation, check stops.

    Marks beyond the field of the stage are hollow: no view reads them.
    """
    title = "How the plate lies in every view" if len(views) > 1 else "Place the plate"
    drawing = parts.titled("views", title)
    margin = 2.6 * artifact.grid_pitch_m
    reach = [(half + margin) * MM_PER_M for half in artifact.field_half_m]
    if artifact.map_grid is not None:  # the corners may reach far beyond the field
        corners = np.abs([_places_mm(view, *_corners(artifact)) for view in views])
        reach = np.maximum(
            reach, corners.max(axis=(0, 2)) + margin / 2 * MM_PER_M
        ).tolist()
    titles = [
        f"{view.name}: {pose_text(view.rotation_rad, view.translation_m, artifact)}"
        for view in views
    ]
    for frame, view in zip(parts.panels(drawing, titles, reach), views, strict=True):
        _plate(frame, view, artifact)
        frame.border()
    turn = "; arrow: its turn" * any(view.rotation_rad for view in views)
    legend = [
        "stage x to the right, y upwards; shaded: its field",
        f"dot: corner (h, h) of the plate{turn}",
        "small dots: only lines are read; hollow: off the field, not read",
    ]
    if aside := {view.check_offset_m for view in views if view.check_marks}:
        legend.append(
            "crosses: check stops, measured again with the stage "
            f"{' or '.join(f'{offset_m * UM_PER_M:.6g}' for offset_m in sorted(aside))} µm off"
        )
    for line in legend:
        drawing.height += 18
        drawing.label(46, drawing.height - 12, line, size=11.5, colour="soft")
    return drawing


def views_in(result: CalibrationResult) -> list[View]:
    """Return the views of a result, as far as it knows them; not the other cells of images.

    On the lattice grids are read after quarter turns; else the offset of such a view is known.
    """
    placed = result.plate.map_grid is not None
    return [
        View(
            without_cell(view.name),
            view.rotation,
            (view.translation_x, view.translation_y),
            math.isfinite(view.tx)
            if placed
            else abs(math.remainder(view.rotation, math.pi / 2)) < 1e-6,
            angular=False,
        )
        for view in result.views
        if view.name.endswith(cell_label((0, 0)))
        or view.name == without_cell(view.name)
    ]


def _corners(artifact: Artifact) -> np.ndarray:
    """Return the outline of the plate, plate frame, (2, 5), m."""
    half = np.array(artifact.reach)[:, None]
    return (
        np.array([[1, 1, -1, -1, 1], [1, -1, -1, 1, 1]])
        * (half + 0.6)
        * artifact.grid_pitch_m
    )


def _field(frame: Frame, half_mm: Sequence[float], fill: str) -> None:
    """Fill the field, which reaches to `half_mm` on both sides of its centre."""
    left, bottom = frame.at(-half_mm[0], -half_mm[1])
    right, top = frame.at(half_mm[0], half_mm[1])
    frame.drawing.box(left, top, right - left, bottom - top, fill=fill)


def _plate(frame: Frame, view: View, artifact: Artifact) -> None:
    drawing, pitch = frame.drawing, artifact.grid_pitch_m
    half = np.array(artifact.reach)[:, None]
    field = [(reach + 0.3 * pitch) * MM_PER_M for reach in artifact.field_half_m]
    _field(frame, field, "e2")
    drawing.line(
        _at(frame, _places_mm(view, *_corners(artifact))), stroke="truth", width=1.6
    )
    sites = parts.thinned(artifact, parts.MAX_ARROWS)
    place = _places_mm(view, artifact.x_m[sites], artifact.y_m[sites])
    if view.grid:
        pose = view.on_stage(artifact)
        marks = artifact.places(artifact.m[sites], artifact.n[sites])
        on = ~pose.beyond_field(np.stack(pose.site_of(*marks)), artifact)
        drawing.discs(_at(frame, place[:, on]), 1.4, fill="ink")
        drawing.discs(_at(frame, place[:, ~on]), 1.6, stroke="bad")
    else:
        drawing.discs(_at(frame, place.reshape(2, -1)), 1.0, fill="soft")
    if view.check_marks:
        field_sites = pose.marks_in_field(artifact)[1]
        for x, y in _at(
            frame,
            field_sites[:, check_marks(field_sites, view.check_marks)]
            * pitch
            * MM_PER_M,
        ):
            drawing.lines(
                [[(x - 6, y), (x + 6, y)], [(x, y - 6), (x, y + 6)]],
                stroke="c0",
                width=1.6,
            )
    drawing.discs(_at(frame, _places_mm(view, *(half * pitch))), 3.6, fill="truth")
    if view.rotation_rad:
        inside = 0.72 * half * pitch
        arc = np.hstack(
            [
                _places_mm(replace(view, rotation_rad=float(angle)), *inside)
                for angle in np.linspace(0.0, view.rotation_rad, 61)
            ]
        )
        parts.curved_arrow(drawing, _at(frame, arc), colour="truth")


def _places_mm(view: View, x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    return places_mm(view.rotation_rad, view.translation_m, x_m, y_m)


def _at(frame: Frame, places: np.ndarray) -> list[Point]:
    return [frame.at(x, y) for x, y in places.T]


Place = tuple[str, str, float, float]
"""View, reason, x and y in mm."""


def rejected_in(result: CalibrationResult) -> list[Place]:
    """Return rejected detections of known position, and marks that `--robust` removed."""
    places = [
        (rejected.view, reason, float(x * MM_PER_M), float(y * MM_PER_M))
        for rejected in result.parts.rejected_at or ()
        for reason, x, y in zip(rejected.reason, rejected.x, rejected.y, strict=True)
        if np.isfinite(x) and np.isfinite(y)
    ]
    views = {view.name: view for view in result.views}
    outliers = result.parts.outliers
    for removed in outliers.removed if outliers else ():
        view = views.get(removed.view)
        if view is None or removed.kind != "grid":
            continue
        if result.plate.marks is None or result.plate.has(*np.array(removed.mark)):
            places.append(_of_outlier(result.plate, view, removed.mark))
    return places


def _of_outlier(plate: Artifact, view: ViewResult, mark: tuple[int, ...]) -> Place:
    at = np.array(plate.places(*np.array(mark))) * plate.grid_pitch_m
    x, y = places_mm(view.rotation, (view.translation_x, view.translation_y), *at)
    return (view.name, "outlier_among_views", float(x), float(y))


def rejected_map(result: CalibrationResult) -> Drawing | None:
    """Return where readings were rejected in each view, coloured by reason; None if nowhere."""
    places = rejected_in(result)
    names = [
        view.name for view in result.views if any(view.name == row[0] for row in places)
    ]
    if not names:
        return None
    artifact = result.plate
    field = [
        (half + 0.5 * artifact.grid_pitch_m) * MM_PER_M
        for half in artifact.field_half_m
    ]
    reach = [half + 1.2 * artifact.grid_pitch_m * MM_PER_M for half in field]
    colours = {
        reason: f"c{i % SERIES}"
        for i, (reason, _) in enumerate(Counter(row[1] for row in places).most_common())
    }
    drawing = parts.titled("rejected", "Positions of rejected grid readings")
    for title, frame in zip(names, parts.panels(drawing, names, reach), strict=True):
        _field(frame, field, "card")
        for reason, colour in colours.items():
            at = [
                (x, y) for view, why, x, y in places if (view, why) == (title, reason)
            ]
            inside = [
                (min(max(x, -reach[0]), reach[0]), min(max(y, -reach[1]), reach[1]))
                for x, y in at
            ]
            drawing.discs(
                [frame.at(x, y) for x, y in inside], 3.0, fill=colour, opacity=0.8
            )
        frame.axes(ticks=(4, 4))
    _legend(
        drawing,
        {
            reason: (colour, sum(row[1] == reason for row in places))
            for reason, colour in colours.items()
        },
    )
    return drawing


def _legend(drawing: Drawing, entries: dict[str, tuple[str, int]]) -> None:
    """Write the reasons below, as many per row as fit."""
    x = 46.0
    y = drawing.height + 14
    for reason, (colour, count) in entries.items():
        words = f"{printable(reason).replace('_', ' ')} ({count})"
        width = 26 + parts.text_width(words, 12)
        if x + width > parts.WIDTH and x > 46:
            x = 46.0
            y = y + 18
        parts.legend(drawing, [(colour, words)], (x, y))
        x += width
    drawing.height = y + 10


LEFT, TOP, SIDE = 58.0, 40.0, 260.0


def camera_errors(result: CalibrationResult) -> draw.Drawing | None:
    """Return the camera's errors, published minus true offset, as vectors; None without images."""
    if result.camera is None:
        return None
    cells = result.camera.known_cells
    place = cells[:2] * MM_PER_M
    error = cells[2:4]
    u = cells[4:6] * result.noise.k_xy
    distance_mm = abs(place[0] + 1j * place[1] - (place[0] + 1j * place[1])[:, None])
    spacing = (
        float(distance_mm[distance_mm > 0].min(initial=np.inf))
        if len(distance_mm) > 1
        else 1.0
    )
    factor = parts.enlargement(np.hypot(*error), spacing / MM_PER_M)
    reach = float(
        np.abs(np.concatenate([place, place + error * factor * MM_PER_M])).max()
    )
    half = max(reach, float(np.abs(place).max()) + spacing / 2) * 1.1
    drawing = parts.titled("camera", "Error of the camera, published − true offset")
    frame = draw.Frame(drawing, (LEFT, TOP, SIDE, SIDE), (-half, half), (-half, half))
    drawing.discs([frame.at(x, y) for x, y in place.T], 2.0, fill="soft")
    parts.arrows(frame, place, error, factor)
    frame.axes(x_label="offset x in mm", y_label="offset y in mm")
    for x, y, dx, dy, ux, uy in np.concatenate(
        [place, error * UM_PER_M, u * UM_PER_M]
    ).T:
        words = (
            f"{with_u(dx, ux)} µm, {with_u(dy, uy)} µm (k = {result.noise.k_xy:.3g})"
        )
        drawing.spot(*frame.at(x, y), 12.0, f"x {x:.4g} mm, y {y:.4g} mm: {words}")
    parts.arrow_key(frame, factor, (LEFT, TOP + SIDE + 58))
    drawing.label(LEFT + 130, TOP + SIDE + 62, f"vectors enlarged {factor:,.0f} ×")
    drawing.height = TOP + SIDE + 76
    return drawing


def stage_yaw(result: CalibrationResult) -> draw.Drawing | None:
    """Return the yaw of the stage at its nodes in colour; None without images."""
    yaw_map = result.stage_yaw
    if yaw_map is None:
        return None
    place = np.stack([yaw_map.x, yaw_map.y]) * MM_PER_M
    yaw, u = yaw_map.yaw * URAD_PER_RAD, yaw_map.u_yaw * URAD_PER_RAD
    half = [np.diff(np.unique(along)).min(initial=np.inf) / 2 for along in place]
    dx, dy = (side if np.isfinite(side) else min(half) for side in half)
    x, y = (
        float(np.abs(along).max()) + side
        for along, side in zip(place, (dx, dy), strict=True)
    )
    drawing = parts.titled("yaw", "Yaw of the stage about its mean, counter-clockwise")
    width, height = (SIDE, SIDE * y / x) if y < x else (SIDE * x / y, SIDE)
    frame = draw.Frame(drawing, (LEFT, TOP, width, height), (-x, x), (-y, y))
    scale = parts.Scale("d", -(end := parts.round_end(yaw)), end)
    levels = parts.levels(yaw, scale)
    for level in np.unique(levels).tolist():
        drawing.shapes(
            [
                tuple(
                    frame.at(a + i * dx, b + j * dy)
                    for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))
                )
                for a, b in place[:, levels == level].T
            ],
            fill=f"d{level}",
        )
    frame.axes(x_label="stage x in mm", y_label="stage y in mm")
    parts.scale_bar(drawing, scale, (LEFT + width + 16, TOP, 14.0, height), "µrad")
    k = result.noise.k_xy
    for (a, b), value, spread in zip(place.T, yaw, u * k, strict=True):
        drawing.spot(
            *frame.at(a, b),
            0.9 * min(dx * frame.per_x, dy * frame.per_y),
            f"x {a:.4g} mm, y {b:.4g} mm: {with_u(value, spread)} µrad (k = {k:.3g})",
        )
    drawing.height = TOP + height + 46
    return drawing
