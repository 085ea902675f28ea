# SPDX-License-Identifier: Apache-2.0
"""Where the stage stops: which cell of the image shows a mark then, and check stops.

A check stop is a reading of a mark with the stage deliberately off it. The position of the stage
relative to the site of a mark is deviation minus offset, in either sense. Check stops are
recognised by the position of the stage: about a check offset from its usual position at that mark,
along one axis.
"""

from functools import lru_cache

import numpy as np

from selfcal_ros.collection.marks.repeats import groups_of, pairs_of
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View

MOST_CELLS = 10_000
"""Cells to both sides of the axis beyond which offsets are not distinguished."""


def cells_of(view: View, offset_m: np.ndarray, shift: complex = 0j) -> np.ndarray:
    """Return the cell of the image that shows each mark, x + iy, complex of whole numbers (n,).

    Parameters
    ----------
    view : View
        The view; without an image there is one cell, 0.
    offset_m : float array (2, n)
        Measured offsets, stage axes, m.
    shift : complex
        Displacement of all marks in the image, cells.
    """
    if view.image is None:
        return np.zeros(offset_m.shape[1], dtype=complex)
    return _rounded(_steps(view, offset_m) - shift)


def places_of_cells(
    view: View, offset_m: np.ndarray, shift: complex = 0j
) -> np.ndarray:
    """Return the place of the cell that shows each mark, stage axes, (2, n), m."""
    if view.image is None:
        return np.zeros_like(offset_m)
    place = cells_of(view, offset_m, shift) * (view.pose.rows * view.image.pitch_m)
    return np.stack([place.real, place.imag])


def _steps(view: View, offset_m: np.ndarray) -> np.ndarray:
    """Return offsets (2, n) as x + iy in cells of the image."""
    pitch_m = view.image.pitch_m if view.image else 1.0
    return (offset_m[0] + 1j * offset_m[1]) / (view.pose.rows * pitch_m)


def _rounded(steps: np.ndarray) -> np.ndarray:
    return np.rint(steps.real) + 1j * np.rint(steps.imag) + 0.0


def shift_of(view: View, offset_m: np.ndarray, away_m: np.ndarray) -> complex:
    """Return the displacement of all marks in the image of a view, cells.

    The part of a cell is that of the offsets. Whole cells are those for which the marks fill the
    image; if they fill it at several places, those of the known marks.

    Parameters
    ----------
    view : View
        A view with images.
    offset_m : float array (2, n)
        Measured offsets, stage axes, m.
    away_m : float array (2, k)
        Measured offsets minus those expected with the stage at its site, of the known marks.
    """
    steps, known_steps = _steps(view, offset_m), _steps(view, away_m)
    fraction = complex(
        *(
            float(np.angle(np.exp(2j * np.pi * axis).mean())) / (2 * np.pi)
            for axis in (steps.real, steps.imag)
        )
    )
    cells = _rounded(steps - fraction)
    known_steps = known_steps - fraction
    nx, ny = (view.image.nx, view.image.ny) if view.image else (1, 1)
    return fraction + complex(
        middle_of(cells.real, nx, known_steps.real),
        middle_of(cells.imag, ny, known_steps.imag),
    )


def middle_of(
    numbers: np.ndarray,
    width: int,
    known_numbers: np.ndarray | None = None,
    *,
    visible: tuple[int, int] | None = None,
) -> int:
    """Return the middle of the `width` neighbouring whole numbers that hold most of `numbers`.

    Of several that hold as many, but for a quarter of a number's share, that of the median of the
    `known_numbers`, else 0. With the first and last `visible` number that which lacks the fewest
    visible ones.
    """
    low = int(max(numbers.min(), -MOST_CELLS)) - width
    count = np.bincount(np.clip(numbers - low, 0, 2 * MOST_CELLS).astype(int))
    window_count = np.convolve(
        np.append(count, np.zeros(width, int)), np.ones(width, int), mode="valid"
    )
    first = np.flatnonzero(
        window_count >= window_count.max() - len(numbers) / (4 * width)
    )
    best = first + low + width // 2
    if visible is not None:
        number = low + np.arange(len(count) + width)
        unseen = (number >= visible[0]) & (number <= visible[1])
        unseen[: len(count)] &= count == 0
        lacking = np.convolve(unseen, np.ones(width, int), mode="valid")[first]
        best = best[lacking == lacking.min()]
        return int(best[np.abs(best).argmin()])
    middle = (
        round(float(np.median(known_numbers)))
        if known_numbers is not None and len(known_numbers)
        else 0
    )
    return int(best[0]) if len(best) == 1 else middle if middle in best else 0


