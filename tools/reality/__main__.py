# SPDX-License-Identifier: Apache-2.0
"""`make reality`: what real machines do, what the calibration makes of it, as a table.

python -m tools.reality [--runs N] [--workers N] [--only TEXT] [-o TABLE.md]
"""

import argparse
import sys
from functools import partial

from selfcal_ros.files import write_text
from selfcal_ros.parallel import check_workers, outcomes
from selfcal_ros.units import NM_PER_M
from tools.reality.cases import Case, Run, Summary, cases, run_case, summarise

HEADER = ("| what the machine does | map error, nm, largest (median) | in U | XY error / u | "
          "θ error / u | not qualified | wrong and qualified | first cause |\n"
          "|---|---|---|---|---|---|---|---|")


def row(found: Summary) -> str:
    causes = ", ".join(f"{name} ({count})" for name, count in found.causes) or "–"
    refused = f" ({found.refused} refused)" if found.refused else ""
    return (f"| {found.case.name.replace('um', 'µm').replace(' deg', '°')} "
            f"| {found.error_m * NM_PER_M:.1f} | {100 * found.within:.1f} % | {found.z_xy:.3f} "
            f"| {found.z_theta:.3f} | {found.told} of {found.runs}{refused} | {found.wrong} "
            f"| {causes} |")


def once(numbers: tuple[int, int]) -> Run:
    index, seed = numbers
    return run_case(cases()[index], 10_000 * index + seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="runs of each case (default: 40)")
    parser.add_argument("--workers", type=int, help="processes (default: one a core)")
    parser.add_argument("--only", default="", help="only cases whose name holds this text")
    parser.add_argument("-o", "--output", help="write the table to this file")
    args = parser.parse_args()
    every: list[Case] = cases()
    chosen = [i for i, case in enumerate(every) if args.only in case.name]
    jobs = [(index, seed) for index in chosen for seed in range(args.runs)]
    runs: dict[int, dict[int, Run]] = {index: {} for index in chosen}
    waiting, lines, write = list(chosen), [HEADER], partial(print, flush=True)
    write(HEADER)
    for outcome in outcomes(once, jobs, workers=check_workers(args.workers)):
        if outcome.error is not None:
            raise outcome.error
        index = jobs[outcome.index][0]
        runs[index][jobs[outcome.index][1]] = outcome.value
        while waiting and len(runs[waiting[0]]) == args.runs:
            done = waiting.pop(0)
            found = [runs[done][seed] for seed in range(args.runs)]
            lines.append(row(summarise(every[done], found)))
            write(lines[-1])
    notes = [f"- {every[i].name}: {every[i].hidden}." for i in chosen if every[i].hidden]
    lines += ["", "Not told, or not always, by the readings:", "", *notes] if notes else []
    write("\n".join(lines[-len(notes) - 3:] if notes else []))
    if args.output:
        write_text(args.output, "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
