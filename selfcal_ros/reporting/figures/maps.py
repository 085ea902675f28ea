# SPDX-License-Identifier: Apache-2.0
"""Figures of the map: vectors, components with their uncertainty, and the angular error."""

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from textwrap import wrap
from typing import Any

import numpy as np

from selfcal_ros import __version__
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.estimation.comparison.verification import Verification
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.figures import drawing as draw
from selfcal_ros.reporting.figures import parts
from selfcal_ros.reporting.summary.numbers import (
    UNKNOWN,
    significant,
    truth_arrays,
    with_u,
)
from selfcal_ros.reporting.summary.sections import state_sentence
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M

LEFT, TOP, SIDE = 58.0, 40.0, 336.0
"""Place and width of the vector map in its figure."""

MAX_SPOTS = 31
"""Largest number of sites along a side that have tooltips."""

ERRORS = {"stage": "G = indicated − true", "plate": "A = true − nominal"}
"""Sign convention in the title of the map of a stage, and of a plate."""

CENTRE: draw.Point = (240.0, 232.0)
ZERO, ROOM = 112.0, 66.0
"""Radius of the circle of no error, and of the largest error above it; pixels."""

DRAWN = 720
"""Points of a circle between the lines of a Fourier series."""

MARKED_LINES = 120
"""Largest number of lines that have a dot with a tooltip each."""

SCALE_AT = math.radians(22.5)
"""Where the radial scale is labelled."""


def map_picture(
    result: CalibrationResult, truth: Mapping[str, np.ndarray] | None = None
) -> draw.Drawing:
    """Return the map as one picture: verdict, vectors, angular error and origin.

    Raises
    ------
    InputError
        If `truth` does not fit the map.
    """
    truth = truth_arrays(result.error_map, truth)
    pictures = [error_map(result, truth)]
    if result.artifact.angular_count:
        pictures.append(angular_map(result, truth))
    return _side_by_side(pictures, state_sentence(result), _origin(result))


def difference_picture(
    a: CalibrationResult,
    b: CalibrationResult,
    difference: Mapping[str, Any],
    verdict: str,
) -> draw.Drawing:
    """Return two maps and their difference side by side, each at its own scale.

    Parameters
    ----------
    a, b : CalibrationResult
        Calibrations on the same lattice.
    difference : mapping
        B minus A without the datum difference: gx, gy in m, g_theta in rad. B is drawn as A plus
        this, which is B in the datum of A; U of the difference is that of both, independent.
    verdict : str
        Heading.
    """
    map_a, map_b = a.error_map, b.error_map
    noise = replace(
        a.noise,
        k_xy=max(a.noise.k_xy, b.noise.k_xy),
        k_theta=max(a.noise.k_theta, b.noise.k_theta),
    )
    names = ("gx", "gy", "g_theta")
    of_b = replace(
        b,
        error_map=replace(
            map_b, **{name: getattr(map_a, name) + difference[name] for name in names}
        ),
    )
    of_both = replace(
        a,
        noise=noise,
        error_map=replace(
            map_a,
            **difference,
            **{
                f"u_{name}": np.hypot(
                    *(getattr(emap, f"u_{name}") for emap in (map_a, map_b))
                )
                for name in names
            },
        ),
    )
    titled = [("A", a), ("B, in the datum of A", of_b), ("B − A", of_both)]
    pictures = [error_map(result, title=title) for title, result in titled]
    if np.isfinite(difference["g_theta"]).any():
        pictures.append(
            angular_map(
                of_both, title="B − A in θ in arcsec, outwards = counter-clockwise"
            )
        )
    return _side_by_side(pictures, verdict, f"A: {_origin(a)}", f"B: {_origin(b)}")


