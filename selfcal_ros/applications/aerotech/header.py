# SPDX-License-Identifier: Apache-2.0
"""Start lines of a table: positional arguments, keywords and their arguments.

Source: Aerotech, Axis Calibration, the tables "File Format Settings".
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from selfcal_ros.applications.aerotech.model import (
    CalFindings,
    TableKind,
    Unit,
    UnitWord,
)

LIMIT = 1e15
"""Largest valid length, angle or count."""
SMALLEST = 1e-15
"""Smallest valid distance or divisor."""
OLD_UNITS = {"METRIC": "PRIMARY"}
"""Words of older controllers."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d{1,4})?", re.ASCII)
_INTEGER = re.compile(r"[+-]?\d{1,9}", re.ASCII)


class ArgumentFault(Exception):
    """An argument that cannot be used: what is wrong, and how to correct it."""

    def __init__(self, what: str, remedy: str) -> None:
        self.what, self.remedy = what, remedy
        super().__init__(what)


def short(text: str) -> str:
    """Return `text` in quotes, shortened for a message and without control characters."""
    clean = "".join(c if c.isprintable() else "?" for c in text[:41])
    return f"'{clean[:40]}{'...' if len(text) > 40 else ''}'"


def number(text: str) -> float:
    """Return the decimal number in `text`.

    Raises
    ------
    ArgumentFault
        If it is not a plain decimal number, or beyond `LIMIT`.
    """
    if len(text) > 400 or not _NUMBER.fullmatch(text):
        remedy = (
            "use a point as decimal mark"
            if "," in text
            else "write a plain decimal number"
        )
        raise ArgumentFault(f"{short(text)} is not a number", remedy)
    value = float(text)
    if abs(value) > LIMIT:
        raise ArgumentFault(f"{short(text)} is too large", f"stay within +-{LIMIT:g}")
    return value


def integer(text: str) -> int:
    """Return the whole number in `text`; ArgumentFault if invalid or too large."""
    if not _INTEGER.fullmatch(text):
        raise ArgumentFault(
            f"{short(text)} is not a whole number", "write it with at most 9 digits"
        )
    return int(text)


def unit(text: str) -> Unit:
    """Return the unit in `text`, such as PRIMARY/1000; ArgumentFault if invalid."""
    word, slash, divisor = text.partition("/")
    try:
        name = UnitWord(OLD_UNITS.get(word.upper(), word.upper()))
    except ValueError:
        raise ArgumentFault(
            f"{short(word)} is not a unit",
            "take PRIMARY, SECONDARY or COUNTS, with /divisor",
        ) from None
    if not slash:
        return Unit(name)
    if not divisor:
        raise ArgumentFault(
            "the / of a unit has no divisor after it",
            "write it without white space, such as PRIMARY/1000",
        )
    value = number(divisor)
    if value < SMALLEST:
        raise ArgumentFault(
            f"the divisor {short(divisor)} is not positive",
            "write it as in PRIMARY/1000",
        )
    return Unit(name, value)


def direction(text: str) -> str:
    """Return CW or CCW; ArgumentFault for anything else."""
    if text.upper() not in ("CW", "CCW"):
        raise ArgumentFault(f"{short(text)} is not a home direction", "take CW or CCW")
    return text.upper()


def serial(text: str) -> str:
    """Return a serial number without its quotes; ArgumentFault for a stray quote."""
    bare = text[1:-1] if len(text) >= 2 and text[0] == text[-1] == '"' else text
    if '"' in bare:
        raise ArgumentFault(
            "a stray quote in the serial number", 'write SERIALNUMBER="..."'
        )
    return bare


@dataclass(frozen=True)
class Keyword:
    """A keyword: its field in the table, and the reader of its argument (None: a flag)."""

    field: str
    read: Callable[[str], Any] | None


