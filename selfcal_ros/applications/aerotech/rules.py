# SPDX-License-Identifier: Apache-2.0
"""Limits and rules of calibration files (Aerotech, Axis Calibration)."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from selfcal_ros.applications.aerotech.header import LIMIT, SMALLEST
from selfcal_ros.applications.aerotech.model import (
    CalFindings,
    Table,
    Table1D,
    Table2D,
    TableKind,
    UnitWord,
)

MAX_AXIS = 32
MAX_1D_TABLES = 100
MAX_1D_TABLES_PER_AXIS = 8
MAX_2D_TABLES = 10
MAX_GALVO_POINTS = 138_000
GI4_SIDE = 65
EDGE = 1e-9
"""Fraction of a sample distance within which a position is taken to be on the table's edge."""


@dataclass(frozen=True)
class Gi4:
    """Restrictions of the GI4 galvo drive, by the bits of its protocol."""

    bits: int = 16

    @property
    def sample_counts(self) -> float:
        """Required sample distance: 1/64 of the protocol's range, in counts."""
        return 2.0**self.bits / 64


def check_tables(tables: Sequence[Table], findings: CalFindings) -> None:
    """Add a finding for every rule broken by the tables of one file."""
    for table in tables:
        check_table(table, findings)
        if table.kind is not tables[0].kind:
            mixed_kinds(table.line, (table.kind, tables[0].kind), findings)
    check_counts(tables, findings)


def check_table(table: Table, findings: CalFindings, *, gi4: Gi4 | None = None) -> None:
    """Add a finding for every rule broken by one table."""
    if not np.all(np.abs(table.values) <= LIMIT):
        findings.error(
            table.line,
            "values that are not finite, or too large",
            f"stay within +-{LIMIT:g}",
        )
    if not table.values.size:
        findings.error(
            table.line, "the table has no correction values", "give at least one"
        )
    _axes(table, findings)
    if isinstance(table, Table1D):
        _table_1d(table, findings)
    else:
        _table_2d(table, findings)
        if table.galvo:
            _galvo(table, findings, gi4)


def _axes(table: Table, findings: CalFindings) -> None:
    for axis in {*table.inputs, *table.outputs}:
        if not 1 <= axis <= MAX_AXIS:
            remedy = (
                "indices in calibration files count from 1"
                if axis == 0
                else "correct the index"
            )
            findings.error(table.line, f"axis {axis} is not in 1..{MAX_AXIS}", remedy)


def _distance(table: Table, name: str, value: float, findings: CalFindings) -> None:
    if abs(value) < SMALLEST:
        findings.error(
            table.lines.get(name, table.line),
            f"{name.replace('_', ' ')} is zero",
            "give the distance between entries",
        )


def _rollover(table: Table, name: str, findings: CalFindings) -> None:
    value = getattr(table, name)
    if value is not None and value < SMALLEST:
        findings.error(
            table.lines.get(name, table.line),
            "the rollover is not positive",
            "give the counts of one turn",
        )


def _table_1d(table: Table1D, findings: CalFindings) -> None:
    _distance(table, "sample_dist", table.sample_dist, findings)
    _rollover(table, "rollover", findings)

    def ignored(name: str, without: str) -> None:
        if getattr(table, name) is not None and getattr(table, without) is None:
            word, needed_word = (n.upper().replace("_", "") for n in (name, without))
            findings.warning(
                table.lines.get(name, table.line),
                f"{word} is ignored without {needed_word}",
                f"add {needed_word} or remove it",
            )

    ignored("home_offset", "home_direction")
    ignored("full_travel", "home_direction")
    ignored("expand_coeff", "material_temp")
    ignored("material_temp", "expand_coeff")
    if table.home_direction is not None and table.home_offset is None:
        findings.warning(
            table.lines.get("home_direction", table.line),
            "HOMEDIRECTION without HOMEOFFSET: a home offset of 0 is assumed",
            "add HOMEOFFSET",
        )
    if table.expand_coeff is not None and table.reference != table.axis:
        findings.warning(
            table.lines.get("expand_coeff", table.line),
            "thermal expansion in a table that corrects another axis",
            "put EXPANDCOEFF into the accuracy table of the axis",
        )
    first, last = _span(table.sample_dist, table.offset or 0.0, len(table.values))
    if not (first <= 0 <= last or table.rollover):
        findings.warning(
            table.lines.get("offset", table.line),
            f"the home position lies outside of the table, which covers {first:.9g} to {last:.9g}",
            "check the signs of SAMPLEDIST and OFFSET",
        )


def _span(distance: float, offset: float, count: int) -> tuple[float, float]:
    """Return the smallest and largest position, rounded so that 0 may be on an edge."""
    ends = [-offset, (count - 1) * distance - offset]
    ends = [0.0 if abs(end) < EDGE * abs(distance) else end for end in ends]
    return min(ends), max(ends)


