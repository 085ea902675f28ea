# SPDX-License-Identifier: Apache-2.0
"""Views that are noisier than the others: by their own repeats, and by their residuals."""

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.estimation.joint.noise import pooled
from selfcal_ros.estimation.quality.leverage import ROUNDING, Residuals, view_noise
from selfcal_ros.estimation.verdict.causes import LEVEL
from selfcal_ros.model.readings import Measurements

NOISY_REPEATS = 1.5
"""Ratio of the noise of a view's repeats to that of the others from which it is named."""

NOISY_RESIDUALS = 3.0
"""The same for the noise that residuals show, which is known far less well."""

MIN_VIEW_DOF = 5.0
"""Degrees of freedom of a view's own noise below which it is not judged: chance does as much."""

MAX_RATIO = 20.0
"""Largest ratio of noises that residuals can tell: a noisy view hides the noise of the others."""


def noisy_views(residuals: Residuals, measurements: Measurements
                ) -> tuple[tuple[str, float], ...]:
    """Return the views whose noise stands out, with its ratio to that of the others."""
    found = by_repeats(measurements)
    for name, ratio in _by_residuals(residuals, measurements).items():
        found[name] = max(ratio, found.get(name, 0.0))
    return tuple((view.view.name, found[view.view.name]) for view in measurements.views
                 if view.view.name in found)


def by_repeats(measurements: Measurements) -> dict[str, float]:
    """Return the views whose repeats scatter more than those of the others (F-test)."""
    views = [(v.view.name, v.sigma_xy, v.dof_xy) for v in measurements.views
             if len(v.m) and v.dof_xy > 0 and np.isfinite(v.sigma_xy)]
    out = {}
    for index, (name, sigma, dof) in enumerate(views):
        others, rest = pooled((s, d) for i, (_, s, d) in enumerate(views) if i != index)
        if not rest or not others > ROUNDING:
            continue
        p = float(fdtrc(dof, rest, (sigma / others) ** 2)) * len(views)
        if p < LEVEL and sigma > NOISY_REPEATS * others:
            out[name] = float(sigma / others)
    return out


def _by_residuals(residuals: Residuals, measurements: Measurements) -> dict[str, float]:
    if residuals.problem.system.grid.n_views < 2:
        return {}
    out = {}
    for index, (own, others, dof) in zip(residuals.problem.grid.index, view_noise(residuals),
                                         strict=True):
        ratio = float(own / max(others, own / MAX_RATIO, ROUNDING))
        if ratio > NOISY_RESIDUALS and dof >= MIN_VIEW_DOF:
            out[measurements.views[index].view.name] = ratio
    return out