_UNITS = {"POSUNIT": Keyword("pos_unit", unit), "CORUNIT": Keyword("cor_unit", unit)}
_NEGCOR = {"NEGCOR": Keyword("negcor", None)}
_GALVO = {**_UNITS, **_NEGCOR, "OUTAXIS3": Keyword("outaxis3", integer)}
KEYWORDS: dict[TableKind, dict[str, Keyword]] = {
    TableKind.ONE_D: {
        "REFERENCEAXIS": Keyword("reference_axis", integer),
        **_UNITS,
        "SAMPLEDIST": Keyword("sample_dist", number),
        "OFFSET": Keyword("offset", number),
        "EXPANDCOEFF": Keyword("expand_coeff", number),
        "MATERIALTEMP": Keyword("material_temp", number),
        "NEGPOS": Keyword("negpos", None),
        **_NEGCOR,
        "ROLLOVER": Keyword("rollover", number),
        "HOMEDIRECTION": Keyword("home_direction", direction),
        "HOMEOFFSET": Keyword("home_offset", number),
        "ABSOLUTEFEEDBACKOFFSET": Keyword("absolute_feedback_offset", number),
        "FULLTRAVEL": Keyword("full_travel", number),
        "SERIALNUMBER": Keyword("serial_number", serial),
    },
    TableKind.TWO_D: {
        **_GALVO,
        "OFFSETROW": Keyword("offset_row", number),
        "OFFSETCOL": Keyword("offset_col", number),
        "ABSOLUTEFEEDBACKOFFSETROW": Keyword("absolute_feedback_offset_row", number),
        "ABSOLUTEFEEDBACKOFFSETCOL": Keyword("absolute_feedback_offset_col", number),
        "ROLLOVERROW": Keyword("rollover_row", number),
        "ROLLOVERCOL": Keyword("rollover_col", number),
        "SERIALNUMBER": Keyword("serial_number", serial),
    },
    TableKind.GALVO: _GALVO,
}
ALIASES = {
    f"PRIMARYABSOLUTEFEEDBACKOFFSET{end}": f"ABSOLUTEFEEDBACKOFFSET{end}"
    for end in ("", "ROW", "COL")
}
"""Other names, from the manufacturer's parameter pages."""
ALL_KEYWORDS = set().union(*KEYWORDS.values())
POSITIONAL: dict[TableKind, tuple[str, ...]] = {
    TableKind.ONE_D: ("axis_index",),
    TableKind.TWO_D: (
        "RowAxis",
        "ColumnAxis",
        "OutputAxis1",
        "OutputAxis2",
        "SampDistRow",
        "SampDistCol",
        "NumCols",
    ),
}
POSITIONAL[TableKind.GALVO] = POSITIONAL[TableKind.TWO_D]


_WORD = re.compile(
    r"""[ \t]*(?:
    (?P<key>[A-Za-z_]\w*) (?P<blank>[ \t]*) = (?P<blank2>[ \t]*) (?P<value>"[^"]*"|[^ \t]*)
    | (?P<word>[^ \t]+))""",
    re.VERBOSE,
)
_POSITION = re.compile(r"[+\-.\d]")


@dataclass
class Header:
    """Content of the start lines of one table."""

    kind: TableKind
    line: int
    positional: list[float] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)
    lines: dict[str, int] = field(default_factory=dict)
    broken: bool = False


def read_header(
    kind: TableKind, heads: list[tuple[int, str]], findings: CalFindings
) -> Header:
    """Return the arguments on the start lines `heads` (line number, text after the token)."""
    header = Header(kind, heads[0][0])
    for index, (line, text) in enumerate(heads):
        words: list[str] = []
        at, named, late = 0, False, False
        text = text.rstrip(" \t")
        while at < len(text):
            match = _WORD.match(text, at)
            assert match is not None, "the pattern takes any text"
            at = match.end()
            positional = bool(_POSITION.match(match["word"] or ""))
            late |= positional and named
            named |= not positional
            if match["key"]:
                if match["blank"] or match["blank2"]:
                    findings.tolerated(
                        line, "blanks around =", "write KEYWORD=argument"
                    )
                _argument(header, (line, match["key"]), match["value"], findings)
            elif positional:
                words.append(match["word"])
            else:
                _flag(header, line, match["word"], findings)
        if late and index == 0:
            findings.tolerated(
                line,
                f"an argument of {kind.start} after a keyword",
                f"write {', '.join(POSITIONAL[kind])} before the keywords",
            )
        _positional(header, (index, line), words, findings)
    return header


