# SPDX-License-Identifier: Apache-2.0
"""Several calibrations of one stage combined to one map, with the part between runs in its U.

Run i gives x_i = G + e_i + s_i c + b_i: e_i its own error with the covariance C_i, c an error
common to all runs of one machine (covariance K; s_i = 1, or 0 for a run of other origin), and b_i
the part between runs. Its covariance T has one variance for each given shape, and one for the rest.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import fdtrc

from selfcal_ros import __version__
from selfcal_ros.blocks import blocks
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import BEYOND, SHOWN
from selfcal_ros.estimation.comparison.covariance import covariance_of, kept_covariances
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
    INTERPOLATION,
    TOLD,
    budget_lines,
    remaining_part,
)
from selfcal_ros.model.error_map import (
    MANY_DOF,
    ErrorMap,
    ThetaDatum,
    datum_columns,
    first_order,
    rms,
)
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
    BudgetLine,
    Enlargement,
    Finding,
    Grade,
    ModelResult,
    Provenance,
    Verdict,
)

OTHER_UNIT = 300.0
"""How many times larger the errors in a table are that is not in m or rad."""


@dataclass(frozen=True, eq=False)
class Part:
    """A map to be combined: its file, and its calibration; None for a map of other origin."""

    name: str
    error_map: ErrorMap
    result: CalibrationResult | None = None


def require_own_readings(
    parts: Sequence[Part], common: Mapping[str, np.ndarray], *, scale: bool
) -> None:
    """Refuse a map that equals another but for its datum, or has another unit or sign.

    Parameters
    ----------
    parts : sequence of Part
        The maps.
    common : mapping
        ``xy``, ``theta`` -> places known in all maps.
    scale : bool
        Whether magnification belongs to the datum.
    """
    first = next(index for index, part in enumerate(parts) if part.result is not None)
    for kind, known in common.items():
        q = np.linalg.qr(datum_columns(parts[first].error_map.artifact, kind, known, scale=scale))[
            0
        ]
        maps, u = (
            np.array([part.error_map.of(kind)[of][:, known].ravel() for part in parts])
            for of in (0, 1)
        )
        maps -= maps @ q @ q.T
        for index, part in enumerate(parts):
            if part.result is None:
                ratio = rms(maps[index]) / max(rms(maps[first]), rms(u[first]))
                if ratio > OTHER_UNIT:
                    raise InputError(
                        part.name,
                        f"its errors are {ratio:.2g} times those of "
                        f"{parts[first].name}: is it in µ{KINDS[kind]}?",
                        "give m and rad",
                    )
                if _is_opposite(*(maps[n] / np.maximum(u[n], NO_NOISE) for n in (index, first))):
                    raise InputError(
                        part.name,
                        f"of the opposite sign to {parts[first].name}: its "
                        "negative agrees, and it does not",
                        "give G = indicated - true",
                    )
            for other in range(index if kind == "xy" else 0):
                if rms((maps[index] - maps[other]) / np.minimum(u[index], u[other])) < NEGLIGIBLE:
                    raise InputError(
                        part.name,
                        f"of the same readings as {parts[other].name}: their maps are equal",
                        "leave one of them out",
                    )


def _is_opposite(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two maps, over their u, are each other's negative beyond doubt.

    Both are beyond noise, of more values than agree in sign by chance, and their sum is as much
    less than their difference.
    """
    sizes = rms(one), rms(other)
    if min(sizes) < BEYOND or 0.5 ** len(one) > SHOWN:
        return False
    one, other = one / sizes[0], other / sizes[1]
    return BEYOND * rms(one + other) < rms(one - other)


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
    own = [result for result in results if result is not None]
    found = [result.reference for result in own if result.reference]
    if len(found) < len(own):
        return None
    if len(own) < len(results):
        found = [replace(each, certified=None) for each in found]
    if all(each == found[0] for each in found):
        return found[0]
    share = np.array([weight for result, weight in zip(results, weights, strict=True) if result])
    errors = np.array([each.relative_error for each in found])
    names = dict.fromkeys(each.certificate or "none" for each in found)
    return replace(
        found[0],
        certified=None,
        relative_error=float(share @ errors / share.sum()),
        u_relative=max(each.u_relative for each in found),
        certificate="; ".join(names),
        runs=tuple(found),
    )


