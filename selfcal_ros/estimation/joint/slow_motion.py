# SPDX-License-Identifier: Apache-2.0
"""Motion that the marks of an image share and that is slow: more of it at long periods.

An image shows what its marks have in common apart from each of them, in a single pass as well. Slow
motion moves neighbours in time alike, so that what images of a view have in common is correlated.
The fit hides most of it, as it looks like the pose, a strain or a drift of the plate: from what
draws of white and of slow motion leave follows how much there was (method eq. 4.18).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg import toeplitz
from scipy.special import stdtr

from selfcal_ros.estimation.checks.wiring import F_LEVEL
from selfcal_ros.estimation.joint.images import fitted_alone
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.normal.angular import FLOOR
from selfcal_ros.estimation.normal.equations import N_DRAWS, TRACE, NormalEquations
from selfcal_ros.estimation.terms.visits import TermInputs, ViewVisits

LEAST = 4
"""Exposures of a view for each coefficient of its drift, below which they show no slow motion."""


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of one placing of the plate, in their order.

    Attributes
    ----------
    rows : tuple of int
        Its views: the cells of its images.
    visits : tuple of ViewVisits
        What each of them saw; together they have n readings.
    degree : int
        Of the drift that is taken out.
    """

    rows: tuple[int, ...]
    visits: tuple[ViewVisits, ...]
    degree: int

    @cached_property
    def row(self) -> np.ndarray:
        """View of each reading, int (n,)."""
        return np.repeat(self.rows, [len(of_row.mark) for of_row in self.visits])

    @cached_property
    def mark(self) -> np.ndarray:
        """Flat index of the mark of each reading, int (n,)."""
        return np.concatenate([of_row.mark for of_row in self.visits])

    @cached_property
    def root(self) -> np.ndarray:
        """Square root of the weight of each reading, (n,)."""
        return np.sqrt(np.concatenate([of_row.weight for of_row in self.visits]))

    @cached_property
    def exposure(self) -> np.ndarray:
        """Index of the exposure of each reading, int (n,)."""
        time = np.concatenate([of_row.time for of_row in self.visits])
        return np.unique(time, return_inverse=True)[1]

    @cached_property
    def number(self) -> int:
        """Number of exposures, E."""
        return int(self.exposure.max()) + 1

    @cached_property
    def _drift(self) -> np.ndarray:
        """Orthonormal polynomials of the time, (E, degree + 1)."""
        time = np.linspace(-1, 1, self.number)
        return np.linalg.qr(legvander(time, self.degree))[0]

    @cached_property
    def _marks(self) -> np.ndarray:
        """Number of marks of each exposure that count, (E,)."""
        return np.maximum(np.bincount(self.exposure, self.root > 0), 1)

    def sums(self, weighted: np.ndarray) -> np.ndarray:
        """Return the sum over the marks of each exposure, complex (k, E), of values (k, n)."""
        out = np.zeros((len(weighted), self.number), dtype=complex)
        np.add.at(out.T, self.exposure, weighted.T)
        return out

    def common(self, about: Sequence[np.ndarray], residuals: np.ndarray) -> np.ndarray:
        """Return what the marks of each exposure have in common beside a drift, complex (E,).

        Parameters
        ----------
        about : sequence of complex array (V,)
            What the visits of each of its views have more than the means of their marks.
        residuals : complex array (views, marks)
            What a fit leaves of the means.
        """
        left = np.concatenate(about) + residuals[self.row, self.mark]
        common = self.sums((self.root * left)[None])[0] / self._marks
        return common - self._drift @ (self._drift.T @ common)


@dataclass(frozen=True, eq=False)
class SlowMotion:
    """Slow motion of the images.

    Attributes
    ----------
    exposures : tuple of Exposures
        The exposures of each placing.
    slow, white : float
        Variances of slow motion, and of white motion beyond that of the noise of images, over that
        of a reading: the second is negative.
    """

    exposures: tuple[Exposures, ...]
    slow: float
    white: float

    def added(self, sensitivities: np.ndarray) -> np.ndarray:
        """Return what it adds to variances, (k,), for unit noise; none becomes smaller.

        Parameters
        ----------
        sensitivities : complex array (k, views, nx, ny)
            Sensitivities of k coordinates over the weights, see `added_variances`.
        """
        flat = sensitivities.reshape(*sensitivities.shape[:2], -1)
        total = np.zeros(len(flat))
        for of_placing in self.exposures:
            n = of_placing.number
            common = of_placing.sums(
                of_placing.root * flat[:, of_placing.row, of_placing.mark]
            )
            power = abs(np.fft.fft(common, 2 * n)) ** 2
            products = np.fft.ifft(power).real[:, :n]
            covariance = 2 * self.slow * slow_correlation(n)
            covariance[0] = self.slow + self.white
            total += products @ covariance
        return np.maximum(total, 0.0)


