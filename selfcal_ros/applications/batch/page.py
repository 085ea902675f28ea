# SPDX-License-Identifier: Apache-2.0
"""The page of a batch: what was found, a few plots over time, and a table that fits."""

import os
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from selfcal_ros.applications.batch.course import Course, CourseKind
from selfcal_ros.applications.batch.folder import Record
from selfcal_ros.applications.batch.table import PlanHistory, described, in_time
from selfcal_ros.errors import printable
from selfcal_ros.reporting.figures.drawing import (
    TICK,
    Drawing,
    Frame,
    round_ticks,
    tick_text,
)
from selfcal_ros.reporting.figures.svg import inline_svg
from selfcal_ros.reporting.report import page
from selfcal_ros.reporting.summary.numbers import decimals_for, fixed, with_u

STYLE = """td.text { text-align: left; min-width: 14rem; } td.bad { color: var(--bad); }
details { margin: 1rem 0; } summary { cursor: pointer; color: var(--c0); margin-bottom: .6rem; }
"""

FIRST = (
    "max_error_um",
    "nonorthogonality_arcsec",
    "scale_difference_ppm",
    "max_theta_error_arcsec",
    "difference_from_baseline_largest_um",
)
"""Quantities that everybody looks at: plotted first, and the columns of the table."""

U_OF_ONE_PLACE = {
    "max_error_um": "rms_uncertainty_um",
    "difference_from_baseline_largest_um": "rms_uncertainty_um",
    "max_theta_error_arcsec": "rms_theta_uncertainty_arcsec",
}
"""Quantities that are the error of one place -> the standard uncertainty of a place, rms."""

ALIKE = ("uncertainty", "sigma", "difference_from_baseline", "error")
"""Words of names whose plots share a scale, if their unit is the same; the first that fits."""

S_PER_MAD = 1.4826
"""Standard deviation of a normal distribution whose median absolute deviation is 1."""

LIMIT = 3.0
"""Limits in standard deviations from the median, as in a control chart (ISO 7870-2)."""

Span = tuple[float, float]


def page_html(
    records: Sequence[Record], histories: Sequence[PlanHistory], lines: Sequence[str]
) -> str:
    """Return the page; `lines` are those of `summary_lines`; all text is escaped."""
    head, *findings = lines
    codes = {record["exit_code"] for record in records}
    grade = "good" if codes == {0} else "not_qualified"
    parts = [
        f'<p class="verdict {grade}">{_text(head)}</p>',
        f"<p>{'<br>'.join(map(_text, findings))}</p>" if findings else "",
    ]
    parts += [_history(series) for series in histories if series.courses]
    parts.append(
        f"<section><h2>Bags</h2>{_table(records)}"
        "<p>table.csv has all quantities of each bag.</p></section>"
    )
    return page(f"Calibrations from {len(records)} bags", "\n".join(parts), style=STYLE)


def _text(value: object) -> str:
    return escape(printable(str(value)))


def _history(series: PlanHistory) -> str:
    """Return the plots of a series: those that are looked at or have a finding come first."""
    first = [name for name in FIRST if name in series.courses]
    first += [
        name
        for name, course in series.courses.items()
        if course.finding is not CourseKind.NONE and name not in first
    ]
    further = [name for name in series.courses if name not in first]
    spans = _common_spans(series)

    def plots(names: Iterable[str]) -> str:
        pictures = "\n".join(_figure(series, name, spans[name]) for name in names)
        return f'<div class="figures">{pictures}</div>'

    details = (
        f"<details><summary>{len(further)} further quantities</summary>{plots(further)}</details>"
        if further
        else ""
    )
    return (
        f"<section><h2>{_text('Plan ' + series.plan_id)}: over time</h2>"
        "<p>Dots are bags, red ones not qualified; bars are ± 2 u. The band is the median "
        f"± {LIMIT:.0f} standard deviations of the bags themselves: a stable stage stays in "
        f"it.</p>{plots(first)}{details}</section>"
    )


