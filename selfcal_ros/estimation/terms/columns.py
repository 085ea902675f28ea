# SPDX-License-Identifier: Apache-2.0
"""The columns of the terms: what a unit of each coefficient does to every reading.

In the plate frame, with o the offset seen, tau the view's time in [-1, 1], z the mark, H the half
width and s the signs of approach (reality of machines; docs/method.md, terms of the model):

    microscope   V has -E o                  4 coefficients, shared
    drift        V has sum_l d_l P_l(tau)     2 a degree and view (Legendre)
    plate_scale  V has b z                    1 a view
    plate_shape  V has a quadratic form of z/H, 6 a view
    approach     V has +-(h_x s_x + i h_y s_y)  2, shared; minus where the plate moves
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.special import eval_legendre

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.visits import ViewVisits
from selfcal_ros.model.terms import UNITS, VISIT_TERMS, ModelTerm, TermName


@dataclass(frozen=True)
class Column:
    """One coefficient: its term (or ``slip``), grid view (-1 = all), what it is, its size."""

    term: str
    view: int
    component: str
    size: float

    @property
    def unit(self) -> str:
        """SI unit of the coefficient."""
        return UNITS.get(self.term, "m")


@dataclass(frozen=True, eq=False)
class WithinMarks:
    """What the visits of each mark tell about the coefficients, and leave: see `visits`.

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


@dataclass(frozen=True, eq=False)
class TermColumns:
    """Columns of a set of terms.

    Attributes
    ----------
    columns : tuple of Column
        What each is, p of them.
    grid : complex array (p, views, nx, ny)
        Mean over the visits of every mark, plate frame; 0 where not read.
    within : WithinMarks
        What the means hide.
    seen : list
        Values of each column at the visits of each view, (V,), plate frame; None where they are
        those of the means.
    """

    columns: tuple[Column, ...]
    grid: np.ndarray
    within: WithinMarks
    seen: list[list[np.ndarray | None]]

    @property
    def size(self) -> np.ndarray:
        """Known standard deviation of every coefficient, (p,); infinite if free."""
        return np.array([column.size for column in self.columns])

    def at_visits(self, coefficients: np.ndarray) -> list[np.ndarray | float]:
        """Return what the terms make of each visit of each view, (V,), plate frame, m.

        Up to what is the same at all visits of a mark.
        """
        views = len(self.seen[0]) if self.seen else 0
        return [sum((value * column[view] for value, column in zip(
            coefficients, self.seen, strict=True) if column[view] is not None), start=0.0)
            for view in range(views)]

    def rows(self, names: Iterable[str]) -> np.ndarray:
        """Return which columns belong to the terms `names`, bool (p,)."""
        wanted = set(names)
        return np.array([column.term in wanted for column in self.columns], dtype=bool)

    def with_size(self, name: str, size: float) -> "TermColumns":
        """Return the same columns with another size of the term `name`."""
        return replace(self, columns=tuple(
            replace(column, size=size) if column.term == name else column
            for column in self.columns))


Parts = list[tuple[str, Callable[[ViewVisits], np.ndarray]]]


class Made(NamedTuple):
    """A column: means at the marks (nx, ny) by view, 0 in others; values as in `TermColumns`."""

    column: Column
    means: dict[int, np.ndarray]
    seen: list[np.ndarray | None]


