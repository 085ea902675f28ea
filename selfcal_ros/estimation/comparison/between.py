# SPDX-License-Identifier: Apache-2.0
"""Several runs that measured the same values: mean, part between runs, deviation of each run.

Run i gives x_i = G + e_i + s_i c + b_i: e_i its own error with the covariance C_i, c an error
common to all runs of one machine (covariance K; s_i = 1, or 0 for a run of other origin), and b_i
the part between runs. Its covariance T has one variance for each given shape, and one for the rest.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.comparison.maps import Spread, significance, without
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.model.error_map import MANY_DOF
from selfcal_ros.model.recheck import Significance

INDEPENDENT = 1e-6
"""Part of a unit shape outside the span of earlier ones, below which it adds nothing."""
RUNS_LEVEL = 0.05
"""Probability that a run stands out, or a part between runs seems to exist, by chance."""
SINGLE = 0.8
"""Part of the scatter between runs above which a single shape is nearly all of it."""
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class Run:
    """The values of one run.

    Attributes
    ----------
    values : float array (d,)
        Values.
    covariance : float array (d, d) or (d,)
        Their covariance without the common part; variances if the correlations are unknown.
    common : float array (d, d) or (d,)
        Covariance of the part that it shares with the other runs of its machine.
    shares : bool
        Whether it has a common part.
    dof : float
        Degrees of freedom of its covariance.
    """

    values: np.ndarray
    covariance: np.ndarray
    common: np.ndarray
    shares: bool
    dof: float


@dataclass(frozen=True, eq=False)
class Deviation:
    """Deviation of a run from the weighted mean of the others.

    Attributes
    ----------
    e_n : float array (d,)
        Deviation over its expanded uncertainty, 95.45 %, without a part between runs (E_n).
    test : Significance or None
        Test of all values together, level 5 %.
    p_scatter : float
        Probability that a run deviates so much more than the others do from each other; NaN
        for two runs.
    """

    e_n: np.ndarray
    test: Significance | None
    p_scatter: float


@dataclass(frozen=True, eq=False)
class Mean:
    """Weighted mean of runs.

    Attributes
    ----------
    values, u : float array (d,)
        Mean and standard uncertainty.
    covariance : float array (d, d) or (d,)
        Covariance of the mean.
    within, common, between : float array (d,)
        Its variance from the uncertainties of the runs, from what they share, and from the part
        between runs.
    u_between : float
        Standard deviation of a value between runs, rms over the values.
    p_between : float
        Probability of as much scatter between runs without a part between them.
    weights : float array (runs,)
        Weights, sum 1.
    dof : float
        Degrees of freedom of u, the median of all values; the fewest, runs - 1 where nothing is
        shared, if nearly all that runs differ by is the amplitude of a single shape.
    deviations : tuple of Deviation
        Of each run.
    """

    values: np.ndarray
    covariance: np.ndarray
    within: np.ndarray
    common: np.ndarray
    between: np.ndarray
    u_between: float
    p_between: float
    weights: np.ndarray
    dof: float
    deviations: tuple[Deviation, ...]

    @property
    def u(self) -> np.ndarray:
        """Standard uncertainty."""
        return np.sqrt(self.within + self.common + self.between)


def independent_of(removed: np.ndarray, shapes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal columns of `removed`, and of what `shapes` add to them, (d, r), (d, m)."""
    q = np.linalg.qr(removed)[0] if removed.size else removed
    found: list[np.ndarray] = []
    for shape in shapes.T:
        rest = shape / max(np.linalg.norm(shape), TINY)
        for _ in range(2):  # the second time removes rounding
            for basis in (q, *(column[:, None] for column in found)):
                rest = rest - basis @ (basis.T @ rest)
        if np.linalg.norm(rest) > INDEPENDENT:
            found.append(rest / np.linalg.norm(rest))
    return q, np.stack(found, axis=1) if found else np.zeros((len(removed), 0))


def _diagonal(covariance: np.ndarray) -> np.ndarray:
    found = covariance if covariance.ndim == 1 else np.diag(covariance)
    return np.maximum(found, 0.0)


