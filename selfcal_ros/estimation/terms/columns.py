# SPDX-License-Identifier: Apache-2.0
"""The columns of the terms: what a unit of each coefficient does to every reading.

In the plate frame, with o the offset seen, tau the view's time in [-1, 1], z the mark, H the half
width and s the signs of approach (reality of machines; docs/method.md, terms of the model):

    microscope   V has -E o                  4 coefficients, shared: E o = (s + ir) o + (a + ih) o*
    drift        V has sum_l d_l P_l(tau)     2 a degree and view (Legendre)
    plate_scale  V has b z                    1 a view
    plate_strain V has b z + (a + ih) z*      3 a view: scale, stretch, shear
    plate_shape  V has a quadratic form of z/H, 6 a view
    approach     V has +-(h_x s_x + i h_y s_y)  2, shared; minus where the plate moves
    line_eccentricity  Vtheta has c cos theta_k + s sin theta_k, 2 a view, rad
    rotation     Vtheta has r, 1 a view of marks and lines, rad
    yaw          V has -i yaw d at d in the image, 1 a node, shared
"""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import eval_legendre

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
from selfcal_ros.estimation.terms.visits import TermInputs, ViewVisits, squares_within
from selfcal_ros.model.terms import OF_LINES, UNITS, VISIT_TERMS, ModelTerm, TermName

AXES: tuple[tuple[str, complex], ...] = (("x", 1), ("y", 1j))
"""Along x and along y: what a column multiplies its shape by."""


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
        return UNITS.get(self.term, "m")


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

    def add_terms(self, terms: Iterable[ModelTerm], degree: int) -> None:
        """Add the columns of terms, see `term_columns`."""
        for term in terms:
            if term.name in VISIT_TERMS:
                _require_visits(self.ground, term.name)
            if term.name in OF_LINES:
                _line_columns(self, term)
            elif term.name is TermName.YAW:
                _yaw_columns(self, term)
            elif term.name not in VISIT_TERMS:
                _plate_columns(self, term)
            elif term.name is TermName.DRIFT:
                _drift_columns(self, term, degree)
            else:
                _shared_columns(self, term)

    def done(self) -> TermColumns:
        """Return the columns."""
        shapes = shapes_of(self.means, self.of_column, self.unit, self.ground.weight)
        at, values = zip(*self.lines, strict=True) if self.lines else ((), ())
        within = within_marks(self.ground.visits, self.at, shapes)
        return TermColumns(tuple(self.columns), shapes, within, self.at,
                           LineColumns(np.array(at), np.stack(values)) if at else NO_LINES)


def term_columns(ground: TermInputs, terms: Iterable[ModelTerm], degree: int) -> TermColumns:
    """Return the columns of `terms`.

    Parameters
    ----------
    ground : TermInputs
        Plate, views, visits.
    terms : iterable of ModelTerm
        What is wanted.
    degree : int
        Degree of a drift's polynomial.

    Raises
    ------
    InputError
        If a term needs to know the visits of a view, and they are not known.
    """
    made = ColumnBuilder(ground)
    made.add_terms(terms, degree)
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
        _shared_columns(fresh, term)
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


def _require_visits(ground: TermInputs, name: TermName) -> None:
    for view, visits in zip(ground.names, ground.visits, strict=True):
        if visits is None:
            raise InputError(f"view '{view}'", f"the term '{name}' needs the time, the offset and "
                             "the direction of approach of each reading, and the readings do not "
                             "contain them", "solve from the bag, or leave the term out")


def _drift_columns(made: ColumnBuilder, term: ModelTerm, degree: int) -> None:
    orders, ground = np.arange(1, degree + 1), made.ground
    for first, members in ground.members.items():
        values, means = {}, {}
        for view in members:
            if (visits := ground.visits[view]) is not None:
                values[view] = eval_legendre(orders[:, None], visits.time) * visits.phase
                means[view] = visits.means(values[view], ground.z.size)
        for row, order in enumerate(orders if values else ()):
            number = made.add({view: mean[row] for view, mean in means.items()},
                              {view: value[row] for view, value in values.items()})
            for axis, unit in AXES:
                made.column(Column(term.name, first, f"{axis} P{order}", term.size), number, unit)


def _shared_columns(made: ColumnBuilder, term: ModelTerm) -> None:
    """Add the columns of a term of the visits whose coefficients all views share."""
    ground, both, means = made.ground, {}, {}
    for view, visits in enumerate(ground.visits):
        if visits is not None:
            both[view] = _values(ground, term.name, visits) * visits.phase
            # in the nominal frame, as the map: an approach that every visit has is the map's
            frame = visits.frame if term.name is TermName.APPROACH else 1.0
            means[view] = visits.means(both[view] / frame, ground.z.size)
    for row, parts in enumerate(_SHARED[term.name]):
        number = made.add({view: mean[row] for view, mean in means.items()},
                          {view: values[row] for view, values in both.items()})
        for component, unit in parts:
            if size := term.size_of(component):
                made.column(Column(term.name, -1, component, size), number, unit)


