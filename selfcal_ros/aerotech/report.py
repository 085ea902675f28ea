# SPDX-License-Identifier: Apache-2.0
"""What exported tables leave of a stage's error: a figure, and a chapter of the report."""

import numpy as np

from selfcal_ros.aerotech.export import table_xy
from selfcal_ros.aerotech.verify import Verification, verify_tables
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import Residual
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.chapters import Chapter, Figure
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.figures.drawing import Drawing
from selfcal_ros.reporting.summary.format import counted, fixed_column, significant
from selfcal_ros.reporting.summary.sections import Section
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M

MAX_SITES = 10_201
"""Sites of a field up to which the table is tried on a simulated controller."""

TITLE = "Exported table: before and after"
PLACES = {"sites": "at the nodes", "between": "between the nodes", "lines": "at the lines"}
BEFORE_AND_AFTER = ("before", "after")


def table_chapter(result: CalibrationResult) -> Chapter:
    """Return what the table of `selfcal cal export` leaves of the error, or why it is not tried.

    As `selfcal cal verify`: the map is the truth at its nodes, the cubic spline through them
    between.
    """
    emap = result.error_map
    unknown = int((~emap.valid).sum())
    if unknown == emap.valid.size:
        return Chapter(TITLE)
    if unknown:
        return _untried(f"{counted(unknown, 'unknown site')}, but a table has no gaps: "
                        "selfcal cal export --fill fills them from their neighbours")
    if emap.valid.size > MAX_SITES:
        return _untried(f"not tried beyond {MAX_SITES} sites: see selfcal cal verify")
    if max(np.abs(emap.gx).max(), np.abs(emap.gy).max()) > 0.5 * result.artifact.grid_pitch_m:
        return _untried("a table cannot correct errors beyond half a pitch")
    frame = MachineFrame()
    found = verify_tables(emap, [table_xy(emap, frame)], frame)
    rows = [(PLACES[residual.place], *fixed_column([
        f(which) * UM_PER_M for f in (residual.rms, residual.largest)
        for which in BEFORE_AND_AFTER], 4)) for residual in found.residuals]
    header = ("error vector in µm", "rms before", "after", "largest before", "after")
    return Chapter(TITLE, (Figure(
        controller_figure(found), "A simulated controller moving to the nodes and to the "
        "middle of every cell, without and with the table of selfcal cal export. What remains "
        "between the nodes is the controller's linear interpolation."),), (Section(
            "What the table leaves", table=(header, *rows), notes=(
                "The map is taken as the truth here: its own U adds to what remains.",)),))


def _untried(why: str) -> Chapter:
    return Chapter(TITLE, sections=(Section("", notes=(why,)),))


def controller_figure(found: Verification) -> Drawing:
    """Return the error of the controller, true − commanded, before and after at one scale."""
    drawing = parts.titled("before-after",
                           "Controller: true − commanded, without its constant shift")
    fields = [residual for residual in found.residuals if residual.place != "lines"]
    shown = [_shown(residual) for residual in fields]
    if fields:
        reach = (np.abs(fields[0].position).max(axis=1) * 1.2 * MM_PER_M).tolist()
        lengths = np.concatenate([np.hypot(*residual.before) for residual in fields])
        factor = parts.enlargement(lengths, min(spacing for _, spacing in shown))
        frames = parts.panels(drawing, [f"{which}, {PLACES[residual.place]}" for residual in fields
                                        for which in BEFORE_AND_AFTER], reach, 68.0)
        for number, frame in enumerate(frames):
            (residual, which), (take, _) = _pair(fields, number), shown[number // 2]
            parts.arrows(frame, residual.position[:, take] * MM_PER_M,
                         getattr(residual, which)[:, take], factor, width=0.9)
            frame.axes(ticks=(4, 4))
            left, top, _, height = frame.box
            drawing.label(left, top + height + 32, _sizes(residual, which, "µm", UM_PER_M),
                          size=11, colour="soft")
        parts.arrow_key(frames[0], factor, (46, drawing.height + 26))
        drawing.label(150, drawing.height + 30, "one scale for all; axes in mm")
        drawing.height += 40
    if found.lines is not None:
        _draw_lines(drawing, found.lines)
    return drawing


def _pair(fields: list[Residual], number: int) -> tuple[Residual, str]:
    return fields[number // 2], BEFORE_AND_AFTER[number % 2]


def _shown(residual: Residual) -> tuple[np.ndarray, float]:
    """Return every second, third, ... point along each side as a mask, and their spacing, m."""
    sides = [np.unique(side, return_inverse=True) for side in residual.position]
    step = max(1, -(-max(len(values) for values, _ in sides) // parts.MAX_ARROWS))
    take = np.all([number.ravel() % step == 0 for _, number in sides], axis=0)
    spacing = min(float(np.ptp(values)) / max(len(values) - 1, 1) for values, _ in sides)
    return take, step * (spacing or 1.0)


def _sizes(residual: Residual, which: str, unit: str, scale: float) -> str:
    rms, largest = (size(which) * scale for size in (residual.rms, residual.largest))
    if largest < 1e-4:
        return f"below 0.0001 {unit} everywhere"
    return f"rms {significant(rms)}, largest {significant(largest)} {unit}"


def _draw_lines(drawing: Drawing, residual: Residual) -> None:
    """Draw the angular residuals before and after over the angle, below what there is."""
    top = max(drawing.height, 16.0) + 44
    angle = np.rad2deg(residual.position[0])
    parts.chart(drawing, (62, top, 410, 150), [
        parts.Curve(angle, getattr(residual, which)[0] * ARCSEC_PER_RAD, colour, dots=2.0)
        for which, colour in zip(BEFORE_AND_AFTER, ("c5", "c1"), strict=True)],
        title=PLACES["lines"], labels=("θ in °", "arcsec"))
    for number, (which, colour) in enumerate(zip(BEFORE_AND_AFTER, ("c5", "c1"), strict=True)):
        sizes = _sizes(residual, which, "arcsec", ARCSEC_PER_RAD)
        parts.legend(drawing, [(colour, f"{which}: {sizes}")], (62, top + 206 + 18 * number))
    drawing.height = top + 236
