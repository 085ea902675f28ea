# SPDX-License-Identifier: Apache-2.0
"""Terms of the measurement model in addition to stage, plate and misalignments."""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from enum import StrEnum

from selfcal_ros.errors import InputError, known_are
from selfcal_ros.files import checked_fields

MAX_DRIFT_DEGREE = 9
"""Largest degree of the polynomial of a view's drift."""

DRIFT_DEGREE = 3
"""Default degree of this polynomial."""

SMALLEST, LARGEST = 1e-18, 1.0
"""Valid sizes of terms in texts."""


class TermName(StrEnum):
    """Names of the terms, as in ``--model``, ``model_terms`` and RESULT.json.

    MICROSCOPE: a 2x2 matrix E shared by all views, mark = indicated + (1 + E) offset.
    DRIFT: the plate moves relative to the stage during a view, a polynomial of time.
    PLATE_SCALE: the plate is larger by a factor 1 + b in a view (temperature).
    PLATE_SHAPE: the plate is bent in a view, quadratic in position (clamping, gravity).
    APPROACH: the indicated position depends on the direction from which an axis arrived.
    PLATE_STRAIN: the plate is strained linearly in a view (clamping): scale, stretch and shear.
    LINE_ECCENTRICITY: the circle of lines is eccentric to the axis of rotation, differently in each
    view, as a fraction of its radius.
    ROTATION: the plate turns between the marks and the lines of a view.
    YAW: the stage turns, by another angle at each site; only marks off the optical axis show it.
    """

    MICROSCOPE = "microscope"
    DRIFT = "drift"
    PLATE_SCALE = "plate_scale"
    PLATE_SHAPE = "plate_shape"
    APPROACH = "approach"
    PLATE_STRAIN = "plate_strain"
    LINE_ECCENTRICITY = "line_eccentricity"
    ROTATION = "rotation"
    YAW = "yaw"


VISIT_TERMS = frozenset({TermName.MICROSCOPE, TermName.DRIFT, TermName.APPROACH})
"""Terms that need instant, offset or approach of each reading."""

UNITS: dict[str, str] = {
    TermName.MICROSCOPE: "m/m", TermName.DRIFT: "m", TermName.PLATE_SCALE: "m/m",
    TermName.PLATE_SHAPE: "m", TermName.APPROACH: "m", TermName.PLATE_STRAIN: "m/m",
    TermName.LINE_ECCENTRICITY: "rad", TermName.ROTATION: "rad", TermName.YAW: "rad"}
"""Unit of each term's size: a standard deviation known from elsewhere. For a drift it is that at
the edge of the view's time, for a shape at the middle of the plate's edge."""

NOMINAL_SIZES = {
    TermName.MICROSCOPE: 1e-3, TermName.DRIFT: 10e-9, TermName.PLATE_SCALE: 1e-6,
    TermName.PLATE_SHAPE: 10e-9, TermName.APPROACH: 10e-9, TermName.PLATE_STRAIN: 1e-6}
"""Sizes for which the effect of a term outside the model is stated: 1 mrad and 0.1 %, 10 nm,
1 um/m. Terms of the marks only: lines do not affect the XY map."""

OF_PLATE = (TermName.PLATE_SCALE, TermName.PLATE_SHAPE, TermName.PLATE_STRAIN)
"""Terms of the plate itself, which differ between views and turn with it."""

SHARED = (TermName.MICROSCOPE, TermName.APPROACH, TermName.YAW)
"""Terms whose coefficients all views share."""

OF_LINES = (TermName.LINE_ECCENTRICITY, TermName.ROTATION)
"""Terms that only readings of lines have, each view its own."""


