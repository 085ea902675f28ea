# SPDX-License-Identifier: Apache-2.0
"""From repeats of a mark to one mean, without outliers, and to the means of its visits.

Rule: a repeat is an outlier if its distance from the median of its mark's repeats exceeds
`limit` standard deviations of one reading. The standard deviation is robust: the median of
the absolute differences of all pairs of repeats of the view, over 0.6745 sqrt(2), stable with up
to a quarter of bad pairs. With few pairs the limit grows. Of two contradictory repeats both are
outliers, and so are all repeats of a mark of which fewer than half are left: the median of mostly
bad repeats is itself an outlier, and would be kept instead of the good one.
Of clean Gaussian readings fewer than 1 in 100,000 are rejected (test_repeats.py).
If most pairs agree to the bit and the others differ by whole steps of one size, this is the
resolution of the sensor, and a few steps are not an outlier.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from selfcal_ros.model.readings import GridVisits, RepeatMotion, weights_by_u

PART = 32_768
"""Numbers that are worked on together where marks do not depend on each other: they stay in the
cache of a processor, and take no memory beside the readings."""
MIN_PAIRS = 12
"""Smallest number of pairs of repeats in a view to detect outliers."""
ALL_PAIRS = 33
"""Largest number of repeats of a mark with all pairs used; above, 16 per repeat."""
STEPS = 3
"""Steps of a sensor by which otherwise identical repeats may differ."""
SLOW = 5
"""Degree of the polynomial of the order of the readings that is taken out of their changes."""
TURNS = 2
"""Degree of the polynomial of the order that is taken out of lines: as slow as a plate turns. Two
passes determine it so well that the means become noisier by a fortieth."""
TURNS_LEVEL = 0.02
"""Probability by chance (F-test) below which repeats of lines show that all of them turn."""
FOLLOWS = 3.0
"""Change of the deviation over that of the stage's position up to which an outlier among repeats
may come of the microscope's wiring: reversed offsets make 2 of it, doubled ones 1."""


def median(values: np.ndarray, *, overwrite: bool = False) -> float:
    """Return the median to the bit of `numpy.median`, at a third of its cost.

    Parameters
    ----------
    values : float array (n,)
        At least one, none of them NaN.
    overwrite : bool
        Whether their order may be changed, which saves a copy.
    """
    half = len(values) // 2
    partitioned = values if overwrite else values.copy()
    partitioned.partition(half)
    if len(values) % 2:
        return float(partitioned[half])
    return float((partitioned[:half].max() + partitioned[half]) / 2)


def row_medians(values: np.ndarray) -> np.ndarray:
    """Return the medians (..., 1) of the rows of a table (..., r), r > 0, none of them NaN."""
    half = values.shape[-1] // 2
    rising = np.sort(values, axis=-1)
    if values.shape[-1] % 2:
        return rising[..., half : half + 1]
    return (rising[..., half - 1 : half] + rising[..., half : half + 1]) / 2


def distances(away: np.ndarray) -> np.ndarray:
    """Return the lengths (n,) of vectors (2, n) of ordinary size: `numpy.hypot`, faster."""
    return np.sqrt(away[0] * away[0] + away[1] * away[1])


@dataclass(frozen=True)
class Means:
    """Means of marks: (c, marks) values, their counts and declared standard uncertainties.

    `companions` are means of further quantities with the same weights; `outlier` is a mask of
    the readings that are in no mean.
    """

    key: np.ndarray
    mean: np.ndarray
    count: np.ndarray
    u: np.ndarray
    sigma: float
    dof: int
    outlier: np.ndarray
    companions: np.ndarray


