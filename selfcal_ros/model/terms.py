# SPDX-License-Identifier: Apache-2.0
"""Terms of the measurement model in addition to stage, plate and misalignments."""

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from functools import cache

from selfcal_ros.blocks import Block, block_of, blocks
from selfcal_ros.errors import InputError, known_are
from selfcal_ros.files import checked_fields
from selfcal_ros.plain_numbers import number_of

MAX_DRIFT_DEGREE = 9
"""Largest degree of the polynomial of a view's drift."""

DRIFT_DEGREE = 3
"""Default degree of this polynomial."""

UNDETERMINED = 0.3
"""Effect in standard uncertainties of the map, rms, from which a term that the readings do not
determine is assumed in its nominal size."""

TIMES = 3
"""How many times larger than assumed an effect is taken to show what U owes to the assumption."""

SMALLEST, LARGEST = 1e-18, 1.0
"""Valid sizes of terms in texts."""


@dataclass(frozen=True)
class ModelTerm:
    """A term estimated together with the map.

    Attributes
    ----------
    name : str
        Of its block (`selfcal_ros.blocks`).
    size : float
        Standard deviation of its coefficients as known from elsewhere, SI unit; infinite if
        the readings alone determine them, 0 if they are known to be zero.
    parts : tuple of float
        Standard deviations of the parts of its block, if they differ; `size` is then the largest.

    Raises
    ------
    InputError
        For an unknown term.
    """

    name: str
    size: float = math.inf
    parts: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        """Refuse an unknown name; the size of several parts is the largest."""
        _ = self.block
        if self.parts:
            object.__setattr__(self, "size", max(self.parts))

    @property
    def block(self) -> Block:
        """What it is."""
        return block_of(self.name)

    @property
    def free(self) -> bool:
        """Whether the readings alone determine it."""
        return math.isinf(self.size)

    def size_of(self, component: str) -> float:
        """Return the size of one coefficient; those of parts may differ."""
        for size, (_, components) in zip(self.parts, self.block.parts, strict=False):
            if component in components:
                return size
        return self.size

    def scaled(self, factor: float) -> "ModelTerm":
        """Return the term with all its sizes multiplied by `factor`."""
        return ModelTerm(
            self.name, self.size * factor, tuple(factor * p for p in self.parts)
        )

    @property
    def rounded_up(self) -> "ModelTerm":
        """The term with its size rounded up to two figures."""
        power = 10.0 ** (math.floor(math.log10(self.size)) - 1)
        return ModelTerm(
            self.name, float(f"{math.ceil(self.size / power) * power:.1e}")
        )

    def __str__(self) -> str:
        """Return the term as written in an option."""
        sizes = self.parts or (() if self.free else (self.size,))
        return ":".join([str(self.name), *(f"{size:g}" for size in sizes)])


def default_of(block: Block) -> ModelTerm:
    """Return what is assumed of a block for every measurement unless it is declared."""
    if block.parts:
        return ModelTerm(block.name, parts=block.sizes)
    return ModelTerm(block.name, max(block.sizes))


def nominal_terms(known_terms: Collection[str], *, visits: bool) -> list[ModelTerm]:
    """Return terms that are not assumed by default, except `known_terms`, in nominal sizes.

    `visits`: whether the visits of all views are known, as some terms require.
    """
    return [
        ModelTerm(block.name, block.nominal)
        for block in blocks().values()
        if block.nominal
        and not (block.sizes or block.part_of or block.name in known_terms)
        and (visits or not block.needs_visits)
    ]


@cache
def default_terms() -> tuple[ModelTerm, ...]:
    """Return the assumptions for every measurement unless declared (GUM type B)."""
    return tuple(default_of(block) for block in blocks().values() if block.sizes)


def block_of_offsets() -> Block:
    """Return the block whose columns are made of the measured offsets of marks."""
    return next(block for block in blocks().values() if block.of_microscope)


