# SPDX-License-Identifier: Apache-2.0
"""The lattice maps of a set of views: from fields over sites to fields over marks, and back.

Vectors are complex numbers, z = x + iy, so that a quarter turn is a multiplication by i. In the
plate frame the model (method eq. 2.4, Hu 12-15) reads, for view v with q quarter turns,
    y_v(m) = i^-q G(X_v(m)) + A(m) + phi_v i z(m) + tau_v,     y_v = i^-q V_v,  tau_v = i^-q t_v.
A finite rotation adds (R(phi) - 1 - phi J) R^q m + (R(phi) - 1) R^q A to it (method eq. 2.6), with
R(phi) = exp(i phi).
"""

from dataclasses import dataclass
from functools import cached_property
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from selfcal_ros.estimation.lattice.readings import AnyPose, MapPose, pose_of
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import LatticePose
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.result import ArtifactMap

if TYPE_CHECKING:
    from selfcal_ros.estimation.lattice.placed import PlacedViews  # splines

PHASES = np.array([1, 1j, -1, -1j])
"""i^q for q = 0..3, exact."""


@dataclass(frozen=True)
class Window:
    """Marks of one view and their sites, as slices into the plate and into the field."""

    marks: tuple[slice, slice]
    sites: tuple[slice, slice]
    transposed: bool


def window(pose: LatticePose, half: tuple[float, float]) -> Window:
    """Return the marks of a view inside the field, and their sites, as slices.

    Site = R^q (u, v) + (a, b); a field with half widths `half`, pitches.
    """
    (hx, hy), swap = half, pose.q % 2 == 1
    # stage x = sx * (u or v) + a, stage y = sy * (v or u) + b
    sx, sy = ((1, 1), (-1, 1), (-1, -1), (1, -1))[pose.q]
    along_x, along_y = ((hy, hx) if swap else (hx, hy))
    p = _run(sx, pose.a, along_x, hx)
    r = _run(sy, pose.b, along_y, hy)
    marks = (r[0], p[0]) if swap else (p[0], r[0])
    return Window(marks, (p[1], r[1]), swap)


def _run(sign: int, shift: float, half_mark: float, half_site: float) -> tuple[slice, slice]:
    """Return the slices of u in [-half_mark, half_mark] with sign*u + shift in the field.

    Steps of 1. All ends are whole numbers, or all odd multiples of 1/2.
    """
    ends = sorted((sign * (-half_site - shift), sign * (half_site - shift)))
    low, high = max(ends[0], -half_mark), min(ends[1], half_mark)
    if low > high:
        return slice(0), slice(0)
    first, last = (int(sign * end + shift + half_site) for end in (low, high))
    stop = last + sign
    return (slice(int(low + half_mark), int(high + half_mark) + 1),
            slice(first, None if stop < 0 else stop, sign))


