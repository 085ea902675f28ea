# SPDX-License-Identifier: Apache-2.0
"""The verdict on a solution: one, with the tests that failed and what explains them.

Tests: residuals against the scatter of repeats, or the declared noise, in either direction (F);
each term that the model does not hold; each size of those that it holds (method eq. 7.9); where
the stage stood (7.10); the noise of each view against the others; the axis conditions where they
are the datum. Of 397 clean simulated measurements two were not qualified.
"""

from dataclasses import replace

import numpy as np
from scipy.special import fdtrc

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.blas_threads import one_thread
from selfcal_ros.estimation.datum.angular import MISCLOSURE_LEVEL
from selfcal_ros.estimation.findings import (
    AxesNotMet,
    FiniteRotation,
    NoiseContradicted,
    NoiseUnknown,
    OffSitesCause,
    VisitedOnce,
)
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.noise import pooled
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.joint.solved import Solved
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.cause_sizes import cause_of, noise_cause, size_cause
from selfcal_ros.estimation.verdict.causes import LEVEL, Explanation, find_explanations
from selfcal_ros.estimation.verdict.coverage import with_coverage
from selfcal_ros.estimation.verdict.line_readings import line_cause
from selfcal_ros.estimation.verdict.off_sites import off_sites_cause
from selfcal_ros.estimation.verdict.provenance import provenance_of
from selfcal_ros.estimation.verdict.reading_columns import READING
from selfcal_ros.estimation.verdict.rotations import bends, rotation_cause, solved_apart
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.statistics import rms
from selfcal_ros.model.terms import TermName
from selfcal_ros.model.verdict import Cause, Finding, Verdict

ALWAYS_SITES = 41 * 41
"""Field up to which terms are looked for in any case; beyond, where another test fails."""

MAX_SITES = 201 * 201
"""Field up to which they are looked for at all."""

NOISY = 1.5
"""Ratio of the noise of a view to that of the others from which it matters."""

MUCH_MORE = 1.1
"""Ratio of what a linear model leaves to what finite rotations leave from which it is named."""

MATTERS = 0.1
"""Effect of a cause on the map, in standard uncertainties (rms), below which it is of no account
where the readings tell all of it."""


@one_thread()
def judged(solved: Solved, measurements: Measurements, options: Options) -> CalibrationResult:
    """Return the result with its verdict, not worded.

    Parameters
    ----------
    solved : Solved
        What is to be judged.
    measurements : Measurements
        The readings behind it.
    options : Options
        How it was calibrated.
    """
    noises = _noise_findings(solved)
    checked = checked_by(solved, measurements, options, failed=bool(noises))
    failed = [*_rotation_findings(solved, checked), *noises, *_axes_findings(checked)]
    places, sizes = _off_sites(checked, options), _sizes(solved)
    others = [*sizes, *_causes(checked, measurements, options,
                               failed=bool(failed or sizes or places))]
    causes = _in_order(places, others)
    verdict = Verdict(not (failed or causes), causes=causes, findings=(*failed, *causes))
    reference = options.reference
    result = with_coverage(solved.result, reference)
    return replace(
        result, verdict=verdict, findings=(*result.findings, *_visits_findings(checked)),
        provenance=provenance_of(measurements, options),
        reference=None if reference is None else {
            "kind": str(reference.kind), "relative_error": reference.relative_error,
            "u_relative": reference.u_relative, "certificate": reference.certificate})


def _sizes(solved: Solved) -> list[Cause]:
    """Return the terms whose size the readings contradict, the worst first."""
    if solved.model is None:
        return []
    found = {term.name: term.estimates for term in solved.result.model.terms}
    return [size_cause(test, found[test.name]) for test in solved.model.sizes
            if test.contradicted]


def checked_by(solved: Solved, measurements: Measurements, options: Options, *,
               failed: bool) -> Solved:
    """Return the solution that is looked through for causes: joint, and rigid if that fits better.

    Hu's law has no residuals of the whole, and a linear model takes rotations for something else.
    `solved` itself where nobody asked, or where no other can be had.
    """
    nx, ny = measurements.artifact.shape
    wanted = failed or (solved.model is None and nx * ny <= ALWAYS_SITES)
    if options.causes is False or not wanted or options.misalignment_model != "linear":
        return solved
    try:
        linear = solved if solved.model is not None else solve_joint(
            measurements, replace(options, method="joint", misalignment_model="linear"))
        rigid = linear if not failed else solve_joint(
            measurements, replace(options, method="joint", misalignment_model="rigid"))
    except InputError:
        return solved
    return rigid if MUCH_MORE * rigid.xy.residuals < linear.xy.residuals else linear


def _rotation_findings(solved: Solved, checked: Solved) -> list[Finding]:
    """Return whether finite rotations explain what a linear model leaves."""
    if checked is solved or checked.model is None or not checked.model.problem.rigid:
        return []
    return [FiniteRotation(max(abs(view.phi) for view in checked.result.views),
                           checked.xy.residuals)]


def _noise_findings(solved: Solved) -> list[Finding]:
    out: list[Finding] = [
        NoiseContradicted(kind, noise.residuals, noise.stated, bool(np.isfinite(noise.declared)))
        for noise, kind in ((solved.xy, "grid"), (solved.theta, "angular")) if noise.contradicted]
    return out if np.isfinite(solved.xy.sigma) else [*out, NoiseUnknown()]


