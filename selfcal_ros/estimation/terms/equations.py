# SPDX-License-Identifier: Apache-2.0
"""The equations of the terms' coefficients: which are determined, their values and covariance.

The estimate of map, plate and misalignments projects the columns. The estimate without terms is
linear: y -> (G, misalignments) with residuals (1 - P) y. A term's column c has the map F = G(c) and
the residuals r = (1 - P) c. The terms then follow by partitioned regression (Frisch and Waugh):
    (r'W c + within + sigma^2/size^2) b = c'W e + within,
    G = G(y) - F b,     cov G = S + F cov(b) F'
With the marks, then the sites (matrix M, right-hand side s), then the misalignments (right-hand
side d, covariance C) eliminated, r'W c = c'W c - mean' W mean - s' M^-1 s - d' C d. Up to the last
step everything is linear over the complex numbers and done for the shapes of the columns.

Sizes are tested against the readings. The coefficients of a term, estimated without their size,
have b ~ N(0, C + size^2 1), with C their covariance (method eq. 7.9). If this is contradicted, the
readings give another size: that at which b' (C + size^2 1)^-1 b equals its rank (Paule and Mandel
1982), and at most that at which it is improbably small.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import chdtri, fdtrc

from selfcal_ros.blocks import blocks
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.checks.wiring import LEAST_NOISE_M
from selfcal_ros.estimation.normal.angular import GAP, ROUNDED, AngularSystem
from selfcal_ros.estimation.normal.equations import TRACE, NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem, of_misalignments
from selfcal_ros.estimation.terms.columns import LineColumns, Shapes, TermColumns
from selfcal_ros.model.error_map import COVERAGE, MANY_DOF
from selfcal_ros.model.findings import LooksLikeStage, SeparateTerm
from selfcal_ros.model.result import Observability
from selfcal_ros.model.terms import ModelTerm


@dataclass(frozen=True, eq=False)
class ReducedColumns:
    """Columns with the sites eliminated, independent of the angular readings.

    Attributes
    ----------
    grid : GridSystem
        The measured plan.
    shapes : Shapes
        The columns, p of them, of q shapes.
    sites : complex array (sites, q)
        Right-hand side s of every shape.
    inner : complex array (q, q)
        Weighted inner products of the shapes' residuals after marks and sites.
    misalignments : complex array (2 views, q)
        Coupling of the shapes to rotation and offset of every view, sites eliminated.
    """

    grid: GridSystem
    shapes: Shapes
    sites: np.ndarray
    inner: np.ndarray
    misalignments: np.ndarray

    @cached_property
    def free(self) -> np.ndarray:
        """M^-1 s of every column, complex (sites, p)."""
        return self.shapes.of_columns(self.grid.solve(self.sites))

    @cached_property
    def right(self) -> np.ndarray:
        """Right-hand side of the misalignments, (3 views, p)."""
        return of_misalignments(self.shapes.of_columns(self.misalignments))

    @cached_property
    def gram(self) -> np.ndarray:
        """Weighted inner products of the columns' residuals after marks and sites, (p, p)."""
        return self.shapes.products(self.inner)


def reduce_columns(grid: GridSystem, shapes: Shapes) -> ReducedColumns:
    """Return columns with the sites eliminated; the last ones are kept, and the grid with them."""
    return (_last_reduced if shapes.n else _reduced)(grid, shapes)


def _reduced(grid: GridSystem, shapes: Shapes) -> ReducedColumns:
    sites: np.ndarray = np.zeros((grid.n_sites, 0), dtype=complex)
    inner: np.ndarray = np.zeros((0, 0), dtype=complex)
    coupling: np.ndarray = np.zeros((2 * grid.n_views, 0), dtype=complex)
    if shapes.n:  # a model without terms takes no time
        sites, inner, coupling = _marks_eliminated(grid, shapes)
        inner -= grid.factor.products(sites)
        coupling -= _coupled(grid, sites)
    return ReducedColumns(grid, shapes, sites, (inner + inner.conj().T) / 2, coupling)


_last_reduced = lru_cache(maxsize=2)(_reduced)


