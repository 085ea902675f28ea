# SPDX-License-Identifier: Apache-2.0
"""The artifact plate: a grid of marks and a circle of angular lines."""

from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property
from math import ceil, sqrt

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.marks import MarkList
from selfcal_ros.units import MM_PER_M

MAX_GRID_SIZE = 401
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
        Number of nodes along x. The map is square unless `size_y` is given.
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

    The marks of a lattice lie evenly about its centre: along a side with an odd number of them mark
    m at m pitches, m from -(N-1)/2 to (N-1)/2; along one with an even number at m + 1/2 pitches, m
    from -N/2 to N/2 - 1. Unless `map_grid` is given, the map has its nodes on the plate's lattice.
    The marks of a list are arrays (n, 1): n rows of one mark, m the ids, n = 0.

    Attributes
    ----------
    grid_size : int
        N, number of marks along x. The plate is square unless `grid_size_y` is given.
    grid_pitch_m : float
        Distance between neighbouring marks, m.
    angular_count : int
        K, number of angular lines, at least 3; 0 for a plate without them. Lines are read in the
        views that are turned by a whole number of them: at 90° if K is a multiple of 4.
    grid_size_y : int
        Number of marks along y; 0 means `grid_size`.
    map_grid : MapGrid, optional
        Nodes of the error map, for views whose marks do not lie on the lattice.
    harmonics : int
        H, harmonics of the angular map, below K/2: a Fourier series, for views at any turn. 0 = one
        value for each line, for views turned by whole lines.
    marks : MarkList, optional
        The marks if they are not a lattice; `grid_size` is then their number and `grid_pitch_m` the
        median distance of neighbours, whatever is given.

    Raises
    ------
    InputError
        If a size or the pitch is out of range, K is 1, 2 or negative, or the lines do not determine
        H harmonics.
    """

    grid_size: int
    grid_pitch_m: float
    angular_count: int = 0
    grid_size_y: int = 0
    map_grid: MapGrid | None = None
    harmonics: int = 0
    marks: MarkList | None = None

    def __post_init__(self) -> None:
        """Refuse impossible sizes, pitches and counts."""
        if self.marks is not None:
            for name, value in (
                ("grid_size", len(self.marks.ids)),
                ("grid_size_y", 1),
                ("grid_pitch_m", self.marks.spacing_m),
            ):
                object.__setattr__(self, name, value)
        else:
            self._check_sides()
        self._check_pitch()
        self._check_lines()
        if self.map_grid is not None:
            try:
                Artifact(
                    self.map_grid.size, self.map_grid.pitch_m, 0, self.map_grid.size_y
                )
            except InputError as error:
                raise InputError(
                    error.where.replace("artifact", "map"),
                    error.what,
                    "give the number of nodes a side, their pitch in m",
                ) from error

    def _check_sides(self) -> None:
        for name, size in (
            ("grid_size", self.grid_size),
            ("grid_size_y", self.shape[1]),
        ):
            if size > MAX_GRID_SIZE:
                raise InputError(
                    f"artifact {name}",
                    f"{size} rows of marks are more than {MAX_GRID_SIZE}",
                    "use every other mark: half the rows, twice the pitch",
                )
            if size < 3:
                raise InputError(
                    f"artifact {name}",
                    f"{size} is not a number from 3 to {MAX_GRID_SIZE}",
                    "give the number of rows; marks in fewer rows "
                    "as a list (artifact: {marks: FILE.csv})",
                )

    def _check_pitch(self) -> None:
        if not (np.isfinite(self.grid_pitch_m) and self.grid_pitch_m > 0):
            raise InputError(
                "artifact grid_pitch",
                f"{self.grid_pitch_m} m is not a length",
                "give the distance between marks in metres",
            )
        if not PITCH_RANGE_M[0] <= self.grid_pitch_m <= PITCH_RANGE_M[1]:
            raise InputError(
                "artifact grid_pitch",
                f"{self.grid_pitch_m:g} m is not a pitch of a plate "
                f"({PITCH_RANGE_M[0]:g} to {PITCH_RANGE_M[1]:g} m)",
                f"is it in {'mm' if self.grid_pitch_m < MM_PER_M else 'µm'}? give the "
                "distance between marks in metres",
            )

    def _check_lines(self) -> None:
        if self.angular_count and not 3 <= self.angular_count <= MAX_ANGULAR_COUNT:
            raise InputError(
                "artifact angular_count",
                f"{self.angular_count} is not a number from 3 to {MAX_ANGULAR_COUNT}",
                "give 0 for a plate without lines",
            )
        most = min((self.angular_count - 1) // 2, MAX_HARMONICS)
        if self.harmonics and not 0 < self.harmonics <= most:
            raise InputError(
                "map harmonics",
                f"{self.harmonics} harmonics cannot be told with {self.angular_count} lines",
                f"give 1 to {most}"
                if most > 0
                else "leave them out for a plate without lines",
            )

    @cached_property
    def field(self) -> "Artifact":
        """Lattice of the error map: that of the plate unless `map_grid` is given."""
        grid = self.map_grid
        if grid is None and self.marks is not None:
            raise InputError(
                "artifact marks",
                "a list of marks without nodes of the map",
                "give map_grid_size and map_grid_pitch with it",
            )
        return (
            self
            if grid is None
            else Artifact(
                grid.size,
                grid.pitch_m,
                self.angular_count,
                grid.size_y,
                harmonics=self.harmonics,
            )
        )

    @property
    def placed(self) -> "Artifact | None":
        """The plate itself if the map has nodes of its own, off the marks; else None."""
        return None if self.map_grid is None else self

    @property
    def lattice(self) -> "Artifact":
        """The lattice of the marks; of a list that of the error map."""
        return self if self.marks is None else self.field

    @property
    def field_half_m(self) -> tuple[float, float]:
        """Largest x and y of the stage's field, m."""
        return self.field.half[0] * self.field.grid_pitch_m, (
            self.field.half[1] * self.field.grid_pitch_m
        )

    @property
    def is_stepped(self) -> bool:
        """Whether the map is wider than the plate, by more than one of its own nodes."""
        return self.map_grid is not None and any(
            field_m > reach * self.grid_pitch_m + self.map_grid.pitch_m
            for field_m, reach in zip(self.field_half_m, self.reach, strict=True)
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Number of marks along x and y."""
        return self.grid_size, self.grid_size_y or self.grid_size

    @property
    def half(self) -> tuple[float, float]:
        """Largest x and y of a lattice, pitches: h = (N-1)/2, whole numbers on odd sides.

        Raises
        ------
        ValueError
            For a list of marks, which has no rows.
        """
        if self.marks is not None:
            raise ValueError("a list of marks has no rows")
        hx, hy = (size // 2 if size % 2 else (size - 1) / 2 for size in self.shape)
        return hx, hy

    @property
    def limits(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Smallest and largest m, and n, of a lattice."""
        (nx, ny), (i, j) = self.shape, self.middle
        return (-i, nx - i - 1), (-j, ny - j - 1)

    @property
    def middle(self) -> tuple[int, int]:
        """Index in arrays (nx, ny) of the mark m = n = 0 of a lattice."""
        return self.shape[0] // 2, self.shape[1] // 2

    @property
    def off_centre(self) -> tuple[float, float]:
        """Place of the mark m = n = 0 of a lattice along x and y, pitches: 1/2 on even sides."""
        return 0.5 * (self.shape[0] % 2 == 0), 0.5 * (self.shape[1] % 2 == 0)

    @property
    def quarter_shift(self) -> float:
        """Shift along x and y, pitches, of a plate that lies on its lattice after a quarter turn.

        Half a pitch, more or less by whole ones, if one side has an odd and the other an even
        number of marks: without it rows would lie between rows. Else 0.
        """
        nx, ny = self.shape
        return (
            0.5 if (nx - ny) % 2 and self.marks is None and self.map_grid is None else 0
        )

    @cached_property
    def reach(self) -> tuple[float, float]:
        """Largest x and y of a mark, in pitches."""
        if self.marks is None:
            return self.half
        x, y = np.abs(self.marks.places_m).max(axis=1) / self.grid_pitch_m
        return float(x), float(y)

    @property
    def half_width_m(self) -> float:
        """Longer half width of the plate, m."""
        return self.grid_pitch_m * max(self.reach)

    @cached_property
    def m(self) -> np.ndarray:
        """Index m of every site, int array (nx, ny)."""
        if self.marks is not None:
            return self.marks.id_array[:, None]
        return np.repeat(
            np.arange(self.shape[0])[:, None] - self.middle[0], self.shape[1], axis=1
        )

    @cached_property
    def n(self) -> np.ndarray:
        """Index n of every site, int array (nx, ny)."""
        if self.marks is not None:
            return np.zeros(self.shape, dtype=int)
        return np.repeat(
            np.arange(self.shape[1])[None, :] - self.middle[1], self.shape[0], axis=0
        )

    def has(self, m: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return which of the marks (m, n) are on the plate, bool."""
        if self.marks is not None:
            return np.isin(m, self.marks.id_array) & (np.asarray(n) == 0)
        (first_m, last_m), (first_n, last_n) = self.limits
        return (m >= first_m) & (m <= last_m) & (n >= first_n) & (n <= last_n)

    def index(self, m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of marks of the plate in arrays (nx, ny)."""
        if self.marks is not None:
            return np.searchsorted(self.marks.id_array, m), np.zeros_like(n)
        return m + self.middle[0], n + self.middle[1]

    def marks_at(self, i: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return m and n of the marks with these indices in arrays (nx, ny)."""
        if self.marks is not None:
            return self.marks.id_array[i], np.zeros_like(j)
        return i - self.middle[0], j - self.middle[1]

    def nearest(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return m and n, floats, of a lattice without an edge nearest to places in pitches."""
        off_m, off_n = self.off_centre
        return np.rint(x - off_m), np.rint(y - off_n)

    def flat(self, m: np.ndarray, n: np.ndarray) -> np.ndarray:
        """Return the indices of marks of the plate in flattened arrays."""
        i, j = self.index(m, n)
        return i * self.shape[1] + j

    def places(self, m: np.ndarray, n: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the nominal places of marks on the plate, in pitches: (m, n) between odd sides."""
        if self.marks is None:
            off_m, off_n = self.off_centre
            return m + off_m if off_m else m, n + off_n if off_n else n
        x, y = self.marks.places_m[:, self.index(m, n)[0]] / self.grid_pitch_m
        return x, y

    @property
    def x_m(self) -> np.ndarray:
        """Nominal x of every site in m, (nx, ny)."""
        if self.marks is not None:
            return self.marks.places_m[0][:, None]
        return self.places(self.m, self.n)[0] * self.grid_pitch_m

    @property
    def y_m(self) -> np.ndarray:
        """Nominal y of every site in m, (nx, ny)."""
        if self.marks is not None:
            return self.marks.places_m[1][:, None]
        return self.places(self.m, self.n)[1] * self.grid_pitch_m

    @property
    def theta_rad(self) -> np.ndarray:
        """Nominal angle of every line in rad, (K,), from 0 counter-clockwise."""
        return np.arange(self.angular_count) * (2 * np.pi / max(self.angular_count, 1))


def default_map_grid(artifact: Artifact) -> MapGrid:
    """Return the map's nodes for views off the lattice, where a plan does not give them.

    They span the field of the plate; along its longer side there is an odd number of nodes, at most
    three quarters of the marks, at least five if there are as many marks, at most `DEFAULT_NODES`.
    With as many nodes as marks the readings hardly determine the outermost ones. Of a list, as many
    marks count along a side as a lattice of the same number would have over the rectangle that it
    covers.

    Raises
    ------
    InputError
        If a list is too short to choose the nodes.
    """
    longer = max(artifact.reach)
    if artifact.marks is not None:
        along = sqrt(len(artifact.marks.ids) * longer / min(artifact.reach))
        cells = int(0.75 * along - 1 + 1e-9) // 2 * 2
        if cells < 2:
            raise InputError(
                "artifact marks",
                f"{len(artifact.marks.ids)} marks are too few to choose the nodes of the map",
                "give them in the plan, e.g. map: {grid_size: 3}, or use a plate with more marks",
            )
    else:
        cells = max(
            int(0.75 * (2 * longer + 1) - 1) // 2 * 2, min(4, int(2 * longer) // 2 * 2)
        )
    cells = min(cells, DEFAULT_NODES - 1)
    pitch_m = 2 * longer * artifact.grid_pitch_m / cells
    sides = [
        max(2 * ceil(cells * half / (2 * longer) - 1e-9) + 1, 3)
        for half in artifact.reach
    ]
    return MapGrid(
        sides[0],
        pitch_m,
        Interpolation.BICUBIC,
        sides[1] if sides[1] != sides[0] else 0,
    )
