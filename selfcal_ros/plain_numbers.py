# SPDX-License-Identifier: Apache-2.0
"""Numbers in texts that people and programs write."""

import re
from collections.abc import Mapping

QUANTITY = re.compile(r"\s*([-+.\deE]*[\d.])\s*([a-zµμ]*)\s*", re.ASCII)


def number_of(text: str) -> float:
    """Return the number that a text is.

    Raises
    ------
    ValueError
        If it is none, also for 1_000 and for digits of other scripts, which float() reads.
    """
    return float(_plain(text))


def whole_number_of(text: str) -> int:
    """Return the whole number that a text is; ValueError as of `number_of`."""
    return int(_plain(text))


def quantity_of(text: str, units: Mapping[str, float]) -> tuple[float, str]:
    """Return the number that a text such as ``20nm`` is, in SI units, and its unit.

    Parameters
    ----------
    text : str
        A number, and a unit behind it or none: then the unit is "".
    units : mapping
        Name of a unit, with u for µ -> factor to SI.

    Raises
    ------
    ValueError
        If it is none, or its unit is unknown.
    """
    match = QUANTITY.fullmatch(text)
    if match is None:
        raise ValueError(f"not a quantity: {text!r}")
    unit = re.sub("[µμ]", "u", match[2])
    if unit and unit not in units:
        raise ValueError(f"not a unit: {unit!r}")
    return number_of(match[1]) * units.get(unit, 1.0), unit


def _plain(text: str) -> str:
    """Return `text`; ValueError if it has what stands in no plain number."""
    if not text.isascii() or "_" in text:
        raise ValueError(f"not a plain number: {text!r}")
    return text
