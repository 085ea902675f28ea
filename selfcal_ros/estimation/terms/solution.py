# SPDX-License-Identifier: Apache-2.0
"""Coefficients of the terms from the residuals of an estimate, and the remaining noise."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.terms.equations import TermEquations


@dataclass(frozen=True, eq=False)
class Sums:
    """Weighted sums of squared residuals, m^2, with their degrees of freedom.

    `between`: residuals of the marks' means; `within`: visits about the mean of their mark.
    """

    between: float
    dof_between: float
    within: float
    dof_within: float

    @property
    def total(self) -> float:
        """Both together."""
        return self.between + self.within

    @property
    def dof(self) -> float:
        """Degrees of freedom of both together."""
        return self.dof_between + self.dof_within


@dataclass(frozen=True, eq=False)
class Score:
    """Part of the residuals of an estimate that missing columns can explain.

    Attributes
    ----------
    between, within : float array (p,)
        Inner products c' W e of the marks' means, and those within marks.
    sums : Sums
        Sums of squares of the estimate without the columns.
    """

    between: np.ndarray
    within: np.ndarray
    sums: Sums

    @property
    def total(self) -> np.ndarray:
        """Right-hand side of the coefficients, (p,)."""
        return self.between + self.within


def score(equations: TermEquations, residuals: tuple[np.ndarray, np.ndarray],
          squares: tuple[float, float], *, coefficients: np.ndarray | None = None) -> Score:
    """Return the right-hand side of the remaining coefficients.

    Parameters
    ----------
    equations : TermEquations
        The columns.
    residuals : tuple of array
        Residuals of the estimate from deviations minus `coefficients` columns: of the marks, plate
        frame, m, complex (views, nx, ny), and of the lines, rad, (views, K).
    squares : tuple of float
        Weighted squares of all residuals, angular ones included, m^2, and their degrees of
        freedom without terms.
    coefficients : float array (p,), optional
        Coefficients already subtracted.
    """
    columns, weight = equations.columns, equations.system.grid.weight
    shapes = columns.shapes
    within = columns.within
    taken = np.zeros(equations.n) if coefficients is None else coefficients
    between = shapes.against(shapes.sums(weight * residuals[0]))
    between[columns.lines.at] += equations.line_weight * columns.lines.sums(
        equations.system.angular.weight * residuals[1])
    inner = within.total - 2 * taken @ within.right + taken @ within.gram @ taken
    sums = Sums(*squares, float(inner), within.dof)
    return Score(between, within.right - within.gram @ taken, sums)


def residual_sums(equations: TermEquations, found: Score) -> Sums:
    """Return the residuals of all columns with free coefficients.

    The noise comes from this fit: a size that is too small would leave part of its term.
    """
    inverse = free_inverse(equations)
    more = inverse @ found.total
    gram, within = equations.projected.gram, equations.columns.within.gram
    between = found.sums.between - 2 * more @ found.between + more @ gram @ more
    inner = found.sums.within - 2 * more @ found.within + more @ within @ more
    return Sums(max(float(between), 0.0), found.sums.dof_between - float(np.sum(inverse * gram)),
                max(float(inner), 0.0), found.sums.dof_within - float(np.sum(inverse * within)))


def free_inverse(equations: TermEquations) -> np.ndarray:
    """Return the pseudo-inverse of the information: covariance of free coefficients."""
    everything = np.ones(equations.n, dtype=bool)
    untold = equations.untold(everything)
    scaled = equations.information / np.outer(equations.norm, equations.norm)
    held = np.linalg.inv(scaled + untold @ untold.T) - untold @ untold.T
    return held / np.outer(equations.norm, equations.norm)


def next_coefficients(equations: TermEquations, found: Score, coefficients: np.ndarray,
                      sigma_m: float) -> np.ndarray:
    """Return the coefficients from the score, (p,), with sizes as prior knowledge.

    Parameters
    ----------
    equations : TermEquations
        The columns.
    found : Score
        Score at `coefficients`.
    coefficients : float array (p,)
        Present coefficients of the estimate.
    sigma_m : float
        Noise of one grid reading, m.
    """
    prior = equations.prior(sigma_m)
    return coefficients + equations.inverse(sigma_m) @ (found.total - prior * coefficients)