def numbers_of(view: View, cells: np.ndarray) -> np.ndarray:
    """Return the index of cells in `Image.cells`, int array (n,); -1 beyond the image."""
    if view.image is None:
        return np.zeros(len(cells), dtype=int)
    hx, hy = view.image.nx // 2, view.image.ny // 2
    x, y = np.clip([cells.real, cells.imag], -hx - hy - 1, hx + hy + 1).astype(int)
    in_image = (np.abs(x) <= hx) & (np.abs(y) <= hy)
    return np.where(in_image, (x + hx) * (2 * hy + 1) + y + hy, -1)


def middles(view: View, number: np.ndarray, away_m: np.ndarray) -> np.ndarray:
    """Return the median displacement in the cell of each mark, less that on the axis, m.

    Parameters
    ----------
    view : View
        A view with images.
    number : int array (n,)
        Cells, see `numbers_of`; beyond the image the displacement is 0.
    away_m : float array (2, n)
        Of marks from the places of their cells; without any on the axis all displacements are 0.
    """
    axis = numbers_of(view, np.zeros(1, dtype=complex))[0]
    out = np.zeros_like(away_m)
    cells = np.unique(number[number >= 0])
    for cell in cells if axis in cells else ():
        out[:, number == cell] = np.median(
            away_m[:, number == cell], axis=1, keepdims=True
        )
    return (
        out
        - np.where(
            number >= 0, np.median(away_m[:, number == axis], axis=1, keepdims=True), 0
        )
        if out.any()
        else out
    )


@lru_cache(64)
def marks_shown(artifact: Artifact, view: View) -> tuple[np.ndarray, ...]:
    """Return the marks that each cell shows if the stage stops at every mark in the field.

    Returns
    -------
    tuple of bool array (nx, ny)
        For the cells in their order.
    """
    marks, _ = view.on_stage(artifact).marks_in_field(artifact)
    stops = np.zeros(artifact.shape, dtype=bool)
    stops[artifact.index(*marks)] = True
    return tuple(beside(stops, artifact, sub) for sub in view.sub_views)


def beside(
    marks: np.ndarray, artifact: Artifact, sub_view: View, sign: int = 1
) -> np.ndarray:
    """Return the marks shown in a cell where the stage stops at `marks`, bool (nx, ny).

    With `sign` -1, the marks at which the stage stops where `marks` are shown in the cell.
    """
    out = np.zeros_like(marks)
    m, n = np.nonzero(marks)
    step_m, step_n = sub_view.step_on_plate(artifact)
    m, n = m + sign * step_m, n + sign * step_n
    on_plate = (m >= 0) & (m < marks.shape[0]) & (n >= 0) & (n < marks.shape[1])
    out[m[on_plate], n[on_plate]] = True
    return out


SCATTER = 1 / 12
"""Scatter of the ordinary stops, in check offsets, above which check stops are not recognised."""
QUARTILE = 0.4506241100243562
"""Lower quartile of the difference of two normal variables of standard deviation 1."""
LOOKED_AT = 2000
"""Largest number of marks per number of readings used for the scatter."""