def _axes_findings(solved: Solved) -> list[Finding]:
    p, size_rad = solved.axes
    return [] if p >= MISCLOSURE_LEVEL else [AxesNotMet(size_rad, p)]


def _off_sites(solved: Solved, options: Options) -> list[Cause]:
    """Return whether the stage stood off the sites where that matters."""
    model = solved.model
    if options.causes is False or model is None or not model.problem.direct:
        return []
    cause = off_sites_cause(model, solved.result.error_map, LEVEL)
    return [cause] if cause else []


def _in_order(places: list[Cause], others: list[Cause]) -> tuple[Cause, ...]:
    """Return the causes, the likeliest first: places of the stage last, unless residuals show them.

    What spoils the readings spoils the slopes of the map, on which the effect of places rests.
    """
    first = any(isinstance(cause.what, OffSitesCause) and cause.what.shown for cause in places)
    return (*places, *others) if first else (*others, *places)


def _visits_findings(solved: Solved) -> list[Finding]:
    """Return whether repeats are there, and none of them at another time."""
    if solved.model is None:
        return []
    problem = solved.model.problem
    held = any(term.name is TermName.DRIFT for term in problem.terms)
    visits = [view for view in problem.ground.visits if view is not None]
    once = len(visits) == len(problem.ground.visits) and not any(v.repeated for v in visits)
    return [VisitedOnce()] if once and not held and problem.repeats_xy[1] > 0 else []


def _causes(solved: Solved, measurements: Measurements, options: Options, *,
            failed: bool) -> list[Cause]:
    """Return what the readings show beside the model, the likeliest first."""
    model = solved.model
    if model is None or not model.problem.direct or not np.isfinite(solved.xy.sigma):
        return []
    if not are_looked_for(model.problem.system.grid.n_sites, options, failed=failed):
        return []
    line = line_cause(model.problem, measurements, LEVEL)
    causes = [*_of_marks(solved, model, measurements, options, failed=failed),
              *([line] if line else [])]
    return causes or _noisy_views(measurements, model)


def _of_marks(solved: Solved, model: ModelFit, measurements: Measurements, options: Options, *,
              failed: bool) -> list[Cause]:
    """Return what the marks show beside the model, or a rotation that they do not share."""
    turned = rotation_cause(model, LEVEL)
    if turned is None:
        return _explained(solved, model, failed=failed)
    # what the marks leave is bent by the lines then: it tells nothing of other causes
    apart = solved_apart(measurements, options)
    if apart is None or apart.model is None:
        return [turned]
    counts = failed or bends(solved.result, apart.result, MATTERS)
    # what spoils the marks turns them as well: a rotation is the cause where nothing else is
    others = _explained(apart, apart.model, failed=counts)
    return others or ([turned] if counts else [])


def _explained(solved: Solved, model: ModelFit, *, failed: bool) -> list[Cause]:
    """Return what explains the residuals of a solution, the likeliest first."""
    found = [item for item in find_explanations(model, slips=False)
             if failed or _counts(item, solved)]
    if found or failed:
        found = find_explanations(model, slips=True)
    return [cause_of(item, model.problem.ground.names, model.problem.half_width_m)
            for item in found]


def are_looked_for(sites: int, options: Options, *, failed: bool) -> bool:
    """Return whether causes are looked for in a field of so many sites, unasked only in small ones.

    Parameters
    ----------
    sites : int
        Sites of the field.
    options : Options
        Whether somebody asked.
    failed : bool
        Whether another test failed.
    """
    if options.causes is False or sites > MAX_SITES:
        return False
    return failed or sites <= ALWAYS_SITES or bool(options.causes)


def _counts(found: Explanation, solved: Solved) -> bool:
    """Return whether an explanation is worth a word: by what it does to the map."""
    if not found.whole or found.name == READING:  # one node may be far off, and the rest not
        return True
    emap = solved.result.error_map
    u = np.concatenate([emap.u_gx[emap.valid], emap.u_gy[emap.valid]])
    if not np.isfinite(u).any():
        return True
    return found.effect_m > MATTERS * rms(u)


def _noisy_views(measurements: Measurements, model: ModelFit) -> list[Cause]:
    """Return the views whose repeats scatter more than those of the others."""
    if model.problem.terms:
        return []  # their own scatter holds what the terms explain
    views = [(v.view.name, v.sigma_xy, v.dof_xy) for v in measurements.views
             if len(v.m) and v.dof_xy > 0 and np.isfinite(v.sigma_xy)]
    out = []
    for index, (name, sigma, dof) in enumerate(views):
        others, rest = pooled((s, d) for i, (_, s, d) in enumerate(views) if i != index)
        if not rest or not others > 0:
            continue
        ratio = sigma / others
        p = float(fdtrc(dof, rest, ratio**2)) * len(views)
        if p < LEVEL and ratio > NOISY:
            out.append(noise_cause(name, ratio, ratio * np.sqrt((1 / dof + 1 / rest) / 2), p))
    return sorted(out, key=lambda cause: cause.p)
