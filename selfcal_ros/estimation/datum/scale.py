# SPDX-License-Identifier: Apache-2.0
"""The scale of the maps from a reference length, and the first-order terms that have no datum.

No view determines the magnification: G = s z, A = -s m with offsets to match changes no reading.
With a reference the maps in their datum (no scale) become G + c z and A - c m, with c such that the
reference holds (method eq. 3.5).
"""

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength
from selfcal_ros.model.artifact import Artifact


def scale_of(system: NormalEquations, reference: ReferenceLength, *, field: np.ndarray,
             plate: np.ndarray, half_width_m: float) -> float:
    """Return c for a map and a plate in their datum, m at the unit of position."""
    value = reference.relative_error * half_width_m
    if not reference.kind.of_plate:
        return value - float(np.real(_slope(system, reference.kind).conj() @ field.ravel()))
    return float(np.real(np.vdot(scale_of_plate(system, reference), plate))) - value


def scale_rows(system: NormalEquations, reference: ReferenceLength
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return c as functionals of both maps in their datum, complex (sites, 1) and (marks, 1)."""
    sites = np.zeros((system.grid.n_sites, 1), dtype=complex)
    marks = np.zeros((system.grid.n_marks, 1), dtype=complex)
    if reference.kind.of_plate:
        marks[:, 0] = scale_of_plate(system, reference).reshape(-1)
    else:
        sites[:, 0] = -_slope(system, reference.kind)
    return sites, marks


def scale_of_plate(system: NormalEquations, reference: ReferenceLength) -> np.ndarray:
    """Return the row of the plate's map that is its scale, complex (nx, ny).

    That of the distance of two marks if the reference is one, else the least-squares scale.

    Raises
    ------
    InputError
        If one of the two marks was not measured.
    """
    z, known = system.grid.views.z, system.known_marks
    if reference.marks is None:
        return Gauge(z, known, scale=True).dual(3)
    first, second = (system.grid.views.index_of(*mark) for mark in reference.marks)
    for mark, at in zip(reference.marks, (first, second), strict=True):
        if not known[at]:
            raise InputError("reference length", f"the mark {mark} was not measured",
                             "measure it, or take another reference")
    apart, row = z[second] - z[first], np.zeros(z.shape, dtype=complex)
    row[second], row[first] = (sign * apart / abs(apart) ** 2 for sign in (1, -1))
    return row


def _slope(system: NormalEquations, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope of Gx on x, or Gy on y, over the known sites, (sites,)."""
    z, known = system.grid.views.z_sites, system.known_sites
    along, unit = (z.real, 1) if kind is ReferenceKind.STAGE_X else (z.imag, 1j)
    centred = np.where(known, along - along[known].mean(), 0.0)
    return (unit * centred / (centred**2).sum()).ravel()


def first_order(artifact: Artifact, field: np.ndarray) -> tuple[float, float]:
    """Return O and R (Hu eq. 6) of a map, complex (nx, ny), m; NaN where it is unknown."""
    z, pitch_m = artifact.x_m + 1j * artifact.y_m, artifact.grid_pitch_m
    o, r = Gauge(z / pitch_m, np.isfinite(field), scale=True).first_order(field)
    return o / pitch_m, r / pitch_m
