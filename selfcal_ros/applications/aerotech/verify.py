# SPDX-License-Identifier: Apache-2.0
"""Error of a simulated controller before and after loading tables: numbers, figure, chapter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.applications.aerotech.evaluate import (
    AxisSetup,
    CalEvaluator,
    MachineSetup,
    bound_2d,
)
from selfcal_ros.applications.aerotech.export import UNIFORM
from selfcal_ros.applications.aerotech.model import CalFile, Table, Table1D, Table2D
from selfcal_ros.applications.aerotech.one_axis import (
    OneAxisFit,
    known_rms,
    leaves_too_much,
    one_axis_fit,
)
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.export import fill_unknown
from selfcal_ros.compensation.frame import MachineFrame, frame_from_comments
from selfcal_ros.compensation.residual import (
    Correction,
    Residual,
    added_m,
    combined,
    plane_of,
    plane_residuals,
    residual_of,
)
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.chapters import CaptionedFigure, Chapter
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.summary.numbers import fixed_column, significant
from selfcal_ros.reporting.summary.sections import Section
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M


def setup_of(frame: MachineFrame) -> MachineSetup:
    """Return the controller's settings for the axes of a frame."""
    if frame.theta_axis is None or frame.theta_counts_per_unit is None:
        return MachineSetup()
    return MachineSetup({frame.theta_axis: AxisSetup(frame.theta_counts_per_unit)})


def plane_correction(tables: CalEvaluator, frame: MachineFrame) -> Correction:
    """Return what loaded tables add to x and y."""

    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        add = tables.corrections({frame.x_axis: px, frame.y_axis: py})
        none = np.zeros(np.shape(px))
        return add.get(frame.x_axis, none), add.get(frame.y_axis, none)

    return correct


def turned(
    stage: Compensator,
    frame: MachineFrame,
    theta_rad: ArrayLike,
    tables: CalEvaluator | None = None,
) -> np.ndarray:
    """Return the true angle, rad, after a command to `theta_rad`, as `reached` for theta."""
    position = frame.theta_to_machine(theta_rad)
    if tables is not None:
        axis = frame.theta_axis
        add = tables.corrections({} if axis is None else {axis: position})
        position = position + (0.0 if axis is None else add.get(axis, 0.0))
    return stage.correct_theta(frame.theta_from_machine(position))


@dataclass(frozen=True, eq=False)
class TableVerification:
    """Residuals at the sites, between them, and at the angular lines; None if not requested.

    `one_axis` is what tables of x and y leave if all of them are 1D: they correct only part of a
    map. `entries` is what 2D ones leave at their own entries that are not at sites, beyond the
    difference of straight line and spline between these.
    """

    frame: MachineFrame
    sites: Residual | None = None
    between: Residual | None = None
    lines: Residual | None = None
    one_axis: OneAxisFit | None = None
    entries: Residual | None = None

    @property
    def residuals(self) -> list[Residual]:
        """Return the available residuals."""
        return [r for r in (self.sites, self.between, self.lines) if r is not None]

    @property
    def worse(self) -> bool:
        """Whether the tables make the machine worse at its sites or lines.

        With 1D tables in whatever turn of both axes: a table of squareness turns one of them.
        """
        sites = self.sites
        if sites is not None and self.one_axis is not None:
            sites = replace(
                sites,
                before=_without_turn(sites.position, sites.before),
                after=_without_turn(sites.position, sites.after),
            )
        return any(
            r.rms("after") > (1 + 1e-6) * r.rms("before")
            for r in (sites, self.lines)
            if r is not None
        )

    def unfit(self, error_map: ErrorMap) -> list[Residual]:
        """Return the residuals of tables that are not those of a map, though no worse than none.

        Of a 2D table and of a theta table no more than U of the map (k = 2) may remain, rms, and
        at no place more than twice U, or 5 % of the error. 1D tables of x and y are
        judged by `one_axis`.
        """
        in_two_axes = self.sites if self.one_axis is None else None
        pairs = (
            (in_two_axes, (error_map.u_gx, error_map.u_gy)),
            (self.entries, (error_map.u_gx, error_map.u_gy)),
            (self.lines, (error_map.u_g_theta,)),
        )
        failing = [
            residual
            for residual, u in pairs
            if residual is not None
            and leaves_too_much(
                (residual.rms("after"), residual.largest("after")),
                (residual.rms("before"), residual.largest("before")),
                known_rms(*u),
            )
        ]
        return [
            residual
            for residual in failing
            if residual is not self.entries or self.sites not in failing
        ]


