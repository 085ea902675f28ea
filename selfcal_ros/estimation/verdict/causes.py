# SPDX-License-Identifier: Apache-2.0
"""Causes: explanations with their largest component and its place; faults of angular lines."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import compress

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.blocks import Located, block_of, blocks
from selfcal_ros.estimation.joint.model_fit import ModelFit, equations_of
from selfcal_ros.estimation.joint.problem import FLOOR, LEAST_PART, pooled
from selfcal_ros.estimation.normal.equations import angular_residuals
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.estimation.verdict.explanations import CAUSE_LEVEL, Explanation
from selfcal_ros.estimation.verdict.off_sites import MOST, READING, SLIP
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Cause

NOISY = 1.5
"""Ratio of a view's noise to that of the others above which it is a cause."""

SURE = 3.0
"""Ratio of a rotation to its standard uncertainty above which the readings determine its view."""

CHECKED = 1e-6
"""Smallest share of a reading's error in its own residual: the part that other readings check."""


def cause_of(found: Explanation, ground: TermInputs) -> Cause:
    """Return an explanation of the residuals, or a term of the model, as a cause.

    Parameters
    ----------
    found : Explanation
        The explanation.
    ground : TermInputs
        Of the fit: names of the views, unit of a slip's rotation.
    """
    names = ground.names_of(found.name)
    options = list(_OTHERS[found.name](found, names, ground.half_width_m)
                   if found.name in _OTHERS else block_of(found.name).located(found, names))
    fields, value, u = max(((fields, *_linear(found, weights)) for fields, weights in options),
                           key=lambda sized: abs(sized[1]) / max(sized[2], 1e-300))
    unit = blocks()[found.name].unit if found.name in blocks() else "m"
    largest = 0.0 if found.moved is None else float(np.abs(found.moved).max(initial=0.0))
    return Cause(**{"name": found.name, "size": value, "u": u, "unit": unit, "p": found.p,
                    "effect_rms": found.effect_m, "effect_max": largest, "told": found.whole,
                    **fields})


def fitted_term(model: ModelFit, name: str, p: float = 1.0, *, whole: bool = True) -> Explanation:
    """Return a term of the model with its fitted coefficients and its effect."""
    if model.equations is None:
        raise ValueError(f"the model does not have the term {name}")
    equations = equations_of(model.problem, model.found, model.equations.columns, model.reduced)
    rows = equations.rows([name])
    covariance = model.covariance[np.ix_(rows, rows)] * model.found.xy.sigma**2
    columns = tuple(compress(equations.columns.columns, rows))
    found = Explanation(str(name), columns, model.coefficients[rows], covariance, p, whole, 0.0)
    return found.with_effect(equations, np.where(rows, model.coefficients, 0.0))


def scatter_of_views(model: ModelFit, measurements: Measurements
                     ) -> list[tuple[str, float, float]]:
    """Return (name, noise of one reading, degrees of freedom) from the repeats of each grid view.

    If marks were visited again, from the visits after subtraction of the fitted terms.
    """
    out, again = [], {row: (visits, rest) for row, visits, rest in model.visits_about_means()
                      if model.equations is not None and visits.repeated}
    for row, index in enumerate(model.problem.grid.index):
        view = measurements.views[index]
        sigma, dof = view.sigma_xy, float(view.dof_xy)
        if row in again:
            visits, rest = again[row]
            dof = 2.0 * (len(visits.mark) - len(np.unique(visits.mark)))
            sigma = float(np.sqrt(visits.weight @ abs(rest) ** 2 / dof))
        if dof > 0 and np.isfinite(sigma):
            out.append((view.view.name, sigma, dof))
    return out


def noisier_views(views: Sequence[tuple[str, float, float]]) -> list[Cause]:
    """Return the views whose noise exceeds that of the others (F-test), as causes.

    Parameters
    ----------
    views : sequence of (str, float, float)
        Name, noise of one reading, m, and degrees of freedom of each view.
    """
    found = []
    for index, (name, sigma, dof) in enumerate(views):
        others, rest = pooled((s, d) for i, (_, s, d) in enumerate(views) if i != index)
        if not rest or not others > FLOOR:
            continue
        ratio = sigma / others
        p = float(fdtrc(dof, rest, ratio**2)) * len(views)
        if p < CAUSE_LEVEL and ratio > NOISY:
            u = float(ratio * np.sqrt((1 / dof + 1 / rest) / 2))
            found.append(Cause("noise", float(ratio), u, "m/m", p, name))
    return found


