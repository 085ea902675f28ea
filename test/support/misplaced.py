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


def photographed(
    cell: Scene, lies: dict[int, complex], *, field: float = 1.45
) -> Scene:
    """Return a cell whose camera sees every mark within `field` pitches, at noise alone.

    `lies`: index of a view -> where the centre of its plate lies beside its place, pitches.
    """
    plate, views = cell.plan.artifact, cell.plan.views
    rng = np.random.default_rng(5)
    begun = [c.stamp_ns for c in cell.commands if c.view][::2]
    stamps = np.array([sample.stamp_ns for sample in cell.samples])
    marks = (plate.x_m + 1j * plate.y_m).ravel()
    detections = []
    for seen in {d.stamp_ns: d for d in cell.detections}.values():
        index = int(np.searchsorted(begun, seen.stamp_ns)) - 1
        at = cell.samples[int(np.abs(stamps - seen.stamp_ns).argmin())].positions
        beside = complex(*views[index].translation_m) - complex(*at[:2])
        offsets = np.exp(1j * views[index].rotation_rad) * marks + beside
        offsets = offsets + lies.get(index, 0j) * plate.grid_pitch_m
        reach = np.maximum(np.abs(offsets.real), np.abs(offsets.imag))
        for offset in offsets[reach < field * plate.grid_pitch_m].tolist():
            x, y = rng.normal((offset.real, offset.imag), 2e-8).tolist()
            detections.append(
                replace(seen, has_id=False, m=0, n=0, offset_x=x, offset_y=y)
            )
    cell.detections = detections
    return cell