def _marks_eliminated(
    grid: GridSystem, shapes: Shapes
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return s (sites, q), inner products (q, q) and the coupling to the views (2 views, q)."""
    n, marks = grid.n_views, grid.n_marks
    weight, relative_weight = (
        array.reshape(n, marks) for array in (grid.weight, grid.relative_weight)
    )
    to_views = grid.shapes.reshape(2, marks).conj()
    means: np.ndarray = np.zeros((shapes.n, marks), dtype=complex)
    sites: np.ndarray = np.zeros((shapes.n, *grid.views.shape), dtype=complex)
    inner: np.ndarray = np.zeros((shapes.n, shapes.n), dtype=complex)
    coupling: np.ndarray = np.zeros((n, 2, shapes.n), dtype=complex)
    for v, (rows, values) in enumerate(zip(shapes.rows, shapes.values, strict=True)):
        weighted = values * weight[v]
        means[rows] += values * relative_weight[v]
        inner[rows[:, None], rows] += values.conj() @ weighted.T
        coupling[v][:, rows] += to_views @ weighted.T
        of_view = np.zeros((len(rows), *grid.views.shape), dtype=complex)
        grid.views.add_scattered(
            of_view, v, weighted.reshape(len(rows), *shapes.lattice)
        )
        sites[rows] += of_view
    # minus the mean of each mark, which all views share
    inner -= (means * weight.sum(axis=0)).conj() @ means.T
    coupling -= (to_views * weight[:, None]) @ means.T
    for v in range(n):
        grid.views.add_scattered(
            sites, v, (means * -weight[v]).reshape(-1, *shapes.lattice)
        )
    return (
        np.ascontiguousarray(sites.reshape(shapes.n, grid.n_sites).T),
        inner,
        coupling.reshape(2 * n, shapes.n),
    )


def _coupled(grid: GridSystem, sites: np.ndarray) -> np.ndarray:
    """Return the coupling of M^-1 s to rotation and offset of every view, complex (2 views, k)."""
    answers = grid.response.reshape(grid.n_sites, grid.n_views, 3)[:, :, :2]
    return answers.reshape(grid.n_sites, -1).conj().T @ sites


@dataclass(frozen=True, eq=False)
class ProjectedColumns:
    """Effect of each column on the estimate, in no particular datum.

    Attributes
    ----------
    make_fields : callable
        Returns `fields`, which only the last step needs.
    parameters : float array (size, p)
        Misalignments, as in `NormalEquations`.
    gram : float array (p, p)
        Weighted inner products of columns and residuals, c' W r.
    turned : float array (K, p)
        Angular map of each column, sign reversed, rad.
    """

    make_fields: Callable[[], np.ndarray]
    parameters: np.ndarray
    gram: np.ndarray
    turned: np.ndarray

    @cached_property
    def fields(self) -> np.ndarray:
        """Map F, complex (sites, p)."""
        return self.make_fields()

    def of_lines(
        self, system: NormalEquations, lines: LineColumns, half_width_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the plate's lines (p, K) and the residuals (p, views, K) of the columns, rad."""
        y = np.zeros((len(self.gram), *system.angular.weight.shape))
        if len(lines.at):
            y[lines.at] = lines.values
        phi = self.parameters[system.phi_at] / half_width_m
        return system.angular.plate(y, -self.turned.T, phi.T)


def project(
    system: NormalEquations,
    reduced: ReducedColumns,
    inverse: np.ndarray,
    lines: LineColumns,
    *,
    ratio: float,
    half_width_m: float,
) -> ProjectedColumns:
    """Return the effect of the columns on the joint estimate.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    reduced : ReducedColumns
        The columns with the sites eliminated.
    inverse : float array (size, size)
        Covariance of the misalignments for unit noise of one grid reading.
    lines : LineColumns
        The columns of lines; a reading has the weight `ratio` times `half_width_m` squared.
    ratio, half_width_m : float
        Weight of a line, and the unit of the misalignments, m.
    """
    angular = system.angular
    n = 3 * system.grid.n_views
    right = np.zeros((system.size, reduced.right.shape[1]))
    right[:n] = reduced.right
    free, of_lines, gram_of_lines = lines_eliminated(angular, lines)
    right[np.ix_(system.phi_at, lines.at)] += ratio * half_width_m * of_lines
    parameters = inverse @ right
    gram = reduced.gram - right.T @ parameters
    gram[np.ix_(lines.at, lines.at)] += ratio * half_width_m**2 * gram_of_lines
    turned = angular.response @ parameters[system.phi_at] / half_width_m
    turned[:, lines.at] -= free
    return ProjectedColumns(
        lambda: reduced.free - system.grid.response @ parameters[:n],
        parameters,
        (gram + gram.T) / 2,
        turned,
    )


def lines_eliminated(
    angular: AngularSystem, lines: LineColumns
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what q columns make of the stage's lines, (K, q), and right-hand side and products.

    Of the misalignments, (views, q), and of the residuals, (q, q).
    """
    if not len(lines.at):
        return (
            np.zeros((angular.n_lines, 0)),
            np.zeros((angular.n_views, 0)),
            np.zeros((0, 0)),
        )
    weighted = angular.weight * angular.centred(lines.values)
    of_sites, of_rotations = angular.adjoint(weighted)
    free = angular.solve(of_sites)
    gram = np.einsum("pvk,qvk->pq", lines.values, weighted) - of_sites.T @ free
    return free, of_rotations - angular.coupled(free), (gram + gram.T) / 2


OVER_NOISE = 100.0
"""Ratio of the variance of the offsets to that of their noise from which they determine the scale
of offsets: below, they would be dominated by their own noise, which is in the readings as well."""

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
    noise_m: float
    line_weight: float

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
        return np.sqrt(
            np.maximum(grid + np.diag(self.columns.within.gram), np.finfo(float).tiny)
        )

    @property
    def free(self) -> np.ndarray:
        """Coefficients to be determined by the readings alone, bool (p,)."""
        return np.isinf(self.columns.size)

    def undetermined(
        self,
        rows: np.ndarray,
        limit: float | None = None,
        *,
        unknown: np.ndarray | None = None,
    ) -> np.ndarray:
        """Return undetermined combinations of the coefficients `rows`, (p, k).

        Orthonormal in scaled coefficients (times `norm`); others are taken as known, but for those
        that are `unknown`. Eigenvalues up to `limit`, by default that of `rows`, count as zero.
        """
        values, vectors = (
            self._spectrum if rows.all() else self._spectrum_of(rows, unknown)
        )
        hidden = values <= (self.limit(rows) if limit is None else limit)
        out = np.zeros((len(rows), int(hidden.sum())))
        out[rows] = vectors[:, hidden]
        return out

    @cached_property
    def _spectrum(self) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues and eigenvectors of the scaled equations of all coefficients."""
        return self._spectrum_of(np.ones(self.n, dtype=bool))

    def _spectrum_of(
        self, rows: np.ndarray, unknown: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        scaled = self.information / np.outer(self.norm, self.norm)
        information = scaled[np.ix_(rows, rows)]
        if unknown is not None:
            couple = scaled[np.ix_(rows, unknown)]
            information = (
                information
                - couple
                @ np.linalg.pinv(scaled[np.ix_(unknown, unknown)], hermitian=True)
                @ couple.T
            )
        values, vectors = np.linalg.eigh(information)
        return values, vectors

    @cached_property
    def _undetermined_free(self) -> np.ndarray:
        """Undetermined combinations of the free coefficients, (p, k)."""
        return self.undetermined(self.free)

    def limit(self, rows: np.ndarray) -> float:
        """Return the eigenvalue of the scaled equations of `rows` that counts as zero.

        Offsets of lines are told apart from their noise only where they stand alone: among others
        theirs is a combination of its own.
        """
        of_marks, of_lines = (
            float(noise_shares[rows].max(initial=0.0))
            for noise_shares in self._noise_of_offsets
        )
        lines_alone = self._noise_of_offsets[1][rows].all()
        return max(GAP, OVER_NOISE * (of_lines if lines_alone else of_marks))

    @cached_property
    def _noise_of_offsets(self) -> tuple[np.ndarray, np.ndarray]:
        """The part of the weighted square of columns that the noise of offsets makes, (p,) each.

        Columns of marks hold the noise of one coordinate of every mean; those of lines, whose
        residuals leave no more of it, that of the rotation of every view.
        """
        power = (self.noise_m / self.norm) ** 2
        marks = self.columns.having(lambda block: block.of_microscope)
        lines = self.columns.having(lambda block: block.of_offsets and block.of_lines)
        return (
            self.system.grid.n_readings * power * marks,
            self.system.angular.n_views * power * lines,
        )

    @cached_property
    def plates(self) -> np.ndarray:
        """Plate for a unit of each coefficient, beside `projected.fields`, complex (marks, p)."""
        grid = self.system.grid
        fields = self.projected.fields.T.reshape(-1, *grid.views.shape)
        parameters = self.projected.parameters[: 3 * grid.n_views].T
        plates = [
            grid.plate(*effects)[0].ravel()
            for effects in zip(self.columns.grid, fields, parameters, strict=True)
        ]
        return np.array(plates).reshape(-1, grid.n_marks).T

    @cached_property
    def maps(self) -> np.ndarray:
        """Map for a unit of each coefficient in the datum, complex (sites, p); 0 where unknown."""
        known_sites = self.system.known_sites.ravel()[:, None]
        fields = np.where(known_sites, self.projected.fields, 0.0)
        return np.where(known_sites, self.system.gauge.without(fields), 0.0)

    @cached_property
    def turned(self) -> np.ndarray:
        """Angular map for a unit of each coefficient in the datum, sign reversed, (K, p)."""
        known_lines = self.system.known_lines
        turned = self.projected.turned
        return (
            turned - turned[known_lines].mean(axis=0) if known_lines.any() else turned
        )

    def variances(self, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the variances that coefficients with a covariance (p, p) give the maps.

        (2, sites) of the XY map, and (K,) of the angular one.
        """
        x, y, lines = (
            (effect @ covariance * effect).sum(axis=1)
            for effect in (self.maps.real, self.maps.imag, self.turned)
        )
        return np.stack([x, y]), lines

    def unseen(self, rows: np.ndarray) -> np.ndarray:
        """Return undetermined combinations of `rows` that change the map, scaled, (p, modes)."""
        undetermined = self.undetermined(rows)
        if not undetermined.shape[1]:
            return undetermined
        grid = self.system.grid
        unit = undetermined / self.norm[:, None]
        of_map = self.maps @ unit * np.sqrt(grid.weight.sum() / grid.n_sites)
        lines = (self.turned @ unit)[self.system.known_lines]
        lines = lines * np.sqrt(
            self.line_weight * self.system.angular.weight.sum() / max(len(lines), 1)
        )
        maps = np.concatenate([of_map.real, of_map.imag, lines])
        _, size, right = np.linalg.svd(maps, full_matrices=False)
        return undetermined @ right[size > TRACE].T  # the smallest true ones are 1e-2

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
        feigned = self.columns.having(lambda block: block.of_microscope) & (
            self.columns.shapes.unit == 1
        )
        return (self.noise_m * count) ** 2 * feigned

    @cached_property
    def _mixed(self) -> np.ndarray:
        """(K + D)^-1 D of method eq. 7.11, (p, p)."""
        none = self.norm**2 <= np.finfo(float).tiny * 2  # an approach that is not known
        scale = np.hypot(np.where(none, 1.0, self.norm), np.sqrt(self.position_noise))
        matrix = (self.information + np.diag(self.position_noise)) / np.outer(
            scale, scale
        )
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
        undetermined = self._undetermined_free
        # sized coefficients may be determined far better than free ones in these units; the
        # diagonal of an undetermined free one is rounding
        diagonal = np.maximum(np.diag(matrix), np.finfo(float).tiny)
        unit = np.sqrt(np.where(self.free & (diagonal <= GAP), 1.0, diagonal))
        null = np.linalg.qr(unit[:, None] * undetermined)[0]
        inverse = _inverse_beside(matrix / np.outer(unit, unit), null)
        inverse /= np.outer(unit, unit)
        determined = np.eye(self.n) - undetermined @ undetermined.T
        return determined @ inverse @ determined * np.outer(scale, scale)

    @cached_property
    def free_inverse(self) -> np.ndarray:
        """Pseudo-inverse of the information: covariance of free coefficients, (p, p).

        The scale of the lines' offsets is known: beside a microscope and turns of lines that are
        free it would explain noise alone.
        """
        return self.inverse_without(
            self.columns.having(lambda block: block.of_offsets and block.of_lines)
        )

    def inverse_without(self, known_rows: np.ndarray) -> np.ndarray:
        """Return the covariance of free coefficients (p, p) if those in `known_rows` are."""
        free = ~known_rows
        undetermined = self.undetermined(free)[free]
        norm = self.norm[free]
        scaled = self.information[np.ix_(free, free)] / np.outer(norm, norm)
        out = np.zeros((self.n, self.n))
        out[np.ix_(free, free)] = (
            np.linalg.inv(scaled + undetermined @ undetermined.T)
            - undetermined @ undetermined.T
        ) / np.outer(norm, norm)
        return out


def _inverse_beside(matrix: np.ndarray, null: np.ndarray) -> np.ndarray:
    """Return the inverse of a matrix (k, k) beside what it does not determine, (k, n)."""
    held = null @ null.T  # held, and let go again
    return np.linalg.pinv(matrix + held, hermitian=True, rcond=1e-14) - held


def equations_of_columns(
    system: NormalEquations,
    columns: TermColumns,
    inverse: np.ndarray,
    *,
    ratio: float,
    half_width_m: float,
    noise_m: float,
) -> TermEquations:
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
    """
    reduced = reduce_columns(system.grid, columns.shapes)
    projected = project(
        system, reduced, inverse, columns.lines, ratio=ratio, half_width_m=half_width_m
    )
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


def score(
    equations: TermEquations,
    residuals: tuple[np.ndarray, np.ndarray],
    squares: tuple[float, float],
    *,
    coefficients: np.ndarray | None = None,
) -> Score:
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
    columns = equations.columns
    weight = equations.system.grid.weight
    shapes = columns.shapes
    within = columns.within
    subtracted = np.zeros(equations.n) if coefficients is None else coefficients
    between = shapes.against(shapes.sums(weight * residuals[0]))
    between[columns.lines.at] += equations.line_weight * columns.lines.sums(
        equations.system.angular.weight * residuals[1]
    )
    inner = (
        within.total
        - 2 * subtracted @ within.right
        + subtracted @ within.gram @ subtracted
    )
    sums = Sums(*squares, float(inner), within.dof)
    return Score(between, within.right - within.gram @ subtracted, sums)


def residual_sums(equations: TermEquations, scored: Score) -> Sums:
    """Return the residuals of all columns with free coefficients.

    The noise comes from this fit: a size that is too small would leave part of its term.
    """
    inverse = equations.free_inverse
    more = inverse @ scored.total
    gram = equations.projected.gram
    within = equations.columns.within.gram
    between = scored.sums.between - 2 * more @ scored.between + more @ gram @ more
    inner = scored.sums.within - 2 * more @ scored.within + more @ within @ more
    return Sums(
        max(float(between), 0.0),
        scored.sums.dof_between - float(np.sum(inverse * gram)),
        max(float(inner), 0.0),
        scored.sums.dof_within - float(np.sum(inverse * within)),
    )


def next_coefficients(
    equations: TermEquations,
    scored: Score,
    coefficients: np.ndarray,
    *,
    sigma_m: float,
    inverse: np.ndarray,
) -> np.ndarray:
    """Return the coefficients from the score, (p,), with sizes as prior knowledge.

    Parameters
    ----------
    equations : TermEquations
        The columns.
    scored : Score
        Score at `coefficients`.
    coefficients : float array (p,)
        Present coefficients of the estimate.
    sigma_m : float
        Noise of one grid reading, m.
    inverse : float array (p, p)
        `TermEquations.inverse` of it.
    """
    right = equations.unbiased_sums(scored.total)
    # no reading tells anything of these: what is there is rounding
    undetermined = equations.undetermined(np.ones(equations.n, dtype=bool), ROUNDED)
    right = right - equations.norm * (
        undetermined @ (undetermined.T @ (right / equations.norm))
    )
    prior = equations.prior(sigma_m)
    return coefficients + inverse @ (right - prior * coefficients)


def root_of(covariance: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return a root (p, k) of the part of a covariance that is gone if `rows` are known."""
    values, vectors = np.linalg.eigh(covariance[np.ix_(rows, rows)])
    determined = values > ROUNDED * max(values[-1], 0.0)
    return covariance[:, rows] @ (vectors[:, determined] / np.sqrt(values[determined]))


def roots_by_term(
    covariance: np.ndarray, columns: TermColumns
) -> list[tuple[str, np.ndarray]]:
    """Return roots (p, k) of parts of a covariance: of each term with a size, of the free ones.

    A part is the reduction of the covariance if that term, and those before it, are
    known: the parts add up to the covariance.
    """
    remaining = covariance.copy()
    out = []
    sized = dict.fromkeys(c.term for c in columns.columns if np.isfinite(c.size))
    for name in sized:
        root = root_of(remaining, columns.rows([name]))
        remaining = remaining - root @ root.T
        out.append((str(name), root))
    free = np.isinf(columns.size)
    u = np.sqrt(np.maximum(np.diag(covariance)[free], np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(remaining[np.ix_(free, free)] / np.outer(u, u))
    root = np.zeros((len(free), len(u)))
    root[free] = u[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    out.append((FREE, root))
    return out


CAUSE_LEVEL = 5e-4
"""Level of the test of each size, and of each term, all parts of it that are tried together."""

DOUBT_LEVEL = 0.1
"""Level below which the readings make a size doubtful, and a larger one is used instead: its upper
limit with as much confidence, which is far above what few coefficients show. By chance, this makes
u of some clean sessions without check stops many times that of their plan. Combinations whose noise
is far above what the size makes do most of it, but cannot be left out: with those of 100 times left
out, 9 of 40 machines with a distorting camera and plates against pins passed, with them 2."""

DOUBT_LEVEL_OF_FEW = 0.2
"""The same where the readings determine no more than two combinations of the coefficients. Both may
be small by chance: with 0.1, eccentricities of 7.5 times the assumed size passed in 6 of 96
machines with seven lines, with 0.2 in 2 of 100."""

TAIL = (1 - COVERAGE) / 2
"""Probability of a small statistic below which a size is too large."""


@dataclass(frozen=True)
class SizeTest:
    """The size of a term compared with the readings.

    Attributes
    ----------
    name : str
        The term.
    given : float
        Its size, SI unit of the term; the largest one of a microscope.
    shown, allowed : float
        The size shown by the readings, and the largest that they allow: the upper one of two limits
        with a coverage of 95.45 % if they contradict the given size; the limit of `doubt` if
        they make it doubtful; beyond what is plausible no more than `shown`; otherwise the given
        size.
    statistic : float
        b' (C + size^2 1)^-1 b of all coefficients; `rank` on average.
    rank : int
        Number of their combinations determined by the readings.
    p_together : float
        Probability of as large a value if the size is right.
    p : float
        The same of whichever is the least likely: of all coefficients, or of a family of them.
    evidence : float
        Logarithm of how much likelier the readings are with the size that they show (ratio of
        marginal likelihoods); 0 if they do not make the given one doubtful.
    doubt : float
        Level below which the size is doubtful.
    """

    name: str
    given: float
    shown: float
    allowed: float
    statistic: float
    rank: int
    p_together: float
    p: float
    evidence: float = 0.0
    doubt: float = DOUBT_LEVEL

    @property
    def contradicted(self) -> bool:
        """Whether the readings rule out the size as too small."""
        return self.p < CAUSE_LEVEL

    @property
    def raised(self) -> bool:
        """Whether the readings make the size doubtful, or rule it out: a larger one is used."""
        return self.p < self.doubt


def size_test(
    equations: TermEquations,
    right: np.ndarray,
    term: ModelTerm,
    noise: tuple[float, float],
) -> SizeTest:
    """Return the test of one size, the other terms with their sizes or free.

    The test of all its coefficients, or of those of one family (`Block.families`): whichever
    contradicts the size more, at the level of all of them together.

    Parameters
    ----------
    equations : TermEquations
        The columns of all terms.
    right : float array (p,)
        Inner products c' W y of all columns with the readings, without coefficients subtracted.
    term : ModelTerm
        With a size.
    noise : tuple of float
        Noise of one grid reading, m, and its degrees of freedom.
    """
    columns = equations.columns.columns
    of_term = equations.rows([term.name])
    families = [
        of_term & np.array([column.component in family for column in columns])
        for family in term.block.families
    ]
    together, *of_families = [
        _coefficients_test(
            equations, right, term, noise, rows=rows, among=1 + len(families)
        )
        for rows in (of_term, *families)
    ]
    return replace(
        min((together, *of_families), key=lambda test: test.p),
        rank=together.rank,
        statistic=together.statistic,
        p_together=together.p_together,
    )


def _coefficients_test(
    equations: TermEquations,
    right: np.ndarray,
    term: ModelTerm,
    noise: tuple[float, float],
    *,
    rows: np.ndarray,
    among: int,
) -> SizeTest:
    """Return the test of a size by the coefficients `rows`, bool (p,), one of `among` tests."""
    sigma, dof = noise
    values, information, of_size = _estimates_if_free(equations, right, rows, sigma)
    rank = len(values)
    if not rank:
        return SizeTest(
            name=term.name,
            given=term.size,
            shown=term.size,
            allowed=term.size,
            statistic=0.0,
            rank=0,
            p_together=1.0,
            p=1.0,
        )
    root = np.sqrt(information)
    # in independent combinations
    of_unit, turn = np.linalg.eigh(root[:, None] * of_size * root)
    squares = (turn.T @ (root * values)) ** 2

    def variances(size: float) -> np.ndarray:
        return sigma**2 + size**2 * of_unit

    def statistic(size: float) -> float:
        return float((squares / variances(size)).sum())

    of_given = statistic(term.size)
    p = float(fdtrc(rank, min(dof, MANY_DOF), of_given / rank))
    doubt = DOUBT_LEVEL_OF_FEW if rank <= 2 else DOUBT_LEVEL
    test = SizeTest(
        name=term.name,
        given=term.size,
        shown=term.size,
        allowed=term.size,
        statistic=of_given,
        rank=rank,
        p_together=p,
        p=min(1.0, among * p),
        doubt=doubt,
    )
    if not test.raised:
        return test
    # the statistic is below its square / size^2
    beyond = np.sqrt((squares / of_unit).sum())

    def size_at(level: float) -> float:
        low = term.size
        high = float(beyond / np.sqrt(level))
        while low < (middle := float(np.sqrt(low * high))) < high:
            low, high = (middle, high) if statistic(middle) > level else (low, middle)
        return high

    tail = TAIL if test.contradicted else doubt
    size_shown = size_at(rank)
    allowed = size_at(float(chdtri(rank, 1 - tail)))
    # the limit of few coefficients is far above what they show
    allowed = min(allowed, max(term.size, term.block.plausible, size_shown))
    wider = float(np.log(variances(size_shown) / variances(term.size)).sum())
    return replace(
        test,
        shown=size_shown,
        allowed=allowed,
        evidence=float(of_given - statistic(size_shown) - wider) / 2,
    )


def _estimates_if_free(
    equations: TermEquations, right: np.ndarray, rows: np.ndarray, sigma_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the estimates of coefficients taken as free.

    The determined combinations, scaled by the columns' norms, (r,), the information on them for
    unit noise, (r,), and their covariance for a largest size of 1, (r, r).
    """
    other_columns = ~rows
    prior = np.where(other_columns, np.sqrt(equations.prior(sigma_m)), 0.0)
    norm = np.hypot(equations.norm, prior)
    scaled = equations.unbiased / np.outer(norm, norm) + np.diag((prior / norm) ** 2)
    # the other columns, with their sizes or free, are eliminated
    hidden = equations.undetermined(equations.free & other_columns)[other_columns]
    of_others = _inverse_beside(scaled[np.ix_(other_columns, other_columns)], hidden)
    couple = scaled[np.ix_(rows, other_columns)] @ of_others
    scores = equations.unbiased_sums(right) / norm
    information = (
        scaled[np.ix_(rows, rows)] - couple @ scaled[np.ix_(other_columns, rows)]
    )
    # of the rest the combinations that the readings determine
    size, vectors = np.linalg.eigh((information + information.T) / 2)
    determined = size > equations.limit(rows)
    vectors = vectors[:, determined]
    size = size[determined]
    values = vectors.T @ (scores[rows] - couple @ scores[other_columns]) / size
    sizes = equations.columns.size[rows]
    turned = vectors * (norm[rows] * sizes / sizes.max())[:, None]
    return values, size, turned.T @ turned


def size_tests(
    equations: TermEquations,
    right: np.ndarray,
    terms: Sequence[ModelTerm],
    noise: tuple[float, float],
) -> tuple[SizeTest, ...]:
    """Return the tests of all sizes, raised ones first, in the order of their evidence.

    Each is tested with the preceding terms at the sizes that the readings allow, so that one term
    does not make others appear too small.

    Parameters
    ----------
    equations, right, noise
        As in `size_test`.
    terms : sequence of ModelTerm
        All terms.
    """
    raised: list[SizeTest] = []
    sized = [
        term for term in terms if not term.free and equations.rows([term.name]).any()
    ]
    if not np.isfinite(noise[0]):
        return ()
    while sized:
        tests = [size_test(equations, right, term, noise) for term in sized]
        failed = [test for test in tests if test.raised]
        if not failed:
            return (*raised, *tests)
        worst = max(failed, key=lambda test: test.evidence)
        raised.append(worst)
        sized = [term for term in sized if term.name != worst.name]
        equations = replace(
            equations,
            columns=equations.columns.scaled(worst.name, worst.allowed / worst.given),
        )
    return tuple(raised)


def unseen_by_term(equations: TermEquations) -> dict[str, int]:
    """Return, for each free term that is not separable from the stage, the modes that it hides.

    Terms that are not separable only in combination are all named, with the modes hidden together.
    """
    free = {
        column.term
        for column in equations.columns.columns
        if column.size == float("inf")
    }
    out = {}
    for name in blocks():
        if name in free:
            modes = equations.unseen(equations.rows([name])).shape[1]
            if modes:
                out[name] = modes
    together = equations.unseen(equations.free).shape[1]
    if together and not out:
        out = {name: together for name in blocks() if name in free}
    return out


def require_terms_determined(
    equations: TermEquations, observability: Observability
) -> None:
    """Raise NotIdentifiableError if free terms hide modes of the stage.

    Parameters
    ----------
    equations : TermEquations
        The terms.
    observability : Observability
        Observability without terms.
    """
    modes = equations.unseen(equations.free).shape[1]
    if not modes:
        return
    by_term = unseen_by_term(equations)
    alike = tuple(
        LooksLikeStage(term=name, count=count) for name, count in by_term.items()
    )
    advice = tuple(SeparateTerm(term=name) for name in by_term)
    free = int(equations.free.sum())
    with_terms = replace(
        observability,
        unknowns=observability.unknowns + free,
        rank=observability.rank + free - modes,
        deficiency=observability.deficiency + modes,
        identifiable=False,
        modes=alike,
        advice=advice,
    )
    raise NotIdentifiableError(
        f"the readings do not separate {' and '.join(by_term)} from the stage "
        f"({modes} mode{'s' * (modes != 1)} undetermined)",
        with_terms,
    )