def verification_picture(
    before: CalibrationResult,
    after: CalibrationResult,
    verification: Verification,
    sentence: str,
) -> draw.Drawing:
    """Return the maps without and with the correction side by side, at one scale.

    Parameters
    ----------
    before, after : CalibrationResult
        Maps on the same nodes.
    verification : Verification
        What was found; the map after is drawn in the datum of the map before.
    sentence : str
        Heading.
    """
    with_it = replace(
        after,
        error_map=replace(after.error_map, gx=verification.gx, gy=verification.gy),
    )
    largest = max(
        float(np.nanmax(np.hypot(result.error_map.gx, result.error_map.gy)))
        for result in (before, with_it)
    )
    pictures = [
        error_map(result, title=title, largest_m=largest)
        for title, result in (
            ("Without the correction", before),
            ("With the correction", with_it),
        )
    ]
    return _side_by_side(
        pictures, sentence, f"without: {_origin(before)}", f"with: {_origin(after)}"
    )


def _side_by_side(
    pictures: list[draw.Drawing], heading: str, *foot: str
) -> draw.Drawing:
    """Return pictures side by side below a heading, with lines on their origin."""
    margin, top = 28.0, 30.0
    width = margin + len(pictures) * (parts.WIDTH + margin)
    drawing = draw.Drawing("map", heading, width, 0)
    for line in wrap(heading, 52 * len(pictures)):
        drawing.label(drawing.width / 2, top, line, size=13, anchor="middle", bold=True)
        top += 18
    for column, picture in enumerate(pictures):
        drawing.add(picture, margin + column * (parts.WIDTH + margin), top)
    drawing.height = top + max(picture.height for picture in pictures) + 44
    for number, line in enumerate(foot):
        drawing.height += 14 * (number > 0)
        drawing.label(margin, drawing.height - 14, line, size=10, colour="soft")
    return drawing


def _origin(result: CalibrationResult) -> str:
    source = os.path.basename(str(result.input.get("file", "")))
    words = [
        f"plan {parts.shortened(result.plan_id, 60)}",
        f"method {parts.shortened(result.method, 20)}",
        f"θ datum {result.error_map.datum_theta}"
        if result.artifact.angular_count
        else "",
        f"input {parts.shortened(source, 60)}" if source else "",
        f"selfcal {__version__}",
    ]
    return "  ·  ".join(word for word in words if word)


def error_map(
    result: CalibrationResult,
    truth: Mapping[str, np.ndarray] | None = None,
    *,
    title: str = "",
    of: str = "stage",
    largest_m: float = 0.0,
) -> draw.Drawing:
    """Return the vectors of a map over their lengths in colour, with U around their heads.

    A known truth is drawn beneath. `of` is a key of `ERRORS`; the scales have room for an error
    of `largest_m`.
    """
    emap = result.error_map
    artifact = result.artifact
    k = result.noise.k_xy
    sites = parts.thinned(artifact, parts.MAX_ARROWS)
    step = sites[0].step or 1
    length = np.hypot(emap.gx, emap.gy)
    U = emap.u_xy * k
    factor = parts.enlargement(
        np.fmax(np.fmax(length, largest_m), U.max(axis=0)), step * artifact.grid_pitch_m
    )

    def shown(along: Iterable[np.ndarray], scale: float = 1.0) -> np.ndarray:
        return np.stack([component[sites].ravel() for component in along]) * scale

    at = shown((artifact.x_m, artifact.y_m), MM_PER_M)
    around = shown(U, factor * MM_PER_M)
    fields = [
        shown(np.where(emap.valid, g[key], np.nan) for key in ("gx", "gy"))
        for g in (vars(emap), truth)
        if g is not None
    ]
    tips = [at + field * factor * MM_PER_M for field in fields]
    drawing = parts.titled(
        f"{'error' if of == 'stage' else of}-map",
        title or f"Error of the {of}, {ERRORS[of]}",
    )
    frame = _frame(
        drawing, artifact, [np.abs(tip) + np.nan_to_num(around) for tip in tips]
    )
    scale = parts.Scale(
        "e", 0.0, parts.round_end(np.fmax(length, largest_m) * UM_PER_M)
    )
    parts.cells(frame, artifact, length * UM_PER_M, scale)
    entries = [("ink", "measured")]
    if truth is not None:
        parts.arrows(
            frame, at, fields[1], factor, colour="truth", width=3.4, heads=False
        )
        entries.append(("truth", "known truth"))
    if _ellipses(frame, tips[0], around):
        entries.append(("band", f"U at the nodes, k = {k:.3g}"))
    parts.arrows(frame, at, fields[0], factor)
    frame.axes(x_label=f"{of} x in mm", y_label=f"{of} y in mm")
    left, top, width, height = frame.box
    parts.scale_bar(drawing, scale, (left + width + 16, top, 14.0, height))
    _spots(frame, result, ERRORS[of][0])
    parts.arrow_key(frame, factor, (LEFT, top + height + 58))
    thin = "" if step == 1 else f", every {parts.ordinal(step)} site"
    drawing.label(
        LEFT + 130,
        top + height + 62,
        f"vectors enlarged {factor:,.0f} ×{thin}"
        if emap.valid.any()
        else "no site is known",
    )
    parts.legend(drawing, entries, (LEFT, top + height + 82))
    drawing.height = top + height + 92
    return drawing


