# SPDX-License-Identifier: Apache-2.0
"""The new formulation (Ibaraki, Goto, Matsubara): linear errors measured, set-up unknown."""

from collections.abc import Collection

import numpy as np

from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.laser.adjust import adjust
from selfcal_ros.laser.closure import (
    between_diagonals,
    check_lengths,
    length_closure,
    propagated,
)
from selfcal_ros.laser.data import Closure, Form, Method, StepDiagonal, StepDiagonalResult
from selfcal_ros.laser.published_equations import Erratum, solve_diagonal
from selfcal_ros.laser.wang import jacobian
from selfcal_ros.model.statistics import rms


@one_thread()
def identify_ibaraki(data: StepDiagonal, *, form: Form = Form.EXACT,
                 errata: Collection[Erratum] = ()) -> StepDiagonalResult:
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
    lengths = length_closure(data) or (None, None)
    if form is not Form.EXACT:
        return _paper(data, form, errata, lengths)
    found = adjust(data)
    mirror = {name: np.arctan(tilt).tolist()
              for name, tilt in zip(data.diagonals, found.tilt, strict=True)}
    between, u_between, residual = None, None, None
    if len(data.diagonals) > 1:
        residual = rms(found.residuals_m)
        if data.dim == 2:
            alone = [adjust(data.pick([name])) for name in data.diagonals]
            between, u_between = between_diagonals(data, alone)
    return StepDiagonalResult(
        data.steps_m, found.errors_m, propagated(data, found.by_readings, found.by_linear),
        Method.NEW, form, mirror, Closure(lengths[0], lengths[1], between, u_between, residual))


def _paper(data: StepDiagonal, form: Form, errata: Collection[Erratum],
           lengths: tuple[float | None, float | None]) -> StepDiagonalResult:
    """Return the mean of the diagonals by the paper's own equations."""
    def solve(readings: np.ndarray, linear: np.ndarray) -> np.ndarray:
        return solve_diagonal(data, readings, linear, form=form, errata=errata)

    readings, linear = data.readings_m, data.linear_mean_m
    alone = solve(readings, linear)
    by_readings = jacobian(lambda r: solve(r, linear).mean(axis=0), readings)
    by_linear = jacobian(lambda e: solve(readings, e).mean(axis=0), linear)
    between = alone[0] - alone[1] if len(alone) == 2 else None
    return StepDiagonalResult(
        data.steps_m, alone.mean(axis=0), propagated(data, by_readings, by_linear), Method.NEW,
        form, {}, Closure(*lengths, between))
