# SPDX-License-Identifier: Apache-2.0
"""`make reality`: a table of real machines' effects and of the results of calibrating with them.

python -m tools.reality [--runs N] [--first SEED] [--workers N] [--only TEXT] [-o FILE]
"""

import argparse
import csv
import math
import sys
from collections.abc import Iterator
from dataclasses import asdict
from io import StringIO
from pathlib import Path

from selfcal_ros.outputs import plain, write_json, write_text
from selfcal_ros.parallel import check_workers, outcomes
from selfcal_ros.units import NM_PER_M
from tools.reality.cases import Case
from tools.reality.runs import GRADES, Course, Summary, every_case, once, rows

HEADER = (
    "| effect | in U: XY, θ, % | error / u: XY, θ | grades (wrong) | after the advice | "
    "first cause |\n|---|---|---|---|---|---|"
)
COLUMNS = (
    "effect",
    "after_advice",
    "runs",
    "largest_error_nm",
    "in_u_xy",
    "u_in_u_xy",
    "in_u_x",
    "in_u_y",
    "in_u_theta",
    "error_over_u_xy",
    "error_over_u_theta",
    *GRADES,
    "wrong",
    "first_cause",
    "runs_of_cause",
)
WRONG = 0.05
"""Part of the runs of a case that may be wrong and accepted; the page lists cases with more."""

SHOWN = {
    "plates turned by": "φσ",
    "um": "µm",
    " deg": "°",
    "urad": "µrad",
    "of the other sign": "with the wrong sign",
    "stage that never scatters": "stage without scatter",
    "laid by hand": "placed by hand",
    "after each laying down": "after each placement",
    "marks that lie 1 mm beside": "marks 1 mm away from",
    "marks that lie 2 mm beside": "marks 2 mm away from",
    "alike in": "the same in",
    "beside white noise": "plus white noise",
    "declared 800 µm/m wrong": "declared wrong by 800 µm/m",
    "to the other side": "in the opposite direction",
    "all of them": "all of these",
    "nothing, and no noise": "no effect, no noise",
    "stops: nothing": "stops: no effect",
    "ids: nothing": "ids: no effect",
    "microscope as its default uncertainty says": "microscope drawn from its default uncertainty",
}
"""Text of a case's name -> how the table shows it. Seeds depend on the name itself."""


def shown(name: str) -> str:
    for plain_text, text in SHOWN.items():
        name = name.replace(plain_text, text)
    return name


def grades(found: Summary) -> str:
    counts = "/".join(str(found.grades.get(grade, 0)) for grade in GRADES)
    return f"{counts} ({found.wrong})"


def row(name: str, found: Summary, advised: Summary | None = None) -> str:
    """Return the line of a case; `advised` is what came of it where advice was followed."""
    within_xy = f"{100 * found.within:.1f} ± {200 * found.u_within:.1f}"
    within_theta = f"{100 * found.within_theta:.1f}"
    cause = found.causes[0][0] if found.causes else "–"
    after = grades(advised) if advised else ""
    text = (
        f"| {shown(name)} | {within_xy}, {within_theta} | {found.z_xy:.2f}, "
        f"{found.z_theta:.2f} | {grades(found)} | {after} | {cause} |"
    )
    return text.replace("nan ± nan", "–").replace("nan", "–")


def table(cases: list[tuple[str, list[Summary]]]) -> list[str]:
    """Return the page's table: the cases with more wrong and accepted runs than `WRONG`."""
    return [
        HEADER,
        *(
            row(name, found, *advised)
            for name, (found, *advised) in cases
            if found.wrong > WRONG * found.runs
        ),
    ]


