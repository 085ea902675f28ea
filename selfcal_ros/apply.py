# SPDX-License-Identifier: Apache-2.0
"""A calibrated stage in your own program: commands, true positions, their uncertainty.

>>> stage = load("RESULT.json")
>>> x_command, y_command = stage.command(0.010, -0.020)   # to be truly at (10, -20) mm
>>> x_true, y_true = stage.correct(x_indicated, y_indicated)
"""

import os
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.compensation.cells import SNAP, Interpolation, Outside, cubic_pieces
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.comparison.covariance import (
    covariance_of,
    variance_of_each_place,
)
from selfcal_ros.estimation.comparison.maps import MapDifference, compare
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.results import read_result

MOST_NODES = 25
"""Nodes along a side between which distances are judged."""
MAX_POINTS = 2000
"""Largest number of points of a covariance matrix: 128 MB."""


class StageMap(Compensator):
    """The error map of a result, with the covariance of any set of points.

    Parameters
    ----------
    result : CalibrationResult
        The calibration; `result.verdict` states whether it is qualified.
    method, outside : str
        As for `Compensator`; None = that of the map, bilinear on the plate's lattice and where a
        node of the map is unknown.

    Raises
    ------
    NotIdentifiableError
        If the measured plan does not identify the stage.
    InputError
        As `Compensator`.
    """

    def __init__(
        self,
        result: CalibrationResult,
        *,
        method: Interpolation | None = None,
        outside: Outside = "clamp",
    ) -> None:
        if not result.observability.identifiable:
            raise NotIdentifiableError(
                "the measured plan does not identify the stage; measure the missing views",
                result.observability,
            )
        grid = result.plate.map_grid
        all_known = grid is not None and bool(result.error_map.valid.all())
        fitted: Interpolation | None = grid.interpolation.value if grid else None
        default_method: Interpolation = fitted if fitted and all_known else "bilinear"
        super().__init__(
            result.error_map,
            method=method or default_method,
            outside=outside,
            fitted=fitted if result.reads_between_nodes else None,
        )
        self.result = result

    def __repr__(self) -> str:
        from selfcal_ros.reporting.summary.sections import (
            state_line,
        )  # words, where they are read

        return f"<StageMap {self.result.plan_id}: {state_line(self.result)}>"

    def _repr_html_(self) -> str:
        """Return the picture of `plot` for a notebook."""
        from selfcal_ros.reporting.figures.maps import (
            map_picture,
        )  # figures, where they are seen
        from selfcal_ros.reporting.figures.svg import printed_svg  # likewise

        return f'<div style="background: white">{printed_svg(map_picture(self.result))}</div>'

    def plot(self) -> Any:
        """Return the maps as a figure of matplotlib: verdict, vectors with U, angular error."""
        from selfcal_ros.reporting.figures.maps import (
            map_picture,
        )  # figures, where they are seen
        from selfcal_ros.reporting.figures.paper import (
            figure,
        )  # matplotlib, for this alone

        return figure(map_picture(self.result))

    def difference(self, other: "StageMap") -> MapDifference:
        """Return the map of `other` minus this one, as `selfcal diff` compares them.

        Raises
        ------
        InputError
            If the maps have other nodes.
        """
        return compare(self.result, other.result)

    def to_dataframe(self) -> Any:
        """Return the nodes as a table of pandas: x, y, gx, gy, u_gx, u_gy, m; NaN where unknown.

        Raises
        ------
        InputError
            If pandas is not installed.
        """
        plate = self.error_map.artifact
        emap = self.error_map
        columns = {
            "x": plate.x_m,
            "y": plate.y_m,
            "gx": emap.gx,
            "gy": emap.gy,
            "u_gx": emap.u_gx,
            "u_gy": emap.u_gy,
        }
        return _library("pandas").DataFrame(
            {name: values.ravel() for name, values in columns.items()}
        )

    def to_xarray(self) -> Any:
        """Return the maps as a data set of xarray, m and rad.

        gx, gy, u_gx, u_gy over the nodes (x, y), and g_theta, u_g_theta over the angles (theta) of
        a map with lines; `plan_id`, `grade` and the coverage factor `k` are attributes.

        Raises
        ------
        InputError
            If xarray is not installed.
        """
        emap = self.error_map
        plate = self.error_map.artifact
        coordinates = {"x": plate.x_m[:, 0], "y": plate.y_m[0]}
        maps: dict[str, tuple] = {
            name: (("x", "y"), getattr(emap, name), {"units": "m"})
            for name in ("gx", "gy", "u_gx", "u_gy")
        }
        if self.has_theta:
            coordinates["theta"] = (
                2 * np.pi * np.arange(len(emap.g_theta)) / len(emap.g_theta)
            )
            maps |= {
                name: (("theta",), getattr(emap, name), {"units": "rad"})
                for name in ("g_theta", "u_g_theta")
            }
        return _library("xarray").Dataset(
            maps,
            coordinates,
            {
                "plan_id": self.result.plan_id,
                "grade": self.result.verdict.grade.value,
                "k": self.result.noise.k_xy,
            },
        )

    def covariance(self, x_m: ArrayLike, y_m: ArrayLike) -> np.ndarray:
        """Return the covariance of Gx at all points, then Gy at all points, (2P, 2P), m^2.

        That of the interpolated error at true positions, by the interpolation of the stage: its
        values are linear in those of the sites. The variance of any combination a . (Gx, Gy), such
        as the distance of two points, is a' C a. The error of interpolation between the sites, as
        in `uncertainty`, is common to the points of a cell and independent between cells and
        between x and y.

        Raises
        ------
        InputError
            For more than `MAX_POINTS` points, a point outside the field or one that needs an
            unknown site, or a result that does not contain the correlations of its sites.
        """
        x, y = (
            np.ravel(p)
            for p in np.broadcast_arrays(
                np.asarray(x_m, dtype=float), np.asarray(y_m, dtype=float)
            )
        )
        if len(x) > MAX_POINTS:
            raise InputError(
                "covariance", f"{len(x)} points", f"give at most {MAX_POINTS}"
            )
        if np.isnan(x + y).any():
            raise InputError("covariance", "a position is not a number", "give numbers")
        if not self.inside(x, y).all():
            raise InputError(
                "covariance",
                "a point lies outside the calibrated field",
                "leave it out: its uncertainty is not known",
            )
        weights = self._weights(x, y)
        used_sites = weights.any(axis=0)
        if not self.error_map.valid.ravel()[used_sites].all():
            raise InputError(
                "covariance",
                "a point lies next to an unknown site",
                "leave the point out, or measure the site",
            )
        sites = covariance_of(
            self.result, "xy", used_sites.reshape(self.error_map.artifact.shape)
        )
        if sites.ndim == 1:
            raise InputError(
                "covariance",
                "the result does not contain the correlations of its sites",
                "solve again with uncertainties; fields beyond 31 x 31 marks (means and rechecks: "
                "21 x 21), and means with maps from tables, have none",
            )
        # what has a sign of its own at each place has it between the sites as well
        of_each_place = variance_of_each_place(self.result).reshape(2, -1)[
            :, used_sites
        ]
        sites[np.diag_indices_from(sites)] -= of_each_place.ravel()
        weights_xy = np.kron(np.eye(2), weights[:, used_sites])
        cells = np.stack([self._cell(x, 0), self._cell(y, 1)])
        alike = (cells[:, :, None] == cells[:, None, :]).all(axis=0)
        cover = weights_xy @ sites @ weights_xy.T
        near = abs(weights[:, used_sites])
        near /= near.sum(axis=1, keepdims=True)
        cover[np.diag_indices_from(cover)] += (of_each_place @ near.T).ravel()
        for axis, more in enumerate(self._between(x, y)):
            rows = slice(axis * len(x), (axis + 1) * len(x))
            cover[rows, rows] += alike * np.outer(more, more)
        return cover

    def _cell(self, p_m: np.ndarray, axis: int) -> np.ndarray:
        """Return the cells of the grid along an axis in which positions lie, (P,)."""
        half = self.error_map.artifact.half[axis]
        return np.clip(np.floor(p_m / self._pitch + half), 0, 2 * half - 1)

    def length_error(
        self, first: tuple[ArrayLike, ArrayLike], second: tuple[ArrayLike, ArrayLike]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the error indicated - true of distances, and its standard uncertainty, (P,) m.

        The uncertainty is NaN where an end lies outside the field, both where one lies next to an
        unknown site.

        Parameters
        ----------
        first, second : tuple of array
            True x and y of the two ends of each distance, m.

        Raises
        ------
        InputError
            If two ends coincide, or as `covariance`.
        """
        ends = np.broadcast_arrays(
            *(np.asarray(p, dtype=float) for p in (*first, *second))
        )
        x1, y1, x2, y2 = (np.ravel(p) for p in ends)
        dx, dy = x2 - x1, y2 - y1
        length = np.hypot(dx, dy)
        if not (length > 0).all():
            raise InputError("distance", "its ends coincide", "give two points")
        (ax, ay), (bx, by) = self.error(x1, y1), self.error(x2, y2)
        error = np.hypot(dx + bx - ax, dy + by - ay) - length
        u = np.full(len(length), np.nan)
        inside = self.inside(x1, y1) & self.inside(x2, y2)
        known_pairs = np.flatnonzero(inside & np.isfinite(error))
        for start in range(0, len(known_pairs), MAX_POINTS // 2):
            chunk = known_pairs[start : start + MAX_POINTS // 2]
            cover = self.covariance(
                np.append(x1[chunk], x2[chunk]), np.append(y1[chunk], y2[chunk])
            )
            u[chunk] = _along(
                cover, dx[chunk] / length[chunk], dy[chunk] / length[chunk]
            )
        return error, u

    def length_uncertainty(self, *, anywhere: bool = True) -> tuple[float, float]:
        """Return a in m and b in m/m: U of a distance L in the field is at most a + b L.

        With the coverage factor of the map, 95.45 %. Of a larger field every second, third, ...
        place stands for its neighbours.

        Parameters
        ----------
        anywhere : bool
            Whether the ends lie anywhere in the field: at nodes and halfway between them, where
            the error of interpolation is largest. Otherwise both are nodes.

        Raises
        ------
        InputError
            As `covariance`.
        """
        from scipy.optimize import linprog  # a third of a second, for this alone

        x, y = self._places(between=anywhere)
        i, j = np.triu_indices(len(x), 1)
        if not len(i):
            raise InputError(
                "distance", "fewer than two sites are known", "measure more"
            )
        cover = self.covariance(x, y)
        dx = x[j] - x[i]
        dy = y[j] - y[i]
        length = np.hypot(dx, dy)
        n = len(x)
        ex, ey = dx / length, dy / length
        square = sum(
            weight * _of_difference(cover, at, to)
            for weight, at, to in ((ex**2, i, j), (ey**2, i + n, j + n))
        )
        square += (
            2
            * ex
            * ey
            * (cover[i, i + n] + cover[j, j + n] - cover[i, j + n] - cover[j, i + n])
        )
        U = self.result.noise.k_xy * np.sqrt(np.maximum(square, 0.0))
        size = U.max() or 1.0  # both unknowns near one
        at, which = np.unique(
            np.rint(length / length.max() / SNAP), return_inverse=True
        )
        most = np.zeros(len(at))  # of each length the largest U
        np.maximum.at(most, which, U / size)
        solution = linprog(
            [1.0, (length / length.max()).mean()],
            b_ub=-most,
            A_ub=-np.stack([np.ones(len(at)), SNAP * at], axis=1),
        )
        return float(solution.x[0] * size), float(solution.x[1] * size / length.max())

    def _places(self, *, between: bool) -> tuple[np.ndarray, np.ndarray]:
        """Return x and y of known nodes, m, (P,); with `between` of points halfway as well.

        At most about `MOST_NODES` along a side, which of a larger field stand for the others.
        """
        plate = self.error_map.artifact
        if not between:
            step = -(-max(plate.shape) // MOST_NODES)
            some = np.zeros(plate.shape, dtype=bool)
            rows, columns = (
                {*range(0, count, step), count - 1} for count in plate.shape
            )
            some[np.ix_(sorted(rows), sorted(columns))] = True
            some &= self.error_map.valid
            return plate.x_m[some], plate.y_m[some]
        sides = []
        for count in plate.shape:
            last = 2 * count - 2  # in half pitches
            # odd: nodes and points between them in turn
            step = -(-last // MOST_NODES) | 1
            halves = np.unique([*range(0, last, step), 1, last - 1, last])
            sides.append((halves - last / 2) * self._pitch / 2)
        x, y = (p.ravel() for p in np.meshgrid(*sides, indexing="ij"))
        known = np.isfinite(self.error(x, y)[0])
        return x[known], y[known]

    def _weights(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the weights of the sites in the interpolated error at points, (P, sites)."""
        of_x, of_y = (
            self._weights_along(p, count)
            for p, count in zip((x, y), self.error_map.artifact.shape, strict=True)
        )
        return (of_x[:, :, None] * of_y[:, None, :]).reshape(len(x), -1)

    def _weights_along(self, p_m: np.ndarray, count: int) -> np.ndarray:
        """Return the weights of the nodes of one axis at positions along it, (P, count)."""
        at = np.clip(p_m / self._pitch + (count - 1) / 2, 0, count - 1)
        at = np.where(np.abs(at - np.round(at)) < SNAP, np.round(at), at)
        below = np.minimum(at.astype(int), count - 2)
        inside = (at - below)[:, None]
        # the splines that are 1 at one node and 0 at the others
        if self.method == "bicubic":
            c = cubic_pieces(np.eye(count))[:, below]
            return ((c[3] * inside + c[2]) * inside + c[1]) * inside + c[0]
        unit = np.eye(count)
        return (1 - inside) * unit[below] + inside * unit[below + 1]


def _library(name: str) -> ModuleType:
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        raise InputError(
            error.name or name, "not installed", f"pip install {name}"
        ) from error


def _along(cover: np.ndarray, ex: np.ndarray, ey: np.ndarray) -> np.ndarray:
    """Return u of e . (G2 - G1) for pairs, from the covariance of Gx1, Gx2, Gy1, Gy2."""
    pairs = len(ex)
    covariances = cover.reshape(4, pairs, 4, pairs)[
        :, np.arange(pairs), :, np.arange(pairs)
    ]
    row = np.stack([-ex, ex, -ey, ey], axis=1)
    return np.sqrt(np.maximum(np.einsum("pa,pab,pb->p", row, covariances, row), 0.0))


def _of_difference(cover: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    """Return the variance of the difference of components i and j."""
    return cover[i, i] + cover[j, j] - 2 * cover[i, j]


def load(
    path: str | os.PathLike,
    *,
    method: Interpolation | None = None,
    outside: Outside = "clamp",
) -> StageMap:
    """Return the calibrated stage of a RESULT.json.

    Raises
    ------
    InputError
        If the file is not a result.
    NotIdentifiableError
        If its plan does not identify the stage.
    """
    return StageMap(read_result(path), method=method, outside=outside)