def term_columns(ground: Ground, terms: Iterable[ModelTerm], degree: int) -> TermColumns:
    """Return the columns of `terms`.

    Parameters
    ----------
    ground : Ground
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
    made: list[Made] = []
    for term in terms:
        if term.name in VISIT_TERMS:
            _require_visits(ground, term.name)
            made += _visit_columns(ground, term, degree)
        else:
            made += _plate_columns(ground, term)
    return _stacked(ground, made)


def made_anew(ground: Ground, term: ModelTerm, before: TermColumns) -> TermColumns:
    """Return columns of which those of one shared term of the visits are of another ground.

    Parameters
    ----------
    ground : Ground
        With the same readings as before, but other offsets or signs of approach.
    term : ModelTerm
        The term, one that all views share: its columns are made anew.
    before : TermColumns
        Columns of all terms.
    """
    at = np.flatnonzero(before.rows([term.name]))
    grid, seen = before.grid.copy(), list(before.seen)
    for row, (_, means, values) in zip(at, _visit_columns(ground, term, 0), strict=True):
        _fill(grid[row], means)
        seen[row] = values
    return TermColumns(before.columns, grid, _within_anew(ground, seen, before.within, at), seen)


def columns_from(ground: Ground, columns: Iterable[Column],
                 shapes: Iterable[np.ndarray]) -> TermColumns:
    """Return columns of one view each, given by their values at its visits (V,), plate frame."""
    made = []
    for column, values in zip(columns, shapes, strict=True):
        visits = ground.visits[column.view]
        if visits is None:
            raise ValueError(f"column of view {column.view}: its visits are not known")
        means = visits.means(values[None], ground.z.size).reshape(ground.z.shape)
        seen: list[np.ndarray | None] = [None] * len(ground.names)
        seen[column.view] = values
        made.append(Made(column, {column.view: means}, seen))
    return _stacked(ground, made)


def _stacked(ground: Ground, made: list[Made]) -> TermColumns:
    grid = np.zeros((len(made), *ground.weight.shape), dtype=complex)
    for out, item in zip(grid, made, strict=True):
        _fill(out, item.means)
    seen = [item.seen for item in made]
    return TermColumns(tuple(item.column for item in made), grid, _within(ground, seen), seen)


def _fill(out: np.ndarray, means: dict[int, np.ndarray]) -> None:
    for view, values in means.items():
        out[view] = values


def joined(ground: Ground, first: TermColumns, second: TermColumns) -> TermColumns:
    """Return the columns of both."""
    seen = [*first.seen, *second.seen]
    return TermColumns((*first.columns, *second.columns),
                       np.concatenate([first.grid, second.grid]), _within(ground, seen), seen)


def _require_visits(ground: Ground, name: TermName) -> None:
    for view, visits in zip(ground.names, ground.visits, strict=True):
        if visits is None:
            raise InputError(f"view '{view}'", f"the term '{name}' needs to know when, with which "
                             "offset and from where each mark was read, and the readings do not "
                             "tell it", "solve from the bag, or leave the term out")


def _visit_columns(ground: Ground, term: ModelTerm,
                   degree: int) -> list[Made]:
    if term.name is TermName.DRIFT:
        out = []
        for view in range(len(ground.names)):
            for order in range(1, degree + 1):
                parts = _drift_parts(order)
                out += [_of_visits(ground, Column(term.name, view, text, term.size), shape)
                        for text, shape in parts]
        return out
    parts = _microscope_parts() if term.name is TermName.MICROSCOPE else _approach_parts(ground)
    return [_of_visits(ground, Column(term.name, -1, text, term.size), shape)
            for text, shape in parts]


def _drift_parts(order: int) -> Parts:
    return [(f"x P{order}", lambda v: eval_legendre(order, v.time) + 0j),
            (f"y P{order}", lambda v: 1j * eval_legendre(order, v.time))]


def _microscope_parts() -> Parts:
    # E o = (e_xx o_x + e_xy o_y) + i (e_yx o_x + e_yy o_y); a reading has o where it should
    # have (1 + E) o
    return [("xx", lambda v: -v.offset.real + 0j), ("xy", lambda v: -v.offset.imag + 0j),
            ("yx", lambda v: -1j * v.offset.real), ("yy", lambda v: -1j * v.offset.imag)]


def _approach_parts(ground: Ground) -> Parts:
    return [("x", lambda v: ground.indicated * v.approach_x + 0j),
            ("y", lambda v: 1j * ground.indicated * v.approach_y)]


def _of_visits(ground: Ground, column: Column,
               shape: Callable[[ViewVisits], np.ndarray]) -> Made:
    """Return a column of the visits: its means at the marks, and its values at the visits."""
    means: dict[int, np.ndarray] = {}
    values: list[np.ndarray | None] = []
    for view, visits in enumerate(ground.visits):
        if visits is None or column.view not in (-1, view):
            values.append(None)
            continue
        at = shape(visits) * visits.phase
        means[view] = visits.means(at[None], ground.z.size)[0].reshape(ground.z.shape)
        values.append(at)
    return Made(column, means, values)


def _plate_columns(ground: Ground, term: ModelTerm) -> list[Made]:
    """Return columns of plate scale or shape: the same at all visits of a mark.

    A size says how far views scatter about what they have in common, so that each view has its
    own; free ones are relative to the first view, as what all have in common is the plate's.
    """
    first = 1 if term.free else 0
    out = []
    for view in range(first, len(ground.names)):
        for text, shape in _plate_shapes(ground, term.name):
            means = {view: np.where(ground.weight[view] > 0, shape, 0)}
            out.append(Made(Column(term.name, view, text, term.size), means,
                            [None] * len(ground.names)))
    return out


def _plate_shapes(ground: Ground, name: TermName) -> list[tuple[str, np.ndarray]]:
    if name is TermName.PLATE_SCALE:
        return [("scale", ground.z * ground.half_width_m)]
    x, y = ground.z.real, ground.z.imag
    # 2xy beside x^2 and y^2: a bending (x^2 - y^2, -2xy) then has coefficients of one size
    return [(f"{axis} {text}", unit * form) for axis, unit in (("x", 1), ("y", 1j))
            for text, form in (("xx", x * x), ("xy", 2 * x * y), ("yy", y * y))]


def _within(ground: Ground, seen: list[list[np.ndarray | None]]) -> WithinMarks:
    total, dof, n = 0.0, 0, len(seen)
    for visits in ground.visits:
        if visits is not None and visits.repeated:
            rest = visits.about_means(visits.y[None], ground.z.size)[0]
            total += float(visits.weight @ abs(rest) ** 2)
            dof += 2 * (len(visits.mark) - len(np.unique(visits.mark)))
    nothing = WithinMarks(np.zeros((n, n)), np.zeros(n), total, dof)
    return _within_anew(ground, seen, nothing, np.arange(n))


def _within_anew(ground: Ground, seen: list[list[np.ndarray | None]], before: WithinMarks,
                 changed: np.ndarray) -> WithinMarks:
    """Return what the means hide, the products of the columns `changed` set up anew."""
    gram, right = before.gram.copy(), before.right.copy()
    gram[changed], gram[:, changed], right[changed] = 0.0, 0.0, 0.0
    for view, visits in enumerate(ground.visits):
        mine = [k for k in changed if seen[k][view] is not None]
        if visits is None or not visits.repeated or not mine:
            continue
        here = [k for k in range(len(seen)) if seen[k][view] is not None]
        # about the means of their marks: then those of the others drop out
        moved = visits.about_means(np.array([seen[k][view] for k in mine]), ground.z.size)
        weighted = np.conj(moved) * visits.weight
        gram[np.ix_(mine, here)] += (weighted @ np.array([seen[k][view] for k in here]).T).real
        right[mine] += (weighted @ visits.y).real
    gram[:, changed] = gram[changed].T
    gram[np.ix_(changed, changed)] = _symmetric(gram[np.ix_(changed, changed)])
    return WithinMarks(gram, right, before.total, before.dof)


def _symmetric(square: np.ndarray) -> np.ndarray:
    return (square + square.T) / 2
