# SPDX-License-Identifier: Apache-2.0
"""Cells of a camera's image: which one shows a mark, and which marks are expected in each."""

from functools import lru_cache

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


def cells_of(view: View, offset_m: np.ndarray) -> np.ndarray:
    """Return the cell of the image that shows each mark, x + iy, complex of whole numbers (n,).

    Parameters
    ----------
    view : View
        The view; without an image there is one cell, 0.
    offset_m : float array (2, n)
        Measured offsets, stage axes, m.
    """
    if view.image is None:
        return np.zeros(offset_m.shape[1], dtype=complex)
    step = (offset_m[0] + 1j * offset_m[1]) / (view.pose.rows * view.image.pitch_m)
    return np.rint(step.real) + 1j * np.rint(step.imag) + 0.0


def places_of_cells(view: View, offset_m: np.ndarray) -> np.ndarray:
    """Return the place of the cell that shows each mark, stage axes, (2, n), m."""
    if view.image is None:
        return np.zeros_like(offset_m)
    place = cells_of(view, offset_m) * (view.pose.rows * view.image.pitch_m)
    return np.stack([place.real, place.imag])


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
