# SPDX-License-Identifier: Apache-2.0
"""Data model of Aerotech calibration files: tables, units, findings, lines of text."""

import codecs
import re
from dataclasses import dataclass, field, fields
from enum import StrEnum

import numpy as np


class TableKind(StrEnum):
    """Kind of a table; a file contains tables of one kind only."""

    ONE_D = "1D"
    TWO_D = "2D"
    GALVO = "galvo 2D"

    @property
    def start(self) -> str:
        """The token that opens a table of this kind."""
        return {
            TableKind.ONE_D: ":START",
            TableKind.TWO_D: ":START2D",
            TableKind.GALVO: ":GALVO2D",
        }[self]


class Severity(StrEnum):
    """Severity of a finding."""

    ERROR = "error"
    WARNING = "warning"
    TOLERATED = "tolerated"


@dataclass(frozen=True, order=True)
class CalFinding:
    """A finding in a file: line, problem and remedy.

    Attributes
    ----------
    line : int
        Line of the file, from 1; 0 means the whole file.
    severity : Severity
        ERROR: the file must not be loaded. WARNING: legal, but probably not intended.
        TOLERATED: not the strict form, but unambiguous.
    what, remedy : str
        What is wrong, and what to do about it.
    """

    line: int
    severity: Severity
    what: str
    remedy: str = ""

    def text(self, where: str) -> str:
        """Return the finding as one line for the file `where`."""
        place = f"{where}:{self.line}" if self.line else where
        remedy = f"; {self.remedy}" if self.remedy else ""
        return f"{place}: {self.severity}: {self.what}{remedy}"


class UnitWord(StrEnum):
    """Words of POSUNIT and CORUNIT."""

    PRIMARY = "PRIMARY"
    SECONDARY = "SECONDARY"
    COUNTS = "COUNTS"


@dataclass(frozen=True)
class Unit:
    """A unit word with its divisor: PRIMARY/1000 means thousandths of the primary unit."""

    word: UnitWord = UnitWord.COUNTS
    divisor: float = 1.0


COUNTS = Unit()


@dataclass(frozen=True, eq=False)
class Table1D:
    """A 1D table: `axis` is corrected from the position of `reference`.

    Attributes
    ----------
    axis : int
        Corrected axis, 1..32.
    sample_dist, offset : float
        Entry n belongs to the position n * sample_dist - offset, in `pos_unit`.
    values : float array (n,)
        Corrections in `cor_unit`.
    reference_axis : int or None
        None means `axis` itself.
    pos_unit, cor_unit : Unit or None
        None: counts; a missing `cor_unit` follows `pos_unit`.
    expand_coeff, material_temp : float or None
        Thermal expansion of the scale's carrier in 1/degC, and the temperature of the
        measurement in degC.
    negpos, negcor : bool
        Change the sign of all positions, of all corrections.
    rollover : float or None
        Counts after which the table repeats.
    home_direction : str or None
        "CW" (positive end) or "CCW"; without it `home_offset` and `full_travel` are ignored.
    home_offset, full_travel : float or None
        Primary units.
    absolute_feedback_offset : float or None
        Counts.
    serial_number : str or None
        For reference only.
    line, lines : int, dict
        Line of the first start token, and keyword -> line; 0 and empty if not read from a file.
    """

    axis: int
    sample_dist: float
    values: np.ndarray
    reference_axis: int | None = None
    pos_unit: Unit | None = None
    cor_unit: Unit | None = None
    offset: float | None = None
    expand_coeff: float | None = None
    material_temp: float | None = None
    negpos: bool = False
    negcor: bool = False
    rollover: float | None = None
    home_direction: str | None = None
    home_offset: float | None = None
    absolute_feedback_offset: float | None = None
    full_travel: float | None = None
    serial_number: str | None = None
    line: int = 0
    lines: dict[str, int] = field(default_factory=dict)

    kind = TableKind.ONE_D

    @property
    def reference(self) -> int:
        """Axis whose position selects the entry."""
        return self.axis if self.reference_axis is None else self.reference_axis

    @property
    def outputs(self) -> tuple[int, ...]:
        """Corrected axes."""
        return (self.axis,)

    @property
    def inputs(self) -> tuple[int, ...]:
        """Axes whose positions are needed."""
        return (self.reference,)

    @property
    def position_unit(self) -> Unit:
        """Unit of `sample_dist` and `offset`, defaults applied."""
        return self.pos_unit or COUNTS

    @property
    def correction_unit(self) -> Unit:
        """Unit of `values`, defaults applied: CORUNIT, else POSUNIT, else counts."""
        return self.cor_unit or self.position_unit


