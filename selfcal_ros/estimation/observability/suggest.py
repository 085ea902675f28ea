# SPDX-License-Identifier: Apache-2.0
"""Which view to measure next, and the best plan for a given number of views.

Where the plate may lie anywhere a pattern search finds the best pose of a view. Turns are tried in
whole degrees and shifts in tenths of a pitch: a plate is not placed better than that on purpose,
and the uncertainty is flat about its minimum.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement, product
from math import comb, inf

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import FULL_SIZE, planned_system
from selfcal_ros.estimation.observability.plan_check import (
    SEARCH_SIZE,
    Prediction,
    Step,
    candidate_views,
    check_stops,
    measured_like,
    more_repeats,
    more_views,
    other_orders,
    predict,
    unit_repeats,
    unused_name,
)
from selfcal_ros.estimation.observability.rank import (
    deficiency,
    equivalent_key,
    full_observability,
    smaller,
)
from selfcal_ros.estimation.observability.resistance import with_part_of_terms
from selfcal_ros.estimation.terms.planned import Assumed, planned_equations
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.view import Plan, View

SHIFTS = ((0.0, 0.0), (0.5, 0.5), (1.3, -0.7), (-1.3, 0.7), (-0.5, 1.5), (0.5, -1.5))
"""Shifts, in pitches, from which the search starts: none, half a pitch, and beyond one."""

STEPS = ((30, 1.0), (15, 0.5), (5, 0.2), (1, 0.1))
"""Steps of the turn, in degrees, and of the shift, in pitches, one after the other."""

TURNS_DEG = range(0, 360, STEPS[0][0])
"""Turns from which the search starts, as far apart as its first step of the turn."""

REACH = 0.2
"""Largest shift along an axis, as a part of the plate: beyond it too few marks are in the field."""

Pose = tuple[int, float, float]
"""Turn in degrees, shift along x and y in pitches."""


def view_at(view: View, pose: Pose, pitch_m: float) -> View:
    """Return the view at a pose, named after it."""
    turn, *shift = pose
    shift_text = "".join(
        f"{step:+g}{axis}" for step, axis in zip(shift, "xy", strict=True) if step
    )
    return replace(
        view,
        name=f"{turn}deg{shift_text}",
        rotation_rad=math.radians(turn),
        translation_m=(shift[0] * pitch_m, shift[1] * pitch_m),
    )


def pose_of_view(view: View, pitch_m: float) -> Pose:
    """Return the pose of a view, rounded to whole degrees and tenths of a pitch."""
    x, y = (round(step_m / pitch_m, 1) for step_m in view.translation_m)
    return round(math.degrees(view.rotation_rad)) % 360, x, y


def start_poses(reach: float) -> list[Pose]:
    """Return the poses from which a search starts, with shifts up to `reach` pitches."""
    return [
        (turn, *shift)
        for turn, shift in product(TURNS_DEG, SHIFTS)
        if max(map(abs, shift)) <= reach
    ]


def reach_of(artifact: Artifact) -> float:
    """Return the largest shift to be tried on a plate, in pitches."""
    return max(1.0, round(REACH * (2 * min(artifact.reach)), 1))


def best_pose(
    starts: Sequence[Pose], reach: float, value: Callable[[Pose], tuple[float, ...]]
) -> Pose:
    """Return the pose of the smallest value near one of the best starts.

    Parameters
    ----------
    starts : sequence
        Poses to begin with.
    reach : float
        Largest shift along an axis, in pitches.
    value : callable
        Key of a pose, the smallest is the best.
    """
    values: dict[Pose, tuple[float, ...]] = {}

    def key(pose: Pose) -> tuple[float, ...]:
        if pose not in values:
            values[pose] = value(pose)
        return values[pose]

    local_best = []
    for best in sorted(starts, key=key)[:FINALISTS]:
        for turn, shift in STEPS:
            while key(
                near := min(_neighbours(best, turn, shift, reach), key=key)
            ) < key(best):
                best = near
        local_best.append(best)
    return min(local_best, key=key)


def _neighbours(pose: Pose, turn: int, shift: float, reach: float) -> Iterator[Pose]:
    """Yield the pose and its neighbours: turned, or shifted along one axis."""
    yield pose
    angle, x, y = pose
    for sign in (1, -1):
        yield (angle + sign * turn) % 360, x, y
        yield from (
            (angle, to + 0.0, y)
            for to in [round(x + sign * shift, 1)]
            if abs(to) <= reach
        )
        yield from (
            (angle, x, to + 0.0)
            for to in [round(y + sign * shift, 1)]
            if abs(to) <= reach
        )


EXHAUSTIVE = 2000
"""Largest number of plans for which all are tried; above, greedy choice and exchange."""

FEW = 200
"""The same if terms are involved, which mirror images do not share."""

MAX_TIES = 64
"""Largest number of plans that differ only in their lines to be evaluated with them."""

FINALISTS = 5
"""Starts of a search that are refined, and plans of one on a smaller field that are evaluated on
the plan's own: there are several minima."""


