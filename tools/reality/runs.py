# SPDX-License-Identifier: Apache-2.0
"""Runs of a case: simulate, calibrate, compare with the truth, follow the advice that is given."""

import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.stats import binom, norm

from selfcal_ros.errors import InputError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.error_map import datum_modes, remove_modes, rms
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.simulation.cell import plan_events
from selfcal_ros.simulation.machine import Truth, random_truth
from test.support.collecting import gathered
from test.support.truth import FIRST_STAMP_NS, simulate_measurements
from tools.reality.cases import Case, term_cases
from tools.reality.machines import machine_cases
from tools.reality.populations import populations

WRONG = (0.85, 242)
"""Part of the map inside k u below which a single map is called wrong: of 242 correlated
coordinates 95 % are inside on average, and hardly ever fewer than 85 % in a clean run. Where one
smooth error dominates, as few are inside by chance: see `beyond_chance`."""
OF_DRAWS = 0.01, 2000
"""Part of the draws from the covariance of a map that may have fewer errors inside than a map that
is not wrong, and how many are drawn."""
BY_CHANCE = 1e-4
"""Probability of as few angles inside k u as make a map of angles wrong: 17 of 24, 3 of 8."""
COVERAGE = 0.9545
"""Part of the errors that k u is to hold."""
STEPS, AGAIN = 4, 2
"""Advice that is followed at most, one after another, and how often the same in a row."""
GRADES = ("good", "enlarged", "not_qualified", "refused")


@dataclass(frozen=True)
class Run:
    """One calibration against its truth; of a refused one only `grade` and `causes` count.

    `error_m` is the largest error of a coordinate of the map, `within` and `within_theta` the parts
    of the maps inside k u, `within_x` and `within_y` those of Gx and Gy, `z_xy` and `z_theta` the
    rms of the errors over their u, `holds` whether enough of both maps is inside, `causes` the
    names of the causes given.
    """

    grade: str
    error_m: float = float("nan")
    within: float = float("nan")
    within_theta: float = float("nan")
    z_xy: float = float("nan")
    z_theta: float = float("nan")
    holds: bool = True
    causes: tuple[str, ...] = ()
    within_x: float = float("nan")
    within_y: float = float("nan")

    @property
    def wrong(self) -> bool:
        """Whether the map is accepted and its uncertainty does not hold the error."""
        return self.grade in GRADES[:2] and not self.holds


@dataclass(frozen=True)
class Course:
    """The first calibration of a run, what was advised and done, and the last."""

    first: Run
    steps: tuple[str, ...] = ()
    last: Run | None = None

    @property
    def end(self) -> Run:
        """The result when no advice is left to follow."""
        return self.last or self.first


@cache
def every_case() -> tuple[Case, ...]:
    """Return all cases, populations last."""
    return (*machine_cases(), *term_cases(), *populations())


def once(numbers: tuple[int, int]) -> Course:
    """Return what comes of run `numbers[1]` of case `numbers[0]`."""
    return run_case(every_case()[numbers[0]], numbers[1])


def run_case(case: Case, seed: int) -> Course:
    """Simulate, calibrate, and follow the advice to its end; the same seed is the same machine."""
    case = case.draw(_rng(case, seed, 0), case) if case.draw else case
    truth, readings, said = measured(case, seed, 1)
    options = case.options
    result = _calibrated(readings, options)
    first = last = compared(result, truth, said)
    steps: list[str] = []
    while len(steps) < STEPS and isinstance(result, CalibrationResult):
        advice = advised(result, options)
        if advice is None:
            break
        text, options = advice
        if steps[-AGAIN:] == [text] * AGAIN:
            break
        # nothing to solve anew with: measure it again
        if options.terms == case.options.terms:
            truth, readings, said = measured(case, seed, 2 + len(steps))
        steps.append(text)
        result = _calibrated(readings, options)
        last = compared(result, truth, said)
    return Course(first, tuple(steps), last if steps else None)