def exposures(results: Sequence[CalibrationResult | None]) -> dict[str, str]:
    """Return the first and the last exposure of all runs, where they are known."""
    times = [
        [str(result.provenance.extra.get(f"{end}_exposure", "")) for result in results if result]
        for end in ("first", "last")
    ]
    if not all(map(all, times)):
        return {}
    return {"first_exposure": min(times[0]), "last_exposure": max(times[1])}


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
    known = np.linalg.qr(removed)[0] if removed.size else removed
    datum = known.shape[1]
    for shape in shapes.T:
        rest = shape / max(np.linalg.norm(shape), TINY)
        for _ in range(2):  # the second time removes rounding
            rest = rest - known @ (known.T @ rest)
        if np.linalg.norm(rest) > TRACE:
            known = np.column_stack([known, rest / np.linalg.norm(rest)])
    return known[:, :datum], known[:, datum:]


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
    within : float array (runs,)
        Variance of these values within each run.
    """

    def excess(variance: float) -> float:
        return _scatter(squares, within + variance) - (len(within) - 1)

    high = float(((squares - squares.mean(axis=0)) ** 2).sum(axis=0).mean())
    if not high > 0 or excess(0.0) <= 0:
        return 0.0
    return float(brentq(excess, 0.0, high, xtol=TINY))


def _scatter(squares: np.ndarray, within: np.ndarray) -> float:
    """Return the scatter of values about their weighted means, over their variances."""
    weight = 1 / np.maximum(within, TINY)
    rest = squares - weight @ squares / weight.sum()
    return float((weight @ rest**2).mean())


@dataclass(frozen=True, eq=False)
class _Family:
    """Values of every run that have one variance between runs: a shape's amplitude, or the rest.

    Attributes
    ----------
    values : float array (runs, n)
        The amplitude, n = 1; or what the shapes leave, as that of independent values.
    within : float array (runs,)
        Their variance within each run.
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
    values: np.ndarray, covariances: list[np.ndarray], q: np.ndarray, shapes: np.ndarray
) -> list[_Family]:
    """Return the families of values: one for each shape, and what is left, if anything is."""
    amplitude = values @ shapes
    within = np.stack([variances_of(c, shapes) for c in covariances])
    found = [
        _Family(amplitude[:, [m]], within[:, m], shape**2, 1) for m, shape in enumerate(shapes.T)
    ]
    known = np.concatenate([q, shapes], axis=1)
    n_rest = len(known) - known.shape[1]
    if n_rest:
        total = np.array([variances(c).sum() for c in covariances])
        found.append(
            _Family(
                (values - amplitude @ shapes.T) * np.sqrt(len(known) / n_rest),
                np.maximum(total - within.sum(axis=1), 0.0) / n_rest,
                np.maximum(1 - (known**2).sum(axis=1), 0.0),
                n_rest,
            )
        )
    return found


