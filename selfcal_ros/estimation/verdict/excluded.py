# SPDX-License-Identifier: Apache-2.0
"""Effects that U does not contain: terms outside the model that no reading shows.

Bending that differs between views, or a drift measured in one pass, moves the map and leaves the
residuals as they are. Nobody knows its size, so that it is no line of the budget; what a nominal
size would add to u is stated beside it.
"""

import numpy as np

from selfcal_ros.estimation.joint.model_fit import ModelFit, equations_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import term_columns
from selfcal_ros.estimation.terms.equations import LEAST_NOISE_M, TermEquations
from selfcal_ros.model.terms import NOMINAL_SIZES, UNITS, VISIT_TERMS, ModelTerm, TermName
from selfcal_ros.model.verdict import BudgetLine

EXCLUDED = tuple(ModelTerm(name, NOMINAL_SIZES[name]) for name in (
    TermName.DRIFT, TermName.PLATE_SHAPE, TermName.APPROACH))
"""Terms that are not assumed by default; a change of scale is a strain, which is."""

MATTERS = 0.3
"""Effect in standard uncertainties of the map, rms, below which it is not stated."""


def excluded_lines(model: ModelFit, options: Options, u_rms: float) -> tuple[BudgetLine, ...]:
    """Return what terms outside the model would add to u of the XY map, the largest first.

    Of each the increase of u² if it alone were declared with its nominal size: what the readings
    determine of it is not part of that.

    Parameters
    ----------
    model : ModelFit
        The fit.
    options : Options
        Terms that are declared, also those that are declared to be zero.
    u_rms : float
        Standard uncertainty of the map, rms over its coordinates, m.
    """
    problem = model.problem
    known = {term.name for term in (*options.terms, *problem.terms)}
    visited = all(visits is not None for visits in problem.ground.visits)
    more = [term for term in EXCLUDED if term.name not in known
            and (visited or term.name not in VISIT_TERMS)]
    columns = term_columns(problem.ground, (*problem.terms, *more), problem.drift_degree)
    equations = equations_of(problem, model.found, columns)
    held, lines = model.covariance, []
    for term in more:
        variance = _increase(equations, columns.rows([term.name]), held, model.found.xy.sigma)
        lines.append(BudgetLine(
            "xy", f"term {term.name}", "B", float("nan"), term.size, UNITS[term.name],
            float(np.sqrt(variance.mean())), float(np.sqrt(variance.max())), np.inf, "excluded"))
    return tuple(sorted((line for line in lines if line.effect_rms > MATTERS * u_rms),
                        key=lambda line: -line.effect_rms))


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
