# SPDX-License-Identifier: Apache-2.0
"""``selfcal replay``: a bag played over DDS into the live nodes, each in its own process."""

import argparse
import contextlib
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.offline import (
    BagLines,
    BagSession,
    Playlist,
    bag_input,
    bag_lines,
    collect_bag,
)
from selfcal_ros.cli.processes import domain, need_ros, process
from selfcal_ros.cli.terminal import (
    add_parameters,
    add_recorded_namespace,
    add_solved,
    aside,
    exit_code,
    file_of,
    given,
    node_settings,
    on_stdout,
    option_of,
    progress_bar,
    put,
    show,
    warn,
)
from selfcal_ros.collection.inputs import rejections
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.files import read_json, read_yaml, write_yaml
from selfcal_ros.model.result import result_from_dict, with_digests
from selfcal_ros.outputs import check_outputs, temporary_folder, write_json
from selfcal_ros.portable import ended_by_signals
from selfcal_ros.settings.detector import ANY_NUMBER, OPTIONS, DetectorSettings
from selfcal_ros.settings.nodes import CollectorSettings, check_parameters
from selfcal_ros.settings.parameter import TYPED
from selfcal_ros.topics import INPUT_TOPICS, LARGEST_DOMAIN

NODES = ("measurement_collector", "pose_sequencer", "solver")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "bag",
        metavar="BAG",
        help="MCAP file or rosbag2 folder; of one with "
        "images and no detections mark_detector finds the marks",
    )
    speed = parser.add_mutually_exclusive_group()
    speed.add_argument(
        "--rate", type=float, default=1.0, metavar="R", help="speed (default: 1)"
    )
    speed.add_argument(
        "--fast", action="store_true", help="as fast as the nodes can follow"
    )
    add_solved(parser)
    parser.add_argument(
        "--params", metavar="NODES.yaml", help="ROS parameter file for the nodes"
    )
    add_recorded_namespace(parser)
    parser.add_argument(
        "--domain",
        type=int,
        metavar="ID",
        help="ROS domain to play in, to watch "
        "with ros2 topic echo; refused if somebody publishes in it (default: one "
        "that nobody uses)",
    )
    parser.add_argument("--quiet", action="store_true", help="print no summary")
    images = parser.add_argument_group(
        "for a bag with images and no detections",
        "options of mark_detector, as in selfcal detect, or in NODES.yaml",
    )
    add_parameters(images, DetectorSettings, OPTIONS)


def run(args: argparse.Namespace) -> int:
    """Start the nodes, play the bag, collect the result, stop the nodes."""
    need_ros(", or use `selfcal solve`")
    _check(args)
    if args.params:
        check_parameters(read_yaml(args.params), args.params)
    source = bag_input(args.bag)
    detector = detector_of(args)
    settings = node_settings(args.params, CollectorSettings)
    bag = bag_lines(args.bag, settings, args.namespace)
    for line in bag.faults:  # first: what nodes say of the readings follows from them
        warn(args, f"{args.bag}: {line}")
    with (
        ended_by_signals(),
        temporary_folder(Path(tempfile.gettempdir())) as folder,
        domain(args.domain) as environment,
    ):
        saved = folder / "result.json"
        code, unplayed = _play(
            args, saved, environment, detector, printed_faults=bag.faults
        )
        if saved.exists():
            data = with_bag(read_json(saved), bag, unplayed, source)
            if file_of(args):
                write_json(args.output, data)
            if on_stdout(args):
                put(data)
            _warn_of_rejections(args, data, by_detector=detector is not None)
        _refuse_fault(args, code, detector, folder, printed_faults=bag.faults)
        if code or not saved.exists():  # perhaps a result without a map
            return code or 1
    result = result_from_dict(data, args.bag)
    if not args.quiet:
        show(result, args.bag, file_of(args), aside(args))
    return exit_code(result)


def _warn_of_rejections(
    args: argparse.Namespace, data: dict[str, Any], *, by_detector: bool
) -> None:
    """Print what `solve` says of many rejections, whether or not there is a map."""
    lines = rejections(data["rejected"], sum(view["used"] for view in data["views"]))
    if lines and (by_detector or not offline(args, args.bag).findings):
        for line in lines:
            warn(args, f"{args.bag}: {line}")


def _check(args: argparse.Namespace) -> None:
    """Refuse options before anything is started."""
    if not args.fast and not args.rate > 0:
        raise InputError(
            "--rate", f"{args.rate:g} is not a speed", "give a number above 0"
        )
    if args.domain is not None and not 0 <= args.domain <= LARGEST_DOMAIN:
        raise InputError(
            "--domain",
            f"{args.domain} is not a ROS domain",
            f"give a number from 0 to {LARGEST_DOMAIN}",
        )
    check_outputs([args.bag, args.params], [file_of(args)])


def offline(args: argparse.Namespace, bag: str | Path) -> BagSession:
    """Return what `selfcal solve` collects from a bag."""
    return collect_bag(
        bag, node_settings(args.params, CollectorSettings), namespace=args.namespace
    )


