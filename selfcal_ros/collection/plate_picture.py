# SPDX-License-Identifier: Apache-2.0
"""The plate of a view as lines of characters: which marks are read, which are missing."""

from collections.abc import Iterable
from math import ceil

import numpy as np

from selfcal_ros.collection.expected import mark_range
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


def plate_picture(artifact: Artifact, view: View, missing: Iterable[tuple[int, int]],
                  n_missing: int, most: int) -> tuple[list[str], int]:
    """Return the plate in its own frame, top line first, and how many marks a side are one sign.

    ``o`` read, ``.`` missing, ``?`` not told which, blank: not in this view. Of several marks the
    worst shows. There are no lines where nothing can be told.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    view : View
        How it lies.
    missing : iterable of (m, n)
        The first missing marks, in the order of m, then n.
    n_missing : int
        How many are missing; the named ones may be fewer.
    most : int
        Signs a side at most.
    """
    (m_low, m_high), (n_low, n_high) = mark_range(artifact, view)
    named = sorted(missing)
    if m_high < m_low or n_high < n_low or (n_missing > 0 and not named):
        return [], 1
    half, step = artifact.half, max(1, ceil(max(artifact.shape) / most))
    (m, m_last), (n, n_last) = (_blocks(h, low, high, step) for h, low, high in (
        (half[0], m_low, m_high), (half[1], n_low, n_high)))
    inside = (m <= m_last)[:, None] & (n <= n_last)[None, :]
    signs = np.where(inside, "o", " ")
    if n_missing > len(named):  # what lies behind the last named one is not told
        last = named[-1]
        behind = (m_last > last[0])[:, None] | ((m_last == last[0])[:, None]
                                                & (n_last > last[1])[None, :])
        signs[inside & behind] = "?"
    for mark in named:
        if m_low <= mark[0] <= m_high and n_low <= mark[1] <= n_high:
            signs[(mark[0] + half[0]) // step, (mark[1] + half[1]) // step] = "."
    return ["".join(row) for row in signs.T[::-1]], step


def _blocks(half: int, low: int, high: int, step: int) -> tuple[np.ndarray, np.ndarray]:
    """Return first and last index of each block of `step` from -half, cut to low..high."""
    first = np.arange(-half, half + 1, step)
    return np.maximum(first, low), np.minimum(first + step - 1, high)