@dataclass(frozen=True, eq=False)
class Table2D:
    """A 2D or galvo table: two or three axes are corrected from the positions of two.

    Attributes
    ----------
    row_axis, column_axis : int
        Input axes: rows run down the table, columns across it.
    output_axes : tuple of int
        Two or three corrected axes.
    sample_row, sample_col : float
        Row r belongs to r * sample_row - offset_row, and columns likewise, in `pos_unit`; the
        centre of a galvo table belongs to position (0, 0).
    values : float array (rows, columns, outputs)
        Corrections in `cor_unit`.
    pos_unit, cor_unit : Unit or None
        None means counts, each for itself.
    rollover_row, rollover_col, absolute_feedback_offset_row, absolute_feedback_offset_col
        Counts or None.
    galvo : bool
        Whether the table belongs to a galvo scanner.
    line, lines : int, dict
        As in `Table1D`.
    """

    row_axis: int
    column_axis: int
    output_axes: tuple[int, ...]
    sample_row: float
    sample_col: float
    values: np.ndarray
    pos_unit: Unit | None = None
    cor_unit: Unit | None = None
    offset_row: float | None = None
    offset_col: float | None = None
    absolute_feedback_offset_row: float | None = None
    absolute_feedback_offset_col: float | None = None
    negcor: bool = False
    rollover_row: float | None = None
    rollover_col: float | None = None
    serial_number: str | None = None
    galvo: bool = False
    line: int = 0
    lines: dict[str, int] = field(default_factory=dict)

    @property
    def kind(self) -> TableKind:
        """Kind of the table."""
        return TableKind.GALVO if self.galvo else TableKind.TWO_D

    @property
    def outputs(self) -> tuple[int, ...]:
        """Corrected axes."""
        return self.output_axes

    @property
    def inputs(self) -> tuple[int, ...]:
        """Axes whose positions are needed."""
        return self.row_axis, self.column_axis

    @property
    def position_unit(self) -> Unit:
        """Unit of the sample distances and offsets, defaults applied."""
        return self.pos_unit or COUNTS

    @property
    def correction_unit(self) -> Unit:
        """Unit of `values`, defaults applied."""
        return self.cor_unit or COUNTS


Table = Table1D | Table2D


@dataclass(frozen=True, eq=False)
class CalFile:
    """Content of a calibration file, with findings.

    Attributes
    ----------
    where : str
        File name, for messages.
    tables : tuple of Table
        Tables that could be read, in their order.
    findings : tuple of CalFinding
        Sorted by line.
    comments : tuple of str
        Comments before the first table, without their mark.
    """

    where: str
    tables: tuple[Table, ...]
    findings: tuple[CalFinding, ...] = ()
    comments: tuple[str, ...] = ()

    def of(self, severity: Severity) -> list[CalFinding]:
        """Return the findings of one severity."""
        return [finding for finding in self.findings if finding.severity is severity]


def same_table(a: Table, b: Table) -> bool:
    """Return whether two tables are equal, apart from their position in files."""
    if type(a) is not type(b) or a.values.shape != b.values.shape:
        return False
    names = [f.name for f in fields(a) if f.name not in ("values", "line", "lines")]
    return all(getattr(a, name) == getattr(b, name) for name in names) and bool(
        np.array_equal(a.values, b.values)
    )


MAX_FINDINGS = 100
_MARKS = re.compile("[;'\"]")


class TooManyFindings(Exception):
    """Raised to stop reading an unusable file."""