def reduce_repeats(
    key: np.ndarray,
    values: np.ndarray,
    sigma: np.ndarray,
    *,
    limit: float,
    extent: float = 0.0,
    residual: np.ndarray | None = None,
    steady: tuple[np.ndarray, int] | None = None,
) -> Means:
    """Reject outliers and average the repeats of every mark.

    Parameters
    ----------
    key : int array (n,)
        Index of the mark of each reading.
    values : float array (c, n)
        Readings, c components, m or rad; in canonical order, for reproducible sums.
    sigma : float array (n,)
        Declared standard uncertainty of each reading, 0 = not declared.
    limit : float
        Outlier limit in standard deviations; 0 keeps all.
    extent : float
        Size of the positions behind the readings, m or rad: a difference within their rounding is
        not an outlier, however exact the other repeats are.
    residual : float array (c, n), optional
        The readings without the view's own motion. With too few repeats for the noise, their
        scatter between marks is its upper limit.
    steady : tuple, optional
        Values (c, n) used for outliers and repeatability instead of the readings, and the number
        of parameters fitted to them; see `check_stops.without_aside`.

    Returns
    -------
    Means
        Marks in rising order of key. If all repeats of a mark declare a sigma the mean is
        weighted by 1/sigma^2. `sigma` is the pooled repeatability (NaN without repeats),
        `dof` its degrees of freedom, `outlier` a mask over the readings.
    """
    outlier = np.zeros(len(key), dtype=bool)
    judged, fitted = steady or (values, 0)
    if limit > 0 and len(key):
        outlier = _outliers(key, judged, _relative(sigma), (limit, extent), residual)
    means = average(key[~outlier], values[:, ~outlier], sigma[~outlier])
    if fitted:
        judged_means = average(key[~outlier], judged[:, ~outlier], sigma[~outlier])
        dof = max(judged_means.dof - fitted, 0)
        pooled = (
            judged_means.sigma * np.sqrt(judged_means.dof / dof)
            if dof
            else float("nan")
        )
        means = replace(means, sigma=float(pooled), dof=dof)
    return replace(means, outlier=outlier)


def average(
    key: np.ndarray,
    values: np.ndarray,
    sigma: np.ndarray,
    companions: np.ndarray | None = None,
) -> Means:
    """Average the readings of each key; arguments as for `reduce_repeats`, none is an outlier.

    `companions` (e, n) are averaged likewise, without effect on the repeatability.
    """
    marks, inverse, count = _distinct(key)
    weight, best = weights_by_u(inverse, sigma, 1.0, len(marks))
    declared = best > 0
    total = np.bincount(inverse, weight, len(marks))
    mean = _means(values, weight, inverse, total)
    residual = values - mean[:, inverse]
    dof = int(len(values) * (count - 1).sum())
    pooled = float(np.sqrt((residual**2).sum() / dof)) if dof else float("nan")
    u = (
        np.where(declared, best / np.sqrt(total), np.nan)
        if declared.any()
        else np.zeros(0)
    )
    more = (
        mean[:0] if companions is None else _means(companions, weight, inverse, total)
    )
    return Means(
        key=marks,
        mean=mean,
        count=count,
        u=u,
        sigma=pooled,
        dof=dof,
        outlier=np.zeros(len(key), dtype=bool),
        companions=more,
    )


