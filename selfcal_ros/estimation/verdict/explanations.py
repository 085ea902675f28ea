# SPDX-License-Identifier: Apache-2.0
"""What explains the residuals: terms, slips, single readings (method eqs. 7.7, 7.8).

A term that the model does not hold is tested by the sum of squares that its columns explain, with
as many degrees of freedom as the readings determine of them (F-test against the remainder). The
best one (Bayesian information criterion) is accepted first, and the others are tested together with
it, so that one cause does not appear under many names. Of terms that explain the same equally well
all are returned: the readings do not determine which of them it is.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.estimation.joint.model_fit import ModelFit, equations_of, squares
from selfcal_ros.estimation.joint.problem import FLOOR, noise_excess
from selfcal_ros.estimation.terms.columns import Column, ColumnBuilder
from selfcal_ros.estimation.terms.equations import Score, TermEquations, score
from selfcal_ros.estimation.terms.visits import without_noise
from selfcal_ros.estimation.verdict.off_sites import (
    READING,
    SLIP,
    PlacedSlip,
    add_slip,
    reading_columns,
    slip_columns,
)
from selfcal_ros.model.terms import ModelTerm


@dataclass(frozen=True, eq=False)
class Explained:
    """Joint fit of a set of columns to the residuals.

    Attributes
    ----------
    rows, at : bool array (p,), int array (k,)
        The columns: as a mask, k of p, and as indices.
    own_inverse, rank : float array (k, k), int
        Pseudo-inverse of their information, and its rank.
    own_values : float array (k,)
        Their estimated coefficients.
    explained : float
        Sum of squares that they explain, m^2.
    between, dof_between : float
        Remaining squares of the means of the marks, m^2, and their degrees of freedom.
    """

    rows: np.ndarray
    at: np.ndarray
    own_inverse: np.ndarray
    rank: int
    own_values: np.ndarray
    explained: float
    between: float
    dof_between: float

    @property
    def inverse(self) -> np.ndarray:
        """The pseudo-inverse for all columns, (p, p), 0 for the others."""
        out = np.zeros((len(self.rows),) * 2)
        out[self.at[:, None], self.at] = self.own_inverse
        return out

    @property
    def values(self) -> np.ndarray:
        """The coefficients of all columns, (p,), 0 for the others."""
        out = np.zeros(len(self.rows))
        out[self.at] = self.own_values
        return out


@dataclass(frozen=True, eq=False)
class Candidates:
    """All columns that may explain the residuals, with those of the model.

    Attributes
    ----------
    equations : TermEquations
        Equations of all columns.
    right : Score
        Right-hand sides and sums of squares of the residuals.
    prior : float array (p,)
        Information on each coefficient of the model from its size; 0 for all others.
    taken : float array (p,)
        Estimated coefficients of the model; 0 for all others.
    excess, common : float
        Variance of what is common to the marks of an image, over that of a reading, and in m^2.
    """

    equations: TermEquations
    right: Score
    prior: np.ndarray
    taken: np.ndarray
    excess: float = 1.0
    common: float = 0.0

    def explain(self, rows: np.ndarray) -> Explained:
        """Fit the columns of `rows`, bool (p,), together."""
        return self.explain_each([rows])[0]

    def explain_each(self, many: Sequence[np.ndarray]) -> list[Explained]:
        """Fit each of many sets of columns, bool (p,), by itself.

        Sets of equal size are computed together: for few columns a call costs more than its work.
        """
        places = [rows.nonzero()[0] for rows in many]
        found: dict[int, Explained] = {}
        for size in {len(at) for at in places}:
            mine = [number for number, at in enumerate(places) if len(at) == size]
            limits = np.array([self.equations.limit(many[number] & (self.prior == 0))
                               for number in mine])
            blocks = self._of_one_size(np.array([places[number] for number in mine]), limits)
            for number, block in zip(mine, blocks, strict=True):
                found[number] = Explained(many[number], places[number], *block)
        return [found[number] for number in range(len(many))]

    def _of_one_size(self, at: np.ndarray, limits: np.ndarray) -> Iterator[tuple]:
        """Yield the fields of `Explained` from `own_inverse` on, for the columns `at`, int (n, k).

        Eigenvalues up to `limits`, (n,), count as 0.
        """
        sums, square = self.right.sums, (at[:, :, None], at[:, None, :])
        values, vectors = np.linalg.eigh(self._scaled[square])
        told = values > limits[:, None]
        vectors = vectors / self._norm[at][:, :, None]
        inverse = (vectors * (told / np.where(told, values, 1.0))[:, None]) @ vectors.swapaxes(1, 2)
        right, gram = self._total[at], self.equations.projected.gram[square]
        own = (inverse @ right[:, :, None])[:, :, 0]
        left = (gram @ own[:, :, None])[:, :, 0] - 2 * self.right.between[at]
        between = sums.between + (own * left).sum(axis=1)
        dof = sums.dof_between - (inverse * gram).sum(axis=(1, 2))
        explained = (right * own).sum(axis=1)
        return zip(inverse, told.sum(axis=1).tolist(), own, explained.tolist(), between.tolist(),
                   dof.tolist(), strict=True)

    @cached_property
    def _scaled(self) -> np.ndarray:
        """Information on the coefficients of columns scaled to unit length, (p, p)."""
        information = self.equations.unbiased + np.diag(self.prior)
        return information / np.outer(self._norm, self._norm)

    @cached_property
    def _norm(self) -> np.ndarray:
        return np.hypot(self.equations.norm, np.sqrt(self.prior))

    @cached_property
    def _total(self) -> np.ndarray:
        return self.equations.unbiased_sums(self.right.total) - self.prior * self.taken

    @cached_property
    def everything(self) -> tuple[float, float]:
        """Sum of squares of all residuals, m^2, and its degrees of freedom, without any column."""
        sums = self.right.sums
        return (sums.total, sums.dof) if sums.dof_within >= 1 else (sums.between,
                                                                   sums.dof_between)

    def noise(self, fitted: Explained) -> tuple[float, float]:
        """Return the remaining variance of one reading, m^2, and its degrees of freedom.

        If a cause is missing, visits of one mark agree better than marks do: the larger variance
        counts. NaN and 0 if the columns use up all degrees of freedom.
        """
        sums, between, dof = self.right.sums, fitted.between, fitted.dof_between
        both = sums.dof - fitted.rank
        if sums.dof_within >= 1 and both > 0:
            total = (sums.total - fitted.explained) / both
            if dof <= 0 or between / dof <= total:
                return max(total, 0.0), both
        return (max(between, 0.0) / dof, dof) if dof > 0 else (float("nan"), 0.0)


CAUSE_LEVEL = 5e-4
"""Level of the test of each term, all parts of it that are tried together."""

MAX_CAUSES = 4


@dataclass(frozen=True, eq=False)
class Explanation:
    """A term, slip or single reading that explains part of the residuals.

    Attributes
    ----------
    name : str
        Name of the term, ``slip`` or ``reading``.
    columns : tuple of Column
        Columns of its coefficients.
    values, covariance : float array (p,), (p, p)
        Estimates of the coefficients and their covariance, SI units.
    p : float
        Probability of explaining as much by chance.
    whole : bool
        Whether the readings determine all coefficients.
    effect_m, effect_rad : float
        Effect on a coordinate of the map and on the angular map, rms, as far as determined.
    part : float
        Part of the view's visits before a slip; otherwise NaN.
    mark : tuple of int, optional
        Mark (m, n) of a single reading; otherwise None.
    moved, turned : complex array (sites,), float array (K,), optional
        Effect on the maps in their datum, in the frame of the equations, m and rad.
    rank : int
        Place among the explanations; those of equal rank explain the same equally well.
    """

    name: str
    columns: tuple[Column, ...]
    values: np.ndarray
    covariance: np.ndarray
    p: float
    whole: bool
    effect_m: float
    part: float = float("nan")
    mark: tuple[int, int] | None = None
    moved: np.ndarray | None = None
    rank: int = 0
    effect_rad: float = 0.0
    turned: np.ndarray | None = None

    def with_effect(self, equations: TermEquations, coefficients: np.ndarray) -> "Explanation":
        """Return the explanation with the effect of `coefficients` (p,) on the maps."""
        system = equations.system
        moved = equations.maps @ coefficients
        turned = np.where(system.known_lines, -(equations.turned @ coefficients), 0.0)
        known, lines = (max(int(at.sum()), 1) for at in (system.known_sites, system.known_lines))
        return replace(self, moved=moved, turned=turned,
                       effect_m=float(np.sqrt((abs(moved) ** 2).sum() / (2 * known))),
                       effect_rad=float(np.sqrt((turned**2).sum() / lines)))


@dataclass(frozen=True, eq=False)
class Group:
    """Columns that are tested together: a term, or one slip or reading of `places` tried."""

    name: str
    rows: np.ndarray
    view: int = -1
    part: float = float("nan")
    places: int = 1
    mark: tuple[int, int] | None = None


def find_explanations(model: ModelFit, *, slips: bool, readings: bool = True,
                      placed: PlacedSlip | None = None) -> list[Explanation]:
    """Return the significant explanations of the residuals of a fit, the most likely first.

    Parameters
    ----------
    model : ModelFit
        The fit; its own terms are not tested again.
    slips, readings : bool
        Whether slips of the plate within a view, or single faulty readings, are tested.
    placed : PlacedSlip, optional
        A slip that competes with the others.
    """
    problem = model.problem
    known = () if model.equations is None else model.equations.columns.at_visits(
        model.coefficients)
    ground = without_noise(problem.ground, model.found.residuals, known)
    own = [term.name for term in problem.terms]
    told = all(visits is not None for visits in ground.visits)
    more = [ModelTerm(block.name) for block in blocks().values()
            if block.name not in own and (told or not block.needs_visits)]
    made, views = ColumnBuilder(ground), problem.system.grid.views
    made.add_terms((*problem.terms, *more))
    groups = list(_groups(made.columns, [term.name for term in more]))
    phases, every = views.phases.conj(), int(np.count_nonzero(ground.weight))
    if slips:
        steps = list(slip_columns(made))
        groups += [Group(SLIP, np.array(rows), view, part, len(steps))
                   for rows, view, part in steps]
    if readings:
        groups += [Group(READING, np.array(rows), view, places=every, mark=views.mark_at(*place))
                   for rows, view, place in reading_columns(made, model.found.residuals, phases)]
    if placed is not None:
        moved, turned = placed.after * phases[placed.view], placed.after * ground.z
        rows = add_slip(made, placed.view, (moved.reshape(-1), turned.reshape(-1)))
        groups.append(Group(SLIP, np.array(rows), placed.view, places=placed.places))
    columns = made.done()
    groups = [replace(group, rows=np.isin(np.arange(len(columns.columns)), group.rows))
              for group in groups]
    equations = equations_of(problem, model.found, columns)
    taken = np.zeros(equations.n)
    taken[:len(model.coefficients)] = model.coefficients
    right = score(equations, model.found.both_residuals, squares(problem, model.found),
                  coefficients=taken)
    # images determine the yaw: no other cause may gain from a size that is too small for it
    sized = columns.rows([name for name in own if not block_of(name).of_images])
    prior = np.where(sized, equations.prior(model.found.xy.sigma), 0.0)
    excess = noise_excess(problem, model.found.residuals)
    common = excess * model.found.xy.residuals**2 if problem.images else 0.0
    return select_explanations(Candidates(equations, right, prior, taken, excess, common), groups,
                               columns.rows(own))


def _groups(columns: Sequence[Column], names: Iterable[str]) -> Iterator[Group]:
    """Yield the columns of each term, those of each of its views, and those tested alone.

    By their indices.
    """
    of_view = np.array([c.view for c in columns], dtype=int)
    alone = np.array([c.term in blocks() and blocks()[c.term].alone(c.component)
                      for c in columns], dtype=bool)
    for name in names:
        whole = np.array([c.term == name for c in columns], dtype=bool)
        parts = [whole]
        for view in sorted(set(of_view[whole].tolist()) - {-1}):
            here = whole & (of_view == view)
            parts.append(here)
            if (here & alone).any():
                parts.append(here & alone)
        yield from (Group(str(name), np.flatnonzero(rows), places=len(parts))
                    for rows in parts if rows.any())


def select_explanations(pool: Candidates, groups: list[Group],
                        taken: np.ndarray) -> list[Explanation]:
    """Return the explanations, each tested together with `taken` and those before it."""
    found: list[Explanation] = []
    rank = 0
    while groups and len(found) < MAX_CAUSES:
        before = pool.explain(taken)
        fitted = pool.explain_each([taken | group.rows for group in groups])
        tests = [(_test(pool, before, after, group), group)
                 for after, group in zip(fitted, groups, strict=True)]
        good = [(test, group) for test, group in tests
                if test is not None and test[0] < CAUSE_LEVEL]
        if not good:
            break
        best = max(good, key=lambda item: item[0][1])[1]
        as_good = [(test, group) for test, group in good
                   if group is best or _replaces(pool, taken, group, best)]
        # the best part of each term; what all views share is simpler than what each view has
        as_good.sort(key=lambda item: (not _is_shared(item[1].name), -item[0][1]))
        names: list[str] = []
        for (p, _), group in as_good:
            if group.name not in names:
                names.append(group.name)
                found.append(replace(_explanation(pool, taken, group, p), rank=rank))
        rank += 1
        taken = taken | best.rows
        groups = [g for g in groups if (g.rows & ~taken).any() and (
            g.name == best.name or g.name not in names) and not (
            best.name == SLIP == g.name and g.view == best.view)]
    return found


def _is_shared(name: str) -> bool:
    return name in blocks() and blocks()[name].shared


def _replaces(pool: Candidates, taken: np.ndarray, group: Group, best: Group) -> bool:
    """Return whether `best` explains nothing beyond what `group` explains."""
    if any(name not in blocks() or blocks()[name].between for name in (group.name, best.name)):
        return False
    before, after = pool.explain_each([taken | group.rows, taken | group.rows | best.rows])
    more = _test(pool, before, after, best)
    return more is None or more[0] >= CAUSE_LEVEL


def _test(pool: Candidates, before: Explained, after: Explained,
          group: Group) -> tuple[float, float] | None:
    """Return probability and evidence of a group; None if the readings do not determine it.

    `before` is the fit without the group, `after` the one with it.
    """
    gained, more = max(after.explained - before.explained, 0.0), after.rank - before.rank
    variance, dof = pool.noise(after)
    if more <= 0 or not variance > FLOOR**2:  # NaN where nothing is left to test against
        return None
    p = float(fdtrc(more, dof / pool.excess, gained / more / max(variance, pool.common)))
    # of all readings together, so that explanations are compared by the same squares
    whole, n = pool.everything
    rest = max(whole - after.explained, FLOOR**2)
    evidence = n * math.log1p(gained / rest) - more * math.log(n)
    return min(p * group.places, 1.0), evidence - 2 * math.log(group.places)


def _explanation(pool: Candidates, taken: np.ndarray, group: Group, p: float) -> Explanation:
    fitted = pool.explain(taken | group.rows)
    variance, _ = pool.noise(fitted)
    own = np.where(group.rows, fitted.values, 0.0)
    columns = tuple(compress(pool.equations.columns.columns, group.rows))
    return Explanation(group.name, columns, own[group.rows],
                       variance * fitted.inverse[np.ix_(group.rows, group.rows)], p,
                       pool.explain(group.rows).rank == int(group.rows.sum()), 0.0, group.part,
                       group.mark).with_effect(pool.equations, own)
