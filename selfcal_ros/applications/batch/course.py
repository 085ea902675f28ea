# SPDX-License-Identifier: Apache-2.0
"""Course of a quantity over time: a trend, a change, or neither; comparison with a baseline.

Both are rank tests, so a single outlier is not decisive: Mann and Kendall's test of a
trend with Theil and Sen's slope, and Pettitt's test of a change (Appl. Statist. 28 (1979) 126),
with probabilities from random orders of the same values; the change point minimises the sum
of absolute residuals. They assume independent values under the null hypothesis.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from selfcal_ros.applications.batch.folder import Record
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import MapDifference, compare
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.summary.numbers import p_text
from selfcal_ros.results import read_result
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

FEWEST = 8
"""Smallest number of values for a test."""
COURSE_LEVEL = 0.05
"""Fraction of stable batches with a false alarm, all quantities together."""
ORDERS = 9999
"""Number of random orders for the probability of a change."""
SEED = 20240229


class CourseKind(StrEnum):
    """Kinds of findings."""

    NONE = "none"
    TREND = "trend"
    CHANGE = "change"


@dataclass(frozen=True)
class Course:
    """Course of the values of a quantity over time.

    Attributes
    ----------
    n : int
        Number of values.
    slope_per_day : tuple of float
        Theil and Sen's slope, and its 95 % limits.
    p_trend, p_change : float
        Probability of as much, or more, of stable values.
    last_before, change : int
        Indices of the last known value before the most likely change, and of the first after it;
        both 0 if there is none.
    before, after : float
        Medians on both sides of it.
    adjusted_p : float
        Probability of the finding (else the smaller one), corrected for all tests of a series
        (Benjamini, Hochberg).
    finding : CourseKind
        The significant finding; of two the one with smaller residuals.
    """

    n: int
    slope_per_day: tuple[float, float, float]
    p_trend: float
    p_change: float
    change: int
    before: float
    after: float
    adjusted_p: float = 1.0
    finding: CourseKind = CourseKind.NONE
    last_before: int = 0


def course_of(
    days: np.ndarray,
    values: np.ndarray,
    rng: np.random.Generator,
    *,
    orders: int = ORDERS,
) -> Course:
    """Return the course of `values` (n,) at the times `days` (n,), which rise.

    Without a decision, which `courses` makes for all quantities together.
    """
    nothing = Course(
        n=len(values),
        slope_per_day=(0.0, 0.0, 0.0),
        p_trend=1.0,
        p_change=1.0,
        change=0,
        before=float(values[0]),
        after=float(values[0]),
    )
    if len(values) < FEWEST or np.ptp(values) == 0 or np.ptp(days) == 0:
        return nothing
    from scipy import stats  # a second, for a series alone

    slope, _, low, high = stats.theilslopes(values, days, 0.95)
    change = step_of(values)
    p_change = pettitt(values, rng, orders=orders)
    return Course(
        n=len(values),
        slope_per_day=(float(slope), float(low), float(high)),
        p_trend=float(stats.kendalltau(days, values).pvalue),
        p_change=p_change,
        change=change,
        before=float(np.median(values[:change])),
        after=float(np.median(values[change:])),
    )


def pettitt(
    values: np.ndarray, rng: np.random.Generator, *, orders: int = ORDERS
) -> float:
    """Return the probability of as large a change in a random order of `values` (n,).

    Pettitt's statistic is the largest |2 sum of the first t ranks - t (n + 1)| over t.
    """
    from scipy.stats import rankdata  # as in `course_of`

    ranks = rankdata(values)
    size = _imbalance(ranks[None]).max()
    shuffled = rng.permuted(np.broadcast_to(ranks, (orders, len(ranks))), axis=1)
    as_large = int((_imbalance(shuffled).max(axis=1) >= size - 1e-9).sum())
    return (1 + as_large) / (1 + orders)


def step_of(values: np.ndarray) -> int:
    """Return the index of the first value after the best step in the sense of least moduli.

    The maximum of Pettitt's statistic is biased towards the middle.
    """
    moduli = [
        np.abs(values[:t] - np.median(values[:t])).sum()
        + np.abs(values[t:] - np.median(values[t:])).sum()
        for t in range(1, len(values))
    ]
    return int(np.argmin(moduli)) + 1


def _imbalance(ranks: np.ndarray) -> np.ndarray:
    """Return |2 sum of the first t ranks - t (n + 1)| for t = 1..n-1, (orders, n - 1)."""
    n = ranks.shape[1]
    return np.abs(2 * np.cumsum(ranks, axis=1)[:, :-1] - np.arange(1, n) * (n + 1))


def courses(
    days: np.ndarray,
    table: Mapping[str, np.ndarray],
    *,
    orders: int = ORDERS,
) -> dict[str, Course]:
    """Return the course of every quantity, with a common decision.

    Parameters
    ----------
    days : float array (n,)
        Times, rising, in days.
    table : mapping
        Quantity -> values (n,), NaN if unknown.
    orders : int
        Number of the random orders.
    """
    rng = np.random.default_rng(SEED)
    course_of_quantity = {}
    for name, values in table.items():
        has_value = np.isfinite(values)
        if has_value.sum() >= FEWEST:
            course = course_of(days[has_value], values[has_value], rng, orders=orders)
            if course.change:
                last, first = np.flatnonzero(has_value)[
                    course.change - 1 : course.change + 1
                ]
                course = replace(course, last_before=int(last), change=int(first))
            course_of_quantity[name] = course
    adjusted = _adjusted(
        [
            p
            for course in course_of_quantity.values()
            for p in (course.p_trend, course.p_change)
        ]
    ).reshape(-1, 2)
    return {
        name: _with_finding(course, pair, days, table[name])
        for (name, course), pair in zip(
            course_of_quantity.items(), adjusted, strict=True
        )
    }


def _adjusted(p: Sequence[float]) -> np.ndarray:
    """Return the probabilities of all tests of a batch, corrected together, (n,)."""
    if not p:
        return np.zeros(0)
    from scipy.stats import false_discovery_control  # as in `course_of`

    return false_discovery_control(p)


def _with_finding(
    course: Course, adjusted: np.ndarray, days: np.ndarray, values: np.ndarray
) -> Course:
    finding = CourseKind.NONE
    if adjusted.min() <= COURSE_LEVEL:
        finding = (
            _of_both(course, days, values)
            if adjusted.max() <= COURSE_LEVEL
            else (
                CourseKind.TREND if adjusted[0] <= COURSE_LEVEL else CourseKind.CHANGE
            )
        )
    counted = {CourseKind.TREND: adjusted[0], CourseKind.CHANGE: adjusted[1]}
    return replace(
        course, adjusted_p=float(counted.get(finding, adjusted.min())), finding=finding
    )


def _of_both(course: Course, days: np.ndarray, values: np.ndarray) -> CourseKind:
    """Return the better of a line and a step (BIC of Laplace errors, 2 and 3 unknowns)."""
    has_value = np.isfinite(values)
    t = days[has_value]
    x = values[has_value]
    n = int(has_value.sum())
    line = x - course.slope_per_day[0] * t
    after = np.flatnonzero(has_value) >= course.change
    step = x - np.where(after, course.after, course.before)
    sizes = [np.abs(line - np.median(line)).sum(), np.abs(step).sum()]
    tiny = np.finfo(float).tiny
    line_bic, step_bic = (
        n * np.log(max(size, tiny)) + k * np.log(n) / 2
        for size, k in zip(sizes, (2, 3), strict=True)
    )
    return CourseKind.TREND if line_bic <= step_bic else CourseKind.CHANGE


LEVEL = 0.05
"""Part of the named maps that may be named by chance."""


def compared(
    records: Sequence[Record], folder: Path, baseline: CalibrationResult, where: str
) -> list[Record]:
    """Return the records with `baseline` and further quantities, where their map can be compared.

    `baseline`: {p, adjusted_p, changed}. The quantities are largest and rms difference, datum
    difference removed. A map that cannot be compared has the reason in `not_compared`.

    Parameters
    ----------
    records : sequence of dict
        Records of bags; those without a map remain as they are.
    folder : Path
        Folder of the batch.
    baseline : CalibrationResult
        The map to compare with.
    where : str
        Its file, for the reasons.
    """
    tried = {
        number: _difference(record, folder, baseline, where)
        for number, record in enumerate(records)
        if record.get("quantities") and "result" in record
    }
    differences = {
        number: difference
        for number, difference in tried.items()
        if isinstance(difference, MapDifference)
    }
    records = [
        record | {"not_compared": tried[number]}
        if isinstance(tried.get(number), str)
        else record
        for number, record in enumerate(records)
    ]
    p = {
        number: value
        for number, difference in differences.items()
        if np.isfinite(value := probability(difference))
    }
    adjusted = dict(zip(p, _adjusted(list(p.values())), strict=True))
    return [
        record
        if number not in differences
        else record
        | {
            "quantities": record["quantities"] | _quantities(differences[number]),
            "baseline": None
            if number not in p
            else {
                "p": p[number],
                "adjusted_p": float(adjusted[number]),
                "changed": bool(adjusted[number] <= LEVEL),
            },
        }
        for number, record in enumerate(records)
    ]


def probability(difference: MapDifference) -> float:
    """Return the probability of a difference as large in any of its tests; NaN without tests.

    The distance of all nodes and the largest one, of XY and theta: the smallest times their number.
    """
    tests = [test for test in (difference.xy, difference.theta) if test is not None]
    values = [p for test in tests for p in (test.p, test.p_z) if np.isfinite(p)]
    return min(min(values) * len(values), 1.0) if values else float("nan")


def _difference(
    record: Record, folder: Path, baseline: CalibrationResult, where: str
) -> MapDifference | str:
    file = folder / record["result"]
    try:
        return compare(baseline, read_result(file), names=(where, str(file)))
    except InputError as error:  # another lattice, or nothing that both know
        return error.what


def _quantities(difference: MapDifference) -> dict[str, float | None]:
    values = {
        "difference_from_baseline_rms_um": difference.rms_m * UM_PER_M,
        "difference_from_baseline_largest_um": difference.max_m * UM_PER_M,
        "theta_difference_from_baseline_rms_arcsec": difference.rms_theta_rad
        * ARCSEC_PER_RAD,
    }
    return {name: value for name, value in values.items() if np.isfinite(value)}


def sentence(records: Sequence[Record], where: str) -> str:
    """Return which maps differ from the baseline, in one sentence."""
    tested = [record for record in records if record.get("baseline")]
    changed = [record for record in tested if record["baseline"]["changed"]]
    named = ", ".join(
        f"{record['bag']} ({p_text(record['baseline']['adjusted_p'])})"
        for record in changed
    )
    reasons = Counter(
        record["not_compared"] for record in records if "not_compared" in record
    )
    return (
        f"{len(changed)} of {len(tested)} maps differ from {where}"
        + (f": {named}" if changed else "")
        + "".join(
            f"; not compared: {count} ({reason})" for reason, count in reasons.items()
        )
    )
