# SPDX-License-Identifier: Apache-2.0
"""Cells in which a plate lies otherwise than their commands say."""

from dataclasses import replace
from typing import Any

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from test.support import placed
from test.support.collecting import Scene, scene
from test.support.plans import plan_of

NOISE: dict[str, Any] = {"sigma_xy_m": 2e-8, "repeats": 2, "size": 7, "count": 0}


def laid(
    planned: str, lies: str, *, with_ids: bool, seed: int = 3, **how: Any
) -> tuple[Scene, list[str]]:
    """Return the messages of a cell whose plates lie otherwise than its commands say."""
    cell = scene(lies, with_ids=with_ids, seed=seed, **NOISE, **how)
    views = plan_of(planned, NOISE["size"], count=0, repeats=2).views
    cell.commands = [
        replace(c, view=views[c.view_index]) if c.view else c for c in cell.commands
    ]
    return cell, [view.name for view in views]


def laid_at(
    artifact: Artifact, index: int, pose: tuple, seed: int, sigma: float = 20e-9
) -> Measurements:
    """Return readings of six views, one at another pose: its marks are taken for those planned."""
    lies = [*placed.SIX[:index], pose, *placed.SIX[index + 1 :]]
    planned, found = (
        placed.readings(artifact, poses, np.random.default_rng(seed), sigma=sigma)[0]
        for poses in (placed.SIX, lies)
    )
    views = [replace(view, sigma_xy=sigma, dof_xy=50) for view in found.views]
    here, there = planned.views[index], views[index]
    taken, true = (
        view.view.pose.places(artifact, view.m, view.n) for view in (here, there)
    )
    nearest, marks = np.abs(true[:, None] - taken).argmin(axis=1), np.arange(len(taken))
    away = true - taken[nearest]
    kept = np.abs(away) < 0.05 * artifact.grid_pitch_m
    assert kept.mean() > 0.75 and len(set(nearest[kept])) == kept.sum() <= len(marks)
    views[index] = replace(
        there,
        view=here.view,
        m=here.m[nearest[kept]],
        n=here.n[nearest[kept]],
        dx=(there.dx + away.real)[kept],
        dy=(there.dy + away.imag)[kept],
        count=there.count[kept],
    )
    return replace(found, views=tuple(views))
