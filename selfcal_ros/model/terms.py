# SPDX-License-Identifier: Apache-2.0
"""Terms of the measurement model beside stage, plate and misalignments: what they are called."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum

from selfcal_ros.errors import InputError, known_are

MAX_DRIFT_DEGREE = 9
"""Largest degree of the polynomial by which a view may drift."""

DRIFT_DEGREE = 3
"""Degree of that polynomial if nothing else is said."""

SMALLEST, LARGEST = 1e-18, 1.0
"""Sizes of terms that are written down: nothing is known better, and no more is left open."""


class TermName(StrEnum):
    """Names of the terms, as in ``--model``, ``model_terms`` and RESULT.json.

    MICROSCOPE: a 2x2 matrix E shared by all views, mark = indicated + (1 + E) offset.
    DRIFT: the plate moves against the stage while a view is measured, a polynomial of time.
    PLATE_SCALE: the plate is larger by a factor 1 + b in a view (temperature).
    PLATE_SHAPE: the plate is bent in a view, quadratic in position (clamping, gravity).
    APPROACH: the indicated position depends on the direction from which an axis arrived.
    """

    MICROSCOPE = "microscope"
    DRIFT = "drift"
    PLATE_SCALE = "plate_scale"
    PLATE_SHAPE = "plate_shape"
    APPROACH = "approach"


VISIT_TERMS = frozenset({TermName.MICROSCOPE, TermName.DRIFT, TermName.APPROACH})
"""Terms that need to know when, with which offset or from where a mark was read."""

UNITS: dict[str, str] = {
    TermName.MICROSCOPE: "m/m", TermName.DRIFT: "m", TermName.PLATE_SCALE: "m/m",
    TermName.PLATE_SHAPE: "m", TermName.APPROACH: "m"}
"""Unit of each term's size: a standard deviation known from elsewhere. For a drift it is that at
the edge of the view's time, for a shape at the middle of the plate's edge."""


@dataclass(frozen=True)
class ModelTerm:
    """A term that is estimated together with the map.

    Attributes
    ----------
    name : TermName
        Which.
    size : float
        Standard deviation of its coefficients as known from elsewhere, in `UNITS`; infinite if
        the readings alone are to tell them.

    Raises
    ------
    InputError
        For an unknown term.
    """

    name: TermName
    size: float = math.inf

    def __post_init__(self) -> None:
        """Take a name that is given as plain text, too."""
        if self.name not in list(TermName):
            raise InputError("ModelTerm", f"the term '{self.name}' is unknown",
                             known_are(self.name, TermName))
        object.__setattr__(self, "name", TermName(self.name))

    @property
    def free(self) -> bool:
        """Whether the readings alone are to tell it."""
        return math.isinf(self.size)

    def __str__(self) -> str:
        """Return the term as it is written in an option."""
        return str(self.name) if self.free else f"{self.name}:{self.size:g}"


def parse_terms(texts: Iterable[str], where: str) -> tuple[ModelTerm, ...]:
    """Return the terms written as ``TERM`` or ``TERM:SIZE``, in the order of `TermName`.

    Parameters
    ----------
    texts : iterable of str
        Each one term, or several separated by commas; empty ones are passed over.
    where : str
        Option, parameter or file, for messages.

    Raises
    ------
    InputError
        For an unknown term, one given twice, or a size that is none.
    """
    found: dict[TermName, ModelTerm] = {}
    for text in (part.strip() for item in texts for part in item.split(",")):
        if not text:
            continue
        name, colon, size = text.partition(":")
        if name not in list(TermName):
            raise InputError(where, f"the term '{name}' is unknown", known_are(name, TermName))
        term = ModelTerm(TermName(name), _size(size, f"{where}: {name}") if colon else math.inf)
        if term.name in found:
            raise InputError(where, f"the term '{name}' is given twice", "remove one")
        found[term.name] = term
    return tuple(found[name] for name in TermName if name in found)


def _size(text: str, where: str) -> float:
    try:
        size = float(text)
    except ValueError:
        size = math.nan
    if not 0 < size < math.inf:
        raise InputError(where, f"the size '{text}' is not a positive number",
                         "give a standard deviation in SI units, as in plate_shape:30e-9")
    if not SMALLEST <= size <= LARGEST:
        raise InputError(where, f"the size {text} is outside {SMALLEST:g} to {LARGEST:g}",
                         "give a standard deviation in SI units, as in plate_shape:30e-9")
    return size
