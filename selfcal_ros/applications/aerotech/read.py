# SPDX-License-Identifier: Apache-2.0
"""Read calibration files tolerantly, with a finding for each deviation."""

import contextlib
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from selfcal_ros.applications.aerotech import model, rules
from selfcal_ros.applications.aerotech.header import (
    LIMIT,
    ArgumentFault,
    Header,
    number,
    read_header,
    short,
)
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_bytes

MAX_TABLES = 1000
"""Number of tables after which reading stops."""
_NUMERIC = re.compile(r"[0-9eE+\-. \t]*")
_NUMBER_FIRST = re.compile(r"[+\-.]?\d")
_TOKEN = re.compile(r":([A-Za-z0-9_]*)")
_STARTS = {kind.start[1:]: kind for kind in model.TableKind}


@dataclass
class _Open:
    """A table between its first start line and its end."""

    kind: model.TableKind
    heads: list[tuple[int, str]]
    words: list[str] = field(default_factory=list)
    lines: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    broken: bool = False
    broken_head: bool = False


class _Reader:
    """The state of reading: tables so far, and the open one."""

    def __init__(self) -> None:
        self.findings = model.CalFindings()
        self.tables: list[model.Table] = []
        self.comments: list[str] = []
        self.first_start = 0
        self.first_kind: model.TableKind | None = None
        self.n_tables = 0
        self.open: _Open | None = None

    def read(self, lines: list[str], odd: set[int]) -> None:
        """Process all lines; those in `odd` are not UTF-8."""
        index = 0
        while index < len(lines):
            end = index
            while (
                self.open is not None
                and end < len(lines)
                and _NUMERIC.fullmatch(lines[end])
            ):
                end += 1
            if not lines[index]:
                index += 1
            elif end > index:
                self._numbers(lines[index:end], index + 1)
                index = end
            else:
                self._line(index + 1, lines[index], odd=index + 1 in odd)
                index += 1
        self._finish(len(lines))

    def _numbers(self, block: list[str], first: int) -> None:
        assert self.open is not None, "numbers outside a table go to `_line`"
        counts = np.array([len(line.split()) for line in block])
        with_words = np.flatnonzero(counts)
        self.open.words.extend(" ".join(block).split())
        self.open.lines.extend((with_words + first).tolist())
        self.open.counts.extend(counts[with_words].tolist())

    def _line(self, number_: int, line: str, *, odd: bool) -> None:
        """Process a line that is not just numbers."""
        text, mark, comment = model.strip_comment(line)
        text = text.strip(" \t")
        if mark and not self.first_start:
            self.comments.append(comment.strip())
        if mark == "'":
            self.findings.tolerated(
                number_,
                "a comment that starts with an apostrophe",
                "start comments with a semicolon",
            )
        if odd:
            self._odd(number_, text)
        if text.startswith(":"):
            self._directive(number_, text)
        elif text and self.open is not None:
            if not _NUMERIC.fullmatch(text):
                self._not_numeric(number_, text)
            self._numbers([text], number_)
        elif text and _NUMBER_FIRST.match(text):
            self.findings.error(
                number_,
                "values outside of a table",
                "put them between a start token and :END, or make them a comment",
            )
        elif text:
            self.findings.tolerated(
                number_,
                "text outside of a table is ignored",
                "start it with a semicolon",
            )

    def _odd(self, line: int, text: str) -> None:
        if text.isascii() or not (text.startswith(":") or self.open is not None):
            self.findings.tolerated(
                line, "Windows-1252 characters in a comment", "save as UTF-8"
            )
        else:
            self.findings.error(line, "the line is not UTF-8", "save the file as UTF-8")

    def _finish(self, last: int) -> None:
        if self.open is not None:
            start = self.open.heads[0][0]
            self.findings.error(
                last,
                f"the table of line {start} has no :END",
                "end it with :END; the file may be truncated",
            )
            self.open.broken = True
            self._close()
        elif not self.first_start:
            self.findings.error(
                0,
                "no table in the file",
                "a table starts with :START, :START2D or :GALVO2D",
            )

    def _directive(self, line: int, text: str) -> None:
        match = _TOKEN.match(text)
        assert match is not None, "the pattern takes any text"
        word = match[1]
        arguments = text[match.end() :]
        if word.upper() == "END":
            self._end(line, word, arguments)
        elif word.upper() in _STARTS:
            if word != word.upper():
                self.findings.tolerated(
                    line,
                    "a token in mixed case",
                    "write :START, :START2D, :GALVO2D, :END",
                )
            self._start(line, _STARTS[word.upper()], arguments)
        else:
            self.findings.error(
                line,
                f"unknown token {short(text.split()[0])}",
                "known are :START, :START2D, :GALVO2D and :END",
            )

    def _start(self, line: int, kind: model.TableKind, arguments: str) -> None:
        if arguments and arguments[0] not in " \t":
            self.findings.error(line, f"no blank after {kind.start}", "put one")
        if self.open is not None and not self.open.counts:
            if kind is not self.open.kind:
                self.findings.error(
                    line,
                    f"a {kind.start} line in the {self.open.kind} table of line "
                    f"{self.open.heads[0][0]}",
                    f"start every line of its head with {self.open.kind.start}",
                )
                self.open.broken = self.open.broken_head = True
                return
            self.open.heads.append((line, arguments))
            return
        if self.open is not None:
            self.findings.error(
                line,
                f"{kind.start} before the :END of the table of line {self.open.heads[0][0]}",
                "end that table with :END",
            )
            self.open.broken = True
            self._close()
        self.n_tables += 1
        if self.n_tables > MAX_TABLES:
            self.findings.stop(
                line,
                f"more than {MAX_TABLES} tables in the file",
                f"it may have {rules.MAX_1D_TABLES}",
            )
        self.first_start = self.first_start or line
        self.first_kind = self.first_kind or kind
        if kind is not self.first_kind:
            rules.mixed_kinds(line, (kind, self.first_kind), self.findings)
        self.open = _Open(kind, [(line, arguments)])

    def _end(self, line: int, word: str, trailing: str) -> None:
        if word != "END":
            self.findings.tolerated(
                line, "a token in mixed case", "write :START, :START2D, :GALVO2D, :END"
            )
        if trailing.strip():
            self.findings.tolerated(
                line, "text after :END is ignored", "start it with a semicolon"
            )
        if self.open is None:
            self.findings.error(
                line, ":END without a start", "remove it or start the table"
            )
            return
        self._close()

    def _not_numeric(self, line: int, text: str) -> None:
        for word in text.split():
            try:
                number(word)
            except ArgumentFault as fault:
                self.findings.error(line, fault.what, fault.remedy)
                break
        else:
            self.findings.error(
                line,
                "odd characters between the numbers",
                "separate numbers by blanks or tabs",
            )
        if self.open is not None:
            self.open.broken = True

    def _close(self) -> None:
        table = self.open
        self.open = None
        assert table is not None, "called with a table open"
        header = read_header(table.kind, table.heads, self.findings)
        header.broken |= table.broken_head
        values = _numbers(table, self.findings) if not table.broken else None
        make = _table_1d if table.kind is model.TableKind.ONE_D else _table_2d
        parsed = make(header, values, (table.lines, table.counts), self.findings)
        if parsed is not None:
            self.tables.append(parsed)


