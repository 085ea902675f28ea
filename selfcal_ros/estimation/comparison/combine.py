# SPDX-License-Identifier: Apache-2.0
"""Several calibrations of one stage combined to one map, with the part between runs in its U."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal_ros import __version__
from selfcal_ros.blocks import blocks
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.between import RUNS_LEVEL, Deviation, Mean, Run, mean_of
from selfcal_ros.estimation.comparison.covariance import (
    kept_covariance,
    theta_covariance,
    xy_covariance,
)
from selfcal_ros.estimation.comparison.maps import require_same_lattice
from selfcal_ros.estimation.comparison.runs import (
    SAME,
    Part,
    exposures,
    require_own_readings,
    shared_reference,
)
from selfcal_ros.estimation.joint.problem import coverage_factor
from selfcal_ros.estimation.joint.solved import KEY, factors_of
from selfcal_ros.estimation.lattice.connectivity import first_order
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.verdict.uncertainty import (
    INTERPOLATION,
    TOLD,
    budget_lines,
    remaining_part,
)
from selfcal_ros.model.error_map import ErrorMap, ThetaDatum, datum_modes, rms
from selfcal_ros.model.result import (
    COMBINED,
    ArtifactMap,
    CalibrationResult,
    Noise,
    Observability,
)
from selfcal_ros.model.verdict import (
    BudgetLine,
    Enlargement,
    Finding,
    Grade,
    ModelResult,
    Provenance,
    Verdict,
)

BETWEEN = "between_runs"
"""Name of the part between runs among the causes of an enlarged U."""
DEGREE = 3
"""Degree up to which each polynomial of a map may vary between runs by its own."""
HARMONICS = 3
"""The same of the angular map, waves per turn."""


@dataclass(frozen=True, eq=False)
class Combination:
    """The mean map as a result, with the intermediate findings.

    `xy` and `theta` have the mean and the deviations of the coordinates of the sites `known`
    (Gx, then Gy) and of the angular lines; `theta` is None without angular maps in all runs.
    """

    result: CalibrationResult
    known: np.ndarray
    xy: Mean
    theta: Mean | None


@one_thread()
def combine(parts: Sequence[Part], *, keep_scale: bool = False) -> Combination:
    """Return the weighted mean of several maps of one stage.

    Differences of datum are removed first. The weight of a run is the inverse of its mean variance
    plus that between runs. What all runs of a machine share (the microscope as declared, and with
    `keep_scale` the reference length) does not average out.

    Parameters
    ----------
    parts : sequence of Part
        Two or more; at least one is a calibration, which gives the lattice.
    keep_scale : bool
        Keep the magnification: every calibration has a reference length.

    Raises
    ------
    InputError
        If the maps cannot be combined.
    """
    first = _checked(parts, keep_scale=keep_scale)
    known = np.logical_and.reduce([
        part.error_map.valid & np.isfinite(part.error_map.u_gx + part.error_map.u_gy)
        for part in parts])
    if known.sum() < 3:
        raise InputError(parts[-1].name, f"{int(known.sum())} sites are known with their "
                         "uncertainty in all maps", "combine maps that overlap")
    artifact = first.artifact
    modes = datum_modes(artifact, scale=not keep_scale)
    require_own_readings(parts, known, modes)
    modes = modes[:, :, known]
    xy = mean_of([_xy_run(part, known, keep_scale=keep_scale) for part in parts],
                 modes.reshape(len(modes), -1).T, _polynomials(artifact.x_m, artifact.y_m, known))
    lines = np.logical_and.reduce([np.isfinite(part.error_map.g_theta + part.error_map.u_g_theta)
                                   for part in parts])
    theta = None
    if lines.sum() > 1:
        theta = mean_of([_theta_run(part, lines) for part in parts],
                        np.ones((int(lines.sum()), 1)), _waves(lines))
    result = _result(parts, first, (known, xy), (lines, theta))
    if not keep_scale:
        result = replace(result, reference=None)
    return Combination(result, known, xy, theta)


def _checked(parts: Sequence[Part], *, keep_scale: bool) -> CalibrationResult:
    """Return the first calibration; InputError if the maps cannot be combined."""
    own = [part for part in parts if part.result is not None]
    if len(parts) < 2 or not own:
        raise InputError(parts[0].name if parts else "RESULT.json", "a single map, or no "
                         "RESULT.json among them", "give two or more, one of them a RESULT.json")
    for part in own:
        require_same_lattice(own[0].error_map.artifact, part.error_map.artifact,
                             (own[0].name, part.name))
        result = part.result
        if result is None or not result.verdict.qualified:
            raise InputError(part.name, "its calibration is not qualified", "leave it out")
        if keep_scale and result.reference is None:
            raise InputError("--keep-scale", f"{part.name} has no reference length, so its "
                             "magnification is unknown", "omit it, or solve with --reference")
    for index, part in enumerate(parts):
        _require_single_run(part, parts[:index])
    found = own[0].result
    assert found is not None
    return found


def _require_single_run(part: Part, others: Sequence[Part]) -> None:
    """Refuse a map that is not of one recording alone, or of that of another map."""
    result = part.result
    if result is None:
        return
    if result.method == COMBINED:
        raise InputError(part.name, "a mean of several runs", "name these runs themselves")
    for other in others:
        if other.result is None:
            continue
        if _same_recording(result, other.result):
            raise InputError(part.name, f"of the same recording as {other.name}",
                             "leave one of them out")
        plate = _readings_of_plate(result)
        if plate and plate == _readings_of_plate(other.result):
            raise InputError(part.name, f"of the same plate errors as {other.name}: both rest on "
                             "one calibration", "leave one of them out")


def _readings_of_plate(result: CalibrationResult) -> str:
    """Return the SHA-256 of the readings that made the plate of a map known; empty if unknown."""
    recheck = result.recheck
    readings = result.input if recheck is None else recheck.calibration.readings
    return readings.get("sha256", "")


def _same_recording(one: CalibrationResult, other: CalibrationResult) -> bool:
    """Whether two results are of one bag, or of one run at the same time with the same noise."""
    digest = one.input.get("sha256")
    if digest and digest == other.input.get("sha256"):
        return True
    run, also = ((result.run_id, result.provenance.extra.get("first_exposure"),
                  result.provenance.extra.get("last_exposure")) for result in (one, other))
    return all(run) and run == also and bool(np.isclose(
        one.noise.sigma_xy_repeats, other.noise.sigma_xy_repeats, rtol=SAME, atol=0.0,
        equal_nan=True))


def _xy_run(part: Part, known: np.ndarray, *, keep_scale: bool) -> Run:
    emap, result = part.error_map, part.result
    values = np.concatenate([emap.gx[known], emap.gy[known]])
    u = np.concatenate([emap.u_gx[known], emap.u_gy[known]])
    if result is None:
        return Run(values, u**2, np.zeros(len(u)), False, np.inf)
    covariance = xy_covariance(result, known)
    factors = _common(result, known, keep_scale=keep_scale)
    common = factors.T @ factors if covariance.ndim == 2 else (factors**2).sum(axis=0)
    return Run(values, covariance - common, common, True, result.noise.dof_of("xy"))


def _common(result: CalibrationResult, known: np.ndarray, *, keep_scale: bool) -> np.ndarray:
    """Return factors L (r, 2n) of the covariance L' L of what the runs of a machine share, m.

    Terms of the microscope that are known from elsewhere, and the reference length.
    """
    terms = {term.name: term for term in result.model.terms}
    names = [name for name, block in blocks().items() if block.shared
             if name in terms and remaining_part(terms[name]) >= TOLD]
    of_terms = result.extra[KEY]["terms"] if KEY in result.extra else []
    factors = factors_of(result)[np.isin(of_terms, names)][:, :, known]
    factors = factors.reshape(len(factors), 2 * int(known.sum()))
    factors = factors * np.nan_to_num(result.noise.sigma_xy)
    if keep_scale and result.reference is not None:
        at = result.artifact
        place = np.concatenate([at.x_m[known], at.y_m[known]]) * result.reference["u_relative"]
        factors = np.concatenate([factors, place[None]])
    return factors


def _theta_run(part: Part, lines: np.ndarray) -> Run:
    emap, result = part.error_map, part.result
    values, zero = emap.g_theta[lines], np.zeros(int(lines.sum()))
    if result is None:
        return Run(values, emap.u_g_theta[lines] ** 2, zero, False, np.inf)
    return Run(values, theta_covariance(result, lines), zero, True, result.noise.dof_of("theta"))


def _polynomials(x: np.ndarray, y: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return polynomials of position up to `DEGREE` as columns over Gx, then Gy; the shear first.

    The first two are non-orthogonality O and scale difference R (Hu eq. 6).
    """
    size = max(np.abs(x).max(), np.abs(y).max())
    x, y = x[known] / size, y[known] / size
    zero = np.zeros(len(x))
    columns = [(y, x), (x, -y)]
    for degree in range(2, DEGREE + 1):
        for power in range(degree + 1):
            values = x ** (degree - power) * y**power
            columns += [(values, zero), (zero, values)]
    return np.array([np.concatenate(column) for column in columns]).T


