# SPDX-License-Identifier: Apache-2.0
"""Shared by the sub-verbs of ``selfcal cal``: axes, units, pairs AXIS=VALUE."""

import argparse
import math
import re
from collections.abc import Container
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from selfcal_ros.errors import InputError
from selfcal_ros.units import M_PER

if TYPE_CHECKING:
    from selfcal_ros.aerotech.machine import MachineFrame
    from selfcal_ros.model.result import CalibrationResult


def pairs(texts: list[str] | None, option: str) -> dict[int, str]:
    """Return axis -> value of options AXIS=VALUE; InputError for anything else."""
    found: dict[int, str] = {}
    for text in texts or []:
        axis, equals, value = text.partition("=")
        if not (equals and axis.isascii() and axis.isdigit() and 1 <= int(axis[:9]) <= 32):
            raise InputError(option, f"'{text}' is not AXIS=VALUE with an axis from 1 to 32",
                             f"write {option} 1=10.5")
        if int(axis) in found:
            raise InputError(option, f"axis {int(axis)} is given twice", "keep one of them")
        found[int(axis)] = value
    return found


def numbers(texts: list[str] | None, option: str, *, positive: bool = False) -> dict[int, float]:
    """Return axis -> number of options AXIS=NUMBER; InputError for anything else."""
    from selfcal_ros.aerotech.header import SMALLEST, ArgumentFault, number

    found = {}
    for axis, text in pairs(texts, option).items():
        try:
            value = number(text)
        except ArgumentFault:
            value = math.nan
        if not value >= (SMALLEST if positive else -math.inf):
            raise InputError(option, f"'{text}' is not a {'positive ' * positive}number",
                             f"write {option} {axis}=1000")
        found[axis] = value
    return found


def in_unit(texts: list[str] | None, unit: str, *, rotary: Container[int] = ()) -> list[str]:
    """Return options AXIS=LENGTH with the length as a number in `unit`; others unchanged.

    Raises
    ------
    InputError
        For a length of an axis in `rotary`.
    """
    found = []
    for text in texts or []:
        match = re.fullmatch(r"(\d+)=([-+]?[\d.]+(?:[eE][-+]?\d{1,3})?) ?(m|mm|um|µm|nm)", text)
        if match is None:
            found.append(text)
            continue
        if int(match[1]) in rotary:
            raise InputError("--position", f"'{text}' is a length, and axis {match[1]} is rotary",
                             f"write {match[1]}=10.5, in its primary unit (deg)")
        factor = Fraction(str(M_PER[match[3].replace("µ", "u")])) / Fraction(str(M_PER[unit]))
        try:
            found.append(f"{match[1]}={float(Fraction(match[2]) * factor)!r}")
        except (ValueError, OverflowError):
            found.append(text)
    return found


def add_frame(parser: argparse.ArgumentParser, *, theta: bool, default: bool = True) -> None:
    """Add the options that relate the controller's axes to the stage frame."""
    group = parser.add_argument_group(
        "machine", "" if default else "default: from the comments of FILE.cal, else columns "
        "are x and rows are y")
    group.add_argument("--x-axis", type=int, metavar="N", default=1 if default else None,
                       help="index of the x axis, from 1")
    group.add_argument("--y-axis", type=int, metavar="N", default=2 if default else None,
                       help="index of the y axis")
    group.add_argument("--unit", choices=("m", "mm", "um"), default="mm" if default else None,
                       help="primary unit of the linear axes (default mm)")
    for axis, unit in (("x", "primary unit"), ("y", "primary unit"), ("theta", "deg")):
        if axis == "theta" and not theta:
            continue
        group.add_argument(f"--home-{axis}", type=float, metavar="P", default=None,
                           help=f"position of the controller's zero in the stage frame, {unit} "
                                "(default 0, the centre of the field)")
        group.add_argument(f"--reverse-{axis}", action="store_true",
                           help=f"the encoder counts opposite to the stage frame's {axis}")
    if theta:
        group.add_argument("--theta-axis", type=int, metavar="N", help="index of the theta axis")
        group.add_argument("--counts-per-unit", action="append", metavar="AXIS=COUNTS",
                           help="encoder counts per degree of the theta axis")


def frame_of(args: argparse.Namespace, base: "MachineFrame | None" = None) -> "MachineFrame":
    """Return the frame described by the options, with `base` as default."""
    from dataclasses import replace

    from selfcal_ros.aerotech.machine import UNITS_M, MachineFrame

    base = base or MachineFrame()
    changes: dict[str, Any] = {
        name: getattr(args, name) for name in ("x_axis", "y_axis", "theta_axis", "unit")
        if getattr(args, name, None) is not None}
    unit_m = UNITS_M[changes.get("unit", base.unit)]
    for name in ("x", "y", "theta"):
        home = getattr(args, f"home_{name}", None)
        if home is not None and not math.isfinite(home):
            raise InputError(f"--home-{name}", f"{home} is not a position", "give a number")
        if home is not None and name == "theta":
            changes["home_theta_rad"] = math.radians(home)
        elif home is not None:
            changes[f"home_{name}_m"] = home * unit_m
        if getattr(args, f"reverse_{name}", False):
            changes[f"reverse_{name}"] = True
    for name in ("x_axis", "y_axis", "theta_axis"):
        if not 1 <= changes.get(name, 1) <= 32:
            raise InputError(f"--{name.replace('_', '-')}", f"{changes[name]} is not in 1..32",
                             "indices in calibration files count from 1")
    counts = numbers(getattr(args, "counts_per_unit", None), "--counts-per-unit", positive=True)
    theta_axis = changes.get("theta_axis", base.theta_axis)
    for name in ("home_theta_rad", "reverse_theta"):
        if name in changes and theta_axis is None:
            raise InputError(f"--{name.removesuffix('_rad').replace('_', '-')}",
                             "there is no theta axis", "name --theta-axis")
    for axis, count in counts.items():
        if axis != theta_axis:
            raise InputError("--counts-per-unit", f"axis {axis} is not the theta axis",
                             f"write {theta_axis}={count:g}" if theta_axis else "name --theta-axis")
        changes["theta_counts_per_unit"] = count
    return replace(base, **changes)


def read_result(path: str) -> "CalibrationResult":
    """Return the result in a RESULT.json; InputError if it is invalid."""
    from selfcal_ros.files import read_json
    from selfcal_ros.model.result import result_from_dict

    return result_from_dict(read_json(path), path)
