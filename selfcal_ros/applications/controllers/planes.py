# SPDX-License-Identifier: Apache-2.0
"""Tables over the plane: KMotion's Geo Table, Turbo PMAC's and Beckhoff's plane compensation.

Each has a writer, and a reader that returns what the controller then adds to a command.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.applications.controllers.grid import (
    MAX_ENTRIES,
    NUMBER,
    Grid,
    Line,
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
from selfcal_ros.compensation.export import decimal
from selfcal_ros.compensation.residual import Correction, Covering
from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.units import UM_PER_M

Texts = dict[str, list[str]]
"""Lines of each file, by what is added to its name: "", or "x" and "y"."""
PER_COUNT = 16
"""PMAC: entries are in sixteenths of a count."""
COARSEST = 4
"""PMAC: cells for each of the map where no fraction meets its nodes."""
TENTH_UM = 1e-7
"""Beckhoff: its unit of length, m."""
MAX_POINTS = 10_201
"""Beckhoff: points of a table without ``max_points``."""


def write_kmotion(error_map: ErrorMap, wiring: Wiring) -> Texts:
    """Return a Geo Table: absolute positions to command, rows along y, columns along x."""
    unit_m = wiring.frame.unit_m
    x, y = nodes(error_map, wiring.frame)
    px, py = np.meshgrid(x, y)
    cx, cy = wanted(error_map, wiring)(px, py)
    lines = [
        f"{len(y)},{len(x)}",
        f"{decimal(spacing(x))},{decimal(spacing(y))}",
        f"{decimal(x[0])},{decimal(y[0])}",
    ]
    lines += [
        f"{row},{column},{fixed(px[row, column] + cx[row, column], unit_m)},"
        f"{fixed(py[row, column] + cy[row, column], unit_m)},0"
        for row in range(len(y))
        for column in range(len(x))
    ]
    return {"": lines}


def read_kmotion(sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return the correction by a Geo Table; the edge cell extrapolates.

    What follows the last entry is not read by the controller: there are the comments.
    """
    [source] = sources
    lines = [
        Line(text.strip(), f"{source.where}:{number}")
        for number, text in enumerate(source.text.splitlines(), 1)
    ]
    if len(lines) < 3:
        raise InputError(source.where, "it has no Geo Table", "export it again")
    comma = r"\s*,\s*"
    rows, columns = map(int, numbers(*lines[0], f"I{comma}I"))
    step, first = (numbers(*line, f"N{comma}N") for line in lines[1:3])
    if not (2 <= rows <= 4000 and 2 <= columns <= 4000) or not all(step):
        raise InputError(
            source.where,
            f"{rows} rows and {columns} columns, spacing {step}",
            "2 to 4000 of each, with a distance between them",
        )
    entries: tuple[dict, dict] = {}, {}
    for line in lines[3 : 3 + rows * columns]:
        row, column, *command = numbers(*line, comma.join("IINNN"))
        if not (0 <= row < rows and 0 <= column < columns):
            raise InputError(
                line.where,
                f"row {row:.0f}, column {column:.0f} is not in the table",
                "export it again",
            )
        for out, value in zip(entries, command[:2], strict=True):
            out[int(column), int(row)] = value
    grids = [
        Grid(
            (first[0], first[1]),
            (step[0], step[1]),
            filled(out, (columns, rows), source.where),
            "extrapolate",
        )
        for out in entries
    ]
    along_x, along_y = (
        (start, start + by * (count - 1))
        for start, by, count in zip(first, step, (columns, rows), strict=True)
    )
    return Covering(
        lambda px, py: (grids[0].at(px, py) - px, grids[1].at(px, py) - py),
        along_x,
        along_y,
    )


def write_pmac(error_map: ErrorMap, wiring: Wiring) -> Texts:
    """Return two 2D compensation tables in counts; the motor with the higher number first.

    Tables begin at the motors' zero and roll over, so that up to two cells more than the field
    has keep its ends apart. Entry [0, 0] is zero: all positions move by a constant. If the zero is
    not at a site, the cells are a whole fraction of the map's, so that its nodes are met.
    """
    frame = wiring.frame
    counts = _counts(wiring)
    spans, shape, at = [], [], []
    for positions, per in zip(nodes(error_map, frame), counts, strict=True):
        cell = positions[0] / spacing(positions)
        split = next(
            (k for k in range(1, 11) if abs(cell * k - round(cell * k)) < 1e-6),
            COARSEST,
        )
        entries = split * (len(positions) + 1)
        span = round(entries / split * spacing(positions) * per)
        entry = np.arange(entries + 1) * span / entries
        middle = positions[[0, -1]].mean() * per
        at.append((entry - span * np.floor((entry - middle) / span + 0.5)) / per)
        spans.append(span)
        shape.append(entries)
    px, py = np.meshgrid(*at, indexing="ij")
    correct = wanted(error_map, wiring)
    tables = {}
    motors = (frame.x_axis, frame.y_axis)
    changes = [
        PER_COUNT * per * (values - values[0, 0])
        for values, per in zip(correct(px, py), counts, strict=True)
    ]
    _require_entries(wiring, changes)
    for motor, entries in zip(motors, changes, strict=True):
        integers = np.rint(entries).astype(int).T.ravel()[1:]
        tables[motor] = [
            f"#{motor}",
            f"DEFINE COMP {shape[1]}.{shape[0]},#{frame.x_axis}D,#{frame.y_axis}D,"
            f"#{motor},{spans[0]},{spans[1]}",
            *(
                " ".join(map(str, integers[k : k + 10].tolist()))
                for k in range(0, len(integers), 10)
            ),
        ]
    high_first = sorted(tables, reverse=True)
    return {"": [line for motor in high_first for line in tables[motor]] + ["I51=1"]}


