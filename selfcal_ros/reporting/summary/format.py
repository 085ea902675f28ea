# SPDX-License-Identifier: Apache-2.0
"""Formatting of numbers, names and tables: significant digits, alignment, ASCII."""

import math
import re
import unicodedata
from collections.abc import Sequence
from typing import TextIO

from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

UNKNOWN = "–"
_NUMBER = re.compile(r"[−+-]?\d[\d.]*(e[+-]?\d+)?|–|many")
_ASCII = {"µ": "u", "θ": "theta", "φ": "phi", "°": " deg", "±": "+/-", "–": "-", "×": "x",
          "σ": "sigma", "²": "^2", "−": "-"}


def to_ascii(text: str) -> str:
    """Return `text` in ASCII: known symbols spelled out, others replaced by a question mark."""
    spelled = "".join(_ASCII.get(char, char) for char in text.replace(" °", "°"))
    return spelled.encode("ascii", "replace").decode()


def can_print_symbols(stream: TextIO) -> bool:
    """Return whether the encoding of `stream` holds every symbol of a summary."""
    try:
        "".join(_ASCII).encode(getattr(stream, "encoding", None) or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True


def printable(text: object) -> str:
    """Return `text` as one line without control characters, which could steer a terminal."""
    return "".join(c if c.isprintable() else "?" for c in str(text))


def significant(value: float, digits: int = 3) -> str:
    """Return `value` with `digits` significant digits; scientific only far from 1.

    NaN and infinities, which mean unknown, become a dash.
    """
    if not math.isfinite(value):
        return UNKNOWN
    if value == 0:
        return "0"
    exponent = int(f"{value:.{digits - 1}e}".split("e")[1])
    if not -4 <= exponent < 7:
        return f"{value:.{digits - 1}e}"
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def um(value_m: float) -> str:
    """Return a length in µm with its unit, or ``not known``."""
    return f"{significant(value_m * UM_PER_M)} µm" if math.isfinite(value_m) else "not known"


def arcsec(value_rad: float) -> str:
    """Return an angle in arcseconds with its unit, or ``not known``."""
    if not math.isfinite(value_rad):
        return "not known"
    return f"{significant(value_rad * ARCSEC_PER_RAD)} arcsec"


def fixed(value: float, decimals: int) -> str:
    """Return `value` with `decimals` decimals, without a negative zero; NaN becomes a dash."""
    if not math.isfinite(value):
        return UNKNOWN
    text = f"{value:.{decimals}f}"
    return text.lstrip("-") if float(text) == 0 else text


def decimals_for(values: Sequence[float], digits: int = 3) -> int:
    """Return the number of decimals that gives the largest value `digits` significant digits."""
    largest = max((abs(v) for v in values if math.isfinite(v)), default=0.0)
    if largest == 0:
        return 0
    return min(max(digits - 1 - math.floor(math.log10(largest)), 0), 9)


def fixed_column(values: Sequence[float], digits: int = 3) -> list[str]:
    """Return the values of a column with as many decimals as its largest value needs."""
    decimals = decimals_for(values, digits)
    return [fixed(value, decimals) for value in values]


def aligned_numbers(values: Sequence[float], digits: int = 3, *, more: int = 3) -> list[str]:
    """Return the values of a column with equal decimals that resolve even the smallest one.

    The largest has `digits` significant digits, and up to `more` decimals are added until the
    smallest has two; values beyond are in scientific form.
    """
    known = [abs(v) for v in values if math.isfinite(v) and v != 0]
    if not known or max(known) >= 1e7 or max(known) < 1e-6:
        return [significant(v, digits) for v in values]
    wanted = 1 - math.floor(math.log10(min(known)))
    base = decimals_for(values, digits)
    decimals = min(max(base, wanted), base + more)
    return [fixed(value, decimals) for value in values]


def counted(number: int, noun: str) -> str:
    """Return ``1 view``, ``4 views``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def numeric_columns(table: Sequence[Sequence[str]]) -> list[bool]:
    """Return which columns of a table contain only numbers below the header."""
    return [all(_NUMBER.fullmatch(cell) for cell in column)
            for column in zip(*table[1:], strict=True)]


def aligned(rows: Sequence[Sequence[str]], *, left: int = 1, indent: str = "  ") -> list[str]:
    """Return `rows` as lines in columns; the first `left` columns flush left, the rest right."""
    if not rows:
        return []
    widths = [max(_columns(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = []
    for row in rows:
        cells = [cell + _fill(cell, width) if i < left else _fill(cell, width) + cell
                 for i, (cell, width) in enumerate(zip(row, widths, strict=True))]
        lines.append((indent + "  ".join(cells)).rstrip())
    return lines


def _columns(text: str) -> int:
    """Return the terminal columns of `text`: wide East Asian characters take two."""
    return sum(2 if unicodedata.east_asian_width(c) in "WF" else 1 for c in text)


def _fill(cell: str, width: int) -> str:
    return " " * (width - _columns(cell))
