# SPDX-License-Identifier: Apache-2.0
"""``selfcal detect``: marks in the images of a bag, or in a table, written as detections."""

import argparse
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from selfcal_ros.bagio.exposure_table import (
    read_positions,
    read_readings,
    write_pictures,
    write_readings,
)
from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.offline import TRUTH_FILE
from selfcal_ros.cli.terminal import (
    add_json,
    add_parameters,
    given,
    node_settings,
    say,
    warn,
)
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_bytes
from selfcal_ros.model.view import Plan
from selfcal_ros.outputs import creating, write_bytes
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.settings.detector import ANY_NUMBER, OPTIONS, DetectorSettings
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.parameter import TYPED
from selfcal_ros.vision.detector import Judged
from selfcal_ros.vision.drawing import circled
from selfcal_ros.vision.exposures import ImageDetector
from selfcal_ros.vision.images import Picture

SHOWN = 5
"""Number of problems that are printed."""
WITH_IDS = OPTIONS | {"aruco": "aruco"}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "bag",
        metavar="BAG|READINGS.csv",
        help="bag with stage/image or "
        "stage/image/compressed; with --positions the folder of image files; or a table of "
        "readings (docs/start/readings.md)",
    )
    parser.add_argument(
        "--positions",
        metavar="FILE.csv",
        help="table of the image files and indicated positions: file, view, x, y (m)",
    )
    parser.add_argument(
        "--plan",
        metavar="PLAN.yaml",
        help="plan with plate and views, needed with --positions and for a table of readings",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="BAG",
        required=True,
        help="bag folder to create: the detections and all other topics, without the images",
    )
    add_parameters(parser, DetectorSettings, WITH_IDS)
    parser.add_argument(
        "--params",
        metavar="NODES.yaml",
        help="ROS parameter file; the section of mark_detector is used",
    )
    parser.add_argument(
        "--namespace",
        metavar="NAME",
        help="namespace of the camera, for bags with several cells; / is the root",
    )
    parser.add_argument(
        "--draw",
        metavar="FOLDER",
        help="new folder: write each image there as PNG, with "
        "circles around what was found, squares and reasons around the rejected",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Detect, write the bag and print what was found."""
    if args.bag.lower().endswith(".csv"):
        return _from_table(args)
    settings = replace(
        node_settings(args.params, DetectorSettings, **given(args, WITH_IDS)),
        max_marks=ANY_NUMBER,
    )
    draw = partial(_drawn, _empty(args.draw), settings) if args.draw else None
    detector = ImageDetector(settings, args.params or TYPED, draw)
    if args.positions:
        problems = _from_files(args, detector, settings)
    else:
        images = ImageBag(Path(args.bag), args.namespace)
        if settings.aruco:
            for plate in images.plates():
                settings.require_plate(plate, args.params or TYPED)
        problems = images.write_detected(
            args.output,
            detector.take,
            check=partial(detector.refuse_nothing, args.bag),
            frame_id=settings.frame_id,
        )
    truth = Path(args.bag, TRUTH_FILE)
    if truth.is_file():
        write_bytes(Path(args.output, TRUTH_FILE), read_bytes(truth))
    for line, count in problems.most_common(SHOWN):
        warn(args, f"{args.bag}: {f'{count} x ' if count > 1 else ''}{line}")
    counts = detector.counts.values()
    say(
        args,
        text_of(args.output, counts),
        {"bag": args.output, "counts": counts, "problems": dict(problems)},
    )
    return 0


def _from_table(args: argparse.Namespace) -> int:
    """Write a bag from a table of readings."""
    of_images = {
        "--positions": args.positions,
        "--draw": args.draw,
        "--params": args.params,
        "--namespace": args.namespace,
        **{f"--{option}": getattr(args, option) for option in WITH_IDS},
    }
    for option, value in of_images.items():
        if value is not None:
            raise InputError(
                option.replace("_", "-"),
                f"is of images, and {args.bag} is a table of readings",
                "leave it out",
            )
    plan = _plan(args, args.bag)
    rows = read_readings(args.bag, plan)
    write_readings(rows, plan, args.output, frame_id=DetectorSettings().frame_id)
    text = f"{args.output}: {counted(len(rows), 'reading')}"
    say(args, text, {"bag": args.output, "readings": len(rows)})
    return 0


def _plan(args: argparse.Namespace, of_what: str) -> Plan:
    """Return the plan behind a table."""
    if not args.plan:
        raise InputError(of_what, "the plan is missing", "give --plan PLAN.yaml")
    return read_plan(args.plan)


def _from_files(
    args: argparse.Namespace, detector: ImageDetector, settings: DetectorSettings
) -> Counter[str]:
    """Write a bag from image files and a table of positions; return problems."""
    plan = _plan(args, "--positions")
    settings.require_plate(plan.artifact, args.params or TYPED)
    return write_pictures(
        Path(args.bag),
        read_positions(args.positions, plan),
        plan,
        args.output,
        detect=detector.take_file,
        check=partial(detector.refuse_nothing, args.bag),
        frame_id=settings.frame_id,
    )


def _empty(name: str) -> Path:
    """Return a folder for pictures.

    Raises
    ------
    InputError
        If it has files: those of the camera may have the same names.
    """
    folder = Path(name)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(
            name, "has files, which pictures could replace", "name another folder"
        )
    return folder


def _drawn(
    folder: Path,
    settings: DetectorSettings,
    name: str,
    picture: Picture,
    judged: Sequence[Judged],
) -> None:
    """Write an image with what was found and what was rejected in it, under its own name."""
    size = settings.mark_size / settings.pixel_size
    with creating(folder):
        folder.mkdir(parents=True, exist_ok=True)
    # a.png and a.tif, or one name in two folders, are two pictures
    flat = name.strip("/").replace("/", "_").removesuffix(".png")
    write_bytes(folder / f"{flat}.png", circled(picture.values, judged, size))


def text_of(output: str, counts: dict[str, int]) -> str:
    """Return the numbers of images and marks as a line."""
    rejected = ", ".join(
        f"{count} {name.removeprefix('rejected_')}"
        for name, count in counts.items()
        if name.startswith("rejected_")
    )
    extra_counts = [
        f"{counted(counts[name], 'image')} {text}"
        for name, text in (
            ("images_without_marks", "without marks"),
            (
                "images_with_contradicting_markers",
                "without ids: markers do not lie as on this plate",
            ),
            ("images_refused", "refused"),
            (
                "images_repeated",
                "shown before, under another stamp: no repeats",
            ),
            (
                "images_with_more_pages",
                "with further pages, which were not used",
            ),
        )
        if counts.get(name)
    ]
    named = counts.get("marks_with_ids")
    ids = "" if named is None else f", {named} with their ids"
    return "; ".join(
        [
            f"{output}: {counted(counts['marks'], 'mark')} in "
            f"{counted(counts['images'], 'image')}{ids}",
            *([f"rejected: {rejected}"] if rejected else []),
            *extra_counts,
        ]
    )