def microscope_term(*parts: float) -> ModelTerm:
    """Return the microscope's term from prior standard uncertainties.

    Parameters
    ----------
    parts : float
        Standard uncertainty of its scale (m/m), of its rotation relative to the axes (rad), and of
        half the difference of its scales and half its squareness error; missing ones by default.
    """
    block = block_of_offsets()
    return ModelTerm(block.name, parts=(*parts, *block.sizes[len(parts) :]))


def parse_terms(texts: Iterable[str], where: str) -> tuple[ModelTerm, ...]:
    """Return the terms written as ``TERM`` or ``TERM:SIZE``, in the order of the blocks.

    One with parts may have a size of each, ``microscope:SCALE:TURN:SHEAR``. A size of 0 means that
    the term is known to be zero.

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
    terms: dict[str, ModelTerm] = {}
    for text in (piece.strip() for item in texts for piece in item.split(",")):
        if not text:
            continue
        name, colon, size = text.partition(":")
        if name not in blocks():
            raise InputError(
                where, f"the term '{name}' is unknown", known_are(name, blocks())
            )
        term = _term(name, size.split(":") if colon else [], f"{where}: {name}")
        if term.name in terms:
            raise InputError(where, f"the term '{name}' is given twice", "remove one")
        terms[term.name] = term
    return in_order(terms.values())


def in_order(terms: Iterable[ModelTerm]) -> tuple[ModelTerm, ...]:
    """Return terms in the order of the blocks."""
    term_of_name = {term.name: term for term in terms}
    return tuple(term_of_name[name] for name in blocks() if name in term_of_name)


def _term(name: str, texts: list[str], where: str) -> ModelTerm:
    sizes = [parse_size(text, where) for text in texts]
    parts = block_of(name).parts
    if len(sizes) < 2:
        return ModelTerm(name, sizes[0] if sizes else math.inf)
    if len(sizes) != len(parts):
        raise InputError(
            where,
            f"{len(sizes)} sizes are given",
            "give one"
            + (
                f", or those of {':'.join([name, *(part_name.upper() for part_name, _ in parts)])}"
                if parts
                else ""
            ),
        )
    return ModelTerm(name, parts=tuple(sizes))


def parse_size(text: str, where: str) -> float:
    """Return a size written in SI units, or 0."""
    try:
        size = number_of(text)
    except ValueError:
        size = math.nan
    if not 0 <= size < math.inf:
        raise InputError(
            where,
            f"the size '{text}' is not a positive number",
            "give a standard deviation in SI units, as in plate_shape:30e-9, or 0 "
            "for a term that is known to be zero",
        )
    if size and not SMALLEST <= size <= LARGEST:
        raise InputError(
            where,
            f"the size {text} is outside {SMALLEST:g} to {LARGEST:g}",
            "give a standard deviation in SI units, as in plate_shape:30e-9",
        )
    return size


def with_microscope(terms: tuple[str, ...], raw: dict, where: str) -> tuple[str, ...]:
    """Return the terms, including the microscope's from the plan."""
    if not raw:
        return terms
    fields = checked_fields(
        raw,
        where,
        {},
        {
            "scale_u": (float, 0.01),
            "rotation_u": (float, 0.01),
            "shear_u": (float, 0.002),
        },
    )
    declared = microscope_term(
        *(parse_size(f"{size:g}", where) for size in fields.values())
    )
    if any(term.partition(":")[0] == declared.name for term in terms):
        raise InputError(
            where, "model_terms has a microscope as well", "leave one of them out"
        )
    return tuple(map(str, parse_terms([*terms, str(declared)], where)))


def terms_of(texts: list, where: str) -> tuple[str, ...]:
    """Return the terms in PLAN.yaml as texts in their usual form."""
    where = f"{where}: model_terms"
    for text in texts:
        if not isinstance(text, str):
            raise InputError(
                where, f"{text!r} is not a text", "write TERM or TERM:SIZE"
            )
    return tuple(str(term) for term in parse_terms(texts, where))


def merged(
    terms: Iterable[ModelTerm], more: Collection[ModelTerm]
) -> tuple[ModelTerm, ...]:
    """Return `terms` with `more`, which replace those of the same name."""
    named = {term.name for term in more}
    return (*(term for term in terms if term.name not in named), *more)
