# SPDX-License-Identifier: Apache-2.0
"""The verdict on a solution: its grade, the tests that failed, and their causes.

Residuals are compared with the scatter of repeats, or with the declared noise, in either direction
(F-test); the axis conditions are tested where they are the datum; and
`selfcal_ros.estimation.verdict.search` searches for causes. A cause whose effect is bounded
enlarges U; one that is not disqualifies the result. The result also states when the readings were
taken.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import numpy as np
from scipy.special import chdtri, ndtri

from selfcal_ros import __version__
from selfcal_ros.blocks import traits_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import (
    LEAST_NOISE_M,
    MAX_REMOVED,
    SHOWN,
    contradicted_scale,
    shows_offsets,
    sign_is_shown,
    sign_of_lines_is_shown,
)
from selfcal_ros.estimation.datum.covariance import USUAL_LEVEL
from selfcal_ros.estimation.joint.model_fit import ModelFit, squares
from selfcal_ros.estimation.joint.problem import (
    NEGLIGIBLE,
    SAME,
    NoiseEstimate,
    fit,
)
from selfcal_ros.estimation.joint.solve import (
    NEARLY_EXACT_M,
    Solved,
    fit_joint,
    solve_joint,
)
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.normal.equations import ENOUGH_DOF
from selfcal_ros.estimation.observability.rank import DETERMINED
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.equations import DOUBT_LEVEL
from selfcal_ros.estimation.terms.visits import time_ranges
from selfcal_ros.estimation.verdict.causes import NOISY
from selfcal_ros.estimation.verdict.leverage import FEW_OUTLIERS
from selfcal_ros.estimation.verdict.search import ALWAYS_SITES, search_causes
from selfcal_ros.estimation.verdict.uncertainty import (
    DETERMINED_BELOW,
    Effect,
    budget_lines,
    effect_everywhere,
    enlarged,
    enlargements,
    with_coverage,
)
from selfcal_ros.estimation.verdict.undetermined import with_undetermined_terms
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.findings import (
    ApproachUnknown,
    AxesNotMet,
    Cause,
    Finding,
    FiniteRotation,
    HarmonicsUntested,
    LinesSignNotShown,
    NoiseContradicted,
    NoiseUnknown,
    NoOffsets,
    NotConverged,
    RepeatsContradict,
    RoughnessUntested,
    ScaleOfOffsets,
    SignNotShown,
    SignShownByLines,
    TermWithoutReadings,
    ViewLeftOut,
    VisitedOnce,
)
from selfcal_ros.model.kept import LACK_OF_FIT, ROUGHNESS
from selfcal_ros.model.readings import (
    AFTER_SLIP,
    REPEAT_OUTLIER,
    Measurements,
    ViewReadings,
)
from selfcal_ros.model.verdict import Grade, Provenance, Verdict
from selfcal_ros.units import NS_PER_S

SIGN_U = 0.3
"""Standard uncertainty of the microscope's scale, by the joint fit alone, up to which the readings
show the sign of the offsets."""

LACK_LEVEL = 0.02
"""Two-sided level from which residuals beyond the scatter of repeats count as lack of fit."""


@one_thread()
def judged(
    solved: Solved, measurements: Measurements, options: Options, *, advise: bool = True
) -> Solved:
    """Return the solution that allows for causes, its result with its verdict as data.

    Parameters
    ----------
    solved : Solved
        The solution.
    measurements, options : Measurements, Options
        Its readings, and how they were solved.
    advise : bool
        Whether remedies of causes are tried.
    """
    solved, options, undetermined = with_undetermined_terms(
        solved, measurements, options
    )
    noises = list(_noise_findings(solved))
    checked = checked_by(solved, measurements, options, failed=bool(noises))
    is_same = checked is solved
    failed = _failed_tests(solved, checked, measurements, options)
    searched = search_causes(
        checked, measurements, options, failed=bool(noises), advise=advise
    )
    causes = _with_declared_zeros(searched.causes, options)
    if is_same:
        solved = searched.solved
        noises = list(_noise_findings(solved))
    explained = solved if is_same else checked
    failed += _scale_findings(explained, measurements, options, causes)

    effects = [*searched.effects, *_beyond_repeats(solved)]
    result = with_coverage(
        enlarged(
            replace(solved.result, reference=options.reference),
            [*effects, *undetermined],
        )
    )
    bounded = (
        searched.bounded and (is_same or not causes) and not _unexplained_noise(solved)
    )
    if not (failed or noises or causes):
        grade = Grade.GOOD
    elif bounded and not failed and result.has_uncertainty:
        grade = Grade.ENLARGED
    else:
        grade = Grade.NOT_QUALIFIED
    # what is neither a cause nor a failed test is a line of the budget alone
    named = {(cause.name, cause.unit) for cause in causes}
    named |= {(LACK_OF_FIT, noise.unit) for noise in noises}
    shown_effects = [
        effect
        for effect in effects
        if effect.name not in (ROUGHNESS, LACK_OF_FIT)
        or (effect.name, effect.unit) in named
    ]
    verdict = Verdict(
        grade,
        (*failed, *noises),
        causes,
        enlargements(result, searched.terms, shown_effects),
    )
    result = replace(
        result,
        verdict=verdict,
        findings=(
            *result.findings,
            *_visits_findings(checked),
            *views_findings(measurements),
            *_without_readings(solved, options),
        ),
        provenance=provenance_of(measurements, options),
    )
    return replace(solved, result=replace(result, budget=tuple(budget_lines(result))))


def _failed_tests(
    solved: Solved, checked: Solved, measurements: Measurements, options: Options
) -> list[Finding]:
    """Return the tests that fail whatever the causes: model, axes, iteration, signs.

    Parameters
    ----------
    solved, checked : Solved
        The solution, and the one in which causes are searched for.
    measurements, options : Measurements, Options
        Its readings, and how they were solved.
    """
    failed: list[Finding] = []
    if (
        checked is not solved
        and checked.model is not None
        and checked.model.problem.rigid
    ):
        failed.append(
            FiniteRotation(
                size=max(abs(view.phi) for view in checked.result.views),
                unit="rad",
                residuals=checked.xy.residuals,
            )
        )
    p, size_rad = checked.axes
    if not p >= USUAL_LEVEL:
        failed.append(AxesNotMet(size=size_rad, unit="rad", p=p))
    if not solved.converged:
        failed.append(NotConverged())
    if solved.model is not None:
        system = solved.model.problem.system
        if not _test_the_model(solved.xy) and system.nodes_untested:
            failed.append(RoughnessUntested())
        if system.angular.harmonics_untested:
            failed.append(HarmonicsUntested())
    failed += _sign_findings(checked, measurements, options)
    failed += _lines_sign_findings(checked, measurements, options)
    return failed


def _test_the_model(noise: NoiseEstimate) -> bool:
    """Return whether residuals of marks test the model: noise is known, or there is none."""
    dof_known = np.inf if np.isfinite(noise.declared) else noise.dof_repeats
    return (
        min(dof_known, noise.dof_residuals) >= ENOUGH_DOF
        or noise.residuals < NEARLY_EXACT_M
    )


def _with_declared_zeros(
    causes: Iterable[Cause], options: Options
) -> tuple[Cause, ...]:
    """Return the causes; those of terms that were declared to be 0 say so."""
    zero = {str(term.name) for term in options.terms if term.size == 0}
    return tuple(
        replace(cause, details=replace(cause.details, declared=0.0))
        if str(cause.name) in zero
        else cause
        for cause in causes
    )


def _without_readings(solved: Solved, options: Options) -> Iterator[Finding]:
    """Yield a finding of each named term on which no reading depends: the model is without it."""
    if solved.model is None:
        return
    estimated = {term.name for term in solved.model.problem.terms}
    for term in options.terms:
        if term.size > 0 and term.name not in estimated:
            yield TermWithoutReadings(term=str(term.name))


def _beyond_repeats(solved: Solved) -> Iterator[Effect]:
    """Yield what residuals have beyond the scatter of repeats, each map's, as its lack of fit.

    It does not average out: it is met in full at every place, with a sign of its own. That of the
    view with the most counts: sites that all views share hide it.
    """
    if solved.model is None:
        return
    emap = solved.result.error_map
    fitted = solved.model.fitted
    system = solved.model.problem.system
    size_m = _lack_of_fit(solved.xy, system.grid.weight, abs(fitted.residuals))
    if size_m:
        yield effect_everywhere(LACK_OF_FIT, emap, size_m=size_m)
    size_rad = _lack_of_fit(solved.theta, system.angular.weight, fitted.residuals_theta)
    if size_rad:
        yield effect_everywhere(LACK_OF_FIT, emap, size_rad=size_rad)


def _lack_of_fit(
    noise: NoiseEstimate, weight: np.ndarray, residuals: np.ndarray
) -> float:
    """Return the most that one mean has beyond noise, m or rad; 0 if residuals leave no doubt.

    By the upper limit of the residuals of each view, with the confidence of a doubtful size.

    Parameters
    ----------
    noise : NoiseEstimate
        Noise of the readings.
    weight, residuals : float arrays (views, ...)
        Weights and residuals of the readings.
    """
    if not (noise.p_of_known < LACK_LEVEL and noise.residuals > noise.known):
        return 0.0
    weight_of_views = weight.reshape(len(weight), -1)
    squares = (weight_of_views * residuals.reshape(weight_of_views.shape) ** 2).sum(
        axis=1
    )
    share_of_view = (weight_of_views > 0).sum(axis=1) / (weight_of_views > 0).sum()
    dof = noise.dof_residuals * share_of_view
    largest = (
        noise.residuals**2
        * squares
        / squares.sum()
        * noise.dof_residuals
        / chdtri(dof, 1 - DOUBT_LEVEL)
    )
    return float(
        np.sqrt(
            max(largest.max() - noise.known**2, 0.0)
            / weight_of_views[weight_of_views > 0].mean()
        )
    )


def _unexplained_noise(solved: Solved) -> bool:
    """Return whether the noise is not known, or residuals are larger than U covers."""
    return not np.isfinite(solved.xy.sigma) or any(
        noise.contradicted and noise.residuals > NOISY * noise.known
        for noise in (solved.xy, solved.theta)
    )


def checked_by(
    solved: Solved, measurements: Measurements, options: Options, *, failed: bool
) -> Solved:
    """Return the solution in which causes are searched for: joint, and rigid if that fits better.

    A solution by other steps has no residuals of all readings, and a linear model mistakes
    rotations for other effects. `solved` itself if no search is wanted, or there is no other
    solution.
    """
    nx, ny = measurements.artifact.shape
    is_checked = failed or nx * ny <= ALWAYS_SITES
    if (
        options.causes is False
        or not is_checked
        or options.misalignment_model != "linear"
    ):
        return solved
    try:
        linear = (
            solved
            if solved.model is not None
            else solve_joint(measurements, replace(options, at_places=False))
        )
        rigid = solve_joint(measurements, replace(options, misalignment_model="rigid"))
    except InputError:
        return solved
    return rigid if SAME * rigid.xy.residuals < linear.xy.residuals else linear


def _sign_findings(
    solved: Solved, measurements: Measurements, options: Options
) -> Iterator[Finding]:
    """Yield a finding if nothing shows the sign of the offsets, or lines alone do.

    Repeats show it, or the joint fit does (through where the stage stood beside its targets,
    rotations that lines share, and their squares), or the microscope was declared. Lines share
    rotations with the other sign as well if it is that of their own offsets, too.
    """
    if (
        _is_declared(options)
        or not shows_offsets(measurements)  # nothing can show it
        or sign_is_shown(measurements)
    ):
        return
    model = (
        solved.model if options.finite_rotations else _rigid_fit(measurements, options)
    )
    if model is None:
        return
    equations = model.equations
    rows = equations.columns.having(lambda block: block.of_microscope)
    scale = [
        at
        for at in np.flatnonzero(rows)
        if equations.columns.columns[at].component == "scale"
    ]
    if not scale or not np.isfinite(model.fitted.xy.sigma):
        return
    lines = equations.columns.having(lambda block: block.of_offsets and block.of_lines)

    def is_shown(*, by_lines: bool) -> bool:
        undetermined = equations.undetermined(rows, unknown=None if by_lines else lines)
        spread = equations.inverse_without(lines & by_lines)[scale[0], scale[0]]
        hidden = np.abs(undetermined[scale[0]]).max(initial=0.0) > NEGLIGIBLE
        return not hidden and 0 <= spread * model.fitted.xy.sigma**2 <= SIGN_U**2

    with_lines = is_shown(by_lines=True)
    if with_lines and (
        is_shown(by_lines=False) or sign_of_lines_is_shown(measurements)
    ):
        return
    if not any(
        view is not None and view.offset.any() for view in model.problem.inputs.visits
    ):
        yield NoOffsets()
    elif not _stops_show_the_sign(model, measurements):
        yield SignShownByLines() if with_lines else SignNotShown()


def _stops_show_the_sign(model: ModelFit, measurements: Measurements) -> bool:
    """Return whether views show by what the stage stood beside its targets the sign of offsets.

    It stood s beside them, and y = s + o. If s is motion, true offsets undo it; offsets of the
    other sign double it; noise of the encoders is left as it is. With Q(k) the squares of what
    y - k s leaves, k = 1 - (Q(2) - Q(0)) / 4a is near 0, 2 and 1, its variance sigma^2 / a with
    a = (Q(0) + Q(2)) / 2 - Q(1). It has to be nearer to 0 than to 1. All signs reversed, o - s is
    a reading as good as s - o: a stage that stood on its targets has nothing to tell them apart by.
    """
    # with its noise: lines weigh the same for each k
    problem = replace(model.problem, terms=())
    stood = np.zeros_like(model.y)
    for row, (index, placed) in enumerate(
        zip(problem.grid.index, problem.inputs.visits, strict=True)
    ):
        visits = measurements.views[index].visits
        if visits is None or placed is None:
            continue
        motion = visits.dx - visits.offset_x + 1j * (visits.dy - visits.offset_y)
        means = placed.means((motion * placed.phase)[None], stood[row].size)[0]
        stood[row] = means.reshape(stood[row].shape)
    with_it, halfway, without = (
        squares(problem, fit(problem, model.y - k * stood), of_noise=False)[0]
        for k in range(3)
    )
    noise = max(model.fitted.xy.sigma, LEAST_NOISE_M)
    information = (with_it + without) / 2 - halfway
    if not information > noise**2:
        return False
    undone = (without - with_it) / (4 * information)
    return bool(undone > max(0.5, -ndtri(SHOWN) * noise / np.sqrt(information)))


def _is_declared(options: Options) -> bool:
    """Return whether the microscope is declared, and with it the signs of the offsets."""
    return not options.assumed or any(
        term.block.of_microscope and not term.free for term in options.terms
    )


def _lines_sign_findings(
    solved: Solved, measurements: Measurements, options: Options
) -> Iterator[Finding]:
    """Yield a finding if nothing shows the sign of the lines' offsets.

    Their repeats show it, or the turns of the plate that marks and lines share: with the other
    sign the readings fit less well. Conditions of the axes show it by themselves, or the
    microscope was declared.
    """
    model = solved.model
    if (
        model is None
        or _is_declared(options)
        or options.datum_theta != ThetaDatum.ZERO_MEAN
        or not np.isfinite(solved.xy.sigma)
        or sign_of_lines_is_shown(measurements)
        or not model.problem.system.angular.n_views
    ):
        return
    problem = replace(model.problem, terms=(), residuals_xy=None)
    angular = problem.angular
    squared = []
    turns = dict(zip(problem.grid.index, problem.turn_rad, strict=True))
    turn = np.array([turns.get(index, 0.0) for index in angular.index])[:, None]
    # of the readings before they were turned into the frame of the plate
    for sign in (1, -1):
        y = np.where(angular.weight > 0, sign * (angular.y + turn) - turn, 0.0)
        read = replace(problem, angular=replace(angular, y=y))
        squared.append(squares(read, fit(read, model.y), of_noise=False)[0])
    worse = (squared[1] - squared[0]) / max(solved.xy.sigma, LEAST_NOISE_M) ** 2
    if not worse > -2 * np.log(SHOWN):
        yield LinesSignNotShown()


def _scale_findings(
    solved: Solved,
    measurements: Measurements,
    options: Options,
    causes: Iterable[Cause],
) -> Iterator[Finding]:
    """Yield a finding if repeats contradict a scale of the microscope that is not fitted.

    A fit uses offsets that are far larger than their noise. Of smaller ones, the noise of encoders
    reduces the scale and that of detections increases it: they give limits.
    """
    term = next(
        (term for term in options.model_terms(visits=True) if term.block.of_microscope),
        None,
    )
    u = 0.0 if term is None else term.size_of("scale")
    fitted = [
        estimate
        for term_result in solved.result.model.terms
        if term is not None and term_result.name == term.name
        for estimate in term_result.estimates
        if estimate.component == "scale" and estimate.u < DETERMINED_BELOW * u
    ]
    if (
        np.isinf(u)
        or fitted
        or any(traits_of(cause.name).of_microscope for cause in causes)
    ):
        return
    if (response := contradicted_scale(measurements, u)) is not None:
        yield ScaleOfOffsets(
            size=-response.slope,
            u=response.u_slope,
            unit="m/m",
            p=response.p,
            axis=response.axis,
            most=response.most,
            u_scale=u,
        )


def _rigid_fit(measurements: Measurements, options: Options) -> ModelFit | None:
    """Return the fit with finite rotations: a linear model has no microscope."""
    try:
        return fit_joint(measurements, replace(options, misalignment_model="rigid"))
    except InputError:
        return None


def _noise_findings(solved: Solved) -> Iterator[Finding]:
    for noise, unit in ((solved.xy, "m"), (solved.theta, "rad")):
        if noise.contradicted:
            yield NoiseContradicted(
                size=noise.residuals,
                unit=unit,
                p=noise.p,
                stated=noise.stated,
                declared=bool(np.isfinite(noise.declared)),
            )
    if not np.isfinite(solved.xy.sigma):
        yield NoiseUnknown()


def _visits_findings(solved: Solved) -> Iterator[Finding]:
    """Yield a finding if all repeats of each mark are one visit, or approaches are not known."""
    if solved.model is None:
        return
    problem = solved.model.problem
    time_fitted = any(term.block.of_time for term in problem.terms)
    visits = [view for view in problem.inputs.visits if view is not None]
    visited_once = len(visits) == len(problem.inputs.visits) and not any(
        v.repeated for v in visits
    )
    if visited_once and not time_fitted and problem.repeats_xy[1] > 0:
        yield VisitedOnce()
    unknown = [(v.approach_x == 0) | (v.approach_y == 0) for v in visits]
    if visits and np.concatenate(unknown).mean() > 0.5:
        yield ApproachUnknown()


def views_findings(measurements: Measurements) -> Iterator[Finding]:
    """Yield the views whose repeats often contradict each other, then those left out."""
    n_used: Counter[str] = Counter()
    rejected: dict[str, Counter[str]] = {}
    for view in measurements.views:
        name = view.view.plan_view
        n_used[name] += view.used
        rejected.setdefault(name, Counter()).update(view.rejected)
    for name, counts in rejected.items():
        n_lost = counts[REPEAT_OUTLIER]
        total = counts[REPEAT_OUTLIER] + n_used[name]
        if n_lost > max(FEW_OUTLIERS, MAX_REMOVED * total):
            yield RepeatsContradict(view=name, rejected=n_lost, of=total)
    yield from _left_out_findings(measurements)


def _left_out_findings(measurements: Measurements) -> Iterator[Finding]:
    """Yield the views of which less than half of the marks, or of the lines, became readings.

    A kind of mark that no view has is not missed in a view that has the other. The parts of a view
    in which the plate slipped are one view.
    """
    artifact = measurements.artifact
    readings_of_view = dict[str, list[ViewReadings]]()
    for readings in measurements.views:
        view_of_part = replace(
            readings.view, name=readings.view.name.split(AFTER_SLIP)[0]
        )
        readings_of_view.setdefault(view_of_part.plan_view, []).append(readings)
    kinds_read = (
        any(len(readings.m) for readings in measurements.views),
        any(len(readings.k) for readings in measurements.views),
    )
    for name, readings_of_cells in readings_of_view.items():
        views = {
            readings.view.cell: readings.view for readings in readings_of_cells
        }.values()
        n_planned = (
            sum(
                int(view.on_stage(artifact).mark_rows(artifact)[1].sum())
                for view in views
                if view.grid
            ),
            artifact.angular_count * any(view.angular for view in views),
        )
        n_read = (
            sum(len(readings.m) for readings in readings_of_cells),
            sum(len(readings.k) for readings in readings_of_cells),
        )
        few = any(
            kind_read and got < DETERMINED * planned
            for kind_read, got, planned in zip(
                kinds_read, n_read, n_planned, strict=True
            )
        )
        if few or not any(n_read):
            rejected = sum(
                (Counter(readings.rejected) for readings in readings_of_cells),
                Counter[str](),
            )
            yield ViewLeftOut(
                view=name,
                read=n_read,
                asked=n_planned,
                rejected={
                    str(reason): count for reason, count in rejected.most_common(3)
                },
            )


FIRST_DATE_NS = 365 * 86_400 * NS_PER_S
"""Stamp below which stamps are not dates, 1971."""


def provenance_of(measurements: Measurements, options: Options) -> Provenance:
    """Return the origin of the readings: first and last exposure, visiting order.

    `model_terms_from` says who requested terms: ``options`` or ``plan``. The time of creation is
    left empty, so that the same readings give the same result. Stamps of 1970 are no dates: those
    of a simulated clock, or of images whose times are not known.
    """
    first, last = time_ranges(measurements.views, [0] * len(measurements.views)).get(
        0, (0, 0)
    )
    extra: dict[str, Any] = {
        "visit_order": {
            view.view.name: view.view.visit_order
            for view in measurements.views
            if view.view.visit_order
        }
    }
    if options.terms_from:
        extra["model_terms_from"] = options.terms_from
    if first < FIRST_DATE_NS:
        return Provenance(version=__version__, extra=extra)
    duration_s = (last - first) / NS_PER_S
    return Provenance(
        duration_s=duration_s,
        version=__version__,
        extra=extra,
        first_exposure=_iso(first),
        last_exposure=_iso(last),
    )


def _iso(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601 in UTC; as nanoseconds if it is not a date."""
    try:
        return datetime.fromtimestamp(stamp_ns / NS_PER_S, UTC).isoformat(
            timespec="milliseconds"
        )
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