def mean_of(runs: list[RunValues], removed: np.ndarray, shapes: np.ndarray) -> Mean:
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
    families = _families(values, own, q, shapes)
    spread = np.sum([family.between * family.share for family in families], axis=0)
    weights = 1 / np.maximum([variances(c).sum() + spread.sum() for c in own], TINY)
    weights = weights / weights.sum()
    shared = [without(run.common, q) for run in runs if run.shares]
    common = _sum(
        [np.zeros(len(q)), *shared],
        np.append(0.0, weights[shares > 0] / max(weights @ shares, TINY)),
    )
    pooled = weights**2
    within = sum(w * variances(c) for w, c in zip(pooled, own, strict=True))
    between = pooled.sum() * spread
    covariance = _sum([*own, common], np.append(pooled, (weights @ shares) ** 2))
    added = spread
    if covariance.ndim == 2:
        of_shapes = np.array([family.between for family in families[: shapes.shape[1]]])
        of_rest = sum(family.between for family in families[shapes.shape[1] :])
        added = (shapes * of_shapes) @ shapes.T + of_rest * (
            np.eye(len(q)) - q @ q.T - shapes @ shapes.T
        )
    covariance = covariance + pooled.sum() * added
    shared_part = (weights @ shares) ** 2 * variances(common)
    p = _p_between(families, runs, own)
    of_one = max(families[: shapes.shape[1]], key=lambda family: family.between, default=None)
    if p < USUAL_LEVEL and of_one and of_one.between > SINGLE * spread.sum():
        dof = _dof_of_single(of_one, weights, shared_part)
    else:
        dof = _dof(runs, own, families, weights, whole=within + shared_part + between)
    return Mean(
        weights @ values,
        covariance,
        within,
        shared_part,
        between,
        float(np.sqrt(spread.mean())),
        p,
        weights,
        dof,
        tuple(
            _deviation(i, runs, values, own, common, weights, q, added) for i in range(len(runs))
        ),
    )


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


def _p_between(families: list[_Family], runs: list[RunValues], own: list[np.ndarray]) -> float:
    """Return the probability of the scatter between runs by chance: the worst, Bonferroni."""
    dof, together = _noise_dof(runs, own, np.ones(len(runs))), _sum(own, np.ones(len(own)))
    found = []
    for family in families:
        k = len(runs) - 1
        scatter = _scatter(family.values, family.within)
        found.append(float(fdtrc(k * family.number(together), dof, scatter / k)))
    return min(1.0, len(found) * min(found, default=1.0))


def _noise_dof(runs: list[RunValues], own: list[np.ndarray], factors: np.ndarray) -> float:
    """Return the degrees of freedom of a sum of the runs' covariances (Welch-Satterthwaite)."""
    power = [float(f * variances(c).mean()) for f, c in zip(factors, own, strict=True)]
    return min(joint_dof(*zip(power, [run.dof for run in runs], strict=True)), MANY_DOF)


def _dof(
    runs: list[RunValues],
    own: list[np.ndarray],
    families: list[_Family],
    weights: np.ndarray,
    *,
    whole: np.ndarray,
) -> float:
    """Return the degrees of freedom of the mean's u, the median of all values.

    A variance between runs is a difference: its uncertainty is that of the scatter between runs,
    which contains the part within runs, with one degree of freedom less than there are runs.
    """
    pooled = _sum(own, weights**2)
    terms = np.zeros(len(whole))
    for family in families:
        k = (len(runs) - 1) * family.number(pooled)
        terms = terms + _scatter_of_mean(family, weights) ** 2 / k
    for run, c, w in zip(runs, own, weights, strict=True):
        if 0 < run.dof < MANY_DOF:
            terms = terms + (w**2 * variances(c)) ** 2 / run.dof
    found = (whole**2 / np.maximum(terms, TINY))[whole > 0]
    return min(float(np.median(found)), MANY_DOF) if len(found) else MANY_DOF


def _scatter_of_mean(family: _Family, weights: np.ndarray) -> np.ndarray:
    """Return the variances (d,) that the scatter of a family between runs gives the mean."""
    return ((weights**2).sum() * family.between + weights**2 @ family.within) * family.share


def _dof_of_single(family: _Family, weights: np.ndarray, shared: np.ndarray) -> float:
    """Return the degrees of freedom where runs differ by the amplitude of a single shape.

    The value with the fewest: the scatter of the amplitude has as many as there are runs but one,
    and what is shared is known. The noise within runs is not counted as known: the scatter
    contains that of the amplitude, and the rest of it is small there.
    """
    scatter = _scatter_of_mean(family, weights)
    ratio = float(np.min(shared[scatter > 0] / scatter[scatter > 0]))
    return min((len(weights) - 1) * (1 + ratio) ** 2, MANY_DOF)


