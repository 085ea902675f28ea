# SPDX-License-Identifier: Apache-2.0
"""Effects that machines have and these readings do not determine: they belong into U.

A drift measured in one pass or the direction of approach look like errors of the stage. Where the
readings determine such an effect it adds nothing.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.checks.wiring import LEAST_NOISE_M
from selfcal_ros.estimation.datum.covariance import MapsCovariance
from selfcal_ros.estimation.joint.model_fit import equations_of, spread_of
from selfcal_ros.estimation.joint.problem import NEGLIGIBLE
from selfcal_ros.estimation.joint.solve import Solved
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.estimation.verdict.uncertainty import Effect, effect_of_field
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.terms import UNTOLD, nominal_terms


def untold_effects(solved: Solved, options: Options) -> Iterator[Effect]:
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
    model, emap = solved.model, solved.result.error_map
    if model is None or not (options.assumed and options.finite_rotations):
        return
    if not solved.result.has_uncertainty or not np.isfinite(model.found.xy.sigma):
        return
    problem, found = model.problem, model.found
    known = {term.name for term in (*options.terms, *problem.terms)}
    visited = all(visits is not None for visits in problem.ground.visits)
    more = nominal_terms(known, visits=visited)
    if not more:
        return
    columns = term_columns(problem.ground, (*problem.terms, *more))
    equations = equations_of(problem, found, columns)
    maps = MapsCovariance(
        problem.system, found.inverse, options.reference, half_width_m=problem.half_width_m,
        terms=spread_of(equations, np.zeros((equations.n,) * 2))).maps_of_terms()
    both = np.concatenate([part for values in maps for part in (values.real, values.imag)])
    count = 2 * problem.system.grid.n_sites
    least = UNTOLD * rms(emap.u_xy)
    for term in more:
        added = _added(equations, both, columns.rows([term.name]), held=model.covariance,
                       sigma=found.xy.sigma)
        if np.sqrt((added[:count]**2).sum(axis=1).mean()) > least:
            for each in added.T:
                yield _effect(str(term.name), each, solved)


def _effect(name: str, both: np.ndarray, solved: Solved) -> Effect:
    """Return the effect on Gx, Gy, Ax, Ay, one after the other, in the frame of the equations."""
    emap, plate = solved.result.error_map, solved.result.artifact_map
    stage, of_plate = np.split(both, [2 * emap.gx.size])
    x, y = stage.reshape(2, *emap.gx.shape)
    found = effect_of_field(name, x + 1j * y, solved.result.sense, np.zeros(len(emap.g_theta)))
    return replace(found, plate=of_plate.reshape(2, *plate.ax.shape))


def _added(equations: TermEquations, maps: np.ndarray, rows: np.ndarray, *, held: np.ndarray,
           sigma: float) -> np.ndarray:
    """Return what the columns `rows` add to both maps, independent and of size 1, (n, c), m.

    With C = `held` the covariance of the model's own coefficients, which come first, M the
    information and F the `maps` (n, p) of the columns, their squares add up to
    (F_t - F C M_t) (M_tt + 1/size^2 - M_t' C M_t)^-1 (F_t - F C M_t)'.
    """
    own = slice(len(held))
    couple = held @ equations.unbiased[own][:, rows]
    size = equations.columns.size[rows]  # in whose units the coefficients are of equal order
    left = equations.unbiased[np.ix_(rows, rows)] - equations.unbiased[rows][:, own] @ couple
    left = left * np.outer(size, size) + max(sigma, LEAST_NOISE_M) ** 2 * np.eye(len(size))
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    root = size[:, None] * vectors * sigma / np.sqrt(np.maximum(values, LEAST_NOISE_M**2))
    moved = (maps[:, rows] - maps[:, own] @ couple) @ root
    left_maps, sizes, _ = np.linalg.svd(moved, full_matrices=False)
    return (left_maps * sizes)[:, sizes > NEGLIGIBLE * sizes.max(initial=0.0)]
