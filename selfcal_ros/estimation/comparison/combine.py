# SPDX-License-Identifier: Apache-2.0
"""Several calibrations of one stage combined to one map, with the part between runs in its U.

Run i gives x_i = G + e_i + s_i c + b_i: e_i its own error with the covariance C_i, c an error
common to all runs of one machine (covariance K; s_i = 1, or 0 for a run of other origin), and b_i
the part between runs. Its covariance T has one variance for each given shape, and one for the rest.
"""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import fdtrc

from selfcal_ros import __version__
from selfcal_ros.blocks import blocks
from selfcal_ros.compensation.circle import fourier_basis
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import BEYOND, SHOWN
from selfcal_ros.estimation.comparison.covariance import (
    behind,
    covariance_of,
    kept_covariances,
)
from selfcal_ros.estimation.comparison.lengths import (
    Lengths,
    lengths_of,
    require_one_text,
)
from selfcal_ros.estimation.comparison.maps import (
    KINDS,
    ReducedNoise,
    joint_dof,
    require_same_lattice,
    significance,
    variances,
    variances_of,
    without,
)
from selfcal_ros.estimation.datum.covariance import NO_NOISE, USUAL_LEVEL
from selfcal_ros.estimation.joint.problem import NEGLIGIBLE, coverage_factor
from selfcal_ros.estimation.joint.solve import factors_of
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import TRACE
from selfcal_ros.estimation.verdict.uncertainty import (
    DETERMINED_BELOW,
    INTERPOLATION,
    budget_lines,
)
from selfcal_ros.model.budget import READING_NOISE, BudgetLine, OfRuns
from selfcal_ros.model.error_map import (
    MANY_DOF,
    ErrorMap,
    datum_columns,
    rms,
)
from selfcal_ros.model.findings import (
    BetweenRuns,
    EnlargedRuns,
    Finding,
    NotInAll,
    WarningOfRuns,
)
from selfcal_ros.model.parts import Combined, CombinedRun, Parts
from selfcal_ros.model.recheck import Significance
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import (
    COMBINED,
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
)
from selfcal_ros.model.verdict import (
    Enlargement,
    Grade,
    ModelResult,
    Provenance,
    Verdict,
)

OTHER_UNIT = 300.0
"""How many times larger the errors in a table are that is not in m or rad."""


@dataclass(frozen=True, eq=False)
class Member:
    """A map to be combined: its file, and its calibration; None for a map of other origin."""

    name: str
    error_map: ErrorMap
    result: CalibrationResult | None = None


def require_own_readings(
    members: Sequence[Member], common: Mapping[str, np.ndarray], *, scale: bool
) -> None:
    """Refuse a map that equals another but for its datum, or has another unit or sign.

    Parameters
    ----------
    members : sequence of Member
        The maps.
    common : mapping
        ``xy``, ``theta`` -> places known in all maps.
    scale : bool
        Whether magnification belongs to the datum.
    """
    first = next(
        index for index, member in enumerate(members) if member.result is not None
    )
    for kind, known_places in common.items():
        q = np.linalg.qr(
            datum_columns(
                members[first].error_map.artifact, kind, known_places, scale=scale
            )
        )[0]
        maps, u = (
            np.array(
                [
                    member.error_map.of(kind)[of][:, known_places].ravel()
                    for member in members
                ]
            )
            for of in (0, 1)
        )
        maps -= maps @ q @ q.T
        for index, member in enumerate(members):
            if member.result is None:
                ratio = rms(maps[index]) / max(rms(maps[first]), rms(u[first]))
                if ratio > OTHER_UNIT:
                    raise InputError(
                        member.name,
                        f"its errors are {ratio:.2g} times those of "
                        f"{members[first].name}: is it in µ{KINDS[kind]}?",
                        "give m and rad",
                    )
                if _is_opposite(
                    *(maps[n] / np.maximum(u[n], NO_NOISE) for n in (index, first))
                ):
                    raise InputError(
                        member.name,
                        f"of the opposite sign to {members[first].name}: its negative "
                        "agrees, and it does not",
                        "give G = indicated - true",
                    )
            for earlier in range(index if kind == "xy" else 0):
                if (
                    rms(
                        (maps[index] - maps[earlier]) / np.minimum(u[index], u[earlier])
                    )
                    < NEGLIGIBLE
                ):
                    raise InputError(
                        member.name,
                        f"of the same readings as {members[earlier].name}: their maps are equal",
                        "leave one of them out",
                    )


def _is_opposite(values: np.ndarray, reference: np.ndarray) -> bool:
    """Return whether two maps, over their u, are each other's negative beyond doubt.

    Both are beyond noise, of more values than agree in sign by chance, and their sum is as much
    less than their difference.
    """
    sizes = rms(values), rms(reference)
    if min(sizes) < BEYOND or 0.5 ** len(values) > SHOWN:
        return False
    values, reference = values / sizes[0], reference / sizes[1]
    return BEYOND * rms(values + reference) < rms(values - reference)


