# SPDX-License-Identifier: Apache-2.0
"""The calibration report as a PDF on A4: text in columns, then the figures."""

import io
from collections.abc import Sequence
from textwrap import wrap
from typing import Any

from matplotlib import rc_context
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure as Page

from selfcal_ros import __version__
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.chapters import Chapter, Figure
from selfcal_ros.reporting.figures.paper import RC, drawable, put
from selfcal_ros.reporting.summary.numbers import aligned, numeric_columns
from selfcal_ros.reporting.summary.sections import Section, state_sentence

WIDTH, HEIGHT, MARGIN = 595.0, 842.0, 48.0
"""A4 in points, and what is left free at each edge."""

SIZE, LEADING = 7.6, 10.4
"""Size and distance of lines of text, points."""

COLUMNS = 108
"""Characters of the fixed-width type in a line."""

FIGURE_WIDTH = 240.0
"""Width of a figure, of which two stand beside each other, points."""

EMBEDDED: dict[Any, Any] = {"pdf.fonttype": 42}
"""Fonts go into the file as TrueType: words can be found and copied."""

Line = tuple[str, bool]
"""Words of a line, and whether they are a heading."""


def report_pdf(result: CalibrationResult, found: Sequence[Chapter], head: Section) -> bytes:
    """Return the report as a PDF, the same bytes for the same result."""
    title = drawable(f"Stage calibration: plan {result.plan_id}", 90)
    buffer = io.BytesIO()
    about = {"Title": title, "Creator": f"selfcal {__version__}", "CreationDate": None,
             "Producer": None}
    with rc_context({**RC, **EMBEDDED}), PdfPages(buffer, metadata=about) as pages:
        writer = _Writer(pages, title)
        writer.lines([(line, False) for line in [*_section_lines(head), ""]])
        writer.sentence(drawable(state_sentence(result), 600))
        for chapter in found:
            writer.lines(_lines(chapter))
        writer.figures([figure for chapter in found for figure in chapter.figures])
        writer.close()
    return buffer.getvalue()


def _lines(chapter: Chapter) -> list[Line]:
    """Return the text of a chapter, wrapped to the width of a page."""
    lines: list[Line] = []
    for section in chapter.sections:
        lines += [("", False), (drawable(section.title or chapter.title, COLUMNS), True)]
        lines += [(line, False) for line in _section_lines(section)]
    return lines


def _section_lines(section: Section) -> list[str]:
    rows = [(drawable(label), drawable(value, 2000)) for label, value in section.facts]
    width = max((len(label) for label, _ in rows), default=0)
    lines = []
    for label, value in rows:
        parts = wrap(value, COLUMNS - width - 4) or [""]
        lines += [f"  {label if i == 0 else '':{width}}  {part}" for i, part in enumerate(parts)]
    lines += _table_lines(section.table)
    for note in section.notes:
        lines += wrap(drawable(note, 2000), COLUMNS, initial_indent="  - ",
                      subsequent_indent="    ")
    return lines


def _table_lines(table: tuple[tuple[str, ...], ...]) -> list[str]:
    """Return a table in columns; those that do not fit are listed by name below each row."""
    if not table:
        return []
    cells = [[drawable(cell, 2000) for cell in row] for row in table]
    columns = len(table[0])
    while columns > 1 and max(map(len, _aligned(cells, columns))) > COLUMNS:
        columns -= 1
    lines = _aligned(cells, columns)
    if columns == len(table[0]) and max(map(len, lines)) <= COLUMNS:
        return lines
    out = lines[:1]
    for line, row in zip(lines[1:], cells[1:], strict=True):
        rest = "; ".join(f"{name}: {cell}" for name, cell in
                         zip(cells[0][columns:], row[columns:], strict=True) if cell)
        out += [line[:COLUMNS], *wrap(rest, COLUMNS, initial_indent="      ",
                                      subsequent_indent="      ")]
    return out


def _aligned(cells: list[list[str]], columns: int) -> list[str]:
    """Return the first columns of a table as lines."""
    table = tuple(tuple(row[:columns]) for row in cells)
    numeric = numeric_columns(table)
    left = next((i for i, number in enumerate(numeric) if number), len(numeric))
    return aligned(table, left=max(left, 1))


class _Writer:
    """Fills pages from top to bottom."""

    def __init__(self, pages: PdfPages, title: str) -> None:
        self._pages, self._title, self._number = pages, title, 0
        self._begin()

    def _begin(self) -> None:
        self._page = Page(figsize=(WIDTH / 72, HEIGHT / 72))
        self._number += 1
        self._y = MARGIN
        first = self._number == 1
        self._write(self._title, size=15.0 if first else SIZE, weight="bold")
        self._y += 26 if first else 18
        self._page.text(0.5, 24 / HEIGHT, f"{self._number}", ha="center", fontsize=SIZE)

    def _write(self, words: str, *, size: float = SIZE, weight: str = "normal",
               family: str = "DejaVu Sans", left: float = MARGIN) -> None:
        self._page.text(left / WIDTH, 1 - self._y / HEIGHT, words, fontsize=size, weight=weight,
                        family=family, va="top")

    def _room(self, points: float) -> None:
        """Start the next page unless `points` are free on this one."""
        if self._y + points > HEIGHT - MARGIN:
            self.close()
            self._begin()

    def sentence(self, words: str) -> None:
        """Write the verdict."""
        for part in wrap(words, 84):
            self._write(part, size=10.5, weight="bold")
            self._y += 14
        self._y += 4

    def lines(self, lines: list[Line]) -> None:
        """Write lines of fixed width; a heading stays with what follows."""
        for words, heading in lines:
            self._room(4 * LEADING if heading else LEADING)
            self._write(words, size=SIZE + 1.4 if heading else SIZE,
                        weight="bold" if heading else "normal",
                        family="DejaVu Sans" if heading else "DejaVu Sans Mono")
            self._y += LEADING + (3 if heading else 0)

    def figures(self, figures: list[Figure]) -> None:
        """Put the figures two per row, each above its caption."""
        self._y = HEIGHT
        for pair in [figures[i:i + 2] for i in range(0, len(figures), 2)]:
            captions = [wrap(drawable(figure.caption), 58) for figure in pair]
            height = max(f.drawing.height / f.drawing.width * FIGURE_WIDTH
                         + 9 * len(c) + 24 for f, c in zip(pair, captions, strict=True))
            self._room(height)
            for column, (figure, caption) in enumerate(zip(pair, captions, strict=True)):
                self._figure(figure, caption, MARGIN + column * (FIGURE_WIDTH + 19))
            self._y += height

    def _figure(self, figure: Figure, caption: list[str], left: float) -> None:
        drawing = figure.drawing
        height = drawing.height / drawing.width * FIGURE_WIDTH
        axes = self._page.add_axes((left / WIDTH, 1 - (self._y + height) / HEIGHT,
                                    FIGURE_WIDTH / WIDTH, height / HEIGHT))
        put(drawing, axes, FIGURE_WIDTH / drawing.width)
        top = self._y
        self._y += height + 5
        for line in caption:
            self._write(line, size=7, left=left)
            self._y += 9
        self._y = top

    def close(self) -> None:
        """Finish the page."""
        self._pages.savefig(self._page)