class LatticeViews:
    """The maps between sites and marks for the grid views of one calibration.

    Parameters
    ----------
    shape : tuple of int
        Marks (and sites) along x and y.
    poses : tuple of LatticePose
        One per view.
    unit : float
        Pitches in the unit of positions; 0 = the longer half width.
    """

    def __init__(self, shape: tuple[int, int], poses: tuple[LatticePose, ...],
                 unit: float = 0) -> None:
        self.shape, self.poses = shape, poses
        self.half = (shape[0] - 1) / 2, (shape[1] - 1) / 2
        self.unit = unit or max(self.half)
        self.windows = tuple(window(pose, self.half) for pose in poses)

    @property
    def reach(self) -> int:
        """Largest folded distance, in pitches, of two sites visited by one mark, rounded up."""
        out = 0.0
        for p in self.poses:
            for r in self.poses:
                if p.q == r.q:
                    out = max(out, abs(p.a - r.a), abs(p.b - r.b))
                else:
                    out = max(out, max(abs(p.a), abs(p.b)) + max(abs(r.a), abs(r.b)))
        return ceil(out)

    @property
    def plate_shape(self) -> tuple[int, int]:
        """Marks along x and y."""
        return self.shape

    def mark_at(self, i: int, j: int) -> tuple[int, int]:
        """Return the m and n of a mark by its index."""
        return int(i) - self.shape[0] // 2, int(j) - self.shape[1] // 2

    def index_of(self, m: int, n: int) -> tuple[int, int]:
        """Return the index of a mark."""
        return m + self.shape[0] // 2, n + self.shape[1] // 2

    @cached_property
    def phases(self) -> np.ndarray:
        """i^q of every view, exact, complex (views,)."""
        return np.array([pose.phase for pose in self.poses], dtype=complex)

    @cached_property
    def shifts(self) -> np.ndarray:
        """Position of the plate's centre in every view, in pitches, complex (views,)."""
        return np.array([pose.a + 1j * pose.b for pose in self.poses], dtype=complex)

    @cached_property
    def z_sites(self) -> np.ndarray:
        """Site positions in the unit, complex (nx, ny)."""
        return self.z

    @cached_property
    def z(self) -> np.ndarray:
        """Mark positions in the unit, complex (nx, ny)."""
        x, y = (np.arange(size) - half for size, half in zip(self.shape, self.half, strict=True))
        return (x[:, None] + 1j * y) / self.unit

    @cached_property
    def in_field(self) -> np.ndarray:
        """Marks inside the field, bool (views, nx, ny)."""
        out = np.zeros((len(self.poses), *self.shape), dtype=bool)
        for index, win in enumerate(self.windows):
            out[index][win.marks] = True
        return out

    @cached_property
    def site_index(self) -> np.ndarray:
        """Flat index of the site of every mark, int (views, nx, ny); -1 off the field."""
        flat = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        out = np.full((len(self.poses), *self.shape), -1)
        for index, win in enumerate(self.windows):
            sites = flat[win.sites]
            out[index][win.marks] = sites.T if win.transposed else sites
        return out

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return i^-q G(X_v(m)), complex (..., views, nx, ny), 0 where the mark is off the field.

        Parameters
        ----------
        field : complex array (..., nx, ny)
            G, or several fields.
        """
        out = np.zeros((*field.shape[:-2], len(self.poses), *self.shape), dtype=complex)
        for index, (pose, win) in enumerate(zip(self.poses, self.windows, strict=True)):
            sites = field[(..., *win.sites)]
            np.multiply(sites.swapaxes(-1, -2) if win.transposed else sites, PHASES[-pose.q % 4],
                        out=out[(..., index, *win.marks)])
        return out

    def gather_mean(self, field: np.ndarray, relative_weight: np.ndarray) -> np.ndarray:
        """Return the sum over views of relative_weight times `gather`, complex (nx, ny)."""
        out = np.zeros(self.shape, dtype=complex)
        for index, (pose, win) in enumerate(zip(self.poses, self.windows, strict=True)):
            sites = field[win.sites]
            part = (sites.T if win.transposed else sites) * relative_weight[index][win.marks]
            _add_turned(out[win.marks], part, -pose.q % 4)
        return out

    def subtract_scattered(self, out: np.ndarray, weight: np.ndarray, mean: np.ndarray) -> None:
        """Subtract the scatter of weight times one field over the marks from `out`."""
        for index, (pose, win) in enumerate(zip(self.poses, self.windows, strict=True)):
            part = weight[index][win.marks] * mean[win.marks]
            _add_turned(out[win.sites], part.T if win.transposed else part, (pose.q + 2) % 4)

    def add_scattered(self, out: np.ndarray, index: int, marks: np.ndarray) -> None:
        """Add the scatter of one view's fields over the marks to `out`, (..., nx, ny) both."""
        win = self.windows[index]
        part = marks[(..., *win.marks)]
        _add_turned(out[(..., *win.sites)], part.swapaxes(-1, -2) if win.transposed else part,
                    self.poses[index].q)

    def scatter_weight(self, weight: np.ndarray) -> np.ndarray:
        """Return the sum of the weights of all readings at every site, (nx, ny)."""
        out = np.zeros(self.shape)
        for index, win in enumerate(self.windows):
            part = weight[index][win.marks]
            out[win.sites] += part.T if win.transposed else part
        return out

    @cached_property
    def _of_site(self) -> tuple[np.ndarray, np.ndarray]:
        """Index of the mark on every site, and i^q or 0 if there is none, (views, sites)."""
        n = self.shape[0] * self.shape[1]
        place = np.zeros((len(self.poses), n), dtype=int)
        phase = np.zeros(place.shape, dtype=complex)
        for v, pose in enumerate(self.poses):
            marks = np.flatnonzero(self.in_field[v])
            sites = self.site_index[v].reshape(-1)[marks]
            place[v, sites], phase[v, sites] = marks + v * n, PHASES[pose.q]
        return place, phase

    def scatter(self, marks: np.ndarray) -> np.ndarray:
        """Return the adjoint of `gather`: the sum over views at every site, complex (nx, ny)."""
        place, phase = self._of_site
        return (marks.reshape(-1)[place] * phase).sum(axis=0).reshape(self.shape)


