# SPDX-License-Identifier: Apache-2.0
"""The calibration report: one HTML file that needs nothing else."""

import os
import re
from collections.abc import Mapping
from html import escape

import numpy as np

from selfcal_ros.files import write_text
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.chapters import Chapter, Figure, chapters
from selfcal_ros.reporting.html_page import page
from selfcal_ros.reporting.sheet.svg import inline_svg
from selfcal_ros.reporting.summary.format import numeric_columns, printable
from selfcal_ros.reporting.summary.numbers import truth_arrays
from selfcal_ros.reporting.summary.sections import Section, state_sentence

WIDE = 40
"""Characters from which a cell of words is given room."""

SHORT = 24
"""Characters up to which a cell of words is kept in one line."""


def save_report(result: CalibrationResult, path: str | os.PathLike, *,
                truth: Mapping[str, np.ndarray] | None = None) -> None:
    """Write the report of a calibration to `path`, atomically.

    Raises
    ------
    InputError
        If `truth` does not fit the map, or the file cannot be written.
    """
    write_text(path, report_html(result, truth=truth))


def report_html(result: CalibrationResult, *,
                truth: Mapping[str, np.ndarray] | None = None) -> str:
    """Return the report as one HTML document with inline figures and no outside resource.

    Parameters
    ----------
    result : CalibrationResult
        What was found; all its text is escaped.
    truth : mapping, optional
        ``gx``, ``gy`` in m and ``g_theta`` in rad: adds the comparison and draws it.

    Raises
    ------
    InputError
        If `truth` does not fit the map.
    """
    found = chapters(result, truth_arrays(result.error_map, truth))
    good = (result.verdict.grade is Grade.GOOD and result.observability.identifiable
            and not result.warnings)
    parts = [f'<p class="verdict{"" if good else " bad"}">{_text(state_sentence(result))}</p>',
             _contents(found), *map(_chapter, found)]
    title = _text(f"Stage calibration: plan {result.plan_id}")
    return page(title, "\n".join(parts))


def _text(value: object) -> str:
    return escape(printable(value))


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z]+", "-", title.lower()).strip("-")


def _contents(found: list[Chapter]) -> str:
    links = "".join(f'<a href="#{_anchor(c.title)}">{_text(c.title)}</a>' for c in found)
    return f"<nav>{links}</nav>"


def _chapter(chapter: Chapter) -> str:
    figures = "\n".join(map(_figure, chapter.figures))
    parts = [f"<h2>{_text(chapter.title)}</h2>",
             f'<div class="figures">\n{figures}\n</div>' if figures else "",
             *(_section(s, titled=len(chapter.sections) > 1 and s.title != chapter.title)
               for s in chapter.sections)]
    kind = ' class="attention"' if chapter.alert else ""
    return f'<section id="{_anchor(chapter.title)}"{kind}>' + "\n".join(
        part for part in parts if part) + "</section>"


def _figure(figure: Figure) -> str:
    return (f"<figure>{inline_svg(figure.drawing)}"
            f"<figcaption>{_text(figure.caption)}</figcaption></figure>")


def _section(section: Section, *, titled: bool) -> str:
    """Return a section with its facts, its table and its notes."""
    parts = [f"<h3>{_text(section.title)}</h3>"] if titled and section.title else []
    if section.facts:
        rows = "".join(f"<tr><th>{_text(label)}</th><td>{_text(value)}</td></tr>"
                       for label, value in section.facts)
        parts.append(f'<table class="facts"><tbody>{rows}</tbody></table>')
    if section.table:
        parts.append(_table(section.table))
    if section.notes:
        items = "".join(f"<li>{_text(note)}</li>" for note in section.notes)
        parts.append(f"<ul>{items}</ul>")
    return "\n".join(parts)


def _table(table: tuple[tuple[str, ...], ...]) -> str:
    """Return a table; columns of numbers are flush right, long words get room."""
    kinds = []
    for number, column in zip(numeric_columns(table), zip(*table, strict=True), strict=True):
        longest = max(map(len, column))
        kinds.append("n" if number else "w" if longest > WIDE else "s" if longest < SHORT else "t")
    head = "".join(_cell("th", cell, kind) for cell, kind in zip(table[0], kinds, strict=True))
    rows = "".join("<tr>" + "".join(_cell("td", cell, kind) for cell, kind in
                                    zip(row, kinds, strict=True)) + "</tr>" for row in table[1:])
    return (f'<div class="scroll"><table><thead><tr>{head}</tr></thead>'
            f"<tbody>{rows}</tbody></table></div>")


def _cell(tag: str, value: str, kind: str) -> str:
    return f'<{tag} class="{kind}">{_text(value)}</{tag}>'