def _numbers(table: _Open, findings: model.CalFindings) -> np.ndarray | None:
    """Return the values of a table, or None with a finding."""
    if not table.words:
        findings.error(
            table.heads[-1][0],
            "the table has no correction values",
            "give them between the start lines and :END",
        )
        return None
    try:
        values = np.fromiter(map(float, table.words), float, len(table.words))
    except ValueError:
        values = None
    if values is not None and np.all(np.abs(values) <= LIMIT):
        return values
    index = 0
    for line, count in zip(table.lines, table.counts, strict=True):
        for word in table.words[index : index + count]:
            try:
                number(word)
            except ArgumentFault as fault:
                findings.error(line, fault.what, fault.remedy)
                return None
        index += count
    return values


def _table_1d(
    header: Header,
    values: np.ndarray | None,
    layout: tuple[list[int], list[int]],
    findings: model.CalFindings,
) -> model.Table1D | None:
    if "sample_dist" not in header.values and not header.broken:
        findings.error(
            header.line,
            "SAMPLEDIST is missing",
            "give the distance between entries: SAMPLEDIST=...",
        )
        return None
    if header.broken or values is None:
        return None
    several = next((line for line, count in zip(*layout, strict=True) if count > 1), 0)
    if several:
        findings.tolerated(
            several, "several values on a line of a 1D table", "write one value a line"
        )
    return model.Table1D(
        int(header.positional[0]),
        header.values.pop("sample_dist"),
        values,
        **header.values,
        line=header.line,
        lines=header.lines,
    )


