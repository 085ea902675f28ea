# SPDX-License-Identifier: Apache-2.0
"""The page of a batch: one HTML file with what is named, courses as pictures, and the table."""

from collections.abc import Sequence
from html import escape
from typing import Any

import numpy as np

from selfcal_ros.batch.course import Course, Finding
from selfcal_ros.batch.quantities import described
from selfcal_ros.batch.records import Record
from selfcal_ros.batch.table import Series, in_time
from selfcal_ros.errors import printable
from selfcal_ros.reporting.report import page

WIDTH, HEIGHT, LEFT, EDGE = 560, 150, 64, 14
STYLE = """
figure { max-width: 36rem; } svg { width: 100%; height: auto; }
svg text { fill: var(--soft); font-size: 11px; }
.frame { stroke: var(--line); fill: none; } .value { fill: var(--good); }
.value.bad { fill: var(--bad); } .course { stroke: var(--ink); fill: none; stroke-width: 1.5; }
.change { stroke: var(--bad); stroke-dasharray: 4 3; }
td.text { text-align: left; min-width: 14rem; } td.bad { color: var(--bad); }
"""


def page_html(records: Sequence[Record], found: Sequence[Series], lines: Sequence[str]) -> str:
    """Return the page; `lines` are `table.summary_lines`, all text is escaped."""
    good = bool(records) and all(record["exit_code"] == 0 for record in records)
    head, *said = lines
    parts = [f'<p class="verdict{"" if good else " bad"}">{_text(head)}</p>',
             f"<p>{'<br>'.join(map(_text, said))}</p>" if said else ""]
    for series in found:
        pictures = "\n".join(_figure(series, name, course)
                             for name, course in series.courses.items())
        if pictures:
            parts.append(f"<section><h2>{_text('Plan ' + series.plan_id)}: over time</h2>"
                         f'<div class="figures">{pictures}</div></section>')
    parts.append(f"<section><h2>Bags</h2>{_table(records)}</section>")
    return page(f"Calibrations from {len(records)} bags", "\n".join(parts), style=STYLE)


def _text(value: object) -> str:
    return escape(printable(str(value)))


def _table(records: Sequence[Record]) -> str:
    ordered = in_time(records)
    names = dict.fromkeys(name for record in ordered for name in record.get("quantities", {}))
    heads = [f"{text}{', ' * bool(unit)}{unit}" for text, unit in map(described, names)]
    head = "".join(f"<th>{_text(cell)}</th>" for cell in ("bag", "first exposure", "verdict",
                                                           *heads))
    rows = []
    for record in ordered:
        quantities = record.get("quantities", {})
        bad = ' class="text bad"' if record["exit_code"] else ' class="text"'
        cells = [f"<td>{_text(record['bag'])}</td>",
                 f"<td>{_text((record.get('first_exposure') or '')[:16].replace('T', ' '))}</td>",
                 f"<td{bad}>{_text(record['message'])}</td>",
                 *(f"<td>{_number(quantities.get(name))}</td>" for name in names)]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    return ('<div class="scroll"><table><thead><tr>' + head + "</tr></thead><tbody>"
            + "\n".join(rows) + "</tbody></table></div>")


def _number(value: Any) -> str:
    return "" if value is None else f"{value:.4g}"


def _figure(series: Series, name: str, course: Course) -> str:
    """Return values over time with what is named: a line, or a step where it changed."""
    text, unit = described(name)
    values = np.array([record["quantities"].get(name) for record in series.records], dtype=float)
    known = np.isfinite(values)
    ends = low, high = float(values[known].min()), float(values[known].max())
    margin = (high - low) * 0.08 or abs(high) * 0.01 or 1.0
    low, high = low - margin, high + margin
    span = float(series.days[-1]) or 1.0
    bottom = HEIGHT - 2 * EDGE

    def place(day: float, value: float) -> tuple[float, float]:
        return (LEFT + (WIDTH - LEFT - EDGE) * day / span,
                EDGE + (bottom - EDGE) * (high - value) / (high - low))

    marks = [f'<rect class="frame" x="{LEFT}" y="{EDGE}" width="{WIDTH - LEFT - EDGE}" '
             f'height="{bottom - EDGE}"/>',
             *(f'<text x="{LEFT - 6}" y="{place(0.0, value)[1] + 4:.1f}" text-anchor="end">'
               f"{value:.4g}</text>" for value in sorted({ends[0], ends[1]})),
             f'<text x="{LEFT}" y="{HEIGHT - 1}">{series.date(0)[:10]}</text>',
             f'<text x="{WIDTH - EDGE}" y="{HEIGHT - 1}" text-anchor="end">'
             f"{series.date(-1)[:10]}</text>"]
    for day, value, record in zip(series.days[known], values[known],
                                  np.array(series.records, dtype=object)[known], strict=True):
        x, y = place(day, value)
        kind = "value" if record["exit_code"] == 0 else "value bad"
        marks.append(f'<circle class="{kind}" cx="{x:.1f}" cy="{y:.1f}" r="3"><title>'
                     f"{_text(record['bag'])}: {value:.6g} {_text(unit)}</title></circle>")
    marks += _named(series, course, values, place)
    caption = _text(f"{text}{', ' * bool(unit)}{unit}")
    return (f'<figure><svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{caption}">'
            + "".join(marks) + f"</svg><figcaption>{caption}</figcaption></figure>")


def _named(series: Series, course: Course, values: np.ndarray, place: Any) -> list[str]:
    days = series.days
    if course.finding is Finding.TREND:
        slope = course.slope_per_day[0]
        offset = float(np.nanmedian(values - slope * days))
        ends = [place(day, offset + slope * day) for day in (days[0], days[-1])]
        return [_line("course", *ends)]
    if course.finding is Finding.CHANGE:
        middle = (days[course.last_before] + days[course.change]) / 2
        x = place(middle, 0.0)[0]
        return [_line("change", (x, EDGE), (x, HEIGHT - 2 * EDGE)),
                _line("course", place(days[0], course.before), place(middle, course.before)),
                _line("course", place(middle, course.after), place(days[-1], course.after))]
    return []


def _line(kind: str, start: tuple[float, float], end: tuple[float, float]) -> str:
    return (f'<line class="{kind}" x1="{start[0]:.1f}" y1="{start[1]:.1f}" x2="{end[0]:.1f}" '
            f'y2="{end[1]:.1f}"/>')
