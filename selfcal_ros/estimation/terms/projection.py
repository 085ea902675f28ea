# SPDX-License-Identifier: Apache-2.0
"""Columns through the estimate of map, plate and misalignments: what they do to it, and leave.

The estimate without terms is linear: y -> (G, misalignments) with residuals (1 - P) y. A term's
column c has the map F = G(c) and the residuals r = (1 - P) c. With these the terms join by
partitioned regression (Frisch and Waugh):
    (r'W c + within + sigma^2/size^2) b = c'W e + within,
    G = G(y) - F b,     cov G = S + F cov(b) F'
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
        M^-1 b of every column.
    right : float array (3 views, p)
        Right-hand side of the misalignments.
    """

    free: np.ndarray
    right: np.ndarray


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
    free = np.zeros((grid.n_sites, len(columns)), dtype=complex)
    right = np.zeros((3 * grid.n_views, len(columns)))
    for part in _chunks(columns):
        weighted = grid.weight * _centred(grid, columns[part])
        sites = np.stack([grid.views.scatter(one).ravel() for one in weighted], axis=1)
        sums = np.einsum("kij,pvij->vkp", np.conj(grid.shapes), weighted, optimize=True)
        free[:, part] = grid.factor.solve(sites)
        both = np.stack([sums[:, 0].real, sums[:, 1].real, sums[:, 1].imag], axis=1)
        right[:, part] = both.reshape(3 * grid.n_views, -1) - grid.coupled(free[:, part])
    return ReducedColumns(free, right)


def project(system: NormalEquations, columns: np.ndarray, reduced: ReducedColumns,
            inverse: np.ndarray) -> ProjectedColumns:
    """Return what the joint estimate makes of the columns.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    columns : complex array (p, views, nx, ny)
        The columns in the plate frame.
    reduced : ReducedColumns
        Their sites eliminated.
    inverse : float array (size, size)
        Covariance of the misalignments for unit noise of one grid reading.
    """
    grid, n = system.grid, 3 * system.grid.n_views
    parameters = inverse[:, :n] @ reduced.right
    fields = reduced.free - grid.response @ parameters[:n]
    gram = np.zeros((len(columns), len(columns)))
    for part in _chunks(columns):
        residuals = residuals_of_columns(grid, columns[part], fields[:, part],
                                         parameters[:n, part])
        weighted = (grid.weight * residuals).reshape(residuals.shape[0], -1)
        gram[:, part] = (np.conj(columns.reshape(len(columns), -1)) @ weighted.T).real
    return ProjectedColumns(fields, parameters, (gram + gram.T) / 2)


def residuals_of_columns(grid: GridSystem, columns: np.ndarray, fields: np.ndarray,
                         parameters: np.ndarray) -> np.ndarray:
    """Return the grid residuals (p, views, nx, ny) of columns with the maps (sites, p)."""
    out = np.empty(columns.shape, dtype=complex)
    shape = grid.views.shape
    for row, column, field, values in zip(out, columns, fields.T, parameters.T, strict=True):
        row[...] = grid.plate(column, field.reshape(shape), values)[1]
    return out


def _centred(grid: GridSystem, columns: np.ndarray) -> np.ndarray:
    mean = np.einsum("vij,pvij->pij", grid.relative_weight, columns)
    return columns - mean[:, None]


def _chunks(columns: np.ndarray) -> list[slice]:
    step = max(1, CHUNK_READINGS // max(columns[0].size if len(columns) else 1, 1))
    return [slice(i, i + step) for i in range(0, len(columns), step)]