def _rng(case: Case, seed: int, part: int) -> np.random.Generator:
    """Return random numbers that stay the same when other cases come and go."""
    return np.random.default_rng([zlib.crc32(case.name.encode()), seed, part])


def measured(
    case: Case, seed: int, part: int
) -> tuple[Truth, Measurements, tuple[str, ...]]:
    """Return the machine of a run, a measurement of it, number `part`, from 1, and what it says.

    What is said is why most detections of a view were rejected.
    """
    machine, placing = _rng(case, seed, 0), _rng(case, seed, part)
    truth = random_truth(
        case.plan.artifact, len(case.plan.views), machine, case.spread, placing=placing
    )
    truth = case.change(truth, placing)
    if case.messages:
        return truth, *_collected(truth, case, placing)
    readings = simulate_measurements(
        truth,
        case.plan,
        placing,
        settings=case.settings,
        visits=True,
        missing=case.missing,
    )
    return truth, case.spoil(readings, placing), ()


def _collected(
    truth: Truth, case: Case, rng: np.random.Generator
) -> tuple[Measurements, tuple[str, ...]]:
    """Return the readings, and what is said of them, as `selfcal solve` has them from a bag."""
    collector = gathered(
        plan_events(
            truth, case.plan, settings=case.settings, rng=rng, start_ns=FIRST_STAMP_NS
        ),
        measurement_sense=str(case.settings.sense),
    )
    measurements, views = collector.collect()
    findings = collector.findings(measurements, views).values()
    return measurements, tuple(
        str(found).partition("stage_not_at_mark: ")[2].partition("; ")[0] or str(found)
        for found in findings
    )


def _calibrated(readings: Measurements, options: Options) -> CalibrationResult | str:
    """Return the result, or the name of the refusal."""
    try:
        return calibrate(readings, options)
    except (NotIdentifiableError, InputError) as error:
        return type(error).__name__


def compared(
    result: CalibrationResult | str, truth: Truth, said: tuple[str, ...] = ()
) -> Run:
    """Return how far a calibration lies from the truth, in its datum."""
    if isinstance(result, str):
        return Run("refused", causes=(*said, result))
    emap = result.error_map
    error = np.stack([emap.gx, emap.gy]) - truth.g
    error = remove_modes(error, datum_modes(truth.artifact, scale=True))
    theta = emap.g_theta - truth.g_theta
    theta = theta - np.nanmean(theta) if np.isfinite(theta).any() else theta
    k = result.noise.k_xy
    within, z_xy = _covered(error, np.stack([emap.u_gx, emap.u_gy]), k)
    within_x, within_y = (
        _covered(each, u, k)[0]
        for each, u in zip(error, (emap.u_gx, emap.u_gy), strict=True)
    )
    within_theta, z_theta = _covered(theta, emap.u_g_theta, result.noise.k_theta)
    n_theta = int(np.isfinite(theta).sum())
    holds = not (
        (
            within < limit(int(np.isfinite(error).sum()))
            and beyond_chance(result, within, z_xy)
        )
        or within_theta < binom.ppf(BY_CHANCE, n_theta, COVERAGE) / max(n_theta, 1)
    )
    return Run(
        grade_of(result),
        float(np.nanmax(np.abs(error))),
        within,
        within_theta,
        z_xy,
        z_theta,
        holds,
        (*said, *(cause.name for cause in result.verdict.causes)),
        within_x,
        within_y,
    )


def limit(n_errors: int) -> float:
    """Return the part inside k u below which an XY map is wrong; fewer errors scatter more."""
    at, count = WRONG
    return COVERAGE - (COVERAGE - at) * float(np.sqrt(count / max(n_errors, 1)))


