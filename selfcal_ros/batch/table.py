# SPDX-License-Identifier: Apache-2.0
"""The table of a batch in the order of time, the courses of its quantities, and its HTML page."""

import csv
import io
from collections.abc import Container, Sequence
from dataclasses import dataclass
from datetime import datetime
from html import escape
from typing import Any

import numpy as np

from selfcal_ros.batch.course import FEWEST, Course, CourseKind, courses
from selfcal_ros.batch.folder import PER, SCHEMA, Record
from selfcal_ros.errors import printable
from selfcal_ros.reporting.figures.drawing import TICK, Drawing, Frame
from selfcal_ros.reporting.figures.svg import inline_svg
from selfcal_ros.reporting.report import page

S_PER_DAY = 86400.0
BASE = ("bag", "first_exposure", "exit_code", "qualified", "message", "plan_id", "run_id",
        "sha256", "result", "grade")
STYLE = "td.text { text-align: left; min-width: 14rem; } td.bad { color: var(--bad); }\n"


@dataclass(frozen=True)
class PlanHistory:
    """Bags of one plan and plate with known times, and the courses of their quantities.

    Attributes
    ----------
    plan_id : str
        The plan.
    records : tuple of dict
        The bags with a map, in the order of their first exposure; copies count once.
    days : float array (n,)
        Their times since the first, in days.
    courses : dict
        Quantity -> course.
    """

    plan_id: str
    records: tuple[Record, ...]
    days: np.ndarray
    courses: dict[str, Course]

    def date(self, index: int) -> str:
        """Return the day and minute of a bag."""
        return str(self.records[index]["first_exposure"])[:16].replace("T", " ")

    def sentences(self) -> list[str]:
        """Return the findings, one line each."""
        return [self._sentence(name, course) for name, course in self.courses.items()
                if course.finding is not CourseKind.NONE]

    def _sentence(self, name: str, course: Course) -> str:
        text, unit = described(name)
        p = f"p = {course.adjusted_p:.2g}"
        if course.finding is CourseKind.TREND:
            slope, low, high = course.slope_per_day
            return (f"{text}: trend of {slope:+.3g} {unit} per day (95 %: {low:+.3g} to "
                    f"{high:+.3g}), {p}")
        return (f"{text}: changed between {self.date(course.last_before)} and "
                f"{self.date(course.change)} by {course.after - course.before:+.3g} {unit} "
                f"(from {course.before:.4g} to {course.after:.4g}), {p}")


def in_time(records: Sequence[Record]) -> list[Record]:
    """Return the records in the order of their first exposure; those without one last."""
    return sorted(records, key=lambda r: (r.get("first_exposure") is None,
                                          str(r.get("first_exposure")), r["bag"]))


def series_of(records: Sequence[Record]) -> list[PlanHistory]:
    """Return the series of a batch: bags of different plans or plates are never mixed."""
    groups: dict[tuple, dict[str, Record]] = {}
    for record in in_time(records):
        if record.get("quantities") and _time_s(record) is not None:
            group = (record["plan_id"], tuple(record["plate"]))
            groups.setdefault(group, {}).setdefault(record["sha256"], record)
    return [_series(group[0], list(found.values())) for group, found in groups.items()]


def _series(plan_id: str, records: list[Record]) -> PlanHistory:
    times = np.array([_time_s(record) for record in records])
    days = (times - times[0]) / S_PER_DAY
    names = dict.fromkeys(name for record in records for name in record["quantities"])
    table = {name: np.array([record["quantities"].get(name) for record in records], dtype=float)
             for name in names if not _is_u(name, names)}
    return PlanHistory(plan_id, tuple(records), days, courses(days, table))


def _is_u(name: str, names: Container[str]) -> bool:
    """Return whether a quantity is the standard uncertainty of another one."""
    return name.startswith("u_") and name.removeprefix("u_") in names


def _time_s(record: Record) -> float | None:
    try:
        return datetime.fromisoformat(str(record.get("first_exposure"))).timestamp()
    except ValueError:
        return None


def csv_text(records: Sequence[Record]) -> str:
    """Return the table as CSV: one line per bag, unknown values are empty."""
    ordered = in_time(records)
    names = dict.fromkeys(name for record in ordered for name in record.get("quantities", {}))
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    compared = ["baseline_p", "changed", "not_compared"] * any(
        {"baseline", "not_compared"} & set(record) for record in ordered)
    writer.writerow([*BASE, "cause", "cause_view", *compared, *names])
    for record in ordered:
        found, causes = record.get("quantities", {}), record.get("causes", [])
        likeliest = causes[0] if causes else {"name": "", "view": ""}
        writer.writerow([_field(record.get(name)) for name in BASE]
                        + [likeliest["name"], likeliest["view"]]
                        + [_field(((record.get("baseline") or {}) | record).get(name))
                           for name in ("adjusted_p", "changed", "not_compared") if compared]
                        + [_field(found.get(name)) for name in names])
    return out.getvalue()


def _field(value: Any) -> Any:
    return "" if value is None else str(value).lower() if isinstance(value, bool) else value