def _without_turn(position: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return residual vectors (2, P) at positions (2, P) without their least-squares turn."""
    x, y = position - position.mean(axis=1, keepdims=True)
    turn = np.stack([-y, x])
    square = (turn**2).sum()
    return residual - turn * ((turn * residual).sum() / square if square else 0.0)


def verify_tables(
    error_map: ErrorMap,
    tables: Sequence[Table],
    frame: MachineFrame,
    active: Correction | None = None,
) -> TableVerification:
    """Return the residuals of a stage with this error map and `tables`.

    `active` is the table that was loaded during the calibration, if any; see `plane_residuals`.

    Raises
    ------
    InputError
        If a table corrects or needs an axis outside the frame.
    """
    stage: set[int | None] = {frame.x_axis, frame.y_axis}
    xy = [table for table in tables if stage & set(table.outputs)]
    theta = [table for table in tables if frame.theta_axis in table.outputs]
    for table in tables:
        if not set(table.inputs) <= (stage if table in xy else {frame.theta_axis}):
            raise InputError(
                f"the table of line {table.line}",
                f"it corrects {list(table.outputs)} from the positions of {list(table.inputs)}",
                f"name the axes of the stage (now x={frame.x_axis}, y={frame.y_axis}, "
                f"theta={frame.theta_axis or 'none'})",
            )
    sites = between = lines = one_axis = entries = None
    in_one_axis = [table for table in xy if isinstance(table, Table1D)]
    if xy:
        evaluator = CalEvaluator(xy, setup_of(frame))
        sites, *between_sites = plane_residuals(
            error_map, frame, plane_correction(evaluator, frame), active
        )
        between = between_sites[0] if between_sites else None
        error = error_map if active is None else combined(error_map, frame, active)
        if len(in_one_axis) == len(xy):
            one_axis = one_axis_fit(error, in_one_axis, frame, setup_of(frame))
        else:
            entries = _at_entries(error, xy, frame, evaluator)
    if theta:
        lines = _at_lines(error_map, frame, CalEvaluator(theta, setup_of(frame)))
    return TableVerification(
        frame=frame,
        sites=sites,
        between=between,
        lines=lines,
        one_axis=one_axis,
        entries=entries,
    )


def _at_entries(
    error_map: ErrorMap,
    tables: Sequence[Table],
    frame: MachineFrame,
    evaluator: CalEvaluator,
) -> Residual | None:
    """Return what tables leave at the entries of 2D ones between the sites; None if none are there.

    Between the sites the error of the stage is known to the difference of the bilinear map and the
    spline through its sites.
    """
    filled_map, _ = fill_unknown(error_map)
    plate = filled_map.artifact
    plane = plane_of(filled_map)
    nodes = plate.x_m[:, 0], plate.y_m[0]
    places = [np.stack([plate.x_m.ravel(), plate.y_m.ravel()])]
    for table in tables:
        if isinstance(table, Table2D):
            bound = bound_2d(table, setup_of(frame))
            along = {
                track.axis: track.first + track.step * np.arange(track.count)
                for track in (bound.rows, bound.columns)
            }
            entries = frame.from_machine(along[frame.x_axis], along[frame.y_axis])
            inside = [
                p[(p > side[0]) & (p < side[-1])]
                for p, side in zip(entries, nodes, strict=True)
            ]
            places.append(np.stack(np.meshgrid(*inside)).reshape(2, -1))
    sites = plate.x_m.size
    position = np.concatenate(places, axis=1)
    pitches = (position[:, sites:] - position[:, :1]) / plate.grid_pitch_m
    between = (np.abs(pitches - np.round(pitches)) > UNIFORM).any(axis=0)
    position = position[:, np.append(np.full(sites, True), between)]
    if not between.any():
        return None
    correct = plane_correction(evaluator, frame)
    added = added_m(correct, frame, *frame.to_machine(*position))
    error = np.stack(Compensator(plane).error(*position))
    doubt = np.abs(
        np.stack(Compensator(plane, method="bicubic").error(*position)) - error
    )
    residual_m = error - added
    residual_m = residual_m - residual_m[:, :sites].mean(axis=1, keepdims=True)
    residual_m = np.sign(residual_m) * np.maximum(np.abs(residual_m) - doubt, 0.0)
    mean = error[:, :sites].mean(axis=1)
    return Residual(
        place="entries",
        position=position[:, sites:],
        before=(error - mean[:, None])[:, sites:],
        after=residual_m[:, sites:],
        shift_before=mean,
        shift_after=np.zeros(2),
    )


def _at_lines(
    error_map: ErrorMap, frame: MachineFrame, evaluator: CalEvaluator
) -> Residual:
    angles = error_map.artifact.theta_rad[np.isfinite(error_map.g_theta)]
    if not len(angles):
        raise InputError(
            "error map", "it knows no angular line", "leave out the theta axis"
        )
    stage = Compensator(error_map)
    return residual_of(
        "lines",
        angles[None],
        [turned(stage, frame, angles, tables)[None] for tables in (None, evaluator)],
    )


TITLE = "Exported table: before and after"
PLACES = {
    "sites": "at the nodes",
    "between": "between the nodes",
    "lines": "at the lines",
}
BEFORE_AND_AFTER = ("before", "after")


def frame_of_file(cal: CalFile) -> MachineFrame | None:
    """Return the frame that the comments of a file state; else columns are x and rows are y.

    None if it states none and its first table has one axis.
    """
    first = cal.tables[0]
    stated = frame_from_comments(cal.comments)
    if stated is None and isinstance(first, Table2D):
        return MachineFrame(first.column_axis, first.row_axis)
    return stated


def table_chapter(result: CalibrationResult, cal: CalFile) -> Chapter:
    """Return what exported tables leave of the error, as `selfcal cal verify`.

    The map is the truth at its nodes, the cubic spline through them between.

    Raises
    ------
    InputError
        If a table corrects or needs an axis outside the frame of the file.
    """
    verification = verify_tables(
        result.error_map, cal.tables, frame_of_file(cal) or MachineFrame()
    )
    rows = []
    for residual in verification.residuals:
        unit, scale = (
            ("arcsec", ARCSEC_PER_RAD)
            if residual.place == "lines"
            else ("µm", UM_PER_M)
        )
        sizes = [
            size(state) * scale
            for size in (residual.rms, residual.largest)
            for state in BEFORE_AND_AFTER
        ]
        rows.append((PLACES[residual.place], *fixed_column(sizes, 4), unit))
    header = ("error", "rms before", "after", "largest before", "after", "unit")
    figure = CaptionedFigure(
        controller_figure(verification),
        "A simulated controller moves to the nodes and to the middle of every cell, "
        "without and with the exported table. What remains between the nodes is the "
        "controller's linear interpolation.",
    )
    leaves = Section(
        "What the table leaves",
        table=(header, *rows),
        notes=("The map is taken as the truth here: its own U adds to what remains.",),
    )
    return Chapter(TITLE, (figure,), (leaves,))


def controller_figure(verification: TableVerification) -> Drawing:
    """Return the error of the controller, true − commanded, before and after at one scale."""
    drawing = parts.titled(
        "before-after", "Controller: true − commanded, without its constant shift"
    )
    fields = [
        residual for residual in verification.residuals if residual.place != "lines"
    ]
    selections = [_thinned(residual) for residual in fields]
    if fields:
        reach = (np.abs(fields[0].position).max(axis=1) * 1.2 * MM_PER_M).tolist()
        lengths = np.concatenate([np.hypot(*residual.before) for residual in fields])
        factor = parts.enlargement(lengths, min(spacing for _, spacing in selections))
        frames = parts.panels(
            drawing,
            [
                f"{state}, {PLACES[residual.place]}"
                for residual in fields
                for state in BEFORE_AND_AFTER
            ],
            reach,
            68.0,
        )
        for number, frame in enumerate(frames):
            residual, state = _pair(fields, number)
            take, _ = selections[number // 2]
            parts.arrows(
                frame,
                residual.position[:, take] * MM_PER_M,
                getattr(residual, state)[:, take],
                factor,
                width=0.9,
            )
            frame.axes(ticks=(4, 4))
            left, top, _, height = frame.box
            drawing.label(
                left,
                top + height + 32,
                _sizes(residual, state, "µm", UM_PER_M),
                size=11,
                colour="soft",
            )
        parts.arrow_key(frames[0], factor, (46, drawing.height + 26))
        drawing.label(150, drawing.height + 30, "one scale for all; axes in mm")
        drawing.height += 40
    if verification.lines is not None:
        _draw_lines(drawing, verification.lines)
    return drawing


def _pair(fields: list[Residual], number: int) -> tuple[Residual, str]:
    return fields[number // 2], BEFORE_AND_AFTER[number % 2]


def _thinned(residual: Residual) -> tuple[np.ndarray, float]:
    """Return every second, third, ... point along each side as a mask, and their spacing, m."""
    sides = [np.unique(side, return_inverse=True) for side in residual.position]
    step = max(1, -(-max(len(values) for values, _ in sides) // parts.MAX_ARROWS))
    take = np.all([number.ravel() % step == 0 for _, number in sides], axis=0)
    spacing = min(
        float(np.ptp(values)) / max(len(values) - 1, 1) for values, _ in sides
    )
    return take, step * (spacing or 1.0)


def _sizes(residual: Residual, state: str, unit: str, scale: float) -> str:
    rms, largest = (size(state) * scale for size in (residual.rms, residual.largest))
    if largest < 1e-4:
        return f"below 0.0001 {unit} everywhere"
    return f"rms {significant(rms)}, largest {significant(largest)} {unit}"


def _draw_lines(drawing: Drawing, residual: Residual) -> None:
    """Draw the angular residuals before and after over the angle, below what there is."""
    top = max(drawing.height, 16.0) + 44
    angle = np.rad2deg(residual.position[0])
    parts.chart(
        drawing,
        (62, top, 410, 150),
        [
            parts.Curve(
                angle, getattr(residual, state)[0] * ARCSEC_PER_RAD, colour, dots=2.0
            )
            for state, colour in zip(BEFORE_AND_AFTER, ("c5", "c1"), strict=True)
        ],
        title=PLACES["lines"],
        labels=("θ in °", "arcsec"),
    )
    for number, (state, colour) in enumerate(
        zip(BEFORE_AND_AFTER, ("c5", "c1"), strict=True)
    ):
        sizes = _sizes(residual, state, "arcsec", ARCSEC_PER_RAD)
        parts.legend(
            drawing, [(colour, f"{state}: {sizes}")], (62, top + 206 + 18 * number)
        )
    drawing.height = top + 236