def _table_2d(
    header: Header,
    values: np.ndarray | None,
    layout: tuple[list[int], list[int]],
    findings: model.CalFindings,
) -> model.Table2D | None:
    if header.broken:
        return None
    *axes, sample_row, sample_col, n_columns = header.positional
    row, column, first, second = (int(axis) for axis in axes)
    columns = int(n_columns)
    third = header.values.pop("outaxis3", None)
    outputs = (first, second) if third is None else (first, second, third)
    if columns < 1:
        findings.error(
            header.line, f"NumCols is {columns}", "give the number of columns"
        )
        return None
    if values is None or not _rows_are_whole(columns, len(outputs), layout, findings):
        return None
    return model.Table2D(
        row,
        column,
        outputs,
        sample_row,
        sample_col,
        values.reshape(-1, columns, len(outputs)),
        **header.values,
        galvo=header.kind is model.TableKind.GALVO,
        line=header.line,
        lines=header.lines,
    )


def _rows_are_whole(
    columns: int,
    outputs: int,
    layout: tuple[list[int], list[int]],
    findings: model.CalFindings,
) -> bool:
    """Return whether the lines form whole rows; a finding names a line that does not."""
    width = columns * outputs
    want = f"a row has {columns} columns of {outputs} values = {width}"
    lines = layout[0]
    on_lines = np.array(layout[1])
    ends = np.cumsum(on_lines)
    if np.all(on_lines == width):
        return True
    # Rows may be wrapped, or share a line; but a line may not straddle two rows.
    begins = ends - on_lines
    straddles = (begins // width != (ends - 1) // width) & (
        (begins % width != 0) | (ends % width != 0)
    )
    if not straddles.any() and ends[-1] % width == 0:
        findings.tolerated(lines[0], "lines are not rows", "write one row a line")
        return True
    mostly_rows = 2 * np.count_nonzero(on_lines == width) >= len(on_lines)
    if mostly_rows or straddles.any():
        wrong = int(np.argmax(on_lines != width if mostly_rows else straddles))
        findings.error(
            lines[wrong],
            f"{on_lines[wrong]} values on the line; {want}",
            "correct the line or NumCols",
        )
    else:
        findings.error(
            lines[-1],
            f"the last row has {ends[-1] % width} values; {want}",
            "complete the row or correct NumCols",
        )
    return False


def parse_cal(
    data: bytes, where: str, *, gi4: rules.Gi4 | None = None
) -> model.CalFile:
    """Return the content of a calibration file from its bytes, with all findings.

    Parameters
    ----------
    data : bytes
        Content of the file.
    where : str
        Its name, for messages.
    gi4 : Gi4, optional
        Also check galvo tables against the restrictions of this drive.
    """
    reader = _Reader()
    with contextlib.suppress(model.TooManyFindings):
        reader.read(*model.decode(data, reader.findings))
        for table in reader.tables:
            rules.check_table(table, reader.findings, gi4=gi4)
        rules.check_counts(reader.tables, reader.findings)
    return model.CalFile(
        where, tuple(reader.tables), reader.findings.sorted(), tuple(reader.comments)
    )


def read_cal(path: str | os.PathLike, *, gi4: rules.Gi4 | None = None) -> model.CalFile:
    """Return the content of a calibration file, with all findings; InputError if missing."""
    return parse_cal(read_bytes(path), str(path), gi4=gi4)


def refuse_errors(cal: model.CalFile) -> model.CalFile:
    """Return `cal` if it has no errors.

    Raises
    ------
    InputError
        For the first error, with its line and remedy.
    """
    errors = cal.of(model.Severity.ERROR)
    if errors:
        first = errors[0]
        more = f" ({len(errors) - 1} more errors)" if len(errors) > 1 else ""
        place = f"{cal.where}:{first.line}" if first.line else cal.where
        raise InputError(place, first.what, first.remedy + more)
    return cal


def load_cal(path: str | os.PathLike) -> model.CalFile:
    """Return a calibration file that a controller would accept; InputError for any other."""
    return refuse_errors(read_cal(path))


def load_cals(paths: Sequence[str]) -> model.CalFile:
    """Return files that are loaded together as one; their corrections are added.

    Raises
    ------
    InputError
        As `load_cal`; or if two files are one, or alike.
    """
    files = [load_cal(path) for path in paths]
    for (first, cal), (again, other) in combinations(zip(paths, files, strict=True), 2):
        if len(cal.tables) == len(other.tables) and all(
            map(model.same_table, cal.tables, other.tables)
        ):
            raise InputError(
                again,
                f"is the same as {first}, and would be added twice",
                "name it once",
            )
    return model.CalFile(
        ", ".join(paths),
        *(
            tuple(item for cal in files for item in getattr(cal, name))
            for name in ("tables", "findings", "comments")
        ),
    )