@dataclass(frozen=True)
class ModelTerm:
    """A term estimated together with the map.

    Attributes
    ----------
    name : TermName
        Which.
    size : float
        Standard deviation of its coefficients as known from elsewhere, in `UNITS`; infinite if
        the readings alone determine them, 0 if they are known to be zero.
    parts : tuple of float
        For a microscope: standard deviations of scale, turn and shear, if they differ;
        `size` is then the largest.

    Raises
    ------
    InputError
        For an unknown term.
    """

    name: TermName
    size: float = math.inf
    parts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Accept a name as plain text, too."""
        if self.name not in list(TermName):
            raise InputError("ModelTerm", f"the term '{self.name}' is unknown",
                             known_are(self.name, TermName))
        object.__setattr__(self, "name", TermName(self.name))
        if self.parts:
            object.__setattr__(self, "size", max(self.parts))

    @property
    def free(self) -> bool:
        """Whether the readings alone determine it."""
        return math.isinf(self.size)

    def size_of(self, component: str) -> float:
        """Return the size of one coefficient; those of a microscope may differ."""
        if not self.parts:
            return self.size
        return self.parts[{"scale": 0, "turn": 1}.get(component, 2)]

    def scaled(self, factor: float) -> "ModelTerm":
        """Return the term with all its sizes multiplied by `factor`."""
        return ModelTerm(self.name, self.size * factor, tuple(factor * p for p in self.parts))

    @property
    def rounded_up(self) -> "ModelTerm":
        """The term with its size rounded up to two figures."""
        power = 10.0 ** (math.floor(math.log10(self.size)) - 1)
        return ModelTerm(self.name, float(f"{math.ceil(self.size / power) * power:.1e}"))

    def __str__(self) -> str:
        """Return the term as written in an option."""
        sizes = self.parts or (() if self.free else (self.size,))
        return ":".join([str(self.name), *(f"{size:g}" for size in sizes)])


def microscope_term(scale_u: float = 0.01, rotation_u: float = 0.01,
                    shear_u: float = 0.002) -> ModelTerm:
    """Return the microscope's term from prior standard uncertainties.

    Parameters
    ----------
    scale_u, rotation_u, shear_u : float
        Standard uncertainty of its scale (m/m), of its rotation relative to the axes (rad), and of
        half the difference of its scales and half its squareness error.
    """
    return ModelTerm(TermName.MICROSCOPE, parts=(scale_u, rotation_u, shear_u))


DEFAULT_TERMS = (
    microscope_term(),
    ModelTerm(TermName.PLATE_STRAIN, 7e-8),
    ModelTerm(TermName.LINE_ECCENTRICITY, 2e-6),
    ModelTerm(TermName.ROTATION, 1e-7),
    ModelTerm(TermName.YAW, 1e-4))
"""Assumptions for every measurement unless declared (GUM type B): the pixel size is known to 1 %
and the rotation of the camera to 10 mrad; a plate of fused silica is strained by 5e-8 by clamping
and by as much again by 0.1 K; the circle of lines is centred to 0.1 um at a radius of 50 mm, and
moves by 5 nm there between the marks and the lines of a view; the stage turns by 0.1 mrad (20")
from site to site, more than the yaw of almost any stage, so that images determine it."""


def parse_terms(texts: Iterable[str], where: str) -> tuple[ModelTerm, ...]:
    """Return the terms written as ``TERM`` or ``TERM:SIZE``, in the order of `TermName`.

    A microscope may have three sizes, ``microscope:SCALE:TURN:SHEAR``. A size of 0 means that the
    term is known to be zero.

    Parameters
    ----------
    texts : iterable of str
        Each one term, or several separated by commas; empty ones are ignored.
    where : str
        Option, parameter or file, for messages.

    Raises
    ------
    InputError
        For an unknown or duplicate term, or an invalid size.
    """
    found: dict[TermName, ModelTerm] = {}
    for text in (part.strip() for item in texts for part in item.split(",")):
        if not text:
            continue
        name, colon, size = text.partition(":")
        if name not in list(TermName):
            raise InputError(where, f"the term '{name}' is unknown", known_are(name, TermName))
        term = _term(TermName(name), size.split(":") if colon else [], f"{where}: {name}")
        if term.name in found:
            raise InputError(where, f"the term '{name}' is given twice", "remove one")
        found[term.name] = term
    return tuple(found[name] for name in TermName if name in found)


def _term(name: TermName, texts: list[str], where: str) -> ModelTerm:
    sizes = [_size(text, where) for text in texts]
    if len(sizes) < 2:
        return ModelTerm(name, sizes[0] if sizes else math.inf)
    if name is not TermName.MICROSCOPE or len(sizes) != 3:
        raise InputError(where, f"{len(sizes)} sizes are given",
                         "give one, or those of microscope:SCALE:TURN:SHEAR")
    return microscope_term(*sizes)


def _size(text: str, where: str) -> float:
    try:
        size = float(text)
    except ValueError:
        size = math.nan
    if not 0 <= size < math.inf:
        raise InputError(where, f"the size '{text}' is not a positive number",
                         "give a standard deviation in SI units, as in plate_shape:30e-9, or 0 "
                         "for a term that is known to be zero")
    if size and not SMALLEST <= size <= LARGEST:
        raise InputError(where, f"the size {text} is outside {SMALLEST:g} to {LARGEST:g}",
                         "give a standard deviation in SI units, as in plate_shape:30e-9")
    return size


def with_microscope(terms: tuple[str, ...], raw: dict, where: str) -> tuple[str, ...]:
    """Return the terms, including the microscope's from the plan."""
    if not raw:
        return terms
    fields = checked_fields(raw, where, {}, {
        "scale_u": (float, 0.01), "rotation_u": (float, 0.01), "shear_u": (float, 0.002)})
    if any(term.startswith(TermName.MICROSCOPE) for term in terms):
        raise InputError(where, "model_terms has a microscope as well", "leave one of them out")
    sizes = ":".join(f"{size:g}" for size in fields.values())
    return tuple(map(str, parse_terms([*terms, f"{TermName.MICROSCOPE}:{sizes}"], where)))


def terms_of(texts: list, where: str) -> tuple[str, ...]:
    """Return the terms in PLAN.yaml as texts in their usual form."""
    where = f"{where}: model_terms"
    for text in texts:
        if not isinstance(text, str):
            raise InputError(where, f"{text!r} is not a text", "write TERM or TERM:SIZE")
    return tuple(str(term) for term in parse_terms(texts, where))


def merged(terms: Iterable[ModelTerm], more: Collection[ModelTerm]) -> tuple[ModelTerm, ...]:
    """Return `terms` with `more`, which replace those of the same name."""
    named = {term.name for term in more}
    return (*(term for term in terms if term.name not in named), *more)