def _frame(
    drawing: draw.Drawing, artifact: Artifact, ends_mm: list[np.ndarray]
) -> draw.Frame:
    """Return a frame of the field and of points (2, P) up to four pitches outside of it."""
    pitch = artifact.grid_pitch_m * MM_PER_M
    x, y = (
        min(
            max(
                (half + 0.5) * pitch, float(np.nanmax(ends, initial=0.0)) + 0.2 * pitch
            ),
            (half + 4) * pitch,
        )
        for half, ends in zip(
            artifact.reach, np.concatenate(ends_mm, axis=1), strict=True
        )
    )
    return draw.Frame(drawing, (LEFT, TOP, SIDE, SIDE * y / x), (-x, x), (-y, y))


def _ellipses(frame: draw.Frame, tips_mm: np.ndarray, u_mm: np.ndarray) -> bool:
    """Draw U (2, P) around the heads (2, P); return whether it is large enough to be seen."""
    finite = np.isfinite(u_mm + tips_mm).all(axis=0)
    radii = (u_mm * np.array([[frame.per_x], [frame.per_y]]))[:, finite]
    if radii.max(initial=0.0) < 0.7:
        return False
    frame.drawing.discs(
        [frame.at(x, y) for x, y in tips_mm[:, finite].T],
        list(map(tuple, radii.T)),
        fill="band",
        opacity=0.6,
    )
    return True


def _spots(frame: draw.Frame, result: CalibrationResult, name: str) -> None:
    """Add tooltips with the values of each site, unless the field is too large."""
    emap = result.error_map
    artifact = result.artifact
    k = result.noise.k_xy
    if artifact.m.size > MAX_SPOTS**2:
        return
    radius = 0.45 * artifact.grid_pitch_m * MM_PER_M * frame.per_x
    for index in np.ndindex(artifact.shape):
        x, y = (
            float(values[index]) * MM_PER_M for values in (artifact.x_m, artifact.y_m)
        )
        gx, gy, ux, uy = (
            float(values[index]) * UM_PER_M
            for values in (emap.gx, emap.gy, emap.u_gx, emap.u_gy)
        )
        words = (
            f"{name}x {with_u(gx, k * ux)} µm, {name}y {with_u(gy, k * uy)} µm (k = {k:.3g})"
            if math.isfinite(gx)
            else UNKNOWN
        )
        frame.drawing.spot(
            *frame.at(x, y), radius, f"x {x:.6g} mm, y {y:.6g} mm: {words}"
        )


