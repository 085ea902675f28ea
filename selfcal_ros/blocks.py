# SPDX-License-Identifier: Apache-2.0
"""Blocks: the effects that readings may have beside stage, plate and misalignments.

A block is one effect: what a unit of its coefficients does to the readings, how well it is known,
what it is as a finding. Whatever estimates, tests, searches or reports terms of the model iterates
over the blocks; those of other packages are registered as entry points `selfcal.blocks`.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from typing import Any, Protocol

import numpy as np

from selfcal_ros.errors import InputError, known_are

ENTRY_POINTS = "selfcal.blocks"

BUILT_IN = (
    "microscope",
    "drift",
    "plate_scale",
    "plate_shape",
    "approach",
    "plate_strain",
    "line_eccentricity",
    "line_scale",
    "rotation",
    "yaw",
)
"""Modules of `selfcal_ros.estimation.terms`, in the order in which terms are listed."""

SHARED = -1
"""View of coefficients that all views share."""

AXES: tuple[tuple[str, complex], ...] = (("x", 1), ("y", 1j))
"""Along x and along y: what a coefficient multiplies the values of its pattern by."""

ByView = Mapping[int, np.ndarray]


@dataclass(frozen=True, eq=False)
class Pattern:
    """What coefficients do to the readings: a unit of each its factor times the same values.

    Attributes
    ----------
    coefficients : tuple of (str, complex)
        Component and factor of each, 1 or i.
    marks : dict of complex array (marks,)
        Values at the means of the marks of views, plate frame, m; none in others.
    visits : dict of complex array (visits,)
        Values at each visit of the views in which visits of a mark differ, plate frame, m.
    view : int
        View, or first view of the placing, whose coefficients they are; `SHARED` by all views.
    lines : float array (views of lines, lines), optional
        Values at the lines, rad: instead of those at the marks.
    """

    coefficients: tuple[tuple[str, complex], ...]
    marks: ByView = field(default_factory=dict)
    visits: ByView = field(default_factory=dict)
    view: int = SHARED
    lines: np.ndarray | None = None


@dataclass(frozen=True)
class Where:
    """What a combination of coefficients is, in the finding that it sizes.

    Attributes
    ----------
    view, against : str
        Its view, and the one from which it differs; empty if there is none.
    axis, part : str
        ``x`` or ``y``, and its component; empty where that says nothing.
    unit : str
        Its SI unit; empty for that of the block.
    least_u : float
        Standard uncertainty that it has at least, in that unit.
    """

    view: str = ""
    against: str = ""
    axis: str = ""
    part: str = ""
    unit: str = ""
    least_u: float = 0.0


Located = Iterator[tuple[Where, np.ndarray]]
"""Combinations of the coefficients, the most significant of which sizes a finding: what each is,
and the weights of the coefficients."""


class Coefficient(Protocol):
    """One coefficient of a block."""

    @property
    def view(self) -> int:
        """View whose coefficient it is, or `SHARED`."""
        ...

    @property
    def component(self) -> str:
        """Name of its component."""
        ...


class Estimates(Protocol):
    """Estimated coefficients of a block, SI units."""

    @property
    def columns(self) -> Sequence[Coefficient]:
        """The coefficients, (p,)."""
        ...

    @property
    def values(self) -> np.ndarray:
        """Their values, (p,)."""
        ...

    @property
    def covariance(self) -> np.ndarray:
        """Their covariance, (p, p)."""
        ...


def by_coefficient(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield every coefficient: the usual `Block.located`.

    Parameters
    ----------
    estimates : Estimates
        The coefficients of the block that explain the residuals.
    names : tuple of str
        Names of the views that the columns count.
    """
    for column, weights in zip(
        estimates.columns, np.eye(len(estimates.columns)), strict=True
    ):
        view = names[column.view] if column.view != SHARED else ""
        yield Where(view=view, part=column.component), weights


