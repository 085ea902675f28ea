# SPDX-License-Identifier: Apache-2.0
"""The artifact plate: a grid of marks and a circle of angular lines."""

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import checked_fields

MAX_GRID_SIZE = 1001
MAX_ANGULAR_COUNT = 1_000_000
MAX_HARMONICS = 180
DEFAULT_NODES = 51
"""Largest number of nodes along one side of a map that nobody asked for."""
PITCH_RANGE_M = (1e-7, 1.0)
"""Valid distances between marks."""


class Interpolation(StrEnum):
    """Interpolation of the stage's error between the nodes of its map."""

    BILINEAR = "bilinear"
    BICUBIC = "bicubic"


@dataclass(frozen=True)
class MapGrid:
    """Nodes of the error map where they are not the sites of the plate's lattice.

    Attributes
    ----------
    size : int
        Number of nodes along x; odd. The map is square unless `size_y` is given.
    pitch_m : float
        Distance between neighbouring nodes, m.
    interpolation : Interpolation
        Between the nodes.
    size_y : int
        Number of nodes along y; 0 means `size`.
    """

    size: int
    pitch_m: float
    interpolation: Interpolation = Interpolation.BICUBIC
    size_y: int = 0


@dataclass(frozen=True)
class Artifact:
    """Nominal geometry of the plate, and the grid of the stage's map.

    Unless `map_grid` is given, the map has its nodes on the plate's lattice.

    Attributes
    ----------
    grid_size : int
        N, number of marks along x; odd. The plate is square unless `grid_size_y` is given.
    grid_pitch_m : float
        Distance between neighbouring marks, m.
    angular_count : int
        K, number of angular lines, at least 3; 0 for a plate without them. Lines are read in the
        views that are turned by a whole number of them: at 90 deg if K is a multiple of 4.
    grid_size_y : int
        Number of marks along y; 0 means `grid_size`.
    map_grid : MapGrid, optional
        Nodes of the error map, for views whose marks do not lie on the lattice.
    harmonics : int
        H, harmonics of the angular map, below K/2: a Fourier series, for views at any turn. 0 = one
        value for each line, for views turned by whole lines.

    Raises
    ------
    InputError
        If a size is even, a size or the pitch is out of range, K is 1, 2 or negative, or the lines
        do not determine H harmonics.
    """

    grid_size: int
    grid_pitch_m: float
    angular_count: int = 0
    grid_size_y: int = 0
    map_grid: MapGrid | None = None
    harmonics: int = 0

    def __post_init__(self) -> None:
        """Refuse sizes without a centre mark and counts without a quarter turn."""
        for name, size in (("grid_size", self.grid_size), ("grid_size_y", self.shape[1])):
            if not 3 <= size <= MAX_GRID_SIZE or size % 2 == 0:
                raise InputError(f"artifact {name}", f"{size} is not an odd number from 3 to "
                                 f"{MAX_GRID_SIZE}", "the plate needs a mark at its centre")
        if not (np.isfinite(self.grid_pitch_m) and self.grid_pitch_m > 0):
            raise InputError("artifact grid_pitch", f"{self.grid_pitch_m} m is not a length",
                             "give the distance between marks in metres")
        if not PITCH_RANGE_M[0] <= self.grid_pitch_m <= PITCH_RANGE_M[1]:
            raise InputError("artifact grid_pitch", f"{self.grid_pitch_m:g} m is no pitch of a "
                             f"plate ({PITCH_RANGE_M[0]:g} to {PITCH_RANGE_M[1]:g} m)",
                             "is it in mm? give the distance between marks in metres")
        if self.angular_count and not 3 <= self.angular_count <= MAX_ANGULAR_COUNT:
            raise InputError("artifact angular_count", f"{self.angular_count} is not a number from "
                             f"3 to {MAX_ANGULAR_COUNT}", "give 0 for a plate without lines")
        most = min((self.angular_count - 1) // 2, MAX_HARMONICS)
        if self.harmonics and not 0 < self.harmonics <= most:
            raise InputError("map harmonics", f"{self.harmonics} harmonics cannot be told with "
                             f"{self.angular_count} lines", f"give 1 to {most}" if most > 0 else
                             "leave them out for a plate without lines")
        if self.map_grid is not None:
            try:
                Artifact(self.map_grid.size, self.map_grid.pitch_m, 0, self.map_grid.size_y)
            except InputError as error:
                raise InputError(error.where.replace("artifact", "map"), error.what,
                                 "give the map an odd number of nodes, its pitch in m") from error

    @cached_property
    def field(self) -> "Artifact":
        """Lattice of the error map: that of the plate unless `map_grid` is given."""
        grid = self.map_grid
        return self if grid is None else Artifact(
            grid.size, grid.pitch_m, self.angular_count, grid.size_y, harmonics=self.harmonics)

    @property
    def field_half_m(self) -> tuple[float, float]:
        """Largest x and y of the stage's field, m."""
        return self.field.half[0] * self.field.grid_pitch_m, (
            self.field.half[1] * self.field.grid_pitch_m)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of marks along x and y."""
        return self.grid_size, self.grid_size_y or self.grid_size

    @property
    def half(self) -> tuple[int, int]:
        """Largest index along x and y: h = (N-1)/2."""
        return self.shape[0] // 2, self.shape[1] // 2  # both are odd

    @cached_property
    def m(self) -> np.ndarray:
        """Index m of every site, int array (nx, ny)."""
        return np.repeat(np.arange(self.shape[0])[:, None] - self.half[0], self.shape[1], axis=1)

    @cached_property
    def n(self) -> np.ndarray:
        """Index n of every site, int array (nx, ny)."""
        return np.repeat(np.arange(self.shape[1])[None, :] - self.half[1], self.shape[0], axis=0)

    @property
    def x_m(self) -> np.ndarray:
        """Nominal x of every site in m, (nx, ny)."""
        return self.m * self.grid_pitch_m

    @property
    def y_m(self) -> np.ndarray:
        """Nominal y of every site in m, (nx, ny)."""
        return self.n * self.grid_pitch_m

    @property
    def theta_rad(self) -> np.ndarray:
        """Nominal angle of every line in rad, (K,), from 0 counter-clockwise."""
        return np.arange(self.angular_count) * (2 * np.pi / max(self.angular_count, 1))


def map_to_dict(artifact: Artifact) -> dict[str, Any]:
    """Return what a map has of its own in the form of ``map`` in PLAN.yaml; empty if nothing."""
    grid, own = artifact.map_grid, {}
    if grid is not None:
        own = {"grid_size": grid.size, "grid_pitch": grid.pitch_m,
               "interpolation": str(grid.interpolation),
               **({"grid_size_y": grid.size_y} if grid.size_y else {})}
    return own | ({"harmonics": artifact.harmonics} if artifact.harmonics else {})


def map_grid_from_dict(data: dict[str, Any]) -> MapGrid | None:
    """Return the nodes of `map_to_dict`; None if there are none.

    Raises
    ------
    KeyError, ValueError
        If a key is missing, or the interpolation is unknown.
    """
    if not set(data) - {"harmonics"}:
        return None
    return MapGrid(data["grid_size"], float(data["grid_pitch"]),
                   Interpolation(data["interpolation"]), data.get("grid_size_y", 0))


def default_map_grid(artifact: Artifact) -> MapGrid:
    """Return the map's nodes for views off the lattice, where a plan does not give them.

    They span the field of the plate; along its longer side there are three quarters as many nodes
    as marks, at least five if there are as many marks, at most `DEFAULT_NODES`. With as many nodes
    as marks the readings hardly determine the outermost ones.
    """
    longer = max(artifact.half)
    cells = max(int(0.75 * (2 * longer + 1) - 1) // 2 * 2, min(4, 2 * longer))
    cells = min(cells, DEFAULT_NODES - 1)
    pitch_m = 2 * longer * artifact.grid_pitch_m / cells
    sides = [max(2 * ceil(cells * half / (2 * longer) - 1e-9) + 1, 3) for half in artifact.half]
    return MapGrid(sides[0], pitch_m, Interpolation.BICUBIC,
                   sides[1] if sides[1] != sides[0] else 0)


def harmonics_of(data: dict, where: str) -> int:
    """Return the harmonics of the angular map in a plan; 0 if it does not give them."""
    given = {"harmonics": data.get("harmonics", 0)}
    return checked_fields(given, where, {"harmonics": int})["harmonics"]


def map_grid_of(data: dict, artifact: Artifact, where: str) -> MapGrid | None:
    """Return the nodes of the map; None if the plan does not give them."""
    if not set(data) - {"harmonics"}:
        return None
    raw = checked_fields(data, where, {"grid_size": int}, {
        "grid_pitch": (float, 0.0), "interpolation": (str, str(Interpolation.BICUBIC)),
        "grid_size_y": (int, 0), "harmonics": (int, 0)})
    if raw["interpolation"] not in list(Interpolation):
        raise InputError(f"{where}: interpolation", f"'{raw['interpolation']}' is not known",
                         f"use one of {', '.join(Interpolation)}")
    sizes = raw["grid_size"], raw["grid_size_y"] or raw["grid_size"]
    spans = max(half / max(size // 2, 1) for half, size in zip(artifact.half, sizes, strict=True))
    return MapGrid(sizes[0], raw["grid_pitch"] or spans * artifact.grid_pitch_m,
                   Interpolation(raw["interpolation"]), raw["grid_size_y"])
