# SPDX-License-Identifier: Apache-2.0
"""Figures of the map: vectors, components beside their uncertainty, and the angular error."""

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.figures.drawing import (
    TICK,
    Drawing,
    Frame,
    Point,
    round_ticks,
    tick_text,
)
from selfcal_ros.reporting.figures.parts import (
    MAX_ARROWS,
    MAX_SPOTS,
    Scale,
    arrow_key,
    arrows,
    cells,
    enlargement,
    legend,
    map_frame,
    round_end,
    scale_bar,
    thinned,
)
from selfcal_ros.reporting.summary.format import UNKNOWN, significant
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M

WIDTH = 480.0
"""Width of a figure in pixels: its words can still be read on a telephone."""

LEFT, TOP, SIDE = 58.0, 40.0, 336.0
"""Place and width of a map in its figure."""

AXES = {"x_label": "stage x in mm", "y_label": "stage y in mm"}


def error_map(result: CalibrationResult,
              truth: Mapping[str, np.ndarray] | None = None) -> Drawing:
    """Return the vectors of G over their length, with the truth beneath where it is known."""
    emap, artifact = result.error_map, result.artifact
    length = np.hypot(emap.gx, emap.gy) * UM_PER_M
    sites = thinned(artifact, MAX_ARROWS)
    factor = enlargement(length / UM_PER_M, (sites[0].step or 1) * artifact.grid_pitch_m)
    drawing, frame = _sheet("error-map", "Error of the stage in X and Y: vectors from the nominal "
                            "sites, enlarged, over their length.", artifact,
                            _reach(emap, truth, factor))
    scale: Scale = ("e", round_end(length))
    cells(frame, artifact, length, scale)
    at = np.stack([artifact.x_m[sites].ravel(), artifact.y_m[sites].ravel()]) * MM_PER_M
    entries = [("ink", "measured")]
    if truth is not None:
        true = np.stack([np.where(emap.valid, truth[key], np.nan)[sites].ravel()
                         for key in ("gx", "gy")])
        arrows(frame, at, true, factor, colour="truth", width=3.4, heads=False)
        entries.append(("truth", "known truth"))
    found = np.stack([emap.gx[sites].ravel(), emap.gy[sites].ravel()])
    if _circles(frame, result, at, found, factor):
        entries.append(("band", f"U, k = {result.noise.k_xy:.3g}"))
    arrows(frame, at, found, factor)
    _finish(frame, "Error of the stage, G = indicated − true", scale)
    _spots(frame, emap)
    bottom = frame.box[1] + frame.box[3]
    arrow_key(frame, factor, (LEFT, bottom + 58))
    thin = "" if sites[0].step == 1 else f", every {_ordinal(sites[0].step or 1)} site"
    drawing.label(LEFT + 130, bottom + 62, f"vectors enlarged {factor:,.0f} ×{thin}", size=12)
    legend(drawing, entries, (LEFT, bottom + 82))
    drawing.height = bottom + 92
    return drawing


def component_maps(result: CalibrationResult) -> Drawing:
    """Return Gx, Gy and their standard uncertainties as four fields at one scale."""
    emap, artifact = result.error_map, result.artifact
    parts = {"Gx": emap.gx, "Gy": emap.gy, "u(Gx)": emap.u_gx, "u(Gy)": emap.u_gy}
    end = round_end(np.stack([emap.gx, emap.gy]) * UM_PER_M)
    side, gap, left = 158.0, 44.0, 44.0
    drawing = Drawing("components", "Components of the error and their standard uncertainty, all "
                      "at one scale.", WIDTH, 0)
    drawing.label(0, 16, "Components and their standard uncertainty, one scale", size=13, bold=True)
    top = 50.0
    for number, (name, values) in enumerate(parts.items()):
        column = number % 2
        frame = map_frame(drawing, artifact, (left + column * (side + gap), top, side))
        cells(frame, artifact, values * UM_PER_M, ("d", end))
        frame.axes(ticks=(4, 4), x_label="mm" if number > 1 else "")
        drawing.label(frame.box[0], top - 7, name, size=12, bold=True)
        if column:
            top += frame.box[3] + 56
    first = 50.0
    scale_bar(drawing, ("d", end), (left + 2 * side + gap + 14, first, 12.0, top - 56 - first))
    drawing.height = top - 8
    return drawing


