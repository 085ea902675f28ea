# SPDX-License-Identifier: Apache-2.0
"""What explains the residuals, as causes: with the largest component of each, and its place.

A stage may have stopped so far from the sites that its error there is unknown. A reading contains
the stage error at the position of the stage (method eq. 7.10), and the map gives it between its
sites by a spline. Two splines through the sites differ if the stage is rough from site to site, and
the maps with them; a solution that takes the sites for the positions misses the whole difference.
If all views are displaced alike, residuals show neither.

Terms, slips and single readings explain residuals (method eqs. 7.7, 7.8). A term that the model
does not hold is tested by the sum of squares that its columns explain, with as many degrees of
freedom as the readings determine of them (F-test against the remainder). The best one (Bayesian
information criterion) is accepted first, and the others are tested together with it, so that one
cause does not appear under many names. Of terms that explain the same equally well all are
returned: the readings do not determine which of them it is.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.blocks import AXES, block_of, blocks, differences, traits_of
from selfcal_ros.estimation.checks.wiring import BEYOND
from selfcal_ros.estimation.joint.model_fit import ModelFit, equations_of
from selfcal_ros.estimation.joint.problem import (
    Problem,
    fit,
    least_noise_rad,
    noise_excess,
    pooled,
)
from selfcal_ros.estimation.joint.solve import NEARLY_EXACT_M
from selfcal_ros.estimation.normal.angular import FLOOR
from selfcal_ros.estimation.terms.columns import Column, ColumnBuilder
from selfcal_ros.estimation.terms.equations import (
    CAUSE_LEVEL,
    Score,
    TermEquations,
)
from selfcal_ros.estimation.terms.places import StagePlaces
from selfcal_ros.estimation.terms.visits import TermInputs, ViewVisits, without_noise
from selfcal_ros.estimation.verdict.leverage import FEW_DRAWS, lines_alone
from selfcal_ros.model.error_map import ErrorMap, rms
from selfcal_ros.model.findings import Cause, CauseDetails
from selfcal_ros.model.readings import Measurements, turned_over
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import ModelTerm

READING = "reading"

MOST = 6
"""Number of readings that are tested: those with the largest residuals."""


@dataclass(frozen=True, eq=False)
class PlacedSlip:
    """A slip known beforehand: its grid view, marks read after it, bool (nx, ny), places tried."""

    view: int
    after: np.ndarray
    places: int


def reading_columns(
    builder: ColumnBuilder, residuals: np.ndarray, phases: np.ndarray
) -> Iterator[tuple[range, int, tuple[int, int]]]:
    """Add the columns of the readings with the largest residuals.

    Two for each reading: its errors along x and y, stage axes, m. Yield their indices, the view,
    and the place of the mark.

    Parameters
    ----------
    builder : ColumnBuilder
        The columns.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    phases : complex array (views,)
        From the stage frame to the plate frame in each view.
    """
    weight = builder.inputs.weight
    squares = np.where(weight > 0, weight * abs(residuals) ** 2, -1.0)
    largest = np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]
    for view, i, j in np.transpose(np.unravel_index(largest, squares.shape)).tolist():
        if squares[view, i, j] >= 0:
            mean = np.zeros(squares.shape[1:], dtype=complex)
            mean[i, j] = phases[view]
            shape_at = builder.add({view: mean.reshape(-1)})
            for axis, unit in AXES:
                builder.column(Column(READING, view, axis, np.inf), shape_at, unit)
            yield range(len(builder.columns) - 2, len(builder.columns)), view, (i, j)


SLIP = "slip"

PLACES = 12
"""Number of instants in each view, or of places along it, at which a slip is tried."""


def slip_columns(builder: ColumnBuilder) -> Iterator[tuple[range, int, float]]:
    """Add the columns of slips at some instants of the visits; yield indices, view and instant.

    Views whose visits are unknown have none. An instant is a part of the view's visits, 0..1.
    """
    for view, visits in enumerate(builder.inputs.visits):
        if visits is None:
            continue
        rank = np.argsort(np.argsort(visits.time, kind="stable"), kind="stable")
        for share_before in (np.arange(1, PLACES + 1) / (PLACES + 1)).tolist():
            after = rank >= round(share_before * len(rank))
            if 3 <= after.sum() <= len(after) - 3:
                places = builder.inputs.z.reshape(-1)[visits.mark]
                yield (
                    add_slip(
                        builder, view, (after * visits.phase, after * places), visits
                    ),
                    view,
                    share_before,
                )


def add_slip(
    builder: ColumnBuilder,
    view: int,
    values: tuple[np.ndarray, np.ndarray],
    visits: ViewVisits | None = None,
) -> range:
    """Add the columns of a slip, and return their indices.

    Offset along x and y, stage axes, m, and rotation, m at the half width.

    Parameters
    ----------
    builder : ColumnBuilder
        The columns.
    view : int
        The grid view.
    values : tuple of complex array
        A motion along x, and the places that a rotation moves, plate frame, 0 before the slip: at
        the visits, (V,), or at the marks, (marks,).
    visits : ViewVisits, optional
        The visits.
    """
    for motion, components in zip(values, (AXES, (("phi", 1j),)), strict=True):
        shape = (
            builder.add({view: motion})
            if visits is None
            else builder.add(
                {view: visits.means(motion[None], builder.inputs.z.size)[0]},
                {view: motion},
            )
        )
        for component, unit in components:
            builder.column(Column(SLIP, view, component, np.inf), shape, unit)
    return range(len(builder.columns) - 3, len(builder.columns))


OFF_SITES = "off_sites"

SMALL = 0.02
"""Change of the readings, in standard uncertainties of the map (rms), that is ignored."""

ROUGH = 2.5
"""Ratio of the error of the spline to its difference from a spline with slopes from neighbours,
for a stage whose errors at neighbouring sites are independent; smaller for smoother stages."""

SHOWN = 0.9
"""Ratio of residuals without the change to those with it below which residuals show it as well."""

RMS_MATTERS = 0.5
"""Effect on the map, in standard uncertainties (rms), above which it is a cause."""

NODE_MATTERS = 2.0
"""Effect on a coordinate of a node, in its standard uncertainty, above which it is a cause."""


@dataclass(frozen=True, eq=False)
class OffSites:
    """A stage off the sites as a cause, and its effect on the map.

    Attributes
    ----------
    cause : Cause
        The cause.
    map_change : complex array (nx, ny)
        Effect on the map along x and y, frame of the equations, m.
    residuals_show_it : bool
        Whether residuals show it as well.
    bounded : bool
        Whether the effect is smaller than the uncertainty that it enlarges.
    """

    cause: Cause
    map_change: np.ndarray
    residuals_show_it: bool
    bounded: bool


def off_sites_cause(model: ModelFit, error_map: ErrorMap) -> OffSites | None:
    """Return the effect of a stage off the sites as a cause; None if it is small.

    Parameters
    ----------
    model : ModelFit
        The fit; views whose visits are unknown count as measured at the sites.
    error_map : ErrorMap
        Its map.
    """
    problem = model.problem
    places = model.problem.places
    if places is None:
        return None
    # finite rotations of a stage that is rotated relative to its datum leave as much
    u = np.maximum(_uncertainty(model, error_map), NEARLY_EXACT_M)
    known_sites = problem.system.known_sites
    error_there = places.errors(model.fitted.field)
    reading_change = places.changes(
        _missed(problem, places, model.fitted.field, error_there), problem.turn_rad
    )
    if not rms(_coordinates(reading_change)) > SMALL * rms(u):
        return None
    before = model.fitted.xy.residuals
    corrected = fit(problem, model.y - reading_change)
    if corrected.xy.residuals < before:  # part of the residual noise is this effect
        u = u * (corrected.xy.residuals / before)
    map_change = np.where(known_sites, model.fitted.field - corrected.field, 0.0)
    ratio = np.where(known_sites, np.abs(_coordinates(map_change)) / u, 0.0)
    if not (rms(ratio[:, known_sites]) > RMS_MATTERS or ratio.max() > NODE_MATTERS):
        return None
    u_of_effect = np.maximum(_noise(problem, places, error_there, u), FLOOR)
    effect = np.abs(_coordinates(map_change))
    p = effect.size * math.erfc(float((effect / u_of_effect).max()) / math.sqrt(2))
    if p >= CAUSE_LEVEL:
        return None
    worst = np.unravel_index(int(effect.argmax()), effect.shape)
    cause = Cause(
        name=OFF_SITES,
        size=float(effect[worst]),
        u=float(u_of_effect[worst]),
        unit="m",
        p=p,
        details=CauseDetails(away=places.true_distance_m(error_there)),
        effect_rms=rms(effect),
        effect_max=float(effect[worst]),
    )
    return OffSites(
        cause,
        map_change,
        bool(corrected.xy.residuals < SHOWN * before),
        rms(ratio[:, known_sites]) < model.fitted.xy.k,
    )


def _missed(
    problem: Problem, places: StagePlaces, field: np.ndarray, error_there: np.ndarray
) -> np.ndarray:
    """Return the part of a field at the positions of the stage that a solution omits, (P,), m.

    Parameters
    ----------
    problem : Problem
        What was solved.
    places : StagePlaces
        The positions of the stage.
    field : complex array (nx, ny)
        Stage error at the sites, m.
    error_there : complex array (P,)
        Stage error of the solution at the positions of the stage.
    """
    smooth = places.differences(field, error_there)
    return (
        ROUGH * (places.differences(field, error_there, local=True) - smooth)
        if problem.moves
        else smooth
    )


def _noise(
    problem: Problem, places: StagePlaces, error_there: np.ndarray, u: np.ndarray
) -> np.ndarray:
    """Return the standard deviation of `_missed` at each site for noise u of the nodes, m.

    Both (2, nx, ny).
    """
    rng = np.random.default_rng(0)
    sites = places.site
    total = np.zeros((2, u[0].size))
    n_sites = u[0].size
    for _ in range(FEW_DRAWS):
        drawn = rng.normal(0, u)
        missed = _missed(problem, places, drawn[0] + 1j * drawn[1], error_there)
        total += [
            np.bincount(sites, coordinate**2, n_sites)
            for coordinate in _coordinates(missed)
        ]
    return np.sqrt(
        total / (FEW_DRAWS * np.maximum(np.bincount(sites, minlength=n_sites), 1))
    ).reshape(u.shape)


def _coordinates(field: np.ndarray) -> np.ndarray:
    return np.stack([field.real, field.imag])


def _uncertainty(model: ModelFit, error_map: ErrorMap) -> np.ndarray:
    """Return the standard uncertainty in the frame of the equations, (2, nx, ny), m.

    If it was not computed, that of a mean reading, which a map from three views comes close to.
    """
    u = error_map.u_xy
    grid = model.problem.system.grid
    if not np.isfinite(u).any():
        return np.full_like(
            u, model.fitted.xy.sigma / math.sqrt(grid.weight[grid.read].mean())
        )
    u = np.nan_to_num(u, nan=rms(u))
    return turned_over(model.problem.inputs.sense, u, sign=1)


@dataclass(frozen=True, eq=False)
class Explained:
    """Joint fit of a set of columns to the residuals.

    Attributes
    ----------
    columns : int array (k,)
        The columns.
    inverse, rank : float array (k, k), int
        Pseudo-inverse of their information, and its rank.
    values : float array (k,)
        Their estimated coefficients.
    explained : float
        Sum of squares that they explain, m^2.
    between, dof_between : float
        Remaining squares of the means of the marks, m^2, and their degrees of freedom.
    """

    columns: np.ndarray
    inverse: np.ndarray
    rank: int
    values: np.ndarray
    explained: float
    between: float
    dof_between: float


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
    coefficients : float array (p,)
        Estimated coefficients of the model; 0 for all others.
    excess, common : float
        Variance of what is common to the marks of an image, over that of a reading, and in m^2.
    """

    equations: TermEquations
    right: Score
    prior: np.ndarray
    coefficients: np.ndarray
    excess: float = 1.0
    common: float = 0.0

    def explain(self, rows: np.ndarray) -> Explained:
        """Fit the columns of `rows`, bool (p,), together."""
        sums = self.right.sums
        chosen = np.flatnonzero(rows)
        square = np.ix_(chosen, chosen)
        size, vectors = np.linalg.eigh(self._scaled[square])
        determined = size > self.equations.limit(rows & (self.prior == 0))
        vectors = vectors[:, determined] / self._norm[chosen, None]
        inverse = (vectors / size[determined]) @ vectors.T
        right = self._total[chosen]
        gram = self.equations.projected.gram[square]
        values = inverse @ right
        between = sums.between + values @ (
            gram @ values - 2 * self.right.between[chosen]
        )
        return Explained(
            columns=chosen,
            inverse=inverse,
            rank=int(determined.sum()),
            values=values,
            explained=float(right @ values),
            between=float(between),
            dof_between=sums.dof_between - float((inverse * gram).sum()),
        )

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
        return (
            self.equations.unbiased_sums(self.right.total)
            - self.prior * self.coefficients
        )

    @cached_property
    def everything(self) -> tuple[float, float]:
        """Sum of squares of all residuals, m^2, and its degrees of freedom, without any column."""
        sums = self.right.sums
        return (
            (sums.total, sums.dof)
            if sums.dof_within >= 1
            else (sums.between, sums.dof_between)
        )

    def noise(self, fitted: Explained) -> tuple[float, float]:
        """Return the remaining variance of one reading, m^2, and its degrees of freedom.

        If a cause is missing, visits of one mark agree better than marks do: the larger variance
        counts. NaN and 0 if the columns use up all degrees of freedom.
        """
        sums = self.right.sums
        between = fitted.between
        dof = fitted.dof_between
        dof_of_both = sums.dof - fitted.rank
        if sums.dof_within >= 1 and dof_of_both > 0:
            total = (sums.total - fitted.explained) / dof_of_both
            if dof <= 0 or between / dof <= total:
                return max(total, 0.0), dof_of_both
        return (max(between, 0.0) / dof, dof) if dof > 0 else (float("nan"), 0.0)