def differences(
    values: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far coefficients (p,) are apart, (p, p), and that in standard uncertainties."""
    variance = np.diag(covariance)
    spread = variance[:, None] + variance - 2 * covariance
    apart = np.abs(values[:, None] - values)
    return apart, apart / np.sqrt(np.maximum(spread, np.finfo(float).tiny))


@dataclass(frozen=True, eq=False)
class Block:
    """One effect.

    Attributes
    ----------
    name : str
        As in ``--model``, ``model_terms`` and RESULT.json.
    unit : str
        SI unit of coefficients and sizes: ``m``, ``m/m`` or ``rad``.
    patterns : callable
        Inputs (`TermInputs`) and the term (`ModelTerm`) -> the patterns of its coefficients.
    undetected : float
        A size so small that any readings that show the effect contradict it: with it a block joins
        the model if it is found in the residuals.
    nominal : float
        Size that is assumed where the readings do not determine the effect, if there are no
        `sizes`, and for which plans are judged; 0: neither.
    sizes : tuple of float
        Standard deviations that are assumed unless declared (GUM type B): one, or one of each of
        `parts`. Empty: the effect is not in the model unless it is asked for or found.
    parts : tuple of (str, tuple of str)
        Coefficients that may have sizes of their own: name of the size, components.
    families : tuple of tuple of str
        Components that a cause may have without the others: their size is also tested by itself.
    plausible : float
        Largest plausible size: a larger one is a fault.
    needs_visits : bool
        Whether it needs instant, offset or approach of each visit.
    of_lines, between : bool
        Whether only lines show it; whether only the difference between the marks and the lines of
        one view does.
    of_plate : bool
        Whether the plate has it, and turns it along; each placing its own.
    of_map : bool
        Whether it adds to the stage's error, and turns with that.
    of_offsets : bool
        Whether its columns are made of offsets that were measured, which hold the noise of the
        readings.
    of_images : bool
        Whether only images of several marks show it.
    of_time : bool
        Whether it goes on while a view is measured: measuring again does not remove it.
    shared : bool
        Whether all views have its coefficients in common.
    alone : callable
        Component -> whether such coefficients of a view are also tested by themselves.
    located : callable
        See `by_coefficient`.
    part_of : str
        The block, if any, with which this effect is a part of what is assumed.
    change : str
        Change of a plan that may determine it: ``view``, ``order`` or ``check_stops``.
    cure : str
        What to add to a plan that does not determine it.
    sentence : callable, optional
        Of a block of another package: a `Cause` -> what it is in words, e.g. "a stage that ...".
    action : str
        Of a block of another package: what to do about it.
    """

    name: str
    unit: str
    patterns: Callable[[Any, Any], Iterable[Pattern]]
    undetected: float
    nominal: float = 0.0
    sizes: tuple[float, ...] = ()
    parts: tuple[tuple[str, tuple[str, ...]], ...] = ()
    families: tuple[tuple[str, ...], ...] = ()
    plausible: float = float("inf")
    needs_visits: bool = False
    of_lines: bool = False
    between: bool = False
    of_plate: bool = False
    of_map: bool = False
    of_offsets: bool = False
    of_images: bool = False
    of_time: bool = False
    part_of: str = ""
    shared: bool = False
    alone: Callable[[str], bool] = lambda component: False
    located: Callable[[Estimates, tuple[str, ...]], Located] = by_coefficient
    change: str = "view"
    cure: str = ""
    sentence: Callable[[Any], str] | None = None
    action: str = ""

    @property
    def of_microscope(self) -> bool:
        """Whether its columns are made of the offsets of marks."""
        return self.of_offsets and not self.of_lines

    @property
    def turns_lines(self) -> bool:
        """Whether it turns the lines of a view against its marks."""
        return self.of_lines and (self.between or self.of_offsets)

    @property
    def by_placing(self) -> bool:
        """Whether each placing of the plate has its own coefficients."""
        return not (self.shared or self.of_lines)


@cache
def blocks() -> dict[str, Block]:
    """Return all blocks by name: those of this package, then those of others.

    Raises
    ------
    InputError
        If a block of another package cannot be loaded, or has the name of one of this package.
    """
    from importlib.metadata import entry_points  # slow, and only this needs it

    block_by_name = {
        name: import_module(f"selfcal_ros.estimation.terms.{name}").BLOCK
        for name in BUILT_IN
    }
    for point in sorted(entry_points(group=ENTRY_POINTS), key=lambda point: point.name):
        where = f"block '{point.name}' ({point.value})"
        try:
            block = point.load()
        except Exception as error:
            raise InputError(
                where,
                f"it cannot be loaded: {error}",
                "repair or remove the package that registers it",
            ) from error
        if (
            not isinstance(block, Block)
            or block.name != point.name
            or block.name in block_by_name
        ):
            raise InputError(
                where,
                "it is not a selfcal_ros.blocks.Block of this name, or another block has the name",
                "correct the package that registers it",
            )
        block_by_name[block.name] = block
    return block_by_name


def block_of(name: str) -> Block:
    """Return the block of a name.

    Raises
    ------
    InputError
        If there is none.
    """
    known_blocks = blocks()
    if name not in known_blocks:
        raise InputError(
            "model", f"the term '{name}' is unknown", known_are(name, known_blocks)
        )
    return known_blocks[name]


PLAIN = Block("", "m", patterns=lambda inputs, term: (), undetected=0.0)
"""A block without traits."""


def traits_of(name: str) -> Block:
    """Return the block of a name, or one without traits for what is not a block, as a slip."""
    return blocks().get(name, PLAIN)
