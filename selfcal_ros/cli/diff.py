# SPDX-License-Identifier: Apache-2.0
"""``selfcal diff``: compare two calibrations, or a calibration and a laser measurement."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from selfcal_ros.cli.terminal import busy, save_drawing, say, say_unless_qualified, tell
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.comparison.covariance import plate_as_map
from selfcal_ros.estimation.comparison.maps import (
    LaserDifference,
    MapDifference,
    compare,
    compare_with_laser,
)
from selfcal_ros.files import read_json
from selfcal_ros.model.recheck import Significance
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import check_outputs, plain
from selfcal_ros.reporting.figures.maps import difference_picture
from selfcal_ros.reporting.summary.numbers import p_text, with_u
from selfcal_ros.reporting.summary.sections import enlargement_texts
from selfcal_ros.results import read_result
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M, URAD_PER_RAD


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("a", metavar="A.json", help="RESULT.json of `selfcal solve`")
    parser.add_argument(
        "b",
        metavar="B.json",
        help="another RESULT.json, or the OUT.json of "
        "`selfcal step-diagonal`: then squareness and scale are compared",
    )
    parser.add_argument(
        "--keep-scale",
        action="store_true",
        help="keep the magnification: both maps have a reference length",
    )
    parser.add_argument(
        "--artifact",
        action="store_true",
        help="compare the maps of the plates rather than those of the stages",
    )
    parser.add_argument(
        "--plot",
        metavar="FILE.png|.svg|.pdf",
        help="draw both maps and their difference side by side",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Compare and print."""
    check_outputs([args.a, args.b], [args.plot])
    a, second = read_result(args.a), read_json(args.b)
    if isinstance(second, dict) and "ex_x" in second:
        return _compare_with_laser(args, a, second)
    b = read_result(args.b)
    if args.keep_scale:
        for name, result in ((args.a, a), (args.b, b)):
            if result.reference is None:
                raise InputError(
                    "--keep-scale",
                    f"{name} has no reference length, so its magnification is unknown",
                    "omit it, or solve with --reference",
                )
    with busy("comparing"):
        difference = compare(
            a,
            b,
            keep_scale=args.keep_scale,
            plates=args.artifact,
            names=(args.a, args.b),
        )
    if args.plot:
        _draw(args, a, b, difference)
    say(
        args,
        _text(difference, _grades_text([a, b]), args.artifact),
        {**_json(difference), **_grades([a, b])},
    )
    datums = [result.error_map.datum_theta for result in (a, b)]
    of_theta = difference.theta is not None and not args.artifact
    if of_theta and datums[0] != datums[1] and not args.json:
        tell(
            f"       theta datums differ: {datums[0]} and {datums[1]}; xy_axes also ties four "
            "lines to the XY axes"
        )
    for name, result in ((args.a, a), (args.b, b)):
        say_unless_qualified(result, f"selfcal diff: {name}")
    return ExitCode.DONE


def _compare_with_laser(
    args: argparse.Namespace, result: CalibrationResult, laser: dict[str, Any]
) -> int:
    """Compare a map with the diagonals of a laser, and print."""
    if args.keep_scale:
        raise InputError(
            "--keep-scale",
            f"for {args.b} squareness and scale difference are compared, not the magnification",
            "omit it",
        )
    for option in ("plot", "artifact"):
        if getattr(args, option):
            raise InputError(
                f"--{option}", f"{args.b} has no map", "name two RESULT.json"
            )
    rows = compare_with_laser(result, laser, args.b)
    say(
        args,
        "\n".join([_laser_text(rows), *_grades_text([result])]),
        {**_laser_json(rows), **_grades([result])},
    )
    say_unless_qualified(result, f"selfcal diff: {args.a}")
    return ExitCode.DONE


def _draw(
    args: argparse.Namespace,
    a: CalibrationResult,
    b: CalibrationResult,
    difference: MapDifference,
) -> None:
    """Draw the difference of two maps, or of two plates."""
    map_a, map_b = (plate_as_map(a), plate_as_map(b)) if args.artifact else (a, b)
    shown = {
        "gx": difference.dx,
        "gy": difference.dy,
        "g_theta": difference.d_theta,
    }
    picture = difference_picture(map_a, map_b, shown, _verdict_text(difference))
    save_drawing(picture, args.plot)


def _grades(results: Sequence[CalibrationResult]) -> dict[str, Any]:
    """Return grade and enlargements of the results A and B."""
    named = dict(zip("ab", (result.verdict for result in results), strict=False))
    return plain(
        {
            "grade": {name: str(verdict.grade) for name, verdict in named.items()},
            "enlarged_by": {
                name: [vars(item) for item in verdict.enlarged_by]
                for name, verdict in named.items()
            },
        }
    )


