# SPDX-License-Identifier: Apache-2.0
"""Whether a map has changed, and how large a change is found (method eq. 13.4).

Three statistics of the same change: one for a change at all nodes, one for a change at few, one for
a smooth change. Draws of the change's noise give the probability of the most telling of the three;
every other one tells how large a change is found.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import chdtrc, fdtrc, i0e, stdtr

from selfcal_ros.estimation.comparison.maps import DRAWS, NO_VARIANCE, Spread
from selfcal_ros.model.error_map import MANY_DOF, rms
from selfcal_ros.model.recheck import Detectable

FEW, LARGE = 3.0, 3.0
"""Number of changed nodes, and their change in standard uncertainties, of the second statistic."""

TAIL = 0.005
"""Probability below which draws are too few, and a bound of it counts if that is smaller."""

ORDER = 2
"""Degree of the polynomials of the third statistic."""

POWER = 0.9
"""Part of the changes of the size stated as found that are found."""


@dataclass(frozen=True, eq=False)
class ChangeTests(Spread):
    """Statistics of changes of a map, Gx first, then Gy, (2n,), without what the datum removes.

    Attributes
    ----------
    places : complex array (n,)
        Nodes, in any unit.
    """

    places: np.ndarray

    @cached_property
    def _smooth(self) -> np.ndarray:
        """Orthonormal polynomials of both coordinates that are free from `removed`, (2n, k)."""
        z = self.places / np.abs(self.places).max()
        columns = np.stack([z.real**i * z.imag**j for i in range(ORDER + 1)
                            for j in range(ORDER + 1 - i)], axis=1)
        basis, size, _ = np.linalg.svd(self.without(np.kron(np.eye(2), columns)),
                                       full_matrices=False)
        return basis[:, size > np.sqrt(NO_VARIANCE) * size[0]]

    @cached_property
    def _whiten_smooth(self) -> np.ndarray:
        """Rows from a change to its polynomials, of variance 1 and independent, (k, 2n)."""
        factor = np.linalg.cholesky(self._smooth.T @ self.remaining @ self._smooth)
        return np.linalg.solve(factor, self._smooth.T)

    def of(self, values: np.ndarray) -> np.ndarray:
        """Return the three statistics of changes (2n, draws), (3, draws)."""
        ratio = values / self.u[:, None]
        few = np.hypot(*ratio.reshape(2, -1, ratio.shape[1]))
        part = FEW / len(few)
        likelier = np.logaddexp(np.log1p(-min(part, 0.5)), np.log(part) + LARGE * few
                                - LARGE**2 / 2 + np.log(i0e(LARGE * few)))
        return np.stack([self.squares(ratio), likelier.sum(axis=0),
                         ((self._whiten_smooth @ values) ** 2).sum(axis=0)])

    @cached_property
    def _noise(self) -> np.ndarray:
        """Changes that are noise only, (2n, DRAWS), m."""
        return self.u[:, None] * self.drawn

    @cached_property
    def _ranked(self) -> tuple[np.ndarray, np.ndarray]:
        """Statistics of noise, each in order, (3, DRAWS), and the least rank from above, sorted."""
        statistics = self.of(self._noise)
        ranks = DRAWS - np.argsort(np.argsort(statistics, axis=1), axis=1)
        return np.sort(statistics, axis=1), np.sort(ranks.min(axis=0))

    def p(self, values: np.ndarray) -> float:
        """Return the probability of as significant a change, (2n,), if there is none."""
        statistics, (drawn, least) = self.of(values[:, None])[:, 0], self._ranked
        rank = min(DRAWS - int(np.searchsorted(row, statistic)) + 1
                   for row, statistic in zip(drawn, statistics, strict=True))
        p = (1 + int(np.searchsorted(least, rank, side="right"))) / (1 + DRAWS)
        return float(p) if p > TAIL else min(float(p), self._bound(values, statistics))

    def _bound(self, values: np.ndarray, statistics: np.ndarray) -> float:
        """Return a bound of the probability, close where it is small (Bonferroni)."""
        dof, n = min(self.dof, MANY_DOF), len(self.u)
        each = [2 * n * float(stdtr(dof, -np.abs(values / self.u).max()))]
        for square, free in ((statistics[0], self.rank),
                             (statistics[2], self._smooth.shape[1])):
            each.append(float(fdtrc(free, dof, square / free) if self.dof <= MANY_DOF
                              else chdtrc(free, square)))
        return min(3 * min(each), 1.0)

    def detectable(self, level: float) -> Detectable:
        """Return the changes of which POWER are found if the tests have a level.

        At one node, any node and direction; and a smooth one, any polynomial.
        """
        drawn, least = self._ranked
        rank = int(least[max(int(level * DRAWS) - 1, 0)])
        limits = drawn[:, -rank][:, None]
        rng, noise = np.random.default_rng(1), self._noise[:, ::2]
        n, number = len(self.places), np.arange(noise.shape[1])
        at, turn = rng.integers(n, size=len(number)), 2 * np.pi * rng.random(len(number))
        one = np.zeros(noise.shape)
        one[at, number], one[at + n, number] = np.cos(turn), np.sin(turn)
        smooth = self._smooth @ rng.standard_normal((self._smooth.shape[1], len(number)))
        smooth /= np.sqrt((smooth**2).mean(axis=0))
        return Detectable(*(self._size(self.without(shape), noise, limits)
                            for shape in (one, smooth)))

    def _size(self, shape: np.ndarray, noise: np.ndarray, limits: np.ndarray) -> float:
        """Return the size of a change of given shape of which POWER are found, by bisection."""
        low, high = 0.0, 20 * rms(self.u)
        for _ in range(10):
            size = (low + high) / 2
            enough = (self.of(noise + size * shape) >= limits).any(axis=0).mean() >= POWER
            low, high = (low, size) if enough else (size, high)
        return high