def _deviation(
    i: int,
    runs: list[RunValues],
    values: np.ndarray,
    own: list[np.ndarray],
    common: np.ndarray,
    weights: np.ndarray,
    q: np.ndarray,
    between: np.ndarray,
) -> Deviation:
    """Return the deviation of run i from the weighted mean of the others."""
    others = np.where(np.arange(len(runs)) == i, 0.0, weights)
    others = others / others.sum()
    rest = values[i] - others @ values
    factors = others**2 + (np.arange(len(runs)) == i)
    shares = np.array([run.shares for run in runs], dtype=float)
    total = _sum([*own, common], np.append(factors, (shares[i] - others @ shares) ** 2))
    dof = _noise_dof(runs, own, factors)
    full = all(run.covariance.ndim == 2 for run in runs)
    test = significance(rest, ReducedNoise(total if full else variances(total), q, dof))
    u = np.sqrt(variances(total))
    e_n = np.divide(rest, coverage_factor(dof) * u, out=np.zeros_like(rest), where=u > 0)
    return Deviation(e_n, test, _p_scatter(i, values, own, others, between))


def _p_scatter(
    i: int, values: np.ndarray, own: list[np.ndarray], others: np.ndarray, between: np.ndarray
) -> float:
    """Return the probability that run i is so much farther from the mean than the others are.

    Ratio of its squared distance from the mean of the others to the scatter of these, each over
    its expectation, as F with the number of independent values in each run (Box).
    """
    runs = len(values)
    if runs < 3:
        return float("nan")
    power = np.array([variances(c).sum() + variances(between).sum() for c in own])
    mean = others @ values
    of_mean = others**2 @ power
    left = np.flatnonzero(np.arange(runs) != i)
    scatter = ((values[left] - mean) ** 2).sum()
    expected = ((1 - 2 * others[left]) * power[left] + of_mean).sum()
    ratio = (
        ((values[i] - mean) ** 2).sum()
        / max(power[i] + of_mean, TINY)
        / max(scatter / max(expected, TINY), TINY)
    )
    total = _sum([*own, between], np.append(np.full(runs, 1 / runs), 1.0))
    number = max(_independent_number(total), 1.0)
    return float(fdtrc(number, number * (runs - 2), ratio))


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
def combine(parts: Sequence[Part], *, keep_scale: bool = False) -> Combination:
    """Return the weighted mean of several maps of one stage.

    Differences of datum are removed first. The weight of a run is the inverse of its mean variance
    plus that between runs. What all runs of a machine share (the microscope as declared, and with
    `keep_scale` the reference length) does not average out.

    Parameters
    ----------
    parts : sequence of Part
        Two or more; at least one is a calibration, which gives the lattice.
    keep_scale : bool
        Keep the magnification: every calibration has a reference length.

    Raises
    ------
    InputError
        If the maps cannot be combined.
    """
    first = _checked(parts, keep_scale=keep_scale)
    common = {
        kind: np.logical_and.reduce(
            [np.isfinite(part.error_map.of(kind)).all(axis=(0, 1)) for part in parts]
        )
        for kind in KINDS
    }
    known, lines = common["xy"], common["theta"]
    if known.sum() < 3:
        raise InputError(
            parts[-1].name,
            f"{int(known.sum())} sites are known with their uncertainty in all maps",
            "combine maps that overlap",
        )
    require_own_readings(parts, common, scale=not keep_scale)
    shapes = {"xy": _polynomials(first.artifact.x_m, first.artifact.y_m, known)}
    if lines.sum() > 1:
        shapes["theta"] = _waves(lines)
    means = {
        kind: mean_of(
            [_run(part, kind, common[kind], keep_scale=keep_scale) for part in parts],
            datum_columns(first.artifact, kind, common[kind], scale=not keep_scale),
            of_kind,
        )
        for kind, of_kind in shapes.items()
    }
    result = _result(parts, first, means, common)
    if not keep_scale:
        result = replace(result, reference=None)
    return Combination(result, known, means["xy"], means.get("theta"))


