# SPDX-License-Identifier: Apache-2.0
"""Columns projected by the estimate of map, plate and misalignments: effects and residuals.

The estimate without terms is linear: y -> (G, misalignments) with residuals (1 - P) y. A term's
column c has the map F = G(c) and the residuals r = (1 - P) c. The terms then follow by
partitioned regression (Frisch and Waugh):
    (r'W c + within + sigma^2/size^2) b = c'W e + within,
    G = G(y) - F b,     cov G = S + F cov(b) F'
With the marks, then the sites (matrix M, right-hand side s), then the misalignments (right-hand
side d, covariance C) eliminated, r'W c = c'W c - mean' W mean - s' M^-1 s - d' C d. Up to the last
step everything is linear over the complex numbers and done for the shapes of the columns.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.estimation.normal.angular import AngularSystem
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem, of_misalignments
from selfcal_ros.estimation.terms.shapes import LineColumns, Shapes


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
    asked : complex array (2 views, q)
        Coupling of the shapes to rotation and offset of every view, sites eliminated.
    """

    grid: GridSystem
    shapes: Shapes
    sites: np.ndarray
    inner: np.ndarray
    asked: np.ndarray

    @cached_property
    def free(self) -> np.ndarray:
        """M^-1 s of every column, complex (sites, p)."""
        return self.shapes.of_columns(self.grid.factor.solve(self.sites))

    @cached_property
    def right(self) -> np.ndarray:
        """Right-hand side of the misalignments, (3 views, p)."""
        return of_misalignments(self.shapes.of_columns(self.asked))

    @cached_property
    def gram(self) -> np.ndarray:
        """Weighted inner products of the columns' residuals after marks and sites, (p, p)."""
        return self.shapes.products(self.inner)


def reduce_columns(grid: GridSystem, shapes: Shapes) -> ReducedColumns:
    """Return columns with the sites eliminated."""
    sites, inner, asked = _marks_eliminated(grid, shapes)
    inner -= grid.factor.products(sites)
    return ReducedColumns(grid, shapes, sites, (inner + inner.conj().T) / 2,
                          asked - _coupled(grid, sites))


def reduce_anew(grid: GridSystem, shapes: Shapes, before: ReducedColumns,
                rows: np.ndarray) -> ReducedColumns:
    """Return columns with the sites eliminated, if only `rows` have changed.

    Parameters
    ----------
    grid : GridSystem
        The measured plan.
    shapes : Shapes
        The columns.
    before : ReducedColumns
        The previous columns.
    rows : bool array (p,)
        Columns to recompute, with all others of the same shapes.
    """
    changed = np.unique(shapes.of_column[rows])
    sites, fresh, asked = _marks_eliminated(grid, shapes)
    free = grid.factor.solve(np.ascontiguousarray(sites[:, changed]))
    inner, asked_before = before.inner.copy(), before.asked.copy()
    inner[changed] = fresh[changed] - free.conj().T @ sites
    inner[:, changed] = inner[changed].conj().T
    asked_before[:, changed] = asked[:, changed] - _coupled(grid, sites[:, changed])
    return ReducedColumns(grid, shapes, sites, (inner + inner.conj().T) / 2, asked_before)


def _marks_eliminated(grid: GridSystem, shapes: Shapes
                      ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return s (sites, q), inner products (q, q) and the coupling to the views (2 views, q)."""
    n, marks = grid.n_views, grid.n_marks
    weight, part = (array.reshape(n, marks) for array in (grid.weight, grid.relative_weight))
    to_views = grid.shapes.reshape(2, marks).conj()
    means: np.ndarray = np.zeros((shapes.n, marks), dtype=complex)
    sites: np.ndarray = np.zeros((shapes.n, *grid.views.shape), dtype=complex)
    inner: np.ndarray = np.zeros((shapes.n, shapes.n), dtype=complex)
    asked: np.ndarray = np.zeros((n, 2, shapes.n), dtype=complex)
    for v, (rows, values) in enumerate(zip(shapes.rows, shapes.values, strict=True)):
        weighted = values * weight[v]
        means[rows] += values * part[v]
        inner[rows[:, None], rows] += values.conj() @ weighted.T
        asked[v][:, rows] += to_views @ weighted.T
        here = np.zeros((len(rows), *grid.views.shape), dtype=complex)
        grid.views.add_scattered(here, v, weighted.reshape(len(rows), *shapes.lattice))
        sites[rows] += here
    # minus the mean of each mark, which all views share
    inner -= (means * weight.sum(axis=0)).conj() @ means.T
    asked -= (to_views * weight[:, None]) @ means.T
    for v in range(n):
        grid.views.add_scattered(sites, v, (means * -weight[v]).reshape(-1, *shapes.lattice))
    return (np.ascontiguousarray(sites.reshape(shapes.n, grid.n_sites).T), inner,
            asked.reshape(2 * n, shapes.n))


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
        Returns `fields`, which are rarely needed.
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

    def of_lines(self, system: NormalEquations, lines: LineColumns,
                 half_width_m: float) -> np.ndarray:
        """Return the angular residuals of the columns, (views, K, p), rad."""
        angular = system.angular
        phi = self.parameters[system.phi_at] / half_width_m
        out = angular.gather(self.turned) - phi[:, None]
        if len(lines.at):
            out[:, :, lines.at] += np.moveaxis(lines.values, 0, -1)
        return np.where(angular.read[:, :, None], angular.centred(out), 0.0)


def project(system: NormalEquations, reduced: ReducedColumns, inverse: np.ndarray,
            lines: LineColumns, *, ratio: float, half_width_m: float) -> ProjectedColumns:
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
    angular, n = system.angular, 3 * system.grid.n_views
    right = np.zeros((system.size, reduced.right.shape[1]))
    right[:n] = reduced.right
    free, of_lines, gram_of_lines = _lines_eliminated(angular, lines)
    right[np.ix_(system.phi_at, lines.at)] += ratio * half_width_m * of_lines
    parameters = inverse @ right
    gram = reduced.gram - right.T @ parameters
    gram[np.ix_(lines.at, lines.at)] += ratio * half_width_m**2 * gram_of_lines
    turned = angular.response @ parameters[system.phi_at] / half_width_m
    turned[:, lines.at] -= free
    return ProjectedColumns(lambda: reduced.free - system.grid.response @ parameters[:n],
                            parameters, (gram + gram.T) / 2, turned)


def _lines_eliminated(angular: AngularSystem,
                      lines: LineColumns) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what q columns make of the stage's lines, (K, q), and right-hand side and products.

    Of the misalignments, (views, q), and of the residuals, (q, q).
    """
    if not len(lines.at):
        return np.zeros((angular.n_lines, 0)), np.zeros((angular.n_views, 0)), np.zeros((0, 0))
    values = np.moveaxis(lines.values, 0, -1)
    weighted = angular.weight[:, :, None] * angular.centred(values)
    lines_right = angular.scatter(weighted)
    free = angular.solve(lines_right)
    gram = np.einsum("vkp,vkq->pq", values, weighted) - lines_right.T @ free
    return free, weighted.sum(axis=1) - angular.columns.T @ free, (gram + gram.T) / 2
