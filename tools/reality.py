# SPDX-License-Identifier: Apache-2.0
"""`make reality`: what real machines do, what the calibration makes of it, as a table.

reality.py [--runs N] [--workers N] [--only TEXT] [-o TABLE.md]
"""

import argparse
import sys
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from selfcal_ros.files import write_text
from selfcal_ros.simulation.reality import Case, Summary, cases, run_case, summarise

HEADER = ("| what the machine does | map error, nm, largest (median) | in U | XY error / u | "
          "θ error / u | not qualified | wrong and qualified | first cause |\n"
          "|---|---|---|---|---|---|---|---|")


def row(found: Summary) -> str:
    causes = ", ".join(f"{name} ({count})" for name, count in found.causes) or "–"
    refused = f" ({found.refused} refused)" if found.refused else ""
    return (f"| {found.case.name.replace('um', 'µm').replace(' deg', '°')} "
            f"| {found.error_m * 1e9:.1f} | {100 * found.within:.1f} % | {found.z_xy:.3f} "
            f"| {found.z_theta:.3f} | {found.told} of {found.runs}{refused} | {found.wrong} "
            f"| {causes} |")


def once(numbers: tuple[int, int]) -> tuple[int, object]:
    index, seed = numbers
    return index, run_case(cases()[index], 10_000 * index + seed)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=40, help="runs of each case (default: 40)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--only", default="", help="only cases whose name holds this text")
    parser.add_argument("-o", "--output", help="write the table to this file")
    args = parser.parse_args()
    every: list[Case] = cases()
    chosen = [i for i, case in enumerate(every) if args.only in case.name]
    jobs = [(index, seed) for index in chosen for seed in range(args.runs)]
    runs: dict[int, list] = {index: [] for index in chosen}
    lines, write = [HEADER], partial(print, flush=True)
    write(HEADER)
    with ProcessPoolExecutor(args.workers) as pool:
        for index, run in pool.map(once, jobs, chunksize=5):
            runs[index].append(run)
            if len(runs[index]) == args.runs:
                lines.append(row(summarise(every[index], runs[index])))
                write(lines[-1])
    notes = [f"- {every[i].name}: {every[i].hidden}." for i in chosen if every[i].hidden]
    lines += ["", "Not told, or not always, by the readings:", "", *notes] if notes else []
    write("\n".join(lines[-len(notes) - 3:] if notes else []))
    if args.output:
        write_text(args.output, "\n".join(lines) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
