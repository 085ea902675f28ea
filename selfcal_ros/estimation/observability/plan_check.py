# SPDX-License-Identifier: Apache-2.0
"""Whether a plan identifies the stage, its unseen modes, and the views that would remove them.

And the standard uncertainties that it will have.
"""

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, islice

import numpy as np

from selfcal_ros.estimation.datum.covariance import (
    MapsCovariance,
    conditions_for,
    lines_alone,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import (
    ENOUGH_DOF,
    UNASKED_SITES,
    NormalEquations,
    planned_system,
)
from selfcal_ros.estimation.observability.rank import (
    full_observability,
    identifies,
    smaller,
    unseen_modes,
    with_unchecked,
)
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum, rms
from selfcal_ros.model.findings import AddViews, OrAddViews
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.result import Observability
from selfcal_ros.model.view import ORDERS, Plan, View, parse_order


@dataclass(frozen=True, eq=False)
class Prediction:
    """Standard uncertainty of the maps for unit noise of one averaged reading.

    If views differ in repeats, the reading with the fewest has unit noise.

    Attributes
    ----------
    u_xy : float array (2, nx, ny)
        Of Gx and Gy, in units of the noise of a grid reading; their shape is that of the
        predicted field.
    u_theta : float array (K,)
        Of Gtheta, in units of the noise of an angular reading, misalignments of the grid
        views known; empty if no line is measured.
    """

    u_xy: np.ndarray
    u_theta: np.ndarray

    @property
    def rms_xy(self) -> float:
        """Root mean square over all sites and both axes."""
        return rms(self.u_xy)

    @property
    def max_xy(self) -> float:
        """Largest value of a site on either axis."""
        return float(np.nanmax(self.u_xy))

    @property
    def n_unknown(self) -> int:
        """Number of sites that remain unknown."""
        return int(np.isnan(self.u_xy[0]).sum())

    @property
    def rms_theta(self) -> float:
        """Root mean square over the lines; NaN if no line is measured."""
        return rms(self.u_theta)


def predict(
    system: NormalEquations, artifact: Artifact, datum: ThetaDatum, *, repeats: int = 1
) -> Prediction:
    """Return the predicted uncertainties for readings that identify the stage.

    Parameters
    ----------
    system : NormalEquations
        The readings; weights are repeats.
    artifact : Artifact
        The plate.
    datum : ThetaDatum
        Convention of the angular map.
    repeats : int
        Repeats of the averaged reading whose noise is the unit.
    """
    n = 3 * system.grid.n_views
    inverse = np.zeros((system.size, system.size))
    inverse[:n, :n] = system.grid_inverse
    u_xy = np.sqrt(MapsCovariance(system, inverse).of_stage * repeats)
    if not system.angular.n_views:
        return Prediction(u_xy, np.zeros(0))
    conditions = conditions_for(
        system,
        ThetaDatum(datum),
        Sense.MICROSCOPE_MOVES,
        artifact.half_width_m,
    )
    flat = replace(conditions, slopes=np.zeros_like(conditions.slopes))
    return Prediction(u_xy, np.sqrt(repeats * lines_alone(system).of_stage(flat)[0]))


SEARCH_SIZE = 11
"""Largest field on which views are searched for: what is found is then evaluated in full."""

PROXY_SIZE = 101
"""Field on which the uncertainty of a larger field is predicted."""

CHECK_MARKS, CHECK_OFFSET_M = 5, 20e-6
"""Suggested check stops: marks per view, and their distance, m."""

OTHER_TURN_DEG = 37
"""Turn of a usual view of lines for a Fourier map: 360° and it have no common factor."""

MAX_CURES = 5
"""Largest number of sets of views proposed."""


@dataclass(frozen=True, eq=False)
class PlanCheck:
    """Check of a plan before anything moves.

    Attributes
    ----------
    observability : Observability
        Rank, deficiency, unseen modes, advice.
    unknown_sites : int
        Sites, or nodes of the map, that remain unknown although the plan identifies the stage.
    harmonics_untested : bool
        Whether the views of lines are too few to show harmonics that the angular map lacks.
    nodes_untested : bool
        Whether neither another map nor repeats show what the nodes of the map do not follow.
    """

    observability: Observability
    unknown_sites: int = 0
    harmonics_untested: bool = False
    nodes_untested: bool = False


@one_thread()
def check_plan(plan: Plan) -> PlanCheck:
    """Return rank, deficiency, unseen modes and advice of a plan with every mark read."""
    system = planned_system(plan.artifact, plan.views)
    observability = with_unchecked(
        full_observability(system, plan.artifact, plan.views), system
    )
    if not observability.identifiable:
        return PlanCheck(with_unseen_modes(observability, system, plan))
    return PlanCheck(
        observability,
        unknown_sites=int((~system.known_sites).sum()),
        harmonics_untested=system.angular.harmonics_untested,
        nodes_untested=system.nodes_untested and not _repeats_test(system, plan),
    )


def _repeats_test(system: NormalEquations, plan: Plan) -> bool:
    """Return whether residuals, compared with repeats, test the nodes of the map."""
    is_repeated = any(view.repeats > 1 for view in plan.views if view.grid)
    return is_repeated and system.dof_of_map >= ENOUGH_DOF


def with_unseen_modes(
    observability: Observability, system: NormalEquations, plan: Plan
) -> Observability:
    """Return the observability of a deficient set of readings: unseen modes, and cures.

    Parameters
    ----------
    observability : Observability
        Rank and deficiency.
    system : NormalEquations
        The readings, possibly incomplete.
    plan : Plan
        The views behind the readings.
    """
    advice = tuple(
        kind(views=cure, plate=plan.artifact)
        for kind, cure in zip(
            (AddViews, OrAddViews, OrAddViews), find_cures(plan), strict=False
        )
    )
    return replace(
        observability,
        modes=tuple(unseen_modes(system)),
        advice=advice or observability.advice,
    )


@one_thread()
def predict_plan(plan: Plan, datum: ThetaDatum) -> Prediction:
    """Return the uncertainties predicted for a plan if every mark is read.

    Fields above UNASKED_SITES are predicted on a smaller field, which is the shape of the result:
    the gain grows slowly, as log N, so the prediction is then too small.
    """
    judged = predicted_on(plan)
    return predict(
        planned_system(judged.artifact, judged.views),
        judged.artifact,
        datum,
        repeats=unit_repeats(plan),
    )


def predicted_on(plan: Plan) -> Plan:
    """Return the plan, on a field of PROXY_SIZE sites a side if it has above UNASKED_SITES."""
    return (
        smaller(plan, PROXY_SIZE)
        if math.prod(plan.artifact.shape) > UNASKED_SITES
        else plan
    )


def unit_repeats(plan: Plan) -> int:
    """Return the fewest repeats, those of the averaged reading whose noise is the unit."""
    return min(view.repeats for view in plan.views)


def candidate_views(artifact: Artifact, *, angular: bool) -> list[View]:
    """Return the usual views of a cell: quarter turns and one-pitch shifts.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    angular : bool
        Whether angular lines are measured as well; then a turn by one line is included, or by
        `OTHER_TURN_DEG` for a Fourier map.
    """
    angular = angular and artifact.angular_count > 0
    pitch = artifact.grid_pitch_m
    quarter_shift_m = artifact.quarter_shift * pitch
    names = {(0, 0): "", (1, 0): "+x", (0, 1): "+y", (-1, 0): "-x", (0, -1): "-y"}
    views = [
        View(
            f"{90 * q}deg{name}",
            q * math.pi / 2,
            (a * pitch + q % 2 * quarter_shift_m, b * pitch + q % 2 * quarter_shift_m),
            True,
            angular
            and (bool(artifact.harmonics) or q * artifact.angular_count % 4 == 0),
        )
        for (a, b), name in names.items()
        for q in range(4)
        if q % 2 == 0
        or artifact.marks
        or artifact.shape[0] == artifact.shape[1]
        or (a, b) == (0, 0)
    ]
    if angular:
        line = 2 * math.pi / artifact.angular_count
        views.append(
            View("one_line", line, (0.0, 0.0), False, True)
            if not artifact.harmonics
            else View(f"{OTHER_TURN_DEG}deg", math.radians(OTHER_TURN_DEG), grid=False)
        )
    return views


def find_cures(plan: Plan) -> Iterator[tuple[View, ...]]:
    """Yield the smallest sets of candidate views that make `plan` identify the stage.

    Sets for the grid are searched on a field of at most SEARCH_SIZE sites per side, a view turned
    by one line is added if the angular map needs it, and every set is verified on the plan's
    own field, so the result is exact.
    """
    angular = any(view.angular for view in plan.views)
    image = next((view.image for view in plan.views if view.grid), None)
    candidates = [
        replace(view, image=image if view.grid else None)
        for view in candidate_views(plan.artifact, angular=angular)
    ]
    grid_only = [view for view in candidates if view.grid]
    small = smaller(plan, SEARCH_SIZE)
    cures: list[tuple[View, ...]] = [()]
    if not _grid_seen(small, ()):
        for size in (1, 2):
            good = (
                views
                for views in combinations(grid_only, size)
                if _grid_seen(small, views)
            )
            cures = list(islice(good, MAX_CURES))
            if cures:
                break
    for views in cures:
        cure = next(
            (
                more
                for more in (views, (*views, candidates[-1]))
                if more and identifies(plan.artifact, (*plan.views, *more))
            ),
            None,
        )
        if cure:
            yield cure


def _grid_seen(plan: Plan, views: tuple[View, ...]) -> bool:
    grid_views = (view for view in (*plan.views, *views) if view.grid)
    return identifies(
        plan.artifact, tuple(replace(view, angular=False) for view in grid_views)
    )


@dataclass(frozen=True)
class Step:
    """A change of a plan.

    Attributes
    ----------
    view : View or None
        The view to add, or the one to repeat; None for a change of all views.
    views : tuple of View
        All views of the plan with it.
    repeat_of : int or None
        Index of the view to be measured more often.
    order : str
        The visiting order, if that is changed.
    """

    view: View | None
    views: tuple[View, ...]
    repeat_of: int | None = None
    order: str = ""


def more_views(plan: Plan) -> list[Step]:
    """Return the views that may be added."""
    angular = any(view.angular for view in plan.views)
    out = []
    like = next((view for view in plan.views if view.grid), View(""))
    for view in candidate_views(plan.artifact, angular=angular):
        named = measured_like(
            replace(view, name=unused_name(view.name, plan.views)),
            replace(like, repeats=unit_repeats(plan)),
        )
        out.append(Step(named, (*plan.views, named)))
    return out


def measured_like(view: View, like: View) -> View:
    """Return a view with the repeats, and in its marks the visiting order, of another one."""
    view = replace(view, repeats=like.repeats)
    return (
        view
        if not view.grid
        else replace(
            view,
            visit_order=like.visit_order,
            check_marks=like.check_marks,
            check_offset_m=like.check_offset_m,
            image=like.image,
        )
    )


def more_repeats(plan: Plan) -> list[Step]:
    """Return the views that may be measured more often, each by the plan's fewest repeats."""
    unit = unit_repeats(plan)
    out = []
    for index, view in enumerate(plan.views):
        more = replace(view, repeats=view.repeats + unit)
        out.append(
            Step(more, (*plan.views[:index], more, *plan.views[index + 1 :]), index)
        )
    return out


def other_orders(plan: Plan) -> list[Step]:
    """Return the visiting orders, with enough repeats to complete them."""
    steps = [
        Step(None, tuple(_in_order(view, order) for view in plan.views), order=order)
        for order in ORDERS
    ]
    return [step for step in steps if step.views != plan.views]


def check_stops(plan: Plan) -> list[Step]:
    """Return the step to check stops, if the plan has none."""
    if any(view.check_marks for view in plan.views):
        return []
    return [
        Step(
            None,
            tuple(
                replace(view, check_marks=CHECK_MARKS, check_offset_m=CHECK_OFFSET_M)
                if view.grid
                else view
                for view in plan.views
            ),
        )
    ]


def _in_order(view: View, order: str) -> View:
    if not view.grid:
        return view
    passes = parse_order(order).passes
    return replace(view, visit_order=order, repeats=-(-view.repeats // passes) * passes)


def unused_name(name: str, views: Iterable[View]) -> str:
    """Return `name`, numbered if another view of the plan has it."""
    names = {view.name for view in views}
    tail = 2
    out = name
    while out in names:
        out = f"{name}_{tail}"
        tail = tail + 1
    return out