def uncertainty_map(result: CalibrationResult) -> draw.Drawing | None:
    """Return the larger expanded uncertainty of x and y at every node; None if none is known."""
    emap = result.error_map
    artifact = result.artifact
    k = result.noise.k_xy
    U_um = np.where(emap.valid, np.fmax(emap.u_gx, emap.u_gy), np.nan) * k * UM_PER_M
    if not np.isfinite(U_um).any():
        return None
    drawing = parts.titled(
        "uncertainty-map", f"Uncertainty of the map, U with k = {k:.3g}"
    )
    frame = _frame(drawing, artifact, [np.zeros((2, 1))])
    scale = parts.range_scale(U_um)
    parts.cells(frame, artifact, U_um, scale)
    frame.axes(x_label="stage x in mm", y_label="stage y in mm")
    left, top, width, height = frame.box
    if scale.low == scale.high:
        drawing.label(
            left + width / 2,
            top + height / 2 + 4,
            f"{significant(scale.high)} µm everywhere",
            anchor="middle",
        )
    else:
        parts.scale_bar(drawing, scale, (left + width + 16, top, 14.0, height))
    drawing.height = top + height + 92
    return drawing


def component_maps(result: CalibrationResult, *, of: str = "stage") -> draw.Drawing:
    """Return Gx and Gy at one scale, and below them their U at a scale of its own.

    `of` is a key of `ERRORS`: of a plate they are Ax and Ay.
    """
    emap = result.error_map
    k = result.noise.k_xy
    errors = np.stack([emap.gx, emap.gy]) * UM_PER_M
    u = np.where(emap.valid, emap.u_xy, np.nan) * k * UM_PER_M
    end = parts.round_end(errors)
    side = 158.0
    gap = 44.0
    left = 44.0
    top = 50.0
    drawing = parts.titled(
        "components" if of == "stage" else f"{of}-components",
        f"Components of the error, and their U with k = {k:.3g}",
    )
    error_names = [ERRORS[of][0] + axis for axis in "xy"]
    for names, pair, scale in (
        (error_names, errors, parts.Scale("d", -end, end)),
        ([f"U({name})" for name in error_names], u, parts.range_scale(u)),
    ):
        for column, (name, values) in enumerate(zip(names, pair, strict=True)):
            box = (left + column * (side + gap), top, side)
            frame = parts.map_frame(drawing, result.artifact, box)
            parts.cells(frame, result.artifact, values, scale)
            frame.axes(ticks=(4, 4), x_label="mm" if name.startswith("U") else "")
            uniform = scale.low == scale.high
            drawing.label(frame.box[0], top - 7, name, bold=True)
            if uniform:
                drawing.label(
                    frame.box[0] + side / 2,
                    top + frame.box[3] / 2 + 4,
                    f"{significant(scale.high)} µm everywhere"
                    if np.isfinite(values).any()
                    else "not known",
                    anchor="middle",
                )
        if not uniform:
            parts.scale_bar(
                drawing, scale, (left + 2 * side + gap + 14, top, 12.0, frame.box[3])
            )
        top += frame.box[3] + 56
    drawing.height = top - 8
    return drawing


