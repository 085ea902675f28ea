# SPDX-License-Identifier: Apache-2.0
"""What every exported table needs: a map without gaps, and comments on its origin."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from selfcal_ros import __version__
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap, rms
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import to_ascii
from selfcal_ros.units import UM_PER_M


def tidy(value: float) -> float:
    """Return `value` without rounding errors from a change of unit."""
    return float(f"{value:.14g}") + 0.0


def decimal(value: float) -> str:
    """Return the shortest decimal number that reads back as `value`, without exponent."""
    return np.format_float_positional(value, trim="-")


def comment_text(text: str) -> str:
    """Return a text without what is not printable, which could end its line."""
    return "".join(c if c.isprintable() else " " for c in text)


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
        site, neighbour = _neighbours(shift, unknown.shape)
        row = number[site]
        take = row >= 0
        rows.append(row[take])
        columns.append(row[take])
        weights.append(np.ones(take.sum()))
        free = take & (number[neighbour] >= 0)
        rows.append(row[free])
        columns.append(number[neighbour][free])
        weights.append(-np.ones(free.sum()))
        known_neighbour = take & (number[neighbour] < 0)
        for out, field in zip(right, (error_map.gx, error_map.gy), strict=True):
            np.add.at(out, row[known_neighbour], field[neighbour][known_neighbour])
    gx, gy = error_map.gx.copy(), error_map.gy.copy()
    if unknown.any():
        place = np.concatenate(rows), np.concatenate(columns)
        matrix = coo_array(
            (np.concatenate(weights), place), shape=(right.shape[1],) * 2
        ).tocsc()
        gx[unknown], gy[unknown] = (
            np.atleast_1d(spsolve(matrix, side)) for side in right
        )
    return replace(error_map, gx=gx, gy=gy), int(unknown.sum())


def _neighbours(shift: tuple[int, int], shape: tuple[int, int]) -> tuple[tuple, tuple]:
    """Return slices of the sites that have a neighbour at `shift`, and of that neighbour."""
    sites, neighbours = [], []
    for step, size in zip(shift, shape, strict=True):
        sites.append(slice(max(0, -step), size - max(0, step)))
        neighbours.append(slice(max(0, step), size - max(0, -step)))
    return tuple(sites), tuple(neighbours)


def provenance(
    result: CalibrationResult,
    frame: MachineFrame,
    *,
    filled: int = 0,
    command: str = "",
    now: datetime | None = None,
) -> list[str]:
    """Return comments with the origin and conventions of a table.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    frame : MachineFrame
        Axes of the machine, for `selfcal cal verify`.
    filled : int
        Number of unknown sites that were filled.
    command : str
        Command line of the export.
    now : datetime, optional
        Date of the export, UTC.
    """
    emap, source = result.error_map, result.input
    lines = [
        f"written by selfcal {__version__} on {(now or datetime.now(UTC)):%Y-%m-%dT%H:%M:%SZ}",
        *origin_lines(result, command),
        f"plan: {result.plan_id}; sense: {result.sense}; method: {result.method}",
        f"bag: {source.get('file', 'unknown')}; sha256: {source.get('sha256', 'unknown')}",
        *verdict_lines(result),
        _uncertainty_line(result),
        f"model: {result.model.misalignment} misalignments"
        + "".join(
            f", {term.name}" + ("" if term.size is None else f":{term.size:g}")
            for term in result.model.terms
        ),
        *_reference_lines(result),
        f"datum: no {_removed(result)}; theta: {emap.datum_theta}",
        "correction = + (indicated - true), added to the command",
        frame.comment(),
    ]
    if filled:
        lines.append(f"{filled} sites were not measured: mean of their neighbours")
    return lines


def _removed(result: CalibrationResult) -> str:
    if result.reference is not None:
        return "translation, rotation"
    return "translation, rotation, magnification"


def origin_lines(result: CalibrationResult, command: str = "") -> list[str]:
    """Return the command of an export, and file and digest of its result."""
    return [
        *([f"command: {command}"] if command else []),
        *(
            [
                f"result: {result.read_from[0]}",
                f"sha256 of the result: {result.read_from[1]}",
            ]
            if result.read_from
            else []
        ),
    ]


def _uncertainty_line(result: CalibrationResult) -> str:
    if not result.has_uncertainty:
        return "uncertainty: not computed"
    u = result.error_map.u_xy
    return (
        f"standard uncertainty of the corrections at the nodes (k=1): {rms(u) * UM_PER_M:.3g} um "
        f"rms; U: k = {result.noise.k_xy:.3g} for 95.45 %"
    )


def verdict_lines(result: CalibrationResult) -> list[str]:
    """Return the verdict with what U assumes, and its reasons unless it is good, in ASCII."""
    verdict = result.verdict
    when = result.provenance.last_exposure
    measured = [f"measured until {when}"] if when else []
    sentence = verdict.sentence or verdict.grade.replace("_", " ")
    lines = [
        f"verdict: {sentence if verdict.qualified else 'NOT QUALIFIED'}",
        *(f"because: {reason}" for reason in verdict.reasons),
    ]
    return [*measured, *map(to_ascii, lines)]


def _reference_lines(result: CalibrationResult) -> list[str]:
    length = result.reference
    if length is None:
        return ["reference length: none, the scale is a convention"]
    certificate = length.certificate or "no certificate named"
    return [
        f"reference length: {length.name}, relative error {length.relative_error:g}, u "
        f"{length.u_relative:g} ({certificate})"
    ]