_SHARED: dict[str, tuple[tuple[tuple[str, complex], ...], ...]] = {
    TermName.MICROSCOPE: ((("scale", 1), ("turn", 1j)), (("stretch", 1), ("shear", 1j))),
    TermName.APPROACH: ((("x", 1),), (("y", 1j),))}
"""Columns of each shape of a shared term: a name and the unit that multiplies the shape."""


def _values(ground: TermInputs, name: TermName, visits: ViewVisits) -> np.ndarray:
    """Return the two shapes of a shared term at the visits, stage frame, (2, V)."""
    if name is TermName.MICROSCOPE:  # a reading has o where it should have (1 + E) o
        return -np.stack([visits.offset, visits.offset.conj()])
    return ground.indicated * np.stack([visits.approach_x, visits.approach_y]).astype(complex)


def _yaw_columns(made: ColumnBuilder, term: ModelTerm) -> None:
    """Add the columns of the stage's yaw: the same at all visits of a mark."""
    ground = made.ground
    if ground.yaw is None:
        return
    phases = [nominal if view is None else view.phase
              for view, nominal in zip(ground.visits, ground.yaw.phases, strict=True)]
    here = ground.weight.reshape(len(phases), -1) > 0
    for node, means in enumerate(ground.yaw.columns(phases, _beside_cells(ground))):
        shape = made.add({view: values * here[view] for view, values in means.items()})
        made.column(Column(term.name, -1, f"node {node}", term.size), shape, 1)


def _beside_cells(ground: TermInputs) -> np.ndarray:
    """Return the offsets of marks from the places of their cells, stage axes, (views, marks), m.

    Of a cell the mean is that on the optical axis: its own holds the camera's error there.
    """
    out = np.zeros((len(ground.names), ground.z.size), dtype=complex)
    mean = np.zeros(len(out), dtype=complex)
    for row, visits in enumerate(ground.visits):
        if visits is not None:
            mean[row] = visits.offset.mean()
            out[row, visits.mark] = visits.means(visits.offset[None], ground.z.size)[0, visits.mark]
    for members in ground.members.values():
        axis = [row for row in members if ground.yaw is not None and not ground.yaw.arms[row]]
        out[members] += np.where(out[members], (mean[axis[0]] if axis else 0) - mean[
            members, None], 0)
    return out


def _plate_columns(made: ColumnBuilder, term: ModelTerm) -> None:
    """Add the columns of plate scale or shape: the same at all visits of a mark.

    A size says how far placings scatter about what they have in common, so that each has its own;
    free ones are relative to the first placing, as what all have in common is the plate's.
    """
    ground, forms = made.ground, _plate_forms(made.ground, term.name)
    for first, members in list(ground.members.items())[1 if term.free else 0:]:
        here = {view: ground.weight[view].reshape(-1) > 0 for view in members}
        numbers = [made.add({view: form * read for view, read in here.items()}) for form in forms]
        for component, form, unit in _PLATE[term.name]:
            made.column(Column(term.name, first, component, term.size), numbers[form], unit)


_PLATE: dict[str, tuple[tuple[str, int, complex], ...]] = {
    TermName.PLATE_SCALE: (("scale", 0, 1),),
    TermName.PLATE_STRAIN: (("scale", 0, 1), ("stretch", 1, 1), ("shear", 1, 1j)),
    TermName.PLATE_SHAPE: tuple((f"{axis} {form}", number, unit) for axis, unit in AXES
                                for number, form in enumerate(("xx", "xy", "yy")))}
"""Columns of each term of the plate: name, number of the form, and the unit that multiplies it."""


def _plate_forms(ground: TermInputs, name: TermName) -> np.ndarray:
    """Return the forms of a term of the plate at the marks, (k, marks)."""
    z = ground.z.reshape(-1)
    if name is TermName.PLATE_SHAPE:
        x, y = z.real, z.imag
        # 2xy beside x^2 and y^2: a bending (x^2 - y^2, -2xy) then has coefficients of one size
        return np.stack([x * x, 2 * x * y, y * y]).astype(complex)
    forms = np.stack([z, z.conj()]) * ground.half_width_m
    return forms[:1] if name is TermName.PLATE_SCALE else forms


def _line_columns(made: ColumnBuilder, term: ModelTerm) -> None:
    """Add the columns of a term of the lines, which no grid reading has."""
    ground, count = made.ground, len(made.ground.line_names)
    angle = 2 * np.pi / max(ground.n_lines, 1) * np.arange(ground.n_lines)
    views, waves = tuple(range(count)), {"cos": np.cos(angle), "sin": np.sin(angle)}
    if term.name is TermName.ROTATION:
        views, waves = ground.with_lines, {"turn": np.ones_like(angle)}
    for view in views[int(term.free):]:
        for component, wave in waves.items():
            values = np.zeros((count, ground.n_lines))
            values[view] = wave
            made.lines.append((len(made.columns), values))
            made.column(Column(term.name, view, component, term.size), made.add({}), 1)