class CalFindings:
    """Collect findings: each kind of tolerance once with its count, the others up to a limit."""

    def __init__(self) -> None:
        self._listed: list[CalFinding] = []
        self._tolerated: dict[tuple[str, str], list[int]] = {}

    def error(self, line: int, what: str, remedy: str) -> None:
        """Record an error: the file must not be loaded."""
        self._add(CalFinding(line, Severity.ERROR, what, remedy))

    def warning(self, line: int, what: str, remedy: str) -> None:
        """Record legal content that was probably not intended."""
        self._add(CalFinding(line, Severity.WARNING, what, remedy))

    def tolerated(self, line: int, what: str, remedy: str) -> None:
        """Record an unambiguous deviation from the strict form."""
        self._tolerated.setdefault((what, remedy), []).append(line)

    def stop(self, line: int, what: str, remedy: str) -> None:
        """Record an error and stop reading."""
        self._listed.append(CalFinding(line, Severity.ERROR, what, remedy))
        raise TooManyFindings

    def sorted(self) -> tuple[CalFinding, ...]:
        """Return all findings by line."""
        out = list(self._listed)
        for (what, remedy), lines in self._tolerated.items():
            more = f" (and in {len(lines) - 1} more lines)" if len(lines) > 1 else ""
            out.append(CalFinding(lines[0], Severity.TOLERATED, what + more, remedy))
        return tuple(sorted(out, key=lambda finding: finding.line))

    def _add(self, finding: CalFinding) -> None:
        self._listed.append(finding)
        if len(self._listed) >= MAX_FINDINGS:
            self.stop(
                finding.line,
                f"reading stopped after {MAX_FINDINGS} findings",
                "correct the first ones",
            )


def decode(data: bytes, findings: CalFindings) -> tuple[list[str], set[int]]:
    """Return the lines of a file without line ends, and the numbers of those not in UTF-8.

    A byte order mark and CRLF are tolerated, UTF-16 is an error. Lines that are not UTF-8 are
    read as Windows-1252; whether this is tolerated depends on their content.
    """
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        findings.error(1, "the file is UTF-16", "save it as UTF-8")
        return _split(data.decode("utf-16", errors="replace"), findings), set()
    if data.startswith(codecs.BOM_UTF8):
        findings.tolerated(
            1, "a byte order mark before the first line", "save as plain UTF-8"
        )
        data = data[len(codecs.BOM_UTF8) :]
    if b"\0" in data:
        line = data.count(b"\n", 0, data.index(b"\0")) + 1
        findings.stop(
            line, "a zero byte: this is not a text file", "give a text file in UTF-8"
        )
    try:
        return _split(data.decode(), findings), set()
    except UnicodeDecodeError:
        lines = _split(data.decode("latin-1"), findings)
    odd = set()
    for index, text in enumerate(lines):
        if not text.isascii():
            raw = text.encode("latin-1")
            try:
                lines[index] = raw.decode()
            except UnicodeDecodeError:
                lines[index] = raw.decode("cp1252", errors="replace")
                odd.add(index + 1)
    return lines, odd


def _split(text: str, findings: CalFindings) -> list[str]:
    if "\r" in text:
        line = text.count("\n", 0, text.index("\r")) + 1
        findings.tolerated(
            line, "lines end with CR or CRLF", "the strict form ends lines with LF"
        )
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    lines = text.split("\n")
    if lines[-1]:
        findings.tolerated(
            len(lines), "the last line has no end", "end it with a newline"
        )
    else:
        lines.pop()
    return lines


def strip_comment(line: str) -> tuple[str, str, str]:
    """Return the line before its comment, the comment's mark (or "") and the comment.

    A semicolon starts a comment, and so does an apostrophe (older controllers), unless it
    is inside a quoted string.
    """
    quoted = False
    for match in _MARKS.finditer(line):
        at = match.start()
        if match.group() == '"':
            # An unclosed quote does not hide the rest of the line.
            quoted = not quoted and line.find('"', at + 1) >= 0
        elif not quoted:
            return line[:at], line[at], line[at + 1 :]
    return line, "", ""