def slow_correlation(n: int) -> np.ndarray:
    """Return the correlation of motion with a power of 1/f, by its distance in n exposures."""
    return n * np.fft.irfft(_power(n), 2 * n)[:n]


def _power(n: int) -> np.ndarray:
    """Return the powers of the waves of slow motion in twice n exposures, (n + 1,), 1 together."""
    power = np.zeros(n + 1)
    power[1:n] = 1 / np.arange(1, n)
    return power / power.sum()


def slow_motion(model: ModelFit) -> SlowMotion | None:
    """Return the slow motion that residuals show; None without images, or if it is white."""
    images, system = model.problem.images, model.problem.system
    sigma = model.fitted.xy.sigma
    if images is None or not sigma > FLOOR:
        return None
    inputs = model.problem.inputs
    exposures = _exposures(inputs, LEAST * (inputs.drift_degree + 1))
    about = {row: values for row, _, values in model.visits_about_means()}
    residuals = model.fitted.residuals
    of_marks = residuals.reshape(len(residuals), -1)
    found = _products(
        of_placing.common([about[row] for row in of_placing.rows], of_marks)
        for of_placing in exposures
    )
    if not found[1] > 0:  # below what white motion leaves of itself
        return None
    noises = images.noises(residuals)
    drawn = _drawn(system, exposures)
    both = np.array([noises.mark**2, noises.image**2, noises.mark * noises.image])
    squares, neighbours = np.tensordot(both, drawn[:, :3], axes=(0, 1)).T
    of_white = neighbours / squares
    beyond = found[1] / found[0] - of_white.mean()
    spread = of_white.std(ddof=1) * np.sqrt(1 + 1 / N_DRAWS)
    if not stdtr(N_DRAWS - 1, -beyond / spread) < F_LEVEL:
        return None
    of_mark, of_image, _, of_slow = drawn.mean(axis=0)
    rest = found - noises.mark**2 * of_mark
    white, slow = np.linalg.solve(np.stack([of_image, of_slow], axis=1), rest)
    if white < 0:
        white, slow = 0.0, rest[0] / of_slow[0]
    return SlowMotion(exposures, slow / sigma**2, (white - noises.image**2) / sigma**2)


@dataclass(frozen=True, eq=False)
class MotionOfStops:
    """What motion makes of the means of the stops of a stage.

    Attributes
    ----------
    covariance : float array (stops, stops)
        Of the means, over what white motion of the same size makes of each.
    shown, dof : float
        Variance of the exposures of one stop about its mean, and its degrees of freedom, over those
        of white motion: 1 both if nothing is slow. No degrees of freedom if no stop was visited
        again: what is slow does not show in exposures of one visit.
    """

    covariance: np.ndarray
    shown: float
    dof: float

    @classmethod
    def of(cls, inputs: TermInputs, stop: np.ndarray, slow: float) -> "MotionOfStops":
        """Return it for the stop of each mark, int (views, nx, ny), -1 if it was not read.

        `slow` is the part of the motion that is slow, in the order of the visits.
        """
        n_stops = int(stop.max()) + 1
        of_marks = stop.reshape(len(stop), -1)
        covariance = np.eye(n_stops)
        white = within = squares = 0.0
        for one in _exposures(inputs, 1) if slow else ():
            weight = np.zeros((n_stops, one.number))
            np.add.at(weight, (of_marks[one.row, one.mark], one.exposure), one.root**2)
            used = np.flatnonzero(weight.any(axis=1))
            gain = np.sqrt(weight[used] / weight[used].sum(axis=1, keepdims=True))
            correlation = toeplitz(slow_correlation(one.number))
            motion = slow * correlation + (1 - slow) * np.eye(one.number)
            covariance[np.ix_(used, used)] = gain @ motion @ gain.T
            about = np.diag(weight.any(axis=0).astype(float)) - gain.T @ gain
            left = about @ motion @ about
            white += about.trace()
            within += left.trace()
            squares += (left**2).sum()
        if not within > TRACE * len(covariance):  # no repeats
            return cls(covariance, 1.0, 0.0 if slow else 1.0)
        return cls(covariance, within / white, within**2 / (white * squares))


