# SPDX-License-Identifier: Apache-2.0
"""Keywords of calibration files: which table takes which, and what their arguments are.

Source: Aerotech, Axis Calibration, the tables "File Format Settings".
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from selfcal_ros.aerotech.model import Kind, Unit, UnitWord

LIMIT = 1e15
"""Numbers beyond this are not lengths, angles or counts of a machine."""
SMALLEST = 1e-15
"""The same for distances and divisors that must not be zero."""
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
        If it is no plain decimal number, or beyond `LIMIT`.
    """
    if len(text) > 400 or not _NUMBER.fullmatch(text):
        remedy = "use a point as decimal mark" if "," in text else "write a plain decimal number"
        raise ArgumentFault(f"{short(text)} is not a number", remedy)
    value = float(text)
    if abs(value) > LIMIT:
        raise ArgumentFault(f"{short(text)} is too large", f"stay within +-{LIMIT:g}")
    return value


def integer(text: str) -> int:
    """Return the whole number in `text`; ArgumentFault if it is none or absurdly large."""
    if not _INTEGER.fullmatch(text):
        raise ArgumentFault(f"{short(text)} is not a whole number",
                            "write it with at most 9 digits")
    return int(text)


def unit(text: str) -> Unit:
    """Return the unit in `text`, such as PRIMARY/1000; ArgumentFault says what is wrong."""
    word, slash, divisor = text.partition("/")
    try:
        name = UnitWord(OLD_UNITS.get(word.upper(), word.upper()))
    except ValueError:
        raise ArgumentFault(f"{short(word)} is not a unit",
                            "take PRIMARY, SECONDARY or COUNTS, with /divisor") from None
    if not slash:
        return Unit(name)
    if not divisor:
        raise ArgumentFault("the / of a unit has no divisor after it",
                            "write it without white space, such as PRIMARY/1000")
    value = number(divisor)
    if value < SMALLEST:
        raise ArgumentFault(f"the divisor {short(divisor)} is not positive",
                            "write it as in PRIMARY/1000")
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
        raise ArgumentFault("a stray quote in the serial number", 'write SERIALNUMBER="..."')
    return bare


@dataclass(frozen=True)
class Keyword:
    """A keyword: the field of the table that it sets, and its argument's reader (None: a flag)."""

    field: str
    read: Callable[[str], Any] | None


_UNITS = {"POSUNIT": Keyword("pos_unit", unit), "CORUNIT": Keyword("cor_unit", unit)}
_NEGCOR = {"NEGCOR": Keyword("negcor", None)}
_GALVO = {**_UNITS, **_NEGCOR, "OUTAXIS3": Keyword("outaxis3", integer)}
KEYWORDS: dict[Kind, dict[str, Keyword]] = {
    Kind.ONE_D: {
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
    Kind.TWO_D: {
        **_GALVO,
        "OFFSETROW": Keyword("offset_row", number),
        "OFFSETCOL": Keyword("offset_col", number),
        "ABSOLUTEFEEDBACKOFFSETROW": Keyword("absolute_feedback_offset_row", number),
        "ABSOLUTEFEEDBACKOFFSETCOL": Keyword("absolute_feedback_offset_col", number),
        "ROLLOVERROW": Keyword("rollover_row", number),
        "ROLLOVERCOL": Keyword("rollover_col", number),
        "SERIALNUMBER": Keyword("serial_number", serial),
    },
    Kind.GALVO: _GALVO,
}
ALIASES = {f"PRIMARYABSOLUTEFEEDBACKOFFSET{end}": f"ABSOLUTEFEEDBACKOFFSET{end}"
           for end in ("", "ROW", "COL")}
"""Other names that the maker's own parameter pages use."""
ALL_KEYWORDS = set().union(*KEYWORDS.values())
POSITIONAL: dict[Kind, tuple[str, ...]] = {
    Kind.ONE_D: ("axis_index",),
    Kind.TWO_D: ("RowAxis", "ColumnAxis", "OutputAxis1", "OutputAxis2", "SampDistRow",
                 "SampDistCol", "NumCols"),
}
POSITIONAL[Kind.GALVO] = POSITIONAL[Kind.TWO_D]
