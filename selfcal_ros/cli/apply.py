# SPDX-License-Identifier: Apache-2.0
"""``selfcal apply``: commands for true positions, or true positions of indicated ones."""

import argparse

import numpy as np

from selfcal_ros.apply import StageMap, load
from selfcal_ros.cli.deliver import csv_text, deliver
from selfcal_ros.cli.terminal import add_json, add_result, file_of, warn
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.files import csv_rows, read_text
from selfcal_ros.model.error_map import rms
from selfcal_ros.outputs import check_outputs
from selfcal_ros.plain_numbers import number_of
from selfcal_ros.reporting.summary.numbers import counted
from selfcal_ros.units import MM_PER_M, UM_PER_M

FAR = 10.0
"""Half fields beyond which positions are in another unit."""
AXES = ("x", "y", "theta")
ENDS = ("x1", "y1", "x2", "y2")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    add_result(parser)
    parser.add_argument(
        "points",
        metavar="POINTS.csv",
        help="columns x,y or x,y,theta in m and rad, stage frame; x1,y1,x2,y2: "
        "the error of the distance between two points",
    )
    parser.add_argument(
        "-o",
        "--output",
        metavar="OUT.csv",
        required=True,
        help="table to write: the points, the corrected ones, and their standard "
        "uncertainties (empty = unknown); - = stdout",
    )
    parser.add_argument(
        "--inverse",
        action="store_true",
        help="the points are indicated positions: give the true ones",
    )
    parser.add_argument(
        "--method",
        choices=("bilinear", "bicubic"),
        help="interpolation between the nodes (default: that of the map; "
        "bilinear on the plate's lattice, or if nodes are unknown)",
    )
    parser.add_argument(
        "--outside",
        choices=("empty", "edge", "refuse"),
        default="empty",
        help="points outside the field, where u is not known: leave them empty "
        "and end with code 5 (default), use the error at the edge of the field, or "
        "refuse",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Read result and points, write the corrected points.

    A result that is not qualified ends with code 5 and the reason on stderr, as in `solve`; so
    do points outside the field that are left empty.
    """
    check_outputs([args.result, args.points], [file_of(args)])
    stage = load(
        args.result,
        method=args.method,
        outside="refuse" if args.outside == "refuse" else "clamp",
    )
    points = read_points(read_text(args.points), args.points)
    edge = args.outside == "edge"
    refuse_other_unit(stage, points, args.points)
    table = distances if points.shape[1] == len(ENDS) else corrected
    text, unknown, outside = table(args, stage, points)
    _say_better(args, stage, points)
    treatment = (
        "corrected as the nearest point of its edge, where u is not known"
        if edge
        else "left empty (--outside edge corrects them as the nearest point of its edge)"
    )
    for count, what in (
        (outside, f"outside the field, {treatment}"),
        (unknown, "next to unknown sites or lines, left empty"),
    ):
        if count:
            warn(args, f"points {what}: {count}")
    code = deliver(
        args,
        stage.result,
        text,
        "csv",
        note=f", {counted(len(points), 'point')}",
        points=len(points),
        unknown=unknown,
        outside=outside,
    )
    return ExitCode.NOT_QUALIFIED if outside and not edge else code


def refuse_other_unit(stage: StageMap, points: np.ndarray, where: str) -> None:
    """Refuse points that all lie outside the field, and some of them far.

    The origin is in the field in any unit.

    Raises
    ------
    InputError
        With the field, and the question whether the points are in mm.
    """
    places = points.reshape(-1, 2) if points.shape[1] == len(ENDS) else points[:, :2]
    is_origin = ~places.any(axis=1)
    places = places[~is_origin]
    plate = stage.error_map.artifact
    half = np.array(plate.half) * plate.grid_pitch_m
    beyond = (np.abs(places) / half).max(axis=1, initial=0.0)
    if not len(places) or stage.inside(*places.T).any() or beyond.max() <= FAR:
        return
    x, y = half * MM_PER_M
    farthest = places[beyond.argmax()]
    raise InputError(
        where,
        f"all points{' but the origin' * bool(is_origin.any())} lie outside the field (x from "
        f"{-x:g} to {x:g} mm, y from {-y:g} to {y:g} mm), up to ({farthest[0]:g}, "
        f"{farthest[1]:g}) m: is it in mm?",
        "give positions in m, in the stage frame",
    )


def _say_better(args: argparse.Namespace, stage: StageMap, points: np.ndarray) -> None:
    """Recommend bicubic interpolation if it at least halves u between the nodes."""
    emap = stage.error_map
    used = rms(stage.halfway)
    x, y = points[:, :2].T
    plain = np.array(stage.uncertainty(x, y)) if used else np.zeros(1)
    if (
        stage.method == "bicubic"
        or not emap.valid.all()
        or not rms(plain) > 2 * rms(emap.u_xy)
    ):
        return
    cubic = rms(Compensator(emap, method="bicubic").halfway)
    if cubic < used / 2:
        warn(
            args,
            "between the nodes u is mostly that of bilinear interpolation, "
            f"{used * UM_PER_M:.2g} µm halfway; with --method bicubic {cubic * UM_PER_M:.2g} µm",
        )


def read_points(text: str, where: str) -> np.ndarray:
    """Return the points of a table x,y[,theta] or x1,y1,x2,y2, (P, 2 to 4).

    Raises
    ------
    InputError
        For another header, or a line that is not as many finite numbers.
    """
    rows = csv_rows(text, where)
    head = [cell.lower() for cell in rows[0][1]] if rows else []
    if tuple(head) not in (AXES, AXES[:2], ENDS):
        raise InputError(
            rows[0][0] if rows else f"{where}:1",
            "the header is not x,y or x,y,theta or x1,y1,x2,y2",
            "begin with one of them, without other columns; positions in m and rad",
        )
    points = np.empty((len(rows) - 1, len(head)))
    for index, (place, cells) in enumerate(rows[1:]):
        try:
            points[index] = (
                list(map(number_of, cells)) if len(cells) == len(head) else np.nan
            )
        except ValueError:
            points[index] = np.nan
        if not np.abs(points[index]).max() < 1e12:
            hint = "with decimal points, " * (len(cells) == 2 * len(head))
            raise InputError(
                place,
                f"not {len(head)} positions: '{','.join(cells):.60}'",
                f"give {','.join(head)} {hint}in m and rad",
            )
        if tuple(head) == ENDS and (points[index, :2] == points[index, 2:]).all():
            raise InputError(
                place, "the ends of the distance coincide", "give two points"
            )
    if not len(points):
        raise InputError(where, "it has no points", "give at least one")
    if "theta" in head and (largest := np.abs(points[:, 2]).max()) > 2 * np.pi:
        raise InputError(
            where,
            f"theta up to {largest:g} rad, more than a turn: is it in degrees?",
            "give theta in rad, within a turn",
        )
    return points


def corrected(
    args: argparse.Namespace, stage: StageMap, points: np.ndarray
) -> tuple[str, int, int]:
    """Return the table of corrected points, and how many are unknown and outside the field.

    Those outside are left empty, or corrected as the nearest point of the field.
    """
    inverse = args.inverse
    names = AXES[: points.shape[1]]
    what = "true" if inverse else "command"
    x, y, *theta = points.T
    corrected_axes = list(stage.correct(x, y) if inverse else stage.command(x, y))
    u = list((stage.uncertainty_indicated if inverse else stage.uncertainty)(x, y))
    outside = ~stage.inside(x, y)
    if inverse:
        outside &= ~stage.inside(corrected_axes[0], corrected_axes[1])
    if theta:
        corrected_axes.append(
            (stage.correct_theta if inverse else stage.command_theta)(theta[0])
        )
        u.append(stage.uncertainty_theta(corrected_axes[2] if inverse else theta[0]))
    unknown = int((np.isnan(corrected_axes).any(axis=0) & ~outside).sum())
    if args.outside != "edge":
        corrected_axes[:2] = (
            np.where(outside, np.nan, axis) for axis in corrected_axes[:2]
        )
    head = [
        *names,
        *(f"{name}_{what}" for name in names),
        *(f"u_{name}" for name in names),
    ]
    return (
        csv_text(head, np.column_stack([points, *corrected_axes, *u]).tolist()),
        unknown,
        int(outside.sum()),
    )


def distances(
    args: argparse.Namespace, stage: StageMap, points: np.ndarray
) -> tuple[str, int, int]:
    """Return the table of distances with their errors, as `corrected`; and a line over length."""
    if args.inverse:
        raise InputError(
            "--inverse", "the ends of distances are true positions", "leave it out"
        )
    x1, y1, x2, y2 = points.T
    error, u = stage.length_error((x1, y1), (x2, y2))
    outside = ~(stage.inside(x1, y1) & stage.inside(x2, y2))
    if args.outside != "edge":
        error = np.where(outside, np.nan, error)
    for where, anywhere in (("anywhere in the field", True), ("of two nodes", False)):
        a, b = stage.length_uncertainty(anywhere=anywhere)
        warn(
            args,
            f"U of a distance L {where} is at most {a * UM_PER_M:.3g} µm + "
            f"{b * UM_PER_M:.3g} µm/m L (k = {stage.result.noise.k_xy:.3g}, 95.45 %)",
        )
    rows = np.column_stack([points, np.hypot(x2 - x1, y2 - y1), error, u])
    unknown = int((np.isnan(error) & ~outside).sum())
    return (
        csv_text([*ENDS, "length", "error", "u"], rows.tolist()),
        unknown,
        int(outside.sum()),
    )
