# SPDX-License-Identifier: Apache-2.0
"""Plates whose marks are a list: rings, scattered marks, a lattice with holes, a lattice."""

from dataclasses import replace

import numpy as np

from selfcal_ros.model.artifact import (
    Artifact,
    Interpolation,
    MapGrid,
    default_map_grid,
)
from selfcal_ros.model.marks import marks_of
from selfcal_ros.model.view import Plan, View

HALF_M = 50e-3


def listed(
    x,
    y,
    nodes: int = 0,
    interpolation: str = "bicubic",
    ids=None,
    angular_count: int = 0,
) -> Artifact:
    """Return a plate with marks at x, y (m) and odd ids that fall, not rise, with their order."""
    ids = [3 * number - 7 for number in range(len(x), 0, -1)] if ids is None else ids
    plate = Artifact(0, 0.0, angular_count, marks=marks_of(ids, list(x), list(y)))
    half = max(plate.reach) * plate.grid_pitch_m
    return replace(
        plate,
        map_grid=default_map_grid(plate)
        if not nodes
        else MapGrid(nodes, 2 * half / (nodes - 1), Interpolation(interpolation)),
    )


def rings(nodes: int = 5, **kwargs) -> Artifact:
    """Return a plate with circles of marks, and one at its centre."""
    at = np.concatenate(
        [
            [0j],
            *(
                radius * HALF_M * np.exp(2j * np.pi * np.arange(n) / n)
                for radius, n in ((1, 36), (0.72, 26), (0.4, 14))
            ),
        ]
    )
    return listed(at.real, at.imag, nodes, **kwargs)


def scatter(
    number: int = 80, nodes: int = 5, seed: int = 3, *, half_m: float = HALF_M, **kwargs
) -> Artifact:
    """Return a plate with marks at random places, no two closer than a third of their spacing."""
    rng, found = (
        np.random.default_rng(seed),
        np.array([[1, 1], [-1, 1], [1, -1], [-1, -1]]),
    )
    found = found * half_m  # the corners: all nodes of the map have marks near them
    while len(found) < number:
        place = rng.uniform(-half_m, half_m, 2)
        if np.hypot(*(found - place).T).min() > half_m * 0.7 / number**0.5:
            found = np.vstack([found, place])
    return listed(*found.T, nodes, **kwargs)


def lattice(size: int, holes=(), nodes: int = 5, **kwargs) -> Artifact:
    """Return the lattice of size x size marks as a list, without the marks of some numbers."""
    along = np.arange(size) - (size - 1) / 2
    x, y = (
        part.ravel() * 2 * HALF_M / (size - 1)
        for part in np.meshgrid(along, along, indexing="ij")
    )
    kept = np.setdiff1d(np.arange(size * size), holes)
    return listed(x[kept], y[kept], nodes, **kwargs)


def listed_plan(artifact: Artifact | None = None, *, repeats: int = 2) -> Plan:
    """Return a plan of scattered marks and 8 lines: 0, 90, 37 deg, shifted, turned by one line."""
    artifact = scatter(60, angular_count=8) if artifact is None else artifact
    lines = (
        [
            View(
                "line",
                2 * np.pi / artifact.angular_count,
                (0.0, 0.0),
                False,
                True,
                repeats,
            )
        ]
        if artifact.angular_count
        else []
    )
    whole = artifact.angular_count > 0
    return Plan(
        "listed",
        artifact,
        (
            View("0", 0.0, (0.0, 0.0), True, whole, repeats),
            View("90", np.pi / 2, (0.0, 0.0), True, whole, repeats),
            View("37", np.radians(37), (6.5e-3, -3.2e-3), True, False, repeats),
            View("shifted", 0.0, (9e-3, 4e-3), True, whole, repeats),
            *lines,
        ),
    )