def _distinct(key: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distinct keys, the inverse indices, and the counts.

    Like `numpy.unique`; repeats of a mark are mostly consecutive, so runs of them are sorted.
    """
    begin = np.flatnonzero(np.diff(key, prepend=key[:1] - 1))
    length = np.diff(np.append(begin, len(key)))
    marks, inverse = np.unique(key[begin], return_inverse=True)
    count = np.bincount(inverse, length, len(marks)).astype(np.int64)
    return marks, np.repeat(inverse, length), count


def _means(
    values: np.ndarray, weight: np.ndarray, inverse: np.ndarray, total: np.ndarray
) -> np.ndarray:
    """Return weighted means relative to each mark's first repeat: exact if repeats are equal."""
    if not len(inverse):
        return np.zeros((len(values), 0))
    first = np.full(len(total), len(inverse))
    np.minimum.at(first, inverse, np.arange(len(inverse)))
    base = values[:, first]
    return base + np.array(
        [
            np.bincount(inverse, weight * (row - b[inverse]), len(total)) / total
            for row, b in zip(values, base, strict=True)
        ]
    )


def _relative(sigma: np.ndarray) -> np.ndarray:
    """Return each reading's declared sigma over their median; 1 where none is declared."""
    declared = sigma > 0
    if not declared.any():
        return np.ones(len(sigma))
    middle = np.median(sigma[declared])
    return np.where(declared, sigma, middle) / middle


def _outliers(
    key: np.ndarray,
    values: np.ndarray,
    relative: np.ndarray,
    limits: tuple[float, float],
    residual: np.ndarray | None,
) -> np.ndarray:
    groups = groups_of(key)
    limit, extent = limits
    scale, pairs = _pair_scale(groups, values, relative)
    if groups and pairs < MIN_PAIRS and residual is not None:
        scale = median(np.abs(residual).ravel()) / 0.6744897501960817
        pairs = len(np.unique(key)) * len(residual)
    out = np.zeros(len(key), dtype=bool)
    if pairs < MIN_PAIRS:
        return out
    # a robust scale from n pairs scatters by about 1.2/sqrt(n): allow for three times this, and
    # more for the skewed distribution of few pairs
    cut = limit * scale * (1 + 4 / np.sqrt(pairs) + 8 / pairs)
    floor = 16 * np.finfo(float).eps * max(extent, np.abs(values).max())
    if cut <= floor:
        floor = max(floor, (STEPS + 0.5) * _sensor_step(groups, values, floor))
    for group in groups:
        # of two, each is half-way off
        share = np.sqrt(0.5) if group.shape[1] == 2 else 1.0
        for members in _batches(group, group.shape[1]):
            repeats = np.take(values, members, axis=1)
            away = np.abs(repeats - row_medians(repeats))
            bad = (away > np.maximum(cut * share * relative[members], floor)).any(
                axis=0
            )
            out[members] = bad | (
                2 * (~bad).sum(axis=1, keepdims=True) < group.shape[1]
            )
    return out


def groups_of(key: np.ndarray) -> list[np.ndarray]:
    """Return the indices of the repeats of each mark: one array (marks, r) for each r > 1."""
    order = np.argsort(key, kind="stable")
    start = np.flatnonzero(np.diff(key[order], prepend=key[order[:1]] - 1))
    count = np.diff(np.append(start, len(key)))
    return [
        order[start[count == r][:, None] + np.arange(r)]
        for r in np.unique(count)
        if r > 1
    ]


def _batches(group: np.ndarray, width: int) -> Iterator[np.ndarray]:
    """Yield the marks of a group in parts, for work with `width` numbers per mark."""
    size = max(1, PART // width)
    for start in range(0, len(group), size):
        yield group[start : start + size]


def _sensor_step(groups: list[np.ndarray], values: np.ndarray, floor: float) -> float:
    """Return the step by which repeats of most marks differ, 0 if there is none.

    It applies to at least three marks, and three quarters of those that differ do so by one to
    `STEPS` of it.
    """
    spread = np.concatenate(
        [np.ptp(values[:, group], axis=2).ravel() for group in groups]
    )
    spread = spread[spread > floor]
    if len(spread) < 3:
        return 0.0
    steps = spread / spread.min()
    whole_steps = (np.abs(steps - np.rint(steps)) < 1e-3) & (steps < STEPS + 0.5)
    return (
        float(spread.min()) if whole_steps.sum() >= max(3, 0.75 * len(steps)) else 0.0
    )


@lru_cache(64)
def pairs_of(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return pairs of `count` repeats: all, or for many repeats each with 16 others, evenly."""
    if count <= ALL_PAIRS:
        return np.triu_indices(count, 1)
    lags = np.rint(np.linspace(1, count // 2, ALL_PAIRS // 2)).astype(int)
    i = np.tile(np.arange(count), len(lags))
    return i, (i + np.repeat(lags, count)) % count


def _pair_scale(
    groups: list[np.ndarray], values: np.ndarray, relative: np.ndarray
) -> tuple[float, int]:
    """Return the robust standard deviation of one reading, and the number of pairs."""
    if not groups:
        return float("nan"), 0
    differences = np.empty(
        len(values)
        * sum(len(group) * len(pairs_of(group.shape[1])[0]) for group in groups)
    )
    filled, alike = 0, bool((relative == 1).all())  # as where no sigma is declared
    for group in groups:
        i, j = pairs_of(group.shape[1])
        for members in _batches(group, len(i)):
            weights = relative[members]
            repeats = np.take(values, members, axis=1)
            norm = (
                np.sqrt(2)
                if alike
                else np.hypot(np.take(weights, i, axis=1), np.take(weights, j, axis=1))
            )
            of_pairs = np.take(repeats, i, axis=2) - np.take(repeats, j, axis=2)
            differences[filled : filled + of_pairs.size] = (
                np.abs(of_pairs) / norm
            ).ravel()
            filled += of_pairs.size
    independent = sum(len(group) * (group.shape[1] - 1) for group in groups) * len(
        values
    )
    return median(differences, overwrite=True) / 0.6744897501960817, independent


def grid_visits(
    means: Means,
    key: np.ndarray,
    sigma: np.ndarray,
    *,
    stamps_ns: np.ndarray,
    deviation: np.ndarray,
    offset: np.ndarray,
    approach: np.ndarray,
    step_m: float = np.inf,
) -> GridVisits | None:
    """Return the visits behind the means of a view's grid marks; None without any.

    A visit is a run of successive exposures of one mark: it ends with an exposure of another mark,
    also if that reading is an outlier, and with a motion of the stage beyond
    `step_m`, as between check stops. Outliers are in no visit. Deviations,
    offsets and instants of a visit are averaged with the weights of `reduce_repeats`. The approach
    is that of all its exposures, 0 if they differ.

    Parameters
    ----------
    means : Means
        Result of `reduce_repeats` for the same readings.
    key : int array (n,)
        Index of the mark of each reading, in the order of the stamps.
    sigma : float array (n,)
        Declared standard uncertainties, m; 0 = not declared.
    stamps_ns : int64 array (n,)
        Instants of exposure.
    deviation, offset : float array (2, n)
        Deviation and measured offset, stage axes, m.
    approach : int8 array (2, n)
        Signs of the last motions of x and y.
    step_m : float
        Motion of the stage along an axis that ends a visit, m.
    """
    no_outlier = ~means.outlier
    if not no_outlier.any():
        return None
    stage_moves = (
        np.abs(np.diff(deviation - offset, prepend=(deviation - offset)[:, :1]))
        > step_m
    )
    number = np.cumsum((np.diff(key, prepend=key[:1]) != 0) | stage_moves.any(axis=0))[
        no_outlier
    ]
    key, stamps_ns = key[no_outlier], stamps_ns[no_outlier]
    begins = np.diff(number, prepend=-1) != 0
    first = np.flatnonzero(begins)
    visit = np.cumsum(begins) - 1
    since = (stamps_ns - stamps_ns[first][visit]).astype(float)
    visits = average(
        visit,
        deviation[:, no_outlier],
        sigma[no_outlier],
        np.vstack([offset[:, no_outlier], since]),
    )
    mark = np.searchsorted(means.key, key[first])
    # visits are numbered in the order of their stamps
    order = np.argsort(mark, kind="stable")
    offset_x, offset_y, since = visits.companions[:, order]
    came_x, came_y = (
        np.where(
            _differs(row[no_outlier], visit, first), 0, row[no_outlier][first]
        ).astype(np.int8)[order]
        for row in approach
    )
    return GridVisits(
        mark=mark[order],
        dx=visits.mean[0, order],
        dy=visits.mean[1, order],
        count=visits.count[order],
        stamp_ns=stamps_ns[first][order] + np.rint(since).astype(np.int64),
        offset_x=offset_x,
        offset_y=offset_y,
        approach_x=came_x,
        approach_y=came_y,
        u=visits.u[order] if len(visits.u) else visits.u,
        sigma_m=visits.sigma,
        dof=visits.dof,
    )


def _differs(values: np.ndarray, visit: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Return which visits have more than one value, bool array (visits,)."""
    return np.bincount(visit, values != values[first][visit], len(first)) > 0


def without_turning(
    means: Means, key: np.ndarray, values: np.ndarray, *, sigma: np.ndarray
) -> Means:
    """Return the means of lines without a slow turning of all of them, if their repeats show one.

    The fit knows the visits of marks and takes their drift out; lines have none. A turning would
    count as noise of their repeats, and hide as much of what residuals show. Only passes determine
    it: successive repeats of a line do not.

    Parameters
    ----------
    means : Means
        Result of `reduce_repeats` for the same readings.
    key : int array (n,)
        Index of the line of each reading, in the order of the stamps.
    values : float array (1, n)
        Readings, rad.
    sigma : float array (n,)
        Declared standard uncertainties, rad; 0 = not declared.
    """
    kept = ~means.outlier
    key, values = key[kept], values[:, kept]
    dof = means.dof - TURNS
    if dof <= 0 or np.count_nonzero(np.diff(key)) + 1 < 2 * len(means.key):
        return means
    about = _about_means(key, values)
    slow = _of_order(len(key), TURNS)
    slow_about = _about_means(key, slow)
    size = np.linalg.lstsq(slow_about.T, about[0], rcond=None)[0]
    left = float(((about[0] - size @ slow_about) ** 2).sum())
    total = float((about**2).sum())
    # the F-test of two coefficients, in closed form
    if not (0 < left < total and (left / total) ** (dof / 2) < TURNS_LEVEL):
        return means
    steady = average(key, values - size @ slow, sigma[kept])
    return replace(
        steady, sigma=float(np.sqrt(left / dof)), dof=dof, outlier=means.outlier
    )


def repeat_motion(
    key: np.ndarray, place: np.ndarray, offset: np.ndarray, outlier: np.ndarray
) -> RepeatMotion | None:
    """Return the response of the offsets of the marks to the stage; None without repeats.

    Outliers are excluded unless the stage had moved as well: offsets of the wrong sign or scale
    turn every stop away from a mark into an outlier. Slow changes, such as a drift that the stage
    follows, are not a response of the microscope: a polynomial is removed, then neighbours are
    subtracted.

    Parameters
    ----------
    key : int array (n,)
        Index of the mark of each reading, in the order of the stamps.
    place, offset : float array (c, n)
        Position of the optical axis over the plate, and offset of the mark from it, m or rad.
    outlier : bool array (n,)
        Outliers among the repeats.
    """
    if outlier.any():
        place_about, offset_about = _about_means(key, place), _about_means(key, offset)
        follows = ((place_about + offset_about) ** 2).sum(axis=0) <= FOLLOWS**2 * (
            place_about**2
        ).sum(axis=0)
        keep = ~outlier | follows
        key = key[keep]
        place = place[:, keep]
        offset = offset[:, keep]
    free = len(key) - int(np.count_nonzero(np.bincount(key))) - SLOW
    if free <= 0:
        return None
    about = np.concatenate([_about_means(key, place), _about_means(key, offset)])
    slow = _about_means(key, _of_order(len(key), SLOW))
    trend = np.linalg.lstsq(slow @ slow.T, slow @ about.T, rcond=None)[0]
    change = np.diff(about - trend.T @ slow)
    # neighbours share a reading
    return RepeatMotion(change @ change.T / 2, 2 * free // 3)


def _of_order(n: int, degree: int) -> np.ndarray:
    """Return polynomials of the order of n readings, without the constant, (degree, n)."""
    order = np.linspace(-1, 1, n)
    return np.polynomial.legendre.legvander(order, degree)[:, 1:].T


def _about_means(key: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (c, n) minus the mean of their mark."""
    first = np.zeros(key.max() + 1, dtype=int)
    count = np.bincount(key)
    # for equal indices the last assignment remains
    first[key[::-1]] = np.arange(len(key))[::-1]
    values = values - values[:, first[key]]  # exact if repeats are equal
    return (
        values
        - np.stack([np.bincount(key, row) for row in values])[:, key] / count[key]
    )
