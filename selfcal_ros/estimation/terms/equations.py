# SPDX-License-Identifier: Apache-2.0
"""The equations of the terms' coefficients: which are determined, their values and covariance."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.terms.columns import TermColumns
from selfcal_ros.estimation.terms.projection import (
    ProjectedColumns,
    ReducedColumns,
    project,
    reduce_columns,
)

UNTOLD = 1e-9
"""Relative size below which an eigenvalue of the scaled equations is zero."""

ROUNDED = 1e-12
"""The same of one that is rounding alone: exact lines leave others of 1e-9 that are told."""

LEAST_NOISE_M = 1e-12
"""Smallest noise against which sizes are weighted, m: less is rounding."""

OVER_NOISE = 100.0
"""Ratio of the variance of the offsets to that of their noise from which they determine a
microscope: below, they would be dominated by their own noise, which is in the readings as well."""

MOVES_THE_MAP = 1e-5
"""Relative rms of the map above which a combination of columns that cannot be seen is an
undetermined mode: rounding gives 1e-9, the smallest true ones 1e-2."""

NO_VARIANCE = 1e-12
"""Relative size below which a variance is zero."""

FREE = ""
"""Name of the part of a covariance that all free terms have together."""


@dataclass(frozen=True, eq=False)
class TermEquations:
    """Normal equations of the coefficients with map, plate and misalignments eliminated.

    For unit noise of one grid reading; p coefficients.

    Attributes
    ----------
    system : NormalEquations
        The measured plan.
    columns : TermColumns
        The terms.
    projected : ProjectedColumns
        Their effect on the estimate.
    noise_m : float
        Noise of one grid reading, m, which is that of the microscope's offsets; 0 if unknown.
    line_weight : float
        Weight of a line reading with weight 1 relative to a grid reading, rad^-2 m^2.
    """

    system: NormalEquations
    columns: TermColumns
    projected: ProjectedColumns
    noise_m: float = 0.0
    line_weight: float = 0.0

    @property
    def n(self) -> int:
        """Number of coefficients."""
        return len(self.columns.columns)

    @cached_property
    def information(self) -> np.ndarray:
        """Information from the readings, without sizes, (p, p): c' W r + within."""
        return self.projected.gram + self.columns.within.gram

    @cached_property
    def norm(self) -> np.ndarray:
        """Root of the weighted square of every column before elimination, (p,).

        The reference for what is determined: the remainder may be mere rounding.
        """
        grid = self.columns.shapes.squares(self.system.grid.weight)
        lines = self.columns.lines
        grid[lines.at] += self.line_weight * lines.sums(self.system.angular.weight, 2)
        return np.sqrt(np.maximum(grid + np.diag(self.columns.within.gram),
                                  np.finfo(float).tiny))

    @property
    def free(self) -> np.ndarray:
        """Coefficients to be determined by the readings alone, bool (p,)."""
        return np.isinf(self.columns.size)

    def untold(self, rows: np.ndarray, limit: float | None = None) -> np.ndarray:
        """Return undetermined combinations of the coefficients `rows`, (p, k).

        Orthonormal in scaled coefficients (times `norm`); others are taken as known. Eigenvalues
        up to `limit`, by default that of `rows`, count as zero.
        """
        values, vectors = self._spectrum if rows.all() else self._spectrum_of(rows)
        hidden = values <= (self.limit(rows) if limit is None else limit)
        out = np.zeros((len(rows), int(hidden.sum())))
        out[rows] = vectors[:, hidden]
        return out

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and eigenvectors of the scaled equations of all coefficients."""
        return self._spectrum_of(np.ones(self.n, dtype=bool))

    def _spectrum_of(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scale = self.norm[rows]
        values, vectors = np.linalg.eigh(
            self.information[np.ix_(rows, rows)] / np.outer(scale, scale))
        return values, vectors

    @cached_property
    def _untold_free(self) -> np.ndarray:
        """Undetermined combinations of the free coefficients, (p, k)."""
        return self.untold(self.free)

    def limit(self, rows: np.ndarray) -> float:
        """Return the eigenvalue of the scaled equations of `rows` that counts as zero."""
        seen = self._norm_of_microscope[rows]
        least = float(seen.min()) if len(seen) else np.inf
        # each column contains the noise of one coordinate of every mean
        return max(UNTOLD, OVER_NOISE * self._power / least**2)

    @cached_property
    def _norm_of_microscope(self) -> np.ndarray:
        """The norm of the microscope's columns, infinite for others, (p,)."""
        return np.where(self.columns.having(lambda block: block.of_offsets), self.norm, np.inf)

    @cached_property
    def _power(self) -> float:
        return self.noise_m**2 * self.system.grid.n_readings

    @cached_property
    def maps(self) -> np.ndarray:
        """Map for a unit of each coefficient in the datum, complex (sites, p); 0 where unknown."""
        known = self.system.known_sites.ravel()[:, None]
        fields = np.where(known, self.projected.fields, 0.0)
        basis = self.system.gauge.orthonormal
        return np.where(known, fields - basis @ np.real(basis.conj().T @ fields), 0.0)

    @cached_property
    def turned(self) -> np.ndarray:
        """Angular map for a unit of each coefficient in the datum, sign reversed, (K, p)."""
        known = self.system.known_lines
        turned = self.projected.turned
        return turned - turned[known].mean(axis=0) if known.any() else turned

    def variances(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances that coefficients with a covariance (p, p) give the maps.

        (2, sites) of the XY map, and (K,) of the angular one.
        """
        x, y, lines = (np.einsum("sp,pq,sq->s", part, covariance, part, optimize=True)
                       for part in (self.maps.real, self.maps.imag, self.turned))
        return np.stack([x, y]), lines

    def unseen(self, rows: np.ndarray) -> np.ndarray:
        """Return undetermined combinations of `rows` that change the map, scaled, (p, modes)."""
        untold = self.untold(rows)
        if not untold.shape[1]:
            return untold
        grid = self.system.grid
        unit = untold / self.norm[:, None]
        moved = self.maps @ unit * np.sqrt(grid.weight.sum() / grid.n_sites)
        lines = (self.turned @ unit)[self.system.known_lines]
        lines = lines * np.sqrt(self.line_weight * self.system.angular.weight.sum()
                                / max(len(lines), 1))
        both = np.concatenate([moved.real, moved.imag, lines])
        _, size, right = np.linalg.svd(both, full_matrices=False)
        return untold @ right[size > MOVES_THE_MAP].T

    def rows(self, names: Iterable[str]) -> np.ndarray:
        """Return which coefficients belong to the terms `names`, bool (p,)."""
        return self.columns.rows(names)

    @cached_property
    def position_noise(self) -> np.ndarray:
        """Variance of the right-hand sides due to noise of the indicated position, (p,).

        For unit noise. If all noise is that of the position, each coordinate of a reading adds its
        variance to the right-hand sides of scale and stretch (method eq. 7.11).
        """
        count = 2 * self.system.grid.n_readings + self.columns.within.dof
        # those that multiply an offset along its own axis: 1, not i, in the direction of the noise
        feigned = self.columns.having(lambda block: block.of_offsets) & (
            self.columns.shapes.unit == 1)
        return (self.noise_m * count) ** 2 * feigned

    @cached_property
    def _mixed(self) -> np.ndarray:
        """(K + D)^-1 D of method eq. 7.11, (p, p)."""
        none = self.norm**2 <= np.finfo(float).tiny * 2  # an approach that is not known
        scale = np.hypot(np.where(none, 1.0, self.norm), np.sqrt(self.position_noise))
        matrix = (self.information + np.diag(self.position_noise)) / np.outer(scale, scale)
        inverse = np.linalg.pinv(matrix, hermitian=True, rcond=1e-14)
        return inverse / np.outer(scale, scale) * self.position_noise

    @cached_property
    def unbiased(self) -> np.ndarray:
        """Information if any part of the noise may be that of the position, (p, p)."""
        noise = self.position_noise
        if not noise.any():
            return self.information
        return self.information - np.diag(noise) + noise[:, None] * self._mixed

    def unbiased_sums(self, right: np.ndarray) -> np.ndarray:
        """Return right-hand sides (p,) that belong to `unbiased`."""
        return right - self._mixed.T @ right if self.position_noise.any() else right

    def prior(self, sigma_m: float) -> np.ndarray:
        """Return the information from each size, for unit noise, (p,); 0 of free ones.

        Noise is at least `LEAST_NOISE_M`: the part common to all views cannot be separated
        from the plate, and without the sizes the equations are singular.
        """
        sized = ~self.free
        size = np.where(sized, self.columns.size, 1.0)
        return np.where(sized, (max(sigma_m, LEAST_NOISE_M) / size) ** 2, 0.0)

    def inverse(self, sigma_m: float) -> np.ndarray:
        """Return the covariance of the coefficients for unit noise, (p, p).

        It is 0 for undetermined combinations of free coefficients, which do not change the map.

        Parameters
        ----------
        sigma_m : float
            Noise of one grid reading, m, against which sizes are weighted.
        """
        # a sized coefficient in units of its size, a free one in those of its column
        scale = np.where(self.free, 1 / self.norm, self.columns.size)
        matrix = self.unbiased * np.outer(scale, scale)
        matrix[np.diag_indices(len(scale))] += self.prior(sigma_m) * scale**2
        hold = self._untold_free
        # sized coefficients may be determined far better than free ones in these units; the
        # diagonal of an undetermined free one is rounding
        diagonal = np.maximum(np.diag(matrix), np.finfo(float).tiny)
        own = np.sqrt(np.where(self.free & (diagonal <= UNTOLD), 1.0, diagonal))
        null = np.linalg.qr(own[:, None] * hold)[0]
        found = np.linalg.pinv(matrix / np.outer(own, own) + null @ null.T, hermitian=True,
                               rcond=1e-14) - null @ null.T
        found /= np.outer(own, own)
        told = np.eye(self.n) - hold @ hold.T
        return told @ found @ told * np.outer(scale, scale)

    @cached_property
    def free_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the information: covariance of free coefficients, (p, p)."""
        untold = self.untold(np.ones(self.n, dtype=bool))
        scaled = self.information / np.outer(self.norm, self.norm)
        held = np.linalg.inv(scaled + untold @ untold.T) - untold @ untold.T
        return held / np.outer(self.norm, self.norm)

    def rank(self) -> int:
        """Return the number of combinations of all coefficients determined by the readings."""
        return self.n - self.untold(np.ones(self.n, dtype=bool)).shape[1]


def equations_of_columns(system: NormalEquations, columns: TermColumns, inverse: np.ndarray, *,
                         ratio: float, half_width_m: float, noise_m: float,
                         reduced: ReducedColumns | None = None) -> TermEquations:
    """Return the equations of columns of readings that are planned, or about an estimate.

    Parameters
    ----------
    system, columns : NormalEquations, TermColumns
        The readings, and the terms.
    inverse : float array (size, size)
        Covariance of the misalignments for unit noise of one grid reading.
    ratio, half_width_m : float
        Weight of a line, and the unit of the misalignments, m.
    noise_m : float
        Noise of one grid reading, m; 0 if unknown.
    reduced : ReducedColumns, optional
        The columns with the sites eliminated, if that is done.
    """
    if reduced is None:
        reduced = reduce_columns(system.grid, columns.shapes)
    projected = project(system, reduced, inverse, columns.lines, ratio=ratio,
                        half_width_m=half_width_m)
    return TermEquations(system, columns, projected, noise_m, ratio * half_width_m**2)


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
    inverse = equations.free_inverse
    more = inverse @ found.total
    gram, within = equations.projected.gram, equations.columns.within.gram
    between = found.sums.between - 2 * more @ found.between + more @ gram @ more
    inner = found.sums.within - 2 * more @ found.within + more @ within @ more
    return Sums(max(float(between), 0.0), found.sums.dof_between - float(np.sum(inverse * gram)),
                max(float(inner), 0.0), found.sums.dof_within - float(np.sum(inverse * within)))


def next_coefficients(equations: TermEquations, found: Score, coefficients: np.ndarray, *,
                      sigma_m: float, inverse: np.ndarray) -> np.ndarray:
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
    inverse : float array (p, p)
        `TermEquations.inverse` of it.
    """
    right = equations.unbiased_sums(found.total)
    # no reading tells anything of these: what is there is rounding
    untold = equations.untold(np.ones(equations.n, dtype=bool), ROUNDED)
    right = right - equations.norm * (untold @ (untold.T @ (right / equations.norm)))
    prior = equations.prior(sigma_m)
    return coefficients + inverse @ (right - prior * coefficients)


def roots_by_term(covariance: np.ndarray, columns: TermColumns) -> list[tuple[str, np.ndarray]]:
    """Return roots (p, k) of parts of a covariance: of each term with a size, of the free ones.

    A part is the reduction of the covariance if that term, and those before it, are
    known: the parts add up to the covariance.
    """
    rest, out = covariance.copy(), []
    sized = dict.fromkeys(c.term for c in columns.columns if np.isfinite(c.size))
    for name in sized:
        at = columns.rows([name])
        values, vectors = np.linalg.eigh(rest[np.ix_(at, at)])
        determined = values > NO_VARIANCE * max(values[-1], 0.0)
        root = rest[:, at] @ (vectors[:, determined] / np.sqrt(values[determined]))
        rest = rest - root @ root.T
        out.append((str(name), root))
    own = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(rest / np.outer(own, own))
    out.append((FREE, own[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))))
    return out
