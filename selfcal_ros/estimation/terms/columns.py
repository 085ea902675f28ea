# SPDX-License-Identifier: Apache-2.0
"""The columns of the terms: what a unit of each coefficient does to every reading.

In the plate frame; each block says its own (`selfcal_ros.blocks`).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from selfcal_ros.blocks import Block, block_of, blocks
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.terms.shapes import (
    NO_LINES,
    AtVisits,
    LineColumns,
    Shapes,
    WithinMarks,
    shapes_of,
    within_anew,
    within_marks,
)
from selfcal_ros.estimation.terms.visits import TermInputs, squares_within
from selfcal_ros.model.terms import ModelTerm


@dataclass(frozen=True)
class Column:
    """One coefficient: its term (or ``slip``), view (-1 = all), what it is, its size."""

    term: str
    view: int
    component: str
    size: float

    @property
    def unit(self) -> str:
        """SI unit of the coefficient."""
        return blocks()[self.term].unit if self.term in blocks() else "m"


@dataclass(frozen=True, eq=False)
class TermColumns:
    """Columns of a set of terms.

    Attributes
    ----------
    columns : tuple of Column
        What each is, p of them.
    shapes : Shapes
        Mean over the visits of every mark, plate frame; 0 where not read.
    within : WithinMarks
        What the means hide.
    at : list of dict
        Values of each shape at the visits of views, (V,), plate frame; those of the means in
        other views.
    lines : LineColumns
        Those in the readings of lines, rad.
    """

    columns: tuple[Column, ...]
    shapes: Shapes
    within: WithinMarks
    at: AtVisits
    lines: LineColumns = NO_LINES

    @property
    def grid(self) -> np.ndarray:
        """The columns at the marks in full, complex (p, views, nx, ny)."""
        return self.shapes.grid

    @property
    def size(self) -> np.ndarray:
        """Known standard deviation of every coefficient, (p,); infinite if free."""
        return np.array([column.size for column in self.columns])

    def at_visits(self, coefficients: np.ndarray) -> list[np.ndarray | float]:
        """Return what the terms make of each visit of each view, (V,), plate frame, m.

        Up to what is the same at all visits of a mark.
        """
        of_shape = np.zeros(len(self.at), dtype=complex)
        np.add.at(of_shape, self.shapes.of_column, coefficients * self.shapes.unit)
        return [sum((value * shape[view] for value, shape in zip(
            of_shape, self.at, strict=True) if view in shape), start=0.0)
            for view in range(len(self.shapes.rows))]

    def rows(self, names: Iterable[str]) -> np.ndarray:
        """Return which columns belong to the terms `names`, bool (p,)."""
        wanted = set(names)
        return np.array([column.term in wanted for column in self.columns], dtype=bool)

    def having(self, trait: Callable[[Block], bool]) -> np.ndarray:
        """Return which columns are those of blocks with a trait, bool (p,)."""
        found = {name for name, block in blocks().items() if trait(block)}
        return self.rows(found)

    def scaled(self, name: str, factor: float) -> "TermColumns":
        """Return the same columns with the sizes of the term `name` multiplied by `factor`."""
        return replace(self, columns=tuple(
            replace(column, size=column.size * factor) if column.term == name else column
            for column in self.columns))


@dataclass
class ColumnBuilder:
    """Columns under construction: their shapes at the marks (marks,) by view, and at the visits."""

    ground: TermInputs
    columns: list[Column] = field(default_factory=list)
    of_column: list[int] = field(default_factory=list)
    unit: list[complex] = field(default_factory=list)
    means: list[dict[int, np.ndarray]] = field(default_factory=list)
    at: AtVisits = field(default_factory=list)
    lines: list[tuple[int, np.ndarray]] = field(default_factory=list)

    def add(self, means: dict[int, np.ndarray], at: dict[int, np.ndarray] | None = None) -> int:
        """Add a shape; return its number."""
        self.means.append(means)
        self.at.append(at or {})
        return len(self.means) - 1

    def column(self, column: Column, shape: int, unit: complex) -> None:
        """Add a column that is `unit` times a shape."""
        self.columns.append(column)
        self.of_column.append(shape)
        self.unit.append(unit)

    def add_terms(self, terms: Iterable[ModelTerm]) -> None:
        """Add the columns of terms, see `term_columns`."""
        for term in terms:
            block = block_of(term.name)
            if block.needs_visits:
                _require_visits(self.ground, term.name)
            patterns = list(block.patterns(self.ground, term))
            numbers: dict[int, int] = {}  # patterns may share the values of their marks
            for pattern in patterns:
                if (values := id(pattern.marks)) not in numbers:
                    numbers[values] = self.add(dict(pattern.marks), dict(pattern.visits))
                for component, unit in pattern.coefficients:
                    if size := term.size_of(component):
                        if pattern.lines is not None:
                            self.lines.append((len(self.columns), pattern.lines))
                        column = Column(term.name, pattern.view, component, size)
                        self.column(column, numbers[values], unit)

    def done(self) -> TermColumns:
        """Return the columns."""
        shapes = shapes_of(self.means, self.of_column, self.unit, self.ground.weight)
        at, values = zip(*self.lines, strict=True) if self.lines else ((), ())
        within = within_marks(self.ground.visits, self.at, shapes)
        return TermColumns(tuple(self.columns), shapes, within, self.at,
                           LineColumns(np.array(at), np.stack(values)) if at else NO_LINES)


def term_columns(ground: TermInputs, terms: Iterable[ModelTerm]) -> TermColumns:
    """Return the columns of `terms`.

    Parameters
    ----------
    ground : TermInputs
        Plate, views, visits.
    terms : iterable of ModelTerm
        What is wanted.

    Raises
    ------
    InputError
        If a term needs to know the visits of a view, and they are not known.
    """
    made = ColumnBuilder(ground)
    made.add_terms(terms)
    return made.done()


def made_anew(ground: TermInputs, term: ModelTerm | None, before: TermColumns, *,
              moved: bool = False) -> TermColumns:
    """Return columns of which those of one shared term of the visits are of another ground.

    Parameters
    ----------
    ground : TermInputs
        With other offsets or signs of approach.
    term : ModelTerm, optional
        One that all views share: its columns are made anew.
    before : TermColumns
        Columns of all terms.
    moved : bool
        Whether visits differ from the means of their marks otherwise than before.
    """
    fresh, at = ColumnBuilder(ground), list(before.at)
    own: dict[int, int] = {}
    if term is not None:
        fresh.add_terms([term])
        changed = before.shapes.of_column[before.rows([term.name])]
        # the shape of each new column takes the place of that of the same column before
        own = dict(zip(fresh.of_column, changed.tolist(), strict=True))
    for shape, number in own.items():
        at[number] = fresh.at[shape]
    shapes = before.shapes.replaced(list(own.values()), [fresh.means[shape] for shape in own])
    changed = np.arange(shapes.n) if moved else np.array(sorted(own.values()), dtype=int)
    total = squares_within(ground.visits) if moved else before.within.total
    within = within_anew(ground.visits, at, shapes, before=replace(before.within, total=total),
                         changed=changed)
    return TermColumns(before.columns, shapes, within, at, before.lines)


def _require_visits(ground: TermInputs, name: str) -> None:
    for view, visits in zip(ground.names, ground.visits, strict=True):
        if visits is None:
            raise InputError(f"view '{view}'", f"the term '{name}' needs the time, the offset and "
                             "the direction of approach of each reading, and the readings do not "
                             "contain them", "solve from the bag, or leave the term out")
