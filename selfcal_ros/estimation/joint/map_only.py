# SPDX-License-Identifier: Apache-2.0
"""The stage map alone, again and again for new readings of a known plan.

For a machine that re-measures the same marks: what does not depend on the values is prepared
once, so that a new map costs one pass over the readings and one pair of triangular solves.
"""

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.joint.solve import prepare
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.normal.equations import MAX_DIRECT_SITES
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.readings import Measurements, Sense


class MapSolver:
    """Grid readings to stage map, for readings of the same marks as the first ones.

    The grid readings alone are used: angular ones would tell the views' rotations a little
    better. On plans without angular views the map is that of `calibrate`.

    Parameters
    ----------
    first : Measurements
        Readings that fix plan, marks and weights.

    Raises
    ------
    NoDataError, NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`; also for a field too large to factorise.
    """

    def __init__(self, first: Measurements) -> None:
        with one_thread():
            problem, _ = prepare(first, Options(uncertainty=False))
            system, grid = problem.system, problem.system.grid
            if grid.n_sites > MAX_DIRECT_SITES:
                raise InputError("map solver", f"{grid.n_sites} sites are too many to factorise",
                                 "use calibrate")
            self._grid, self._gauge = grid, system.gauge
            self._inverse = system.grid_inverse
            self._response, self._known = grid.response, system.known_sites
        self._sign = -1 if first.sense is Sense.PLATE_MOVES else 1
        self._index = problem.grid.index
        self._marks = [(first.views[i].m, first.views[i].n, first.views[i].count)
                       for i in self._index]
        (hx, hy), ny = first.artifact.half, first.artifact.shape[1]
        self._flat = [(m + hx) * ny + (n + hy) for m, n, _ in self._marks]
        self._back = [PHASES[-pose.q % 4] for pose in grid.views.poses]

    def solve(self, readings: Measurements) -> np.ndarray:
        """Return Gx and Gy in their datum, (2, nx, ny), m; NaN where not known.

        Raises
        ------
        InputError
            If other marks were read than at first, or in another order.
        """
        grid = self._grid
        y = np.zeros(grid.weight.shape, dtype=complex)
        for row, i in enumerate(self._index):
            view = readings.views[i]
            for now, then in zip((view.m, view.n, view.count), self._marks[row], strict=True):
                if now is not then and not np.array_equal(now, then):
                    raise InputError(f"view '{view.view.name}'", "not the marks of the first "
                                     "readings", "make a new solver")
            y[row].reshape(-1)[self._flat[row]] = (view.dx + 1j * view.dy) * self._back[row]
        if not np.isfinite(y).all():
            raise InputError("readings", "a deviation is not a finite number", "remove the mark")
        with one_thread():
            free, d = grid.reduced(y)
            field = (free - self._response @ (self._inverse @ d)).reshape(grid.views.shape)
        field = self._gauge.remove(field, self._gauge.parts(field))
        field[~self._known] = complex(np.nan, np.nan)
        if self._sign < 0:
            field = -field[::-1, ::-1]
        out = np.empty((2, *field.shape))
        out[0], out[1] = field.real, field.imag
        return out