def _linear(found: Explanation, weights: np.ndarray) -> tuple[float, float]:
    """Return weights @ values and its standard uncertainty."""
    variance = float(weights @ found.covariance @ weights)
    return float(weights @ found.values), math.sqrt(max(variance, 0.0))


def _reading(found: Explanation, names: tuple[str, ...], _: float) -> Located:
    if found.mark is None:
        raise ValueError("a reading without its mark")
    yield {"view": names[found.columns[0].view], "mark": found.mark}, (
        found.values / np.hypot(*found.values))


def _slip(found: Explanation, names: tuple[str, ...], half_width_m: float) -> Located:
    order = {column.component: i for i, column in enumerate(found.columns)}
    x, y, phi = (float(found.values[order[part]]) for part in ("x", "y", "phi"))
    size = math.hypot(x, y)
    toward = np.zeros(3)
    toward[order["x"]], toward[order["y"]] = (x / size, y / size) if size else (1.0, 0.0)
    yield {"view": names[found.columns[0].view],
           "details": {"after": found.part, "x": x, "y": y, "phi": phi / half_width_m}}, toward


_OTHERS: dict[str, Callable[..., Located]] = {SLIP: _slip, READING: _reading}
"""What is no term: see `selfcal_ros.blocks.Block.located`."""


def turned_too_far(model: ModelFit, result: CalibrationResult,
                   measurements: Measurements) -> Cause | None:
    """Return a cause if lines rotate relative to marks by as much as the plate is rotated.

    A plate that moved does not explain that: the offsets of lines have the wrong sign, or those of
    marks the wrong unit. None otherwise, or if the model has no such rotation.
    """
    between = next((term.name for term in model.problem.terms
                    if block_of(term.name).between), None)
    if between is None:
        return None
    held = fitted_term(model, between)
    first = len(model.problem.ground.with_lines) - len(held.values)  # fewer if the term is free
    values, covariance = np.pad(held.values, (first, 0)), np.pad(held.covariance, (first, 0))
    apart, variance = abs(values[:, None] - values), np.diag(covariance)
    spread = variance[:, None] + variance - 2 * covariance
    of_u = apart / np.sqrt(np.maximum(spread, np.finfo(float).tiny))
    phi = [view.phi for view, readings in zip(result.views, measurements.views, strict=True)
           if len(readings.m) and len(readings.k)]
    if not apart[of_u > SURE].max(initial=0.0) > np.ptp(phi) / 2:
        return None
    p = math.erfc(float(of_u.max()) / math.sqrt(2))
    return replace(cause_of(held, model.problem.ground), p=p)


def line_cause(model: ModelFit, measurements: Measurements, level: float) -> Cause | None:
    """Return the reading of a line that contradicts the others most; None if none does.

    Lines are fitted without marks. The error of a reading is its residual over 1 - h, the part that
    the fit does not follow; the reduction of the sum of squares is tested against the remainder
    (F-test; the level is that of all lines together). Lines are tested against no less noise than
    that with which they are weighted.

    Parameters
    ----------
    model : ModelFit
        The fit of marks and lines.
    measurements : Measurements
        Readings, for the names of the views.
    level : float
        Level of the test.
    """
    worst = min(_suspects(model, measurements), key=lambda line: line.p, default=None)
    return worst if worst is not None and worst.p < level else None


def _suspects(model: ModelFit, measurements: Measurements) -> Iterator[Cause]:
    """Yield the readings of lines with the largest residuals, each tested."""
    problem, system, angular = model.problem, model.problem.system, model.problem.system.angular
    least = LEAST_PART * model.found.xy.sigma / problem.half_width_m
    dof = angular.n_readings - system.rank_angular
    if dof < 2:
        return
    residuals = angular_residuals(system, problem.angular.y)
    squares = angular.weight * residuals**2
    for at in np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]:
        v, k = (int(i) for i in np.unravel_index(at, squares.shape))
        unit = np.zeros(squares.shape)
        unit[v, k] = 1.0
        left, weight = float(angular_residuals(system, unit)[v, k]), float(angular.weight[v, k])
        if weight <= 0 or left < CHECKED:
            continue
        off = float(residuals[v, k]) / left
        gained = weight * left * off**2
        variance = max(float(squares.sum()) - gained, 0.0) / (dof - 1)
        if variance <= FLOOR**2:
            continue
        variance = max(variance, least**2)
        p = float(fdtrc(1, dof - 1, gained / variance)) * angular.n_readings
        yield Cause(READING, off, float(np.sqrt(variance / (weight * left))), "rad", min(p, 1.0),
                    measurements.views[problem.angular.index[v]].view.name, mark=(k,))