def batch_json(records: Sequence[Record], found: Sequence[PlanHistory], done_before: int) -> dict:
    """Return the whole batch as one JSON object, docs/batch.md."""
    counts = {name: sum(code == r["exit_code"] for r in records) for name, code in (
        ("qualified", 0), ("not_qualified", 5))}
    return {"schema": SCHEMA, "bags": len(records), **counts,
            "without_result": len(records) - sum(counts.values()), "done_before": done_before,
            "records": [{k: v for k, v in record.items() if k not in ("files", "schema")}
                        for record in in_time(records)],
            "series": [{
                "plan_id": series.plan_id, "bags": [r["bag"] for r in series.records],
                "findings": series.sentences(),
                "courses": {name: _course_json(series, course)
                            for name, course in series.courses.items()}} for series in found]}


def _course_json(series: PlanHistory, course: Course) -> dict:
    changed = [series.records[i]["first_exposure"] for i in
               (course.last_before, course.change)] if course.change else None
    return {"n": course.n, "finding": str(course.finding), "adjusted_p": course.adjusted_p,
            "p_trend": course.p_trend, "slope_per_day": list(course.slope_per_day),
            "p_change": course.p_change, "change_between": changed,
            "before": course.before, "after": course.after}


def summary_lines(records: Sequence[Record], found: Sequence[PlanHistory],
                  done_before: int) -> list[str]:
    """Return a summary of a batch, in lines."""
    good = sum(record["exit_code"] == 0 for record in records)
    maps = good + sum(record["exit_code"] == 5 for record in records)
    lines = [f"{len(records)} bags: {maps} calibrated, {good} of them qualified, "
             f"{len(records) - maps} without a result; {done_before} were done before"]
    for series in found:
        sentences = series.sentences()
        lines.append(f"plan {series.plan_id}, {len(series.records)} bags from {series.date(0)} to "
                     f"{series.date(-1)}:")
        few = f"too few bags for a trend (fewer than {FEWEST})"
        nothing = few if len(series.records) < FEWEST else "no quantity has a trend or a change"
        lines += [f"  {line}" for line in sentences or [nothing]]
    return lines


def page_html(records: Sequence[Record], found: Sequence[PlanHistory], lines: Sequence[str]) -> str:
    """Return the page; `lines` are those of `summary_lines`; all text is escaped."""
    good = bool(records) and all(record["exit_code"] == 0 for record in records)
    head, *findings = lines
    parts = [f'<p class="verdict{"" if good else " bad"}">{_text(head)}</p>',
             f"<p>{'<br>'.join(map(_text, findings))}</p>" if findings else ""]
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


def _figure(series: PlanHistory, name: str, course: Course) -> str:
    """Return a plot of values over time with the finding: a line, or a step at the change."""
    text, unit = described(name)
    caption = f"{text}{', ' * bool(unit)}{unit}"
    if any(f"u_{name}" in record["quantities"] for record in series.records):
        caption += ", bars ± 2 u"
    days = series.days
    values = np.array([record["quantities"].get(name) for record in series.records], dtype=float)
    known = np.isfinite(values)
    u = np.nan_to_num(np.array([record["quantities"].get(f"u_{name}") for record in
                                series.records], dtype=float))
    low, high = float((values - 2 * u)[known].min()), float((values + 2 * u)[known].max())
    margin = (high - low) * 0.08 or abs(high) * 0.01 or 1.0
    drawing = Drawing(name, caption, 560, 150)
    frame = Frame(drawing, (64, 14, 482, 108), (0.0, float(days[-1]) or 1.0),
                  (low - margin, high + margin))
    frame.border()
    for value in sorted({low, high}):
        drawing.label(58, frame.at(0.0, value)[1] + 4, f"{value:.4g}", size=TICK, anchor="end",
                      colour="soft")
    for number, (x, anchor) in enumerate(((64.0, "start"), (546.0, "end"))):
        drawing.label(x, 142, series.date(-number)[:10], size=TICK, anchor=anchor, colour="soft")
    for day, value, spread, record in zip(days, values, u, series.records, strict=True):
        if np.isfinite(value):
            if spread > 0:
                drawing.line([frame.at(day, value + end) for end in (-2 * spread, 2 * spread)],
                             stroke="soft")
            drawing.discs([frame.at(day, value)], 3.0,
                          fill="bad" if record["exit_code"] else "good")
            drawing.spot(*frame.at(day, value), 6, f"{record['bag']}: {value:.6g} {unit}")
    if course.finding is CourseKind.TREND:
        slope = course.slope_per_day[0]
        offset = float(np.nanmedian(values - slope * days))
        drawing.line([frame.at(day, offset + slope * day) for day in (days[0], days[-1])],
                     width=1.5)
    elif course.finding is CourseKind.CHANGE:
        middle = (days[course.last_before] + days[course.change]) / 2
        drawing.line([frame.at(middle, end) for end in frame.y], stroke="bad", dash=(4, 3))
        for ends, mean in (((days[0], middle), course.before), ((middle, days[-1]), course.after)):
            drawing.line([frame.at(day, mean) for day in ends], width=1.5)
    return (f"<figure>{inline_svg(drawing)}<figcaption>{_text(caption)}</figcaption></figure>")


def described(name: str) -> tuple[str, str]:
    """Return a quantity's name as words, and its unit."""
    text, _, unit = name.replace(f"m{PER}m", "m/m").rpartition("_")
    return text.replace("_", " "), {"percent": "%", "um": "µm", "ppm": "µm/m"}.get(unit, unit)