def _add_turned(out: np.ndarray, part: np.ndarray, q: int) -> None:
    """Add i^q times `part` to `out` without multiplying: only signs and parts are exchanged."""
    if q == 0:
        out += part
    elif q == 2:
        out -= part
    else:
        sign = np.subtract if q == 1 else np.add
        sign(out.real, part.imag, out=out.real)
        (np.add if q == 1 else np.subtract)(out.imag, part.real, out=out.imag)


def rigid_parameters(views: LatticeViews) -> np.ndarray:
    """Return the misalignments of the 7 datum modes, (7, views, 3): phi, Re and Im tau.

    Modes: stage translation x, y, rotation, scale; plate translation x, y, rotation; unit
    length (or unit angle times the longer half width). A mode G, A with these misalignments
    changes no reading (method eq. 3.1).
    """
    out = np.zeros((7, len(views.poses), 3))
    for v, back in enumerate(views.phases.conj()):
        shift = back * views.shifts[v] / views.unit
        taus = (-back, -1j * back, -1j * shift, -shift, -1, -1j, 0)
        out[:, v, 0] = (0, 0, -1, 0, 0, 0, -1)
        out[:, v, 1], out[:, v, 2] = np.real(taus), np.imag(taus)
    return out


type AnyViews = LatticeViews | PlacedViews
"""The maps of the grid views of one calibration."""


def maps_of(shape: tuple[int, int], poses: tuple[AnyPose, ...]) -> AnyViews:
    """Return the maps of views of a plate with `shape` marks."""
    placed = tuple(pose for pose in poses if isinstance(pose, MapPose))
    if placed:
        from selfcal_ros.estimation.lattice.placed import PlacedViews  # splines

        return PlacedViews(placed)
    return LatticeViews(shape, tuple(pose for pose in poses if isinstance(pose, LatticePose)))


def turned_marks(view: ViewReadings, artifact: Artifact) -> np.ndarray:
    """Return R^q m of the marks read, from the plate's centre, complex (P,), stage frame, m."""
    turn = pose_of(view.view, artifact).phase
    x, y = artifact.places(view.m, view.n)
    return turn * (x + 1j * y) * artifact.grid_pitch_m


def turned_plate(view: ViewReadings, artifact: Artifact, plate: ArtifactMap) -> np.ndarray:
    """Return R^q A of the marks read, complex (P,), stage frame, m; NaN where unknown."""
    turn = pose_of(view.view, artifact).phase
    at = artifact.index(view.m, view.n)
    return turn * (plate.ax[at] + 1j * plate.ay[at])


def rotation_excess(phi_rad: float, marks: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return the contribution of the rotation beyond the linear model, complex (P,), m."""
    turn = np.expm1(1j * phi_rad)
    return (turn - 1j * phi_rad) * marks + turn * plate  # method eq. 2.6
