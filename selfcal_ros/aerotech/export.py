# SPDX-License-Identifier: Apache-2.0
"""From an error map to calibration tables.

The correction that makes a commanded position true is c = +G = indicated - true (method,
section 1). Columns of the 2D table run along x, rows along y.
"""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from selfcal_ros import __version__
from selfcal_ros.aerotech.machine import MachineFrame
from selfcal_ros.aerotech.model import Table1D, Table2D, Unit, UnitWord
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.model.verdict import Grade
from selfcal_ros.units import ARCSEC_PER_DEG, M_PER_UM, RAD_PER_ARCSEC, UM_PER_M

DECIMALS = 5
"""Digits of a correction in um: rounding stays below 0.005 nm."""
MAX_THETA_ROUNDING_M = 0.01e-9
"""Largest motion of a point on the field's edge by rounding of an angular correction."""
PRIMARY = Unit(UnitWord.PRIMARY)


def micrometres(unit_m: float) -> Unit:
    """Return the correction unit for micrometres with a primary unit of `unit_m` m."""
    return Unit(UnitWord.PRIMARY, tidy(unit_m / M_PER_UM))


def tidy(value: float) -> float:
    """Return `value` without rounding errors from a change of unit."""
    return float(f"{value:.14g}") + 0.0


def table_xy(error_map: ErrorMap, frame: MachineFrame) -> Table2D:
    """Return the 2D table that corrects x and y.

    A reversed encoder gives a negative sample distance and corrections of opposite sign, so
    that the table follows the sign of the encoder.

    Raises
    ------
    InputError
        If a site is unknown: a table has no holes.
    """
    missing = int((~error_map.valid).sum())
    if missing:
        raise InputError("error map", f"{missing} sites are unknown, and a table has no holes",
                         "measure them, or fill them from their neighbours (--fill)")
    artifact, unit_m = error_map.artifact, frame.unit_m
    hx, hy = (half * artifact.grid_pitch_m for half in artifact.half)
    pitch = artifact.grid_pitch_m / unit_m
    corrections = np.stack([frame.sign_x * error_map.gx.T, frame.sign_y * error_map.gy.T], axis=-1)
    return Table2D(
        frame.y_axis, frame.x_axis, (frame.x_axis, frame.y_axis), tidy(frame.sign_y * pitch),
        tidy(frame.sign_x * pitch), np.round(corrections / M_PER_UM, DECIMALS), PRIMARY,
        micrometres(unit_m), tidy(frame.sign_y * (hy + frame.home_y_m) / unit_m),
        tidy(frame.sign_x * (hx + frame.home_x_m) / unit_m))


def theta_decimals(error_map: ErrorMap) -> int:
    """Return the digits of an angular correction in arcsec required by the field's size."""
    artifact = error_map.artifact
    radius = np.hypot(*artifact.half) * artifact.grid_pitch_m
    digits = int(np.ceil(np.log10(0.5 * RAD_PER_ARCSEC * radius / MAX_THETA_ROUNDING_M)))
    return max(DECIMALS, digits + 1)


def table_theta(error_map: ErrorMap, frame: MachineFrame) -> Table1D:
    """Return the 1D table that corrects theta.

    With known counts per degree it covers one turn and rolls over; without them the
    format cannot express the roll-over, and the table covers a turn in either direction.

    Raises
    ------
    InputError
        If the frame has no theta axis, or the map has unknown angular lines or none.
    """
    count, g = error_map.artifact.angular_count, error_map.g_theta
    if frame.theta_axis is None:
        raise InputError("theta axis", "it is not named", "give its index")
    if not count:
        raise InputError("error map", "it has no angular lines", "leave out --theta-axis")
    if not np.isfinite(g).all():
        raise InputError("error map", f"{int(np.isnan(g).sum())} angular lines are unknown, and a "
                         "table has no holes", "measure them or leave out --theta-axis")
    counts = frame.theta_counts_per_unit
    lines = np.arange(0 if counts else -count, count + 1)
    sign, first = frame.sign_theta, float(lines[0]) * 360 / count
    return Table1D(
        frame.theta_axis, tidy(sign * 360 / count),
        np.round(sign * np.rad2deg(g[lines % count]) * ARCSEC_PER_DEG, theta_decimals(error_map)),
        pos_unit=PRIMARY, cor_unit=Unit(UnitWord.PRIMARY, ARCSEC_PER_DEG),
        offset=tidy(sign * (np.rad2deg(frame.home_theta_rad) - first)),
        rollover=tidy(360 * counts) if counts else None)