def _values(series: PlanHistory, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a quantity of each bag, NaN if unknown, and its standard uncertainty, 0 if unknown."""

    def column(key: str) -> np.ndarray:
        return np.array(
            [record["quantities"].get(key) for record in series.records], dtype=float
        )

    return column(name), np.nan_to_num(column(U_OF_ONE_PLACE.get(name, f"u_{name}")))


def _limits(values: np.ndarray) -> Span:
    """Return the median less and plus `LIMIT` robust standard deviations."""
    finite = values[np.isfinite(values)]
    middle = float(np.median(finite))
    spread = LIMIT * S_PER_MAD * float(np.median(np.abs(finite - middle)))
    return middle - spread, middle + spread


def _common_spans(series: PlanHistory) -> dict[str, Span]:
    """Return the scale of each plot: one for all that are alike."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for name in series.courses:
        kind = next((word for word in ALIKE if word in name), name)
        kinds.setdefault((kind, described(name)[1]), []).append(name)
    spans: dict[str, Span] = {}
    for names in kinds.values():
        ends: list[float] = []
        for name in names:
            values, u = _values(series, name)
            has_value = np.isfinite(values)
            ends += [
                *_limits(values),
                *(values - 2 * u)[has_value],
                *(values + 2 * u)[has_value],
            ]
        low, high = min(ends), max(ends)
        margin = (high - low) * 0.08 or abs(high) * 0.01 or 1.0
        spans |= dict.fromkeys(names, (low - margin, high + margin))
    return spans


def _figure(series: PlanHistory, name: str, span: Span) -> str:
    """Return a plot of values over time with limits, u and the finding."""
    text, unit = described(name)
    values, u = _values(series, name)
    drawing = Drawing(name, f"{text} over time", 560, 170)
    frame = Frame(
        drawing, (64, 14, 482, 126), (0.0, float(series.days[-1]) or 1.0), span
    )
    low, high = _limits(values)
    corners = [
        (frame.x[0], low),
        (frame.x[1], low),
        (frame.x[1], high),
        (frame.x[0], high),
    ]
    drawing.shapes(
        [[frame.at(*corner) for corner in corners]], fill="band", opacity=0.25
    )
    frame.border()
    for value in round_ticks(*span, 4):
        drawing.label(
            58,
            frame.at(0.0, value)[1] + 4,
            tick_text(value),
            size=TICK,
            anchor="end",
            colour="soft",
        )
    for number, (x, anchor) in enumerate(((64.0, "start"), (546.0, "end"))):
        drawing.label(
            x, 160, series.date(-number)[:10], size=TICK, anchor=anchor, colour="soft"
        )
    for day, value, spread, record in zip(
        series.days, values, u, series.records, strict=True
    ):
        if not np.isfinite(value):
            continue
        if spread > 0:
            drawing.line(
                [frame.at(day, value + end) for end in (-2 * spread, 2 * spread)],
                stroke="soft",
            )
        drawing.discs(
            [frame.at(day, value)], 3.0, fill="bad" if record["exit_code"] else "good"
        )
        size = with_u(value, 2 * spread) if spread > 0 else f"{value:.6g}"
        label = f"{record['bag']}: {size} {unit}"
        drawing.spot(*frame.at(day, value), 6, label)
    _finding(frame, series, values, series.courses[name])
    caption = f"{text}{', ' * bool(unit)}{unit}" + (
        "" if u.any() else " (u is not known)"
    )
    return f"<figure>{inline_svg(drawing)}<figcaption>{_text(caption)}</figcaption></figure>"


def _finding(
    frame: Frame, series: PlanHistory, values: np.ndarray, course: Course
) -> None:
    """Draw a trend as a line, or a change as a step between the medians on both sides."""
    days = series.days
    if course.finding is CourseKind.TREND:
        slope = course.slope_per_day[0]
        offset = float(np.nanmedian(values - slope * days))
        frame.drawing.line(
            [frame.at(day, offset + slope * day) for day in (days[0], days[-1])],
            width=1.5,
        )
    elif course.finding is CourseKind.CHANGE:
        middle = (days[course.last_before] + days[course.change]) / 2
        frame.drawing.line(
            [frame.at(middle, end) for end in frame.y], stroke="bad", dash=(4, 3)
        )
        for ends, mean in (
            ((days[0], middle), course.before),
            ((middle, days[-1]), course.after),
        ):
            frame.drawing.line([frame.at(day, mean) for day in ends], width=1.5)


def _table(records: Sequence[Record]) -> str:
    ordered = in_time(records)
    measured = {name for record in ordered for name in record.get("quantities", {})}
    names = [name for name in FIRST if name in measured]
    heads = [
        "bag",
        "first exposure",
        "verdict",
        *(f"{text}{', ' * bool(unit)}{unit}" for text, unit in map(described, names)),
    ]
    rows = []
    for record in ordered:
        kind = "text bad" if record["exit_code"] else "text"
        exposed = str(record.get("first_exposure") or "")[:16].replace("T", " ")
        bag = _text(record["bag"])
        cells = [
            f'<td title="{bag}" data-name="bag">{_text(os.path.basename(record["bag"]))}</td>',
            f'<td data-name="first exposure">{_text(exposed)}</td>',
            f'<td class="{kind}" data-name="verdict">{_text(record["message"])}</td>',
            *(
                f'<td data-name="{_text(head)}">{_quantity(record, name)}</td>'
                for head, name in zip(heads[3:], names, strict=True)
            ),
        ]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    head = "".join(
        f'<th class="{"t" if cell == "verdict" else "n"}">{_text(cell)}</th>'
        for cell in heads
    )
    return (
        '<div class="scroll"><table class="list"><thead><tr>'
        + head
        + "</tr></thead><tbody>"
        + "\n".join(rows)
        + "</tbody></table></div>"
    )


def _quantity(record: Record, name: str) -> str:
    """Return a quantity with its expanded uncertainty, where both are known."""
    quantities = record.get("quantities", {})
    value = quantities.get(name)
    u = quantities.get(U_OF_ONE_PLACE.get(name, f"u_{name}"))
    if value is None:
        return ""
    if not u:
        return f"{value:.4g}"
    # two figures of U, and the value to the same place
    decimals = decimals_for([2 * u], 2)
    return f"{fixed(value, decimals)} ± {fixed(2 * u, decimals)}"