def _refuse_fault(
    args: argparse.Namespace,
    code: int,
    detector: DetectorSettings | None,
    folder: Path,
    *,
    printed_faults: Sequence[str],
) -> None:
    """Refuse a plan that is not identified because of a fault of the cell, as `solve` does.

    A fault that is in `printed_faults` is not repeated.

    Raises
    ------
    InputError
        With the fault, such as a plate that lies otherwise than planned.
    NoDataError
        With what images show instead of marks.
    """
    bag: str | Path = args.bag
    if detector is not None and code in (ExitCode.NO_DATA, ExitCode.NOT_IDENTIFIABLE):
        bag = _detected(args, detector, folder)
    if code == ExitCode.NOT_IDENTIFIABLE:
        session = offline(args, bag)
        for fault in session.findings:
            if fault not in session.lost:
                raise InputError(
                    args.bag,
                    "not identified, for the reason said first"
                    if fault in printed_faults
                    else fault,
                    "correct this first",
                )


def _detected(
    args: argparse.Namespace, settings: DetectorSettings, folder: Path
) -> Path:
    """Return the bag of marks that `selfcal detect` finds in the images of a bag."""
    from selfcal_ros.vision.exposures import (
        ImageDetector,
    )  # with scipy, for images only

    detector = ImageDetector(settings, args.bag)
    marks_bag = folder / "detected"
    ImageBag(Path(args.bag), args.namespace).write_detected(
        marks_bag,
        detector.take,
        check=lambda: detector.refuse_nothing(args.bag),
        frame_id=settings.frame_id,
    )
    return marks_bag


def detector_of(args: argparse.Namespace) -> DetectorSettings | None:
    """Return the parameters of mark_detector for a bag whose images are played; None for others.

    Raises
    ------
    InputError
        If one of them is missing or wrong, or is given where no image is played.
    NoDataError
        If the bag has no detections, commands or encoder samples.
    """
    options = given(args, OPTIONS)
    playlist = Playlist(Path(args.bag), args.namespace)
    transport = playlist.transport
    if not transport:
        if not playlist.counts.keys() >= INPUT_TOPICS.keys():
            offline(args, args.bag)  # raises what is missing
        for name in (name for name, value in options.items() if value is not None):
            raise InputError(
                option_of(name),
                f"no images of {args.bag} are played",
                "leave it out; it is for bags with images and no detections",
            )
        return None
    from selfcal_ros.vision.detector import MarkDetector  # with scipy, for images only

    settings = node_settings(args.params, DetectorSettings, **options)
    MarkDetector(
        settings, f"{args.bag} has images and no detections: {args.params or TYPED}"
    )
    # how images reach it is not the user's here
    way = DetectorSettings(transport=transport)
    return replace(
        settings,
        transport=transport,
        max_waiting=way.max_waiting,
        max_marks=ANY_NUMBER,
        autostart=way.autostart,
    )


def with_bag(
    data: dict[str, Any], bag: BagLines, unplayed: list[str], source: dict[str, str]
) -> dict[str, Any]:
    """Return the JSON form of a result with what the nodes could not see of the bag.

    No node can detect clock steps during fast replay, and messages stamped in the future were not
    played.

    Parameters
    ----------
    data : dict
        RESULT.json as the solver wrote it.
    bag : BagLines
        Problems of the bag.
    unplayed : list of str
        What could not be played, one line each.
    source : dict
        File and SHA-256 of the bag.
    """
    unplayed_only = [line for line in unplayed if line not in bag.faults]
    bag_warnings = [*bag.lost, *unplayed_only, *bag.clock]
    of_nodes = [line for line in data["warnings"] if line not in bag_warnings]
    refused = dict(sorted((data["rejected"] | bag.refused).items()))
    return with_digests(
        data
        | {"warnings": [*of_nodes, *bag_warnings], "rejected": refused, "input": source}
    )


def _play(
    args: argparse.Namespace,
    saved: Path,
    environment: dict,
    detector: DetectorSettings | None,
    *,
    printed_faults: Sequence[str],
) -> tuple[int, list[str]]:
    """Return the exit code of the session, and what it could not play, a line each.

    Lines that are in `printed_faults` are not printed again.
    """
    parameter_arguments = (
        ["--ros-args", "--params-file", args.params] if args.params else []
    )
    quiet = ["--ros-args", "--log-level", "warn"]
    rate = 0.0 if args.fast else args.rate
    cell = "" if args.namespace is None else f"/{args.namespace.strip('/')}"
    with contextlib.ExitStack() as stack:
        node_arguments = {
            "solver": ["--ros-args", "-p", f"result_folder:={saved.parent}"]
        }
        if detector is not None:
            file = saved.with_name("mark_detector.yaml")
            write_yaml(file, {detector.NODE: {"ros__parameters": asdict(detector)}})
            stack.enter_context(
                process(
                    f"selfcal_ros.nodes.{detector.NODE}",
                    ["--ros-args", "--params-file", str(file), *quiet],
                    environment,
                )
            )
        for node in NODES:
            stack.enter_context(
                process(
                    f"selfcal_ros.nodes.{node}",
                    [*parameter_arguments, *node_arguments.get(node, []), *quiet],
                    environment,
                )
            )
        session = stack.enter_context(
            process(
                "selfcal_ros.nodes.replay_session",
                [args.bag, str(rate), str(saved), cell, *quiet],
                environment,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        bar = stack.enter_context(progress_bar("replaying"))
        lost = []
        for line in session.stdout or ():
            word, _, tail = line.rstrip("\n").partition(" ")
            if word == "progress":
                done, total = tail.split()
                bar(int(done), int(total))
            elif word == "lost":
                lost.append(tail)
                if tail not in printed_faults:
                    warn(args, f"{args.bag}: {tail}")
        return session.wait(), lost