def shared_reference(
    results: Sequence[CalibrationResult | None], weights: np.ndarray
) -> ReferenceLength | None:
    """Return what sets the scale of a mean that keeps it: the reference lengths of its runs.

    Parameters
    ----------
    results : sequence of CalibrationResult or None
        The runs; None for a map of other origin, whose reference is not known, so that the mean is
        not certified.
    weights : float array (runs,)
        Their weights in the mean.

    Returns
    -------
    ReferenceLength or None
        None if a run has no reference length; that of all runs if it is the same; otherwise
        the weighted mean, with that of each in `runs`.
    """
    calibrations = [result for result in results if result is not None]
    references = [result.reference for result in calibrations if result.reference]
    if len(references) < len(calibrations):
        return None
    if len(calibrations) < len(results):
        references = [replace(reference, certified=None) for reference in references]
    if all(reference == references[0] for reference in references):
        return references[0]
    share = np.array(
        [weight for result, weight in zip(results, weights, strict=True) if result]
    )
    errors = np.array([reference.relative_error for reference in references])
    names = dict.fromkeys(reference.certificate or "none" for reference in references)
    return replace(
        references[0],
        certified=None,
        relative_error=float(share @ errors / share.sum()),
        u_relative=max(reference.u_relative for reference in references),
        certificate="; ".join(names),
        runs=tuple(references),
    )


def of_all_runs(results: Sequence[CalibrationResult | None]) -> Provenance:
    """Return the provenance of a mean: the first and the last exposure, if all runs have theirs."""
    runs = [result.provenance for result in results if result]
    if not all(run.first_exposure and run.last_exposure for run in runs):
        return Provenance(version=__version__)
    return Provenance(
        version=__version__,
        first_exposure=min(run.first_exposure for run in runs),
        last_exposure=max(run.last_exposure for run in runs),
    )


SINGLE = 0.8
"""Part of the scatter between runs above which a single shape is nearly all of it."""
TINY = np.finfo(float).tiny


@dataclass(frozen=True, eq=False)
class RunValues:
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
    is_of_scale : bool
        Whether nearly all that runs differ by is their scale.
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
    is_of_scale: bool

    @property
    def u(self) -> np.ndarray:
        """Standard uncertainty."""
        return np.sqrt(self.within + self.common + self.between)


