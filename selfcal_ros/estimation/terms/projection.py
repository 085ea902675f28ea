# SPDX-License-Identifier: Apache-2.0
"""Columns through the estimate of map, plate and misalignments: what they do to it, and leave.

The estimate without terms is linear: y -> (G, misalignments) with residuals (1 - P) y. A term's
column c has the map F = G(c) and the residuals r = (1 - P) c. With these the terms join by
partitioned regression (Frisch and Waugh):
    (r'W c + within + sigma^2/size^2) b = c'W e + within,
    G = G(y) - F b,     cov G = S + F cov(b) F'
With the marks, then the sites (matrix M, right-hand side s), then the misalignments (right-hand
side d, covariance C) eliminated, r'W c = c'W (c - mean) - s' M^-1 s - d' C d.
"""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.normal.grid import GridSystem

CHUNK_READINGS = 4_000_000
"""Readings of columns that are worked on at a time: 64 MB."""


@dataclass(frozen=True, eq=False)
class ReducedColumns:
    """Columns with the sites eliminated: what does not depend on the angular readings.

    Attributes
    ----------
    free : complex array (sites, p)
        M^-1 s of every column.
    right : float array (3 views, p)
        Right-hand side of the misalignments.
    gram : float array (p, p)
        Weighted inner products of what marks and sites leave of the columns.
    """

    free: np.ndarray
    right: np.ndarray
    gram: np.ndarray


@dataclass(frozen=True, eq=False)
class ProjectedColumns:
    """What the estimate makes of each column, in no particular datum.

    Attributes
    ----------
    fields : complex array (sites, p)
        Map F.
    parameters : float array (size, p)
        Misalignments, as in `NormalEquations`.
    gram : float array (p, p)
        Weighted inner products of columns and residuals, c' W r.
    """

    fields: np.ndarray
    parameters: np.ndarray
    gram: np.ndarray


def reduce_columns(grid: GridSystem, columns: np.ndarray) -> ReducedColumns:
    """Return columns (p, views, nx, ny) with the sites eliminated."""
    n = len(columns)
    empty = ReducedColumns(np.zeros((grid.n_sites, n), dtype=complex),
                           np.zeros((3 * grid.n_views, n)), np.zeros((n, n)))
    return reduce_anew(grid, columns, empty, np.ones(n, dtype=bool))


def reduce_anew(grid: GridSystem, columns: np.ndarray, before: ReducedColumns,
                rows: np.ndarray) -> ReducedColumns:
    """Return columns with the sites eliminated, of which only `rows` have changed.

    Parameters
    ----------
    grid : GridSystem
        The measured plan.
    columns : complex array (p, views, nx, ny)
        The columns in the plate frame.
    before : ReducedColumns
        Of the columns before.
    rows : bool array (p,)
        Which ones are to be set up anew.
    """
    free, right, gram = before.free.copy(), before.right.copy(), before.gram.copy()
    changed = np.flatnonzero(rows)
    sites = np.empty((grid.n_sites, len(changed)), dtype=complex)
    for part in _chunks(columns, len(changed)):
        at = changed[part]
        weighted = _centred(grid, columns[at])
        weighted *= grid.weight
        for place, one in zip(range(part.start, part.stop), weighted, strict=True):
            sites[:, place] = grid.views.scatter(one).ravel()
        sums = np.einsum("kij,pvij->vkp", np.conj(grid.shapes), weighted, optimize=True)
        free[:, at] = grid.factor.solve(sites[:, part])
        both = np.stack([sums[:, 0].real, sums[:, 1].real, sums[:, 1].imag], axis=1)
        right[:, at] = both.reshape(3 * grid.n_views, -1) - grid.coupled(free[:, at])
        gram[:, at] = inner_products(columns, weighted)
    gram[:, changed] -= inner_products(free.T, sites.T)
    gram[changed] = gram[:, changed].T
    return ReducedColumns(free, right, (gram + gram.T) / 2)


def project(system: NormalEquations, reduced: ReducedColumns,
            inverse: np.ndarray) -> ProjectedColumns:
    """Return what the joint estimate makes of the columns.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    reduced : ReducedColumns
        The columns with their sites eliminated.
    inverse : float array (size, size)
        Covariance of the misalignments for unit noise of one grid reading.
    """
    grid, n = system.grid, 3 * system.grid.n_views
    parameters = inverse[:, :n] @ reduced.right
    fields = reduced.free - grid.response @ parameters[:n]
    gram = reduced.gram - reduced.right.T @ parameters[:n]
    return ProjectedColumns(fields, parameters, (gram + gram.T) / 2)


def inner_products(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the real part of the inner products of complex rows (p, ...) and (k, ...), (p, k)."""
    pairs = [np.ascontiguousarray(rows).reshape(len(rows), -1).view(float)
             for rows in (first, second)]
    return pairs[0] @ pairs[1].T


def _centred(grid: GridSystem, columns: np.ndarray) -> np.ndarray:
    """Return columns less their weighted mean over the views, in their own memory."""
    columns -= np.einsum("vij,pvij->pij", grid.relative_weight, columns)[:, None]
    return columns


def _chunks(columns: np.ndarray, number: int) -> list[slice]:
    step = max(1, CHUNK_READINGS // max(columns[0].size if len(columns) else 1, 1))
    return [slice(i, min(i + step, number)) for i in range(0, number, step)]
