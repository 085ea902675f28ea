# SPDX-License-Identifier: Apache-2.0
"""The table of a batch in the order of time, and the courses of its quantities."""

import csv
import io
from collections.abc import Container, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from selfcal_ros.applications.batch.course import FEWEST, Course, CourseKind, courses
from selfcal_ros.applications.batch.folder import PER, SCHEMA, Record
from selfcal_ros.reporting.summary.numbers import counted, p_text
from selfcal_ros.units import S_PER_DAY

BASE = (
    "bag",
    "first_exposure",
    "exit_code",
    "qualified",
    "message",
    "plan_id",
    "run_id",
    "sha256",
    "result",
    "grade",
)
FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""With these a cell begins that a spreadsheet computes."""


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
        return [
            self._sentence(name, course)
            for name, course in self.courses.items()
            if course.finding is not CourseKind.NONE
        ]

    def _sentence(self, name: str, course: Course) -> str:
        text, unit = described(name)
        p = p_text(course.adjusted_p)
        if course.finding is CourseKind.TREND:
            slope, low, high = course.slope_per_day
            return (
                f"{text}: trend of {slope:+.3g} {unit} per day (95 %: {low:+.3g} to "
                f"{high:+.3g}), {p}"
            )
        return (
            f"{text}: changed between {self.date(course.last_before)} and "
            f"{self.date(course.change)} by {course.after - course.before:+.3g} {unit} "
            f"(from {course.before:.4g} to {course.after:.4g}), {p}"
        )


def in_time(records: Sequence[Record]) -> list[Record]:
    """Return the records in the order of their first exposure; those without one last."""
    return sorted(
        records,
        key=lambda r: (
            r.get("first_exposure") is None,
            str(r.get("first_exposure")),
            r["bag"],
        ),
    )


def series_of(records: Sequence[Record]) -> list[PlanHistory]:
    """Return the series of a batch: bags of different plans or plates are never mixed."""
    groups: dict[tuple, dict[str, Record]] = {}
    for record in in_time(records):
        if record.get("quantities") and _time_s(record) is not None:
            group = (record["plan_id"], tuple(record["plate"]))
            groups.setdefault(group, {}).setdefault(record["sha256"], record)
    return [
        _series(group[0], list(records_of_bag.values()))
        for group, records_of_bag in groups.items()
    ]


def _series(plan_id: str, records: list[Record]) -> PlanHistory:
    times = np.array([_time_s(record) for record in records])
    days = (times - times[0]) / S_PER_DAY
    names = dict.fromkeys(name for record in records for name in record["quantities"])
    table = {
        name: np.array(
            [record["quantities"].get(name) for record in records], dtype=float
        )
        for name in names
        if not _is_u(name, names)
    }
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
    names = dict.fromkeys(
        name for record in ordered for name in record.get("quantities", {})
    )
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    compared = ["baseline_p", "changed", "not_compared"] * any(
        {"baseline", "not_compared"} & set(record) for record in ordered
    )
    writer.writerow([*BASE, "cause", "cause_view", *compared, *names])
    for record in ordered:
        quantities = record.get("quantities", {})
        causes = record.get("causes", [])
        likeliest = causes[0] if causes else {"name": "", "view": ""}
        writer.writerow(
            [_field(record.get(name)) for name in BASE]
            + [_field(likeliest["name"]), _field(likeliest["view"])]
            + [
                _field(((record.get("baseline") or {}) | record).get(name))
                for name in ("adjusted_p", "changed", "not_compared")
                if compared
            ]
            + [_field(quantities.get(name)) for name in names]
        )
    return out.getvalue()


def _field(value: Any) -> Any:
    """Return a cell of the table; text that would be a formula begins with an apostrophe."""
    if value is None:
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    return f"'{value}" if isinstance(value, str) and value[:1] in FORMULA else value


def batch_json(
    records: Sequence[Record], histories: Sequence[PlanHistory], done_before: int
) -> dict:
    """Return the whole batch as one JSON object, docs/guides/batch.md."""
    counts = {
        name: sum(code == r["exit_code"] for r in records)
        for name, code in (("qualified", 0), ("not_qualified", 5))
    }
    return {
        "schema": SCHEMA,
        "bags": len(records),
        **counts,
        "without_result": len(records) - sum(counts.values()),
        "done_before": done_before,
        "records": [
            {k: v for k, v in record.items() if k not in ("files", "schema")}
            for record in in_time(records)
        ],
        "series": [
            {
                "plan_id": series.plan_id,
                "bags": [r["bag"] for r in series.records],
                "findings": series.sentences(),
                "courses": {
                    name: _course_json(series, course)
                    for name, course in series.courses.items()
                },
            }
            for series in histories
        ],
    }


def _course_json(series: PlanHistory, course: Course) -> dict:
    changed = (
        [
            series.records[i]["first_exposure"]
            for i in (course.last_before, course.change)
        ]
        if course.change
        else None
    )
    return {
        "n": course.n,
        "finding": str(course.finding),
        "adjusted_p": course.adjusted_p,
        "p_trend": course.p_trend,
        "slope_per_day": list(course.slope_per_day),
        "p_change": course.p_change,
        "change_between": changed,
        "before": course.before,
        "after": course.after,
    }


def summary_lines(
    records: Sequence[Record], histories: Sequence[PlanHistory], done_before: int
) -> list[str]:
    """Return a summary of a batch, in lines."""
    good = sum(record["exit_code"] == 0 for record in records)
    maps = good + sum(record["exit_code"] == 5 for record in records)
    lines = [
        f"{counted(len(records), 'bag')}: {maps} calibrated, {good} of them qualified, "
        f"{len(records) - maps} without a result; {done_before} were done before"
    ]
    for series in histories:
        sentences = series.sentences()
        lines.append(
            f"plan {series.plan_id}, {counted(len(series.records), 'bag')} from "
            f"{series.date(0)} to {series.date(-1)}:"
        )
        few = f"too few bags for a trend (fewer than {FEWEST})"
        nothing = (
            few
            if len(series.records) < FEWEST
            else "no quantity has a trend or a change"
        )
        lines += [f"  {line}" for line in sentences or [nothing]]
    return lines


def described(name: str) -> tuple[str, str]:
    """Return a quantity's name as words, and its unit."""
    text, _, unit = name.replace(f"m{PER}m", "m/m").rpartition("_")
    return text.replace("_", " "), {"percent": "%", "um": "µm", "ppm": "µm/m"}.get(
        unit, unit
    )
