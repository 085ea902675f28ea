# SPDX-License-Identifier: Apache-2.0
"""The calibration report as one self-contained HTML file, or as a PDF."""

import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError, printable
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.outputs import write_bytes, write_text
from selfcal_ros.reporting.chapters import Chapter, Figure, chapters, heading
from selfcal_ros.reporting.figures.svg import css, inline_svg
from selfcal_ros.reporting.summary.numbers import numeric_columns, truth_arrays
from selfcal_ros.reporting.summary.sections import Section, state_sentence


def write_report(result: CalibrationResult, path: str | os.PathLike, *,
                 truth: Mapping[str, np.ndarray] | None = None,
                 more: Sequence[Chapter] = (), about: Mapping[str, str] | None = None) -> None:
    """Write the report of a calibration, HTML or PDF, atomically.

    Parameters
    ----------
    result : CalibrationResult
        The result; all its text is escaped.
    path : path-like
        File to write; .html or .pdf.
    truth : mapping, optional
        ``gx``, ``gy`` in m and ``g_theta`` in rad: adds the comparison and draws it.
    more : sequence of Chapter
        What others add to the chapters of every report.
    about : mapping, optional
        The ``stage``, its ``serial_number`` and the ``operator``.

    Raises
    ------
    InputError
        If the name ends in neither .html nor .pdf, `truth` does not fit the map, or the file
        cannot be written.
    """
    check_name(path)
    found = chapters(result, truth_arrays(result.error_map, truth), more)
    if Path(path).suffix.lower() == ".pdf":
        from selfcal_ros.reporting.pdf import report_pdf  # loads matplotlib
        write_bytes(path, report_pdf(result, found, heading(result, about or {})))
    else:
        write_text(path, report_html(result, found, heading(result, about or {})))


def check_name(path: str | os.PathLike) -> None:
    """Refuse a file name with any other ending than .html and .pdf.

    Raises
    ------
    InputError
        If it ends in something else.
    """
    if Path(path).suffix.lower() not in (".html", ".htm", ".pdf"):
        raise InputError(str(path), "a report is HTML or PDF", "end the name in .html or .pdf")


CSS = css() + """
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 72rem; background: var(--paper);
  color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
a { color: var(--c0); }
nav { color: var(--soft); } nav a { margin-right: .9rem; display: inline-block; }
.verdict { border-left: .35rem solid var(--good); background: var(--card); padding: .7rem 1rem;
  margin: .8rem 0; font-size: 1.05rem; overflow-wrap: anywhere; }
.verdict.bad { border-color: var(--bad); }
.attention li { color: var(--bad); }
.scroll { overflow-x: auto; max-width: 100%; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .9rem .2rem 0; text-align: right; vertical-align: top; }
thead th { border-bottom: 1px solid var(--line); color: var(--soft); font-weight: 600; }
table:not(.facts) tbody tr + tr td { border-top: 1px solid var(--line); }
th:first-child, td:first-child, .facts td, .s, .w, .t { text-align: left; }
.n { text-align: right; white-space: nowrap; }
.s { white-space: nowrap; } .w { min-width: 16rem; }
.facts th { color: var(--soft); font-weight: 400; width: 11rem; }
.facts td { overflow-wrap: anywhere; }
.figures { display: grid; gap: 1.4rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); align-items: start;
  margin-bottom: 1rem; }
figure { margin: 0; min-width: 0; max-width: 35rem; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3rem; }
@media (max-width: 30rem) { body { padding: .7rem; font-size: 14px; }
  .facts th { width: 6.5rem; } th, td { padding-right: .6rem; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; } nav { display: none; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; }
  h2 { margin: 1rem 0 .3rem; } td, th { padding-bottom: .1rem; padding-top: .1rem; }
  .figures { display: block; } .scroll { overflow: visible; }
  figure { display: inline-block; width: 48%; margin: 0 1% .6rem 0; vertical-align: top; }
  @page { margin: 15mm; } }
"""


POLICY = "default-src 'none'; style-src 'unsafe-inline'"
"""Content security policy: a browser will not fetch anything, whatever a name contains."""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def page(title: str, body: str, *, style: str = "") -> str:
    """Return a whole page of escaped text and HTML; `style` comes after the common sheet."""
    return _PAGE.format(policy=POLICY, title=title, css=CSS + style, body=body)


WIDE = 40
"""Length of text from which a cell gets extra width."""

SHORT = 24
"""Length of text up to which a cell does not wrap."""


def report_html(result: CalibrationResult, found: Sequence[Chapter], head: Section) -> str:
    """Return the report as one HTML document with inline figures and no external resources."""
    good = (result.verdict.grade is Grade.GOOD and result.observability.identifiable
            and not result.warnings)
    parts = [_section(head, titled=False),
             f'<p class="verdict{"" if good else " bad"}">{_text(state_sentence(result))}</p>',
             _contents(found), *map(_chapter, found)]
    return page(_text(f"Stage calibration: plan {result.plan_id}"), "\n".join(parts))


def _text(value: object) -> str:
    return escape(printable(value))


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z]+", "-", title.lower()).strip("-")


def _contents(found: Sequence[Chapter]) -> str:
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
    """Return a table; columns of numbers are flush right, long text wraps."""
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