def _table_2d(table: Table2D, findings: CalFindings) -> None:
    for end, axis in (("row", "row axis"), ("col", "column axis")):
        _distance(table, f"sample_{end}", getattr(table, f"sample_{end}"), findings)
        _rollover(table, f"rollover_{end}", findings)
        if table.galvo:
            continue
        offset = getattr(table, f"offset_{end}") or 0.0
        first, last = _span(
            getattr(table, f"sample_{end}"),
            offset,
            table.values.shape[0 if end == "row" else 1],
        )
        if not (first <= 0 <= last or getattr(table, f"rollover_{end}")):
            findings.warning(
                table.lines.get(f"offset_{end}", table.line),
                f"the home position of the {axis} lies outside of the table, which "
                f"covers {first:.9g} to {last:.9g}: no zero bias",
                "check the signs of the sample distance and the offset",
            )
    if table.row_axis == table.column_axis:
        findings.error(
            table.line,
            f"RowAxis and ColumnAxis are both {table.row_axis}",
            "a 2D table needs two input axes",
        )
    if len(set(table.outputs)) < len(table.outputs):
        findings.error(
            table.line, "an output axis is named twice", "name each output axis once"
        )
    if (
        table.cor_unit is None
        and table.pos_unit is not None
        and table.pos_unit.word is not UnitWord.COUNTS
    ):
        findings.warning(
            table.lines.get("pos_unit", table.line),
            "CORUNIT is missing: the corrections are counts, not POSUNIT",
            "add CORUNIT",
        )


def _galvo(table: Table2D, findings: CalFindings, gi4: Gi4 | None) -> None:
    rows, columns = table.values.shape[:2]
    line = table.line
    if table.column_axis != table.outputs[0]:
        findings.error(
            line,
            f"ColumnAxis is {table.column_axis}, OutputAxis1 {table.outputs[0]}",
            "both must be the first axis of the galvo drive",
        )
    if table.row_axis != table.outputs[1]:
        findings.error(
            line,
            f"RowAxis is {table.row_axis}, OutputAxis2 {table.outputs[1]}",
            "both must be the second axis of the galvo drive",
        )
    for name, value in (
        ("SampDistRow", table.sample_row),
        ("SampDistCol", table.sample_col),
    ):
        if value < 0:
            findings.error(
                line, f"{name} is negative in a galvo table", "make it positive"
            )
    for name, count in (("rows", rows), ("columns", columns)):
        if count % 2 == 0:
            findings.error(
                line, f"a galvo table of {count} {name}", "the number must be odd"
            )
    if rows * columns > MAX_GALVO_POINTS:
        findings.error(
            line,
            f"{rows * columns} points in a galvo table",
            f"it may have {MAX_GALVO_POINTS}",
        )
    if gi4 is not None:
        _gi4(table, findings, gi4)


def _gi4(table: Table2D, findings: CalFindings, gi4: Gi4) -> None:
    rows, columns = table.values.shape[:2]
    if (rows, columns) != (GI4_SIDE, GI4_SIDE):
        findings.error(
            table.line,
            f"{rows} rows and {columns} columns for a GI4",
            f"it needs {GI4_SIDE} and {GI4_SIDE}",
        )
    unit, want = table.position_unit, gi4.sample_counts
    if unit.word is not UnitWord.COUNTS:
        findings.warning(
            table.lines.get("pos_unit", table.line),
            f"sample distances in {unit.word} cannot be compared with the {want:.9g} "
            "counts that a GI4 needs",
            "give them in counts",
        )
        return
    for name, value in (
        ("SampDistRow", table.sample_row),
        ("SampDistCol", table.sample_col),
    ):
        if not np.isclose(value / unit.divisor, want, rtol=1e-9, atol=0):
            findings.error(
                table.line,
                f"{name} is {value / unit.divisor:.9g} counts for a GI4",
                f"a protocol of {gi4.bits} bits needs {want:.9g}, 1/64 of its range",
            )


def mixed_kinds(
    line: int, kinds: tuple[TableKind, TableKind], findings: CalFindings
) -> None:
    """Record a table of another kind than the first one of its file."""
    findings.error(
        line,
        f"a {kinds[0]} table in a file of {kinds[1]} tables",
        "put each kind into a file of its own",
    )


def check_counts(tables: Sequence[Table], findings: CalFindings) -> None:
    """Add a finding for every exceeded limit on the number of tables."""
    limits = {TableKind.ONE_D: MAX_1D_TABLES, TableKind.TWO_D: MAX_2D_TABLES}
    for kind, limit in limits.items():
        of_kind = [table for table in tables if table.kind is kind]
        if len(of_kind) > limit:
            findings.error(
                of_kind[limit].line,
                f"{len(of_kind)} {kind} tables in the file",
                f"it may have {limit}",
            )
    tables_of_axis: Counter[int] = Counter()
    scanners: dict[int, int] = {}
    for table in tables:
        if isinstance(table, Table1D):
            tables_of_axis[table.axis] += 1
            if tables_of_axis[table.axis] == MAX_1D_TABLES_PER_AXIS + 1:
                findings.error(
                    table.line,
                    f"more than {MAX_1D_TABLES_PER_AXIS} tables correct axis {table.axis}",
                    "add their corrections up in one table",
                )
        elif table.galvo:
            for axis in dict.fromkeys(table.inputs):
                if axis in scanners:
                    findings.error(
                        table.line,
                        f"a second table for the galvo scanner of axis {axis}, after "
                        f"that of line {scanners[axis]}",
                        "keep one table for each scanner",
                    )
                    break
            scanners |= {
                axis: table.line for axis in table.inputs if axis not in scanners
            }
