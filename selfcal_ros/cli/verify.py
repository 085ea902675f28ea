# SPDX-License-Identifier: Apache-2.0
"""``selfcal verify``: is the machine better with the correction on, and if not, why not."""

import argparse

from selfcal_ros.bagio.offline import bag_input
from selfcal_ros.cli import solve
from selfcal_ros.cli.terminal import busy, save_drawing, say, say_unless_qualified
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.api import calibrate_corrected
from selfcal_ros.estimation.comparison.verification import (
    is_believed,
    require_correctable,
)
from selfcal_ros.model.result import CalibrationResult, with_input
from selfcal_ros.outputs import check_outputs, plain
from selfcal_ros.reporting.figures.maps import verification_picture
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.verification import (
    verification_text,
    with_verification,
)
from selfcal_ros.results import read_result
from selfcal_ros.settings.estimator import solver_options


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "map", metavar="MAP.json", help="RESULT.json whose map is corrected"
    )
    parser.add_argument(
        "bag",
        metavar="BAG",
        help="MCAP file or rosbag2 folder, measured with the "
        "correction on: a plan that identifies the stage, with any plate, or one "
        "view of the plate of MAP.json",
    )
    parser.add_argument(
        "--plot",
        metavar="FILE.png|.svg|.pdf",
        help="draw the error without and with the correction side by side",
    )
    parser.add_argument(
        "--json", action="store_true", help="print JSON (docs/guides/verify.md)"
    )
    solve.add_options(parser, {})


def run(args: argparse.Namespace) -> int:
    """Solve the bag, compare with the map, and print what the correction does."""
    check_outputs([args.map, args.bag, args.params], [args.plot])
    before = read_result(args.map)
    require_correctable(before, args.map)
    after = _after(args, before)
    with busy("comparing"):
        after, verification = with_verification(
            before, after, names=(args.map, args.bag)
        )
    verified = after.verification
    assert verified is not None
    if args.plot:
        save_drawing(
            verification_picture(before, after, verification, verified.sentence),
            args.plot,
        )
    say(
        args,
        verification_text(verification),
        plain(verified)
        | plain(
            {
                "gx": verification.gx,
                "gy": verification.gy,
                "g_theta": verification.g_theta,
            }
        ),
    )
    if not is_believed(after, verification):
        say_unless_qualified(after, f"selfcal verify: {args.bag}")
    return ExitCode.DONE if verified.passed else ExitCode.NOT_QUALIFIED


def _after(args: argparse.Namespace, before: CalibrationResult) -> CalibrationResult:
    """Return the map of the stage in the bag, on its own or from the plate of the map before."""
    collector, solver = solve.parameters(args)
    session = solve.collected(args, collector)
    source = bag_input(args.bag)
    if before.input.get("sha256") == source["sha256"]:
        raise InputError(
            args.bag,
            f"the recording that {args.map} was computed from, without the correction",
            "measure again with the correction on",
        )
    with busy("solving"), solve.named_bag(args.bag):
        options = solver_options(solver, session.measurements, plate_from=args.map)
        result = calibrate_corrected(session.measurements, options)
    return worded(with_input(result, source, session.lost))