def _checked(parts: Sequence[Part], *, keep_scale: bool) -> CalibrationResult:
    """Return the first calibration; InputError if the maps cannot be combined."""
    own = [part for part in parts if part.result is not None]
    if len(parts) < 2 or not own:
        raise InputError(
            parts[0].name if parts else "RESULT.json",
            "a single map, or no RESULT.json among them",
            "give two or more, one of them a RESULT.json",
        )
    for part in own:
        require_same_lattice(
            own[0].error_map.artifact, part.error_map.artifact, (own[0].name, part.name)
        )
        result = part.result
        if result is None or not result.verdict.qualified:
            raise InputError(part.name, "its calibration is not qualified", "leave it out")
        if keep_scale and result.reference is None:
            raise InputError(
                "--keep-scale",
                f"{part.name} has no reference length, so its magnification is unknown",
                "omit it, or solve with --reference",
            )
    for index, part in enumerate(parts):
        _require_single_run(part, parts[:index])
    found = own[0].result
    assert found is not None
    return found


def _require_single_run(part: Part, others: Sequence[Part]) -> None:
    """Refuse a map that is not of one recording alone, or of that of another map."""
    result = part.result
    if result is None:
        return
    if result.method == COMBINED:
        raise InputError(part.name, "a mean of several runs", "name these runs themselves")
    for other in others:
        if other.result is None:
            continue
        if _same_recording(result, other.result):
            raise InputError(
                part.name, f"of the same recording as {other.name}", "leave one of them out"
            )
        plate = _readings_of_plate(result)
        if plate and plate == _readings_of_plate(other.result):
            raise InputError(
                part.name,
                f"of the same plate errors as {other.name}: both rest on one calibration",
                "leave one of them out",
            )


def _readings_of_plate(result: CalibrationResult) -> str:
    """Return the SHA-256 of the readings that made the plate of a map known; empty if unknown."""
    recheck = result.recheck
    readings = result.input if recheck is None else recheck.calibration.readings
    return readings.get("sha256", "")


def _same_recording(one: CalibrationResult, other: CalibrationResult) -> bool:
    """Whether two results are of one bag, or of one run at the same time with the same noise."""
    digest = one.input.get("sha256")
    if digest and digest == other.input.get("sha256"):
        return True
    run, also = (
        (
            result.run_id,
            result.provenance.extra.get("first_exposure"),
            result.provenance.extra.get("last_exposure"),
        )
        for result in (one, other)
    )
    return (
        all(run)
        and run == also
        and bool(
            np.isclose(
                one.noise.sigma_xy_repeats,
                other.noise.sigma_xy_repeats,
                rtol=NEGLIGIBLE,
                atol=0.0,
                equal_nan=True,
            )
        )
    )


def _run(part: Part, kind: str, known: np.ndarray, *, keep_scale: bool) -> RunValues:
    values, u = (of[:, known].ravel() for of in part.error_map.of(kind))
    result, factors = part.result, np.zeros((0, len(values)))
    if result is None:
        return RunValues(values, u**2, np.zeros(len(u)), False, np.inf)
    covariance = covariance_of(result, kind, known)
    if kind == "xy":
        factors = _common(result, known, keep_scale=keep_scale)
    common = factors.T @ factors if covariance.ndim == 2 else (factors**2).sum(axis=0)
    return RunValues(values, covariance - common, common, True, result.noise.dof_of(kind))


def _common(result: CalibrationResult, known: np.ndarray, *, keep_scale: bool) -> np.ndarray:
    """Return factors L (r, 2n) of the covariance L' L of what the runs of a machine share, m.

    Terms of the microscope that are known from elsewhere, and the reference length.
    """
    terms = {term.name: term for term in result.model.terms}
    names = [
        name
        for name, block in blocks().items()
        if block.shared
        if name in terms and remaining_part(terms[name]) >= TOLD
    ]
    kept = factors_of(result)
    factors = kept.of_map[np.isin(kept.terms, names)][:, :, known]
    factors = factors.reshape(len(factors), 2 * int(known.sum()))
    factors = factors * np.nan_to_num(result.noise.sigma_xy)
    if keep_scale and result.reference is not None:
        at = result.artifact
        place = np.concatenate([at.x_m[known], at.y_m[known]]) * result.reference.u_relative
        factors = np.concatenate([factors, place[None]])
    return factors


