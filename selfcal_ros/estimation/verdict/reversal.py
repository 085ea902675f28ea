# SPDX-License-Identifier: Apache-2.0
"""Test whether the direction of approach does the same everywhere in the field.

The term `approach` has one size an axis. Visits to one mark in one view from both sides show what
it is at their site, apart from all else. If it differs from site to site by more than the visits
scatter (F-test, method eq. 7.13), the rest of it stays in the map wherever one side is approached
more often: at the edge of the field in any order of visits. No reading shows how large it is there:
it is taken to be as large as at any other site.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.solve import NEARLY_EXACT_M
from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.estimation.terms.equations import CAUSE_LEVEL
from selfcal_ros.estimation.verdict.uncertainty import Effect, effect_everywhere
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.findings import Cause
from selfcal_ros.model.kept import REVERSAL
from selfcal_ros.model.readings import turned_over
from selfcal_ros.model.result import CalibrationResult


@dataclass(frozen=True, eq=False)
class Reversal:
    """A reversal that differs from site to site.

    Attributes
    ----------
    p : float
        Probability of such differences by chance, of the axis on which it is smaller, times two.
    size_m, u_m : float array (2,)
        Largest difference from the mean of an axis, and its standard uncertainty, m.
    one_sided : float array (2, nx, ny)
        Mean sign of approach along x and y at each site, frame of the equations: 0 where both
        sides balance.
    """

    p: float
    size_m: np.ndarray
    u_m: np.ndarray
    one_sided: np.ndarray

    def effect(self, result: CalibrationResult) -> Effect:
        """Return its effect on every known node: its own, and what the datum takes off all."""
        own_m = self.size_m[:, None, None] * np.abs(self.one_sided)
        of_all_m = own_m.mean(axis=(1, 2), keepdims=True)
        of_stage = turned_over(result.sense, np.hypot(own_m, of_all_m), sign=1)
        return effect_everywhere(REVERSAL, result.error_map, size_m=of_stage)

    def cause(self, effect: Effect) -> Cause:
        """Return it as a cause, of the axis on which it is larger."""
        axis = int(self.size_m.argmax())
        return Cause(
            name=REVERSAL,
            size=float(self.size_m[axis]),
            u=float(self.u_m[axis]),
            unit="m",
            p=self.p,
            axis="xy"[axis],
            effect_rms=rms(effect.xy),
            effect_max=float(np.abs(effect.xy).max()),
        )


@dataclass(frozen=True, eq=False)
class _Contrasts:
    """Sums over the visits of each site, along x and y, (2, sites).

    A contrast is the sign of approach of a visit less its mean at the mark.

    Attributes
    ----------
    product, information : float array
        Of contrasts times deviations from the mean of the mark, m, and of squared contrasts.
    signs, weights : float array
        Of signs, and of weights.
    squares : float array (2,)
        All squares of deviations, m^2.
    dof : int
        Degrees of freedom of each.
    """

    product: np.ndarray
    information: np.ndarray
    signs: np.ndarray
    weights: np.ndarray
    squares: np.ndarray
    dof: int


def reversal_of(model: ModelFit) -> Reversal | None:
    """Return the reversal that differs from site to site; None if none is shown.

    Marks of an image share its noise, and are not tested.
    """
    if model.problem.images is not None:
        return None
    sums = _contrasts(model)
    known = sums.information > GAP * sums.information.max(initial=0.0)
    n_known = known.sum(axis=1)
    dof = sums.dof - n_known
    if not n_known.any() or dof.min() < 1:
        return None

    information = np.where(known, sums.information, 1.0)
    product = np.where(known, sums.product, 0.0)
    total = np.where(n_known > 0, (information * known).sum(axis=1), 1.0)
    mean_m = product.sum(axis=1) / total
    of_sites = (product**2 / information).sum(axis=1)
    variance = (sums.squares - of_sites) / dof
    if not variance.min() > NEARLY_EXACT_M**2:
        return None
    n_differences = np.maximum(n_known - 1, 1)
    gain = (of_sites - mean_m**2 * total) / n_differences
    p = len(gain) * fdtrc(n_differences, dof, np.maximum(gain, 0.0) / variance)
    if not p.min() < CAUSE_LEVEL:
        return None

    difference_m = np.where(known, product / information - mean_m[:, None], 0.0)
    noise = variance[:, None] / information
    # how far sites differ beyond noise, and what each most likely is
    spread = ((difference_m**2 - noise) * known).sum(axis=1) / np.maximum(n_known, 1)
    share = np.where(p < CAUSE_LEVEL, np.maximum(spread, 0.0), 0.0)[:, None]
    likeliest_m = np.abs(difference_m) * share / (share + noise)
    largest = likeliest_m.argmax(axis=1)[:, None]
    shape = model.problem.inputs.stage.shape
    return Reversal(
        p=float(p.min()),
        size_m=np.take_along_axis(likeliest_m, largest, axis=1)[:, 0],
        u_m=np.sqrt(np.take_along_axis(noise, largest, axis=1)[:, 0]),
        one_sided=(sums.signs / np.maximum(sums.weights, GAP)).reshape(2, *shape),
    )


def _contrasts(model: ModelFit) -> _Contrasts:
    """Return the sums over all visits of a fit."""
    problem = model.problem
    sums = np.zeros((4, 2, problem.inputs.stage.m.size))
    squares = np.zeros(2)
    dof = 0
    for row, visits, residual in model.visits_about_means():
        site = _nearest_sites(model, row)[visits.mark]
        of_stage = residual * problem.to_stage[row]
        signs = np.stack([visits.approach_x, visits.approach_y])
        n_marks = 1 + int(visits.mark.max())
        contrasts = visits.about_means(signs.astype(complex), n_marks).real
        weight = visits.weight
        for axis, deviation_m in enumerate((of_stage.real, of_stage.imag)):
            contrast = contrasts[axis]
            squares[axis] += weight @ deviation_m**2
            for total, values in zip(
                sums[:, axis],
                (contrast * deviation_m, contrast**2, signs[axis], np.ones(len(site))),
                strict=True,
            ):
                total += np.bincount(site, weight * values, total.size)
        dof += visits.n_repeats
    product, information, signs_of_sites, weights = sums
    return _Contrasts(
        product=product,
        information=information,
        signs=signs_of_sites,
        weights=weights,
        squares=squares,
        dof=dof,
    )


def _nearest_sites(model: ModelFit, row: int) -> np.ndarray:
    """Return the site, or node of the map, nearest to each mark of a view, flat, (marks,)."""
    inputs = model.problem.inputs
    places = inputs.on_stage(row) / inputs.stage.grid_pitch_m
    nx, ny = inputs.stage.shape
    i, j = (
        np.clip(np.rint(at + (size - 1) / 2).astype(int), 0, size - 1)
        for at, size in ((places.real, nx), (places.imag, ny))
    )
    return i * ny + j
