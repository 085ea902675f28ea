# SPDX-License-Identifier: Apache-2.0
"""Comparison of two maps after removing the datum difference, with its significance."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc, ndtr, stdtr, stdtrit

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.covariance import (
    covariance_of,
    first_order_u,
    plate_as_map,
)
from selfcal_ros.estimation.comparison.lengths import length_in_both
from selfcal_ros.estimation.datum.covariance import USUAL_LEVEL
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import MANY_DOF, ErrorMap, datum_columns, rms
from selfcal_ros.model.recheck import Significance
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import MM_PER_M

KINDS = {"xy": "m", "theta": "rad"}
"""The maps of a result, and their units."""

DRAWS = 2000
"""Draws of noise: fifty of them, 25 of each of two maps, exceed the limit of the largest |z|."""


@dataclass(frozen=True, eq=False)
class ReducedNoise:
    """Noise of n values from which columns were taken off by least squares.

    Attributes
    ----------
    covariance : float array (n, n) or (n,)
        Of the values before, or their variances if the correlations are unknown.
    removed : float array (n, k)
        The columns.
    dof : float
        Degrees of freedom of the noise behind the covariance.
    """

    covariance: np.ndarray
    removed: np.ndarray
    dof: float

    @property
    def is_known(self) -> bool:
        """Whether there is noise, and all of it is known."""
        return bool(np.isfinite(self.covariance).all() and self.covariance.any())

    @cached_property
    def _basis(self) -> np.ndarray:
        return np.linalg.qr(self.removed)[0]

    def without(self, values: np.ndarray) -> np.ndarray:
        """Return values (n, ...) without the columns `removed`."""
        return values - self._basis @ (self._basis.T @ values)

    @property
    def correlated(self) -> bool:
        """Whether the correlations are known."""
        return self.covariance.ndim == 2

    @cached_property
    def remaining(self) -> np.ndarray:
        """Covariance, or variances, of the values without the columns."""
        return without(self.covariance, self._basis)

    @cached_property
    def variance(self) -> np.ndarray:
        """Variance of each value without the columns, (n,)."""
        return variances(self.remaining)

    @property
    def independent(self) -> float:
        """Number of independent values whose sum of squares scatters as theirs does."""
        squares = self.remaining**2
        return float(self.variance.sum() ** 2 / squares.sum())

    @property
    def varies(self) -> np.ndarray:
        """Values that the columns leave a variance, bool (n,)."""
        return self.variance > GAP * self.variance.max()

    @cached_property
    def u(self) -> np.ndarray:
        """Standard uncertainty of each value, (n,)."""
        return np.sqrt(np.maximum(self.variance, GAP * self.variance.max()))

    @cached_property
    def _axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Standard deviations (r,) and axes (n, r) of the values over `u`."""
        values, vectors = np.linalg.eigh(self.remaining / np.outer(self.u, self.u))
        determined = values > GAP * values[-1]
        return np.sqrt(values[determined]), vectors[:, determined]

    @property
    def rank(self) -> int:
        """Number of independent values."""
        if self.correlated:
            return len(self._axes[0])
        return max(int(self.varies.sum()) - self.removed.shape[1], 1)

    def white(self, ratio: np.ndarray) -> np.ndarray:
        """Return values over `u`, (n, ...), along their axes, of variance 1, (r, ...)."""
        if not self.correlated:
            return ratio
        size, axes = self._axes
        return ((axes.T @ ratio).T / size).T

    @cached_property
    def drawn(self) -> np.ndarray:
        """Values over `u` that are noise only, (n, DRAWS).

        By the symmetric root of their correlation, which rounding does not turn as it turns axes.
        """
        rng = np.random.default_rng(0)
        size, axes = self._axes
        ratio = (axes * size) @ (axes.T @ rng.standard_normal((len(axes), DRAWS)))
        if self.dof > MANY_DOF:
            return ratio
        return ratio / np.sqrt(rng.chisquare(self.dof, DRAWS) / self.dof)


def variances(covariance: np.ndarray) -> np.ndarray:
    """Return the variances (n,) of a covariance, or the variances that stand for it."""
    return np.maximum(np.diag(covariance) if covariance.ndim == 2 else covariance, 0.0)