def _products(common: Iterable[np.ndarray]) -> np.ndarray:
    """Return the sum of squares of what exposures have in common, and that by its neighbour's."""
    products = np.zeros(2)
    for values in common:
        products += (
            np.vdot(values, values).real,
            np.vdot(values[:-1], values[1:]).real,
        )
    return products


def _exposures(inputs: TermInputs, least: int) -> tuple[Exposures, ...]:
    """Return the exposures of each placing that has more than `least` of them."""
    out = []
    for members in inputs.members.values():
        seen = [
            (row, visits)
            for row in members
            if (visits := inputs.visits[row]) is not None
        ]
        if not seen:
            continue
        rows, of_rows = zip(*seen, strict=True)
        of_placing = Exposures(rows, of_rows, inputs.drift_degree)
        if of_placing.number > least:
            out.append(of_placing)
    return tuple(out)


def _drawn(system: NormalEquations, exposures: tuple[Exposures, ...]) -> np.ndarray:
    """Return the products for unit noise, (draws, 4, 2).

    For that of marks, for white motion of images, for both together less these, for slow motion.
    """
    drawn = _drawn_before.setdefault(system, {})
    key = tuple(
        (one.rows, one.mark.tobytes(), one.exposure.tobytes()) for one in exposures
    )
    if key not in drawn:
        rng = np.random.default_rng(0)
        drawn[key] = np.array([_draw(system, exposures, rng) for _ in range(N_DRAWS)])
    return drawn[key]


_drawn_before: WeakKeyDictionary[NormalEquations, dict[tuple, np.ndarray]] = (
    WeakKeyDictionary()
)
"""Products of systems by their exposures; they must not refer to the system."""


def _draw(
    system: NormalEquations,
    exposures: tuple[Exposures, ...],
    rng: np.random.Generator,
) -> np.ndarray:
    """Return the products of one draw, (4, 2), see `_drawn`."""
    noises = zip(
        *(
            (
                _complex(rng, len(one.mark)),
                _complex(rng, one.number)[one.exposure],
                _slow(rng, one.number)[one.exposure],
            )
            for one in exposures
        ),
        strict=True,
    )
    marks, white, slow = (_left(system, exposures, noise) for noise in noises)
    of_marks, of_white, of_slow = map(_products, (marks, white, slow))
    of_both = _products(map(np.add, marks, white))
    return np.array([of_marks, of_white, of_both - of_marks - of_white, of_slow])


def _complex(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return white noise of unit size in each coordinate, complex (n,)."""
    return rng.normal(size=(n, 2)) @ [1, 1j]


def _slow(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return slow motion of unit size in each coordinate, complex (n,)."""
    size = np.sqrt(_power(n))
    x, y = (n * np.fft.irfft(size * _complex(rng, n + 1), 2 * n)[:n] for _ in "xy")
    return x + 1j * y


def _left(
    system: NormalEquations, exposures: Sequence[Exposures], noise: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """Return what a fit leaves of noise in common to exposures, complex (E,) of each placing.

    The noise is that of the readings over their own, complex (n,) of each placing.
    """
    grid = system.grid
    means = np.zeros((len(grid.read), grid.n_marks), dtype=complex)
    about = []
    for one, values in zip(exposures, noise, strict=True):
        y = values / np.where(one.root > 0, one.root, 1.0)
        of_placing = []
        for row, visits in zip(one.rows, one.visits, strict=True):
            of_row = y[one.row == row][None]
            means[row] = visits.means(of_row, grid.n_marks)[0]
            of_placing.append(visits.about_means(of_row, grid.n_marks)[0])
        about.append(of_placing)
    residuals = fitted_alone(system, means.reshape(grid.read.shape)[grid.read])[0]
    left = residuals.reshape(means.shape)
    return [
        one.common(of_placing, left)
        for one, of_placing in zip(exposures, about, strict=True)
    ]
