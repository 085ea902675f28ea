# SPDX-License-Identifier: Apache-2.0
"""The camera's distortion and the stage's yaw from images of several marks (method eq. 4.16).

The offset of each cell of the image holds the camera's error there. A polynomial through the cells
straightens offsets between them; its degree is the smallest that the cells do not contradict.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.joint.model_fit import ModelFit, squares
from selfcal_ros.estimation.terms.equations import score
from selfcal_ros.model.error_map import MANY_DOF
from selfcal_ros.model.readings import GridVisits, Measurements, Sense, ViewReadings
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import TermName

DEGREE_LEVEL = 1e-3
"""Level of the test that a polynomial of a higher degree fits the cells better."""
POWERS = {1: ((1, 0), (0, 1)), 2: ((2, 0), (1, 1), (0, 2)), 3: ((2, 1),)}
"""Powers (a, b) of z^a conj(z)^b that each degree adds; radial distortion is z^2 conj(z). The other
cubic ones look like linear ones in three cells."""

UNREAD = 1e-6
"""Size of a column, or of its part in a combination, that is none."""

STEPS = 20
"""Steps from a published offset to the true one; each is shorter by the slope of the distortion."""

Powers = Sequence[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Distortion:
    """Errors of a camera as a polynomial: published minus true offset, by the true one.

    Attributes
    ----------
    powers : sequence of tuple
        Of the polynomial, see `POWERS`.
    coefficients : complex array (1 + powers,)
        Its constant, 0, and its coefficients, places and errors in m.
    """

    powers: Powers
    coefficients: np.ndarray

    def at(self, offset: np.ndarray) -> np.ndarray:
        """Return the error at published offsets, complex, m: that at the true ones."""
        error = np.zeros_like(offset)
        for _ in range(STEPS):
            error = _terms(offset - error, self.powers) @ self.coefficients
        return error


@dataclass(frozen=True, eq=False)
class Camera(Distortion):
    """Errors of a camera: published minus true offset, as a function of the true one.

    Attributes
    ----------
    place, error : complex array (cells,)
        Mean true offset in each cell, stage axes, and the error there relative to that on the
        optical axis, m.
    u : float array (cells, 2)
        Standard uncertainties of the errors along x and y, m.
    u_coefficients : float array (1 + powers, 2)
        Standard uncertainties of their real and imaginary parts.
    noise_image, noise_mark : float
        Noise shared by the marks of an image, and that of a mark, m.
    """

    place: np.ndarray
    error: np.ndarray
    u: np.ndarray
    u_coefficients: np.ndarray
    noise_image: float
    noise_mark: float

    @property
    def u_linear(self) -> tuple[float, float, float]:
        """Standard uncertainties of scale, rotation, and the larger of stretch and shear."""
        (scale, turn), other = self.u_coefficients[1], self.u_coefficients[2]
        return float(scale), float(turn), float(other.max())

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, ``camera`` in RESULT.json."""
        scale, shear = self.coefficients[1:3]
        u_scale, u_turn = self.u_coefficients[1]
        return {
            "scale": scale.real, "rotation": scale.imag, "stretch": shear.real,
            "shear": shear.imag, "u_scale": u_scale, "u_rotation": u_turn,
            "u_stretch": self.u_coefficients[2, 0], "u_shear": self.u_coefficients[2, 1],
            "degree": max(a + b for a, b in self.powers),
            "coefficients": [
                {"power": list(power), "x": value.real, "y": value.imag, "u_x": u[0], "u_y": u[1]}
                for power, value, u in zip(self.powers, self.coefficients[1:],
                                           self.u_coefficients[1:], strict=True)],
            "cells": [{"x": z.real, "y": z.imag, "dx": e.real, "dy": e.imag, "u_dx": u[0],
                       "u_dy": u[1]} for z, e, u in zip(self.place, self.error, self.u,
                                                        strict=True)],
            "noise_image": self.noise_image, "noise_mark": self.noise_mark}


def _terms(z: np.ndarray, powers: Powers) -> np.ndarray:
    """Return 1 and the powers of places, complex (..., 1 + powers)."""
    return np.stack([np.ones_like(z), *(z**a * np.conj(z)**b for a, b in powers)], axis=-1)