def stage_aside(
    key: np.ndarray, place_m: np.ndarray, offset_m: float
) -> np.ndarray | None:
    """Return the distance of the stage from its usual position at the mark, for check stops.

    Parameters
    ----------
    key : int array (n,)
        Index of the mark of each reading.
    place_m : float array (2, n)
        Position of the stage, m, along x and y.
    offset_m : float
        Distance of check stops, m.

    Returns
    -------
    float array (2, n) or None
        Along the axis of the check stop, m; 0 along the other and for ordinary stops. None if
        ordinary stops scatter too much to be distinguished from check stops.
    """
    if _scatter(key, place_m) > SCATTER * offset_m:
        return None
    away = np.stack([row - _medians(key, row) for row in place_m])
    off = (np.abs(away) > offset_m / 2) & (np.abs(away) < 1.5 * offset_m)
    return np.where(off & ~off[::-1], away, 0.0)


def _scatter(key: np.ndarray, place_m: np.ndarray) -> float:
    """Return the standard deviation of the stops along the axis where it is smaller, m.

    Two of the four check stops coincide along each axis, so the lower quartile of the
    differences of readings of a mark, and the better axis, represent ordinary stops.
    """
    of_groups = [np.zeros((2, 0))]
    for group in groups_of(key):
        some = group[:: -(-len(group) // LOOKED_AT)]
        i, j = pairs_of(some.shape[1])
        of_groups.append(
            np.abs(place_m[:, some[:, i]] - place_m[:, some[:, j]]).reshape(2, -1)
        )
    differences_m = np.concatenate(of_groups, axis=1)
    return (
        float(np.quantile(differences_m, 0.25, axis=1).min()) / QUARTILE
        if differences_m.size
        else 0.0
    )


def _medians(key: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the (lower) median of the values of each key, for each element (n,)."""
    order = np.lexsort((values, key))
    _, first, inverse, count = np.unique(
        key[order], return_index=True, return_inverse=True, return_counts=True
    )
    out = np.empty(len(values))
    out[order] = values[order][first + (count - 1) // 2][inverse]
    return out


def without_aside(
    key: np.ndarray,
    deviation_m: np.ndarray,
    offset_m: np.ndarray,
    check_offset_m: float,
) -> tuple[np.ndarray, int]:
    """Return deviations minus the microscope's error from check stops, and its parameter count.

    A microscope with a wrong scale, turn or sign reads a mark differently from a check stop. This
    is neither an outlier nor noise: the part proportional to the stage position is removed, from
    the median over the check stops along each axis.

    Parameters
    ----------
    key : int array (n,)
        Number of the mark of each reading.
    deviation_m, offset_m : float array (2, n)
        Deviation, and measured offset, m.
    check_offset_m : float
        Distance of check stops, m; 0 = none.
    """
    aside = (
        stage_aside(key, deviation_m - offset_m, check_offset_m)
        if check_offset_m
        else None
    )
    if aside is None or not aside.any():
        return deviation_m, 0
    about = np.stack([row - _medians(key, row) for row in deviation_m])
    out = deviation_m.copy()
    fitted = 0
    for along in aside:
        at_check_stops = along != 0
        if at_check_stops.any():
            slope = np.median(about[:, at_check_stops] / along[at_check_stops], axis=1)
            out[:, at_check_stops] -= slope[:, None] * along[at_check_stops]
            fitted += 2
    return out, fitted


def count_stops(view: View, readings: ViewReadings) -> tuple[np.ndarray, int]:
    """Return the readings of each grid mark without check stops, (P,), and the number checked.

    A mark is checked if it was measured from all four sides; a stop on one side only counts
    as a repeat. If ordinary stops scatter like check stops, they show the microscope's error
    themselves: all requested marks count as checked.
    """
    visits = readings.visits
    if not view.check_marks or visits is None:
        return readings.count, 0
    aside = stage_aside(
        visits.mark,
        np.stack([visits.dx - visits.offset_x, visits.dy - visits.offset_y]),
        view.check_offset_m,
    )
    if aside is None:
        return readings.count, view.check_marks
    sides = [
        np.bincount(visits.mark, sign * row > 0, len(readings.m)) > 0
        for row in aside
        for sign in (1, -1)
    ]
    n_sides = np.sum(sides, axis=0)
    off = aside.any(axis=0) & (n_sides[visits.mark] > 1)
    extra = np.bincount(visits.mark, visits.count * off, len(readings.m)).astype(
        np.int64
    )
    return readings.count - extra, int((n_sides == 4).sum())
