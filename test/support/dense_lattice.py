# SPDX-License-Identifier: Apache-2.0
"""A measurement on a lattice as one dense least squares: sites and marks by their places.

Written from the model in method.md (eqs. 2.4, 2.6) for sides of any number of marks: the marks
of N rows lie at (i - (N-1)/2) pitches, i from 0. Sites are found by their places. Residuals are
turned as the plate lies, with finite rotations, and are orthogonal to the columns of the linear
model.
"""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.readings import Measurements

STEPS = 8
"""Steps to finite rotations, whose part beyond the linear model is taken off the readings."""


@dataclass
class DenseSolution:
    """Complex G and A (nx, ny), m; phi (views,), rad; t (views,), m; u of G for unit noise."""

    field: np.ndarray
    plate: np.ndarray
    phi: np.ndarray
    t: np.ndarray
    u_field: np.ndarray
    rank: int


def places_of(shape: tuple[int, int]) -> np.ndarray:
    """Return the places of a lattice about its centre, complex (nx, ny), pitches."""
    x, y = (np.arange(size) - (size - 1) / 2 for size in shape)
    return x[:, None] + 1j * y


def solve(measurements: Measurements, *, finite: bool) -> DenseSolution:
    """Return the solution in which G has no rigid mode and no scale, and A no rigid mode."""
    artifact = measurements.artifact
    pitch, (nx, ny) = artifact.grid_pitch_m, artifact.shape
    z = places_of((nx, ny)).ravel()
    n, v = z.size, len(measurements.views)
    mark, site, view = [], [], []
    for number, part in enumerate(measurements.views):
        i = np.asarray(part.m) + nx // 2
        j = np.asarray(part.n) + ny // 2
        turn = np.exp(1j * part.view.rotation_rad)
        at = turn * z[i * ny + j] + complex(*part.view.translation_m) / pitch
        away = np.abs(at[:, None] - z)
        assert (away.min(axis=1) < 1e-6).all()  # every mark on a site
        mark.append(i * ny + j)
        site.append(away.argmin(axis=1))
        view.append(np.full(len(i), number))
    mark, site, view = (np.concatenate(part) for part in (mark, site, view))
    seen = np.concatenate([part.dx + 1j * part.dy for part in measurements.views])
    alpha = np.exp(
        1j * np.array([part.view.rotation_rad for part in measurements.views])
    )[view]
    row = np.arange(len(seen))

    length = np.abs(z).max() * pitch
    modes = np.stack([np.ones(n), 1j * np.ones(n), 1j * z, z]) / np.sqrt(n)
    ties = np.zeros((7, 4 * n + 3 * v))
    ties[:4, :n], ties[:4, n : 2 * n] = modes.real, modes.imag
    ties[4:, 2 * n : 3 * n], ties[4:, 3 * n : 4 * n] = modes[:3].real, modes[:3].imag

    out = np.zeros((len(seen), 4 * n + 3 * v), dtype=complex)
    out[row, site], out[row, n + site] = 1, 1j
    out[row, 2 * n + mark], out[row, 3 * n + mark] = alpha, 1j * alpha
    out[row, 4 * n + view] = 1j * alpha * z[mark] * pitch / length
    out[row, 4 * n + v + view], out[row, 4 * n + 2 * v + view] = 1, 1j
    design = np.vstack([out.real, out.imag])
    inverse = np.linalg.pinv(np.vstack([design, ties]), rcond=1e-11)

    def model(x: np.ndarray) -> np.ndarray:
        field, plate = (
            x[:n] + 1j * x[n : 2 * n],
            x[2 * n : 3 * n] + 1j * x[3 * n : 4 * n],
        )
        phi = x[4 * n : 4 * n + v] / length
        t = (x[4 * n + v : 4 * n + 2 * v] + 1j * x[4 * n + 2 * v :])[view]
        arm = z[mark] * pitch
        moved = (
            np.exp(1j * phi[view]) * (arm + plate[mark]) - arm
            if finite
            else 1j * phi[view] * arm + plate[mark]
        )
        return field[site] + alpha * moved + t

    x = np.zeros(4 * n + 3 * v)
    for _ in range(STEPS if finite else 2):
        rest = (seen - model(x)) * np.exp(-1j * x[4 * n : 4 * n + v] / length * finite)[
            view
        ]
        x = x + inverse @ np.concatenate([rest.real, rest.imag, -ties @ x])
    u = np.sqrt((inverse[: 2 * n, : 2 * len(seen)] ** 2).sum(axis=1)).reshape(2, nx, ny)
    return DenseSolution(
        (x[:n] + 1j * x[n : 2 * n]).reshape(nx, ny),
        (x[2 * n : 3 * n] + 1j * x[3 * n : 4 * n]).reshape(nx, ny),
        x[4 * n : 4 * n + v] / length,
        x[4 * n + v : 4 * n + 2 * v] + 1j * x[4 * n + 2 * v :],
        u,
        int(np.linalg.matrix_rank(design, tol=1e-9)),
    )