def camera_of(measurements: Measurements, model: ModelFit) -> Camera | None:
    """Return the camera that a fit shows; None if cells are missing, or lie in one line."""
    images = model.problem.images
    if images is None:
        return None
    problem, grid = model.problem, model.problem.system.grid
    views = [measurements.views[index].view for index in problem.grid.index]
    image = views[0].image
    if image is None or min(image.nx, image.ny) < 3:
        return None
    cells = image.cells
    names = list(dict.fromkeys(view.plan_view for view in views))
    order = {(view.plan_view, view.cell): row for row, view in enumerate(views)}
    if any((name, cell) not in order for name in names for cell in cells):
        return None
    rows = np.array([[order[name, cell] for cell in cells] for name in names])
    middle = cells.index((0, 0))
    turn = grid.views.phases * np.exp(1j * problem.turn_rad)

    def errors(parameters: np.ndarray) -> np.ndarray:
        """Return the errors of the cells for misalignments (..., size)."""
        offset = turn * (parameters[..., 1:3 * grid.n_views:3]
                         + 1j * parameters[..., 2:3 * grid.n_views:3])
        of_cell = offset[..., rows]
        return (of_cell - of_cell[..., middle, None]).mean(axis=-2)

    noises = images.noises(model.found.residuals)
    found = errors(model.found.parameters)
    drawn = errors(images.parameters)
    samples = noises.mark * drawn[:, 0] + noises.image * drawn[:, 1]
    readings = [measurements.views[index] for index in problem.grid.index]
    published = np.array([_place([readings[row] for row in column]) for column in rows.T])
    error = found
    for _ in range(STEPS):  # from the optical axis on, not from the offsets in its cell
        powers, fit = _polynomial(published - error, found, samples)
        error = found - (fit @ found)[0]
    spread = samples @ fit.T
    return Camera(powers, fit @ error, published - error, error, _spread(
        samples - spread[:, :1]), _spread(spread), noises.image, noises.mark)


def _spread(samples: np.ndarray) -> np.ndarray:
    """Return the standard deviations of real and imaginary parts of draws (k, n), (n, 2)."""
    return np.stack([samples.real.std(axis=0, ddof=1), samples.imag.std(axis=0, ddof=1)], axis=1)


def _polynomial(place: np.ndarray, error: np.ndarray,
                samples: np.ndarray) -> tuple[Powers, np.ndarray]:
    """Return the powers of a polynomial, and the matrix from errors to its coefficients.

    A degree is taken if its coefficients differ from 0 by more than those of draws (Hotelling).
    """
    powers: tuple[tuple[int, int], ...] = POWERS[1]
    fit = _fitted(place, powers)
    for degree in (3, 2):
        more = (*powers, *POWERS[degree])
        wider = _fitted(place, more)
        added = (wider @ error)[len(powers) + 1:]
        drawn = (samples @ wider.T)[:, len(powers) + 1:]
        both = np.concatenate([drawn.real, drawn.imag], axis=1)
        value, (k, n) = np.concatenate([added.real, added.imag]), both.shape
        squares = value @ np.linalg.solve(both.T @ both / k, value)
        if fdtrc(n, k - n, squares * (k - n) / (n * (k - 1))) < DEGREE_LEVEL:
            powers, fit = more, wider
    return powers, fit


def _fitted(place: np.ndarray, powers: Powers) -> np.ndarray:
    """Return the least-squares matrix from errors at the cells to coefficients, complex."""
    scale = float(np.abs(place).max())
    unit = np.array([1.0, *(scale**(a + b) for a, b in powers)])
    return np.linalg.pinv(_terms(place / scale, powers)) / unit[:, None]


def _place(views: Sequence[ViewReadings]) -> complex:
    """Return the mean published offset in a cell, stage axes, m."""
    told = [view for view in views if view.visits is not None]
    return complex(np.mean([view.view.cell_m + (view.visits.offset_x + 1j * view.visits.offset_y)
                            .mean() for view in told if view.visits is not None]))


def straightened(measurements: Measurements, camera: Distortion) -> Measurements:
    """Return the readings with the camera's error in each cell that of its mean offset.

    Or that of its nominal place, if the camera was found from other readings.
    """
    image = next(view.view.image for view in measurements.views if view.view.image)
    places = dict(zip(image.cells, camera.place + camera.error, strict=True)) if isinstance(
        camera, Camera) else {}
    return replace(measurements, views=tuple(
        view if view.view.cell is None or view.visits is None
        else _straight(view, view.visits, camera, places.get(view.view.cell, view.view.cell_m))
        for view in measurements.views))