def _waves(lines: np.ndarray) -> np.ndarray:
    angle = 2 * np.pi * np.flatnonzero(lines) / len(lines)
    return np.array([wave(k * angle) for k in range(1, HARMONICS + 1)
                     for wave in (np.cos, np.sin)]).T


def _result(parts: Sequence[Part], first: CalibrationResult, xy: tuple[np.ndarray, Mean],
            theta: tuple[np.ndarray, Mean | None]) -> CalibrationResult:
    (known, mean), (lines, angular), plate = xy, theta, first.plate
    runs = [part.result for part in parts]
    n = int(known.sum())
    gx, gy = (_filled(part, known) for part in (mean.values[:n], mean.values[n:]))
    u_gx, u_gy = (_filled(part, known) for part in (mean.u[:n], mean.u[n:]))
    nothing = np.zeros(0)
    g_theta, u_theta = (_filled(nothing if angular is None else part, lines if angular else
                                np.zeros_like(lines)) for part in (
        (nothing, nothing) if angular is None else (angular.values, angular.u)))
    o, r = first_order(first.artifact, gx + 1j * gy)
    emap = ErrorMap(first.artifact, gx, gy, u_gx, u_gy, g_theta, u_theta, o, r,
                    ThetaDatum.ZERO_MEAN)
    unknown = np.full(plate.shape, np.nan)
    dof = [np.nan if found is None else found.dof for found in (mean, angular)]
    k = [2.0 if found is None else coverage_factor(found.dof) for found in (mean, angular)]
    found = CalibrationResult(
        "+".join(dict.fromkeys(p.result.plan_id for p in parts if p.result)), emap,
        ArtifactMap(unknown, unknown, np.full(plate.angular_count, np.nan)), (),
        Observability(2 * n, 2 * n, 0, True),
        Noise(np.nan, np.nan, dof_xy=dof[0], dof_theta=dof[1], k_xy=k[0], k_theta=k[1],
              dof_map_xy=dof[0], dof_map_theta=dof[1]),
        input={"file": ", ".join(part.name for part in parts)}, method=COMBINED,
        sense=first.sense, extra=_extra(parts, xy, theta), verdict=_verdict(parts, mean, angular),
        model=ModelResult(first.model.misalignment),
        reference=shared_reference(runs, mean.weights),
        provenance=Provenance(version=__version__, extra=exposures(runs)),
        findings=(Finding("not_in_all", details={"sites": int((~known).sum())}),)
        if not known.all() else (),
        placed_plate=first.placed_plate)
    return replace(found, budget=_budget(found, mean, angular))