def fill_unknown(error_map: ErrorMap) -> tuple[ErrorMap, int]:
    """Return the map with each unknown site set to the mean of its neighbours, and their number.

    Raises
    ------
    InputError
        If no site is known.
    """
    unknown = ~error_map.valid
    if unknown.all():
        raise InputError("error map", "no site is known", "calibrate first")
    number = np.full(unknown.shape, -1)
    number[unknown] = np.arange(unknown.sum())
    rows, columns, weights = [], [], []
    right = np.zeros((2, unknown.sum()))
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        here, there = _neighbours(shift, unknown.shape)
        row = number[here]
        take = row >= 0
        rows.append(row[take])
        columns.append(row[take])
        weights.append(np.ones(take.sum()))
        free = take & (number[there] >= 0)
        rows.append(row[free])
        columns.append(number[there][free])
        weights.append(-np.ones(free.sum()))
        known = take & (number[there] < 0)
        for out, field in zip(right, (error_map.gx, error_map.gy), strict=True):
            np.add.at(out, row[known], field[there][known])
    gx, gy = error_map.gx.copy(), error_map.gy.copy()
    if unknown.any():
        place = np.concatenate(rows), np.concatenate(columns)
        matrix = coo_array((np.concatenate(weights), place), shape=(right.shape[1],) * 2).tocsc()
        gx[unknown], gy[unknown] = (np.atleast_1d(spsolve(matrix, side)) for side in right)
    return replace(error_map, gx=gx, gy=gy), int(unknown.sum())


def _neighbours(shift: tuple[int, int], shape: tuple[int, int]) -> tuple[tuple, tuple]:
    """Return slices of the sites that have a neighbour at `shift`, and of that neighbour."""
    here, there = [], []
    for step, size in zip(shift, shape, strict=True):
        here.append(slice(max(0, -step), size - max(0, step)))
        there.append(slice(max(0, step), size - max(0, -step)))
    return tuple(here), tuple(there)


def provenance(result: CalibrationResult, frame: MachineFrame, *, filled: int = 0,
               now: datetime | None = None) -> list[str]:
    """Return comments with the origin and conventions of a table.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    frame : MachineFrame
        Axes of the machine, for `selfcal cal verify`.
    filled : int
        Number of unknown sites that were filled.
    now : datetime, optional
        Date of the export, UTC.
    """
    emap, source = result.error_map, result.input
    lines = [
        f"written by selfcal {__version__} on {(now or datetime.now(UTC)):%Y-%m-%dT%H:%M:%SZ}",
        f"plan: {result.plan_id}; sense: {result.sense}; method: {result.method}",
        f"bag: {source.get('file', 'unknown')}; sha256: {source.get('sha256', 'unknown')}",
        *verdict_lines(result),
        _uncertainty_line(result),
        f"model: {result.model.misalignment} misalignments" + "".join(
            f", {term.name}" + ("" if term.size is None else f":{term.size:g}")
            for term in result.model.terms),
        *_reference_lines(result),
        f"datum: no translation, rotation, magnification; theta: {emap.datum_theta}",
        "correction = + (indicated - true), added to the command; zero at home by the controller",
        frame.comment(),
    ]
    if filled:
        lines.append(f"{filled} sites were not measured: mean of their neighbours")
    return lines


def _uncertainty_line(result: CalibrationResult) -> str:
    if not result.has_uncertainty:
        return "uncertainty: not computed"
    u = np.stack([result.error_map.u_gx, result.error_map.u_gy])
    return (f"standard uncertainty of the corrections (k=1): {rms(u) * UM_PER_M:.3g} um rms; U: "
            f"k = {result.noise.k_xy:.3g} for 95.45 %")


def verdict_lines(result: CalibrationResult) -> list[str]:
    """Return the verdict, with the reasons if not qualified."""
    verdict, when = result.verdict, result.provenance.extra.get("last_exposure", "")
    lines = [f"measured until {when}"] if when else []
    if verdict.grade is Grade.GOOD:
        return [*lines, "verdict: good, the readings agree with the model"]
    if verdict.grade is Grade.ENLARGED:
        return [*lines, "verdict: good within an enlarged uncertainty",
                *(f"because: {reason}" for reason in verdict.reasons)]
    return [*lines, "verdict: NOT QUALIFIED, the readings contradict the model",
            *(f"because: {reason}" for reason in verdict.reasons)]


def _reference_lines(result: CalibrationResult) -> list[str]:
    reference = result.reference
    if not reference:
        return ["reference length: none, the scale is a convention"]
    certificate = reference.get("certificate") or "no certificate named"
    return [f"reference length: {reference['kind']}, relative error {reference['relative_error']:g}"
            f", u {reference['u_relative']:g} ({certificate})"]
