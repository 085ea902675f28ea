# SPDX-License-Identifier: Apache-2.0
"""The scale of the map from a reference length: a certified plate or a laser-measured axis.

No view determines the magnification: G = s z, A = -s m with matching offsets changes no reading.
The map in its datum (no scale) becomes G + c z, with c from the reference (method eq. 3.5).
"""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.lattice.gauge import Gauge
from selfcal_ros.estimation.normal.equations import NormalEquations
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength


@dataclass(frozen=True, eq=False)
class ScaleDatum:
    """Dependence of the scale on a solution: c = const + Re(rows^H G) + parameters . p + noise.

    Attributes
    ----------
    rows : complex array (sites,)
        Factors of the map in no particular datum.
    parameters : float array (3 views,)
        Factors of the corresponding misalignments.
    variance : float
        Variance of the remaining part, for unit noise of one grid reading.
    u_m : float
        Standard uncertainty of the reference itself, m at the unit of position.
    of_plate : bool
        Whether the plate sets the scale, so that terms acting on its marks change it.
    """

    rows: np.ndarray
    parameters: np.ndarray
    variance: float
    u_m: float
    of_plate: bool = False


def scale_datum(system: NormalEquations, reference: ReferenceLength,
                half_width_m: float) -> ScaleDatum:
    """Return the scale set by a reference length.

    Parameters
    ----------
    system : NormalEquations
        The measured plan.
    reference : ReferenceLength
        The length.
    half_width_m : float
        Unit of the system's positions, m.
    """
    grid, n = system.grid, 3 * system.grid.n_views
    u = reference.u_relative * half_width_m
    if reference.kind is not ReferenceKind.ARTIFACT:
        rows = _slope(grid.views.z, system.known_sites, reference.kind)
        basis = system.gauge.orthonormal
        rows = rows - basis @ np.real(basis.conj().T @ rows)
        return ScaleDatum(-rows, np.zeros(n), 0.0, u)
    dual = Gauge(grid.views.z, system.known_marks, scale=True).dual(3)
    rows = system.gauge.dual(3).ravel() - grid.views.scatter(grid.relative_weight * dual).ravel()
    sums = -np.einsum("cij,vij->vc", np.conj(grid.shapes), grid.relative_weight * dual)
    parameters = np.stack([sums[:, 0].real, sums[:, 1].real, sums[:, 1].imag], axis=1).ravel()
    total = grid.weight.sum(axis=0)
    variance = float((abs(dual) ** 2 / np.where(grid.mark_read, total, np.inf)).sum())
    return ScaleDatum(rows, parameters, variance, u, of_plate=True)


def scale_of(system: NormalEquations, reference: ReferenceLength, *, field: np.ndarray,
             plate: np.ndarray, half_width_m: float) -> float:
    """Return c for a map and a plate in their datum, m at the unit of position."""
    value = reference.relative_error * half_width_m
    if reference.kind is not ReferenceKind.ARTIFACT:
        rows = _slope(system.grid.views.z, system.known_sites, reference.kind)
        return value - float(np.real(rows.conj() @ field.ravel()))
    dual = Gauge(system.grid.views.z, system.known_marks, scale=True).dual(3)
    return float(np.real(np.vdot(dual, plate))) - value


def _slope(z: np.ndarray, known: np.ndarray, kind: ReferenceKind) -> np.ndarray:
    """Return the row of the slope of Gx on x, or Gy on y, over the known sites, (sites,)."""
    along, unit = (z.real, 1) if kind is ReferenceKind.STAGE_X else (z.imag, 1j)
    centred = np.where(known, along - along[known].mean(), 0.0)
    return (unit * centred / (centred**2).sum()).ravel()