def variances_of(covariance: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the variances of the inner products of values (n,) with columns (n, k), (k,)."""
    square = (
        covariance @ columns**2
        if covariance.ndim == 1
        else np.einsum("nk,nk->k", covariance @ columns, columns)
    )
    return np.maximum(square, 0.0)


def of_one_kind(covers: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return covariances, or all as variances if one of them is not a full matrix."""
    full = all(cover.ndim == 2 for cover in covers)
    return list(covers) if full else [variances(cover) for cover in covers]


def significance(
    values: np.ndarray, spread: ReducedNoise, *, level: float = USUAL_LEVEL
) -> Significance | None:
    """Test values (n,) without columns against their noise; None if that is unknown or none.

    Both tests together have the `level`.
    """
    if not spread.is_known:
        return None
    dof = spread.dof
    ratio = values / spread.u
    varies = spread.varies
    rank = spread.rank
    # the squared Mahalanobis distance
    square = float((spread.white(np.where(varies, ratio, 0.0)) ** 2).sum())
    p = of_square(square, rank, dof)
    largest = float(abs(ratio[varies]).max())
    drawn = abs(spread.drawn[varies]).max(axis=0) if spread.correlated else None
    p_z, limit = _of_largest(largest, int(varies.sum()), drawn, dof, level / 2)
    of_largest = spread.variance[np.abs(values).argmax()]
    return Significance(
        chi2_ratio=square / rank,
        dof=float(rank),
        p=p,
        correlated=spread.correlated,
        largest_z=largest,
        z_limit=limit,
        p_z=p_z,
        noise_dof=dof,
        significant=min(p, p_z) < level / 2,
        u_rms=float(np.sqrt(spread.variance.mean())),
        u_largest=float(np.sqrt(of_largest)),
    )


def of_square(square: float, rank: float, dof: float) -> float:
    """Return the probability of a sum of squares of `rank` values of unit variance.

    `dof` are the degrees of freedom of the noise behind that variance.
    """
    return float(
        fdtrc(rank, dof, square / rank) if dof <= MANY_DOF else chdtrc(rank, square)
    )


def without(covariance: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the covariance of values from which the columns q were removed; (d,) as variances."""
    if covariance.ndim == 1:
        return covariance * (1 - (q**2).sum(axis=1))
    covariance = covariance - q @ (q.T @ covariance)
    return covariance - (covariance @ q) @ q.T


def _of_largest(
    largest: float, n: int, drawn: np.ndarray | None, noise_dof: float, level: float
) -> tuple[float, float]:
    """Return the probability of such a |z| among n values, and the limit of a level.

    The number of values bounds it (Bonferroni); the largest |z| of draws, if there are any, give it
    for correlated nodes, except in the far tail, where the bound is close.
    """
    dof = min(noise_dof, MANY_DOF)
    bound = min(float(2 * n * stdtr(dof, -largest)), 1.0)
    limit = -float(stdtrit(dof, level / 2 / n))
    if drawn is None:
        return bound, limit
    above = int(level * (len(drawn) + 1))
    p = (1 + np.count_nonzero(drawn >= largest)) / (1 + len(drawn))
    return min(bound, float(p)), min(limit, float(np.sort(drawn)[-above]))


@dataclass(frozen=True, eq=False)
class MapDifference:
    """Map B minus map A, datum difference removed.

    Attributes
    ----------
    dx, dy : float array (nx, ny)
        Difference, m; NaN where either map is unknown.
    d_theta : float array (K,)
        Difference of the angular maps, rad.
    translation_m, rotation_rad, scale, theta_rad : tuple, float
        The removed datum difference.
    nonorthogonality, scale_difference : float
        Differences of O and R.
    xy, theta : Significance or None
        Tests, 5 % altogether; None if there is nothing to test.
    u_beyond_m : float
        Standard uncertainty of the part of `rms_m` beyond that of noise, m; NaN without a test.
    """

    dx: np.ndarray
    dy: np.ndarray
    d_theta: np.ndarray
    translation_m: tuple[float, float]
    rotation_rad: float
    scale: float
    theta_rad: float
    nonorthogonality: float
    scale_difference: float
    xy: Significance | None
    theta: Significance | None
    u_beyond_m: float = float("nan")

    @property
    def beyond_m(self) -> float:
        """The part of `rms_m` beyond that of noise, m; NaN without a test."""
        if self.xy is None:
            return float("nan")
        return float(np.sqrt(max(self.rms_m**2 - self.xy.u_rms**2, 0.0)))

    @property
    def significant(self) -> bool | None:
        """Verdict of all tests; None without uncertainties to test against."""
        tests = [test for test in (self.xy, self.theta) if test is not None]
        return any(test.significant for test in tests) if tests else None

    @property
    def rms_m(self) -> float:
        """Root mean square over the known sites and both axes, m."""
        return rms(np.stack([self.dx, self.dy]))

    @property
    def max_m(self) -> float:
        """Largest difference on an axis, m."""
        return float(np.nanmax(np.abs(np.stack([self.dx, self.dy]))))

    @property
    def rms_theta_rad(self) -> float:
        """Root mean square of the angular difference, rad; NaN without angular maps."""
        return rms(self.d_theta)

    @property
    def max_theta_rad(self) -> float:
        """Largest angular difference, rad; NaN without angular maps."""
        differences = self.d_theta[np.isfinite(self.d_theta)]
        return float(np.abs(differences).max()) if len(differences) else float("nan")


@one_thread()
def compare(
    a: CalibrationResult,
    b: CalibrationResult,
    *,
    keep_scale: bool = False,
    plates: bool = False,
    names: tuple[str, str] = ("A", "B"),
) -> MapDifference:
    """Compare two calibrations of the same lattice.

    Parameters
    ----------
    a, b : CalibrationResult
        The calibrations; the difference is B minus A.
    keep_scale : bool
        Keep magnification in the difference: both maps have their own scale.
    plates : bool
        Compare the maps of the plates rather than those of the stages.
    names : tuple of str
        For messages.

    Raises
    ------
    InputError
        If the lattices differ or no site is known in both.
    """
    pair = [(plate_as_map(result) if plates else result).error_map for result in (a, b)]
    require_same_lattice(pair[0].artifact, pair[1].artifact, names)
    n_known = int((pair[0].valid & pair[1].valid).sum())
    if n_known < 3:
        raise InputError(
            names[1],
            "fewer than three sites are known in both maps",
            "compare maps that overlap",
        )

    xy, theta = (
        _difference((a, b), pair, kind, plates=plates, scale=not keep_scale)
        for kind in KINDS
    )
    tested = [of_map.noise.is_known for of_map in (xy, theta) if of_map.noise]
    test_xy, test_theta = (
        of_map.test(USUAL_LEVEL / max(sum(tested), 1)) for of_map in (xy, theta)
    )
    o, r = (
        getattr(pair[1], name) - getattr(pair[0], name)
        for name in ("nonorthogonality", "scale_difference")
    )
    dx, dy = xy.values
    return MapDifference(
        dx=dx,
        dy=dy,
        d_theta=theta.values[0],
        translation_m=(float(xy.datum[0]), float(xy.datum[1])),
        rotation_rad=float(xy.datum[2]),
        scale=0.0 if keep_scale else float(xy.datum[3]),
        theta_rad=float(theta.datum[0]),
        nonorthogonality=o,
        scale_difference=r,
        xy=test_xy,
        theta=test_theta,
        u_beyond_m=float("nan") if test_xy is None else xy.u_beyond,
    )


@dataclass(frozen=True, eq=False)
class _Difference:
    """One map minus another, (parts, *places), the datum difference removed, and its noise."""

    values: np.ndarray
    datum: np.ndarray
    noise: ReducedNoise | None

    def test(self, level: float) -> Significance | None:
        """Return the test of the known values; None if they are too few or have no noise."""
        if self.noise is None:
            return None
        known_values = self.values[np.isfinite(self.values)]
        return significance(known_values, self.noise, level=level)

    @property
    def u_beyond(self) -> float:
        """Standard uncertainty of the part of the rms of the values beyond that of noise.

        The mean square of noise of n values scatters by u^2 sqrt(2/n).
        """
        assert self.noise is not None
        noise = self.noise
        scatter = 2 / noise.independent + 2 / noise.dof
        return float(np.sqrt(noise.variance.mean()) * scatter**0.25)


def _difference(
    results: Sequence[CalibrationResult],
    maps: Sequence[ErrorMap],
    kind: str,
    *,
    plates: bool,
    scale: bool,
) -> _Difference:
    """Return the second map minus the first."""
    (old, _), (new, _) = (emap.of(kind) for emap in maps)
    known_places = np.isfinite(new - old).all(axis=0)
    columns = datum_columns(maps[0].artifact, kind, known_places, scale=scale)
    out = np.full(old.shape, np.nan)
    if not known_places.any():
        return _Difference(out, np.full(columns.shape[1], np.nan), None)

    values = (new - old)[:, known_places].ravel()
    size = np.linalg.norm(columns, axis=0)
    datum = np.linalg.lstsq(columns / size, values, rcond=None)[0] / size
    values = values - columns @ datum
    out[:, known_places] = values.reshape(len(out), -1)
    if known_places.sum() < 2:
        return _Difference(out, datum, None)

    covariances = [
        covariance_of(result, kind, known_places, plate=plates) for result in results
    ]
    if kind == "xy" and not scale and not plates:
        length = _length_in_both(results, known_places)
        covariances = [
            covariance
            - (np.outer(length, length) if covariance.ndim == 2 else length**2)
            for covariance in covariances
        ]
    total = np.sum(of_one_kind(covariances), axis=0)
    power = [float(np.nan_to_num(rms(emap.of(kind)[1]))) ** 2 for emap in maps]
    dof = joint_dof(
        *zip(
            power,
            [getattr(result.noise, f"dof_{kind}") for result in results],
            strict=True,
        )
    )
    return _Difference(out, datum, ReducedNoise(total, columns, dof))


def _length_in_both(
    results: Sequence[CalibrationResult], known_sites: np.ndarray
) -> np.ndarray:
    """Return what u of a length that sets the scale of both maps adds to Gx, then Gy, (2n,), m."""
    lattice = results[0].artifact
    place = np.concatenate([lattice.x_m[known_sites], lattice.y_m[known_sites]])
    references = [
        result.reference
        for result in results
        if result.reference and not result.recheck
    ]
    return (length_in_both(*references) if len(references) == 2 else 0.0) * place


def require_same_lattice(a: Artifact, b: Artifact, names: tuple[str, str]) -> None:
    """Raise InputError unless both maps have the same lattice."""
    for items, of_first, of_second in (
        ("sites", a.shape, b.shape),
        ("angular lines", a.angular_count, b.angular_count),
    ):
        if of_first != of_second:
            raise InputError(
                f"{names[0]} and {names[1]}",
                f"the lattices differ: {of_first} and {of_second} {items}",
                "compare maps of the same plate",
            )
    if a.marks != b.marks:
        raise InputError(
            f"{names[0]} and {names[1]}",
            "the lists of marks differ",
            "compare maps of the same plate",
        )
    if abs(a.grid_pitch_m - b.grid_pitch_m) > GAP * a.grid_pitch_m:
        raise InputError(
            f"{names[0]} and {names[1]}",
            f"the lattices differ: pitches of {a.grid_pitch_m * MM_PER_M:.9g} and "
            f"{b.grid_pitch_m * MM_PER_M:.9g} mm",
            "compare maps of the same plate",
        )


def joint_dof(*contributions: tuple[float, float]) -> float:
    """Return the degrees of freedom of a sum of variances (Welch-Satterthwaite).

    A variance without degrees of freedom, one of declared noise, counts as known.
    """
    total = sum(variance for variance, _ in contributions)
    of_contributions = sum(
        variance**2 / (dof if dof > 0 else np.inf) for variance, dof in contributions
    )
    return float(total) ** 2 / max(float(of_contributions), float(np.finfo(float).tiny))


@dataclass(frozen=True)
class LaserDifference:
    """A first-order term of map and laser: squareness as O, or scale as R.

    `difference` is laser minus map; `u` its standard uncertainty, NaN if unknown; `p` the
    two-sided probability of such a difference.
    """

    name: str
    of_map: float
    of_laser: float
    u: float
    p: float

    @property
    def difference(self) -> float:
        """Laser minus map."""
        return self.of_laser - self.of_map


@one_thread()
def compare_with_laser(
    result: CalibrationResult, laser: dict, where: str
) -> list[LaserDifference]:
    """Compare O and R of a map with a step-diagonal measurement.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    laser : dict
        OUT.json of `selfcal step-diagonal`; its ``error_map_equivalent`` is read.
    where : str
        File name, for messages.

    Raises
    ------
    InputError
        If the laser's result has no first-order terms of an error map.
    """
    equivalent = laser.get("error_map_equivalent")
    if not isinstance(equivalent, dict) or equivalent.get("nonorthogonality") is None:
        raise InputError(
            where,
            "no error_map_equivalent with a nonorthogonality",
            "give an OUT.json of a 2D measurement that `selfcal step-diagonal` wrote",
        )
    of_map = {
        "nonorthogonality": result.error_map.nonorthogonality,
        "scale_difference": result.error_map.scale_difference,
    }
    u_map = first_order_u(result)
    out = []
    for (name, value), u_of_map in zip(of_map.items(), u_map, strict=True):
        if equivalent.get(name) is None:
            continue
        u_laser = equivalent.get(f"u_{name}")
        u = float(np.hypot(u_of_map, np.nan if u_laser is None else u_laser))
        gap = abs(float(equivalent[name]) - value)
        p = 2 * float(ndtr(-gap / u)) if u > 0 else float("nan")
        out.append(LaserDifference(name, value, float(equivalent[name]), u, p))
    return out