def known_camera(result: CalibrationResult) -> Distortion | None:
    """Return the camera that a calibration found; None if it found none."""
    found: Any = result.extra.get("camera", {})
    if "coefficients" not in found:
        return None
    try:
        powers = [(int(a), int(b)) for a, b in (one["power"] for one in found["coefficients"])]
        values = np.array([0, *(complex(one["x"], one["y"]) for one in found["coefficients"])])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("camera", "no polynomial of a camera",
                         "write the result again with `selfcal solve`") from error
    return Distortion(powers, values)


def _straight(view: ViewReadings, visits: GridVisits, camera: Distortion,
              place: complex) -> ViewReadings:
    offset = view.view.cell_m + visits.offset_x + 1j * visits.offset_y
    excess = camera.at(offset) - camera.at(np.array([place]))
    weight = visits.u**-2 if len(visits.u) and np.isfinite(visits.u).all() else visits.count
    total = np.bincount(visits.mark, weight, len(view.m))
    dx, dy = (np.bincount(visits.mark, weight * part, len(view.m)) / total
              for part in (excess.real, excess.imag))
    return replace(view, dx=view.dx - dx, dy=view.dy - dy, visits=replace(
        visits, dx=visits.dx - excess.real, dy=visits.dy - excess.imag,
        offset_x=visits.offset_x - excess.real, offset_y=visits.offset_y - excess.imag))


@dataclass(frozen=True, eq=False)
class YawMap:
    """Rotation of the stage from place to place, relative to its mean over the nodes.

    Attributes
    ----------
    place : complex array (nodes,)
        Position of the stage, m.
    yaw, u : float array (nodes,)
        Rotation, counter-clockwise, of what the stage carries, and its standard uncertainty, rad.
    p : float
        Probability that a stage that does not turn shows as much.
    """

    place: np.ndarray
    yaw: np.ndarray
    u: np.ndarray
    p: float

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form, ``yaw`` of ``camera`` in RESULT.json."""
        return {"x": self.place.real.tolist(), "y": self.place.imag.tolist(),
                "yaw": self.yaw.tolist(), "u_yaw": self.u.tolist(), "p": self.p}


def yaw_of(model: ModelFit, sense: Sense) -> YawMap | None:
    """Return the stage's yaw that a fit shows, whatever size it was given (method eq. 4.17).

    None without images, or if they do not determine it up to its mean.
    """
    images, nodes = model.problem.images, model.problem.ground.yaw
    if images is None or images.yaw is None or nodes is None or model.equations is None:
        return None
    free = replace(model.equations,
                   columns=model.equations.columns.scaled(TermName.YAW, math.inf))
    rows = free.rows([TermName.YAW]) & (free.norm > free.norm.max() * UNREAD)
    seen = rows[free.rows([TermName.YAW])]
    if np.linalg.matrix_rank(free.untold(free.free)[rows], tol=UNREAD) > 1:
        return None
    noise, taken = model.found.xy, model.coefficients
    now = score(free, model.found.both_residuals, squares(model.problem, model.found),
                coefficients=taken)
    inverse = free.inverse(noise.sigma)
    values = taken + inverse @ (
        free.unbiased_sums(now.total) - free.prior(noise.sigma) * taken)
    centred = np.eye(int(rows.sum())) - 1 / rows.sum()
    to_map = centred @ inverse[np.ix_(rows, rows)]
    share = images.noises(model.found.residuals).share
    covariance = to_map @ centred + share * images.added_covariance(
        np.tensordot(to_map, images.yaw.residuals[seen], 1))
    covariance *= noise.sigma**2
    yaw, n = centred @ values[rows], len(centred) - 1
    statistic = yaw @ np.linalg.pinv(covariance, hermitian=True, rcond=1e-9) @ yaw
    sign = -1 if sense is Sense.PLATE_MOVES else 1  # (1.6) and its rotations
    return YawMap(sign * nodes.nodes[seen], sign * yaw, np.sqrt(np.diag(covariance)),
                  float(fdtrc(n, min(noise.dof, MANY_DOF), statistic / n)))
