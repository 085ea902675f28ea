# SPDX-License-Identifier: Apache-2.0
"""``selfcal camera init``: size of the pixels, turn and mirror from a few moves of the stage."""

import argparse
import math
from pathlib import Path

import numpy as np

from selfcal_ros.bagio.exposure_table import read_positions
from selfcal_ros.bagio.images import ImageBag, encoder_track
from selfcal_ros.cli.terminal import add_json, say, warn
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.files import read_bytes, write_yaml
from selfcal_ros.model.readings import Sense
from selfcal_ros.reporting.summary.numbers import with_u
from selfcal_ros.settings.detector import ANY_NUMBER, DetectorSettings
from selfcal_ros.units import M_PER_UM
from selfcal_ros.vision.camera_pose import SHORT, CameraPose, camera_pose, require_size
from selfcal_ros.vision.detector import LARGEST_SIZE, SMALLEST_SIZE, rejected_text
from selfcal_ros.vision.exposures import ImageDetector

SIZE_OPTION = "--mark-pixels"
"""Option that states the size of a mark in the image."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    init = parser.add_subparsers(
        dest="camera_verb", metavar="init", required=True
    ).add_parser(
        "init",
        help="from a few moves of the stage",
        description="Follows marks in images taken "
        f"while the stage stands at a few positions in x and y, {SHORT} apart, and writes the "
        "parameters of mark_detector.",
    )
    init.add_argument(
        "bag",
        metavar="BAG",
        help="bag with images and joint states; with --positions the folder of image files",
    )
    init.add_argument(
        "--positions",
        metavar="FILE.csv",
        help="table of the image files and indicated positions: file, x, y (m)",
    )
    init.add_argument(
        "-o",
        "--output",
        metavar="NODES.yaml",
        required=True,
        help="ROS parameter file to write",
    )
    init.add_argument(
        "--mark",
        choices=("disc", "ring", "cross", "corner"),
        default="disc",
        help="kind of mark (default: disc)",
    )
    init.add_argument(
        "--mark-size",
        type=float,
        metavar="M",
        required=True,
        help="size of the marks on the plate, m (as in selfcal detect)",
    )
    init.add_argument(
        SIZE_OPTION,
        type=float,
        metavar="PX",
        required=True,
        help="size of a mark in the image, pixels, to a tenth",
    )
    init.add_argument(
        "--polarity",
        choices=("dark", "bright"),
        default="dark",
        help="marks against the background (default: dark)",
    )
    init.add_argument(
        "--sense",
        choices=("microscope_moves", "plate_moves"),
        default="microscope_moves",
        help="what moves (default: microscope_moves)",
    )
    add_json(init)


def run(args: argparse.Namespace) -> int:
    """Follow the marks, print the camera, write the parameters."""
    require_pixels(args.mark_pixels)
    if not args.mark_size > 0:
        raise InputError(
            "--mark-size", f"{args.mark_size:g} is not a size", "give it in m"
        )
    settings = DetectorSettings.checked(
        {  # offsets in pixels
            "pixel_size": 1.0,
            "mark_size": float(args.mark_pixels),
            "mark": args.mark,
            "polarity": args.polarity,
            "max_marks": ANY_NUMBER,
        },
        SIZE_OPTION,
    )
    detector = ImageDetector(settings, SIZE_OPTION)
    positions, images = (_of_files if args.positions else _of_bag)(args, detector)
    counts = detector.counts
    if counts.empty:
        warn(
            args,
            f"{args.bag}: {counts.empty} of {counts.images} images show no mark "
            f"and are left out{rejected_text(counts.rejected)}",
        )
    camera = camera_pose(positions, images, Sense(args.sense))
    require_size(
        camera,
        mark_size_m=args.mark_size,
        mark_pixels=args.mark_pixels,
        where=args.positions or args.bag,
    )
    values = {
        "pixel_size": camera.pixel_size_m,
        "turn": math.degrees(camera.turn_rad),
        "mirror": camera.mirror,
        "mark": args.mark,
        "mark_size": args.mark_size,
        "polarity": args.polarity,
    }
    write_yaml(args.output, {"mark_detector": {"ros__parameters": values}})
    say(
        args,
        pose_text(camera, args.output),
        {
            "file": args.output,
            **values,
            "u_pixel_size": camera.u_pixel_size_m,
            "u_turn": math.degrees(camera.u_turn_rad),
            "sheared": camera.sheared,
            "u_sheared": camera.u_sheared,
            "noise_px": camera.noise_px,
        },
    )
    return 0


def require_pixels(size_px: float) -> None:
    """Refuse a size of a mark in pixels in which none is found."""
    if not SMALLEST_SIZE <= size_px <= LARGEST_SIZE:
        raise InputError(
            SIZE_OPTION,
            f"{size_px:g} is not a size of a mark in pixels",
            f"give {SMALLEST_SIZE:g} to {LARGEST_SIZE:g}",
        )


def pose_text(camera: CameraPose, output: str) -> str:
    """Return a camera in one line."""
    size = with_u(camera.pixel_size_m / M_PER_UM, camera.u_pixel_size_m / M_PER_UM)
    turn = with_u(math.degrees(camera.turn_rad), math.degrees(camera.u_turn_rad))
    return (
        f"{output}: pixel size {size} µm, turn {turn}° (k=1), "
        f"{'mirrored' if camera.mirror else 'not mirrored'}; axes unequal or sheared by "
        f"{with_u(camera.sheared, camera.u_sheared)}; noise of a mark "
        f"{camera.noise_px:.2g} pixels"
    )


def _of_bag(
    args: argparse.Namespace, detector: ImageDetector
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return stage positions and marks of each image of a bag."""
    stamps, track = encoder_track(args.bag)
    exposed, images = [], []
    bag = ImageBag(Path(args.bag))
    for item in bag.items():
        if item.image is not None:
            marks = detector.take(item.image)
            if marks:
                exposed.append(marks[0].stamp_ns)
                images.append(
                    np.array([(mark.offset_x, mark.offset_y) for mark in marks])
                )
    for line, count in bag.lost.items():
        warn(args, f"{args.bag}: {count} x {line}")
    detector.refuse_nothing(args.bag, SIZE_OPTION)
    if not len(stamps):
        raise NoDataError(
            args.bag, "no stage/joint_states", "record them with the images"
        )
    if min(exposed) < stamps[0] or max(exposed) > stamps[-1]:
        raise InputError(
            args.bag,
            "an image was taken before the first or after the last sample of the encoders",
            "record the joint states around all images",
        )
    return np.stack(
        [np.interp(exposed, stamps, axis) for axis in track.T], axis=1
    ), images


def _of_files(
    args: argparse.Namespace, detector: ImageDetector
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return stage positions and marks of each image of a folder."""
    positions, images = [], []
    for number, row in enumerate(read_positions(args.positions, None)):
        marks = detector.take_file(
            read_bytes(Path(args.bag) / row.file), row.file, number
        )
        if marks:
            positions.append((row.x_m, row.y_m))
            images.append(np.array([(mark.offset_x, mark.offset_y) for mark in marks]))
    detector.refuse_nothing(args.bag, SIZE_OPTION)
    return np.array(positions).reshape(-1, 2), images
