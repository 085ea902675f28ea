# SPDX-License-Identifier: Apache-2.0
"""Readings of views at any pose from known truth, and their dense least squares."""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import View

PITCH_M = 10e-3

SIX = (
    (0, (0, 0)),
    (90, (0, 0)),
    (37, (0.6, -0.7)),
    (211, (-1.2, 0.6)),
    (0, (1, 0)),
    (135, (0.4, 1.1)),
)
"""Turns, deg, and shifts, pitches, that determine every node of a map."""

THREE = ((0, (0, 0)), (90, (0, 0)), (37, (1.3, -0.7)))


def plate(marks: int, nodes: int, interpolation: str = "bicubic", **kwargs) -> Artifact:
    """Return a plate whose map spans it with `nodes` nodes a side."""
    pitch = (marks - 1) * PITCH_M / (nodes - 1)
    return Artifact(
        marks,
        PITCH_M,
        map_grid=MapGrid(nodes, pitch, Interpolation(interpolation)),
        **kwargs,
    )


def cardinal(nodes: np.ndarray, at: np.ndarray, interpolation: str) -> np.ndarray:
    """Return the spline through a unit at each node, at places, (P, n): by SciPy alone."""
    degree = 1 if interpolation == "bilinear" else min(3, len(nodes) - 1)
    return make_interp_spline(nodes, np.eye(len(nodes)), k=degree)(at)


def rows(artifact: Artifact, places_m: np.ndarray) -> np.ndarray:
    """Return the rows that lead from the map's nodes to places, dense (P, nodes)."""
    field, how = artifact.field, artifact.map_grid.interpolation
    along = [np.arange(-half, half + 1.0) * field.grid_pitch_m for half in field.half]
    x, y = (
        cardinal(nodes, at, how)
        for nodes, at in zip(along, (places_m.real, places_m.imag), strict=True)
    )
    return (x[:, :, None] * y[:, None, :]).reshape(len(places_m), -1)


@dataclass
class Truth:
    """What the readings were made of: G at the nodes and A, complex, m."""

    field: np.ndarray
    plate: np.ndarray


def readings(
    artifact: Artifact,
    poses,
    rng,
    *,
    sigma=20e-9,
    size=1e-6,
    turn=3e-4,
    shift=3e-6,
    linear=False,
    stage=None,
) -> tuple[Measurements, Truth]:
    """Return readings of views at `poses`, one repeat each, and their truth.

    Parameters
    ----------
    stage : callable, optional
        The stage's error at places, m; without it random nodes and the map's own spline.
    """

    def complex_normal(shape):
        return rng.normal(size=shape) + 1j * rng.normal(size=shape)

    nodes = artifact.field.x_m + 1j * artifact.field.y_m
    field = (
        size * complex_normal(artifact.field.shape) if stage is None else stage(nodes)
    )
    # a stage that turns as a whole turns the offsets seen: of second order
    if stage is None:
        x, y = remove_modes(
            np.stack([field.real, field.imag]), datum_modes(artifact.field, scale=True)
        )
        field = x + 1j * y
    plate_error, views = size * complex_normal(artifact.shape), []
    for number, (degrees, pitches) in enumerate(poses):
        view = View(
            f"view {number}",
            np.radians(degrees),
            tuple(pitch * artifact.grid_pitch_m for pitch in pitches),
            True,
            False,
        )
        inside = view.pose.in_field(artifact)
        m, n = artifact.m[inside], artifact.n[inside]
        at, mark = (
            view.pose.places(artifact, m, n),
            (artifact.x_m + 1j * artifact.y_m)[inside],
        )
        phase, phi, t = (
            np.exp(1j * view.rotation_rad),
            turn * rng.normal(),
            shift * (complex_normal(())),
        )
        of_stage = rows(artifact, at) @ field.ravel() if stage is None else stage(at)
        lies = (
            phase * (1j * phi * mark + plate_error[inside]) + t
            if linear
            else (
                phase * np.exp(1j * phi) * (mark + plate_error[inside])
                - phase * mark
                + t
            )
        )
        seen = lies + of_stage + sigma * complex_normal(len(m))
        views.append(
            ViewReadings(view, m, n, seen.real, seen.imag, np.ones(len(m), dtype=int))
        )
    return Measurements("placed", artifact, tuple(views)), Truth(field, plate_error)


def dense(
    measurements: Measurements, known: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return G in its datum and its standard uncertainty for unit noise, (2, nx, ny) each.

    The datum is that of the `known` nodes, of all unless they are given.

    By one matrix of all readings and unknowns, linear in the rotations, and its pseudo-inverse.
    """
    artifact = measurements.artifact
    n, each = artifact.field.m.size, np.stack([artifact.m, artifact.n])
    z = (artifact.x_m + 1j * artifact.y_m).ravel()
    blocks, values = [], []
    for number, view in enumerate(measurements.views):
        phase, (a, b) = np.exp(1j * view.view.rotation_rad), view.view.translation_m
        # each mark by its name
        own = np.array(
            [
                (mark == each.reshape(2, -1).T).all(axis=1)
                for mark in zip(view.m, view.n, strict=True)
            ],
            dtype=float,
        )
        w = rows(artifact, phase * (own @ z) + complex(a, b))
        here = np.zeros((len(own), 3 * len(measurements.views)), dtype=complex)
        here[:, 3 * number] = phase * 1j * (own @ z) / z.real.max()
        here[:, 3 * number + 1 : 3 * number + 3] = 1, 1j
        row = np.hstack([w, 1j * w, phase * own, 1j * phase * own, here])
        blocks += [row.real, row.imag]
        values += [view.dx, view.dy]
    design, y = np.vstack(blocks), np.concatenate(values)
    inverse = np.linalg.pinv(design, rcond=1e-10)
    modes = datum_modes(artifact.field, scale=True).reshape(4, -1).T
    there = np.tile(np.ones(n, dtype=bool) if known is None else known.ravel(), 2)
    projected = (
        inverse[: 2 * n]
        - modes @ np.linalg.lstsq(modes[there], inverse[: 2 * n][there], rcond=None)[0]
    )
    return (
        (projected @ y).reshape(2, *artifact.field.shape),
        np.sqrt((projected**2).sum(axis=1)).reshape(2, *artifact.field.shape),
    )


def error_in_datum(emap, truth: Truth) -> np.ndarray:
    """Return the error of a map against the truth in the datum of the known nodes, (2, nx, ny)."""
    error = np.stack([emap.gx - truth.field.real, emap.gy - truth.field.imag])
    return remove_modes(error, datum_modes(emap.artifact, scale=True))
