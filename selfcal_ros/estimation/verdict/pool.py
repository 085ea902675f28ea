# SPDX-License-Identifier: Apache-2.0
"""What columns explain of the residuals together, and what they leave (method eqs. 7.7, 7.8)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.estimation.terms.equations import TermEquations
from selfcal_ros.estimation.terms.solution import Score


@dataclass(frozen=True, eq=False)
class Beside:
    """What columns explain together.

    Attributes
    ----------
    rows : bool array (p,)
        Which columns they are, k of p.
    at : int array (k,)
        The same as numbers.
    own_inverse : float array (k, k)
        Pseudo-inverse of their information.
    rank : int
        Its rank.
    own_values : float array (k,)
        Their estimated coefficients.
    explained : float
        The sum of squares that they explain, m^2.
    """

    rows: np.ndarray
    at: np.ndarray
    own_inverse: np.ndarray
    rank: int
    own_values: np.ndarray
    explained: float

    @property
    def inverse(self) -> np.ndarray:
        """The pseudo-inverse among all columns, (p, p)."""
        out = np.zeros((len(self.rows),) * 2)
        out[self.at[:, None], self.at] = self.own_inverse
        return out

    @property
    def values(self) -> np.ndarray:
        """The estimates among all columns, (p,)."""
        out = np.zeros(len(self.rows))
        out[self.at] = self.own_values
        return out


@dataclass(frozen=True, eq=False)
class Pool:
    """All candidate columns at once, and the residuals that they are to explain."""

    equations: TermEquations
    right: Score

    def beside(self, rows: np.ndarray) -> Beside:
        """Return what the columns of `rows`, bool (p,), explain together."""
        at = rows.nonzero()[0]
        if not len(at):
            return Beside(rows, at, np.zeros((0, 0)), 0, np.zeros(0), 0.0)
        values, vectors = np.linalg.eigh(self._scaled[at[:, None], at])
        told = values > self.equations.limit(rows)
        vectors = vectors[:, told] / self.equations.norm[at, None]
        inverse = (vectors / values[told]) @ vectors.T
        right = self._total[at]
        own = inverse @ right
        return Beside(rows, at, inverse, vectors.shape[1], own, float(right @ own))

    @cached_property
    def _scaled(self) -> np.ndarray:
        """The information of columns of unit length, (p, p)."""
        return self.equations.information / np.outer(self.equations.norm, self.equations.norm)

    @cached_property
    def _total(self) -> np.ndarray:
        return self.right.total

    @cached_property
    def everything(self) -> tuple[float, float]:
        """Squares of all residuals, m^2, and their degrees of freedom, without any column."""
        sums = self.right.sums
        return (sums.total, sums.dof) if sums.dof_within >= 1 else (sums.between,
                                                                   sums.dof_between)

    def noise(self, beside: Beside) -> tuple[float, float]:
        """Return the variance of one reading that columns leave, m^2, and its dof.

        Visits of one mark agree better than marks do where a cause is not held: the larger counts.
        NaN and 0 where the columns take all degrees of freedom.
        """
        sums, at, values = self.right.sums, beside.at, beside.own_values
        gram = self.equations.projected.gram[at[:, None], at]
        between = float(sums.between - 2 * values @ self.right.between[at] + values @ gram @ values)
        dof = sums.dof_between - float(np.vdot(beside.own_inverse, gram))
        both = sums.dof - beside.rank
        if sums.dof_within >= 1 and both > 0:
            total = (sums.total - beside.explained) / both
            if dof <= 0 or between / dof <= total:
                return max(total, 0.0), both
        return (max(between, 0.0) / dof, dof) if dof > 0 else (float("nan"), 0.0)