def _keyword(header: Header, line: int, name: str, findings: CalFindings) -> str | None:
    """Return the strict spelling of a keyword of this kind of table, or None with an error."""
    strict = name.upper()
    if strict in ALIASES:
        findings.tolerated(
            line, f"the keyword {short(strict)}", f"write {ALIASES[strict]}"
        )
        strict = ALIASES[strict]
    if strict in KEYWORDS[header.kind]:
        if strict != name and name.upper() == strict:
            findings.tolerated(
                line, "a keyword in lower case", "write keywords in upper case"
            )
        return strict
    header.broken = True
    if strict in ALL_KEYWORDS:
        findings.error(
            line, f"a {header.kind} table must not have {strict}", "remove the keyword"
        )
    else:
        findings.error(
            line,
            f"unknown keyword {short(name)}",
            "known are " + ", ".join(sorted(KEYWORDS[header.kind])),
        )
    return None


def _argument(
    header: Header, place: tuple[int, str], text: str, findings: CalFindings
) -> None:
    line, name = place
    strict = _keyword(header, line, name, findings)
    if strict is None:
        return
    keyword = KEYWORDS[header.kind][strict]
    try:
        if keyword.read is None:
            raise ArgumentFault(f"{strict} takes no argument", f"write {strict} alone")
        if not text:
            raise ArgumentFault(f"{strict} has no argument", f"write {strict}=value")
        value = keyword.read(text)
    except ArgumentFault as fault:
        header.broken = True
        findings.error(
            line,
            f"{strict}: {fault.what}" if strict not in fault.what else fault.what,
            fault.remedy,
        )
        return
    _tolerances(line, strict, (text, value), findings)
    _set(header, (line, strict), (keyword.field, value), findings)


def _tolerances(
    line: int, strict: str, argument: tuple[str, Any], findings: CalFindings
) -> None:
    text, value = argument
    if isinstance(value, Unit):
        word = text.partition("/")[0]
        if word.upper() in OLD_UNITS:
            findings.tolerated(
                line,
                f"the unit {word.upper()} of older controllers, read as {value.word}",
                f"write {value.word}",
            )
        if word != word.upper():
            findings.tolerated(
                line, "a unit in lower case", "write units in upper case"
            )
    elif strict == "HOMEDIRECTION" and text != value:
        findings.tolerated(line, "a home direction in lower case", "write CW or CCW")
    elif strict == "SERIALNUMBER" and not (
        len(text) >= 2 and text[0] == text[-1] == '"'
    ):
        findings.tolerated(
            line, "a serial number without quotes", 'write SERIALNUMBER="..."'
        )


def _flag(header: Header, line: int, word: str, findings: CalFindings) -> None:
    if word.startswith("/"):
        header.broken = True
        findings.error(
            line,
            "white space before the / of a unit",
            "write it without, such as PRIMARY/1000",
        )
        return
    strict = _keyword(header, line, word, findings)
    if strict is None:
        return
    keyword = KEYWORDS[header.kind][strict]
    if keyword.read is not None:
        header.broken = True
        findings.error(line, f"{strict} has no argument", f"write {strict}=value")
        return
    _set(header, (line, strict), (keyword.field, True), findings)


def _set(
    header: Header, place: tuple[int, str], item: tuple[str, Any], findings: CalFindings
) -> None:
    (line, strict), (name, value) = place, item
    if name in header.values and header.values[name] != value:
        header.broken = True
        findings.error(
            line,
            f"{strict} is given twice, here and in line {header.lines[name]}, and differs",
            "keep one of them",
        )
    elif name in header.values:
        findings.warning(line, f"{strict} is given twice", "keep one of them")
    header.values[name] = value
    header.lines.setdefault(name, line)


def _positional(
    header: Header, place: tuple[int, int], words: list[str], findings: CalFindings
) -> None:
    index, line = place
    names = POSITIONAL[header.kind]
    if index > 0:
        if words:
            header.broken = True
            findings.error(
                line,
                f"{short(words[0])} on a later {header.kind.start} line",
                f"only the first {header.kind.start} line of a table carries "
                f"{', '.join(names)}; a new table needs {':END'} before it",
            )
        return
    if len(words) != len(names):
        header.broken = True
        findings.error(
            line,
            f"{header.kind.start} has {len(words)} arguments, not {len(names)}",
            f"write {', '.join(names)} after it",
        )
        return
    for name, word in zip(names, words, strict=True):
        try:
            value = number(word) if name.startswith("Samp") else integer(word)
        except ArgumentFault as fault:
            header.broken = True
            findings.error(line, f"{name}: {fault.what}", fault.remedy)
            value = 0
        header.positional.append(value)
