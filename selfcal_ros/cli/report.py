# SPDX-License-Identifier: Apache-2.0
"""``selfcal report``: a result in, one HTML file (and a picture, and the summary) out."""

import argparse
import sys
from pathlib import Path

HELP = "write a calibration report: one self-contained HTML file"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("result", metavar="RESULT.json", help="result that `selfcal solve` wrote")
    parser.add_argument("-o", "--output", metavar="REPORT.html",
                        help="where to write (default: beside the result, ending in .html)")
    parser.add_argument("--plot", metavar="MAP.png", help="also write the map as a picture")
    parser.add_argument("--truth", metavar="TRUTH.json",
                        help="known truth to compare with: gx, gy in m, g_theta in rad")
    parser.add_argument("--text", action="store_true", help="also print the summary")


def run(args: argparse.Namespace) -> int:
    """Read the result, write the report, say where it is."""
    from selfcal_ros.files import read_json
    from selfcal_ros.model.result import result_from_dict
    from selfcal_ros.reporting.html import save_report
    from selfcal_ros.reporting.map_plot import save_map_plot
    from selfcal_ros.reporting.summary import can_print_symbols, summary_text

    output = Path(args.output) if args.output else Path(args.result).with_suffix(".html")
    _keep_apart([args.result, args.truth], [output, args.plot])
    result = result_from_dict(read_json(args.result), args.result)
    truth = _read_truth(args.truth) if args.truth else None
    save_report(result, output, truth=truth)
    if args.plot:
        save_map_plot(result, args.plot, truth=truth)
    if args.text:
        print(summary_text(result, truth=truth, ascii_only=not can_print_symbols(sys.stdout)))
    for written in (output, args.plot):
        if written:
            print(f"written: {written}")
    return 0


def _keep_apart(inputs: list[str | None], outputs: list[str | Path | None]) -> None:
    """Refuse to write over a file that is read, or two outputs to one file."""
    from selfcal_ros.errors import InputError

    taken = {Path(name).resolve() for name in inputs if name}
    for name in outputs:
        if name and Path(name).resolve() in taken:
            raise InputError(str(name), "would be written over", "name another output file")
        if name:
            taken.add(Path(name).resolve())


def _read_truth(path: str) -> dict:
    from selfcal_ros.errors import InputError
    from selfcal_ros.files import read_json

    truth = read_json(path)
    if not isinstance(truth, dict):
        raise InputError(path, "not a mapping", "give gx, gy (m) and g_theta (rad)")
    return truth