def beyond_chance(result: CalibrationResult, within: float, z_xy: float) -> bool:
    """Return whether fewer errors are in U, or larger over u, than in `OF_DRAWS` of right maps.

    Their errors are drawn from the correlations of the result's own map.
    """
    known_sites = np.isfinite(result.error_map.gx)
    covariance = covariance_of(result, "xy", known_sites)
    if covariance.ndim == 1:
        covariance = np.diag(covariance)
    u = np.sqrt(np.diag(covariance))
    correlation = covariance / np.maximum(np.outer(u, u), ROUNDING**2)
    variances, modes = np.linalg.eigh(correlation)
    part, count = OF_DRAWS
    normal = np.random.default_rng(0).normal(size=(count, len(variances)))
    errors_in_u = normal * np.sqrt(np.maximum(variances, 0.0)) @ modes.T
    k = float(norm.ppf((1 + COVERAGE) / 2))
    shares = np.mean(np.abs(errors_in_u) <= k, axis=1)
    sizes = np.sqrt(np.mean(errors_in_u**2, axis=1))
    return bool(
        within < np.quantile(shares, part) or z_xy > np.quantile(sizes, 1 - part)
    )


ROUNDING = 1e-13
"""Errors in m or rad that no arithmetic avoids: inside any uncertainty."""


def _covered(error: np.ndarray, u: np.ndarray, k: float) -> tuple[float, float]:
    """Return the part of the errors inside k u, and their rms in u; NaN where none is known."""
    known = np.isfinite(error)
    if not known.any():
        return float("nan"), float("nan")
    inside = np.abs(error) <= np.maximum(k * u, ROUNDING)
    return float(inside[known].mean()), rms(error / np.maximum(u, ROUNDING))


def grade_of(result: CalibrationResult) -> str:
    """Return the grade of a result."""
    return str(result.verdict.grade)


def advised(result: CalibrationResult, options: Options) -> tuple[str, Options] | None:
    """Return what the verdict advises and the options to do it with; None if nothing new."""
    remedies = [remedy for cause in result.verdict.causes for remedy in cause.remedies]
    for remedy in remedies:
        if remedy.kind == "model":
            terms = parse_terms([remedy.value], "advice")
            if terms != options.terms:
                return f"--model {remedy.value}", replace(options, terms=terms)
    if any(remedy.kind == "view" for remedy in remedies):
        return "measure again", options
    return None


@dataclass(frozen=True)
class Summary:
    """Medians, means and counts of runs; those that were refused count as not accepted."""

    runs: int
    grades: dict[str, int]
    wrong: int
    wrong_seeds: tuple[int, ...]
    error_m: float
    within: float
    u_within: float
    within_x: float
    within_y: float
    within_theta: float
    z_xy: float
    z_theta: float
    causes: tuple[tuple[str, int], ...]


def summarise(runs: list[Run], seeds: list[int]) -> Summary:
    """Return what came of the runs of a case; of wrong and accepted ones the seeds as well."""
    kept = [run for run in runs if run.grade != "refused"]
    causes = Counter(name for run in runs for name in run.causes[:1])
    wrong = tuple(seed for seed, run in zip(seeds, runs, strict=True) if run.wrong)
    within = _values(kept, "within")
    return Summary(
        len(runs),
        dict(Counter(run.grade for run in runs)),
        len(wrong),
        wrong,
        float(np.median(_values(kept, "error_m"))),
        float(within.mean()),
        float(within.std() / np.sqrt(len(within))),
        *(
            float(_values(kept, name).mean())
            for name in ("within_x", "within_y", "within_theta")
        ),
        rms(_values(kept, "z_xy")),
        rms(_values(kept, "z_theta")),
        tuple(causes.most_common(3)),
    )


def _values(runs: list[Run], name: str) -> np.ndarray:
    """Return a number of each run where it is known; NaN alone where it is known of none."""
    values = np.array([getattr(run, name) for run in runs])
    known = values[np.isfinite(values)]
    return known if len(known) else np.array([np.nan])


def rows(case: Case, courses: dict[int, Course]) -> Iterator[tuple[str, Summary]]:
    """Yield the lines of a case: by default, and where advice was followed, at its end."""
    seeds = list(courses)
    yield case.name, summarise([courses[seed].first for seed in seeds], seeds)
    followed = sum(bool(course.steps) for course in courses.values())
    if followed:
        yield (
            f"after the advice ({followed} of {len(seeds)} followed)",
            summarise([courses[seed].end for seed in seeds], seeds),
        )
