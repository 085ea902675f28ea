# SPDX-License-Identifier: Apache-2.0
"""Where the stage stood at the readings, and what its error is there (method eq. 7.10).

A reading has the stage error of the place where the stage truly stands, and the linear equations
give it that of the mark's site. Between the sites the error is the bicubic spline that
`selfcal_ros.compensation.compensator` uses, and beyond the outermost sites its continuation.
Everything is in the frame of the equations.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.compensation.cells import Cells, bicubic_cells, bilinear_cells
from selfcal_ros.estimation.lattice.maps import LatticeViews, maps_of
from selfcal_ros.estimation.lattice.readings import GridData
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.readings import Measurements

AT_SITES = 1e-5
"""Distance from the sites, in pitches, at which the stage is indicated at them: an error of a
micrometre is 10 pm off there. Slopes are taken over twice as much."""


@dataclass(frozen=True, eq=False)
class StagePlaces:
    """Places of the stage at the readings of the grid views.

    Attributes
    ----------
    views : LatticeViews
        Marks and sites of the views.
    pitch_m : float
        Distance of neighbouring sites, m.
    known : bool array (nx, ny)
        Sites whose error is known.
    at : tuple of int arrays (P,)
        View, row and column of the readings whose place, and the error of whose site, is known.
    away_m : complex array (P,)
        Indicated position of the stage less the site of the mark, mean of the visits, m.
    marks : tuple of int array (V,) or None
        Mark of each visit of each view; None where visits are not known.
    about_m : tuple of complex array (V,) or None
        Indicated position at each visit less the mean of its mark, m.
    """

    views: LatticeViews
    pitch_m: float
    known: np.ndarray
    at: tuple[np.ndarray, ...]
    away_m: np.ndarray
    marks: tuple[np.ndarray | None, ...]
    about_m: tuple[np.ndarray | None, ...]

    @cached_property
    def site(self) -> np.ndarray:
        """Site of the mark of each reading, (P,)."""
        return self.views.site_index[self.at]

    @cached_property
    def distance(self) -> float:
        """How far the stage stood off the sites, in pitches (rms)."""
        return rms(np.abs(self.away_m)) / self.pitch_m

    @property
    def beside(self) -> bool:
        """Whether the stage was indicated beside the sites."""
        return bool(np.abs(self.away_m).max() > AT_SITES * self.pitch_m)

    def true_distance_m(self, error: np.ndarray) -> float:
        """Return how far off the sites the stage with an error (P,), m, truly stood (rms), m."""
        return rms(np.abs(self.away_m - error))

    def differences(
        self, field: np.ndarray, near: np.ndarray | None = None, *, local: bool = False
    ) -> np.ndarray:
        """Return the stage error where the stage stood less that at the site, (P,), m.

        Parameters
        ----------
        field : complex array (nx, ny)
            Stage error at the sites, m.
        near : complex array (P,), optional
            Stage error where the stage stood, as far as it is known: the true place is the
            indicated one less it. That at the site without it.
        local : bool
            Whether the spline has the slopes between neighbours.
        """
        filled = _filled(field, self.known)
        at_site = self._at_nominal(filled)
        x, y = self._cells(filled, local=local).beyond(
            *self._place(at_site if near is None else near)
        )
        return x + 1j * y - at_site

    def _at_nominal(self, field: np.ndarray) -> np.ndarray:
        """Return a field at the nominal place of each reading, (P,)."""
        return self.views.gather(field)[self.at] * self.views.phases[self.at[0]]

    def errors(
        self, field: np.ndarray, differences: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the stage error where the stage stood, (P,), m, given that at the sites."""
        at_site = self._at_nominal(_filled(field, self.known))
        return at_site + (
            self.differences(field) if differences is None else differences
        )

    def changes(self, differences: np.ndarray, turn_rad: np.ndarray) -> np.ndarray:
        """Return what differences of the stage error do to the readings, (views, nx, ny), m.

        Parameters
        ----------
        differences : complex array (P,)
            Differences, frame of the equations, m.
        turn_rad : float array (views,)
            Angle by which the frame of each view's readings is turned.
        """
        out = np.zeros((len(self.about_m), *self.views.plate_shape), dtype=complex)
        out[self.at] = differences * self._phase(turn_rad)[self.at[0]]
        return out

    def about(
        self, field: np.ndarray, near: np.ndarray, turn_rad: np.ndarray
    ) -> list[np.ndarray | float]:
        """Return the excess of the visits of each view over the mean of their mark, (V,), m.

        By the slopes of the stage error where the stage stood; arguments as in `differences` and
        `changes`.
        """
        cells = self._cells(_filled(field, self.known))
        s, t = self._place(near)
        slopes = np.zeros(
            (2, len(self.about_m), *self.views.plate_shape), dtype=complex
        )
        for slope, (a, b) in zip(
            slopes, ((AT_SITES, 0.0), (0.0, AT_SITES)), strict=True
        ):
            x, y = (cells.beyond(s + a, t + b) - cells.beyond(s - a, t - b)) / (
                2 * AT_SITES
            )
            slope[self.at] = (x + 1j * y) / self.pitch_m
        out: list[np.ndarray | float] = []
        for row, (away, marks) in enumerate(zip(self.about_m, self.marks, strict=True)):
            if away is None:
                out.append(0.0)
                continue
            along_x, along_y = slopes[:, row].reshape(2, -1)[:, marks]
            out.append(
                (along_x * away.real + along_y * away.imag) * self._phase(turn_rad)[row]
            )
        return out

    def _place(self, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the stage truly stood, in pitches from the corner of the field, (P,)."""
        away = (self.away_m - error) / self.pitch_m
        s, t = self.views.from_corner  # nominal places of the marks
        return s[self.at] + away.real, t[self.at] + away.imag

    def _cells(self, field: np.ndarray, *, local: bool = False) -> Cells:
        """Return the interpolant of a field between the nodes of the map."""
        components = np.stack([field.real, field.imag])
        if self.views.bilinear:
            return bilinear_cells(components)
        return bicubic_cells(components, local=local)

    def _phase(self, turn_rad: np.ndarray) -> np.ndarray:
        """Return the factor of each view from the stage frame to that of its readings."""
        return self.views.phases.conj() * np.exp(-1j * turn_rad)


def _filled(field: np.ndarray, known_sites: np.ndarray) -> np.ndarray:
    """Return a field with unknown sites on straight lines through known ones of row and column."""
    if known_sites.all():
        return field
    rows_first = _along_both(field, known_sites)
    columns_first = _along_both(field.T, known_sites.T).T
    return (rows_first + columns_first) / 2


def _along_both(field: np.ndarray, known_sites: np.ndarray) -> np.ndarray:
    """Return a field filled along rows and columns with two known sites, then with one."""
    for least in (2, 2, 1, 1):
        field, known_sites = field.copy(), known_sites.copy()
        for row in np.flatnonzero(
            (known_sites.sum(axis=1) >= least) & ~known_sites.all(axis=1)
        ):
            places_known = np.flatnonzero(known_sites[row])
            unknown = np.flatnonzero(~known_sites[row])
            above = np.clip(
                np.searchsorted(places_known, unknown),
                min(1, len(places_known) - 1),
                len(places_known) - 1,
            )
            a = places_known[above - 1]
            b = places_known[above]
            slope = (field[row, b] - field[row, a]) / np.maximum(b - a, 1)
            field[row, unknown] = field[row, a] + (unknown - a) * slope
            known_sites[row] = True
        field, known_sites = field.T, known_sites.T
    return field


def places_of(
    measurements: Measurements,
    grid: GridData,
    inputs: TermInputs,
    known_sites: np.ndarray,
) -> StagePlaces | None:
    """Return where the stage stood; None where no visit tells.

    Parameters
    ----------
    measurements : Measurements
        The readings.
    grid, inputs : GridData, TermInputs
        What is made of them.
    known_sites : bool array (nx, ny)
        Sites whose error is known.
    """
    views = maps_of(grid)
    away = np.zeros(grid.y.shape, dtype=complex)
    located = np.zeros(away.shape, dtype=bool)
    marks: list[np.ndarray | None] = []
    about: list[np.ndarray | None] = []
    for row, (index, visits) in enumerate(zip(grid.index, inputs.visits, strict=True)):
        read_visits = measurements.views[index].visits
        if visits is None or read_visits is None:
            marks.append(None)
            about.append(None)
            continue
        offset_from_target = (
            read_visits.dx
            - read_visits.offset_x
            + 1j * (read_visits.dy - read_visits.offset_y)
        )
        mean = visits.means(offset_from_target[None], grid.y[0].size)[0]
        away[row], located[row].reshape(-1)[visits.mark] = (
            mean.reshape(grid.y.shape[1:]),
            True,
        )
        marks.append(visits.mark)
        about.append(offset_from_target - mean[visits.mark])
    located &= views.near(known_sites) & (grid.weight > 0)
    pitch_m = inputs.half_width_m / views.unit * views.node_pitch
    if not located.any():
        return None
    return StagePlaces(
        views=views,
        pitch_m=pitch_m,
        known=known_sites,
        at=np.nonzero(located),
        away_m=away[located],
        marks=tuple(marks),
        about_m=tuple(about),
    )
