# SPDX-License-Identifier: Apache-2.0
"""The measurement as a CSV table, mm: one row per block and repeat.

Columns: ``block``; ``rx_pp, ry_pp, rx_np, ry_np`` (3D: ``rx_ppp, ry_ppp, rz_ppp, rx_npp, ...``);
and, for the new formulation, the linear errors ``ex_x, ey_y`` (3D: ``ez_z``). Several repeats are
several rows of the same block. Lines that start with ``#`` are comments. The cells of a diagonal
or linear error are empty in the rows beyond its own repeats.
"""

import csv
import io
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.applications.laser import data as laser_data
from selfcal_ros.applications.laser.profiles import name_of
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.files import csv_rows, read_text
from selfcal_ros.outputs import write_text
from selfcal_ros.plain_numbers import number_of
from selfcal_ros.units import M_PER_MM

BLOCK = "block"


@dataclass(frozen=True)
class RequiredColumns:
    """Required columns of a table.

    Attributes
    ----------
    steps_m : tuple of float
        Nominal steps, two for 2D, three for 3D.
    diagonals : tuple of str
        Diagonals to read.
    linear : bool
        Whether the linear errors are required.
    """

    steps_m: tuple[float, ...]
    diagonals: tuple[str, ...]
    linear: bool

    @property
    def readings(self) -> list[str]:
        """Names of the reading columns, diagonal by diagonal."""
        return [
            f"r{axis}_{name}"
            for name in self.diagonals
            for axis in laser_data.AXES[: len(self.steps_m)]
        ]

    @property
    def errors(self) -> list[str]:
        """Names of the columns of linear errors, if required."""
        return [name_of(j, j) for j in range(len(self.steps_m))] if self.linear else []


def read_table(
    path: str | os.PathLike, columns: RequiredColumns
) -> tuple[laser_data.StepDiagonal, list[str]]:
    """Return the measurement in a CSV file, and warnings.

    Raises
    ------
    InputError
        For a missing column or block, a cell that is not a number, a value that cannot be in mm.
    NoDataError
        If the table has no rows.
    """
    rows = _rows(path)
    header = _header(*rows[0], columns)
    known_columns = {BLOCK, *columns.readings, *columns.errors}
    known_columns |= {name_of(j, j) for j in range(3)}
    known_columns |= {
        f"r{axis}_{name}"
        for names in laser_data.DIAGONALS.values()
        for name in names
        for axis in laser_data.AXES
    }
    ignored = [name for name in header if name not in known_columns]
    warnings = [f"{path}: column '{name}' is not used" for name in ignored]
    cells: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    first_place: dict[int, str] = {}
    for place, row in rows[1:]:
        if len(row) != len(header):
            raise InputError(
                place,
                f"{len(row)} cells where the header has {len(header)}",
                "correct the line",
            )
        named = dict(zip(header, row, strict=True))
        block = _block(named[BLOCK], f"{place}: {BLOCK}")
        cells.setdefault(block, []).append(_values(named, columns, place))
        first_place.setdefault(block, place)
    for block, place in first_place.items():
        _refuse_unread(cells[block], columns, place)
    return _assemble(_in_order(cells, path), columns), warnings


def dimension_of(path: str | os.PathLike) -> int:
    """Return 3 if the table has columns of body diagonals, otherwise 2."""
    header = _rows(path)[0][1]
    return 3 if any(f"rx_{name}" in header for name in laser_data.DIAGONALS[3]) else 2


def _rows(path: str | os.PathLike) -> list[tuple[str, list[str]]]:
    rows = csv_rows(read_text(path), str(path))
    if not rows:
        raise NoDataError(
            str(path), "the table is empty", "give a header and one row per block"
        )
    if len(rows) == 1:
        raise NoDataError(
            str(path), "the table has a header only", "give one row per block"
        )
    return rows


def _header(where: str, header: list[str], columns: RequiredColumns) -> list[str]:
    for name in header:
        if header.count(name) > 1:
            raise InputError(where, f"the column '{name}' appears twice", "keep one")
    if BLOCK not in header:
        raise InputError(
            where,
            f"the column '{BLOCK}' is missing",
            f"head the columns {BLOCK}, {', '.join(columns.readings)}",
        )
    missing = [name for name in columns.readings if name not in header]
    absent = [
        name
        for name in columns.diagonals
        if all(
            column in missing
            for column in columns.readings
            if column.endswith(f"_{name}")
        )
    ]
    if absent and len(absent) < len(columns.diagonals):
        raise InputError(
            where,
            f"no readings of the diagonal {', '.join(absent)}",
            "measure every diagonal, or with the new formulation in 2D name the one "
            "measured by --diagonals",
        )
    if missing:
        raise InputError(
            where,
            f"the column {_names_text(missing)} is missing",
            "the table needs " + ", ".join([BLOCK, *columns.readings]),
        )
    lacking = [name for name in columns.errors if name not in header]
    if lacking:
        raise InputError(
            where,
            f"the column {_names_text(lacking)} is missing",
            "the new formulation needs the linear errors, measured directly along "
            "the axes; without them use --method conventional",
        )
    return header


