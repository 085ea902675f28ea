# SPDX-License-Identifier: Apache-2.0
"""The calibration report as one self-contained HTML file, or as a PDF."""

import importlib.util
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError, first_line, printable
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Grade
from selfcal_ros.outputs import write_bytes, write_text
from selfcal_ros.reporting.chapters import (
    MAP,
    CaptionedFigure,
    Chapter,
    chapters,
    heading,
)
from selfcal_ros.reporting.figures.svg import css, inline_svg, printed_svg
from selfcal_ros.reporting.summary.numbers import numeric_columns, truth_arrays
from selfcal_ros.reporting.summary.sections import Section, state_sentence
from selfcal_ros.reporting.turning import script, script_source, turning_map


def write_report(
    result: CalibrationResult,
    path: str | os.PathLike,
    *,
    truth: Mapping[str, np.ndarray] | None = None,
    more: Sequence[Chapter] = (),
    about: Mapping[str, str] | None = None,
) -> None:
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
        If the name ends in neither .html nor .pdf, `truth` does not fit the map, the file cannot
        be written, or a PDF is wanted without WeasyPrint.
    """
    check_name(path)
    printed = is_pdf(path)
    report_chapters = chapters(result, truth_arrays(result.error_map, truth), more)
    text = report_html(
        result, report_chapters, heading(result, about or {}), printed=printed
    )
    if printed:
        write_bytes(path, printed_page(text, path))
    else:
        write_text(path, text)


def check_name(path: str | os.PathLike) -> None:
    """Refuse a file that cannot become a report, before anything is computed.

    Raises
    ------
    InputError
        If it ends in neither .html nor .pdf, or in .pdf where WeasyPrint is not installed.
    """
    if Path(path).suffix.lower() not in (".html", ".htm", ".pdf"):
        raise InputError(
            str(path), "a report is HTML or PDF", "end the name in .html or .pdf"
        )
    if is_pdf(path) and importlib.util.find_spec("weasyprint") is None:
        raise _no_printer(path, "is not installed")


def is_pdf(path: str | os.PathLike) -> bool:
    """Return whether a report is wanted as a PDF."""
    return Path(path).suffix.lower() == ".pdf"


def printed_page(html: str, path: str | os.PathLike) -> bytes:
    """Return a page as a PDF on A4, printed by WeasyPrint; it loads nothing from outside.

    Raises
    ------
    InputError
        If WeasyPrint or a library that it needs is missing; `path` is the file that was wanted.
    """
    try:
        import weasyprint  # optional, and it loads a text layout library
    except (ImportError, OSError) as error:
        raise _no_printer(path, f"cannot be loaded ({first_line(error)})") from error
    return weasyprint.HTML(string=html, url_fetcher=_nothing_from_outside).write_pdf()


def _no_printer(path: str | os.PathLike, why: str) -> InputError:
    page = Path(path).with_suffix(".html").name
    return InputError(
        str(path),
        f"a PDF is printed by WeasyPrint, which {why}",
        f"pip install 'selfcal_ros[pdf]', or write {page} and print it in a browser",
    )


def _nothing_from_outside(url: str) -> dict:
    raise ValueError(f"{url}: a report loads nothing")


CSS = (
    css()
    + """
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1rem; max-width: 72rem; background: var(--paper);
  color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.5rem; margin: 0 0 .3rem; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid var(--line); }
h3 { font-size: 1rem; margin: 1.2rem 0 .3rem; }
a { color: var(--c0); }
nav { color: var(--soft); margin-top: .8rem; } nav a { margin-right: .9rem; display: inline-block; }
.verdict { border-left: .35rem solid var(--good); background: var(--card); padding: .7rem 1rem;
  margin: .8rem 0; font-size: 1.05rem; overflow-wrap: anywhere; }
.verdict.enlarged { border-color: var(--warn); }
.verdict.not_qualified { border-color: var(--bad); }
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
.map3d { margin: 0 0 1rem; } .map3d canvas { display: block; border: 1px solid var(--line);
  touch-action: none; } .map3d p { margin: .4rem 0; }
.figures { display: grid; gap: 1.4rem;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 24rem), 1fr)); align-items: start;
  margin-bottom: 1rem; }
figure { margin: 0; min-width: 0; max-width: 35rem; }
figcaption { color: var(--soft); font-size: .9rem; margin-top: .3rem; }
@media (max-width: 30rem) { body { padding: .7rem; font-size: 14px; }
  .facts th { width: 6.5rem; } th, td { padding-right: .6rem; }
  .list thead { display: none; } .list tr { display: block; padding: .4rem 0;
    border-top: 1px solid var(--line); }
  .list td { display: flex; justify-content: space-between; gap: 1rem; text-align: right;
    border: 0 !important; white-space: normal; min-width: 0; padding: .05rem 0; }
  .list td::before { content: attr(data-name); color: var(--soft); text-align: left; } }
@media print { body { max-width: none; padding: 0; font-size: 9.5pt; }
  nav, .map3d { display: none; }
  figure, tr { break-inside: avoid; } h2, h3 { break-after: avoid; }
  h2 { margin: 1rem 0 .3rem; } td, th { padding-bottom: .1rem; padding-top: .1rem; }
  .figures { grid-template-columns: 1fr 1fr; gap: .8rem; } .scroll { overflow: visible; }
  figure svg { width: 100%; height: auto; max-height: 220mm; } figcaption { font-size: 8pt; }
  table.list { font-size: 8pt; } .list th, .list td { white-space: normal; min-width: 0;
    padding-right: .5rem; }
  @page { margin: 15mm; @bottom-right { content: counter(page) " / " counter(pages);
    font-size: 8pt; } } }
