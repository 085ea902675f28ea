# SPDX-License-Identifier: Apache-2.0
"""Fit text and pictures into a terminal; omissions are stated."""

from collections.abc import Callable, Sequence
from math import ceil

from rich.console import Console
from rich.text import Text

_CONSOLE = Console(width=500, legacy_windows=False)
"""Used for the width of characters; nothing is printed on it."""


def wrapped(texts: Sequence[Text], width: int) -> list[Text]:
    """Return texts as rows of at most `width` columns."""
    return [row for text in texts for row in text.wrap(_CONSOLE, width, overflow="fold")]


def fitted(rows: list[Text], most: int) -> list[Text]:
    """Return at most `most` rows; the last one states how many were omitted."""
    if len(rows) <= most:
        return rows
    left = len(rows) - max(most - 1, 0)
    more = Text(f"... {left} more row{'s' * (left > 1)}", style="dim")
    return [*rows[:max(most - 1, 0)], more][:most]


def last_fitted(texts: Sequence[Text], width: int, most: int) -> list[Text]:
    """Return the last texts that fit into `most` rows; the beginning of one that does not."""
    rows: list[Text] = []
    for text in reversed(texts):
        more = wrapped([text], width)
        if len(rows) + len(more) > most:
            return rows or fitted(more, most)
        rows = more + rows
    return rows


def headed(title: str, rows: list[Text], width: int) -> list[Text]:
    """Return rows below a title line."""
    head = Text(f"── {title} ", style="bold", no_wrap=True)
    head.truncate(width, overflow="ellipsis")
    head.append("─" * (width - head.cell_len))
    return [head, *rows]


def coarser[T](cells: Sequence[Sequence[T]], width: int, height: int,
               worst: Callable[[list[T]], T]) -> tuple[list[list[T]], int]:
    """Return cells coarsened to fit, blank-separated, and the factor per side.

    Parameters
    ----------
    cells : sequence of sequences
        Rows of equal length.
    width, height : int
        Columns and rows of room, at least 1.
    worst : callable
        Returns the cell that represents a group of cells.
    """
    across = max(map(len, cells), default=0)
    step = max(1, ceil(len(cells) / height), ceil(across / ((width + 1) // 2)))
    return [[worst([cell for row in cells[top:top + step] for cell in row[left:left + step]])
             for left in range(0, across, step)] for top in range(0, len(cells), step)], step
