# SPDX-License-Identifier: Apache-2.0
"""Cells of a camera's image: which one shows a mark, and which marks are expected in each."""

from functools import lru_cache

import numpy as np

from selfcal_ros.model.artifact import Artifact
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


def places_of_cells(view: View, offset_m: np.ndarray, shift: complex = 0j) -> np.ndarray:
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
    steps, known = _steps(view, offset_m), _steps(view, away_m)
    part = complex(*(float(np.angle(np.exp(2j * np.pi * axis).mean())) / (2 * np.pi)
                     for axis in (steps.real, steps.imag)))
    cells, known = _rounded(steps - part), known - part
    nx, ny = (view.image.nx, view.image.ny) if view.image else (1, 1)
    return part + complex(middle_of(cells.real, nx, known.real),
                          middle_of(cells.imag, ny, known.imag))


def middle_of(numbers: np.ndarray, width: int, known: np.ndarray | None = None) -> int:
    """Return the middle of the `width` neighbouring whole numbers that hold most of `numbers`.

    Of several that hold as many, but for a quarter of a number's share, that of the median of the
    `known` ones, else 0.
    """
    low = int(max(numbers.min(), -MOST_CELLS)) - width
    count = np.bincount(np.clip(numbers - low, 0, 2 * MOST_CELLS).astype(int), minlength=2 * width)
    held = np.convolve(np.append(count, np.zeros(width, int)), np.ones(width, int), mode="valid")
    best = np.arange(len(held))[held >= held.max() - len(numbers) / (4 * width)] + low + width // 2
    middle = round(float(np.median(known))) if known is not None and len(known) else 0
    return int(best[0]) if len(best) == 1 else middle if middle in best else 0


def numbers_of(view: View, cells: np.ndarray) -> np.ndarray:
    """Return the index of cells in `Image.cells`, int array (n,); -1 beyond the image."""
    if view.image is None:
        return np.zeros(len(cells), dtype=int)
    hx, hy = view.image.nx // 2, view.image.ny // 2
    x, y = np.clip([cells.real, cells.imag], -hx - hy - 1, hx + hy + 1).astype(int)
    shown = (np.abs(x) <= hx) & (np.abs(y) <= hy)
    return np.where(shown, (x + hx) * (2 * hy + 1) + y + hy, -1)


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
    stops[tuple(marks + np.array(artifact.half)[:, None])] = True
    return tuple(beside(stops, artifact, sub) for sub in view.sub_views)


def beside(marks: np.ndarray, artifact: Artifact, sub_view: View, sign: int = 1) -> np.ndarray:
    """Return the marks shown in a cell where the stage stops at `marks`, bool (nx, ny).

    With `sign` -1, the marks at which the stage stops where `marks` are shown in the cell.
    """
    out = np.zeros_like(marks)
    m, n = np.nonzero(marks)
    step_m, step_n = sub_view.step_on_plate(artifact)
    m, n = m + sign * step_m, n + sign * step_n
    there = (m >= 0) & (m < marks.shape[0]) & (n >= 0) & (n < marks.shape[1])
    out[m[there], n[there]] = True
    return out
