# SPDX-License-Identifier: Apache-2.0
"""Six views at any turn and shift, a bicubic map: our solver, and SciPy on the same equations."""

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.sparse import csr_matrix, diags, hstack, kron, vstack
from scipy.sparse.linalg import lsmr, splu
from timing import median_time

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.normal.equations import system_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Measurements
from test.support.placed import SIX, plate, readings

NODES = {21: 21, 51: 31, 101: 51}
"""Nodes a side of the map for marks a side of the plate; as many for other plates."""


class Equations:
    """All readings over the spline's coefficients, the plate, and phi and tau of the views."""

    def __init__(self, data: Measurements) -> None:
        field, plate_z = data.artifact.field, data.artifact.x_m + 1j * data.artifact.y_m
        knots = [
            make_interp_spline(nodes, nodes, k=3).t
            for nodes in (field.x_m[:, 0], field.y_m[0])
        ]
        self.to_nodes = kron(
            *(
                BSpline.design_matrix(nodes, t, 3)
                for nodes, t in zip((field.x_m[:, 0], field.y_m[0]), knots, strict=True)
            )
        )
        marks, length, blocks, values = plate_z.size, np.ptp(field.x_m) / 2, [], []
        for number, view in enumerate(data.views):
            phase, read = (
                np.exp(1j * view.view.rotation_rad),
                data.artifact.flat(view.m, view.n),
            )
            z = plate_z.ravel()[read]
            at = phase * z + complex(*view.view.translation_m)
            x, y = (
                BSpline.design_matrix(np.clip(part, t[0], t[-1]), t, 3)
                for part, t in zip((at.real, at.imag), knots, strict=True)
            )
            stage = vstack([kron(one, other) for one, other in zip(x, y, strict=True)])
            own = csr_matrix(
                (np.ones(len(z)), (np.arange(len(z)), read)), (len(z), marks)
            )
            turned = own * phase
            part = np.zeros((len(z), 3 * len(data.views)), dtype=complex)
            part[:, 3 * number : 3 * number + 3] = np.stack(
                [1j * phase * z / length, np.ones(len(z)), 1j * np.ones(len(z))], axis=1
            )
            part = csr_matrix(part)
            blocks += [
                hstack([stage, stage * 0, turned.real, -turned.imag, part.real]),
                hstack([stage * 0, stage, turned.imag, turned.real, part.imag]),
            ]
            values += [view.dx, view.dy]
        self.full, self.right = vstack(blocks).tocsc(), np.concatenate(values)
        self.shape, (n, m) = field.shape, (field.m.size, marks)
        held = [0, n - 1, n, 2 * n - 1, 2 * n, 2 * n + m - 1, 2 * n + m]
        self.keep = np.setdiff1d(np.arange(self.full.shape[1]), held)
        self.matrix = self.full[:, self.keep]

    def solve(self, method: str) -> np.ndarray:
        """Return G at the nodes, (2, nx, ny), in no particular datum."""
        out, size = (
            np.zeros(self.full.shape[1]),
            1
            / np.sqrt(
                np.asarray(self.matrix.multiply(self.matrix).sum(axis=0)).ravel()
            ),
        )
        matrix = self.matrix @ diags(size)
        if method == "scipy lsmr":
            found = lsmr(
                matrix, self.right, atol=1e-13, btol=1e-13, conlim=0, maxiter=100_000
            )[0]
        else:
            found = splu(
                (matrix.T @ matrix).tocsc(),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            ).solve(matrix.T @ self.right)
        out[self.keep] = size * found
        n = self.to_nodes.shape[1]
        return np.stack(
            [
                (self.to_nodes @ out[part * n : (part + 1) * n]).reshape(self.shape)
                for part in (0, 1)
            ]
        )


def solved(size: int, method: str) -> tuple[float, float]:
    """Return seconds, of our solver with the uncertainty, and the largest error without noise, m.

    The error is that in the datum.
    """
    artifact, options = (
        plate(size, NODES.get(size, size)),
        Options(misalignment_model="linear", assumed=(), causes=False),
    )
    exact, truth = readings(
        artifact, SIX, np.random.default_rng(size), sigma=0.0, linear=True
    )

    def field(data: Measurements, equations: Equations | None) -> np.ndarray:
        if equations is not None:
            return equations.solve(method)
        system_of.cache_clear()
        found = calibrate(data, options).error_map
        return np.stack([found.gx, found.gy])

    data, _ = readings(artifact, SIX, np.random.default_rng(size), linear=True)
    ready, sure = (
        Equations(one) if method.startswith("scipy") else None for one in (data, exact)
    )
    error = field(exact, sure) - np.stack([truth.field.real, truth.field.imag])
    error = remove_modes(error, datum_modes(artifact.field, scale=True))
    return median_time(lambda: field(data, ready), once=size > 21)[0], float(
        np.abs(error).max()
    )
