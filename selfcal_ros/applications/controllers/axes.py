# SPDX-License-Identifier: Apache-2.0
"""Tables over one axis each: LinuxCNC's COMP_FILE, Siemens' CEC.

They cannot hold a whole map. The part that they can hold is the least-squares one: the mean over
the other axis for a table of one axis, and for a sum of tables a(x) + b(y) the means over both.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.applications.controllers.grid import (
    Grid,
    Source,
    Wiring,
    filled,
    fixed,
    lines_of,
    nodes,
    numbers,
    spacing,
    wanted,
)
from selfcal_ros.applications.controllers.planes import Texts
from selfcal_ros.compensation.export import decimal
from selfcal_ros.compensation.residual import Correction
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap

MAX_LINES = 256
"""LinuxCNC: entries of a joint."""
CEC_KEYS = (
    "INPUT_AXIS",
    "OUTPUT_AXIS",
    "STEP",
    "MIN",
    "MAX",
    "DIRECTION",
    "MULT_BY_TABLE",
    "IS_MODULO",
)


def _means(error_map: ErrorMap, wiring: Wiring) -> tuple[tuple, list[tuple]]:
    """Return the nodes, and of cx and cy the means over y (nx,), those over x (ny,), the mean."""
    x, y = nodes(error_map, wiring.frame)
    fields = wanted(error_map, wiring)(*np.meshgrid(x, y, indexing="ij"))
    return (x, y), [(c.mean(axis=1), c.mean(axis=0), c.mean()) for c in fields]


def write_linuxcnc(error_map: ErrorMap, wiring: Wiring) -> Texts:
    """Return a COMP_FILE for each joint, type 0: nominal, forward, reverse.

    The controller adds nominal - forward, so forward = nominal - c. The correction at its zero is
    subtracted, which shifts all positions by a constant, no part of a calibration: a jump of c
    after homing would lie in the dead band of the controller's ramp and never be applied.
    """
    (x, y), [(cx, *_), (_, cy, _)] = _means(error_map, wiring)
    files = {}
    unit_m = wiring.frame.unit_m
    for name, positions, values in (("x", x, cx), ("y", y, cy)):
        at = positions
        if len(at) > MAX_LINES:
            at = np.linspace(positions[0], positions[-1], MAX_LINES)
        values = values - np.interp(0.0, at, np.interp(at, positions, values))
        files[name] = [
            " ".join((fixed(p, unit_m), *[fixed(p - c, unit_m)] * 2))
            for p, c in zip(at, np.interp(at, positions, values), strict=True)
        ]
    return files


def read_linuxcnc(sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return the correction by the files of x and y; it ends at the first line of another form."""
    joints = []
    for source in sources:
        rows = []
        for number, text in enumerate(source.text.splitlines(), 1):
            if text.lstrip().startswith(("#", ";")) or not text.strip():
                break
            rows.append(numbers(text.strip(), f"{source.where}:{number}", r"N\s+N\s+N"))
        nominal, forward, reverse = np.array(rows).T if rows else np.zeros((3, 0))
        if not 2 <= len(rows) <= MAX_LINES or not (np.diff(nominal) > 0).all():
            raise InputError(
                source.where,
                f"{len(rows)} lines, or positions that do not increase",
                f"2 to {MAX_LINES} lines nominal forward reverse, before any comment",
            )
        if (forward != reverse).any():
            raise InputError(
                source.where,
                "forward and reverse differ",
                "a calibrated map has one correction for both directions",
            )
        joints.append((nominal, nominal - forward))
    (xs, cx), (ys, cy) = joints
    return lambda px, py: (np.interp(px, xs, cx), np.interp(py, ys, cy))