def _require_entries(wiring: Wiring, changes: Sequence[np.ndarray]) -> None:
    """Raise InputError if the counts of a motor make all of its entries 0.

    They are in question if no motor has another entry, or if this one had with the counts of the
    other motor; else its errors are that small.
    """
    frame, counts = wiring.frame, _counts(wiring)
    largest = [float(np.abs(entries).max()) for entries in changes]
    for motor, change, per in zip(
        (frame.x_axis, frame.y_axis), largest, counts, strict=True
    ):
        if 0 < change <= 0.5 and (
            max(largest) <= 0.5 or change * max(counts) / per > 0.5
        ):
            entry_um = UM_PER_M * frame.unit_m / (PER_COUNT * per)
            raise InputError(
                "--counts-per-unit",
                f"every entry of motor {motor} would be 0: it is in {entry_um:.3g} µm, and the "
                f"corrections are at most {change * entry_um:.3g} µm",
                f"give the counts per {frame.unit}; if these are right, the errors are too small "
                "for a table",
            )


def _counts(wiring: Wiring) -> tuple[float, float]:
    if wiring.counts is None:
        raise InputError(
            "--counts-per-unit",
            "PMAC's tables are in counts, whose size is not known",
            "give the counts per unit of both motors",
        )
    return wiring.counts


