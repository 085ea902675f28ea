# SPDX-License-Identifier: Apache-2.0
"""Poses of the plate on the stage."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.model.artifact import Artifact

EDGE = 1e-9
"""Distance beyond the edge of the field that is rounding, in pitches."""


@dataclass(frozen=True)
class LatticePose:
    """A plate pose in whole steps of the lattice.

    Attributes
    ----------
    quarter_turns : int or None
        q in 0..3, counter-clockwise; None if the turn is not a whole quarter.
    shift : tuple of int
        (a, b), translation along stage x and y in pitches.
    turn_lines : int or None
        s in 0..K-1, the total turn in angular lines; None on a plate without lines.
    """

    quarter_turns: int | None
    shift: tuple[int, int]
    turn_lines: int | None

    @property
    def q(self) -> int:
        """Quarter turns of a pose in which grid marks are on sites.

        Raises
        ------
        ValueError
            If the turn is not a whole quarter.
        """
        if self.quarter_turns is None:
            raise ValueError("a grid mark lies on a site only after whole quarter turns")
        return self.quarter_turns

    @property
    def phase(self) -> complex:
        """i^q: the factor from the plate frame to the stage frame, exact."""
        return (1, 1j, -1, -1j)[self.q]

    @property
    def a(self) -> int:
        """Shift along stage x, pitches."""
        return self.shift[0]

    @property
    def b(self) -> int:
        """Shift along stage y, pitches."""
        return self.shift[1]

    @property
    def s(self) -> int:
        """Turn in angular lines of a plate that has lines.

        Raises
        ------
        ValueError
            If the plate has none.
        """
        if self.turn_lines is None:
            raise ValueError("the turn is counted in lines only on a plate with angular lines")
        return self.turn_lines

    def site_of(self, m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the site (i, j) of mark (m, n): R^q (m, n) + (a, b).

        Raises
        ------
        ValueError
            If the turn is not a whole quarter.
        """
        x, y = ((m, n), (-n, m), (-m, -n), (n, -m))[self.q]
        return x + self.a, y + self.b

    def marks_in_field(self, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
        """Return the marks inside the field of the stage and their sites, int arrays (2, V)."""
        marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
        sites = np.stack(self.site_of(*marks))
        inside = (np.abs(sites) <= np.array(artifact.half)[:, None]).all(axis=0)
        return marks[:, inside], sites[:, inside]

    def n_in_field(self, artifact: Artifact) -> int:
        """Return the number of marks inside the field of the stage."""
        plate = artifact.half[::-1] if self.q % 2 else artifact.half
        return math.prod(max(0, min(h, s + p) - max(-h, s - p) + 1) for h, s, p in zip(
            artifact.half, self.shift, plate, strict=True))


@dataclass(frozen=True)
class Pose:
    """A plate pose anywhere on the stage.

    Attributes
    ----------
    turn_rad : float
        Counter-clockwise, rad.
    shift_m : tuple of float
        Position of the plate's centre along stage x and y, m.
    """

    turn_rad: float
    shift_m: tuple[float, float]

    @cached_property
    def phase(self) -> complex:
        """exp(i turn), exact for quarter turns."""
        quarters = self.turn_rad / (math.pi / 2)
        if abs(quarters - round(quarters)) < 1e-12:
            return (1, 1j, -1, -1j)[round(quarters) % 4]
        return complex(math.cos(self.turn_rad), math.sin(self.turn_rad))

    def places(self, artifact: Artifact, m: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return the nominal places of marks on the stage, x + iy, complex, m."""
        return self.phase * (m + 1j * n) * artifact.grid_pitch_m + complex(*self.shift_m)

    def in_field(self, artifact: Artifact) -> np.ndarray:
        """Return the marks of the plate that lie in the stage's field, bool (nx, ny)."""
        places, (hx, hy) = self.places(artifact, artifact.m, artifact.n), artifact.field_half_m
        rounding = EDGE * artifact.grid_pitch_m
        return (np.abs(places.real) <= hx + rounding) & (np.abs(places.imag) <= hy + rounding)


@dataclass(frozen=True)
class PlacedPose:
    """The pose of a view, with the plate and the map's grid that it belongs to.

    Attributes
    ----------
    artifact : Artifact
        The plate, with `map_grid`.
    pose : Pose
        Where it lies.
    turn_lines : int or None
        Its turn in angular lines; None where it is not a whole number of them.
    """

    artifact: Artifact
    pose: Pose
    turn_lines: int | None

    @property
    def phase(self) -> complex:
        """exp(i turn): the factor from the plate frame to the stage frame."""
        return self.pose.phase

    @cached_property
    def places_m(self) -> np.ndarray:
        """Nominal places of the marks, complex (nx, ny), m."""
        return self.pose.places(self.artifact, self.artifact.m, self.artifact.n)


AnyPose = LatticePose | PlacedPose