def uncertainty_map(result: CalibrationResult) -> Drawing:
    """Return the expanded uncertainty of a coordinate, the larger of x and y, at every site."""
    emap = result.error_map
    values = np.fmax(emap.u_gx, emap.u_gy) * result.noise.k_xy * UM_PER_M
    values = np.where(emap.valid, values, np.nan)
    drawing, frame = _sheet("uncertainty", "Expanded uncertainty of a coordinate at every site.",
                            result.artifact, 0.0)
    scale: Scale = ("v", round_end(values))
    cells(frame, result.artifact, values, scale)
    _finish(frame, f"Expanded uncertainty U at the nodes, k = {result.noise.k_xy:.3g}", scale)
    drawing.height = frame.box[1] + frame.box[3] + 44
    return drawing


def _sheet(name: str, says: str, artifact: Artifact, reach: float) -> tuple[Drawing, Frame]:
    """Return a drawing and the frame of a map that has room for vectors of `reach` pitches."""
    drawing = Drawing(name, says, WIDTH, 0)
    plain = map_frame(drawing, artifact, (LEFT, TOP, SIDE))
    extra = max(reach - 0.5, 0.0) * artifact.grid_pitch_m * MM_PER_M
    x, y = (end[1] + extra for end in (plain.x, plain.y))
    return drawing, replace(plain, box=(LEFT, TOP, SIDE, SIDE * y / x), x=(-x, x), y=(-y, y))


def _reach(emap: ErrorMap, truth: Mapping[str, np.ndarray] | None, factor: float) -> float:
    """Return how far enlarged vectors reach beyond the outermost sites, in pitches."""
    artifact = emap.artifact
    most = 0.0
    for field in (emap, truth):
        if field is None:
            continue
        for key, at, half in (("gx", artifact.m, artifact.half[0]),
                              ("gy", artifact.n, artifact.half[1])):
            g = getattr(emap, key) if isinstance(field, ErrorMap) else np.asarray(field[key])
            ends = np.abs(at + g * factor / artifact.grid_pitch_m)
            known = ends[np.isfinite(ends)]
            most = max(most, float(known.max()) - half if known.size else 0.0)
    return min(most + 0.2, 4.0)


def _finish(frame: Frame, title: str, scale: Scale) -> None:
    frame.axes(x_label=AXES["x_label"], y_label=AXES["y_label"])
    left, top, width, height = frame.box
    frame.drawing.label(0, 16, title, size=13, bold=True)
    scale_bar(frame.drawing, scale, (left + width + 16, top, 14.0, height))


def _circles(frame: Frame, result: CalibrationResult, at: np.ndarray, found: np.ndarray,
             factor: float) -> bool:
    """Draw U around the heads; return whether it is large enough to be seen."""
    emap, sites = result.error_map, thinned(result.artifact, MAX_ARROWS)
    u = np.stack([part[sites].ravel() for part in (emap.u_gx, emap.u_gy)]) * (
        result.noise.k_xy * factor * MM_PER_M)
    known = np.isfinite(u).all(axis=0) & np.isfinite(found).all(axis=0)
    radii = np.stack([u[0] * frame.per_x, u[1] * frame.per_y])[:, known]
    if not known.any() or radii.max() < 0.7:
        return False
    tips = (at + found * factor * MM_PER_M)[:, known]
    frame.drawing.discs([frame.at(x, y) for x, y in tips.T], [(a, b) for a, b in radii.T],
                        fill="band", opacity=0.6)
    return True


def _spots(frame: Frame, emap: ErrorMap) -> None:
    """Tell a pointer the values of each site of a field that is not too large."""
    artifact = emap.artifact
    if max(artifact.shape) > MAX_SPOTS:
        return
    radius = 0.45 * artifact.grid_pitch_m * MM_PER_M * frame.per_x
    for index in np.ndindex(artifact.shape):
        x, y = (float(part[index]) * MM_PER_M for part in (artifact.x_m, artifact.y_m))
        g, u = ((_um(float(a[index])), _um(float(b[index]))) for a, b in ((emap.gx, emap.gy),
                                                            (emap.u_gx, emap.u_gy)))
        frame.drawing.spot(*frame.at(x, y), radius,
                           f"x {x:.6g} mm, y {y:.6g} mm: Gx {g[0]} µm, Gy {g[1]} µm, "
                           f"u {u[0]}, {u[1]} µm")


def _um(value_m: float) -> str:
    return significant(value_m * UM_PER_M) if math.isfinite(value_m) else UNKNOWN


def _ordinal(number: int) -> str:
    return {2: "2nd", 3: "3rd"}.get(number, f"{number}th")


CENTRE: Point = (240.0, 232.0)
ZERO, ROOM = 112.0, 66.0
"""Radius of the circle of no error, and of the largest error above it; pixels."""

MARKED_LINES = 120
"""Up to so many lines each gets a dot that tells a pointer its value."""

