# SPDX-License-Identifier: Apache-2.0
"""Write calibration files in the strict form, never silently over an existing file."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from selfcal_ros.applications.aerotech.header import KEYWORDS
from selfcal_ros.applications.aerotech.model import (
    CalFile,
    CalFindings,
    Table,
    Table1D,
    Unit,
    same_table,
)
from selfcal_ros.applications.aerotech.read import parse_cal, refuse_errors
from selfcal_ros.applications.aerotech.rules import check_tables
from selfcal_ros.compensation.export import comment_text, decimal
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_bytes
from selfcal_ros.outputs import has_content, refuse_existing, write_together


def cal_text(
    tables: Sequence[Table],
    *,
    comments: Sequence[str] = (),
    decimals: int | None = None,
) -> str:
    """Return a calibration file in the strict form.

    Parameters
    ----------
    tables : sequence of Table
        Tables of one kind.
    comments : sequence of str
        Lines for the head of the file.
    decimals : int, optional
        Digits after the point of the corrections; default: as many as needed to read every value
        back exactly.

    Raises
    ------
    InputError
        If the tables break a rule of the format, or cannot be expressed in it.
    """
    findings = CalFindings()
    check_tables(tables, findings)
    if not tables:
        raise InputError("calibration file", "it has no tables", "give at least one")
    refuse_errors(CalFile("calibration file", tuple(tables), findings.sorted()))
    lines = [f"; {comment_text(comment)}".rstrip() for comment in comments]
    for table in tables:
        lines += _head(table)
        values = table.values.reshape(len(table.values), -1)
        if decimals is None:
            lines += [" ".join(map(decimal, row)) for row in values.tolist()]
        else:
            row_format = " ".join([f"%.{decimals}f"] * values.shape[1])
            lines += [
                row_format % tuple(row)
                for row in _no_minus_zero(values, decimals).tolist()
            ]
        lines.append(":END")
    text = "\n".join(lines) + "\n"
    _refuse_what_reads_differently(text, tables, exact=decimals is None)
    return text


def _refuse_what_reads_differently(
    text: str, tables: Sequence[Table], *, exact: bool
) -> None:
    """Raise InputError if a file does not reproduce the tables it was written from.

    The fields of a table may be invalid: a quote in a serial number, an offset
    that is not a number, keywords that a galvo table must not have.
    """
    back = refuse_errors(parse_cal(text.encode(), "calibration file")).tables
    for number, (table, read) in enumerate(zip(tables, back, strict=True), 1):
        rounded = table.values.shape == read.values.shape and not exact
        if not same_table(
            read, replace(table, values=read.values) if rounded else table
        ):
            raise InputError(
                "calibration file",
                f"table {number} holds what the format cannot say",
                "keep to plain numbers, CW or CCW, and a serial number without quotes",
            )


def _no_minus_zero(values: np.ndarray, decimals: int) -> np.ndarray:
    return np.where(np.abs(values) < 0.5 * 10.0**-decimals, 0.0, values)


def _head(table: Table) -> list[str]:
    start = table.kind.start
    if isinstance(table, Table1D):
        arguments = [str(table.axis)]
    else:
        arguments = [
            str(table.row_axis),
            str(table.column_axis),
            *map(str, table.outputs[:2]),
            decimal(table.sample_row),
            decimal(table.sample_col),
            str(table.values.shape[1]),
        ]
    lines = [f"{start} {' '.join(arguments)}"]
    for word, keyword in KEYWORDS[table.kind].items():
        if keyword.field == "outaxis3":
            value = table.outputs[2] if len(table.outputs) == 3 else None
        else:
            value = getattr(table, keyword.field)
        if keyword.read is None and value:
            lines.append(f"{start} {word}")
        elif keyword.read is not None and value is not None:
            quote = '"' if word == "SERIALNUMBER" else ""
            lines.append(f"{start} {word}={quote}{_argument(value)}{quote}")
    return lines


def _argument(value: float | int | str | Unit) -> str:
    if isinstance(value, Unit):
        return (
            value.word
            if value.divisor == 1
            else f"{value.word}/{decimal(value.divisor)}"
        )
    return decimal(value) if isinstance(value, float) else str(value)


def write_cals(
    texts: Mapping[str, str], *, force: bool = False, now: datetime | None = None
) -> dict[str, Path | None]:
    """Write calibration files, all or none of them; return path -> backup of what it replaces.

    Parameters
    ----------
    texts : dict
        Path -> content, from `cal_text`.
    force : bool
        Whether existing files may be replaced; they are kept as ``NAME.<date>.bak``.
    now : datetime, optional
        Date of the backups, UTC.

    Raises
    ------
    InputError
        If a file exists and `force` is false, or one cannot be written.
    """
    refuse_existing(list(texts), force=force)
    stamp = (now or datetime.now(UTC)).strftime("%Y-%m-%dT%H%M%SZ")
    backups = {
        path: _backup(Path(path), stamp) if has_content(path) else None
        for path in texts
    }
    # nor may another command that replaces the same file take the name of the old one
    refuse_existing(filter(None, backups.values()), force=False)
    contents: dict[str | os.PathLike, bytes] = {
        path: text.encode() for path, text in texts.items()
    }
    contents |= {backup: read_bytes(path) for path, backup in backups.items() if backup}
    write_together(contents)
    return backups


def _backup(target: Path, stamp: str) -> Path:
    """Return a name beside a file that is still free."""
    backup = target.with_name(f"{target.name}.{stamp}.bak")
    count = 1
    while backup.exists():
        count += 1
        backup = target.with_name(f"{target.name}.{stamp}-{count}.bak")
    return backup