@dataclass(frozen=True)
class PlanScore:
    """Predicted uncertainty of a plan for unit noise of one reading; infinite if deficient.

    `of_terms`: the deficiency is caused by free terms; without them the stage is identified.
    `unknown_sites`: outermost nodes of a map that it leaves unknown: no uncertainty counts them.
    """

    deficiency: int
    rms_xy: float
    max_xy: float
    rms_theta: float
    of_terms: bool = False
    unknown_sites: int = 0

    def key(self, criterion: str) -> tuple[float, ...]:
        """Return the order of plans: deficiency, unknown nodes, the criterion, then the other.

        For a plan deficient even without terms, their effect is not counted: it comes last.
        """
        first, second = (
            (self.rms_xy, self.max_xy)
            if criterion == "rms"
            else (self.max_xy, self.rms_xy)
        )
        # rounding must not decide between plans equal by symmetry
        return (
            bool(self.deficiency and not self.of_terms),
            self.deficiency,
            self.unknown_sites,
            round(first, 9),
            round(second, 9),
            round(self.rms_theta, 9),
        )


@dataclass(frozen=True)
class Against:
    """Terms included in the uncertainty, and the assumptions on the visits.

    A size is prior knowledge of a term, whether or not the readings determine it better; modes
    of the stage hidden by a free term count as a deficiency.

    Attributes
    ----------
    terms : tuple of ModelTerm
        Terms of the plan and those asked for.
    assumed : Assumed
        Noise, offsets, visiting order.
    by_default : tuple of ModelTerm
        Terms with sizes that are assumed of every measurement.
    """

    terms: tuple[ModelTerm, ...]
    assumed: Assumed = Assumed()
    by_default: tuple[ModelTerm, ...] = ()

    @property
    def all_terms(self) -> tuple[ModelTerm, ...]:
        """All terms."""
        return (*self.terms, *self.by_default)


NOTHING = Against(())
"""No terms: the uncertainty is that of the noise alone."""


@dataclass(frozen=True)
class Search:
    """How a plan was found.

    Attributes
    ----------
    n_plans : int or None
        The number of plans if all were tried; None after greedy choice and exchange.
    size : int or None
        Sites per side of the smaller field on which they were compared; None for the plan's own.
    """

    n_plans: int | None
    size: int | None = None


@dataclass(frozen=True)
class Suggestion(Step):
    """A next step with the resulting score of the plan."""

    score: PlanScore = field(kw_only=True)


Progress = Callable[[int, int | None], None]


def no_progress(done: int, total: int | None = None) -> None:
    """Do nothing."""


@one_thread()
def score_plan(
    plan: Plan,
    datum: ThetaDatum = ThetaDatum.ZERO_MEAN,
    *,
    repeats: int | None = None,
    against: Against = NOTHING,
) -> PlanScore:
    """Return the score of a plan with every mark read.

    The unit of noise is an averaged reading of `repeats` repeats, by default the plan's fewest.
    The XY uncertainty includes the contribution of the terms of `against`.
    """
    system = planned_system(plan.artifact, plan.views)
    # on the lattice by itself: full observability seeks advice
    unseen = (
        deficiency(system)
        if plan.artifact.map_grid is None
        else full_observability(system, plan.artifact, plan.views).deficiency
    )
    if unseen:
        return PlanScore(unseen, inf, inf, inf)
    repeats = repeats or unit_repeats(plan)
    prediction: Prediction = predict(system, plan.artifact, datum, repeats=repeats)
    if against.all_terms:
        terms = planned_equations(plan, system, against.all_terms, against.assumed)
        hidden = terms.unseen(terms.free).shape[1]
        if hidden:
            return PlanScore(hidden, inf, inf, inf, of_terms=True)
        prediction = with_part_of_terms(prediction, terms, repeats)
    theta = prediction.rms_theta if len(prediction.u_theta) else 0.0
    return PlanScore(
        0,
        prediction.rms_xy,
        prediction.max_xy,
        theta,
        unknown_sites=prediction.n_unknown,
    )