"""
)


POLICY = "default-src 'none'; style-src 'unsafe-inline'"
"""Content security policy: a browser will not fetch anything, whatever a name contains; it runs
the one script of a page that turns a map, and no other."""

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
{script}</body>
</html>
"""


def page(title: str, body: str, *, style: str = "", turns: bool = False) -> str:
    """Return a whole page of escaped text and HTML.

    `style` comes after the common sheet; a page that `turns` a map has the script for it.
    """
    policy = f"{POLICY}; script-src {script_source()}" if turns else POLICY
    last = f"<script>{script()}</script>\n" if turns else ""
    return _PAGE.format(
        policy=policy, title=title, css=CSS + style, body=body, script=last
    )


WIDE = 40
"""Length of text from which a cell gets extra width."""

SHORT = 24
"""Length of text up to which a cell does not wrap."""


def report_html(
    result: CalibrationResult,
    report_chapters: Sequence[Chapter],
    head: Section,
    *,
    printed: bool = False,
) -> str:
    """Return the report as one HTML document that needs nothing from outside.

    Parameters
    ----------
    result : CalibrationResult
        What was found.
    report_chapters : sequence of Chapter
        Its chapters.
    head : Section
        What was calibrated, by whom and when.
    printed : bool
        For paper: light colours, no links, nothing that needs a pointer.
    """
    turning = "" if printed else turning_map(result)
    blocks = [
        f'<p class="verdict {_grade(result)}">{_text(state_sentence(result))}</p>',
        _section(head, titled=False),
        "" if printed else _contents(report_chapters),
        *(
            _chapter(
                chapter, printed=printed, more=turning if chapter.title == MAP else ""
            )
            for chapter in report_chapters
        ),
    ]
    return page(
        _text(f"Stage calibration: plan {result.plan_id}"),
        "\n".join(blocks),
        turns=bool(turning),
    )


def _grade(result: CalibrationResult) -> str:
    """Return the grade behind the colour of the banner; none is given without a map."""
    grade = (
        result.verdict.grade
        if result.observability.identifiable
        else Grade.NOT_QUALIFIED
    )
    return str(grade)


def _text(value: object) -> str:
    return escape(printable(value))


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z]+", "-", title.lower()).strip("-")


def _contents(report_chapters: Sequence[Chapter]) -> str:
    links = "".join(
        f'<a href="#{_anchor(c.title)}">{_text(c.title)}</a>' for c in report_chapters
    )
    return f"<nav>{links}</nav>"


def _chapter(chapter: Chapter, *, printed: bool, more: str) -> str:
    figures = "\n".join(_figure(figure, printed=printed) for figure in chapter.figures)
    blocks = [
        f"<h2>{_text(chapter.title)}</h2>",
        f'<div class="figures">\n{figures}\n</div>' if figures else "",
        more,
        *(
            _section(s, titled=len(chapter.sections) > 1 and s.title != chapter.title)
            for s in chapter.sections
        ),
    ]
    kind = ' class="attention"' if chapter.alert else ""
    return (
        f'<section id="{_anchor(chapter.title)}"{kind}>'
        + "\n".join(block for block in blocks if block)
        + "</section>"
    )


def _figure(figure: CaptionedFigure, *, printed: bool) -> str:
    drawing = printed_svg(figure.drawing) if printed else inline_svg(figure.drawing)
    caption = (
        figure.caption if printed else f"{figure.caption} {figure.on_screen}".rstrip()
    )
    return f"<figure>{drawing}<figcaption>{_text(caption)}</figcaption></figure>"


def _section(section: Section, *, titled: bool) -> str:
    """Return a section with its facts, its table and its notes."""
    blocks = [f"<h3>{_text(section.title)}</h3>"] if titled and section.title else []
    if section.facts:
        rows = "".join(
            f"<tr><th>{_text(label)}</th><td>{_text(value)}</td></tr>"
            for label, value in section.facts
        )
        blocks.append(f'<table class="facts"><tbody>{rows}</tbody></table>')
    if section.table:
        blocks.append(_table(section.table))
    if section.notes:
        items = "".join(f"<li>{_text(note)}</li>" for note in section.notes)
        blocks.append(f"<ul>{items}</ul>")
    return "\n".join(blocks)


def _table(table: tuple[tuple[str, ...], ...]) -> str:
    """Return a table; columns of numbers are flush right, long text wraps."""
    kinds = []
    for number, column in zip(
        numeric_columns(table), zip(*table, strict=True), strict=True
    ):
        longest = max(map(len, column))
        kinds.append(
            "n"
            if number
            else "w"
            if longest > WIDE
            else "s"
            if longest < SHORT
            else "t"
        )
    head = "".join(
        f'<th class="{kind}">{_text(name)}</th>'
        for name, kind in zip(table[0], kinds, strict=True)
    )
    rows = "".join(f"<tr>{_row(row, table[0], kinds)}</tr>" for row in table[1:])
    return (
        f'<div class="scroll"><table class="list"><thead><tr>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def _row(row: Sequence[str], names: Sequence[str], kinds: Sequence[str]) -> str:
    """Return the cells of a row; on a telephone each stands below the other with its name."""
    return "".join(
        f'<td class="{kind}" data-name="{_text(name)}">{_text(value)}</td>'
        for value, name, kind in zip(row, names, kinds, strict=True)
    )