def independent_of(
    removed: np.ndarray, shapes: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return orthonormal columns of `removed`, and of what `shapes` add to them, (d, r), (d, m)."""
    basis = np.linalg.qr(removed)[0] if removed.size else removed
    datum = basis.shape[1]
    for shape in shapes.T:
        independent = shape / max(np.linalg.norm(shape), TINY)
        for _ in range(2):  # the second time removes rounding
            independent = independent - basis @ (basis.T @ independent)
        if np.linalg.norm(independent) > TRACE:
            basis = np.column_stack([basis, independent / np.linalg.norm(independent)])
    return basis[:, :datum], basis[:, datum:]


def _independent_number(covariance: np.ndarray) -> float:
    """Return the number of independent values of equal variance with the same scatter of |x|^2."""
    square = float((covariance**2).sum())
    return float(variances(covariance).sum()) ** 2 / square if square > 0 else 1.0


def variance_between(squares: np.ndarray, within: np.ndarray) -> float:
    """Return the variance between runs of Mandel and Paule, at least 0.

    Parameters
    ----------
    squares : float array (runs, n)
        n values of each run, independent of each other and with the same variance.
    within : float array (runs,) or (runs, runs)
        Variance of these values within each run; covariance where runs share some of it.
    """
    alone = 1.0 if within.ndim == 1 else np.eye(len(within))

    def excess(variance: float) -> float:
        return _scatter(squares, within + variance * alone) - (len(within) - 1)

    high = float(((squares - squares.mean(axis=0)) ** 2).sum(axis=0).mean())
    if not high > 0 or excess(0.0) <= 0:
        return 0.0
    return float(brentq(excess, 0.0, high, xtol=TINY))


def _scatter(squares: np.ndarray, within: np.ndarray) -> float:
    """Return the scatter of values about their weighted means, over their variances."""
    if within.ndim == 2:
        inverse = np.linalg.inv(within + TINY * np.eye(len(within)))
        weight = inverse.sum(axis=0)
        deviations = squares - weight @ squares / weight.sum()
        return float((deviations * (inverse @ deviations)).sum(axis=0).mean())
    weight = 1 / np.maximum(within, TINY)
    deviations = squares - weight @ squares / weight.sum()
    return float((weight @ deviations**2).mean())


@dataclass(frozen=True, eq=False)
class _Family:
    """Values of every run that have one variance between runs: a shape's amplitude, or the rest.

    Attributes
    ----------
    values : float array (runs, n)
        The amplitude, n = 1; or what the shapes leave, as that of independent values.
    within : float array (runs,) or (runs, runs)
        Their variance within each run; covariance where runs share some of it.
    share : float array (d,)
        Variance of each value of the map for a variance of 1.
    most : int
        Largest number of independent values.
    """

    values: np.ndarray
    within: np.ndarray
    share: np.ndarray
    most: int

    @cached_property
    def between(self) -> float:
        """Variance between runs."""
        return variance_between(self.values, self.within)

    def number(self, covariance: np.ndarray) -> float:
        """Return the number of independent values in a map with a covariance."""
        return min(_independent_number(covariance), self.most)


def _families(
    runs: list[RunValues],
    q: np.ndarray,
    shapes: np.ndarray,
    lengths: Lengths | None = None,
) -> list[_Family]:
    """Return the families of values: one for each shape, and what is left, if anything is."""
    values = np.stack([run.values for run in runs])
    amplitude = values @ shapes
    within = np.stack([variances_of(run.covariance, shapes) for run in runs])
    families = [
        _Family(
            amplitude[:, [m]], _with_lengths(within[:, m], shape, lengths), shape**2, 1
        )
        for m, shape in enumerate(shapes.T)
    ]
    removed = np.concatenate([q, shapes], axis=1)
    n_rest = len(removed) - removed.shape[1]
    if n_rest:
        total = np.array([variances(run.covariance).sum() for run in runs])
        families.append(
            _Family(
                (values - amplitude @ shapes.T) * np.sqrt(len(removed) / n_rest),
                np.maximum(total - within.sum(axis=1), 0.0) / n_rest,
                np.maximum(1 - (removed**2).sum(axis=1), 0.0),
                n_rest,
            )
        )
    return families


def _with_lengths(
    variance: np.ndarray, shape: np.ndarray, lengths: Lengths | None
) -> np.ndarray:
    """Return the variance of the amplitude of a shape within runs, with their lengths."""
    if lengths is None or not (of_scale := float(shape @ lengths.place) ** 2):
        return variance
    return np.diag(variance) + of_scale * lengths.differing


def mean_of(
    runs: list[RunValues],
    removed: np.ndarray,
    shapes: np.ndarray,
    lengths: Lengths | None = None,
) -> Mean:
    """Return the weighted mean of runs.

    Parameters
    ----------
    runs : list of RunValues
        At least two, with the same values.
    removed : float array (d, r)
        Columns that are the datum of each run, which is removed.
    shapes : float array (d, m)
        Shapes whose amplitudes vary between runs each by its own; the rest has one variance.
    lengths : Lengths, optional
        What sets the scale of each run, beside its covariance.
    """
    q, shapes = independent_of(removed, shapes)
    lengths = lengths or Lengths.none(len(runs), len(q))
    place = lengths.place - q @ (q.T @ lengths.place)
    lengths = replace(lengths, place=place)
    runs = [
        replace(
            run,
            values=run.values - q @ (q.T @ run.values),
            covariance=without(run.covariance, q),
            common=without(run.common, q),
        )
        for run in runs
    ]
    families = _families(runs, q, shapes, lengths)
    spread = np.sum([family.between * family.share for family in families], axis=0)
    weights = 1 / np.maximum(
        [variances(run.covariance).sum() + spread.sum() for run in runs]
        + lengths.power,
        TINY,
    )
    weights = weights / weights.sum()
    together = _Runs(runs, weights, q, lengths)
    pooled, shared = weights**2, weights @ together.shares
    within = sum(
        w * variances(run.covariance) for w, run in zip(pooled, runs, strict=True)
    )
    of_certificates, of_all = lengths.within(weights), lengths.common(weights)
    within = within + of_certificates * place**2
    common = shared**2 * variances(together.common) + of_all * place**2
    between = pooled.sum() * spread
    covariance = together.total(pooled, shared, of_certificates + of_all)
    added = spread
    if covariance.ndim == 2:
        of_shapes = np.array([family.between for family in families[: shapes.shape[1]]])
        of_rest = sum(family.between for family in families[shapes.shape[1] :])
        added = (shapes * of_shapes) @ shapes.T + of_rest * (
            np.eye(len(q)) - q @ q.T - shapes @ shapes.T
        )
    of_scale = sum(
        family.between * float(shape @ place) ** 2
        for family, shape in zip(families, shapes.T, strict=False)
    )
    p = together.p_between(families)
    of_one = max(
        families[: shapes.shape[1]], key=lambda family: family.between, default=None
    )
    if p < USUAL_LEVEL and of_one and of_one.between > SINGLE * spread.sum():
        dof = _dof_of_single(of_one, weights, common)
    else:
        dof = together.dof(families, within + common + between)
    return Mean(
        values=weights @ together.values,
        covariance=covariance + pooled.sum() * added,
        within=within,
        common=common,
        between=between,
        u_between=float(np.sqrt(spread.mean())),
        p_between=p,
        weights=weights,
        dof=dof,
        deviations=tuple(together.deviation(i, added) for i in range(len(runs))),
        is_of_scale=bool(of_scale > SINGLE * spread.sum() * (place @ place)),
    )


@dataclass(frozen=True, eq=False)
class _Runs:
    """Runs without their datum, and the weights of their mean.

    Attributes
    ----------
    runs : list of RunValues
        The runs.
    weights : float array (runs,)
        Weights, sum 1.
    q : float array (d, r)
        Orthonormal columns of the datum.
    lengths : Lengths
        Their reference lengths.
    """

    runs: list[RunValues]
    weights: np.ndarray
    q: np.ndarray
    lengths: Lengths

    @cached_property
    def values(self) -> np.ndarray:
        """The values, (runs, d)."""
        return np.stack([run.values for run in self.runs])

    @cached_property
    def shares(self) -> np.ndarray:
        """1 for each run that has a common part, else 0, (runs,)."""
        return np.array([run.shares for run in self.runs], dtype=float)

    @cached_property
    def common(self) -> np.ndarray:
        """Covariance of the common part, the weighted mean of those that have one."""
        weights = self.weights * self.shares
        return _sum(
            [run.common for run in self.runs], weights / max(weights.sum(), TINY)
        )

    def total(
        self, factors: np.ndarray, shared: float = 0.0, scale: float = 0.0
    ) -> np.ndarray:
        """Return the covariance of a combination of runs.

        `factors` are the squares of those of the runs, `shared` is that of the common part,
        `scale` the variance of its scale by the reference lengths, 1 = (m/m)^2.
        """
        place = self.lengths.place
        is_full = any(run.covariance.ndim == 2 for run in self.runs)
        of_scale = np.outer(place, place) if is_full else place**2
        return _sum(
            [*(run.covariance for run in self.runs), self.common, of_scale],
            np.append(factors, [shared**2, scale]),
        )

    def noise_dof(self, factors: np.ndarray) -> float:
        """Return the degrees of freedom of a sum of covariances (Welch-Satterthwaite)."""
        power = [
            float(f * variances(run.covariance).mean())
            for f, run in zip(factors, self.runs, strict=True)
        ]
        dof_of_runs = [run.dof for run in self.runs]
        return min(joint_dof(*zip(power, dof_of_runs, strict=True)), MANY_DOF)

    def p_between(self, families: list[_Family]) -> float:
        """Return the probability of the scatter by chance: the worst family's, Bonferroni."""
        all_alike = np.ones(len(self.runs))
        dof, total = self.noise_dof(all_alike), self.total(all_alike)
        probabilities = []
        for family in families:
            k = len(self.runs) - 1
            scatter = _scatter(family.values, family.within)
            probabilities.append(
                float(fdtrc(k * family.number(total), dof, scatter / k))
            )
        return min(1.0, len(probabilities) * min(probabilities, default=1.0))

    def dof(self, families: list[_Family], power: np.ndarray) -> float:
        """Return the degrees of freedom of the mean's u, the median of all values.

        A variance between runs is a difference: its uncertainty is that of the scatter between
        runs, which contains the part within runs, with one degree of freedom less than there are
        runs. `power` is the variance of the mean, (d,).
        """
        pooled = self.total(self.weights**2)
        terms = np.zeros(len(power))
        for family in families:
            k = (len(self.runs) - 1) * family.number(pooled)
            terms = terms + _scatter_of_mean(family, self.weights) ** 2 / k
        for run, w in zip(self.runs, self.weights, strict=True):
            if 0 < run.dof < MANY_DOF:
                terms = terms + (w**2 * variances(run.covariance)) ** 2 / run.dof
        of_values = (power**2 / np.maximum(terms, TINY))[power > 0]
        return (
            min(float(np.median(of_values)), MANY_DOF) if len(of_values) else MANY_DOF
        )

    def deviation(self, i: int, between: np.ndarray) -> Deviation:
        """Return the deviation of run i from the weighted mean of the others.

        `between` is the covariance of the part between runs.
        """
        this = np.arange(len(self.runs)) == i
        others = np.where(this, 0.0, self.weights)
        others = others / others.sum()
        deviation = self.values[i] - others @ self.values
        factors, signed = others**2 + this, this - others
        of_scale = float(signed @ self.lengths.differing @ signed)
        total = self.total(factors, signed @ self.shares, of_scale)
        dof = self.noise_dof(factors)
        tested, removed = total, self.q
        if not all(run.covariance.ndim == 2 for run in self.runs):
            tested = variances(total)
            if of_scale:  # without correlations it would count at every node
                tested = variances(self.total(factors, signed @ self.shares))
                removed = np.column_stack([self.q, self.lengths.place])
        noise = ReducedNoise(tested, removed, dof)
        test = significance(noise.without(deviation), noise)
        e_n = np.zeros_like(deviation)
        expanded_u = coverage_factor(dof) * np.sqrt(variances(total))
        np.divide(deviation, expanded_u, out=e_n, where=expanded_u > 0)
        return Deviation(e_n, test, self.p_scatter(i, others, between))

    def p_scatter(self, i: int, weights: np.ndarray, between: np.ndarray) -> float:
        """Return the probability that run i is so much farther from the mean than the others are.

        Ratio of its squared distance from the mean of the others, with these `weights`, to the
        scatter of these, each over its expectation, as F with the number of independent values in
        each run (Box).
        """
        runs = len(self.runs)
        if runs < 3:
            return float("nan")
        power = (
            np.array([variances(run.covariance).sum() for run in self.runs])
            + self.lengths.power
            + variances(between).sum()
        )
        squares = ((self.values - weights @ self.values) ** 2).sum(axis=1)
        of_mean = weights**2 @ power
        others = np.arange(runs) != i
        expected = ((1 - 2 * weights[others]) * power[others] + of_mean).sum()
        ratio = (
            squares[i]
            / max(power[i] + of_mean, TINY)
            / max(squares[others].sum() / max(expected, TINY), TINY)
        )
        covariances = [run.covariance for run in self.runs]
        total = _sum([*covariances, between], np.append(np.full(runs, 1 / runs), 1.0))
        number = max(_independent_number(total), 1.0)
        return float(fdtrc(number, number * (runs - 2), ratio))


def _sum(covariances: list[np.ndarray], factors: np.ndarray) -> np.ndarray:
    """Return the weighted sum of covariances: a matrix if one of them is."""
    full = any(c.ndim == 2 for c in covariances)
    return np.sum(
        [
            f * (np.diag(c) if full and c.ndim == 1 else c)
            for f, c in zip(factors, covariances, strict=True)
        ],
        axis=0,
    )


def _scatter_of_mean(family: _Family, weights: np.ndarray) -> np.ndarray:
    """Return the variances (d,) that the scatter of a family between runs gives the mean."""
    within = variances(family.within)
    return ((weights**2).sum() * family.between + weights**2 @ within) * family.share


def _dof_of_single(family: _Family, weights: np.ndarray, shared: np.ndarray) -> float:
    """Return the degrees of freedom where runs differ by the amplitude of a single shape.

    The value with the fewest: the scatter of the amplitude has as many as there are runs but one,
    and what is shared is known. The noise within runs is not counted as known: the scatter
    contains that of the amplitude, and the rest of it is small there.
    """
    scatter = _scatter_of_mean(family, weights)
    ratio = float(np.min(shared[scatter > 0] / scatter[scatter > 0]))
    return min((len(weights) - 1) * (1 + ratio) ** 2, MANY_DOF)


BETWEEN = "between_runs"
"""Name of the part between runs among the causes of an enlarged U."""
SUFFIX = {"xy": "", "theta": "_theta"}
"""Ends of the names of what is stated of each map."""
DEGREE = 3
"""Degree up to which each polynomial of a map may vary between runs by its own; waves per turn of
the angular map."""


@dataclass(frozen=True, eq=False)
class Combination:
    """The mean map as a result, with the intermediate findings.

    `xy` and `theta` have the mean and the deviations of the coordinates of the sites `known`
    (Gx, then Gy) and of the angular lines; `theta` is None without angular maps in all runs.
    """

    result: CalibrationResult
    known: np.ndarray
    xy: Mean
    theta: Mean | None


@one_thread()
def combine(members: Sequence[Member], *, keep_scale: bool = False) -> Combination:
    """Return the weighted mean of several maps of one stage.

    Differences of datum are removed first. The weight of a run is the inverse of its mean variance
    plus that between runs. What all runs of a machine share does not average out: the microscope,
    the scale of the lines and the approach as they are declared or assumed, and with `keep_scale`
    a certificate of all runs, and what temperatures add to their lengths.

    Parameters
    ----------
    members : sequence of Member
        Two or more; at least one is a calibration, which gives the lattice.
    keep_scale : bool
        Keep the magnification: every calibration has a reference length.

    Raises
    ------
    InputError
        If the maps cannot be combined.
    """
    first = _checked(members, keep_scale=keep_scale)
    common = {
        kind: np.logical_and.reduce(
            [
                np.isfinite(member.error_map.of(kind)).all(axis=(0, 1))
                for member in members
            ]
        )
        for kind in KINDS
    }
    known_sites, lines = common["xy"], common["theta"]
    if known_sites.sum() < 3:
        raise InputError(
            members[-1].name,
            "fewer than three sites are known with their uncertainty in all maps",
            "combine maps that overlap",
        )
    require_own_readings(members, common, scale=not keep_scale)
    lengths = _lengths(members, first, known_sites) if keep_scale else None
    shapes = {"xy": _polynomials(first.artifact.x_m, first.artifact.y_m, known_sites)}
    if lines.sum() > 1:
        angle_rad = 2 * np.pi * np.flatnonzero(lines) / len(lines)
        shapes["theta"] = fourier_basis(angle_rad, DEGREE)[:, 1:]
    means = {
        kind: mean_of(
            [
                _run(member, kind, common[kind], without_length=keep_scale)
                for member in members
            ],
            datum_columns(first.artifact, kind, common[kind], scale=not keep_scale),
            of_kind,
            lengths if kind == "xy" else None,
        )
        for kind, of_kind in shapes.items()
    }
    result = _result(members, first, means, common)
    if not keep_scale:
        result = replace(result, reference=None)
    return Combination(result, known_sites, means["xy"], means.get("theta"))


def _lengths(
    members: Sequence[Member], first: CalibrationResult, known_sites: np.ndarray
) -> Lengths:
    """Return the reference lengths of the runs, that of rechecks within their u."""
    references = [
        member.result.reference if member.result else None for member in members
    ]
    require_one_text([member.name for member in members], references)
    lattice = first.artifact
    return lengths_of(
        [
            None if member.result and member.result.recheck else reference
            for member, reference in zip(members, references, strict=True)
        ],
        np.concatenate([lattice.x_m[known_sites], lattice.y_m[known_sites]]),
    )


def _checked(members: Sequence[Member], *, keep_scale: bool) -> CalibrationResult:
    """Return the first calibration; InputError if the maps cannot be combined."""
    calibrations = [member for member in members if member.result is not None]
    if len(members) < 2 or not calibrations:
        raise InputError(
            members[0].name if members else "RESULT.json",
            "a single map, or no RESULT.json among them",
            "give two or more, one of them a RESULT.json",
        )
    for member in calibrations:
        require_same_lattice(
            calibrations[0].error_map.artifact,
            member.error_map.artifact,
            (calibrations[0].name, member.name),
        )
        result = member.result
        if result is None or not result.verdict.qualified:
            raise InputError(
                member.name, "its calibration is not qualified", "leave it out"
            )
        if keep_scale and result.reference is None:
            raise InputError(
                "--keep-scale",
                f"{member.name} has no reference length, so its magnification is unknown",
                "omit it, or solve with --reference",
            )
    for index, member in enumerate(members):
        _require_single_run(member, members[:index])
    first = calibrations[0].result
    assert first is not None
    return first


def _require_single_run(member: Member, earlier_members: Sequence[Member]) -> None:
    """Refuse a map that is not of one recording alone, or of that of another map."""
    result = member.result
    if result is None:
        return
    if result.method == COMBINED:
        raise InputError(
            member.name, "a mean of several runs", "name these runs themselves"
        )
    for earlier in earlier_members:
        if earlier.result is None:
            continue
        if _same_recording(result, earlier.result):
            raise InputError(
                member.name,
                f"of the same recording as {earlier.name}",
                "leave one of them out",
            )
        plate = _readings_of_plate(result)
        if plate and plate == _readings_of_plate(earlier.result):
            raise InputError(
                member.name,
                f"of the same plate errors as {earlier.name}: both rest on one calibration",
                "leave one of them out",
            )


def _readings_of_plate(result: CalibrationResult) -> str:
    """Return the SHA-256 of the readings that made the plate of a map known; empty if unknown."""
    recheck = result.recheck
    readings = result.input if recheck is None else recheck.calibration.readings
    return readings.get("sha256", "")


def _same_recording(first: CalibrationResult, second: CalibrationResult) -> bool:
    """Whether two results are of one bag, or of one run at the same time with the same noise."""
    digest = first.input.get("sha256")
    if digest and digest == second.input.get("sha256"):
        return True
    first_run, second_run = (
        (
            result.run_id,
            result.provenance.first_exposure,
            result.provenance.last_exposure,
        )
        for result in (first, second)
    )
    return (
        all(first_run)
        and first_run == second_run
        and bool(
            np.isclose(
                first.noise.sigma_xy_repeats,
                second.noise.sigma_xy_repeats,
                rtol=NEGLIGIBLE,
                atol=0.0,
                equal_nan=True,
            )
        )
    )


def _run(
    member: Member, kind: str, known_places: np.ndarray, *, without_length: bool
) -> RunValues:
    values, u = (of[:, known_places].ravel() for of in member.error_map.of(kind))
    result = member.result
    if result is None:
        return RunValues(values, u**2, np.zeros(len(u)), False, np.inf)
    covariance = covariance_of(result, kind, known_places)
    if result.recheck is not None:
        # it may share any of this with the other runs, or none: nothing is taken off
        common = covariance * _part_beside_noise(result, kind)
        return RunValues(values, covariance, common, True, result.noise.dof_of(kind))
    is_full = covariance.ndim == 2
    common = np.zeros_like(covariance)
    if kind == "xy":
        factors = _common(result, known_places)
        common = factors.T @ factors if is_full else (factors**2).sum(axis=0)
    elif (kept := behind(result)) is not None:
        of_lines = kept.terms_on_lines(known_places, _shared_terms(result))
        common = of_lines if is_full else np.diag(of_lines)
    covariance = covariance - common
    if kind == "xy" and without_length and result.reference is not None:
        at = result.artifact
        length = np.concatenate([at.x_m[known_places], at.y_m[known_places]])
        length *= result.reference.u_relative
        covariance -= np.outer(length, length) if is_full else length**2
    return RunValues(values, covariance, common, True, result.noise.dof_of(kind))


def _part_beside_noise(result: CalibrationResult, kind: str) -> float:
    """Return the part of the variance of a recheck's map that is not noise of its own readings.

    It is of the plate and of terms. What runs share is in both, and not kept apart.
    """
    total = of_others = 0.0
    for line in result.budget:
        if line.quantity == kind and line.component != INTERPOLATION:
            total += line.effect_rms**2
            of_others += line.effect_rms**2 * (line.component != READING_NOISE)
    return of_others / total if total > 0 else 1.0


def _shared_terms(result: CalibrationResult) -> list[str]:
    """Return the names of the effects of a machine that the readings of a run do not determine.

    Those of terms of its model, a coefficient of which they leave, as two scales of which they show
    the difference alone; and of effects that are assumed beside the model.
    """
    determined = {
        term.name
        for term in result.model.terms
        if max((estimate.u for estimate in term.estimates), default=0.0)
        < DETERMINED_BELOW * term.solved_with
    }
    return [
        name
        for name, block in blocks().items()
        if block.shared and name not in determined
    ]


def _common(result: CalibrationResult, known_sites: np.ndarray) -> np.ndarray:
    """Return factors L (r, 2n) of the covariance L' L of what the runs of a machine share, m.

    Terms of the machine that are known from elsewhere.
    """
    saved = factors_of(result)
    factors = saved.of_map[np.isin(saved.terms, _shared_terms(result))]
    factors = factors[:, :, known_sites]
    factors = factors.reshape(len(factors), 2 * int(known_sites.sum()))
    return factors * np.nan_to_num(result.noise.sigma_xy)


def _polynomials(x: np.ndarray, y: np.ndarray, known_sites: np.ndarray) -> np.ndarray:
    """Return polynomials of position up to `DEGREE` as columns over Gx, then Gy.

    The first three are magnification, non-orthogonality O and scale difference R (Hu eq. 6).
    """
    size = max(np.abs(x).max(), np.abs(y).max())
    x, y = x[known_sites] / size, y[known_sites] / size
    zero = np.zeros(len(x))
    columns = [(x, y), (y, x), (x, -y)]
    for degree in range(2, DEGREE + 1):
        for power in range(degree + 1):
            values = x ** (degree - power) * y**power
            columns += [(values, zero), (zero, values)]
    return np.array([np.concatenate(column) for column in columns]).T


def _result(
    members: Sequence[Member],
    first: CalibrationResult,
    means: Mapping[str, Mean],
    common: Mapping[str, np.ndarray],
) -> CalibrationResult:
    """Return the means as a result: of ``xy``, and ``theta`` if it is known, by their places."""
    plate = first.plate
    known_sites = common["xy"]
    shapes = {"xy": (2, *known_sites.shape), "theta": (1, len(common["theta"]))}
    maps, u = (
        {kind: np.full(shape, np.nan) for kind, shape in shapes.items()}
        for _ in range(2)
    )
    dof = dict.fromkeys(KINDS, np.nan)
    k = dict.fromkeys(KINDS, 2.0)
    for kind, mean in means.items():
        for out, values in ((maps[kind], mean.values), (u[kind], mean.u)):
            out[:, common[kind]] = values.reshape(len(out), -1)
        dof[kind], k[kind] = mean.dof, coverage_factor(mean.dof)

    emap = ErrorMap.of_maps(
        first.artifact,
        (maps["xy"], u["xy"]),
        (maps["theta"][0], u["theta"][0]),
    )
    unknown = np.full(plate.shape, np.nan)
    unknowns = 2 * int(known_sites.sum())
    runs = [member.result for member in members]
    result = CalibrationResult(
        plan_id="+".join(dict.fromkeys(run.plan_id for run in runs if run)),
        error_map=emap,
        artifact_map=ArtifactMap(
            unknown, unknown, np.full(plate.angular_count, np.nan)
        ),
        views=(),
        observability=Observability(unknowns, unknowns, 0, True),
        noise=Noise(
            np.nan,
            np.nan,
            dof_xy=dof["xy"],
            dof_theta=dof["theta"],
            k_xy=k["xy"],
            k_theta=k["theta"],
            dof_map_xy=dof["xy"],
            dof_map_theta=dof["theta"],
        ),
        input={"file": ", ".join(member.name for member in members)},
        method=COMBINED,
        sense=first.sense,
        parts=Parts(combined=_runs(members, means)),
        kept=kept_covariances(_covariances(members, means)),
        verdict=_verdict(members, means),
        model=ModelResult(first.model.misalignment),
        reference=shared_reference(runs, means["xy"].weights),
        provenance=of_all_runs(runs),
        findings=(*_not_in_all(known_sites), *_warnings(members)),
        placed_plate=first.placed_plate,
    )
    return replace(result, budget=_budget(result, means))


def _not_in_all(known_sites: np.ndarray) -> Iterator[NotInAll]:
    """Yield how many sites of the mean are unknown, if some are."""
    if not known_sites.all():
        yield NotInAll(sites=int((~known_sites).sum()))


def _warnings(members: Sequence[Member]) -> Iterator[WarningOfRuns]:
    """Yield each warning of the runs once, with the files that have it."""
    runs_of: dict[str, list[str]] = defaultdict(list)
    for member in members:
        for warning in member.result.warnings if member.result else ():
            runs_of[warning].append(member.name)
    for warning, runs in runs_of.items():
        yield WarningOfRuns(runs=tuple(runs), warning=warning)


def _runs(members: Sequence[Member], means: Mapping[str, Mean]) -> Combined:
    """Return the runs with their deviations."""
    between: dict[str, float] = {}
    for kind, mean in means.items():
        between |= {
            f"u_between_{KINDS[kind]}": mean.u_between,
            f"p_between{SUFFIX[kind]}": mean.p_between,
        }
    runs = []
    for index, member in enumerate(members):
        deviations: dict[str, Any] = {}
        for kind, mean in means.items():
            deviations |= _of_run(
                mean.deviations[index], SUFFIX[kind], USUAL_LEVEL / len(members)
            )
        result = member.result
        recheck = None if result is None else result.recheck
        runs.append(
            CombinedRun(
                file=member.name,
                run_id=result.run_id if result else "",
                sha256=result.input.get("sha256", "") if result else "",
                weight=float(means["xy"].weights[index]),
                calibration=None if recheck is None else recheck.calibration,
                **deviations,
            )
        )
    return Combined(**between, runs=tuple(runs))


def _covariances(
    members: Sequence[Member], means: Mapping[str, Mean]
) -> dict[str, np.ndarray]:
    """Return the covariances of the means whose runs all have theirs."""
    all_calibrations = all(member.result is not None for member in members)
    return {
        kind: mean.covariance
        for kind, mean in means.items()
        if (all_calibrations or kind == "theta")
        and mean.covariance.ndim == 2
        and all(
            deviation.test is None or deviation.test.correlated
            for deviation in mean.deviations
        )
    }


def _of_run(deviation: Deviation, kind: str, limit: float) -> dict[str, Any]:
    test = deviation.test
    return {
        f"e_n_rms{kind}": rms(deviation.e_n),
        f"e_n_largest{kind}": float(abs(deviation.e_n).max()),
        f"beyond{kind}": float((abs(deviation.e_n) > 1).mean()),
        f"p{kind}": np.nan if test is None else min(1.0, 2 * min(test.p, test.p_z)),
        f"agrees{kind}": None if test is None else not test.significant,
        f"stands_out{kind}": bool(deviation.p_scatter < limit),
    }


def _verdict(members: Sequence[Member], means: Mapping[str, Mean]) -> Verdict:
    """Return the verdict: enlarged if a run's U was, or if the runs differ by more than their U."""
    enlarged: list[Enlargement] = []
    failed: list[Finding] = []
    for kind, mean in means.items():
        if mean.p_between < USUAL_LEVEL:
            u = np.sqrt(mean.between)
            name = BETWEEN + SUFFIX[kind]
            unit = KINDS[kind]
            enlarged.append(Enlargement(name, rms(u), float(u.max()), unit))
            failed.append(
                BetweenRuns(
                    size=mean.u_between,
                    unit=unit,
                    p=mean.p_between,
                    runs=len(members),
                    quantity=kind,
                    of_scale=mean.is_of_scale,
                )
            )
        enlarged += _of_runs(members, kind, mean)
    of_runs = [
        member.name
        for member in members
        if member.result and member.result.verdict.grade is Grade.ENLARGED
    ]
    if of_runs:
        failed.append(EnlargedRuns(runs=tuple(of_runs)))
    return Verdict(
        Grade.ENLARGED if failed else Grade.GOOD,
        tuple(failed),
        enlarged_by=tuple(enlarged),
    )


def _of_runs(members: Sequence[Member], kind: str, mean: Mean) -> list[Enlargement]:
    """Return what enlarged U of runs, by its contribution to u of their mean.

    What all runs share, and all of rechecks but their noise, adds up by their weights; the rest,
    which differs between runs, by squares.
    """
    # of each cause what is shared, and the squares of the rest; rms and largest
    sums: dict[str, np.ndarray] = defaultdict(lambda: np.zeros((2, 2)))
    for member, weight in zip(members, mean.weights, strict=True):
        if member.result is None:
            continue
        for item in member.result.verdict.enlarged_by:
            if item.unit != KINDS[kind]:
                continue
            part = weight * np.array([item.u_rms, item.u_max])
            if member.result.recheck is not None or _is_shared(item.name):
                sums[item.name][0] += part
            else:
                sums[item.name][1] += part**2
    enlarged = []
    for name, (shared, squares) in sums.items():
        u_rms, u_max = np.sqrt(shared**2 + squares)
        enlarged.append(Enlargement(name, float(u_rms), float(u_max), KINDS[kind]))
    return enlarged


def _is_shared(name: str) -> bool:
    """Return whether all runs of a machine have a cause of this name in common."""
    block = blocks().get(name)
    return block is not None and block.shared


def _budget(
    result: CalibrationResult, means: Mapping[str, Mean]
) -> tuple[BudgetLine, ...]:
    lines: list[BudgetLine] = []
    between = [line for line in budget_lines(result) if line.component == INTERPOLATION]
    for kind, mean in means.items():
        for component, variance, size, is_scatter in (
            ("uncertainty of the runs", mean.within, None, True),
            ("shared by all runs", mean.common, None, False),
            ("between runs", mean.between, mean.u_between, True),
        ):
            u = np.sqrt(variance)
            lines.append(
                BudgetLine(
                    quantity=kind,
                    component=component,
                    kind="A" if is_scatter else "B",
                    u=rms(u) if size is None else size,
                    unit=KINDS[kind],
                    effect_rms=rms(u),
                    effect_max=float(u.max()),
                    dof=mean.dof if is_scatter else np.inf,
                    source="readings" if is_scatter else "declared",
                    details=OfRuns(len(mean.weights)),
                )
            )
        lines += [line for line in between if line.quantity == kind]
    return tuple(lines)
