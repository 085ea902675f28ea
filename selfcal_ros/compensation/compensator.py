# SPDX-License-Identifier: Apache-2.0
"""The compensator: use of a calibrated error map (method eqs. 1.4, 1.5).

The error map contains G = indicated - true at the true position of the marks, hence

    indicated to command for a true position p:   p + G(p)                  (direct)
    true position of an indicated position q:     the p with p + G(p) = q   (fixed point)
"""

import math
from collections.abc import Callable
from functools import cached_property, partial
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.compensation.cells import (
    MAX_ITERATIONS,
    REST,
    SNAP,
    Cells,
    Interpolation,
    Outside,
    bicubic_cells,
    bilinear_cells,
)
from selfcal_ros.compensation.circle import MAX_SLOPE, Circle, steep
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import (
    ErrorMap,
    along_axes,
    error_at_edges,
    error_halfway,
    share_between,
)

GENTLE = 0.005
"""Slope between neighbours below which no spline through them gets near twice MAX_SLOPE."""

PER_STEP = 4
"""Places from one node to the next at which `Compensator.between` looks."""

PASSED_ON = {"bilinear": 0.0, "bicubic": 2 - math.sqrt(3)}
"""Part of an error in one cell that interpolation has in the next: the decay of a cubic spline."""

_Field = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