def _names_text(names: Sequence[str]) -> str:
    return ", ".join(f"'{name}'" for name in names)


def _block(text: str, where: str) -> int:
    number = _number(text, where)
    if number != round(number) or not 0 <= number <= laser_data.MAX_BLOCKS:
        raise InputError(
            where, f"'{text}' is not a block number", "number the blocks 1, 2, 3, ..."
        )
    return int(number)


def _number(text: str, where: str) -> float:
    try:
        value = number_of(text)
    except ValueError as error:
        raise InputError(
            where,
            f"'{text}' is not a number" if text else "the cell is empty",
            "give a number in mm",
        ) from error
    if not math.isfinite(value):
        raise InputError(
            where,
            f"'{text}' is not a finite number",
            "measure the block again or leave its row out of the repeats",
        )
    return value


def _values(
    named: dict[str, str], columns: RequiredColumns, where: str
) -> tuple[np.ndarray, np.ndarray]:
    """Return one row's readings (K, D) and linear errors (D,), m."""
    steps = np.array(columns.steps_m)
    nominal = steps**2 / np.linalg.norm(steps)
    readings = np.full((len(columns.diagonals), len(steps)), np.nan)
    for index, name in enumerate(columns.readings):
        k, j = divmod(index, len(steps))
        of_diagonal = columns.readings[k * len(steps) : (k + 1) * len(steps)]
        if not any(named[column] for column in of_diagonal):
            continue
        place = f"{where}: {name}"
        readings[k, j] = _number(named[name], place) * M_PER_MM
        laser_data.check_reading(readings[k, j], nominal[j], place)
    linear = np.full(len(steps), np.nan)
    for index, name in enumerate(columns.errors):
        if named[name]:
            place = f"{where}: {name}"
            linear[index] = _number(named[name], place) * M_PER_MM
            laser_data.check_linear(linear[index], steps[index], place)
    return readings, linear


def _refuse_unread(
    rows: list[tuple[np.ndarray, np.ndarray]], columns: RequiredColumns, where: str
) -> None:
    """Refuse a block without readings of a diagonal."""
    read = np.isfinite([readings for readings, _ in rows]).any(axis=0).ravel()
    if not read.all():
        raise InputError(
            f"{where}: {columns.readings[int(np.argmin(read))]}",
            "the cell is empty",
            "give a number in mm",
        )


def _in_order(cells: dict[int, list], path: str | os.PathLike) -> list[list]:
    first = min(cells) if min(cells) in (0, 1) else 1
    for block in range(first, max(cells) + 1):
        if block not in cells:
            raise InputError(
                str(path),
                f"block {block} is missing",
                f"measure every block from {first} to {max(cells)}",
            )
    return [cells[block] for block in sorted(cells)]


def _assemble(blocks: list[list], columns: RequiredColumns) -> laser_data.StepDiagonal:
    repeats = max(map(len, blocks))
    dim = len(columns.steps_m)
    samples = np.full((repeats, len(columns.diagonals), dim, len(blocks)), np.nan)
    linear = np.full((repeats, dim, len(blocks)), np.nan)
    for i, rows in enumerate(blocks):
        for repeat, (readings, errors) in enumerate(rows):
            samples[repeat, :, :, i] = readings
            linear[repeat, :, i] = errors
    return laser_data.StepDiagonal(
        columns.steps_m, columns.diagonals, samples, linear if columns.linear else None
    )


def table_text(data: laser_data.StepDiagonal, comments: Sequence[str] = ()) -> str:
    """Return a measurement as CSV text, mm, to 0.01 nm."""
    linear = data.linear_m
    columns = RequiredColumns(data.steps_m, data.diagonals, linear is not None)
    out = io.StringIO()
    for comment in comments:
        out.write(f"# {comment}\n")
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([BLOCK, *columns.readings, *columns.errors])
    for repeat in range(max(len(data.samples_m), 0 if linear is None else len(linear))):
        for i in range(data.n_blocks):
            values = _row(data.samples_m[:, :, :, i], repeat)
            if linear is not None:
                values += _row(linear[:, :, i], repeat)
            if not np.isnan(values).all():
                cells = ("" if np.isnan(v) else f"{v / M_PER_MM:.8f}" for v in values)
                writer.writerow([i + 1, *cells])
    return out.getvalue()


def _row(of_block: np.ndarray, repeat: int) -> list[float]:
    """Return the values of one repeat, NaN where missing."""
    if repeat < len(of_block):
        return of_block[repeat].ravel().tolist()
    return [math.nan] * of_block[0].size


def write_table(
    path: str | os.PathLike, data: laser_data.StepDiagonal, comments: Sequence[str] = ()
) -> None:
    """Write a measurement as a CSV file, with comment lines at the top."""
    write_text(path, table_text(data, comments))
