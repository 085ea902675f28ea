# SPDX-License-Identifier: Apache-2.0
"""Figure of the angular map: the error of every line as distance from a circle."""

import math
from collections.abc import Mapping

import numpy as np

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.figures.fields import legend
from selfcal_ros.reporting.figures.maps import WIDTH
from selfcal_ros.reporting.sheet.drawing import Drawing, Point
from selfcal_ros.reporting.sheet.frame import TICK, round_ticks, tick_text
from selfcal_ros.reporting.summary.format import significant
from selfcal_ros.units import ARCSEC_PER_RAD

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
    _circles(drawing, span)
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


def _circles(drawing: Drawing, span: float) -> None:
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
