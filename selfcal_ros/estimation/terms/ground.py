# SPDX-License-Identifier: Apache-2.0
"""What the columns of terms stand on: plate, views and visits of a measurement."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.lattice.maps import LatticeViews
from selfcal_ros.estimation.lattice.readings import GridData
from selfcal_ros.estimation.terms.visits import ViewVisits, approach_sign, visits_of
from selfcal_ros.model.readings import Measurements


@dataclass(frozen=True, eq=False)
class Ground:
    """What the columns stand on.

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
    """

    z: np.ndarray
    half_width_m: float
    weight: np.ndarray
    visits: tuple[ViewVisits | None, ...]
    names: tuple[str, ...]
    indicated: int = 1


def ground_of(measurements: Measurements, grid: GridData, half_width_m: float) -> Ground:
    """Return the ground of a measurement whose grid readings are `grid`."""
    z = LatticeViews(grid.y.shape[1:], grid.poses).z
    names = tuple(measurements.views[i].view.name for i in grid.index)
    return Ground(z, half_width_m, grid.weight, visits_of(measurements, grid), names,
                  approach_sign(measurements.sense))