def _grades_text(results: Sequence[CalibrationResult]) -> list[str]:
    return [
        f"{name}      grade: "
        + "; ".join(
            [
                str(result.verdict.grade).replace("_", " "),
                *enlargement_texts(result.verdict),
            ]
        )
        for name, result in zip("AB", results, strict=False)
    ]


def _json(difference: MapDifference) -> dict[str, Any]:
    return plain(
        {
            "significant": difference.significant,
            "rms_um": difference.rms_m * UM_PER_M,
            "max_um": difference.max_m * UM_PER_M,
            "rms_theta_arcsec": difference.rms_theta_rad * ARCSEC_PER_RAD,
            "max_theta_arcsec": difference.max_theta_rad * ARCSEC_PER_RAD,
            "datum_difference": {
                "translation_x": difference.translation_m[0],
                "translation_y": difference.translation_m[1],
                "rotation": difference.rotation_rad,
                "scale": difference.scale,
                "theta": difference.theta_rad,
            },
            "nonorthogonality": difference.nonorthogonality,
            "scale_difference": difference.scale_difference,
            "significance_xy": None if difference.xy is None else asdict(difference.xy),
            "significance_theta": None
            if difference.theta is None
            else asdict(difference.theta),
            "dx": difference.dx,
            "dy": difference.dy,
            "d_theta": difference.d_theta,
        }
    )


def _text(difference: MapDifference, grades: Sequence[str], plates: bool) -> str:
    tx, ty = difference.translation_m
    lines = [
        f"B minus A{', plates' if plates else ''}, datum difference removed: "
        f"translation ({_signed(tx * UM_PER_M)}, {_signed(ty * UM_PER_M)}) µm, "
        f"rotation {_signed(difference.rotation_rad * ARCSEC_PER_RAD)} arcsec, scale "
        f"{_signed(difference.scale * UM_PER_M)} µm/m"
        + (
            ""
            if math.isnan(difference.theta_rad)
            else f", theta {_signed(difference.theta_rad * ARCSEC_PER_RAD)} arcsec"
        ),
        f"XY     rms {difference.rms_m * UM_PER_M:.5f} µm per axis   largest "
        f"{difference.max_m * UM_PER_M:.5f} µm on an axis",
        *_test_text(difference.xy),
        f"       non-orthogonality {_signed(difference.nonorthogonality * URAD_PER_RAD)} µrad, "
        f"scale difference {_signed(difference.scale_difference * UM_PER_M)} µm/m",
    ]
    if not math.isnan(difference.rms_theta_rad):
        lines += [
            f"theta  rms {difference.rms_theta_rad * ARCSEC_PER_RAD:.4f} arcsec   "
            f"largest {difference.max_theta_rad * ARCSEC_PER_RAD:.4f} arcsec",
            *_test_text(difference.theta),
        ]
    return "\n".join([*lines, *grades, _verdict_text(difference)])


def _signed(value: float) -> str:
    """Return a number with its sign; rounding error is shown as zero."""
    return f"{round(value, 6) + 0.0:+.4g}"


def _test_text(test: Significance | None) -> list[str]:
    """Return both tests of a difference, one line each."""
    if test is None:
        return ["       no uncertainties to test against"]
    doubt = "" if test.correlated else "; correlations between nodes unknown"
    return [
        f"       Mahalanobis distance^2/dof {test.chi2_ratio:.3f}, {test.dof:.0f} dof, "
        f"{p_text(test.p)}{doubt}",
        f"       largest |z| {test.largest_z:.2f}, limit {test.z_limit:.2f}, {p_text(test.p_z)}",
    ]


def _verdict_text(difference: MapDifference) -> str:
    tests = {"XY": difference.xy, "theta": difference.theta}
    if difference.significant is None:
        return "verdict: none, no uncertainties to test against"
    differ = [
        name for name, test in tests.items() if test is not None and test.significant
    ]
    if differ:
        return f"verdict: significant, the maps differ in {' and '.join(differ)}"
    return "verdict: not significant, the maps agree within their uncertainties"


def _laser_json(rows: Sequence[LaserDifference]) -> dict[str, Any]:
    return plain(
        {
            row.name: {
                "map": row.of_map,
                "laser": row.of_laser,
                "difference": row.difference,
                "u": row.u,
                "p": row.p,
            }
            for row in rows
        }
    )


def _laser_text(rows: Sequence[LaserDifference]) -> str:
    lines = ["first-order terms, map and laser:"]
    for row in rows:
        unit = "µrad" if row.name == "nonorthogonality" else "µm/m"
        difference = with_u(row.difference * UM_PER_M, row.u * UM_PER_M, sign="+")
        test = "" if math.isnan(row.u) else f" (k=1), {p_text(row.p)}"
        lines.append(
            f"  {row.name.replace('_', ' ')}: {row.of_map * UM_PER_M:+.4g} and "
            f"{row.of_laser * UM_PER_M:+.4g} {unit}, difference "
            f"{difference} {unit}{test}"
        )
    return "\n".join(lines)