class Compensator:
    """Evaluate an error map and its inverse at any position in the stage frame.

    Parameters
    ----------
    error_map : ErrorMap
        Stage error G at the sites, and Gtheta at the angular lines.
    method : {"bilinear", "bicubic"}
        Interpolation between the sites. ``bilinear`` is that of the controller with an
        exported table. ``bicubic`` is the interpolating cubic spline (periodic for theta); it
        refuses a map with unknown sites, because each of them would affect the whole field. An
        angular map with harmonics is its Fourier series with both.
    outside : {"clamp", "refuse"}
        Outside the calibrated field: use the error of the nearest point of its edge, whose
        uncertainty there is not known, or raise.
    fitted : {"bilinear", "bicubic"}, optional
        Interpolation with which the map was estimated from readings between its own nodes: what it
        does not follow is then in the uncertainty of these.

    Raises
    ------
    InputError
        For an unknown option, a bicubic map with unknown sites, or a map too steep to be
        inverted.

    Notes
    -----
    Unknown sites (NaN) with ``bilinear``: the value is NaN wherever an unknown site has
    weight, so that known sites themselves stay known. NaN positions give NaN.
    All methods take scalars or arrays that broadcast and return float arrays of that shape.
    """

    def __init__(
        self,
        error_map: ErrorMap,
        *,
        method: Interpolation = "bilinear",
        outside: Outside = "clamp",
        fitted: Interpolation | None = None,
    ) -> None:
        if method not in get_args(Interpolation):
            raise InputError(
                "compensator method",
                f"'{method}' is unknown",
                "use bilinear or bicubic",
            )
        if outside not in get_args(Outside):
            raise InputError(
                "compensator outside", f"'{outside}' is unknown", "use clamp or refuse"
            )
        self.error_map, self.method, self.outside = error_map, method, outside
        self._not_fitted = float(fitted != method)
        self._pitch = error_map.artifact.grid_pitch_m
        fields = np.stack([error_map.gx, error_map.gy])
        if method == "bicubic" and not np.isfinite(fields).all():
            missing = int((~error_map.valid).sum())
            raise InputError(
                "error map",
                f"{missing} sites are unknown",
                "bicubic needs all of them: use bilinear or measure them",
            )
        self._cells = (
            bilinear_cells(fields) if method == "bilinear" else bicubic_cells(fields)
        )
        if self._cells.largest_step > MAX_SLOPE * self._pitch:
            raise steep("sites")
        if (
            method == "bicubic"
            and self._cells.largest_step > GENTLE * self._pitch
            and self._cells.steepest() > 2 * MAX_SLOPE * self._pitch
        ):
            raise _steep_spline()
        self._u_cells = bilinear_cells(error_map.u_xy)
        self._theta = Circle(
            error_map.g_theta,
            cubic=method == "bicubic",
            harmonics=error_map.artifact.harmonics,
        )
        self._u_theta = Circle(error_map.u_g_theta, cubic=False, harmonics=0)

    @property
    def has_theta(self) -> bool:
        """Whether the map has theta."""
        return self.error_map.artifact.angular_count > 0

    def inside(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return whether positions are in the calibrated field, edge included, bool array."""
        half = np.array(self.error_map.artifact.half) * self._pitch + SNAP * self._pitch
        return (np.abs(x_m) <= half[0]) & (np.abs(y_m) <= half[1])

    def is_inside(self, x_m: float, y_m: float) -> bool:
        """Return `inside` of one position, fifty times as fast."""
        half_x, half_y = self.error_map.artifact.half
        return bool(
            abs(x_m) <= (half_x + SNAP) * self._pitch
            and abs(y_m) <= (half_y + SNAP) * self._pitch
        )

    def error(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return G = indicated - true, m, at true positions `x_m`, `y_m`.

        Raises
        ------
        InputError
            With ``outside="refuse"``, if a position is outside the field.
        """
        self._refuse_outside(x_m, y_m)
        return self._blocks(
            lambda x, y: self._at(self._cells, x, y), (x_m, y_m), self._cells.block
        )

    def command(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the indicated position to command so that the true one is `x_m`, `y_m`.

        Raises
        ------
        InputError
            With ``outside="refuse"``, if a position is outside the field.
        """
        gx, gy = self.error(x_m, y_m)
        return np.asarray(x_m) + gx, np.asarray(y_m) + gy

    def correct(self, x_m: ArrayLike, y_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """Return the true position for the indicated position `x_m`, `y_m`.

        Raises
        ------
        InputError
            With ``outside="refuse"``, if a true position is outside the field.
        """
        x, y = np.broadcast_arrays(
            np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float)
        )
        out = self._blocks(
            self._invert(self._cells.solve_in_cell), (x, y), self._cells.block
        )
        unsolved = np.isnan(out[0])
        if unsolved.any():
            solutions = self._blocks(
                self._invert(self._cells.solve),
                (x[unsolved], y[unsolved]),
                self._cells.block,
            )
            for axis, values in zip(out, solutions, strict=True):
                axis[unsolved] = values
        self._refuse_outside(*out)
        return out

    def correct_point(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return `correct` of one finite position, twenty times as fast.

        Raises
        ------
        InputError
            As `correct`.
        """
        hx, hy = self.error_map.artifact.half
        pitch = self._pitch
        s, t = x_m / pitch + hx, y_m / pitch + hy
        a, b = self._cells.solve_point(s, t, 1 / pitch)
        if math.isnan(a):  # the solution is in another cell, outside, or does not exist
            a, b = self._cells.solve_point_anywhere(s, t, 1 / pitch)
        x = (a - hx) * pitch
        y = (b - hy) * pitch
        snap = SNAP * pitch
        is_inside = abs(x) <= hx * pitch + snap and abs(y) <= hy * pitch + snap
        if math.isnan(a) or (self.outside == "refuse" and not is_inside):
            x, y = map(float, self.correct(x_m, y_m))
        return x, y

    def uncertainty(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return standard uncertainties of G, m, at true positions `x_m`, `y_m`.

        NaN outside the field: no reading says anything about G there.

        The uncertainties of the sites, interpolated bilinearly: an upper bound for the bilinear
        value whatever the correlation of the sites. The bicubic value for sites with equal and
        independent errors stays within it to 1 %, except in the outermost cells, where it may
        exceed it by 37 %. In quadrature to it the error of interpolation between the sites, from
        the map's own curvature and edges (method eqs. 1.7, 1.8), unless the map was estimated
        with it.

        Raises
        ------
        InputError
            With ``outside="refuse"``, if a position is outside the field.
        """
        self._refuse_outside(x_m, y_m)
        ux, uy = self._blocks(
            lambda x, y: self._at(self._u_cells, x, y), (x_m, y_m), self._u_cells.block
        )
        more_x, more_y = self._between(x_m, y_m)
        inside = self.inside(x_m, y_m)
        return (
            np.where(inside, np.hypot(ux, more_x), np.nan),
            np.where(inside, np.hypot(uy, more_y), np.nan),
        )

    def uncertainty_indicated(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return `uncertainty` at the true positions of indicated ones `x_m`, `y_m`.

        What is indicated in the field belongs to it, also where its error places it just beyond
        the edge: there it has the uncertainty of the edge.

        Raises
        ------
        InputError
            As `correct`.
        """
        indicated_inside = self.inside(x_m, y_m)
        places = []
        for true, half in zip(
            self.correct(x_m, y_m), self.error_map.artifact.half, strict=True
        ):
            edge = half * self._pitch
            places.append(np.where(indicated_inside, np.clip(true, -edge, edge), true))
        return self.uncertainty(places[0], places[1])

    @cached_property
    def halfway(self) -> np.ndarray:
        """The error of interpolation halfway between sites, rms, m: [of Gx, Gy; along x, y]."""
        error = partial(error_halfway, cubic=self.method == "bicubic")
        return self._not_fitted * along_axes(error, self.error_map)[..., 0]

    @cached_property
    def edges(self) -> np.ndarray:
        """What it has more in the outermost cells, m: [of Gx, Gy; along x, y; first, last cell]."""
        return self._not_fitted * along_axes(error_at_edges, self.error_map)

    def _between(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return the standard uncertainty of the interpolation of Gx and Gy, (2, ...), m."""
        sizes = np.concatenate([self.halfway[..., None], self.edges], axis=2) ** 2
        square = 0.0
        for axis, (p, half) in enumerate(
            zip(
                np.broadcast_arrays(x_m, y_m), self.error_map.artifact.half, strict=True
            )
        ):
            cells = np.arange(2 * half)
            away = np.stack([0 * cells, cells, cells[::-1]])
            in_cells = sizes[:, axis] @ PASSED_ON[self.method] ** (2 * away)
            at = np.clip(np.asarray(p, dtype=float) / self._pitch + half, 0, 2 * half)
            at = np.where(abs(at - np.round(at)) < SNAP, np.round(at), at)
            cell = np.minimum(np.nan_to_num(at), cells[-1]).astype(int)
            square = square + in_cells[:, cell] * share_between(at) ** 2
        return np.sqrt(square)

    def error_theta(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return Gtheta = indicated - true, rad, at true angles; any number of turns.

        Raises
        ------
        InputError
            If the map has no angular lines.
        """
        self._refuse_no_theta()
        return self._theta.at(np.asarray(theta_rad, dtype=float))

    def command_theta(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return the indicated angle to command so that the true one is `theta_rad`.

        Raises
        ------
        InputError
            If the map has no angular lines.
        """
        return np.asarray(theta_rad) + self.error_theta(theta_rad)

    def correct_theta(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return the true angle for the indicated angle `theta_rad`.

        Raises
        ------
        InputError
            If the map has no angular lines.
        """
        self._refuse_no_theta()
        indicated = np.asarray(theta_rad, dtype=float)
        true = indicated - self._theta.at(indicated)
        for _ in range(MAX_ITERATIONS):
            step = indicated - self._theta.at(true) - true
            true = true + step
            if not np.any(np.abs(step) > 1e-15 + REST * np.abs(true)):
                break
        return true

    def correct_angle(self, theta_rad: float) -> float:
        """Return `correct_theta` of one finite angle, faster.

        Raises
        ------
        InputError
            As `correct_theta`.
        """
        self._refuse_no_theta()
        true = theta_rad - self._theta.at_point(theta_rad)
        for _ in range(MAX_ITERATIONS):
            step = theta_rad - self._theta.at_point(true) - true
            true = true + step
            if not abs(step) > 1e-15 + REST * abs(true):
                break
        return true

    def uncertainty_theta(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return the standard uncertainty of Gtheta, rad, like `uncertainty`.

        Raises
        ------
        InputError
            If the map has no angular lines.
        """
        self._refuse_no_theta()
        angle = np.asarray(theta_rad, dtype=float)
        count = self.error_map.artifact.angular_count
        return np.hypot(
            self._u_theta.at(angle),
            self._halfway_theta * share_between(angle * (count / (2 * np.pi))),
        )

    @cached_property
    def _halfway_theta(self) -> float:
        emap = self.error_map
        cubic = self.method == "bicubic"
        if emap.artifact.harmonics:
            return 0.0
        return error_halfway(emap.g_theta, emap.u_g_theta, cubic=cubic, ring=True)[0]

    def between(self) -> tuple[list[np.ndarray], np.ndarray]:
        """Return Gx and Gy, m, and Gtheta, rad, at nodes and at three points between neighbours.

        Splines pass beyond the values of their nodes; bilinear ones do not.
        """
        artifact = self.error_map.artifact
        count = PER_STEP * self.error_map.artifact.angular_count
        places = [
            np.linspace(-half, half, round(2 * half * PER_STEP) + 1) * self._pitch
            for half in artifact.half
        ]
        grids = (
            [self.error_map.gx, self.error_map.gy]
            if self.method == "bilinear"
            else [*self.error(places[0][:, None], places[1])]
        )
        return grids, self._theta.at(np.arange(count) * (2 * np.pi / max(count, 1)))

    def _at(
        self, cells: Cells, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        hx, hy = self.error_map.artifact.half
        return cells.at(x / self._pitch + hx, y / self._pitch + hy)

    def _invert(self, solve: Callable) -> _Field:
        hx, hy = self.error_map.artifact.half
        pitch = self._pitch

        def field(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            a, b = solve(x / pitch + hx, y / pitch + hy, 1 / pitch)
            return (a - hx) * pitch, (b - hy) * pitch

        return field

    def _blocks(
        self, field: _Field, position: tuple[ArrayLike, ArrayLike], block: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Apply `field` block by block to broadcast positions."""
        x, y = np.broadcast_arrays(*(np.asarray(p, dtype=float) for p in position))
        shape = x.shape
        x = x.ravel()
        y = y.ravel()
        out_x, out_y = np.empty(x.size), np.empty(x.size)
        for start in range(0, x.size, block):
            chunk = slice(start, start + block)
            out_x[chunk], out_y[chunk] = field(x[chunk], y[chunk])
        return out_x.reshape(shape), out_y.reshape(shape)

    def _refuse_outside(self, x_m: ArrayLike, y_m: ArrayLike) -> None:
        if self.outside == "clamp":
            return
        # An unknown position (NaN) is neither inside nor outside: it gives NaN.
        off = ~(self.inside(x_m, y_m) | np.isnan(x_m) | np.isnan(y_m))
        if np.any(off):
            x, y = np.broadcast_arrays(x_m, y_m)
            first = np.flatnonzero(off)[0]
            raise InputError(
                "position",
                f"({x.flat[first]:.9g}, {y.flat[first]:.9g}) m lies outside the calibrated field",
                "stay inside, or have it corrected as the nearest point of the edge",
            )

    def _refuse_no_theta(self) -> None:
        if not self.has_theta:
            raise InputError(
                "error map",
                "it has no angular lines",
                "calibrate with a plate that has them",
            )


def _steep_spline() -> InputError:
    return InputError(
        "error map",
        "the cubic spline between the sites is steeper than one half",
        "such a map cannot be inverted: use bilinear, or check its units (m, rad)",
    )
