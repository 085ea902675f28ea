# SPDX-License-Identifier: Apache-2.0
"""Effects that machines have and these readings do not determine: they belong into U.

A drift measured in one pass or the direction of approach look like errors of the stage. Where the
readings determine such an effect it adds nothing. What they do not is a term of the model in its
nominal size, or, where too few readings would be left to show their noise, an effect beside it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from selfcal_ros.errors import NotSettledError
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.model_fit import equations_of
from selfcal_ros.estimation.joint.problem import NEGLIGIBLE
from selfcal_ros.estimation.joint.solve import (
    Solved,
    solve_joint,
    variance_of_terms,
)
from selfcal_ros.estimation.normal.equations import ENOUGH_DOF
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.equations import root_of
from selfcal_ros.estimation.verdict.uncertainty import Effect, effect_of_field
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import UNDETERMINED, nominal_terms


def with_undetermined_terms(
    solved: Solved, measurements: Measurements, options: Options
) -> tuple[Solved, Options, tuple[Effect, ...]]:
    """Return the solution with terms that its readings do not determine, and its options.

    And the effects of such terms if the solution is without them.

    Parameters
    ----------
    solved : Solved
        The solution without them.
    measurements, options : Measurements, Options
        Its readings, and how they were solved.
    """
    effects = tuple(_undetermined_effects(solved, options))
    names = {effect.name for effect in effects}
    if not names:
        return solved, options, ()
    more = tuple(term for term in nominal_terms((), visits=True) if term.name in names)
    problem = solved.joint.problem
    n_coefficients = len(term_columns(problem.inputs, more).columns)
    if problem.system.dof_grid - n_coefficients < ENOUGH_DOF:
        return solved, options, effects
    assuming_more = replace(options, assumed=(*options.assumed, *more))
    try:
        with_more = solve_joint(measurements, assuming_more, whole_only=True)
    except NotSettledError:
        return solved, options, effects
    return with_more, assuming_more, ()


def _undetermined_effects(solved: Solved, options: Options) -> Iterator[Effect]:
    """Yield what terms outside the model, each in its nominal size, would add to u of the XY maps.

    One for each independent combination of their coefficients: what the readings determine of a
    term is not part of that. None of terms that would hardly add anything.

    Parameters
    ----------
    solved : Solved
        The solution.
    options : Options
        How it was solved; nothing is added where nothing is assumed.
    """
    model = solved.model
    emap = solved.result.error_map
    if model is None or not (options.assumed and options.finite_rotations):
        return
    if not solved.result.has_uncertainty or not np.isfinite(model.fitted.xy.sigma):
        return
    problem, fitted = model.problem, model.fitted
    named_terms = {term.name for term in (*options.terms, *problem.terms)}
    visited = all(visits is not None for visits in problem.inputs.visits)
    more = nominal_terms(named_terms, visits=visited)
    # sizes that were raised may be such a term: a drift of one pass looks like a strained plate
    of_terms = variance_of_terms(solved.result)
    raised = sum(
        of_terms.get(str(test.name), 0.0) for test in model.sizes if test.raised
    )
    least = UNDETERMINED * rms(np.sqrt(np.maximum(emap.u_xy**2 - raised, 0.0)))
    for term in more:
        columns = term_columns(problem.inputs, (*(model.given or problem.terms), term))
        equations = equations_of(problem, fitted, columns)
        cover = MapsCovariance(
            problem.system,
            fitted.inverse,
            options.reference,
            half_width_m=problem.half_width_m,
            sigma_m=fitted.xy.sigma,
            terms=equations,
        )
        stage, plate = cover.maps_of_terms()
        coordinates = np.concatenate([stage.real, stage.imag, plate.real, plate.imag])
        rows = equations.rows([term.name])
        root = fitted.xy.sigma * root_of(cover.covariance_of_terms, rows)
        directions, size, _ = np.linalg.svd(coordinates @ root, full_matrices=False)
        added = (directions * size).T[size > NEGLIGIBLE * size.max(initial=0.0)]
        if np.sqrt((added[:, : 2 * emap.gx.size] ** 2).sum(axis=0).mean()) > least:
            for effect in added:
                yield _effect(str(term.name), effect, solved)


def _effect(name: str, coordinates: np.ndarray, solved: Solved) -> Effect:
    """Return the effect on Gx, Gy, Ax, Ay, one after the other, in the frame of the equations."""
    emap, plate = solved.result.error_map, solved.result.artifact_map
    stage, of_plate = np.split(coordinates, [2 * emap.gx.size])
    x, y = stage.reshape(2, *emap.gx.shape)
    effect = effect_of_field(
        name, x + 1j * y, solved.result.sense, np.zeros(len(emap.g_theta))
    )
    return replace(effect, plate=of_plate.reshape(2, *plate.ax.shape))
