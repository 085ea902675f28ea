# SPDX-License-Identifier: Apache-2.0
"""Test whether the nodes of a map resolve the stage's errors, and size the lack of fit.

Between its nodes a map is a spline, and a stage that is rougher has more than that. A spline with
twice as many intervals contains the map's; with the same readings it must not fit significantly
better (F-test of its further coefficients, method eq. 12.4). What both differ by beyond their noise
is the lack of fit, a part of the uncertainty at the nodes and between them (eq. 12.5).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.lattice.connectivity import Gauge
from selfcal_ros.estimation.normal.angular import AngularSystem, HarmonicSystem
from selfcal_ros.estimation.normal.equations import GAP, grid_residuals
from selfcal_ros.estimation.normal.placed import PlacedEquations, PlacedSystem
from selfcal_ros.estimation.verdict.uncertainty import Effect
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Cause

NAME = "roughness"
"""Name of the cause, and of the effect."""

ADEQUACY_LEVEL = 1e-3
"""Probability that a map that suffices fails the test."""

MAX_COEFFICIENTS = 31 * 31
"""Largest refined spline that is fitted: a second of one processor."""

NOISE_FREE_M = 1e-13
"""Noise that is rounding, m: a map that leaves no more than that suffices."""


@dataclass(frozen=True)
class Adequacy:
    """The test of a map's nodes.

    Attributes
    ----------
    p : float
        Probability of such an improvement by chance.
    lack : float
        Standard uncertainty from the lack of fit: one coordinate, m, or of the angular map, rad.
    coefficients : float
        Further coefficients that the readings determine.
    nodes : tuple of int
        Nodes of the map along x and y; of the angular map, its harmonics.
    """

    p: float
    lack: float
    coefficients: float
    nodes: tuple[int, ...]

    @property
    def of_lines(self) -> bool:
        """Whether it is that of the angular map."""
        return len(self.nodes) == 1

    def effect(self, result: CalibrationResult) -> Effect:
        """Return the lack of fit as an effect on every known node.

        Its sign changes from node to node: the datum takes nothing of it out.
        """
        emap = result.error_map
        if self.of_lines:
            return Effect(NAME, np.zeros((2, *emap.gx.shape)), np.where(
                np.isfinite(emap.g_theta), self.lack, 0.0))
        sign = 1 - 2 * (np.indices(emap.gx.shape).sum(axis=0) % 2)
        each = np.where(emap.valid, sign * self.lack, 0.0)
        return Effect(NAME, np.stack([each, each]), np.zeros(len(emap.g_theta)))

    @property
    def cause(self) -> Cause | None:
        """The cause `roughness`, if the map does not suffice."""
        if not self.p < ADEQUACY_LEVEL:
            return None
        size: dict[str, Any] = {"harmonics": self.nodes[0]} if self.of_lines else {
            "nodes": list(self.nodes)}
        return Cause(NAME, self.lack, 0.0, "rad" if self.of_lines else "m", self.p,
                     effect_rms=self.lack, effect_max=self.lack, details=size)


def adequacies_of(model: ModelFit) -> list[Adequacy]:
    """Return the tests of the map and of the angular map, where they can be made."""
    return [one for one in (adequacy_of(model), line_adequacy_of(model)) if one is not None]


def adequacy_of(model: ModelFit) -> Adequacy | None:
    """Return the test of the map of a fit; None on the lattice, or for a map that is too large.

    Parameters
    ----------
    model : ModelFit
        A fit; finite rotations and terms are taken off its readings.
    """
    system = model.problem.system
    if not isinstance(system, PlacedEquations) or is_untested(model):
        return None
    grid = system.grid
    finer = grid.views.spline.refined
    fine = PlacedEquations(PlacedSystem(grid.views.poses, grid.weight, finer),
                           AngularSystem((), np.zeros((0, 0))), system.grid_index, ())
    parts = [(one, _effective(one), _squares(one, model.y)) for one in (fine, system)]
    (_, n_fine, rest), (_, n_coarse, before) = parts
    readings = 2 * grid.n_readings - 2 * int(grid.mark_read.sum()) - (3 * grid.n_views - 7)
    more, dof = n_fine - n_coarse, readings - n_fine
    if dof < 1 or more < 1:
        return None
    sigma_m = float(np.sqrt(rest / dof))
    p = _improved(before, rest, more, dof)
    return Adequacy(p, _lack(fine, system, model.y, sigma_m), more, grid.views.shape)


def _improved(before: float, rest: float, more: float, dof: float) -> float:
    """Return the probability of such an improvement by chance (method eq. 12.4)."""
    if rest < dof * NOISE_FREE_M**2:  # there is no F of rounding
        return 1.0 if before < 4 * (dof + more) * NOISE_FREE_M**2 else 0.0
    return float(fdtrc(more, dof, max(before - rest, 0.0) / more / (rest / dof)))


def line_adequacy_of(model: ModelFit) -> Adequacy | None:
    """Return the test of the harmonics of the angular map by twice as many, if K allows more.

    None for a map that is no Fourier series, or if nothing more can be determined.
    """
    coarse, y = model.problem.system.angular, model.problem.angular.y
    if not isinstance(coarse, HarmonicSystem):
        return None
    finer = min(2 * coarse.harmonics, (coarse.n_lines - 1) // 2)
    fine = HarmonicSystem(coarse.turns, coarse.weight, finer)
    more = fine.n_told - coarse.n_told
    dof = coarse.n_readings - coarse.n_marks - fine.n_told - (coarse.n_views - 1)
    if more < 1 or dof < 1:
        return None
    (before, coarse_map), (rest, fine_map) = (_fitted_lines(one, y) for one in (coarse, fine))
    square = float(((fine_map - coarse_map) ** 2).mean()) - rest / dof * (
        fine.mean_variance - coarse.mean_variance)
    return Adequacy(_improved(before, rest, more, dof), float(np.sqrt(max(square, 0.0))), more,
                    (coarse.harmonics,))


def _fitted_lines(lines: HarmonicSystem, y: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the squares of residuals of lines fitted alone, and their map without its mean."""
    free, d = lines.reduced(y)
    phi = np.linalg.pinv(lines.schur, rcond=GAP, hermitian=True) @ d
    field = free - lines.response @ phi
    rest = lines.plate(y, field, phi)[1]
    return float((lines.weight * rest**2).sum()), field - field.mean()


