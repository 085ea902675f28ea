# SPDX-License-Identifier: Apache-2.0
"""Slips of the plate within a view: find and size them, split the view into two placements.

A view is read line by line. If the plate slips on the way, the rest of the view has another
misalignment. For each view and each line the gain of a second misalignment is tested: the sum of
squares that it explains, from the projection of its three columns on the residuals.

A turned microscope, a drift or a plate that grew leaves residuals that a second misalignment
removes in part. Before a view is split, its slip therefore competes with every term that the model
does not hold.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.joint.fit import JointFit, fit
from selfcal_ros.estimation.joint.problem import Problem
from selfcal_ros.estimation.joint.solve import fit_joint, prepare
from selfcal_ros.estimation.normal.equations import grid_residuals
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.residuals import Residuals
from selfcal_ros.estimation.verdict.causes import cause_of
from selfcal_ros.estimation.verdict.explanations import find_explanations
from selfcal_ros.estimation.verdict.off_sites import SLIP, PlacedSlip
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.verdict import Cause, Finding

AMBIGUOUS = 16.0
"""Difference of chi^2 up to which two places explain the readings equally well."""

TRIED = 12
"""Number of places at which the view is split on trial."""

TINY_M2 = 1e-30
"""Square of a noise that is rounding error."""

SLIP_LEVEL = 1e-9
"""Level of the test of each place where the plate may have slipped."""

MAX_PLACES = 20
"""Largest number of places tested along each axis of a view."""

CLIP = 4.0
"""Standard deviations to which residuals are clipped: one outlier is not a slip."""


@dataclass(frozen=True)
class SlipPlace:
    """Where in a view the plate may have slipped.

    Attributes
    ----------
    view : str
        Name of the view.
    index : int
        Its position in the measurement.
    axis : str
        ``m`` or ``n``: index of the marks along which the view was read.
    first : int
        First value of that index after the slip.
    chi2 : float
        Explained sum of squares over the noise variance; 3 on average without a slip.
    """

    view: str
    index: int
    axis: str
    first: int
    chi2: float

    @property
    def place(self) -> dict[str, str | int]:
        """View, axis and first line of marks after the slip."""
        return {"view": self.view, "axis": self.axis, "first": self.first}


@dataclass(frozen=True)
class Slip(SlipPlace):
    """A slip of the plate within a view, at a place.

    Attributes
    ----------
    tx_m, ty_m, phi_rad : float
        Change of offset and rotation, stage frame.
    alternatives : tuple of SlipPlace
        Other places that explain the readings equally well: few views do not always determine it.
    """

    tx_m: float
    ty_m: float
    phi_rad: float
    alternatives: tuple[SlipPlace, ...] = ()

    def finding(self, *, spoils: bool) -> Finding:
        """Return the slip as a finding; `spoils` if the view had to be kept unsplit."""
        return Finding(
            "slip_found", float(np.hypot(self.tx_m, self.ty_m)), unit="m", view=self.view, details={
                "places": [place.place for place in (self, *self.alternatives)], "x": self.tx_m,
                "y": self.ty_m, "phi": self.phi_rad, "spoils": spoils})


def find_slip(residuals: Residuals, sigma_m: float, measurements: Measurements,
              options: Options) -> Slip | None:
    """Return the slip that explains the residuals best; None if no place passes the test.

    The view is split on trial at the places that explain most; the best split is the slip.

    Parameters
    ----------
    residuals : Residuals
        Residuals of the fit.
    sigma_m : float
        Noise of one reading, m.
    measurements, options : Measurements, Options
        The readings and how they were fitted.
    """
    grid = residuals.problem.system.grid
    found: list[SlipPlace] = []
    limit = CLIP * sigma_m / np.sqrt(np.where(grid.read, grid.weight, 1.0))
    size = abs(residuals.found.residuals)
    clipped = residuals.found.residuals * np.minimum(1.0, limit / np.maximum(size, 1e-300))
    for v, i in enumerate(residuals.problem.grid.index):
        for axis in (0, 1) if measurements.artifact.marks is None else ():
            for place in _places(grid.read[v], axis):
                gain = _explained(residuals, clipped, v, axis, place)
                if gain is not None and gain / sigma_m**2 >= chdtri(3, SLIP_LEVEL):
                    found.append(SlipPlace(measurements.views[i].view.name, i, "mn"[axis],
                                           grid.views.mark_at(place, place)[axis],
                                           gain / sigma_m**2))
    found.sort(key=lambda slip: -slip.chi2)
    return _best(found[:TRIED], measurements, options)


def _best(found: list[SlipPlace], measurements: Measurements, options: Options) -> Slip | None:
    """Return the slip whose split leaves the smallest clipped sum of squares."""
    fits = []
    for slip in found:
        try:
            problem, _ = prepare(split_view(measurements, slip), options)
        except NotIdentifiableError:
            continue
        fitted = fit(problem, problem.grid.y)
        weight = problem.grid.weight
        squares = (abs(fitted.residuals) ** 2 * weight)[weight > 0]
        fits.append((slip, squares, _size(slip, fitted, problem)))
    if not fits:
        return None
    limit = CLIP**2 * max(min(float(np.median(squares)) for _, squares, _ in fits), TINY_M2)
    losses = [float(np.minimum(squares, limit).sum()) for _, squares, _ in fits]
    order = np.argsort(losses, kind="stable")
    slip, squares, size = fits[order[0]]
    # the loss counts residuals, which are smaller than the noise by the part that the fit follows
    system = prepare(split_view(measurements, slip), options)[0].system
    dof_part = 1 - system.rank_grid / (2 * system.grid.n_readings)
    near = losses[order[0]] + AMBIGUOUS * float(np.median(squares)) / chdtri(2, 0.5) / dof_part
    others = tuple(fits[i][0] for i in order[1:] if losses[i] < near)
    tx_m, ty_m, phi_rad = size
    return Slip(slip.view, slip.index, slip.axis, slip.first, slip.chi2, tx_m, ty_m, phi_rad,
                others)


def _size(slip: SlipPlace, fitted: JointFit, problem: Problem) -> tuple[float, float, float]:
    """Return offset and rotation of the second placement minus those of the first."""
    row = problem.grid.index.index(slip.index)
    before, after = fitted.parameters[:3 * problem.system.grid.n_views].reshape(-1, 3)[row:row + 2]
    phi, re, im = after - before
    t = problem.grid.poses[row].phase * complex(re, im)
    return float(t.real), float(t.imag), float(phi / problem.half_width_m)


def _places(read: np.ndarray, axis: int) -> np.ndarray:
    """Return the lines before which a slip is tested: at least one line was read on either side."""
    lines = np.flatnonzero(read.any(axis=1 - axis))
    inner = lines[1:]
    if len(inner) <= MAX_PLACES:
        return inner
    return inner[np.linspace(0, len(inner) - 1, MAX_PLACES).round().astype(int)]


def _explained(residuals: Residuals, clipped: np.ndarray, v: int, axis: int,
               place: int) -> float | None:
    """Return the sum of squares that a slip explains, m^2; None where it cannot be tested."""
    system = residuals.problem.system
    grid = system.grid
    after = grid.read[v].copy()
    after[(slice(0, place), slice(None))[::1 - 2 * axis]] = False
    if after.sum() < 3 or (grid.read[v] & ~after).sum() < 3:
        return None
    columns = np.zeros((3, *grid.weight.shape), dtype=complex)
    columns[0, v], columns[1, v], columns[2, v] = (
        shape * after for shape in (1j * grid.views.z, np.ones_like(grid.views.z),
                                    np.full_like(grid.views.z, 1j)))
    projected = np.array([grid_residuals(system, column) for column in columns])
    normal = np.einsum("avij,bvij,vij->ab", np.conj(projected), projected, grid.weight).real
    if np.linalg.matrix_rank(normal, tol=1e-9 * max(np.trace(normal), 1e-300)) < 3:
        return None
    right = np.einsum("avij,vij,vij->a", np.conj(projected), clipped, grid.weight).real
    return float(right @ np.linalg.solve(normal, right))


def split_view(measurements: Measurements, slip: SlipPlace) -> Measurements:
    """Return the measurement with the view as two placements, before and after the slip.

    Its angular lines become a third placement: the time of their reading is unknown.
    """
    view = measurements.views[slip.index]
    after = getattr(view, slip.axis) >= slip.first
    parts = [_grid_part(view, ~after, ""), _grid_part(view, after, " after slip")]
    if len(view.k):
        lines = replace(view.view, name=view.view.name + " lines", grid=False)
        parts.append(replace(ViewReadings(lines), k=view.k, dtheta=view.dtheta,
                             count_theta=view.count_theta, u_theta=view.u_theta,
                             sigma_theta=view.sigma_theta, dof_theta=view.dof_theta))
    views = (*measurements.views[:slip.index], *parts, *measurements.views[slip.index + 1:])
    return replace(measurements, views=views)


def _grid_part(view: ViewReadings, keep: np.ndarray, suffix: str) -> ViewReadings:
    named = replace(view.view, name=view.view.name + suffix, angular=False)
    used = int(view.count[keep].sum())
    return ViewReadings(named, view.m[keep], view.n[keep], view.dx[keep], view.dy[keep],
                        view.count[keep], view.u[keep] if len(view.u) else view.u,
                        sigma_xy=view.sigma_xy, dof_xy=int(view.dof_xy * keep.mean()), used=used,
                        rejected={} if suffix else view.rejected,
                        visits=None if view.visits is None else view.visits.of_marks(keep))


def likelier_term(measurements: Measurements, options: Options, slip: Slip) -> Cause | None:
    """Return the term that explains the residuals better than a slip; None if the slip does.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    model = fit_joint(measurements, options)
    problem, axis = model.problem, "mn".index(slip.axis)
    row, shape = problem.grid.index.index(slip.index), problem.ground.z.shape
    after = np.indices(shape)[axis] - shape[axis] // 2 >= slip.first
    found = find_explanations(model, slips=True, readings=False, placed=PlacedSlip(
        row, after & (problem.ground.weight[row] > 0), 2 * MAX_PLACES))
    if not found or found[0].name == SLIP:
        return None
    return cause_of(found[0], problem.ground)