def _polynomials(x: np.ndarray, y: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return polynomials of position up to `DEGREE` as columns over Gx, then Gy; the shear first.

    The first two are non-orthogonality O and scale difference R (Hu eq. 6).
    """
    size = max(np.abs(x).max(), np.abs(y).max())
    x, y = x[known] / size, y[known] / size
    zero = np.zeros(len(x))
    columns = [(y, x), (x, -y)]
    for degree in range(2, DEGREE + 1):
        for power in range(degree + 1):
            values = x ** (degree - power) * y**power
            columns += [(values, zero), (zero, values)]
    return np.array([np.concatenate(column) for column in columns]).T


def _waves(lines: np.ndarray) -> np.ndarray:
    angle = 2 * np.pi * np.flatnonzero(lines) / len(lines)
    return np.array([wave(k * angle) for k in range(1, DEGREE + 1) for wave in (np.cos, np.sin)]).T


def _result(
    parts: Sequence[Part],
    first: CalibrationResult,
    means: Mapping[str, Mean],
    common: Mapping[str, np.ndarray],
) -> CalibrationResult:
    """Return the means as a result: of ``xy``, and ``theta`` if it is known, by their places."""
    plate, known = first.plate, common["xy"]
    shapes = {"xy": (2, *known.shape), "theta": (1, len(common["theta"]))}
    maps = {of: np.full(shape, np.nan) for of, shape in shapes.items()}
    u = {of: np.full(shape, np.nan) for of, shape in shapes.items()}
    dof, k = dict.fromkeys(KINDS, np.nan), dict.fromkeys(KINDS, 2.0)
    for kind, mean in means.items():
        for out, values in ((maps[kind], mean.values), (u[kind], mean.u)):
            out[:, common[kind]] = values.reshape(len(out), -1)
        dof[kind], k[kind] = mean.dof, coverage_factor(mean.dof)

    (gx, gy), (u_gx, u_gy) = maps["xy"], u["xy"]
    o, r = first_order(first.artifact, maps["xy"])
    emap = ErrorMap(
        first.artifact,
        gx,
        gy,
        u_gx,
        u_gy,
        maps["theta"][0],
        u["theta"][0],
        o,
        r,
        ThetaDatum.ZERO_MEAN,
    )
    unknown, unknowns = np.full(plate.shape, np.nan), 2 * int(known.sum())
    runs = [part.result for part in parts]
    found = CalibrationResult(
        "+".join(dict.fromkeys(run.plan_id for run in runs if run)),
        emap,
        ArtifactMap(unknown, unknown, np.full(plate.angular_count, np.nan)),
        (),
        Observability(unknowns, unknowns, 0, True),
        Noise(
            np.nan,
            np.nan,
            dof_xy=dof["xy"],
            dof_theta=dof["theta"],
            k_xy=k["xy"],
            k_theta=k["theta"],
            dof_map_xy=dof["xy"],
            dof_map_theta=dof["theta"],
        ),
        input={"file": ", ".join(part.name for part in parts)},
        method=COMBINED,
        sense=first.sense,
        extra={COMBINED: _runs(parts, means)},
        kept=kept_covariances(_covariances(parts, means)),
        verdict=_verdict(parts, means),
        model=ModelResult(first.model.misalignment),
        reference=shared_reference(runs, means["xy"].weights),
        provenance=Provenance(version=__version__, extra=exposures(runs)),
        findings=(Finding("not_in_all", details={"sites": int((~known).sum())}),)
        if not known.all()
        else (),
        placed_plate=first.placed_plate,
    )
    return replace(found, budget=_budget(found, means))


def _runs(parts: Sequence[Part], means: Mapping[str, Mean]) -> dict[str, Any]:
    """Return the runs with their deviations."""
    facts: dict[str, Any] = {}
    for kind, mean in means.items():
        facts |= {
            f"u_between_{KINDS[kind]}": mean.u_between,
            f"p_between{SUFFIX[kind]}": mean.p_between,
        }
    facts["runs"] = []
    for index, part in enumerate(parts):
        run = {
            "file": part.name,
            "run_id": part.result.run_id if part.result else "",
            "sha256": part.result.input.get("sha256", "") if part.result else "",
            "weight": float(means["xy"].weights[index]),
        }
        for kind, mean in means.items():
            run |= _of_run(mean.deviations[index], SUFFIX[kind], USUAL_LEVEL / len(parts))
        facts["runs"].append(run)
    return facts


def _covariances(parts: Sequence[Part], means: Mapping[str, Mean]) -> dict[str, np.ndarray]:
    """Return the covariances of the means whose runs all have theirs."""
    own = all(part.result is not None for part in parts)
    return {
        kind: mean.covariance
        for kind, mean in means.items()
        if (own or kind == "theta")
        and mean.covariance.ndim == 2
        and all(
            deviation.test is None or deviation.test.correlated for deviation in mean.deviations
        )
    }


def _of_run(found: Deviation, kind: str, limit: float) -> dict[str, Any]:
    test = found.test
    return {
        f"e_n_rms{kind}": rms(found.e_n),
        f"e_n_largest{kind}": float(abs(found.e_n).max()),
        f"beyond{kind}": float((abs(found.e_n) > 1).mean()),
        f"p{kind}": np.nan if test is None else min(1.0, 2 * min(test.p, test.p_z)),
        f"agrees{kind}": None if test is None else not test.significant,
        f"stands_out{kind}": bool(found.p_scatter < limit),
    }


def _verdict(parts: Sequence[Part], means: Mapping[str, Mean]) -> Verdict:
    """Return the verdict: enlarged if a run's U was, or if the runs differ by more than their U."""
    enlarged: dict[str, Enlargement] = {}
    failed = []
    for kind, mean in means.items():
        if mean.p_between < USUAL_LEVEL:
            u, name, unit = np.sqrt(mean.between), BETWEEN + SUFFIX[kind], KINDS[kind]
            enlarged[name] = Enlargement(name, rms(u), float(u.max()), unit)
            failed.append(
                Finding(
                    "between_runs",
                    mean.u_between,
                    unit=unit,
                    p=mean.p_between,
                    details={"runs": len(parts), "quantity": kind},
                )
            )
    for part in parts:
        for item in part.result.verdict.enlarged_by if part.result else ():
            before = enlarged.get(item.name)
            if before is None or before.u_rms < item.u_rms:
                enlarged[item.name] = item
    of_runs = [
        part.name for part in parts if part.result and part.result.verdict.grade is Grade.ENLARGED
    ]
    if of_runs:
        failed.append(Finding("enlarged_runs", details={"runs": of_runs}))
    return Verdict(
        Grade.ENLARGED if failed else Grade.GOOD,
        tuple(failed),
        enlarged_by=tuple(enlarged.values()),
    )


def _budget(result: CalibrationResult, means: Mapping[str, Mean]) -> tuple[BudgetLine, ...]:
    lines: list[BudgetLine] = []
    between = [line for line in budget_lines(result) if line.component == INTERPOLATION]
    for kind, mean in means.items():
        for component, variance, size, letter, dof in (
            ("uncertainty of the runs", mean.within, rms(np.sqrt(mean.within)), "A", mean.dof),
            ("shared by all runs", mean.common, rms(np.sqrt(mean.common)), "B", np.inf),
            ("between runs", mean.between, mean.u_between, "A", mean.dof),
        ):
            u = np.sqrt(variance)
            lines.append(
                BudgetLine(
                    kind,
                    component,
                    letter,
                    0.0,
                    size,
                    KINDS[kind],
                    rms(u),
                    float(u.max()),
                    dof,
                    "readings",
                    {"runs": len(mean.weights)},
                )
            )
        lines += [line for line in between if line.quantity == kind]
    return tuple(lines)
