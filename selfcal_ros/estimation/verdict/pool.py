# SPDX-License-Identifier: Apache-2.0
"""What columns explain of the residuals together, and what they leave (method eqs. 7.7, 7.8)."""

from collections.abc import Iterator, Sequence
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
    between, dof_between : float
        Squares of the marks' means beside them, m^2, and their degrees of freedom.
    """

    rows: np.ndarray
    at: np.ndarray
    own_inverse: np.ndarray
    rank: int
    own_values: np.ndarray
    explained: float
    between: float
    dof_between: float

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
    """All candidate columns at once, and the residuals that they are to explain.

    Attributes
    ----------
    equations : TermEquations
        All columns.
    right : Score
        What they can explain.
    prior : float array (p,)
        Information on each coefficient of the model that its size gives; 0 of all others.
    taken : float array (p,)
        Coefficients that the model has.
    """

    equations: TermEquations
    right: Score
    prior: np.ndarray
    taken: np.ndarray

    def beside(self, rows: np.ndarray) -> Beside:
        """Return what the columns of `rows`, bool (p,), explain together."""
        return self.each([rows])[0]

    def each(self, many: Sequence[np.ndarray]) -> list[Beside]:
        """Return what each of many sets of columns, bool (p,), explains by itself.

        Sets of one size are worked out together: for few columns a call costs more than its work.
        """
        places = [rows.nonzero()[0] for rows in many]
        found: dict[int, Beside] = {}
        for size in {len(at) for at in places}:
            mine = [number for number, at in enumerate(places) if len(at) == size]
            limits = np.array([self.equations.limit(many[number] & (self.prior == 0))
                               for number in mine])
            blocks = self._of_one_size(np.array([places[number] for number in mine]), limits)
            for number, block in zip(mine, blocks, strict=True):
                found[number] = Beside(many[number], places[number], *block)
        return [found[number] for number in range(len(many))]

    def _of_one_size(self, at: np.ndarray, limits: np.ndarray) -> Iterator[tuple]:
        """Yield what `Beside` has of the columns `at`, int (n, k), less the columns themselves.

        Their eigenvalues up to `limits`, (n,), count as 0.
        """
        sums, square = self.right.sums, (at[:, :, None], at[:, None, :])
        values, vectors = np.linalg.eigh(self._scaled[square])
        told = values > limits[:, None]
        vectors = vectors / self._norm[at][:, :, None]
        inverse = (vectors * (told / np.where(told, values, 1.0))[:, None]) @ vectors.swapaxes(1, 2)
        right, gram = self._total[at], self.equations.projected.gram[square]
        own = (inverse @ right[:, :, None])[:, :, 0]
        left = (gram @ own[:, :, None])[:, :, 0] - 2 * self.right.between[at]
        between = sums.between + (own * left).sum(axis=1)
        dof = sums.dof_between - (inverse * gram).sum(axis=(1, 2))
        explained = (right * own).sum(axis=1)
        return zip(inverse, told.sum(axis=1).tolist(), own, explained.tolist(), between.tolist(),
                   dof.tolist(), strict=True)

    @cached_property
    def _scaled(self) -> np.ndarray:
        """The information of columns of unit length, (p, p)."""
        information = self.equations.information + np.diag(self.prior)
        return information / np.outer(self._norm, self._norm)

    @cached_property
    def _norm(self) -> np.ndarray:
        return np.hypot(self.equations.norm, np.sqrt(self.prior))

    @cached_property
    def _total(self) -> np.ndarray:
        return self.right.total - self.prior * self.taken

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
        sums, between, dof = self.right.sums, beside.between, beside.dof_between
        both = sums.dof - beside.rank
        if sums.dof_within >= 1 and both > 0:
            total = (sums.total - beside.explained) / both
            if dof <= 0 or between / dof <= total:
                return max(total, 0.0), both
        return (max(between, 0.0) / dof, dof) if dof > 0 else (float("nan"), 0.0)