@one_thread()
def rank_next(
    plan: Plan,
    *,
    criterion: str = "rms",
    datum: ThetaDatum = ThetaDatum.ZERO_MEAN,
    against: Against = NOTHING,
    progress: Progress = no_progress,
) -> tuple[PlanScore, list[Suggestion]]:
    """Return the plan's score and every candidate for the next step, the best first.

    Candidates are the views of `candidate_views`, another set of repeats of a view of the plan,
    and, if the order of the visits matters to the terms, other visiting orders. Fields above
    FULL_SIZE are evaluated on a smaller field of SEARCH_SIZE sites per side.

    Parameters
    ----------
    plan : Plan
        The plan so far.
    criterion : str
        ``rms`` or ``max``: the XY uncertainty to minimise.
    datum : ThetaDatum
        Convention of the angular map.
    against : Against, optional
        Terms included in the uncertainty.
    progress : callable
        Called with the number of plans evaluated and the total.
    """
    judged = (
        smaller(plan, SEARCH_SIZE) if max(plan.artifact.shape) > FULL_SIZE else plan
    )
    unit = unit_repeats(plan)

    def score(views: tuple[View, ...]) -> PlanScore:
        return score_plan(
            replace(judged, views=views), datum, repeats=unit, against=against
        )

    views = more_views(plan)
    if plan.artifact.map_grid:
        views += _anywhere(plan, views, lambda added: score(added).key(criterion))
    steps = [*views, *more_repeats(plan)]
    if any(term.block.change == "order" for term in against.terms):
        steps += other_orders(plan)
    if any(term.block.change == "check_stops" for term in against.all_terms):
        steps += check_stops(plan)
    out = []
    for number, step in enumerate(steps):
        out.append(Suggestion(**vars(step), score=score(step.views)))
        progress(number + 1, len(steps))
    out.sort(key=lambda item: item.score.key(criterion))
    return score(plan.views), out


@one_thread()
def best_plan(
    artifact: Artifact,
    n_views: int,
    *,
    angular: bool,
    criterion: str = "rms",
    like: View | None = None,
    datum: ThetaDatum = ThetaDatum.ZERO_MEAN,
    against: Against = NOTHING,
    progress: Progress = no_progress,
) -> tuple[Plan, PlanScore, Search]:
    """Return the best plan of `n_views` views among the candidates, its score, and the search.

    The first view is the one without a turn: turning all views together only renames the marks.
    With angular lines one view is the turn by one line. Up to EXHAUSTIVE plans are all tried, more
    are searched by greedy choice and exchange of single views until no exchange helps. Of
    mirror-image plans only one is computed; lines decide between the best. Repeats, visiting order
    and check stops are those of the view `like`.

    Raises
    ------
    InputError
        If so few views cannot identify the stage.
    """
    fixed = int(angular)
    if n_views < 3 + fixed:
        raise InputError(
            "--views",
            f"{n_views} views cannot identify the stage",
            f"give {3 + fixed} or more",
        )
    like = like or View("")
    candidates = [
        measured_like(view, like) for view in candidate_views(artifact, angular=angular)
    ]
    pool = [view for view in candidates if view.grid]
    empty_plan = Plan("best", artifact, ())
    small = smaller(empty_plan, SEARCH_SIZE)
    tried, how = _search(
        small,
        pool,
        n_views - 1 - fixed,
        criterion=criterion,
        against=against,
        progress=progress,
    )
    if small is not empty_plan:
        how = replace(how, size=SEARCH_SIZE)
    judged = empty_plan if max(artifact.shape) <= FULL_SIZE else small

    def with_lines(chosen: tuple[int, ...]) -> Plan:
        views = (
            pool[0],
            *(pool[i] for i in chosen),
            *(candidates[-1:] if angular else []),
        )
        return replace(judged, views=_named(views))

    finalists = sorted(tried, key=lambda chosen: (tried[chosen], chosen))
    ties = sum(tried[chosen] == tried[finalists[0]] for chosen in finalists)
    finalists = finalists[: max(FINALISTS, min(ties, MAX_TIES) if angular else 0)]
    scores = [
        score_plan(with_lines(chosen), datum, against=against) for chosen in finalists
    ]
    best = min(range(len(scores)), key=lambda at: scores[at].key(criterion))
    plan = with_lines(finalists[best])
    least = scores[best]
    if artifact.map_grid:
        views = _moved_off_the_lattice(
            plan.views,
            artifact,
            lambda views: score_plan(
                replace(judged, views=views), datum, against=against
            ).key(criterion),
        )
        plan = replace(judged, views=views)
        least = score_plan(plan, datum, against=against)
    return replace(plan, artifact=artifact), least, how


