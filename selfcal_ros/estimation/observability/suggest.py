# SPDX-License-Identifier: Apache-2.0
"""Which view to measure next, and the best plan for a given number of views."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from math import comb, inf

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.normal.planned import planned_system
from selfcal_ros.estimation.observability.plan_check import (
    candidate_views,
    describe_view,
    smaller,
    unit_repeats,
)
from selfcal_ros.estimation.observability.prediction import Prediction, predict
from selfcal_ros.estimation.observability.rank import full_observability
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.view import Plan, View

SEARCH_SIZE = 11
"""Largest field on which plans are compared while searching; the best are then judged in full."""

FULL_SIZE = 41
"""Largest field on which every candidate is judged in full."""

EXHAUSTIVE = 2000
"""Largest number of plans that are all tried; beyond it greedy choice and exchange."""

FINALISTS = 5
"""Plans of a search on a smaller field that are judged on the plan's own field."""

CRITERIA = ("rms", "max")


@dataclass(frozen=True)
class Score:
    """What a plan promises, for unit noise of one reading; infinite if it is deficient."""

    deficiency: int
    rms_xy: float
    max_xy: float
    rms_theta: float

    def key(self, criterion: str) -> tuple[float, ...]:
        """Return the order of plans: deficiency first, then the criterion, then the other."""
        first, second = ((self.rms_xy, self.max_xy) if criterion == "rms"
                         else (self.max_xy, self.rms_xy))
        # rounding must not decide between plans that are equal by symmetry
        return (self.deficiency, round(first, 9), round(second, 9), round(self.rms_theta, 9))


@dataclass(frozen=True)
class Suggestion:
    """A next step and the score that the plan then has.

    `view` is the view to add; for one more repeat of a view of the plan `repeat_of` is its index.
    """

    text: str
    view: View
    score: Score
    repeat_of: int | None = None


@one_thread()
def score_plan(plan: Plan, datum: ThetaDatum = ThetaDatum.XY_AXES, *,
               repeats: int | None = None) -> Score:
    """Return the score of a plan with every mark read.

    The unit of noise is an averaged reading of `repeats` repeats, by default the plan's fewest.
    """
    system = planned_system(plan.artifact, plan.views)
    seen = full_observability(system, plan.artifact, plan.views)
    if not seen.identifiable:
        return Score(seen.deficiency, inf, inf, inf)
    found: Prediction = predict(system, plan.artifact, datum,
                                repeats=repeats or unit_repeats(plan))
    theta = found.rms_theta if len(found.u_theta) else 0.0
    return Score(0, found.rms_xy, found.max_xy, theta)


@one_thread()
def rank_next(plan: Plan, *, criterion: str = "rms",
              datum: ThetaDatum = ThetaDatum.XY_AXES) -> tuple[Score, list[Suggestion]]:
    """Return the plan's score and every candidate for the next step, the best first.

    Candidates are the views of `candidate_views` and as many repeats more of a view of the plan.
    Fields above FULL_SIZE are judged on a smaller field of SEARCH_SIZE sites a side.

    Parameters
    ----------
    plan : Plan
        What is planned so far.
    criterion : str
        ``rms`` or ``max``: which XY uncertainty is to become small.
    datum : ThetaDatum
        Convention of the angular map.
    """
    angular = any(view.angular for view in plan.views) and plan.artifact.angular_count > 0
    judged = smaller(plan, SEARCH_SIZE) if max(plan.artifact.shape) > FULL_SIZE else plan
    unit, out = unit_repeats(plan), []
    for view in candidate_views(plan.artifact, angular=angular):
        named = replace(view, name=unused_name(view.name, plan.views), repeats=unit)
        out.append(Suggestion("add " + describe_view(view, plan.artifact), named,
                              score_plan(replace(judged, views=(*judged.views, named)), datum,
                                         repeats=unit)))
    for index, view in enumerate(plan.views):
        more = replace(view, repeats=view.repeats + unit)
        views = (*judged.views[:index], more, *judged.views[index + 1:])
        out.append(Suggestion(f"measure view '{view.name}' {more.repeats} times, not "
                              f"{view.repeats}", more,
                              score_plan(replace(judged, views=views), datum, repeats=unit), index))
    out.sort(key=lambda item: item.score.key(criterion))
    return score_plan(judged, datum, repeats=unit), out


@one_thread()
def best_plan(artifact: Artifact, n_views: int, *, angular: bool, criterion: str = "rms",
              repeats: int = 1) -> tuple[Plan, Score, str]:
    """Return the best plan of `n_views` views among the candidates, its score, how it was found.

    The first view is the one without turn: turning all views together only renames the plate. With
    angular lines one view is the turn by one line. Up to EXHAUSTIVE plans are all tried, more are
    searched by greedy choice and exchange of single views until no exchange helps.

    Raises
    ------
    InputError
        If so few views cannot identify the stage.
    """
    fixed = int(angular)
    if n_views < 3 + fixed:
        raise InputError("--views", f"{n_views} views cannot identify the stage",
                         f"give {3 + fixed} or more")
    candidates = candidate_views(artifact, angular=angular)
    pool = [view for view in candidates if view.grid]
    last = candidates[-1:] if angular else []
    whole = Plan("best", artifact, ())
    small = smaller(whole, SEARCH_SIZE) if max(artifact.shape) > SEARCH_SIZE else whole
    free = n_views - 1 - fixed

    def key(chosen: tuple[int, ...], field: Plan) -> tuple[float, ...]:
        views = (pool[0], *(pool[i] for i in chosen), *last)
        return score_plan(replace(field, views=views)).key(criterion)

    n_plans = comb(len(pool) + free - 1, free)
    if n_plans <= EXHAUSTIVE:
        how = f"all {n_plans} plans tried"
        tried = {c: key(c, small) for c in combinations_with_replacement(range(len(pool)), free)}
    else:
        how = "greedy choice, then exchange of single views"
        tried = _exchange(lambda chosen: key(chosen, small), len(pool), free)
    finalists = sorted(tried, key=lambda chosen: (tried[chosen], chosen))[:FINALISTS]
    if small is not whole:
        how += f" on a field of {SEARCH_SIZE} x {SEARCH_SIZE} sites"
        finalists.sort(key=lambda chosen: key(chosen, whole)
                       if max(artifact.shape) <= FULL_SIZE else tried[chosen])
    views = _named((pool[0], *(pool[i] for i in finalists[0]), *last), repeats)
    plan = replace(whole, views=views)
    judged = plan if max(artifact.shape) <= FULL_SIZE else smaller(plan, SEARCH_SIZE)
    return plan, score_plan(judged), how


def _exchange(key, n_pool: int, free: int) -> dict[tuple[int, ...], tuple[float, ...]]:
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
            rest = now[:place] + now[place + 1:]
            best = min(((*rest, i) for i in range(n_pool)), key=value)
            if value(best) < value(now):
                now, improved = best, True
    return {chosen: found for chosen, found in tried.items() if len(chosen) == free}


def unused_name(name: str, views: Iterable[View]) -> str:
    """Return `name`, numbered if a view of the plan has it already."""
    taken = {view.name for view in views}
    tail = 2
    out = name
    while out in taken:
        out, tail = f"{name}_{tail}", tail + 1
    return out


def _named(views: Iterable[View], repeats: int) -> tuple[View, ...]:
    out: list[View] = []
    for view in views:
        out.append(replace(view, name=unused_name(view.name, out), repeats=repeats))
    return tuple(out)
