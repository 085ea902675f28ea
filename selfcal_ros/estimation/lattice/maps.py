# SPDX-License-Identifier: Apache-2.0
"""The lattice maps of a set of views: from fields over sites to fields over marks, and back.

Vectors are complex numbers, z = x + iy, so that a quarter turn is a multiplication by i. In the
plate frame the model (method eq. 2.4, Hu 12-15) reads, for view v with q quarter turns,
    y_v(m) = i^-q G(X_v(m)) + A(m) + phi_v i z(m) + tau_v,     y_v = i^-q V_v,  tau_v = i^-q t_v.
A finite rotation adds (R(phi) - 1 - phi J) R^q m + (R(phi) - 1) R^q A to it (method eq. 2.6), with
R(phi) = exp(i phi).
"""

from functools import cached_property
from itertools import product
from math import ceil

import numpy as np

from selfcal_ros.model.pose import LatticePose

PHASES = np.array([1, 1j, -1, -1j])
"""i^q for q = 0..3, exact."""


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

    bilinear = False
    """Whether the map is bilinear between its nodes; on a lattice the nodes are the sites."""
    node_pitch = 1.0
    """Distance of neighbouring nodes, in pitches of the plate."""

    def __init__(self, shape: tuple[int, int], poses: tuple[LatticePose, ...],
                 unit: float = 0) -> None:
        self.shape, self.plate_shape, self.poses = shape, shape, poses
        self.half = (shape[0] - 1) / 2, (shape[1] - 1) / 2
        self.unit = unit or max(self.half)

    @property
    def reach(self) -> int:
        """Largest folded distance, in pitches, of two sites visited by one mark, rounded up."""
        out = 0.0
        for (p, r), (turn, other) in zip(product(self.shifts, repeat=2),
                                         product(self.phases, repeat=2), strict=True):
            (a, b), (c, d) = (p.real, p.imag), (r.real, r.imag)
            out = max(out, max(abs(a - c), abs(b - d)) if turn == other else
                      max(abs(a), abs(b)) + max(abs(c), abs(d)))
        return ceil(out)

    def mark_at(self, i: int, j: int) -> tuple[int, int]:
        """Return the m and n of a mark by its index."""
        return int(i) - self.shape[0] // 2, int(j) - self.shape[1] // 2

    def index_of(self, m: int, n: int) -> tuple[int, int]:
        """Return the index of a mark."""
        return m + self.shape[0] // 2, n + self.shape[1] // 2

    @cached_property
    def phases(self) -> np.ndarray:
        """Factor of every view from the plate frame to the stage frame, complex (views,)."""
        return np.array([pose.phase for pose in self.poses], dtype=complex)

    @cached_property
    def shifts(self) -> np.ndarray:
        """Position of the plate's centre in every view, in pitches, complex (views,)."""
        return np.array([complex(*pose.shift) for pose in self.poses], dtype=complex)

    @cached_property
    def z_sites(self) -> np.ndarray:
        """Node positions in the unit, complex (cx, cy)."""
        return self.z

    @cached_property
    def places(self) -> np.ndarray:
        """Mark positions, in pitches, complex (nx, ny)."""
        x, y = (np.arange(size) - half for size, half in zip(self.shape, self.half, strict=True))
        return x[:, None] + 1j * y

    @property
    def z(self) -> np.ndarray:
        """Mark positions in the unit, complex (nx, ny)."""
        return self.places / self.unit

    @cached_property
    def from_corner(self) -> tuple[np.ndarray, np.ndarray]:
        """Places of the marks in the pitch of the map from its first node, (views, nx, ny) each."""
        turn, shift = (part[:, None, None] for part in (self.phases, self.shifts))
        at = (turn * self.places + shift) / self.node_pitch
        return at.real + self.half[0], at.imag + self.half[1]

    @cached_property
    def in_field(self) -> np.ndarray:
        """Marks inside the field, bool (views, nx, ny)."""
        (x, y), (nx, ny) = self.from_corner, self.shape
        return (x >= 0) & (x < nx) & (y >= 0) & (y < ny)

    @cached_property
    def site_index(self) -> np.ndarray:
        """Flat index of the node nearest to every mark, int (views, nx, ny); -1 off the field."""
        i, j = (np.clip(np.rint(part).astype(int), 0, size - 1)
                for part, size in zip(self.from_corner, self.shape, strict=True))
        return np.where(self.in_field, i * self.shape[1] + j, -1)

    def near(self, nodes: np.ndarray) -> np.ndarray:
        """Return the marks on sites of a bool array (nx, ny), (views, nx, ny)."""
        return self.in_field & nodes.reshape(-1)[self.site_index]

    def gather(self, field: np.ndarray) -> np.ndarray:
        """Return i^-q G(X_v(m)), complex (..., views, nx, ny), 0 where the mark is off the field.

        Parameters
        ----------
        field : complex array (..., nx, ny)
            G, or several fields.
        """
        out = _taken(field, self.site_index)
        out *= self.phases.conj()[:, None, None]
        return out

    @cached_property
    def _mark_on(self) -> np.ndarray:
        """Flat index of the mark on every site in each view, int (views, nx, ny); -1 = none."""
        out = np.full((len(self.poses), self.shape[0] * self.shape[1]), -1)
        for mark_on, site in zip(out, self.site_index.reshape(out.shape), strict=True):
            here = np.flatnonzero(site >= 0)
            mark_on[site[here]] = here
        return out.reshape(-1, *self.shape)

    def add_scattered(self, out: np.ndarray, index: int, marks: np.ndarray) -> None:
        """Add the scatter of one view's fields over the marks to `out`, (..., nx, ny) both."""
        out += _taken(marks, self._mark_on[index]) * self.phases[index]

    def scatter(self, marks: np.ndarray) -> np.ndarray:
        """Return the adjoint of `gather`: the sum over views at every site, complex (nx, ny)."""
        out = np.zeros(self.shape, dtype=complex)
        for index, one in enumerate(marks):
            self.add_scattered(out, index, one)
        return out


def _taken(fields: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return values of fields (..., nx, ny) at flat indices, complex (..., *at); 0 at -1."""
    *several, nx, ny = fields.shape
    flat = np.zeros((*several, nx * ny + 1), dtype=complex)
    flat[..., :-1] = fields.reshape(*several, nx * ny)
    return flat.take(at, axis=-1, mode="wrap")  # -1 is the 0 at its end


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


def rotation_excess(phi_rad: float, marks: np.ndarray, plate: np.ndarray) -> np.ndarray:
    """Return the contribution of the rotation beyond the linear model, complex (P,), m."""
    turn = np.expm1(1j * phi_rad)
    return (turn - 1j * phi_rad) * marks + turn * plate  # method eq. 2.6
