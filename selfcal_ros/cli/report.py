# SPDX-License-Identifier: Apache-2.0
"""``selfcal report``: a result in, one HTML or PDF file (and a picture, and the summary) out."""

import argparse
import os
import sys
from pathlib import Path

from selfcal_ros.applications.aerotech.read import load_cal
from selfcal_ros.applications.aerotech.verify import table_chapter
from selfcal_ros.applications.standards.chapter import certificate_chapter, certified
from selfcal_ros.applications.standards.details import read_details
from selfcal_ros.cli.terminal import (
    add_json,
    add_result,
    add_truth,
    busy,
    save_drawing,
    say,
)
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.outputs import can_print_symbols, check_outputs, refuse_existing
from selfcal_ros.reporting.chapters import ABOUT
from selfcal_ros.reporting.figures.maps import map_picture
from selfcal_ros.reporting.report import check_name, write_report
from selfcal_ros.reporting.summary.sections import summary_text
from selfcal_ros.results import read_result


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_result(parser)
    parser.add_argument(
        "-o",
        "--output",
        metavar="REPORT.html|.pdf",
        help="file to write (default: next to the result, ending in .html)",
    )
    parser.add_argument(
        "--plot", metavar="MAP.png", help="also write the map as a picture"
    )
    add_truth(parser)
    parser.add_argument(
        "--table",
        metavar="FILE.cal",
        help="the table that `selfcal cal export` "
        "wrote: add the error of a simulated controller before and after it",
    )
    parser.add_argument(
        "--details",
        metavar="DETAILS.yaml",
        help="add the contents of a "
        "certificate: laboratory, customer, item, conditions "
        "(docs/guides/certificate.md), traceability, U of distances",
    )
    for name, what in (
        ("stage", "name of the stage"),
        ("serial-number", "its serial number"),
        ("operator", "who calibrated it"),
    ):
        parser.add_argument(
            f"--{name}",
            metavar="TEXT",
            default="",
            help=f"{what}, for the heading of the report",
        )
    add_json(parser)
    parser.add_argument("--text", action="store_true", help="also print the summary")


def run(args: argparse.Namespace) -> int:
    """Read the result, write the report, print its path."""
    output = Path(args.output or f"{os.path.splitext(args.result)[0]}.html")
    check_outputs(
        [args.result, args.truth, args.table, args.details], [output, args.plot]
    )
    check_name(output)
    refuse_existing([output], force=args.force)
    result = read_result(args.result)
    truth = read_truth(args.truth) if args.truth else None
    details = read_details(args.details) if args.details else None
    chapters = [table_chapter(result, load_cal(args.table))] if args.table else []
    if details:
        chapters.append(certificate_chapter(result, details))
    with busy("drawing"):
        if args.plot:
            save_drawing(map_picture(result, truth), args.plot)
        write_report(
            result, output, truth=truth, more=chapters, about=_about(args, details)
        )
    written = [str(name) for name in (output, args.plot) if name]
    text = (
        [
            summary_text(
                result, truth=truth, ascii_only=not can_print_symbols(sys.stdout)
            )
        ]
        if args.text
        else []
    )
    say(
        args,
        "\n".join([*text, *(f"written: {name}" for name in written)]),
        {"written": written, "summary": text[0] if text else None},
    )
    return 0


def _about(args: argparse.Namespace, details: dict | None) -> dict[str, str]:
    """Return what the head of the report states: of a certificate, or the options."""
    named = {name: getattr(args, name) for name in ABOUT}
    return (
        {**certified(details), **{name: text for name, text in named.items() if text}}
        if details
        else named
    )


def read_truth(path: str) -> dict:
    """Return the truth in a TRUTH.json; InputError if it is invalid."""
    truth = read_json(path)
    if not isinstance(truth, dict):
        raise InputError(path, "not a mapping", "give gx, gy (m) and g_theta (rad)")
    return truth
