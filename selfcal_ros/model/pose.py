# SPDX-License-Identifier: Apache-2.0
"""Poses of the plate on the stage."""

import cmath
import math
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import checked_fields
from selfcal_ros.model.artifact import Artifact

LATTICE_TOLERANCE = 1e-3
"""Largest distance of a commanded pose from the lattice, in pitches or lines."""
OFF = "lattice, or give the map nodes of its own (map in PLAN.yaml, map_grid_size in a command)"
"""End of the remedy for poses off the lattice."""
EDGE = 1e-9
"""Distance beyond the edge of the field that is rounding, in pitches."""


class StagePose(ABC):
    """A pose of the plate in pitches: of a site (x, y) on the stage, of a place on the plate.

    Attributes
    ----------
    shift : tuple
        Position of the plate's centre along stage x and y, pitches.
    turn_lines : float or None
        s, 0 to K, the total turn in angular lines: an int unless the map is a Fourier series. None
        if it is not a whole number of them.
    """

    shift: tuple[float, float]
    turn_lines: float | None

    @property
    def has_sites(self) -> bool:
        """Whether grid marks lie on sites of the map, or anywhere between nodes of its own."""
        return True

    @property
    @abstractmethod
    def turn_deg(self) -> float:
        """Turn of the plate, counter-clockwise, 0 to 360°."""

    @abstractmethod
    def turned(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the plate frame in the stage frame."""

    @abstractmethod
    def turned_back(
        self, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the stage frame in the plate frame."""

    @abstractmethod
    def beyond_field(self, site: np.ndarray, artifact: Artifact) -> np.ndarray:
        """Return which sites (2, ...) lie beyond the field of the stage, bool (...)."""

    @abstractmethod
    def mark_rows(self, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
        """Return the first n in the field for each m, and the number of marks, int arrays (nx,)."""

    @property
    def s(self) -> float:
        """Turn in angular lines of a plate that has lines.

        Raises
        ------
        ValueError
            If the plate has none.
        """
        if self.turn_lines is None:
            raise ValueError(
                "the turn is counted in lines only on a plate with angular lines"
            )
        return self.turn_lines

    def site_of(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the site (x, y) of a place (u, v) on the plate, pitches: R (u, v) + shift.

        Raises
        ------
        ValueError
            On the lattice, if the turn is not a whole quarter.
        """
        x, y = self.turned(u, v)
        return x + self.shift[0], y + self.shift[1]

    def marks_in_field(self, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
        """Return the marks inside the field of the stage and their sites, arrays (2, V)."""
        marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
        sites = np.stack(self.site_of(*artifact.places(*marks)))
        inside = ~self.beyond_field(sites, artifact)
        return marks[:, inside], sites[:, inside]

    def n_in_field(self, artifact: Artifact) -> int:
        """Return the number of marks inside the field of the stage."""
        return int(self.mark_rows(artifact)[1].sum())


@dataclass(frozen=True)
class LatticePose(StagePose):
    """A plate pose in whole steps of the lattice.

    Attributes
    ----------
    quarter_turns : int or None
        q in 0..3, counter-clockwise; None if the turn is not a whole quarter.
    shift : tuple of int
        (a, b), translation along stage x and y in pitches. Odd multiples of 1/2 for a quarter turn
        of a plate with an odd and an even number of marks along its sides.
    turn_lines : int or None
        s in 0..K-1, the total turn in angular lines; None on a plate without lines.
    """

    quarter_turns: int | None
    shift: tuple[float, float]
    turn_lines: float | None

    @property
    def has_sites(self) -> bool:
        """Whether the turn is a whole quarter."""
        return self.quarter_turns is not None

    @property
    def q(self) -> int:
        """Quarter turns of a pose in which grid marks are on sites.

        Raises
        ------
        ValueError
            If the turn is not a whole quarter.
        """
        if self.quarter_turns is None:
            raise ValueError(
                "a grid mark lies on a site only after whole quarter turns"
            )
        return self.quarter_turns

    @property
    def turn_deg(self) -> int:
        """Turn of the plate, counter-clockwise: 0, 90, 180 or 270°."""
        return 90 * self.q

    @property
    def phase(self) -> complex:
        """i^q: the factor from the plate frame to the stage frame, exact."""
        return (1, 1j, -1, -1j)[self.q]

    @property
    def a(self) -> float:
        """Shift along stage x, pitches."""
        return self.shift[0]

    @property
    def b(self) -> float:
        """Shift along stage y, pitches."""
        return self.shift[1]

    def turned(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the plate frame in the stage frame: R^q (u, v)."""
        return ((u, v), (-v, u), (-u, -v), (v, -u))[self.q]

    def turned_back(
        self, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the stage frame in the plate frame: R^-q (x, y)."""
        return ((x, y), (y, -x), (-x, -y), (-y, x))[self.q]

    def beyond_field(self, site: np.ndarray, artifact: Artifact) -> np.ndarray:
        """Return which sites (2, ...) lie beyond the plate's lattice on the stage, bool (...)."""
        x, y = np.abs(site)
        hx, hy = artifact.half
        return (x > hx) | (y > hy)

    def mark_rows(self, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
        """Return the first n in the field for each m, and the number of marks, int arrays (nx,)."""
        hx, hy = artifact.half
        x, y = (-hx - self.a, hx - self.a), (-hy - self.b, hy - self.b)  # of R^q (u, v)
        minus_x, minus_y = (-x[1], -x[0]), (-y[1], -y[0])
        u, v = ((x, y), (y, minus_x), (minus_x, minus_y), (minus_y, x))[self.q]
        first = max(v[0], -hy)
        row = np.arange(artifact.shape[0]) - hx
        count = int(max(min(v[1], hy) - first + 1, 0))
        n = int(first - artifact.off_centre[1])
        return np.full(len(row), n), np.where((row >= u[0]) & (row <= u[1]), count, 0)


@dataclass(frozen=True)
class PlacedPose(StagePose):
    """A plate pose anywhere on the stage, for a map with nodes of its own.

    Attributes
    ----------
    phase : complex
        exp(i turn), exact for quarter turns.
    shift, turn_lines
        As in `StagePose`.
    """

    phase: complex
    shift: tuple[float, float]
    turn_lines: float | None

    @property
    def turn_deg(self) -> float:
        """Turn of the plate, counter-clockwise, 0 to 360°."""
        return round(math.degrees(cmath.phase(self.phase)), 6) % 360

    def turned(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the plate frame in the stage frame."""
        cosine, sine = self.phase.real, self.phase.imag
        return cosine * u - sine * v, sine * u + cosine * v

    def turned_back(
        self, x: np.ndarray, y: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return a vector of the stage frame in the plate frame."""
        cosine, sine = self.phase.real, self.phase.imag
        return cosine * x + sine * y, cosine * y - sine * x

    def beyond_field(self, site: np.ndarray, artifact: Artifact) -> np.ndarray:
        """Return which sites (2, ...) lie beyond the nodes of the map, bool (...)."""
        reach_x, reach_y = (
            half / artifact.grid_pitch_m + EDGE for half in artifact.field_half_m
        )
        x, y = np.abs(site)
        return (x > reach_x) | (y > reach_y)

    def mark_rows(self, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
        """Return the first n in the field for each m, and the number of marks, int arrays (nx,).

        The field is convex: the marks of a row in it follow each other.
        """
        return _placed_rows(self, artifact)


AnyPose = LatticePose | PlacedPose


@lru_cache(64)
def _placed_rows(pose: PlacedPose, artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
    sites = np.stack(pose.site_of(*artifact.places(artifact.m, artifact.n)))
    inside = ~pose.beyond_field(sites, artifact)
    return inside.argmax(axis=1) + artifact.n[0, 0], inside.sum(axis=1)


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

    @property
    def quarters(self) -> int:
        """Nearest whole number of quarter turns."""
        return round(self.turn_rad / (math.pi / 2))

    @property
    def rows(self) -> complex:
        """Direction of the rows of marks that is nearest to stage x, as a factor of length 1."""
        return self.phase * (1, -1j, -1, 1j)[self.quarters % 4]

    def places(self, artifact: Artifact, m: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return the nominal places of marks on the stage, x + iy, complex, m."""
        x, y = artifact.places(m, n)
        return self.phase * (x + 1j * y) * artifact.grid_pitch_m + complex(
            *self.shift_m
        )

    def in_field(self, artifact: Artifact) -> np.ndarray:
        """Return the marks of the plate that lie in the stage's field, bool (nx, ny)."""
        places = self.places(artifact, artifact.m, artifact.n)
        hx, hy = artifact.field_half_m
        rounding = EDGE * artifact.grid_pitch_m
        return (np.abs(places.real) <= hx + rounding) & (
            np.abs(places.imag) <= hy + rounding
        )


MOST_CELLS = 15
"""Largest number of cells of an image along one side."""


@dataclass(frozen=True)
class ImageCells:
    """Marks that an exposure shows: one in each cell around the optical axis.

    Attributes
    ----------
    nx, ny : int
        Cells along x and y, odd.
    pitch_m : float
        Distance between them, m; a whole number of the plate's pitches.

    Raises
    ------
    InputError
        For an even or excessive number, or no length.
    """

    nx: int
    ny: int
    pitch_m: float

    def __post_init__(self) -> None:
        """Refuse impossible images."""
        for name, size in (("nx", self.nx), ("ny", self.ny)):
            if not 1 <= size <= MOST_CELLS or size % 2 == 0:
                raise InputError(
                    f"image {name}",
                    f"{size} is not an odd number from 1 to {MOST_CELLS}",
                    "count the mark on the optical axis and as many on either side of it",
                )
        if not (math.isfinite(self.pitch_m) and self.pitch_m > 0):
            raise InputError(
                "image pitch_m",
                f"{self.pitch_m} m is not a length",
                "give the distance between marks in metres",
            )

    @property
    def cells(self) -> list[tuple[int, int]]:
        """The cells (x, y) in their order; the one of the optical axis is (0, 0)."""
        hx, hy = self.nx // 2, self.ny // 2
        return [(x, y) for x in range(-hx, hx + 1) for y in range(-hy, hy + 1)]

    def step_on_plate(
        self, cell: tuple[int, int], pose: Pose, artifact: Artifact
    ) -> tuple[int, int]:
        """Return the steps (m, n) on a plate from the mark on the axis to that of a cell."""
        step = (
            (1, -1j, -1, 1j)[pose.quarters % 4] * complex(*cell) * self.steps(artifact)
        )
        return round(step.real), round(step.imag)

    def steps(self, artifact: Artifact) -> int:
        """Return the distance between cells in pitches of the plate; InputError if not whole."""
        if artifact.marks is not None:
            raise InputError(
                "image",
                "images show the cells of a lattice, the plate is a list of marks",
                "leave image out: one mark in an exposure",
            )
        return whole_steps(
            self.pitch_m / artifact.grid_pitch_m,
            "image pitch_m",
            "pitch",
            "let cells be whole pitches of the plate apart",
        )


def cell_label(cell: tuple[int, int]) -> str:
    """Return what the name of a sub-view has behind that of its view."""
    return f"[{cell[0]:+d},{cell[1]:+d}]"


def without_cell(name: str) -> str:
    """Return the name of the view in the plan from that of a view or sub-view."""
    return re.sub(r"\[[+-]\d+,[+-]\d+\]$", "", name)


def nearest_step(value: float) -> int | None:
    """Return the whole number that a value is meant to be; None if it is not near one."""
    near = math.isfinite(value) and abs(value - round(value)) <= LATTICE_TOLERANCE
    return round(value) if near else None


def whole_steps(value: float, where: str, unit: str, remedy: str) -> int:
    """Return the whole number that a value is meant to be; InputError if it is not near one."""
    steps = nearest_step(value)
    if steps is None:
        raise InputError(
            where, f"{value:.6g} is not a whole number of {unit} steps", remedy
        )
    return steps


def turn_in_lines(turn_rad: float, artifact: Artifact) -> float | None:
    """Return a turn in angular lines, 0 to K: whole unless the map is a Fourier series.

    None if it is not whole, or not finite, or the plate has no lines.
    """
    lines = turn_rad * artifact.angular_count / (2 * math.pi)
    count = artifact.angular_count
    if not count:
        return None
    step = nearest_step(lines)
    if not artifact.harmonics:
        return None if step is None else step % count
    if step is not None and abs(lines - step) < 1e-9:
        return step % count
    return lines % count if math.isfinite(lines) else None


def image_of(data: dict, artifact: Artifact, where: str) -> ImageCells | None:
    """Return the marks that an exposure shows; None if the plan says nothing, or one."""
    if not data:
        return None
    raw = checked_fields(data, where, {"nx": int, "ny": int}, {"pitch_m": (float, 0.0)})
    image = ImageCells(raw["nx"], raw["ny"], raw["pitch_m"] or artifact.grid_pitch_m)
    image.steps(artifact)
    return image if len(image.cells) > 1 else None
