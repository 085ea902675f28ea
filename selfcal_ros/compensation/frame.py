# SPDX-License-Identifier: Apache-2.0
"""The controller's axes in the stage frame."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER, M_PER_INCH

UNITS_M = {name: M_PER[name] for name in ("m", "mm", "um")}
"""Primary units of linear axes; the primary unit of a rotary axis is the degree."""
LENGTHS_M = {**UNITS_M, "in": M_PER_INCH}
"""Units of lengths of all controllers."""
MARK = "machine: "
"""Begins the comment of a calibration file that states its frame."""
_AXES = ("x_axis", "y_axis", "unit")


@dataclass(frozen=True)
class MachineFrame:
    """The controller's axes: their indices, unit, home positions and encoder directions.

    Attributes
    ----------
    x_axis, y_axis, theta_axis : int or None
        One-based indices.
    unit : str
        Primary unit of x and y: m, mm, um or in.
    home_x_m, home_y_m, home_theta_rad : float
        Position of the controller's zero in the stage frame.
    reverse_x, reverse_y, reverse_theta : bool
        Whether the encoder counts opposite to the stage frame.
    theta_counts_per_unit : float or None
        Encoder counts per degree.
    """

    x_axis: int = 1
    y_axis: int = 2
    theta_axis: int | None = None
    unit: str = "mm"
    home_x_m: float = 0.0
    home_y_m: float = 0.0
    home_theta_rad: float = 0.0
    reverse_x: bool = False
    reverse_y: bool = False
    reverse_theta: bool = False
    theta_counts_per_unit: float | None = None

    def __post_init__(self) -> None:
        """Refuse an unknown unit, axes that are not distinct, and values that are not numbers."""
        if self.unit not in LENGTHS_M:
            raise InputError(
                "unit", f"'{self.unit}' is not a primary unit", "use m, mm, um or in"
            )
        axes = [a for a in (self.x_axis, self.y_axis, self.theta_axis) if a is not None]
        if len(set(axes)) < len(axes):
            raise InputError(
                "axes",
                f"the indices {axes} are not distinct",
                "give each axis its own index",
            )
        for value in (self.home_x_m, self.home_y_m, self.home_theta_rad):
            if not math.isfinite(value):
                raise InputError(
                    "home position", f"{value} is not a position", "give a number"
                )
        if (
            self.theta_counts_per_unit is not None
            and not 0 < self.theta_counts_per_unit < math.inf
        ):
            raise InputError(
                "counts per degree",
                f"{self.theta_counts_per_unit} is not a positive number",
                "give the encoder counts in a degree of theta",
            )

    @property
    def unit_m(self) -> float:
        """Metres in a primary unit of x and y."""
        return LENGTHS_M[self.unit]

    @property
    def sign_x(self) -> float:
        """+1 or -1: encoder direction of x in the stage frame."""
        return -1.0 if self.reverse_x else 1.0

    @property
    def sign_y(self) -> float:
        """+1 or -1: encoder direction of y in the stage frame."""
        return -1.0 if self.reverse_y else 1.0

    @property
    def sign_theta(self) -> float:
        """+1 or -1: encoder direction of theta in the stage frame."""
        return -1.0 if self.reverse_theta else 1.0

    def to_machine(
        self, x_m: ArrayLike, y_m: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return controller positions, primary units, of stage positions in m."""
        return (
            self.sign_x * (np.asarray(x_m) - self.home_x_m) / self.unit_m,
            self.sign_y * (np.asarray(y_m) - self.home_y_m) / self.unit_m,
        )

    def from_machine(
        self, px: ArrayLike, py: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return stage positions in m of controller positions in primary units."""
        return (
            self.sign_x * np.asarray(px) * self.unit_m + self.home_x_m,
            self.sign_y * np.asarray(py) * self.unit_m + self.home_y_m,
        )

    def theta_to_machine(self, theta_rad: ArrayLike) -> np.ndarray:
        """Return controller positions, deg, of stage angles in rad."""
        return self.sign_theta * np.rad2deg(np.asarray(theta_rad) - self.home_theta_rad)

    def theta_from_machine(self, position_deg: ArrayLike) -> np.ndarray:
        """Return stage angles in rad of controller positions in deg."""
        return self.sign_theta * np.deg2rad(position_deg) + self.home_theta_rad

    def same_axes(self, other: "MachineFrame") -> bool:
        """Return whether x and y have the same indices, unit and directions in another frame."""
        return all(
            getattr(self, name) == getattr(other, name)
            for name in (*_AXES, "reverse_x", "reverse_y")
        )

    def comment(self, *, axes_alone: bool = False) -> str:
        """Return the frame as a comment of a calibration file.

        With `axes_alone` it states axes and unit: what was measured at positions of the controller
        tells no home position and no direction.
        """
        words = [
            f"x-axis={self.x_axis}",
            f"y-axis={self.y_axis}",
            f"unit={self.unit}",
        ]
        if axes_alone:
            return MARK + " ".join(words)
        words += [
            f"home-x={self.home_x_m / self.unit_m:.15g}",
            f"home-y={self.home_y_m / self.unit_m:.15g}",
        ]
        words += [
            f"reverse-{name}"
            for name in ("x", "y", "theta")
            if getattr(self, f"reverse_{name}")
        ]
        if self.theta_axis is not None:
            words += [
                f"theta-axis={self.theta_axis}",
                f"home-theta={math.degrees(self.home_theta_rad):.15g}",
            ]
        if self.theta_counts_per_unit is not None:
            words.append(f"theta-counts-per-unit={self.theta_counts_per_unit:.17g}")
        return MARK + " ".join(words)


def frame_from_comments(
    comments: Sequence[str], unstated: MachineFrame | None = None
) -> MachineFrame | None:
    """Return the frame that `MachineFrame.comment` wrote into a file, or several, or None.

    Home positions and directions are those of `unstated` if axes and unit alone are stated.

    Raises
    ------
    InputError
        If they state different frames; one may be without theta, or of axes and unit alone.
    """
    stated = [
        (frame, "home-x=" in line)
        for line in comments
        if line.startswith(MARK) and (frame := _stated(line))
    ]
    if not stated:
        return None
    full_frame, placed = max(
        stated, key=lambda pair: (pair[1], pair[0].theta_axis is not None)
    )
    for frame, whole in stated:
        same = (
            frame in (full_frame, _plane(full_frame))
            if whole
            else _axes(frame) == _axes(full_frame)
        )
        if not same:
            raise InputError(
                "comments",
                f"the tables are for different axes, '{frame.comment(axes_alone=not whole)}' and "
                f"'{full_frame.comment(axes_alone=not placed)}'",
                "write them with the same options",
            )
    if unstated is None or placed:
        return full_frame
    return replace(_plane(unstated), **_axes(full_frame))


def _axes(frame: MachineFrame) -> dict[str, Any]:
    return {name: getattr(frame, name) for name in _AXES}


def _plane(frame: MachineFrame) -> MachineFrame:
    """Return a frame without its theta axis."""
    return replace(
        frame,
        theta_axis=None,
        home_theta_rad=0.0,
        reverse_theta=False,
        theta_counts_per_unit=None,
    )


def _stated(line: str) -> MachineFrame | None:
    words = dict(re.findall(r"([a-z-]+)(?:=(\S+))?", line[len(MARK) :]))
    try:
        unit_m = LENGTHS_M[words.get("unit", "mm")]
        theta = words.get("theta-axis")
        counts = words.get("theta-counts-per-unit")
        return MachineFrame(
            int(words["x-axis"]),
            int(words["y-axis"]),
            int(theta) if theta else None,
            unit=words.get("unit", "mm"),
            home_x_m=float(words.get("home-x", 0)) * unit_m,
            home_y_m=float(words.get("home-y", 0)) * unit_m,
            home_theta_rad=math.radians(float(words.get("home-theta", 0))),
            reverse_x="reverse-x" in words,
            reverse_y="reverse-y" in words,
            reverse_theta="reverse-theta" in words,
            theta_counts_per_unit=float(counts) if counts else None,
        )
    except (KeyError, ValueError):
        return None