def is_untested(model: ModelFit) -> bool:
    """Return whether a map has too many nodes for the test of their number."""
    system = model.problem.system
    return isinstance(system, PlacedEquations) and (
        math.prod(system.grid.views.spline.refined.shape) > MAX_COEFFICIENTS)


def known_places(system: PlacedEquations) -> np.ndarray:
    """Return the known nodes and the middles between known nodes, complex (P,), m."""
    views, known = system.grid.views, system.known_sites
    s, t = np.indices([2 * size - 1 for size in views.shape]).reshape(2, -1)
    low, high = (s // 2, t // 2), ((s + 1) // 2, (t + 1) // 2)
    inside = known[low] & known[high] & known[low[0], high[1]] & known[high[0], low[1]]
    x, y = s[inside] / 2 - views.half[0], t[inside] / 2 - views.half[1]
    return (x + 1j * y) * views.spline.pitch_m


def _effective(system: PlacedEquations) -> float:
    """Return the real coefficients of the map that the readings determine."""
    factor, n = system.grid.factor, system.grid.n_sites
    return 2 * (n - system.grid.vague * float(factor.inverse_diagonal().sum()))


def _squares(system: PlacedEquations, y: np.ndarray) -> float:
    return float((system.grid.weight * np.abs(grid_residuals(system, y)) ** 2).sum())


def _lack(fine: PlacedEquations, coarse: PlacedEquations, y: np.ndarray, sigma_m: float) -> float:
    """Return the rms difference of two maps of the same readings beyond their noise, m.

    One coordinate, over the nodes and the middles between them where the map is known.
    """
    at = known_places(coarse)
    rigid = Gauge(at / abs(at).max(), np.ones(len(at), dtype=bool), scale=True).orthonormal
    values, powers = [], []
    for system in (fine, coarse):
        spline = system.grid.views.spline
        rows = spline.rows(at)
        by_nodes = csr_matrix(spline.adjoint(rows.toarray().reshape(
            len(at), *spline.shape)).reshape(len(at), -1)) if system is coarse else rows
        free, d = system.grid.reduced(y)
        field = by_nodes @ (free - system.grid.response @ (system.grid_inverse @ d))
        values.append(field - rigid @ np.real(rigid.conj().T @ field))
        powers.append(sum(part.mean() for part in system.variance(
            by_nodes, rigid, system.grid_inverse)))
    square = float((np.abs(values[0] - values[1]) ** 2).mean())
    return float(np.sqrt(max(square - sigma_m**2 * (powers[0] - powers[1]), 0.0) / 2))