def read_pmac(sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return the correction by compensation tables, as functions of the desired positions."""
    [source] = sources
    tables: list[tuple[Line, list[int], list[int]]] = []
    for line in lines_of(source, ";.*"):
        if re.fullmatch(r"#\d{1,2}|I51\s*=\s*1", line.text, re.I):
            continue
        if re.match("define", line.text, re.I):
            head = numbers(
                *line, r"define\s+comp\s+I\.I,\s*#ID?,\s*#ID?,\s*#I,\s*I,\s*I"
            )
            tables.append((line, [int(value) for value in head], []))
        elif tables and re.fullmatch(
            r"[-+]?\d{1,9}(\s+[-+]?\d{1,9})*", line.text, re.ASCII
        ):
            tables[-1][2].extend(map(int, line.text.split()))
        else:
            raise InputError(
                line.where,
                f"'{line.text[:60]}' is not part of a table",
                "export the tables again",
            )
    grids = [_pmac_grid(*table) for table in tables]
    counts = _counts(wiring)
    motors = (wiring.frame.x_axis, wiring.frame.y_axis)
    for axes, (line, *_) in zip((axes for axes, _ in grids), tables, strict=True):
        if not set(axes) <= set(motors):
            raise InputError(
                line.where,
                f"motors {axes} are not those of the stage, {motors}",
                "name them with --x-axis and --y-axis",
            )
    if not grids:
        raise InputError(source.where, "it has no table", "export it again")

    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        at = {
            motor: p * per
            for motor, p, per in zip(motors, (px, py), counts, strict=True)
        }
        out = {motor: np.zeros(np.shape(px)) for motor in motors}
        for (row, column, target), grid in grids:
            out[target] = out[target] + grid.at(at[row], at[column]) / PER_COUNT
        return out[motors[0]] / counts[0], out[motors[1]] / counts[1]

    return correct


def _pmac_grid(line: Line, head: list[int], entries: list[int]) -> tuple[tuple, Grid]:
    """Return (row motor, column motor, target) and the values over their positions in counts."""
    rows, columns, *axes, row_span, column_span = head
    number = (rows + 1) * (columns + 1) - 1
    if not (
        rows > 0
        and columns > 0
        and number <= MAX_ENTRIES
        and row_span > 0
        and column_span > 0
        and len(entries) == number
    ):
        raise InputError(
            line.where,
            f"{len(entries)} entries for {rows}.{columns}",
            f"{number} belong to it, and positive spans",
        )
    values = np.array([0, *entries], dtype=float).reshape(rows + 1, columns + 1).T
    return tuple(axes), Grid(
        (0.0, 0.0), (row_span / columns, column_span / rows), values, "roll"
    )


def write_beckhoff(error_map: ErrorMap, wiring: Wiring) -> Texts:
    """Return the list of each slave axis: integer positions of 0.1 um, one interval."""
    frame = wiring.frame
    per = wiring.frame.unit_m / TENTH_UM
    x, y = (positions * per for positions in nodes(error_map, frame))
    step = max(1, round(spacing(x)))
    first = [round(positions[0]) for positions in (x, y)]
    last = [
        int(np.ceil((positions[-1] - start) / step - 1e-6))
        for positions, start in zip((x, y), first, strict=True)
    ]
    at = [
        start + step * np.arange(end + 1)
        for start, end in zip(first, last, strict=True)
    ]
    values = wanted(error_map, wiring)(
        *(p / per for p in np.meshgrid(*at, indexing="ij"))
    )
    number = (last[0] + 1) * (last[1] + 1)
    files = {}
    for name, axis, field in zip(
        "xy", (frame.x_axis, frame.y_axis), values, strict=True
    ):
        lines = [f"kopf.achs_nr {axis}", f"kopf.log_achs_name {name.upper()}"]
        keys = {"max_points": number} if number > MAX_POINTS else {}
        keys |= {
            "interval": step,
            "last_index_master1": last[0],
            "last_index_master2": last[1],
            "start_position_master1": first[0],
            "start_position_master2": first[1],
            "unit": 1,
            "master1_ax_nr": frame.x_axis,
            "master2_ax_nr": frame.y_axis,
            "n_cycles": 20,
        }
        lines += [f"kw.crosscomp2.{key} {value}" for key, value in keys.items()]
        scaled = field * per
        lines += [
            f"kw.crosscomp2.table[{j}][{i}].correction "
            + (
                str(round(scaled[i, j]))
                if wiring.integers
                else fixed(scaled[i, j], TENTH_UM)
            )
            for j in range(last[1] + 1)
            for i in range(last[0] + 1)
        ]
        files[name] = lines
    return files


def read_beckhoff(sources: Sequence[Source], wiring: Wiring) -> Correction:
    """Return the correction by the lists of the slave axes; the edge holds outside."""
    frame = wiring.frame
    per = wiring.frame.unit_m / TENTH_UM
    grids = {}
    for source in sources:
        slave, grid = _beckhoff_grid(source, (frame.x_axis, frame.y_axis))
        if slave in grids or slave not in (frame.x_axis, frame.y_axis):
            raise InputError(
                source.where,
                f"axis {slave} is not the other axis of the stage",
                "give the list of x and that of y, and --x-axis, --y-axis",
            )
        grids[slave] = grid
    sense = -1.0 if wiring.negate else 1.0

    def correct(px: np.ndarray, py: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cx, cy = (
            sense * grids[axis].at(px * per, py * per) / per
            for axis in (frame.x_axis, frame.y_axis)
        )
        return cx, cy

    return correct


def _beckhoff_grid(source: Source, masters: tuple[int, int]) -> tuple[int, Grid]:
    where = source.where
    settings: dict[str, Any] = {}
    entries: dict[tuple[int, int], float] = {}
    text = re.sub(
        r"/\*.*?\*/", lambda match: "\n" * match[0].count("\n"), source.text, flags=re.S
    )
    for line in lines_of(Source(text, where), "#.*"):
        match = re.fullmatch(
            r"([\w.]+)(?:\[\s*(\d{1,4})\]\s*\[\s*(\d{1,4})\]\.correction)?"
            rf"\s+({NUMBER}|\w+)",
            line.text,
            re.ASCII,
        )
        if match is None or (match[2] is not None) != (
            match[1] == "kw.crosscomp2.table"
        ):
            raise InputError(
                line.where,
                f"'{line.text[:60]}' is not a key and its value",
                "export the list again",
            )
        place = (int(match[3]), int(match[2])) if match[2] else match[1]
        stated: dict[Any, Any] = entries if match[2] else settings
        if place in stated:
            raise InputError(
                line.where, f"{match[1]} is given twice", "keep one of them"
            )
        stated[place] = (
            match[4]
            if match[1] == "kopf.log_achs_name"
            else numbers(match[4], line.where, "N")[0]
        )
    keys = [
        "interval",
        "last_index_master1",
        "last_index_master2",
        "start_position_master1",
        "start_position_master2",
        "unit",
        "master1_ax_nr",
        "master2_ax_nr",
    ]
    names = ["kopf.achs_nr", *(f"kw.crosscomp2.{key}" for key in keys)]
    missing = [name for name in names if name not in settings]
    if missing:
        raise InputError(where, f"{missing[0]} is missing", "export the list again")
    slave, step, last1, last2, first1, first2, unit, *axes = (
        int(settings[name]) for name in names
    )
    if (
        step < 1
        or unit != 1
        or min(last1, last2) < 0
        or not (last1 + 1) * (last2 + 1) <= MAX_ENTRIES
        or tuple(axes) != masters
    ):
        raise InputError(
            where,
            f"interval {step}, unit {unit}, {last1 + 1} x {last2 + 1} points, masters {axes}",
            f"unit 1, masters {list(masters)} and a positive interval are needed",
        )
    return slave, Grid(
        (first1, first2), (step, step), filled(entries, (last1 + 1, last2 + 1), where)
    )