def _power(covariance: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Return the variances of the amplitudes of orthonormal shapes, (m,)."""
    if covariance.ndim == 1:
        return (shapes**2).T @ covariance
    return np.maximum(np.einsum("dm,de,em->m", shapes, covariance, shapes, optimize=True), 0.0)


def _independent_number(covariance: np.ndarray) -> float:
    """Return the number of independent values of equal variance with the same scatter of |x|^2."""
    square = float((covariance**2).sum())
    return float(_diagonal(covariance).sum()) ** 2 / square if square > 0 else 1.0


def variance_between(squares: np.ndarray, within: np.ndarray) -> float:
    """Return the variance between runs of Mandel and Paule, at least 0.

    Parameters
    ----------
    squares : float array (runs, n)
        n values of each run, independent of each other and with the same variance.
    within : float array (runs,)
        Variance of these values within each run.
    """
    def excess(variance: float) -> float:
        return _scatter(squares, within + variance) - (len(within) - 1)

    high = float(((squares - squares.mean(axis=0)) ** 2).sum(axis=0).mean())
    if not high > 0 or excess(0.0) <= 0:
        return 0.0
    low = 0.0
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def _scatter(squares: np.ndarray, within: np.ndarray) -> float:
    """Return the scatter of values about their weighted means, over their variances."""
    weight = 1 / np.maximum(within, TINY)
    rest = squares - weight @ squares / weight.sum()
    return float((weight @ rest**2).mean())


@dataclass(frozen=True, eq=False)
class _Parts:
    """Amplitudes of the shapes and the rest of every run, and their variances.

    The rest as that of independent values: `n_rest` of d values are.
    """

    shapes: np.ndarray
    amplitude: np.ndarray
    within: np.ndarray
    rest: np.ndarray
    rest_within: np.ndarray
    rest_share: np.ndarray
    n_rest: int


def _parts(values: np.ndarray, covariances: list[np.ndarray], q: np.ndarray,
           shapes: np.ndarray) -> _Parts:
    amplitude = values @ shapes
    known = np.concatenate([q, shapes], axis=1)
    n_rest = len(known) - known.shape[1]
    within = np.stack([_power(c, shapes) for c in covariances])
    total = np.array([_diagonal(c).sum() for c in covariances])
    scale = np.sqrt(values.shape[1] / max(n_rest, 1))
    return _Parts(shapes, amplitude, within, (values - amplitude @ shapes.T) * scale,
                  np.maximum(total - within.sum(axis=1), 0.0) / max(n_rest, 1),
                  np.maximum(1 - (known**2).sum(axis=1), 0.0), n_rest)


def _variances_between(parts: _Parts) -> tuple[np.ndarray, float]:
    """Return the variance between runs of each shape's amplitude, and of each value left."""
    of_shapes = np.array([variance_between(parts.amplitude[:, [m]], parts.within[:, m])
                          for m in range(parts.shapes.shape[1])])
    return of_shapes, variance_between(parts.rest, parts.rest_within) if parts.n_rest else 0.0


def mean_of(runs: list[Run], removed: np.ndarray, shapes: np.ndarray) -> Mean:
    """Return the weighted mean of runs.

    Parameters
    ----------
    runs : list of Run
        At least two, with the same values.
    removed : float array (d, r)
        Columns that are the datum of each run, which is removed.
    shapes : float array (d, m)
        Shapes whose amplitudes vary between runs each by its own; the rest has one variance.
    """
    q, shapes = independent_of(removed, shapes)
    values = np.stack([run.values - q @ (q.T @ run.values) for run in runs])
    own = [without(run.covariance, q) for run in runs]
    shares = np.array([run.shares for run in runs], dtype=float)
    parts = _parts(values, own, q, shapes)
    of_shapes, of_rest = _variances_between(parts)
    spread = shapes**2 @ of_shapes + parts.rest_share * of_rest
    weights = 1 / np.maximum([_diagonal(c).sum() + spread.sum() for c in own], TINY)
    weights = weights / weights.sum()
    shared = [without(run.common, q) for run in runs if run.shares]
    common = _sum([np.zeros(len(q)), *shared],
                  np.append(0.0, weights[shares > 0] / max(weights @ shares, TINY)))
    pooled = weights**2
    within = sum(w * _diagonal(c) for w, c in zip(pooled, own, strict=True))
    between = pooled.sum() * spread
    covariance = _sum([*own, common], np.append(pooled, (weights @ shares) ** 2))
    added = spread if covariance.ndim == 1 else (shapes * of_shapes) @ shapes.T + of_rest * (
        np.eye(len(q)) - q @ q.T - shapes @ shapes.T)
    covariance = covariance + pooled.sum() * added
    shared_part = (weights @ shares) ** 2 * _diagonal(common)
    p = _p_between(parts, runs, own)
    single = p < RUNS_LEVEL and of_shapes.max(initial=0.0) > SINGLE * spread.sum()
    dof = _dof_of_single(parts, of_shapes, weights, shared_part) if single else _dof(
        runs, own, parts, (of_shapes, of_rest), weights, within + shared_part + between)
    return Mean(
        weights @ values, covariance, within, shared_part, between,
        float(np.sqrt(spread.mean())), p, weights, dof,
        tuple(_deviation(i, runs, values, own, common, weights, q, added)
              for i in range(len(runs))))


def _sum(covariances: list[np.ndarray], factors: np.ndarray) -> np.ndarray:
    """Return the weighted sum of covariances: a matrix if one of them is."""
    full = any(c.ndim == 2 for c in covariances)
    return np.sum([f * (np.diag(c) if full and c.ndim == 1 else c)
                   for f, c in zip(factors, covariances, strict=True)], axis=0)


def _p_between(parts: _Parts, runs: list[Run], own: list[np.ndarray]) -> float:
    """Return the probability of the scatter between runs by chance: the worst shape, Bonferroni."""
    dof = _noise_dof(runs, own, np.ones(len(runs)))
    k = len(runs) - 1
    found = [float(fdtrc(k, dof, _scatter(parts.amplitude[:, [m]], parts.within[:, m]) / k))
             for m in range(parts.shapes.shape[1])]
    if parts.n_rest:
        number = min(_independent_number(_sum(own, np.ones(len(own)))), parts.n_rest)
        found.append(float(fdtrc(k * number, dof, _scatter(parts.rest, parts.rest_within) / k)))
    return min(1.0, len(found) * min(found, default=1.0))


def _noise_dof(runs: list[Run], own: list[np.ndarray], factors: np.ndarray) -> float:
    """Return the degrees of freedom of a sum of the runs' covariances (Welch-Satterthwaite)."""
    power = np.array([f * _diagonal(c).mean() for f, c in zip(factors, own, strict=True)])
    dof = np.array([min(run.dof, MANY_DOF) if run.dof > 0 else MANY_DOF for run in runs])
    return min(float(power.sum() ** 2 / max((power**2 / dof).sum(), TINY)), MANY_DOF)


def _dof(runs: list[Run], own: list[np.ndarray], parts: _Parts,
         between: tuple[np.ndarray, float], weights: np.ndarray, whole: np.ndarray) -> float:
    """Return the degrees of freedom of the mean's u, the median of all values.

    A variance between runs is a difference: its uncertainty is that of the scatter between runs,
    which contains the part within runs, with one degree of freedom less than there are runs.
    """
    k, pooled = len(runs) - 1, (weights**2).sum()
    inner = parts.within.T @ weights**2 / pooled
    scatter = pooled * (between[0] + inner) * parts.shapes**2
    terms = (scatter**2).sum(axis=1) / k
    if parts.n_rest:
        number = min(_independent_number(_sum(own, weights**2)), parts.n_rest)
        rest = pooled * (between[1] + weights**2 @ parts.rest_within / pooled) * parts.rest_share
        terms = terms + rest**2 / (k * number)
    for run, c, w in zip(runs, own, weights, strict=True):
        if 0 < run.dof < MANY_DOF:
            terms = terms + (w**2 * _diagonal(c)) ** 2 / run.dof
    found = (whole**2 / np.maximum(terms, TINY))[whole > 0]
    return min(float(np.median(found)), MANY_DOF) if len(found) else MANY_DOF


def _dof_of_single(parts: _Parts, of_shapes: np.ndarray, weights: np.ndarray,
                   shared: np.ndarray) -> float:
    """Return the degrees of freedom where runs differ by the amplitude of a single shape.

    The value with the fewest: the scatter of the amplitude has as many as there are runs but one,
    and what is shared is known. The noise within runs is not counted as known: the scatter
    contains that of the amplitude, and the rest of it is small there.
    """
    m = int(np.argmax(of_shapes))
    scatter = ((weights**2).sum() * of_shapes[m] + weights**2 @ parts.within[:, m]) * (
        parts.shapes[:, m] ** 2)
    ratio = float(np.min(shared[scatter > 0] / scatter[scatter > 0]))
    return min((len(weights) - 1) * (1 + ratio) ** 2, MANY_DOF)


def _deviation(i: int, runs: list[Run], values: np.ndarray, own: list[np.ndarray],
               common: np.ndarray, weights: np.ndarray, q: np.ndarray,
               between: np.ndarray) -> Deviation:
    """Return the deviation of run i from the weighted mean of the others."""
    others = np.where(np.arange(len(runs)) == i, 0.0, weights)
    others = others / others.sum()
    rest = values[i] - others @ values
    factors = others**2 + (np.arange(len(runs)) == i)
    shares = np.array([run.shares for run in runs], dtype=float)
    total = _sum([*own, common], np.append(factors, (shares[i] - others @ shares) ** 2))
    dof = _noise_dof(runs, own, factors)
    full = all(run.covariance.ndim == 2 for run in runs)
    test = significance(rest, Spread(total if full else _diagonal(total), q, dof))
    u = np.sqrt(_diagonal(total))
    e_n = np.divide(rest, coverage_factor(dof) * u, out=np.zeros_like(rest), where=u > 0)
    return Deviation(e_n, test, _p_scatter(i, values, own, others, between))


def _p_scatter(i: int, values: np.ndarray, own: list[np.ndarray], others: np.ndarray,
               between: np.ndarray) -> float:
    """Return the probability that run i is so much farther from the mean than the others are.

    Ratio of its squared distance from the mean of the others to the scatter of these, each over
    its expectation, as F with the number of independent values in each run (Box).
    """
    runs = len(values)
    if runs < 3:
        return float("nan")
    power = np.array([_diagonal(c).sum() + _diagonal(between).sum() for c in own])
    mean = others @ values
    of_mean = others**2 @ power
    left = np.flatnonzero(np.arange(runs) != i)
    scatter = ((values[left] - mean) ** 2).sum()
    expected = ((1 - 2 * others[left]) * power[left] + of_mean).sum()
    ratio = ((values[i] - mean) ** 2).sum() / max(power[i] + of_mean, TINY) / max(
        scatter / max(expected, TINY), TINY)
    total = _sum([*own, between], np.append(np.full(runs, 1 / runs), 1.0))
    number = max(_independent_number(total), 1.0)
    return float(fdtrc(number, number * (runs - 2), ratio))
