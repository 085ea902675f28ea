# SPDX-License-Identifier: Apache-2.0
"""Inputs of the term columns: plate, views and visits of a measurement."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.lattice.maps import maps_of
from selfcal_ros.estimation.lattice.readings import GridData
from selfcal_ros.estimation.terms.visits import ViewVisits, approach_sign, visits_of
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import OF_LINES, OF_PLATE, TermName
from selfcal_ros.model.view import View


@dataclass(frozen=True, eq=False)
class TermInputs:
    """Inputs of the term columns.

    Attributes
    ----------
    z : complex array (nx, ny)
        Marks in units of `half_width_m`.
    half_width_m : float
        Longer half width of the plate, m.
    weight : float array (views, nx, ny)
        Weight of the mean of each mark; 0 = not read.
    visits : tuple of ViewVisits or None
        Visits of each view.
    names : tuple of str
        Names of the views.
    indicated : int
        Sign of the indicated position in a reading.
    line_names : tuple of str
        Names of the views in which lines were read.
    n_lines : int
        Lines of the plate, K.
    with_lines : tuple of int
        Which of these views are views of marks as well, if there are two or more: their marks and
        lines share rotations.
    placings : tuple of int
        First view of the placing of the plate to which each view belongs: the cells of an image
        see one plate, bent and drifting alike. Empty: each view is a placing.
    placing_names : tuple of str
        Names of the placings of the views.
    """

    z: np.ndarray
    half_width_m: float
    weight: np.ndarray
    visits: tuple[ViewVisits | None, ...]
    names: tuple[str, ...]
    indicated: int = 1
    line_names: tuple[str, ...] = ()
    n_lines: int = 0
    with_lines: tuple[int, ...] = ()
    placings: tuple[int, ...] = ()
    placing_names: tuple[str, ...] = ()

    @property
    def members(self) -> dict[int, list[int]]:
        """Views of each placing of the plate, by the first of them."""
        out: dict[int, list[int]] = {}
        for view, first in enumerate(self.placings or range(len(self.names))):
            out.setdefault(first, []).append(view)
        return out

    def names_of(self, term: str) -> tuple[str, ...]:
        """Return the names of the views of the columns of a term."""
        if term in OF_LINES:
            return self.line_names
        of_placing = term in OF_PLATE or term == TermName.DRIFT
        return self.placing_names if of_placing and self.placing_names else self.names

    def name_of(self, term: str, view: int) -> str:
        """Return the name of the view of a column; empty where all views share it (-1)."""
        return (*self.names_of(term), "")[view]


def placings_of(views: Sequence[View]) -> tuple[int, ...]:
    """Return the first of the views that belong to the same placing of the plate, for each view."""
    first: dict[str, int] = {}
    return tuple(row if view.cell is None else first.setdefault(view.plan_view, row)
                 for row, view in enumerate(views))


def ground_of(measurements: Measurements, grid: GridData, half_width_m: float) -> TermInputs:
    """Return the ground of a measurement whose grid readings are `grid`."""
    lines = [v for v in measurements.views if len(v.k)]
    shared = tuple(row for row, view in enumerate(lines) if len(view.m))
    z = maps_of(grid.y.shape[1:], grid.poses).z
    views = [measurements.views[i].view for i in grid.index]
    placings = placings_of(views)
    return TermInputs(z, half_width_m, grid.weight, visits_of(measurements, grid, placings),
                      tuple(view.name for view in views), approach_sign(measurements.sense),
                      tuple(view.view.name for view in lines), measurements.artifact.angular_count,
                      shared if len(shared) > 1 else (), placings,
                      tuple(view.plan_view for view in views))


def without_noise(ground: TermInputs, residuals: np.ndarray,
                  of_terms: Sequence[np.ndarray | float] = ()) -> TermInputs:
    """Return the ground with offsets from which the noise of the readings is taken off.

    The offset that a microscope saw holds the noise of its reading. As a column it would explain
    just that noise, and nothing else where offsets hardly differ. What the estimate leaves of each
    visit is taken off the offset: the rest owes nothing to the residuals.

    Parameters
    ----------
    ground : TermInputs
        With the offsets as they were seen.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    of_terms : sequence, optional
        What terms make of each visit of each view, (V,), plate frame, m; none without terms.
    """
    visits = []
    terms = of_terms or [0.0] * len(ground.visits)
    for view, residual, known in zip(ground.visits, residuals, terms, strict=True):
        if view is not None:
            rest = view.about_means((view.y - known)[None], residual.size)[0]
            rest = rest + residual.reshape(-1)[view.mark]
            view = replace(view, offset=view.offset - rest * np.conj(view.phase))
        visits.append(view)
    return replace(ground, visits=tuple(visits))