def record(case: Case, courses: dict[int, Course]) -> Iterator[list[str]]:
    """Yield the lines of a case for the table of all cases, of `COLUMNS`."""
    followed = sum(bool(course.steps) for course in courses.values())
    for (_, found), advised in zip(
        rows(case, courses), ("", str(followed)), strict=False
    ):
        numbers = (
            found.error_m * NM_PER_M,
            100 * found.within,
            200 * found.u_within,
            100 * found.within_x,
            100 * found.within_y,
            100 * found.within_theta,
            found.z_xy,
            found.z_theta,
        )
        cause, count = found.causes[0] if found.causes else ("", "")
        yield [
            shown(case.name),
            advised,
            str(found.runs),
            *(f"{number:.3g}" if math.isfinite(number) else "" for number in numbers),
            *(str(found.grades.get(grade, 0)) for grade in GRADES),
            str(found.wrong),
            cause,
            str(count),
        ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--runs",
        type=int,
        default=40,
        help="runs of each case (default: 40); "
        "25 times as many of the clean population, 5 times of the others",
    )
    parser.add_argument(
        "--first", type=int, default=0, help="seed of the first run (default: 0)"
    )
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument(
        "--only",
        action="append",
        help="only cases whose name contains this text; may be given again for others",
    )
    parser.add_argument(
        "--list", action="store_true", help="list the cases and do nothing"
    )
    parser.add_argument(
        "-o",
        "--output",
        help="write the table to this page, between its marks, "
        "and all cases to the .csv beside it; or every run to a .json",
    )
    args = parser.parse_args()
    every = every_case()
    chosen = [
        i
        for i, case in enumerate(every)
        if not args.only or any(text in case.name for text in args.only)
    ]
    if args.list:
        print("\n".join(every[i].name for i in chosen))
        return 0
    jobs = [
        (index, args.first + run)
        for index in chosen
        for run in range(args.runs * every[index].times)
    ]
    cases: list[tuple[str, list[Summary]]] = []
    lines, done = [list(COLUMNS)], []
    for index, courses in finished(jobs, check_workers(args.workers)):
        case = every[index]
        done.append(as_json(case, courses))
        cases.append((case.name, [summary for _, summary in rows(case, courses)]))
        lines += record(case, courses)
        print(row(case.name, *cases[-1][1][:2]), flush=True)
        if args.output and args.output.endswith(".json"):
            write_json(args.output, plain(done))  # kept if the rest is interrupted
        elif args.output:
            write_table(args.output, table(cases))
            write_text(Path(args.output).with_suffix(".csv"), in_csv(lines))
    return 0


def in_csv(lines: list[list[str]]) -> str:
    text = StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue()


BEGIN, END = "<!-- rows -->\n", "\n<!-- end of rows -->"


def write_table(path: str, lines: list[str]) -> None:
    """Write the table to a file: between the marks of a page that has them."""
    table = "\n".join(lines)
    page = Path(path).read_text() if Path(path).exists() else ""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    write_text(path, before + begin + table + end + after if end else table + "\n")


def finished(jobs: list[tuple[int, int]], workers: int):
    """Yield (case, seed -> course) of each case in order, as soon as it is complete."""
    waiting = list(dict.fromkeys(index for index, _ in jobs))
    courses: dict[int, dict[int, Course]] = {index: {} for index in waiting}
    wanted = {index: sum(one == index for one, _ in jobs) for index in waiting}
    for outcome in outcomes(once, jobs, workers=workers):
        if outcome.error is not None:
            raise RuntimeError(
                f"case and seed {jobs[outcome.index]}"
            ) from outcome.error
        index, seed = jobs[outcome.index]
        courses[index][seed] = outcome.value
        while waiting and len(courses[waiting[0]]) == wanted[waiting[0]]:
            done = waiting.pop(0)
            yield done, dict(sorted(courses[done].items()))


def as_json(case: Case, courses: dict[int, Course]) -> dict:
    return {
        "case": case.name,
        "rows": [
            {"row": name, **asdict(summary)} for name, summary in rows(case, courses)
        ],
        "runs": [{"seed": seed, **asdict(course)} for seed, course in courses.items()],
    }


if __name__ == "__main__":
    sys.exit(main())