MAX_CAUSES = 4
"""Largest number of explanations: each is tested beside all before it."""


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
    determined : bool
        Whether the readings determine all coefficients.
    effect_m, effect_rad : float
        Effect on a coordinate of the map and on the angular map, rms, as far as determined.
    share_before : float
        Part of the view's visits before a slip; otherwise NaN.
    mark : tuple of int, optional
        Mark (m, n) of a single reading; otherwise None.
    map_change, angle_change : complex array (sites,), float array (K,), optional
        Effect on the maps in their datum, in the frame of the equations, m and rad.
    rank : int
        Place among the explanations; those of equal rank explain the same equally well.
    """

    name: str
    columns: tuple[Column, ...]
    values: np.ndarray
    covariance: np.ndarray
    p: float
    determined: bool
    effect_m: float = 0.0
    share_before: float = float("nan")
    mark: tuple[int, int] | None = None
    map_change: np.ndarray | None = None
    rank: int = 0
    effect_rad: float = 0.0
    angle_change: np.ndarray | None = None

    def with_effect(
        self, equations: TermEquations, coefficients: np.ndarray
    ) -> "Explanation":
        """Return the explanation with the effect of `coefficients` (p,) on the maps."""
        system = equations.system
        map_change = equations.maps @ coefficients
        angle_change = np.where(
            system.known_lines, -(equations.turned @ coefficients), 0.0
        )
        n_sites, n_lines = (
            max(int(at.sum()), 1) for at in (system.known_sites, system.known_lines)
        )
        return replace(
            self,
            map_change=map_change,
            angle_change=angle_change,
            effect_m=float(np.sqrt((abs(map_change) ** 2).sum() / (2 * n_sites))),
            effect_rad=float(np.sqrt((angle_change**2).sum() / n_lines)),
        )


@dataclass(frozen=True, eq=False)
class Group:
    """Columns that are tested together: a term, or one slip or reading of `places` tried."""

    name: str
    rows: np.ndarray
    view: int = -1
    share_before: float = float("nan")
    places: int = 1
    mark: tuple[int, int] | None = None


def find_explanations(
    model: ModelFit,
    *,
    slips: bool,
    readings: bool = True,
    placed: PlacedSlip | None = None,
) -> list[Explanation]:
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
    inputs = without_noise(
        problem.inputs,
        model.fitted.residuals,
        model.equations.columns.at_visits(model.coefficients),
    )
    own_terms = [term.name for term in problem.terms]
    visits_known = all(visits is not None for visits in inputs.visits)
    further_terms = [
        ModelTerm(block.name)
        for block in blocks().values()
        if block.name not in own_terms and (visits_known or not block.needs_visits)
    ]
    builder = ColumnBuilder(inputs)
    views = problem.system.grid.views
    builder.add_terms((*problem.terms, *further_terms))
    groups = list(_groups(builder.columns, [term.name for term in further_terms]))
    phases = views.phases.conj()
    n_readings = int(np.count_nonzero(inputs.weight))
    if slips:
        steps = list(slip_columns(builder))
        groups += [
            Group(SLIP, np.array(rows), view, share_before, len(steps))
            for rows, view, share_before in steps
        ]
    if readings:
        groups += [
            Group(
                READING,
                np.array(rows),
                view,
                places=n_readings,
                mark=views.mark_at(*place),
            )
            for rows, view, place in reading_columns(
                builder, model.fitted.residuals, phases
            )
        ]
    if placed is not None:
        shift = placed.after * phases[placed.view]
        rotation = placed.after * inputs.z
        rows = add_slip(builder, placed.view, (shift.reshape(-1), rotation.reshape(-1)))
        groups.append(Group(SLIP, np.array(rows), placed.view, places=placed.places))
    columns = builder.build()
    groups = [
        replace(group, rows=np.isin(np.arange(len(columns.columns)), group.rows))
        for group in groups
    ]
    equations = equations_of(problem, model.fitted, columns)
    coefficients = np.zeros(equations.n)
    coefficients[: len(model.coefficients)] = model.coefficients
    right_side = model.scored(equations, coefficients)
    # images determine the yaw: no other cause may gain from a size that is too small for it
    sized = columns.rows([name for name in own_terms if not block_of(name).of_images])
    prior = np.where(sized, equations.prior(model.fitted.xy.sigma), 0.0)
    excess = noise_excess(problem, model.fitted.residuals)
    common = excess * model.fitted.xy.residuals**2 if problem.images else 0.0
    return select_explanations(
        Candidates(
            equations=equations,
            right=right_side,
            prior=prior,
            coefficients=coefficients,
            excess=excess,
            common=common,
        ),
        groups,
        columns.rows(own_terms),
    )


def _groups(columns: Sequence[Column], names: Iterable[str]) -> Iterator[Group]:
    """Yield the columns of each term, those of each of its views, and those tested alone.

    By their indices.
    """
    of_view = np.array([c.view for c in columns], dtype=int)
    tested_alone = np.array(
        [traits_of(c.term).alone(c.component) for c in columns],
        dtype=bool,
    )
    for name in names:
        of_term = np.array([c.term == name for c in columns], dtype=bool)
        groups_of_term = [of_term]
        for view in sorted(set(of_view[of_term].tolist()) - {-1}):
            of_view_and_term = of_term & (of_view == view)
            groups_of_term.append(of_view_and_term)
            if (of_view_and_term & tested_alone).any():
                groups_of_term.append(of_view_and_term & tested_alone)
        yield from (
            Group(str(name), np.flatnonzero(rows), places=len(groups_of_term))
            for rows in groups_of_term
            if rows.any()
        )


def select_explanations(
    pool: Candidates, groups: list[Group], in_model: np.ndarray
) -> list[Explanation]:
    """Return the explanations, each tested together with `in_model` and those before it."""
    explanations: list[Explanation] = []
    rank = 0
    while groups and len(explanations) < MAX_CAUSES:
        before = pool.explain(in_model)
        tests = [
            (_test(pool, before, pool.explain(in_model | group.rows), group), group)
            for group in groups
        ]
        significant = [
            (test, group)
            for test, group in tests
            if test is not None and test[0] < CAUSE_LEVEL
        ]
        if not significant:
            break
        best = max(significant, key=lambda item: item[0][1])[1]
        as_good = [
            (test, group)
            for test, group in significant
            if group is best or _replaces(pool, in_model, group, best)
        ]
        # the best part of each term; what all views share is simpler than what each view has
        as_good.sort(key=lambda item: (not traits_of(item[1].name).shared, -item[0][1]))
        names: list[str] = []
        for (p, _), group in as_good:
            if group.name not in names:
                names.append(group.name)
                explanations.append(
                    replace(_explanation(pool, in_model, group, p), rank=rank)
                )
        rank += 1
        in_model = in_model | best.rows
        groups = [
            g
            for g in groups
            if (g.rows & ~in_model).any()
            and (g.name == best.name or g.name not in names)
            and not (best.name == SLIP == g.name and g.view == best.view)
        ]
    return explanations


def _replaces(
    pool: Candidates, in_model: np.ndarray, group: Group, best: Group
) -> bool:
    """Return whether `best` explains nothing beyond what `group` explains."""
    if any(
        name not in blocks() or block_of(name).between
        for name in (group.name, best.name)
    ):
        return False
    with_group = in_model | group.rows
    beyond_group = _test(
        pool, pool.explain(with_group), pool.explain(with_group | best.rows), best
    )
    return beyond_group is None or beyond_group[0] >= CAUSE_LEVEL


def _test(
    pool: Candidates, before: Explained, after: Explained, group: Group
) -> tuple[float, float] | None:
    """Return probability and evidence of a group; None if the readings do not determine it.

    `before` is the fit without the group, `after` the one with it.
    """
    gained = max(after.explained - before.explained, 0.0)
    n_gained = after.rank - before.rank
    variance, dof = pool.noise(after)
    # NaN where nothing is left to test against
    if n_gained <= 0 or not variance > FLOOR**2:
        return None
    p = float(
        fdtrc(
            n_gained, dof / pool.excess, gained / n_gained / max(variance, pool.common)
        )
    )
    # of all readings together, so that explanations are compared by the same squares
    total_squares, n = pool.everything
    unexplained = max(total_squares - after.explained, FLOOR**2)
    evidence = n * math.log1p(gained / unexplained) - n_gained * math.log(n)
    return min(p * group.places, 1.0), evidence - 2 * math.log(group.places)


def _explanation(
    pool: Candidates, in_model: np.ndarray, group: Group, p: float
) -> Explanation:
    fitted = pool.explain(in_model | group.rows)
    variance, _ = pool.noise(fitted)
    of_group = group.rows[fitted.columns]
    coefficients = np.zeros(len(group.rows))
    coefficients[group.rows] = fitted.values[of_group]
    columns = tuple(compress(pool.equations.columns.columns, group.rows))
    return Explanation(
        name=group.name,
        columns=columns,
        values=fitted.values[of_group],
        covariance=variance * fitted.inverse[np.ix_(of_group, of_group)],
        p=p,
        determined=pool.explain(group.rows).rank == int(group.rows.sum()),
        share_before=group.share_before,
        mark=group.mark,
    ).with_effect(pool.equations, coefficients)


NOISY = 1.5
"""Ratio of a view's noise to that of the others, or of residuals to repeats, above which the
uncertainty does not cover it."""


def cause_of(explanation: Explanation, inputs: TermInputs) -> Cause:
    """Return an explanation of the residuals, or a term of the model, as a cause.

    Parameters
    ----------
    explanation : Explanation
        The explanation.
    inputs : TermInputs
        Of the fit: names of the views, unit of a slip's rotation.
    """
    candidates = list(_candidates(explanation, inputs))
    cause, value, u = max(
        ((cause, *_linear(explanation, weights)) for cause, weights in candidates),
        key=lambda sized: abs(sized[1]) / max(sized[2], 1e-300),
    )
    largest = (
        0.0
        if explanation.map_change is None
        else float(np.abs(explanation.map_change).max(initial=0.0))
    )
    return replace(
        cause,
        size=value,
        u=float(np.fmax(cause.u, u)),
        p=explanation.p,
        effect_rms=explanation.effect_m,
        effect_max=largest,
        told=explanation.determined,
    )


def _candidates(
    explanation: Explanation, inputs: TermInputs
) -> Iterator[tuple[Cause, np.ndarray]]:
    """Yield what may size an explanation: a cause without its size, and the weights of values."""
    name = explanation.name
    names = inputs.names_of(name)
    if name == READING:
        if explanation.mark is None:
            raise ValueError("a reading without its mark")
        weights = explanation.values / np.hypot(*explanation.values)
        view = names[explanation.columns[0].view]
        yield Cause(name=name, unit="m", view=view, mark=explanation.mark), weights
    elif name == SLIP:
        view = names[explanation.columns[0].view]
        details, toward = _slip(explanation, inputs.half_width_m)
        yield Cause(name=name, unit="m", view=view, details=details), toward
    else:
        block = block_of(name)
        for where, weights in block.located(explanation, names):
            details = CauseDetails(part=where.part, against=where.against)
            cause = Cause(
                name=name,
                u=where.least_u,
                unit=where.unit or block.unit,
                view=where.view,
                axis=where.axis,
                details=details,
            )
            yield cause, weights


def fitted_term(
    model: ModelFit, name: str, p: float = 1.0, *, determined: bool = True
) -> Explanation:
    """Return a term of the model with its fitted coefficients and its effect."""
    equations = model.equations
    rows = equations.rows([name])
    covariance = model.covariance[np.ix_(rows, rows)] * model.fitted.xy.sigma**2
    columns = tuple(compress(equations.columns.columns, rows))
    explanation = Explanation(
        name=str(name),
        columns=columns,
        values=model.coefficients[rows],
        covariance=covariance,
        p=p,
        determined=determined,
    )
    return explanation.with_effect(equations, np.where(rows, model.coefficients, 0.0))


def scatter_of_views(
    measurements: Measurements, model: ModelFit | None = None
) -> list[tuple[str, float, float]]:
    """Return (name, noise of one reading, degrees of freedom) from the repeats of each grid view.

    If marks were visited again, from the visits after subtraction of the fitted terms.
    """
    revisited = (
        {}
        if model is None or not model.problem.terms
        else {
            model.problem.grid.index[row]: (visits, residuals)
            for row, visits, residuals in model.visits_about_means()
            if visits.repeated
        }
    )
    scatter = []
    for index, view in enumerate(measurements.views):
        sigma = view.sigma_xy
        dof = float(view.dof_xy)
        if index in revisited:
            visits, residuals = revisited[index]
            dof = 2.0 * visits.n_repeats
            sigma = float(np.sqrt(visits.weight @ abs(residuals) ** 2 / dof))
        if len(view.m) and dof > 0 and np.isfinite(sigma):
            scatter.append((view.view.name, sigma, dof))
    return scatter


def noisier_views(views: Sequence[tuple[str, float, float]]) -> list[Cause]:
    """Return the views whose noise exceeds that of the others (F-test), as causes.

    Parameters
    ----------
    views : sequence of (str, float, float)
        Name, noise of one reading, m, and degrees of freedom of each view.
    """
    causes = []
    for index, (name, sigma, dof) in enumerate(views):
        other_noise, other_dof = pooled(
            (s, d) for i, (_, s, d) in enumerate(views) if i != index
        )
        if not other_dof or not other_noise > FLOOR:
            continue
        ratio = sigma / other_noise
        p = float(fdtrc(dof, other_dof, ratio**2)) * len(views)
        if p < CAUSE_LEVEL and ratio > NOISY:
            u = float(ratio * np.sqrt((1 / dof + 1 / other_dof) / 2))
            causes.append(
                Cause(name="noise", size=float(ratio), u=u, unit="m/m", p=p, view=name)
            )
    return causes


def _linear(explanation: Explanation, weights: np.ndarray) -> tuple[float, float]:
    """Return weights @ values and its standard uncertainty."""
    variance = float(weights @ explanation.covariance @ weights)
    return float(weights @ explanation.values), math.sqrt(max(variance, 0.0))


def _slip(
    explanation: Explanation, half_width_m: float
) -> tuple[CauseDetails, np.ndarray]:
    """Return the components of a slip, and the weights that give its length."""
    order = {column.component: i for i, column in enumerate(explanation.columns)}
    x, y, phi = (
        float(explanation.values[order[component]]) for component in ("x", "y", "phi")
    )
    size = math.hypot(x, y)
    toward = np.zeros(3)
    toward[order["x"]], toward[order["y"]] = (
        (x / size, y / size) if size else (1.0, 0.0)
    )
    details = CauseDetails(
        x=x, y=y, phi=phi / half_width_m, after=explanation.share_before
    )
    return details, toward


def turned_too_far(
    model: ModelFit, result: CalibrationResult, measurements: Measurements
) -> Cause | None:
    """Return a cause if lines rotate relative to marks by as much as the plate is rotated.

    A plate that moved does not explain that: the offsets of lines have the wrong sign, or those of
    marks the wrong unit. None otherwise, or if the model has no such rotation.
    """
    between = next(
        (term.name for term in model.problem.terms if block_of(term.name).between), None
    )
    if between is None:
        return None
    rotations = fitted_term(model, between)
    # fewer if the term is free
    first = len(model.problem.inputs.with_lines) - len(rotations.values)
    values = np.pad(rotations.values, (first, 0))
    covariance = np.pad(rotations.covariance, (first, 0))
    apart, of_u = differences(values, covariance)
    phi = [
        view.phi
        for view, readings in zip(result.views, measurements.views, strict=True)
        if len(readings.m) and len(readings.k)
    ]
    if not apart[of_u > BEYOND].max(initial=0.0) > np.ptp(phi) / 2:
        return None
    p = math.erfc(float(of_u.max()) / math.sqrt(2))
    return replace(cause_of(rotations, model.problem.inputs), p=p)


def line_cause(model: ModelFit, measurements: Measurements) -> Cause | None:
    """Return the reading of a line that contradicts the others most; None if none does.

    Lines are fitted without marks. The error of a reading is its residual over 1 - h, the part that
    the fit does not follow; the reduction of the sum of squares is tested against the remainder
    (F-test at the level of all lines together). Lines are tested against no less noise than
    that with which they are weighted.

    Parameters
    ----------
    model : ModelFit
        The fit of marks and lines.
    measurements : Measurements
        Readings, for the names of the views.
    """
    problem = model.problem
    lines = lines_alone(problem.system, problem.angular.y)
    squares = np.nan_to_num(lines.squares, nan=-1.0)
    if not (squares > 0).any():
        return None
    v, k = (int(i) for i in np.unravel_index(int(squares.argmax()), squares.shape))
    if not lines.noise_without((v, k)) > FLOOR:
        return None
    least = least_noise_rad(problem, model.fitted.xy.sigma)
    p = min(lines.p_outlier((v, k), least) * problem.system.angular.n_readings, 1.0)
    checked = lines.redundancy[v, k]
    u = lines.noise_without((v, k), least) / math.sqrt(lines.weight[v, k] * checked)
    view = measurements.views[problem.angular.index[v]].view.name
    return (
        Cause(
            name=READING,
            size=float(lines.residual[v, k] / checked),
            u=u,
            unit="rad",
            p=p,
            view=view,
            mark=(k,),
        )
        if p < CAUSE_LEVEL
        else None
    )