def _anywhere(
    plan: Plan, steps: list[Step], key: Callable[[tuple[View, ...]], tuple[float, ...]]
) -> list[Step]:
    """Return the best further view at any pose, unless it is one of `steps` on the lattice."""
    pitch_m = plan.artifact.grid_pitch_m
    added = steps[0].views[-1]

    def views(pose: Pose) -> tuple[View, ...]:
        view = view_at(added, pose, pitch_m)
        return *plan.views, replace(view, name=unused_name(view.name, plan.views))

    reach = reach_of(plan.artifact)
    starts = [
        pose_of_view(step.views[-1], pitch_m) for step in steps if step.views[-1].grid
    ]
    best = best_pose(
        [*starts, *start_poses(reach)], reach, lambda pose: key(views(pose))
    )
    return [] if best in starts else [Step(views(best)[-1], views(best))]


def _moved_off_the_lattice(
    views: tuple[View, ...],
    artifact: Artifact,
    key: Callable[[tuple[View, ...]], tuple[float, ...]],
) -> tuple[View, ...]:
    """Return the views at the best poses near theirs, changed one by one until none is better.

    The first view remains: it is the frame of the others.
    """
    now = views
    before = None
    pitch_m = artifact.grid_pitch_m

    def instead(views: tuple[View, ...], at: int, pose: Pose) -> tuple[View, ...]:
        return *views[:at], view_at(views[at], pose, pitch_m), *views[at + 1 :]

    def value(views: tuple[View, ...], at: int) -> Callable[[Pose], tuple[float, ...]]:
        return lambda pose: key(instead(views, at, pose))

    while now != before:
        before = now
        for at in (at for at in range(1, len(views)) if views[at].grid):
            better = instead(
                now,
                at,
                best_pose(
                    [pose_of_view(now[at], pitch_m)], reach_of(artifact), value(now, at)
                ),
            )
            now = better if key(better) < key(now) else now
    return _named(now)


def _search(
    field: Plan,
    pool: list[View],
    free: int,
    *,
    criterion: str,
    against: Against,
    progress: Progress,
) -> tuple[dict[tuple[int, ...], tuple], Search]:
    """Return plans of the pool's first view and `free` others with their keys, and how found.

    By their grid marks alone; one of mirror-image plans, unless terms of the visits differ in them.
    """
    pool = [replace(view, angular=False) for view in pool]
    keys: dict[tuple, tuple[float, ...]] = {}
    one_by_one = any(term.block.needs_visits for term in against.terms)
    # no choice of views determines the default terms of the visits
    against = replace(
        against,
        by_default=tuple(
            term for term in against.by_default if not term.block.needs_visits
        ),
    )

    def key(chosen: tuple[int, ...]) -> tuple[float, ...]:
        views = (pool[0], *(pool[i] for i in chosen))
        equivalent = (
            tuple(sorted(chosen))
            if one_by_one
            else equivalent_key(field.artifact, views)
        )
        if equivalent not in keys:
            plan = replace(field, views=_named(views))
            keys[equivalent] = score_plan(plan, against=against).key(criterion)
            progress(len(keys), None)
        return keys[equivalent]

    n_plans = comb(len(pool) + free - 1, free)
    if n_plans <= (FEW if one_by_one else EXHAUSTIVE):
        choices = combinations_with_replacement(range(len(pool)), free)
        return {chosen: key(chosen) for chosen in choices}, Search(n_plans)
    return _exchange(key, len(pool), free), Search(None)


def _exchange(
    key: Callable[[tuple[int, ...]], tuple[float, ...]], n_pool: int, free: int
) -> dict[tuple[int, ...], tuple[float, ...]]:
    """Search by greedy choice and exchange; return every plan tried with its key."""
    tried: dict[tuple[int, ...], tuple[float, ...]] = {}

    def value(chosen: Iterable[int]) -> tuple[float, ...]:
        at = tuple(sorted(chosen))
        if at not in tried:
            tried[at] = key(at)
        return tried[at]

    now: tuple[int, ...] = ()
    while len(now) < free:
        now = min(((*now, i) for i in range(n_pool)), key=value)
    improved = True
    while improved:
        improved = False
        for place in range(free):
            others_kept = now[:place] + now[place + 1 :]
            best = min(((*others_kept, i) for i in range(n_pool)), key=value)
            if value(best) < value(now):
                now = best
                improved = True
    return {
        chosen: key_of_plan
        for chosen, key_of_plan in tried.items()
        if len(chosen) == free
    }


def _named(views: Iterable[View]) -> tuple[View, ...]:
    out: list[View] = []
    for view in views:
        out.append(replace(view, name=unused_name(view.name, out)))
    return tuple(out)