def write_siemens(error_map: ErrorMap, wiring: Wiring) -> Texts:
    """Return four CEC tables: x and y from the position of x, then from that of y."""
    frame = wiring.frame
    at, means = _means(error_map, wiring)
    axes = (frame.x_axis, frame.y_axis)
    lines = ["%_N_NC_CEC_INI", "CHANDATA(1)"]
    table = 0
    for output, (of_x, of_y, mean) in zip(axes, means, strict=True):
        for source, positions, values in zip(
            axes, at, (of_x, of_y - mean), strict=True
        ):
            lines += [
                f"$AN_CEC[{table},{n}]={fixed(value, frame.unit_m)}"
                for n, value in enumerate(values)
            ]
            settings = (
                f"(AX{source})",
                f"(AX{output})",
                decimal(spacing(positions)),
                decimal(positions[0]),
                decimal(positions[-1]),
                "0",
                "0",
                "0",
            )
            lines += [
                f"$AN_CEC_{key}[{table}]={value}"
                for key, value in zip(CEC_KEYS, settings, strict=True)
            ]
            table += 1
    return {"": [*lines, "M17"]}


def read_siemens(sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return the sum of CEC tables; the first and last value hold outside."""
    [source] = sources
    axes = {
        f"(AX{axis})": place
        for place, axis in enumerate((wiring.frame.x_axis, wiring.frame.y_axis))
    }
    entries: dict[int, dict] = {}
    settings: dict[tuple[int, str], Any] = {}
    for line in lines_of(source, ";.*"):
        if re.fullmatch(r"%_N_NC_CEC_INI|CHANDATA\(1\)|M17", line.text):
            continue
        match = re.fullmatch(
            r"\$AN_CEC(?:_(\w+))?\[(\d{1,3})(?:,(\d{1,5}))?\]\s*=\s*(\S+)",
            line.text,
            re.ASCII,
        )
        if (
            match is None
            or (match[1] is None) != (match[3] is not None)
            or match[1] not in (None, *CEC_KEYS)
        ):
            raise InputError(
                line.where,
                f"'{line.text[:60]}' is not a value of a CEC table",
                "export the tables again",
            )
        table = int(match[2])
        stated: dict[Any, Any] = settings if match[1] else entries.setdefault(table, {})
        place = (table, match[1]) if match[1] else (int(match[3]), 0)
        if place in stated:
            raise InputError(line.where, "it is given twice", "keep one of them")
        is_axis = match[1] in CEC_KEYS[:2]
        stated[place] = match[4] if is_axis else numbers(match[4], line.where, "N")[0]
    grids = [
        _cec_grid(table, values, settings, axes, source.where)
        for table, values in entries.items()
    ]
    if not grids:
        raise InputError(source.where, "it has no CEC table", "export it again")
    sense = -1.0 if wiring.negate else 1.0

    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        out = [np.zeros(np.shape(px)), np.zeros(np.shape(px))]
        for source_axis, output, grid in grids:
            out[output] = out[output] + sense * grid.at((px, py)[source_axis], px)
        return out[0], out[1]

    return correct


def _cec_grid(
    table: int, values: dict, settings: dict, axes: dict[str, int], where: str
) -> tuple[int, int, Grid]:
    """Return input axis, output axis and values of a table."""
    table_settings: list[Any] = [settings.get((table, key)) for key in CEC_KEYS]
    place = f"{where}: table {table}"
    if None in table_settings or any(axis not in axes for axis in table_settings[:2]):
        raise InputError(
            place,
            "a setting is missing, or an axis is not one of the stage",
            f"the axes are {' and '.join(axes)} (--x-axis, --y-axis)",
        )
    step, first, last, *other_settings = table_settings[2:]
    if (
        any(other_settings)
        or not step > 0
        or abs((last - first) / step - (len(values) - 1)) > 1e-6
    ):
        raise InputError(
            place,
            f"{len(values)} values from {first} to {last} in steps of {step}",
            "they do not fit, or direction, multiplication or modulo is set",
        )
    return (
        axes[table_settings[0]],
        axes[table_settings[1]],
        Grid((first, 0.0), (step, 1.0), filled(values, (len(values), 1), place)),
    )
