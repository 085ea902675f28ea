# SPDX-License-Identifier: Apache-2.0
"""The marks of a plate that is not a lattice."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isfinite
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError

MARKS_RANGE = (4, 10_000)
"""Smallest and largest number of marks of a list."""
MOST_M = 2.0
"""Largest coordinate of a mark in a list."""
FARTHEST_CENTRE = 0.25
"""Largest distance of the middle of the marks of a list from the plate's centre, in half widths."""
THINNEST = 1e-3
"""Width over length below which the marks of a list lie on one line."""
LEAST_DISTANCE_M = 1e-7
"""Distance of two marks of a list below which they are one."""


@dataclass(frozen=True)
class MarkList:
    """Marks of a plate that is not a lattice, in the order of their ids.

    Attributes
    ----------
    ids : tuple of int
        Id of each mark: the m of its detections, whose n is 0.
    x_m, y_m : tuple of float
        Nominal places in the plate's frame, m.
    """

    ids: tuple[int, ...]
    x_m: tuple[float, ...]
    y_m: tuple[float, ...]

    def __hash__(self) -> int:
        """Return the hash of the marks: computed once."""
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.ids, self.x_m, self.y_m))

    @cached_property
    def places_m(self) -> np.ndarray:
        """Nominal places, (2, n), m."""
        return np.array([self.x_m, self.y_m])

    @cached_property
    def id_array(self) -> np.ndarray:
        """Ids in their order, int (n,)."""
        return np.array(self.ids)

    @cached_property
    def spacing_m(self) -> float:
        """Median distance of a mark from its nearest neighbour, m."""
        return float(np.median(self.neighbours[0]))

    @cached_property
    def neighbours(self) -> tuple[np.ndarray, np.ndarray]:
        """Distance of each mark from its nearest neighbour, m, and the neighbour's index, (n,)."""
        away, near = self.tree.query(self.places_m.T, 2)
        itself = near[:, 1] == np.arange(len(near))  # of two at one place
        return away[:, 1], np.where(itself, near[:, 0], near[:, 1])

    def innermost(self, number: int) -> "MarkList":
        """Return the marks nearest to the plate's centre."""
        near = sorted(
            np.argsort(np.hypot(*self.places_m), kind="stable")[:number].tolist()
        )
        return MarkList(
            tuple(self.ids[i] for i in near),
            tuple(self.x_m[i] for i in near),
            tuple(self.y_m[i] for i in near),
        )

    @cached_property
    def tree(self) -> Any:
        """The places as a tree (scipy.spatial.cKDTree)."""
        from scipy.spatial import cKDTree  # for lists of marks only

        return cKDTree(self.places_m.T)


def marks_of(
    ids: Sequence[int],
    x_m: Sequence[float],
    y_m: Sequence[float],
    where: Sequence[str] = (),
) -> MarkList:
    """Return a list of marks, checked.

    Parameters
    ----------
    ids, x_m, y_m
        Of each mark, in any order; m.
    where : sequence of str
        Where each of them is stated, for messages; default: its number in the list.

    Raises
    ------
    InputError
        For too few or too many marks, places that are not finite, equal, on one line, off centre or
        in another unit, and ids that are equal or no int32.
    """
    if not len(ids) == len(x_m) == len(y_m):
        raise InputError(
            "artifact marks",
            f"{len(ids)} ids, {len(x_m)} x and {len(y_m)} y",
            "give each mark an id, x and y",
        )
    where = where or [f"artifact marks[{i}]" for i in range(len(ids))]
    where_of_list = (
        where[0].rpartition(":")[0] if where and ":" in where[0] else "artifact marks"
    )
    if not MARKS_RANGE[0] <= len(ids) <= MARKS_RANGE[1]:
        raise InputError(
            where_of_list,
            f"{len(ids)} marks, not {MARKS_RANGE[0]} to {MARKS_RANGE[1]}",
            "list the marks of the plate, one a line",
        )
    where_of_id: dict[int, str] = {}
    for number, x, y, place in zip(ids, x_m, y_m, where, strict=True):
        _check_mark(number, x, y, place)
        if number in where_of_id:
            raise InputError(
                place,
                f"the id {number} is used already in {where_of_id[number]}",
                "give every mark its own id",
            )
        where_of_id[number] = place
    order = np.argsort(ids)
    marks = MarkList(
        tuple(int(ids[i]) for i in order),
        tuple(float(x_m[i]) for i in order),
        tuple(float(y_m[i]) for i in order),
    )
    _check_places(marks, where_of_list, where_of_id)
    return marks


def _check_mark(number: int, x: float, y: float, where: str) -> None:
    if not -(2**31) <= number < 2**31:
        raise InputError(
            where, f"id {number} is not a 32 bit integer", "number the marks anew"
        )
    if not (isfinite(x) and isfinite(y)):
        raise InputError(
            where,
            f"mark {number} has no place ({x:g}, {y:g})",
            "give x and y in m, or delete the mark",
        )
    if max(abs(x), abs(y)) > MOST_M:
        raise InputError(
            where,
            f"({x:g}, {y:g}) m of mark {number} is beyond every plate ({MOST_M:g} m)",
            "is it in mm? give x and y in m",
        )


def _check_places(
    marks: MarkList, where_of_list: str, where_of_id: dict[int, str]
) -> None:
    """Raise InputError for marks at one place, on one line, or off the plate's centre."""
    nearest = int(marks.neighbours[0].argmin())
    if marks.neighbours[0][nearest] < LEAST_DISTANCE_M:
        first, second = sorted((nearest, int(marks.neighbours[1][nearest])))
        raise InputError(
            where_of_id[marks.ids[second]],
            f"marks {marks.ids[first]} and {marks.ids[second]} lie at one place",
            "delete one of them",
        )
    length, width = np.linalg.svd(
        marks.places_m - marks.places_m.mean(axis=1)[:, None]
    )[1]
    if width < THINNEST * length:
        raise InputError(
            where_of_list,
            "all marks lie on one line",
            "use a plate with marks in two directions",
        )
    low, high = marks.places_m.min(axis=1), marks.places_m.max(axis=1)
    middle = (low + high) / 2
    if (np.abs(middle) > FARTHEST_CENTRE * (high - low) / 2).any():
        raise InputError(
            where_of_list,
            f"the marks lie about ({middle[0]:g}, {middle[1]:g}) m, not about the plate's centre",
            "count x and y from the centre of the plate: subtract this place from all",
        )
