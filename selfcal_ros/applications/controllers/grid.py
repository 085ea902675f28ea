# SPDX-License-Identifier: Apache-2.0
"""What the tables of all controllers share: wiring, nodes, digits, interpolation, reading."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from selfcal_ros.compensation.cells import Interpolation
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.export import tidy
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import Correction, require_known
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap

ROUNDING_M = 0.5e-11
"""Largest rounding of a value by its digits."""
MAX_ENTRIES = 4_000_000
"""Largest number of entries in a table that is read."""
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?"


@dataclass(frozen=True)
class Wiring:
    """The controller's axes, and what its format leaves to the user.

    Attributes
    ----------
    frame : MachineFrame
        Axes, unit, home position, encoder directions.
    counts : tuple of float, optional
        Encoder counts per unit of x and y.
    negate : bool
        Whether the controller subtracts what its table says.
    integers : bool
        Whether it reads integers only.
    """

    frame: MachineFrame
    counts: tuple[float, float] | None = None
    negate: bool = False
    integers: bool = False


class Source(NamedTuple):
    """A file that was read, or is about to be written."""

    text: str
    where: str


class Line(NamedTuple):
    """A line of a file without its comment."""

    text: str
    where: str


@dataclass(frozen=True, eq=False)
class Grid:
    """Values on a regular grid, linear between the nodes.

    Attributes
    ----------
    first, step : tuple of float
        Position of the first node and spacing along both axes.
    values : float array (nx, ny)
        One node along an axis: no dependence on it.
    edge : str
        Outside: "hold" the value of the edge, "extrapolate" the last cell, or "roll" over after
        the last node.
    """

    first: tuple[float, float]
    step: tuple[float, float]
    values: np.ndarray
    edge: Literal["hold", "extrapolate", "roll"] = "hold"

    def at(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return the values at positions."""
        (i, i1, u), (j, j1, v) = (self._cell(axis, p) for axis, p in enumerate((x, y)))
        c = self.values
        return (1 - u) * ((1 - v) * c[i, j] + v * c[i, j1]) + u * (
            (1 - v) * c[i1, j] + v * c[i1, j1]
        )

    def _cell(self, axis: int, position: np.ndarray) -> tuple:
        last = self.values.shape[axis] - 1
        way = (np.asarray(position, dtype=float) - self.first[axis]) / self.step[axis]
        if last == 0:
            return 0, 0, 0 * way
        if self.edge == "roll":
            way = np.mod(way, last)
        elif self.edge == "hold":
            way = np.clip(way, 0, last)
        below = np.clip(np.floor(way).astype(np.int64), 0, last - 1)
        return below, below + 1, way - below


def wanted(
    error_map: ErrorMap, wiring: Wiring, *, method: Interpolation = "bilinear"
) -> Correction:
    """Return the correction c = +G at any position, in the controller's coordinates.

    By `method` between the nodes: a table is linear there.

    Raises
    ------
    InputError
        If a site is unknown: a table has no holes.
    """
    require_known(error_map)
    stage = Compensator(error_map, method=method)
    frame = wiring.frame
    sense = (-1.0 if wiring.negate else 1.0) / frame.unit_m

    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gx, gy = stage.error(*frame.from_machine(px, py))
        return sense * frame.sign_x * gx, sense * frame.sign_y * gy

    return correct


def nodes(error_map: ErrorMap, frame: MachineFrame) -> tuple[np.ndarray, np.ndarray]:
    """Return the positions of the sites' columns and rows, ascending, controller's coordinates."""
    plate = error_map.artifact
    x, y = frame.to_machine(plate.x_m[:, 0], plate.y_m[0])
    return np.array([*map(tidy, np.sort(x))]), np.array([*map(tidy, np.sort(y))])


def spacing(positions: np.ndarray) -> float:
    """Return the distance between equidistant positions without rounding errors."""
    return float(f"{(positions[-1] - positions[0]) / (len(positions) - 1):.13g}")


def fixed(value: float, unit_m: float) -> str:
    """Return a length in a unit with as many decimals as its rounding has to stay negligible."""
    decimals = max(0, math.ceil(-math.log10(2 * ROUNDING_M / unit_m) - 1e-9))
    text = f"{value:.{decimals}f}"
    return text.removeprefix("-") if float(text) == 0 else text


def lines_of(source: Source, comment: str) -> list[Line]:
    """Return the lines with content; `comment` is a pattern of what is removed from each."""
    lines = [
        Line(re.sub(comment, " ", text).strip(), f"{source.where}:{number}")
        for number, text in enumerate(source.text.splitlines(), 1)
    ]
    return [line for line in lines if line.text]


def numbers(text: str, where: str, pattern: str) -> list[float]:
    """Return the numbers in a line of the form `pattern`, in which N and I stand for them.

    Raises
    ------
    InputError
        If the line has another form, or a number is too large.
    """
    form = pattern.replace("N", f"({NUMBER})").replace("I", r"([-+]?\d{1,15})")
    match = re.fullmatch(form, text, re.ASCII | re.I)
    if match is None:
        form_text = re.sub(
            r"\\(.)", r"\1", pattern.replace(r"\s*", " ").replace(r"\s+", " ")
        )
        raise InputError(
            where,
            f"'{text[:60]}' is not of the form {form_text}",
            "N is a number, I an integer: export the table again",
        )
    values = [float(group) for group in match.groups()]
    if not all(abs(value) < 1e15 for value in values):
        raise InputError(where, "a number is too large", "export the table again")
    return values


def filled(
    entries: dict[tuple[int, int], float], shape: Sequence[int], where: str
) -> np.ndarray:
    """Return entries as an array; InputError if one is missing or outside."""
    if len(entries) != shape[0] * shape[1] or not all(
        i < shape[0] and j < shape[1] for i, j in entries
    ):
        raise InputError(
            where,
            f"{len(entries)} entries, not those of {shape[0]} x {shape[1]} nodes",
            "export the table again",
        )
    out = np.empty(tuple(shape))
    for place, value in entries.items():
        out[place] = value
    return out
