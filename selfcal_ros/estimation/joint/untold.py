# SPDX-License-Identifier: Apache-2.0
"""Effects that machines have and these readings do not determine: they belong into U.

A drift measured in one pass or the direction of approach look like errors of the stage. Where the
readings determine such an effect it changes nothing, and is left out of the model.
"""

import numpy as np

from selfcal_ros.estimation.joint.model_fit import equations_of
from selfcal_ros.estimation.joint.solve import Solved
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.equations import LEAST_NOISE_M, TermEquations
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.terms import UNTOLD, ModelTerm, nominal_terms


@one_thread()
def untold_terms(solved: Solved, options: Options) -> tuple[ModelTerm, ...]:
    """Return the terms outside the model that would add to u of the XY map, in nominal sizes.

    Of each the increase of u² if it alone were declared with its nominal size: what the readings
    determine of it is not part of that.

    Parameters
    ----------
    solved : Solved
        The solution.
    options : Options
        How it was solved; nothing is added where nothing is assumed.
    """
    model, emap = solved.model, solved.result.error_map
    if model is None or not (options.assumed and options.finite_rotations):
        return ()
    if not solved.result.has_uncertainty or not np.isfinite(model.found.xy.sigma):
        return ()
    problem = model.problem
    known = {term.name for term in (*options.terms, *problem.terms)}
    visited = all(visits is not None for visits in problem.ground.visits)
    more = nominal_terms(known, visits=visited)
    if not more:
        return ()
    columns = term_columns(problem.ground, (*problem.terms, *more))
    equations = equations_of(problem, model.found, columns)
    least = UNTOLD * rms(np.stack([emap.u_gx, emap.u_gy]))

    def matters(term: ModelTerm) -> bool:
        variance = _increase(equations, columns.rows([term.name]), model.covariance,
                             model.found.xy.sigma)
        return float(np.sqrt(variance.mean())) > least

    return tuple(filter(matters, more))


def _increase(equations: TermEquations, rows: np.ndarray, held: np.ndarray,
              sigma: float) -> np.ndarray:
    """Return what the columns `rows` add to the variance of the known nodes, (2, nodes), m^2.

    With C = `held` the covariance of the model's own coefficients, which come first, M the
    information and F the maps of the columns:
    (F_t - F C M_t) (M_tt + 1/size^2 - M_t' C M_t)^-1 (F_t - F C M_t)'.
    """
    own = slice(len(held))
    couple = held @ equations.unbiased[own][:, rows]
    size = equations.columns.size[rows]  # in whose units the coefficients are of equal order
    left = equations.unbiased[np.ix_(rows, rows)] - equations.unbiased[rows][:, own] @ couple
    left = left * np.outer(size, size) + max(sigma, LEAST_NOISE_M) ** 2 * np.eye(len(size))
    values, vectors = np.linalg.eigh((left + left.T) / 2)
    root = size[:, None] * vectors * sigma / np.sqrt(np.maximum(values, LEAST_NOISE_M**2))
    maps = equations.maps[equations.system.known_sites.ravel()]
    moved = (maps[:, rows] - maps[:, own] @ couple) @ root
    return np.stack([(moved.real**2).sum(axis=1), (moved.imag**2).sum(axis=1)])
