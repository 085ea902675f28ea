# SPDX-License-Identifier: Apache-2.0
"""The columns of the terms: what a unit of each coefficient does to every reading.

In the plate frame; each block says its own (`selfcal_ros.blocks`).

At the marks they are stored as complex shapes; a column is 1 or i times a shape. Most terms come in
pairs, the same along x and along y, and most belong to one view: a drift of degree 3 in five views
has 30 columns of 5 x 441 numbers each, and 15 shapes of 441. Up to the misalignments the equations
are linear over the complex numbers and computed for the shapes; the products of the columns follow:

    Re(conj(u c) v d) = Re(conj(u) v <c, d>),     u, v in {1, i}
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from selfcal_ros.blocks import Block, block_of, blocks, traits_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.terms.visits import TermInputs, ViewVisits, squares_within
from selfcal_ros.model.terms import ModelTerm

AtVisits = list[dict[int, np.ndarray]]


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes at the means of the marks, and the columns made of them.

    Attributes
    ----------
    n : int
        Number of shapes, q.
    lattice : tuple of int
        Marks along x and y.
    rows : tuple of int array
        Indices of the shapes of each view, (k,); all others are 0 in it.
    values : tuple of complex array
        Their values, (k, marks), plate frame; 0 where not read.
    of_column : int array (p,)
        The shape of each column.
    unit : complex array (p,)
        1 or i, the factor of the shape.
    """

    n: int
    lattice: tuple[int, int]
    rows: tuple[np.ndarray, ...]
    values: tuple[np.ndarray, ...]
    of_column: np.ndarray
    unit: np.ndarray

    @cached_property
    def grid(self) -> np.ndarray:
        """The expanded columns, complex (p, views, nx, ny)."""
        out = np.zeros((len(self.unit), len(self.rows), *self.lattice), dtype=complex)
        for view, (rows, values) in enumerate(zip(self.rows, self.values, strict=True)):
            at = np.full(self.n, -1)
            at[rows] = np.arange(len(rows))
            columns = np.flatnonzero(at[self.of_column] >= 0)
            out[columns, view] = (
                self.unit[columns, None] * values[at[self.of_column[columns]]]
            ).reshape(-1, *self.lattice)
        return out

    def of_columns(self, of_shapes: np.ndarray) -> np.ndarray:
        """Return values linear in the shapes, complex (..., q), for the columns, (..., p)."""
        return of_shapes[..., self.of_column] * self.unit

    def products(self, inner: np.ndarray) -> np.ndarray:
        """Return real inner products of the columns, (p, p), from those of the shapes, (q, q)."""
        pairs = inner[self.of_column[:, None], self.of_column]
        return (pairs * (self.unit.conj()[:, None] * self.unit)).real

    def against(self, inner: np.ndarray) -> np.ndarray:
        """Return Re(conj(column) e), (p,), from the sums of conj(e) times the shapes, (q,)."""
        return self.of_columns(inner).real

    def sums(self, field: np.ndarray) -> np.ndarray:
        """Return the sums of conj(field) times each shape, (q,); field (views, nx, ny)."""
        out = np.zeros(self.n, dtype=complex)
        for rows, values, of_view in zip(self.rows, self.values, field, strict=True):
            out[rows] += values @ of_view.reshape(-1).conj()
        return out

    def squares(self, weight: np.ndarray) -> np.ndarray:
        """Return the weighted sum of squares of each column, (p,); weight (views, nx, ny)."""
        out = np.zeros(self.n)
        for rows, values, of_view in zip(self.rows, self.values, weight, strict=True):
            out[rows] += (values.real**2 + values.imag**2) @ of_view.reshape(-1)
        return out[self.of_column]

    def combined(
        self, coefficients: np.ndarray, only: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the sum of coefficients (p,) times columns, complex (views, nx, ny).

        `only`, bool (p,), selects columns.
        """
        selected = slice(None) if only is None else only
        coefficient_of_shape: np.ndarray = np.zeros(self.n, dtype=complex)
        np.add.at(
            coefficient_of_shape,
            self.of_column[selected],
            (coefficients * self.unit)[selected],
        )
        out = np.empty((len(self.rows), *self.lattice), dtype=complex)
        for of_view, rows, values in zip(out, self.rows, self.values, strict=True):
            of_view[...] = (coefficient_of_shape[rows] @ values).reshape(self.lattice)
        return out

    def chosen(self, columns: np.ndarray) -> "Shapes":
        """Return some of the columns, bool (p,); the shapes are the same."""
        return replace(self, of_column=self.of_column[columns], unit=self.unit[columns])


@dataclass(frozen=True, eq=False)
class LineColumns:
    """Columns of the readings of lines: indices, int (q,), and values (q, views, K)."""

    at: np.ndarray
    values: np.ndarray

    def sums(self, weighted: np.ndarray, power: int = 1) -> np.ndarray:
        """Return the sums of values, to a power, times `weighted` (views, K), (q,)."""
        return np.array(
            [(value**power * weighted).sum() for value in self.values], dtype=float
        )


NO_LINES = LineColumns(np.zeros(0, dtype=int), np.zeros((0, 0, 0)))


def shapes_of(
    means: Sequence[Mapping[int, np.ndarray]],
    of_column: Sequence[int],
    unit: Sequence[complex],
    weight: np.ndarray,
) -> Shapes:
    """Return shapes given by their values in their views.

    Parameters
    ----------
    means : sequence of dict
        Values of each shape at the marks (marks,), by view.
    of_column, unit : sequences (p,)
        Shape of each column, and 1 or i.
    weight : float array (views, nx, ny)
        Weights of the readings, in the shape of the lattice.
    """
    rows, values = [], []
    for view in range(len(weight)):
        shapes_of_view = [at for at, mean in enumerate(means) if view in mean]
        rows.append(np.array(shapes_of_view, dtype=int))
        values.append(
            np.array([means[at][view] for at in shapes_of_view], dtype=complex).reshape(
                len(shapes_of_view), weight[0].size
            )
        )
    return Shapes(
        n=len(means),
        lattice=weight.shape[1:],
        rows=tuple(rows),
        values=tuple(values),
        of_column=np.array(of_column, dtype=int),
        unit=np.array(unit, dtype=complex),
    )


@dataclass(frozen=True, eq=False)
class WithinMarks:
    """Information on the coefficients from the visits of each mark: see `visits`.

    Attributes
    ----------
    gram : float array (p, p)
        Weighted inner products of the columns about the means of their marks.
    right : float array (p,)
        The same with the deviations, m times the column's unit.
    total : float
        Weighted sum of squares of the deviations about the means of their marks, m^2.
    dof : int
        Its degrees of freedom.
    """

    gram: np.ndarray
    right: np.ndarray
    total: float
    dof: int


def within_marks(
    visits: Sequence[ViewVisits | None], at_visits: AtVisits, shapes: Shapes
) -> WithinMarks:
    """Return within-mark sums lost by averaging.

    Parameters
    ----------
    visits : sequence of ViewVisits or None
        Visits of each view.
    at_visits : list of dict
        Values of each shape at the visits, as in `TermColumns`.
    shapes : Shapes
        Those at the means, and the columns.
    """
    n_marks = shapes.lattice[0] * shapes.lattice[1]
    inner: np.ndarray = np.zeros((shapes.n, shapes.n), dtype=complex)
    against: np.ndarray = np.zeros(shapes.n, dtype=complex)
    dof = 0
    for view, view_visits in enumerate(visits):
        if view_visits is None or not view_visits.repeated:
            continue
        dof += 2 * view_visits.n_repeats
        shapes_of_view = [
            number for number, values in enumerate(at_visits) if view in values
        ]
        if shapes_of_view:
            values = np.array([at_visits[number][view] for number in shapes_of_view])
            # about the means of their marks: then those of the others drop out
            weighted = (
                np.conj(view_visits.about_means(values, n_marks)) * view_visits.weight
            )
            inner[np.ix_(shapes_of_view, shapes_of_view)] += weighted @ values.T
            against[shapes_of_view] += (weighted @ view_visits.y).conj()
    gram = shapes.products(inner)
    return WithinMarks(
        (gram + gram.T) / 2, shapes.against(against), squares_within(visits), dof
    )


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
        return traits_of(self.term).unit


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
        return [
            sum(
                (
                    value * shape[view]
                    for value, shape in zip(of_shape, self.at, strict=True)
                    if view in shape
                ),
                start=0.0,
            )
            for view in range(len(self.shapes.rows))
        ]

    def rows(self, names: Iterable[str]) -> np.ndarray:
        """Return which columns belong to the terms `names`, bool (p,)."""
        terms = set(names)
        return np.array([column.term in terms for column in self.columns], dtype=bool)

    def having(self, trait: Callable[[Block], bool]) -> np.ndarray:
        """Return which columns are those of blocks with a trait, bool (p,)."""
        terms = {name for name, block in blocks().items() if trait(block)}
        return self.rows(terms)

    def scaled(self, name: str, factor: float) -> "TermColumns":
        """Return the same columns with the sizes of the term `name` multiplied by `factor`."""
        return replace(
            self,
            columns=tuple(
                replace(column, size=column.size * factor)
                if column.term == name
                else column
                for column in self.columns
            ),
        )


@dataclass
class ColumnBuilder:
    """Columns under construction: their shapes at the marks (marks,) by view, and at the visits."""

    inputs: TermInputs
    columns: list[Column] = field(default_factory=list)
    of_column: list[int] = field(default_factory=list)
    unit: list[complex] = field(default_factory=list)
    means: list[dict[int, np.ndarray]] = field(default_factory=list)
    at: AtVisits = field(default_factory=list)
    lines: list[tuple[int, np.ndarray]] = field(default_factory=list)

    def add(
        self, means: dict[int, np.ndarray], at: dict[int, np.ndarray] | None = None
    ) -> int:
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
                _require_visits(self.inputs, term.name)
            patterns = list(block.patterns(self.inputs, term))
            numbers: dict[int, int] = {}  # patterns may share the values of their marks
            for pattern in patterns:
                if (values := id(pattern.marks)) not in numbers:
                    numbers[values] = self.add(
                        dict(pattern.marks), dict(pattern.visits)
                    )
                for component, unit in pattern.coefficients:
                    if size := term.size_of(component):
                        if pattern.lines is not None:
                            self.lines.append((len(self.columns), pattern.lines))
                        column = Column(term.name, pattern.view, component, size)
                        self.column(column, numbers[values], unit)

    def build(self) -> TermColumns:
        """Return the columns."""
        shapes = shapes_of(self.means, self.of_column, self.unit, self.inputs.weight)
        at, values = zip(*self.lines, strict=True) if self.lines else ((), ())
        within = within_marks(self.inputs.visits, self.at, shapes)
        return TermColumns(
            tuple(self.columns),
            shapes,
            within,
            self.at,
            LineColumns(np.array(at), np.stack(values)) if at else NO_LINES,
        )


def term_columns(inputs: TermInputs, terms: Iterable[ModelTerm]) -> TermColumns:
    """Return the columns of `terms`.

    Parameters
    ----------
    inputs : TermInputs
        Plate, views, visits.
    terms : iterable of ModelTerm
        What is wanted.

    Raises
    ------
    InputError
        If a term needs to know the visits of a view, and they are not known.
    """
    builder = ColumnBuilder(inputs)
    builder.add_terms(terms)
    return builder.build()


def _require_visits(inputs: TermInputs, name: str) -> None:
    for view, visits in zip(inputs.names, inputs.visits, strict=True):
        if visits is None:
            raise InputError(
                f"view '{view}'",
                f"the term '{name}' needs the time, the offset and the direction of "
                "approach of each reading, and the readings do not contain them",
                "solve from the bag, or leave the term out",
            )