def angular_map(
    result: CalibrationResult,
    truth: Mapping[str, np.ndarray] | None = None,
    *,
    title: str = "Error in θ in arcsec, outwards = counter-clockwise",
    of: str = "stage",
) -> draw.Drawing:
    """Return the angular error around the circle, with its expanded uncertainty as a band."""
    emap = result.error_map
    k = result.noise.k_theta
    error = emap.g_theta * ARCSEC_PER_RAD
    u = emap.u_g_theta * k * ARCSEC_PER_RAD
    true = (
        None
        if truth is None or truth.get("g_theta") is None
        else np.asarray(truth["g_theta"]) * ARCSEC_PER_RAD
    )
    drawing = parts.titled(
        "angular-map" if of == "stage" else f"{of}-angular", title, CENTRE[1] + 230
    )
    curves = [np.abs(error) + np.nan_to_num(u)] + (
        [] if true is None else [np.abs(true)]
    )
    magnitudes = np.concatenate(curves)
    magnitudes = magnitudes[np.isfinite(magnitudes)]
    span = (
        1.05 * float(magnitudes.max())
        if magnitudes.size and magnitudes.max() > 0
        else 1.0
    )
    angles = emap.artifact.theta_rad
    _rings(drawing, span)
    entries = [("ink", "measured")]
    between, curve, spread = angles, error, u
    if emap.artifact.harmonics:  # the series, where the lines are far apart
        between = np.arange(DRAWN) * (2 * math.pi / DRAWN)
        stage = Compensator(emap)
        curve = stage.error_theta(between) * ARCSEC_PER_RAD
        spread = stage.uncertainty_theta(between) * k * ARCSEC_PER_RAD
    if np.isfinite(u).any():
        _band(drawing, between, curve, spread, span)
        entries.append(("band", f"U, k = {k:.3g}"))
    if true is not None:
        _curve(drawing, angles, true, span, colour="truth", width=2.6)
        entries.append(("truth", "known truth"))
    _curve(drawing, between, curve, span, colour="ink", width=1.3)
    if len(angles) <= MARKED_LINES:
        good = np.flatnonzero(np.isfinite(error))
        drawing.discs([_at(angles[i], error[i], span) for i in good], 1.8, fill="ink")
        for i in good:
            drawing.spot(
                *_at(angles[i], error[i], span),
                7,
                f"line {i}, {math.degrees(angles[i]):.6g}°: "
                f"{with_u(error[i], u[i])} arcsec (k = {k:.3g})",
            )
    _scale(drawing, span)
    parts.legend(drawing, entries, (90, CENTRE[1] + 220))
    return drawing


def _at(angle: float, value: float, span: float) -> draw.Point:
    radius = ZERO + ROOM * max(min(value / span, 1.2), -1.2)
    return CENTRE[0] + radius * math.cos(angle), CENTRE[1] - radius * math.sin(angle)


def _ring(value: float, span: float) -> list[draw.Point]:
    return [_at(math.radians(degrees), value, span) for degrees in range(0, 361, 5)]


def _rings(drawing: draw.Drawing, span: float) -> None:
    for value in draw.round_ticks(-span, span, 4):
        drawing.line(_ring(value, span), stroke="line")
    drawing.line(_ring(0.0, span), stroke="soft", dash=(5, 4))
    for degrees in range(0, 360, 45):
        angle = math.radians(degrees)
        drawing.line([_at(angle, -span, span), _at(angle, span, span)], stroke="line")
        outside = ZERO + ROOM + 16
        drawing.label(
            CENTRE[0] + outside * math.cos(angle),
            CENTRE[1] - outside * math.sin(angle) + 4,
            f"{degrees}°",
            size=draw.TICK,
            anchor="middle",
            colour="soft",
        )


def _scale(drawing: draw.Drawing, span: float) -> None:
    for value in draw.round_ticks(-span, span, 4):
        x, y = _at(SCALE_AT, value, span)
        words = ("+" if value > 0 else "") + draw.tick_text(value)
        drawing.box(x - 3.4 * len(words), y - 7, 6.8 * len(words), 14, fill="paper")
        drawing.label(x, y + 4, words, size=draw.TICK, anchor="middle")


def _between(line_known: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs of neighbouring lines that are both known."""
    count = len(line_known)
    return [
        (i, (i + 1) % count)
        for i in range(count)
        if line_known[i] and line_known[(i + 1) % count]
    ]


def _curve(
    drawing: draw.Drawing,
    angles: np.ndarray,
    values: np.ndarray,
    span: float,
    *,
    colour: str,
    width: float,
) -> None:
    drawing.lines(
        [
            [_at(angles[k], values[k], span) for k in pair]
            for pair in _between(np.isfinite(values))
        ],
        stroke=colour,
        width=width,
    )


def _band(
    drawing: draw.Drawing,
    angles: np.ndarray,
    error: np.ndarray,
    u: np.ndarray,
    span: float,
) -> None:
    drawing.shapes(
        [
            [
                _at(angles[k], error[k] + side * u[k], span)
                for k, side in ((i, 1), (j, 1), (j, -1), (i, -1))
            ]
            for i, j in _between(np.isfinite(error + u))
        ],
        fill="band",
        opacity=0.6,
    )
