# SPDX-License-Identifier: Apache-2.0
"""The new formulation (Ibaraki, Goto, Matsubara): linear errors measured, set-up unknown."""

from collections.abc import Collection

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.laser.adjust import adjust
from selfcal_ros.laser.conventional import jacobian
from selfcal_ros.laser.data import DIAGONALS, Closure, Form, Identified, Method, StepDiagonal
from selfcal_ros.laser.noise import (
    linear_covariance,
    linear_noise,
    reading_covariance,
    reading_noise,
)
from selfcal_ros.laser.paper import Erratum, solve_diagonal

LENGTH_TOLERANCE = 1e-3
"""Largest relative disagreement of diagonals and linear errors that a set-up can explain: laser
or mirror off by about 30 mrad."""


def identify_new(data: StepDiagonal, *, form: Form = Form.EXACT,
                 errata: Collection[Erratum] = ()) -> Identified:
    """Identify the transverse errors from the readings and the measured linear errors.

    Parameters
    ----------
    data : StepDiagonal
        At least one diagonal in 2D, with linear errors.
    form : Form
        ``exact`` is right for any constant mirror tilt; the other forms follow the paper's
        equations, 2D only, and take the mean of the diagonals.
    errata : collection of Erratum
        Errors of the printed equations to put back; not with ``exact``, which does not use them.

    Raises
    ------
    InputError
        If the linear errors are missing, or do not fit the diagonals.
    NotIdentifiableError
        If the diagonals do not determine the errors.
    """
    check_lengths(data)
    singles = [data.pick([name]) for name in data.diagonals] if data.dim == 2 else []
    mirror: dict[str, list[float]] = {}
    residual = None
    if form is Form.EXACT:
        found = adjust(data)
        errors, by_readings, by_linear = found.errors_m, found.by_readings, found.by_linear
        mirror = {name: np.arctan(tilt).tolist()
                  for name, tilt in zip(data.diagonals, found.tilt, strict=True)}
        alone = [adjust(single).errors_m for single in singles] if len(singles) > 1 else []
        if len(data.diagonals) > 1:
            residual = float(np.sqrt(np.mean(found.residuals_m**2)))
    else:
        alone = list(_paper(data, data.readings_m, data.linear_mean_m, form, errata))
        errors = np.mean(alone, axis=0)
        by_readings, by_linear = _paper_derivatives(data, form, errata)
    between = alone[0] - alone[1] if len(alone) == 2 else None
    closure = Closure(length_closure(data), between, residual)
    return Identified(data.steps_m, errors, _covariance(data, by_readings, by_linear),
                      Method.NEW, form, mirror, closure)


def _paper(data: StepDiagonal, readings: np.ndarray, linear: np.ndarray, form: Form,
           errata: Collection[Erratum]) -> np.ndarray:
    return solve_diagonal(data, readings, linear, form=form, errata=errata)


def _paper_derivatives(data: StepDiagonal, form: Form,
                       errata: Collection[Erratum]) -> tuple[np.ndarray, np.ndarray]:
    readings, linear = data.readings_m, data.linear_mean_m
    return (jacobian(lambda r: _paper(data, r, linear, form, errata).mean(axis=0), readings),
            jacobian(lambda e: _paper(data, readings, e, form, errata).mean(axis=0), linear))


def _covariance(data: StepDiagonal, by_readings: np.ndarray,
                by_linear: np.ndarray) -> np.ndarray | None:
    """Propagate the noise of readings and linear errors; None if readings have no repeats.

    Linear errors without repeats count as exact.
    """
    noise, linear = reading_noise(data), linear_noise(data)
    if not noise.dof:
        return None
    out = by_readings @ reading_covariance(data, noise) @ by_readings.T
    if linear.dof:
        out += by_linear @ linear_covariance(data, linear) @ by_linear.T
    return out


def length_closure(data: StepDiagonal) -> float | None:
    """Return the rms of the diagonals less what the linear errors make of it, m.

    Parallelogram law: the squares of all diagonals sum to those of the sides, whatever the
    squareness. None if a diagonal or the linear errors are missing.
    """
    if data.linear_m is None or set(data.diagonals) != set(DIAGONALS[data.dim]):
        return None
    diagonals = data.readings_m.sum(axis=(1, 2))
    sides = data.linear_mean_m.sum(axis=1) + data.n_blocks * np.array(data.steps_m)
    return float(np.sqrt(np.mean(diagonals**2)) - np.linalg.norm(sides))


def check_lengths(data: StepDiagonal) -> None:
    """Refuse linear errors that cannot belong to the diagonals, block by block.

    Raises
    ------
    InputError
        If diagonals and sides of a block disagree by more than `LENGTH_TOLERANCE`; the message
        says so where micrometres in place of millimetres explain it.
    """
    linear = data.linear_mean_m
    if set(data.diagonals) != set(DIAGONALS[data.dim]):
        return
    square = np.mean(data.readings_m.sum(axis=1) ** 2, axis=0)
    steps = np.array(data.steps_m)[:, None]
    excess = _excess(square, steps + linear)
    worst = int(np.argmax(np.abs(excess)))
    if abs(excess[worst]) <= LENGTH_TOLERANCE:
        return
    smaller = _excess(square, steps + 1e-3 * linear)[worst]
    what = (f"diagonals and linear errors disagree by "
            f"{excess[worst] * np.linalg.norm(steps) * 1e3:.4g} mm")
    if abs(smaller) < 0.1 * abs(excess[worst]):
        raise InputError(f"block {worst + 1}", what + "; the linear errors look like micrometres",
                         "give ex_x, ey_y in mm")
    raise InputError(f"block {worst + 1}", what,
                     "check the steps, the units, and that both are of one machine")


def _excess(square: np.ndarray, sides: np.ndarray) -> np.ndarray:
    return np.sqrt(square / np.sum(sides**2, axis=0)) - 1.0