SCALE_AT = math.radians(22.5)
"""Where the radial scale is labelled."""


def angular_map(result: CalibrationResult,
                truth: Mapping[str, np.ndarray] | None = None) -> Drawing:
    """Return the angular error around the circle, with its expanded uncertainty as a band."""
    emap, k = result.error_map, result.noise.k_theta
    error, u = emap.g_theta * ARCSEC_PER_RAD, emap.u_g_theta * k * ARCSEC_PER_RAD
    true = None if truth is None or truth.get("g_theta") is None else np.asarray(
        truth["g_theta"]) * ARCSEC_PER_RAD
    drawing = Drawing("angular-map", "Error of the stage in theta: distance from the dashed "
                      "circle, outwards is counter-clockwise.", WIDTH, CENTRE[1] + 230)
    drawing.label(0, 16, "Error in θ in arcsec, outwards = counter-clockwise", size=13, bold=True)
    curves = [np.abs(error) + np.nan_to_num(u)] + ([] if true is None else [np.abs(true)])
    known = np.concatenate(curves)
    known = known[np.isfinite(known)]
    span = 1.05 * float(known.max()) if known.size and known.max() > 0 else 1.0
    angles = emap.artifact.theta_rad
    _rings(drawing, span)
    entries = [("ink", "measured")]
    if np.isfinite(u).any():
        _band(drawing, angles, error, u, span)
        entries.append(("band", f"U, k = {k:.3g}"))
    if true is not None:
        _curve(drawing, angles, true, span, colour="truth", width=2.6)
        entries.append(("truth", "known truth"))
    _curve(drawing, angles, error, span, colour="ink", width=1.3)
    if len(angles) <= MARKED_LINES:
        good = np.flatnonzero(np.isfinite(error))
        drawing.discs([_at(angles[i], error[i], span) for i in good], 1.8, fill="ink")
        for i in good:
            drawing.spot(*_at(angles[i], error[i], span), 7,
                         f"line {i}, {math.degrees(angles[i]):.6g}°: {significant(error[i])} arcsec"
                         + (f" ± {significant(u[i])}" if math.isfinite(u[i]) else ""))
    _scale(drawing, span)
    legend(drawing, entries, (90, CENTRE[1] + 220))
    return drawing


def _at(angle: float, value: float, span: float) -> Point:
    radius = ZERO + ROOM * max(min(value / span, 1.2), -1.2)
    return CENTRE[0] + radius * math.cos(angle), CENTRE[1] - radius * math.sin(angle)


def _ring(value: float, span: float) -> list[Point]:
    return [_at(math.radians(degrees), value, span) for degrees in range(0, 361, 5)]


def _rings(drawing: Drawing, span: float) -> None:
    for value in round_ticks(-span, span, 4):
        drawing.line(_ring(value, span), stroke="line")
    drawing.line(_ring(0.0, span), stroke="soft", dash=(5, 4))
    for degrees in range(0, 360, 45):
        angle = math.radians(degrees)
        drawing.line([_at(angle, -span, span), _at(angle, span, span)], stroke="line")
        outside = ZERO + ROOM + 16
        drawing.label(CENTRE[0] + outside * math.cos(angle),
                      CENTRE[1] - outside * math.sin(angle) + 4, f"{degrees}°", size=TICK,
                      anchor="middle", colour="soft")


def _scale(drawing: Drawing, span: float) -> None:
    for value in round_ticks(-span, span, 4):
        x, y = _at(SCALE_AT, value, span)
        words = ("+" if value > 0 else "") + tick_text(value)
        drawing.box(x - 3.4 * len(words), y - 7, 6.8 * len(words), 14, fill="paper")
        drawing.label(x, y + 4, words, size=TICK, anchor="middle")


def _next(count: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % count) for i in range(count)]


def _curve(drawing: Drawing, angles: np.ndarray, values: np.ndarray, span: float, *,
           colour: str, width: float) -> None:
    drawing.lines([(_at(angles[i], values[i], span), _at(angles[j], values[j], span))
                   for i, j in _next(len(angles)) if np.isfinite(values[[i, j]]).all()],
                  stroke=colour, width=width)


def _band(drawing: Drawing, angles: np.ndarray, error: np.ndarray, u: np.ndarray,
          span: float) -> None:
    known = np.isfinite(error) & np.isfinite(u)
    drawing.shapes([(_at(angles[i], error[i] + u[i], span), _at(angles[j], error[j] + u[j], span),
                     _at(angles[j], error[j] - u[j], span), _at(angles[i], error[i] - u[i], span))
                    for i, j in _next(len(angles)) if known[i] and known[j]],
                   fill="band", opacity=0.6)