def _filled(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    out = np.full(known.shape, np.nan)
    out[known] = values
    return out


def _extra(parts: Sequence[Part], xy: tuple[np.ndarray, Mean],
           theta: tuple[np.ndarray, Mean | None]) -> dict[str, Any]:
    """Return the runs with their deviations, and the covariance of the mean."""
    mean, angular = xy[1], theta[1]
    facts: dict[str, Any] = {"u_between_m": mean.u_between, "p_between": mean.p_between}
    if angular is not None:
        facts |= {"u_between_rad": angular.u_between, "p_between_theta": angular.p_between}
    limit = RUNS_LEVEL / len(parts)
    facts["runs"] = [{
        "file": part.name, "run_id": part.result.run_id if part.result else "",
        "sha256": part.result.input.get("sha256", "") if part.result else "",
        "weight": float(mean.weights[index]), **_of_run(mean.deviations[index], "", limit),
        **({} if angular is None else _of_run(angular.deviations[index], "_theta", limit))}
        for index, part in enumerate(parts)]
    covers = {}
    for name, found in (("xy", mean), ("theta", angular)):
        whole = found is not None and (name == "theta" or all(
            part.result is not None for part in parts))
        if found is not None and whole and found.covariance.ndim == 2 and all(
                test.test is None or test.test.correlated for test in found.deviations):
            covers[name] = found.covariance
    return {COMBINED: facts, **kept_covariance(covers)}


def _of_run(found: Deviation, kind: str, limit: float) -> dict[str, Any]:
    test = found.test
    return {f"e_n_rms{kind}": rms(found.e_n), f"e_n_largest{kind}": float(abs(found.e_n).max()),
            f"beyond{kind}": float((abs(found.e_n) > 1).mean()),
            f"p{kind}": np.nan if test is None else min(1.0, 2 * min(test.p, test.p_z)),
            f"agrees{kind}": None if test is None else not test.significant,
            f"stands_out{kind}": bool(found.p_scatter < limit)}


def _verdict(parts: Sequence[Part], mean: Mean, angular: Mean | None) -> Verdict:
    """Return the verdict: enlarged if a run's U was, or if the runs differ by more than their U."""
    enlarged: dict[str, Enlargement] = {}
    failed = []
    for found, kind, unit in ((mean, "xy", "m"), (angular, "theta", "rad")):
        if found is not None and found.p_between < RUNS_LEVEL:
            u = np.sqrt(found.between)
            name = BETWEEN if unit == "m" else f"{BETWEEN}_theta"
            enlarged[name] = Enlargement(name, rms(u), float(u.max()), unit)
            failed.append(Finding("between_runs", found.u_between, unit=unit, p=found.p_between,
                                  details={"runs": len(parts), "quantity": kind}))
    for part in parts:
        for item in part.result.verdict.enlarged_by if part.result else ():
            before = enlarged.get(item.name)
            if before is None or before.u_rms < item.u_rms:
                enlarged[item.name] = item
    of_runs = [part.name for part in parts
               if part.result and part.result.verdict.grade is Grade.ENLARGED]
    if of_runs:
        failed.append(Finding("enlarged_runs", details={"runs": of_runs}))
    return Verdict(Grade.ENLARGED if failed else Grade.GOOD, tuple(failed),
                   enlarged_by=tuple(enlarged.values()))


def _budget(result: CalibrationResult, mean: Mean, angular: Mean | None) -> tuple[BudgetLine, ...]:
    lines: list[BudgetLine] = []
    between = [line for line in budget_lines(result) if line.component == INTERPOLATION]
    for found, kind, unit in ((mean, "xy", "m"), (angular, "theta", "rad")):
        if found is None:
            continue
        runs = len(found.weights)
        for component, variance, size, letter, dof in (
                ("uncertainty of the runs", found.within, rms(np.sqrt(found.within)), "A",
                 found.dof),
                ("shared by all runs", found.common, rms(np.sqrt(found.common)), "B", np.inf),
                ("between runs", found.between, found.u_between, "A", found.dof)):
            u = np.sqrt(variance)
            lines.append(BudgetLine(kind, component, letter, 0.0, size, unit, rms(u),
                                    float(u.max()), dof, "readings", {"runs": runs}))
        lines += [line for line in between if line.quantity == kind]
    return tuple(lines)
