# SPDX-License-Identifier: Apache-2.0
"""``selfcal batch``: hundreds of bags on all cores, one table, changes over time."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from selfcal_ros.applications.batch.course import compared, sentence
from selfcal_ros.applications.batch.folder import (
    DATA,
    PAGE,
    TABLE,
    BatchJob,
    BatchSettings,
    Record,
    done_and_to_do,
    find_bags,
    kept_records,
    opened,
)
from selfcal_ros.applications.batch.jobs import run_job
from selfcal_ros.applications.batch.page import page_html
from selfcal_ros.applications.batch.table import (
    batch_json,
    csv_text,
    series_of,
    summary_lines,
)
from selfcal_ros.cli.solve import ROBUST, add_options, parameters
from selfcal_ros.cli.terminal import add_json, late_progress, say, tell
from selfcal_ros.errors import ExitCode, InputError, SelfcalError, first_line, printable
from selfcal_ros.outputs import write_json, write_text
from selfcal_ros.parallel import begin, check_workers, outcomes
from selfcal_ros.results import read_result

LOCAL = "local"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "bags",
        metavar="DIR|BAG",
        nargs="+",
        help="MCAP files, rosbag2 folders, or folders that contain them at any depth",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="FOLDER",
        required=True,
        help="folder for results, table.csv, index.html and batch.json; results "
        "already there are kept",
    )
    how = parser.add_mutually_exclusive_group()
    how.add_argument(
        "--workers", type=int, metavar="N", help="processes (default: one per core)"
    )
    how.add_argument(
        "--dask",
        metavar="ADDRESS",
        nargs="?",
        const=LOCAL,
        help="use a dask.distributed cluster: address of its scheduler, with access "
        "to the same files, or 'local' (default) for one started for this run",
    )
    parser.add_argument("--redo", action="store_true", help="solve all bags again")
    parser.add_argument(
        "--baseline",
        metavar="RESULT.json",
        help="test every map against this one, and name those that differ",
    )
    add_json(parser, "the contents of batch.json instead of a summary")
    add_options(parser, ROBUST)


def run(args: argparse.Namespace) -> int:
    """Solve the remaining bags, write the table and the page, print a summary."""
    if not args.dask:  # first: the modules of the workers load in parallel
        begin("selfcal_ros.applications.batch.jobs", check_workers(args.workers))

    if args.dask and args.dask != LOCAL and ":" not in args.dask:
        raise InputError(
            "--dask",
            f"'{args.dask}' is not the address of a scheduler",
            f"write HOST:PORT, or --dask {LOCAL} in front of a bag",
        )
    baseline = read_result(args.baseline) if args.baseline else None
    settings = BatchSettings(*parameters(args), args.namespace)
    bags, folder = find_bags(args.bags), Path(args.output)
    _refuse_inside(folder, bags)
    with opened(folder):
        earlier_records = [] if args.redo else kept_records(folder, settings)
        record_of, places = done_and_to_do(earlier_records, bags)
        for record in (record_of[index] for index in sorted(record_of)):
            _say(record)
        record_of |= _worked(args, bags, settings, places)

        records = [record_of[index] for index in sorted(record_of)]
        # copies and moved bags have one, too
        keys = {record.get("key") for record in earlier_records}
        before = sum("key" in record and record["key"] in keys for record in records)
        if baseline is not None:
            records = compared(records, folder, baseline, args.baseline)
        series = series_of(records)
        lines = summary_lines(records, series, before)
        if baseline is not None:
            lines += [sentence(records, args.baseline)]
        content = batch_json(records, series, before)
        write_text(folder / TABLE, csv_text(records))
        write_text(folder / PAGE, page_html(records, series, lines))
        write_json(folder / DATA, content)
    say(
        args,
        "\n".join(
            [
                *map(printable, lines),
                f"written: {folder / TABLE}, {PAGE}, {DATA}",
            ]
        ),
        content,
    )
    return exit_code(records)


def _refuse_inside(folder: Path, bags: Sequence[Path]) -> None:
    """Refuse a folder that is in a bag."""
    for bag in bags:
        if Path(os.path.realpath(folder)).is_relative_to(os.path.realpath(bag)):
            raise InputError(
                str(folder), f"it is in the bag {bag}", "name another folder"
            )


def _worked(
    args: argparse.Namespace,
    bags: Sequence[Path],
    settings: BatchSettings,
    places: Sequence[int],
) -> dict[int, Record]:
    """Return the records of the bags at `places`; print a line for each unqualified result."""
    records: dict[int, Record] = {}
    workers = check_workers(args.workers)
    folder = Path(args.output).absolute()
    jobs = [BatchJob(bags[place], folder, settings, args.redo) for place in places]
    with late_progress("solving bags") as progress:
        for outcome in outcomes(run_job, jobs, workers=workers, dask=args.dask or ""):
            place = places[outcome.index]
            if isinstance(outcome.error, SelfcalError):  # the folder cannot be written
                raise outcome.error
            records[place] = outcome.value or _failed(bags[place], outcome.error)
            _say(records[place])
            progress(len(records), len(jobs))
    return records


def _failed(bag: Path, error: BaseException | None) -> dict[str, Any]:
    """Return the record of a bag that failed with an internal error; it is not kept."""
    reason = first_line(error) if error is not None else "no outcome"
    return {
        "bag": os.path.realpath(bag),
        "exit_code": ExitCode.INTERNAL,
        "qualified": None,
        "message": f"{type(error).__name__}: {reason}",
    }


def _say(record: Record) -> None:
    if record["exit_code"]:
        line = record["message"]
        where = "" if line.startswith(record["bag"]) else f"{record['bag']}: "
        tell(f"selfcal batch: {where}{line}", sys.stderr)


def exit_code(records: Sequence[Record]) -> int:
    """Return 0 if every bag gave a qualified result, else the code of the worst bag.

    From bad to worse: not qualified (5), no usable data (4), not identified (3), bad input (2),
    internal error (1).
    """
    return min(
        (record["exit_code"] for record in records if record["exit_code"]),
        default=ExitCode.DONE,
    )
