# SPDX-License-Identifier: Apache-2.0
"""The public call of the estimators: readings in, calibration out."""

from dataclasses import replace
from functools import cache

from selfcal_ros.blocks import traits_of
from selfcal_ros.errors import InputError, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.checks.placing import check_placing, moved_findings
from selfcal_ros.estimation.checks.wiring import (
    AS_IS,
    OTHER_LINES,
    PAIRS,
    Turned,
    check_wiring,
    shows_offsets,
    sign_is_shown,
    turned_error,
    turned_readings,
)
from selfcal_ros.estimation.comparison.verification import (
    corrected,
    require_correctable,
)
from selfcal_ros.estimation.joint.camera import (
    FittedCamera,
    camera_of,
    few_read,
    known_camera,
    straightened,
    yaw_of,
)
from selfcal_ros.estimation.joint.solve import Solved, fit_joint, solve_joint
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.plate import KnownPlate, known_plate
from selfcal_ros.estimation.recheck.solve import recheck
from selfcal_ros.estimation.verdict.judge import judged
from selfcal_ros.model.findings import (
    Finding,
    LinesSignNotShown,
    NoiseContradicted,
    NoOffsets,
    ScaleOfOffsets,
    SignNotShown,
    SignShownByLines,
    SlipFound,
)
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import microscope_term
from selfcal_ros.model.verdict import Grade

CAMERA_STEPS = 3
"""Number of fits for the camera's distortion, each with the readings corrected by the last."""


@one_thread()
def calibrate(
    measurements: Measurements, options: Options | None = None
) -> CalibrationResult:
    """Estimate stage error, plate error and misalignments from readings.

    Parameters
    ----------
    measurements : Measurements
        All readings, in any order within a view.
    options : Options, optional
        Datum, reference length, model, known plate.

    Returns
    -------
    CalibrationResult
        Bit-identical for the same set of readings.

    Raises
    ------
    NoDataError
        If no grid mark was read.
    NotIdentifiableError
        If the marks that were read do not identify the stage.
    InputError
        If readings contradict the plan, an option does not fit them, the offsets do not follow the
        stage (`WiringError`), or the plate is not placed as planned (`PlacingError`).
    """
    options = options or Options()
    if measurements.verify:
        raise InputError(
            f"plan '{measurements.plan_id}'",
            f"was measured with the correction by {measurements.verify} on",
            f"selfcal verify {measurements.verify} BAG",
        )
    if options.robust:
        return robust_calibrate(measurements, options)
    check_wiring(measurements)
    if options.plate is not None:
        plate = known_plate(options.plate, options.plate_from, options.plate_at)
        return recheck(_as_calibrated(measurements, plate), options, plate)
    camera, measurements = _camera(measurements, options)
    # the microscope that images show, in place of the assumed one
    if camera is not None:
        (scale, turn), others_u = camera.u_coefficients[1:3]
        microscope = microscope_term(float(scale), float(turn), float(others_u.max()))
        options = replace(
            options,
            assumed=tuple(
                microscope if term.block.of_microscope else term
                for term in options.assumed
            ),
        )
    solved = solve_joint(measurements, options)
    converged = solved.converged
    if not converged:  # first: with a wrong wiring the search for causes takes seconds
        _check_turned(measurements, options, contradicted=True)
    solved = judged(solved, measurements, options)
    result = solved.result
    if converged and not _agree(result):
        _check_turned(measurements, options, contradicted=not _fits(result))
    result = with_placing(result, measurements)
    if not measurements.has_images:
        return result
    return replace(
        result,
        findings=(*result.findings, *few_read(measurements, camera)),
        camera=None if camera is None else camera.as_result,
        stage_yaw=yaw_of(solved.joint, measurements.sense),
    )


def with_placing(
    result: CalibrationResult, measurements: Measurements
) -> CalibrationResult:
    """Return the result, and in it whether the plate may not have been moved between views.

    Raises
    ------
    PlacingError
        If it was not moved, or its pose is why the result is not good.
    """
    findings = (*result.findings, *moved_findings(measurements))
    if not (
        result.verdict.qualified and any(view.dof_xy for view in measurements.views)
    ):
        # without repeats residuals are the noise: no contradiction
        check_placing(measurements)
    return replace(result, findings=findings)


def calibrate_corrected(
    measurements: Measurements, options: Options
) -> CalibrationResult:
    """Return the map of a stage while its correction is on: by itself, or by the known plate.

    Parameters
    ----------
    measurements, options
        As `calibrate` takes them; the known plate is that of the map that is corrected.

    Raises
    ------
    InputError
        If that map is not qualified; else as `calibrate`.
    """
    before = options.plate
    if before is None:
        raise InputError(
            f"plan '{measurements.plan_id}'",
            "no map is named whose correction is on",
            "write verify: RESULT.json",
        )
    require_correctable(before, options.plate_from)
    readings = replace(measurements, verify="")
    if not measurements.artifact_from:
        try:
            return calibrate(
                readings, replace(options, plate=None, plate_from="", plate_at="")
            )
        except NotIdentifiableError:
            pass
    return calibrate(readings, replace(options, plate=corrected(before)))


def _agree(result: CalibrationResult, *, as_is: bool = True) -> bool:
    """Return whether the readings agree, whatever the sign of the offsets.

    `as_is`: whether they are those that were given, not wired otherwise to see if that fits.
    """
    verdict = result.verdict
    of_repeats = {SignNotShown, NoOffsets, ScaleOfOffsets, LinesSignNotShown}
    failed = _contradictions(result, as_is=as_is)
    if failed == {SignShownByLines}:
        return _fits(result, as_is=as_is)
    failed -= {SignShownByLines}
    return verdict.qualified or (bool(failed) and failed <= of_repeats)


def _fits(result: CalibrationResult, *, as_is: bool = True) -> bool:
    """Return whether nothing contradicts the wiring: no test failed, and lines turn as marks do.

    That lines alone show the sign contradicts nothing.

    An effect beyond U leaves a result unqualified, and contradicts no wiring; one that is not
    plausible does, such as a microscope whose scale of -1 undoes it.
    """
    return _contradictions(result, as_is=as_is) <= {SignShownByLines} and not any(
        traits_of(cause.name).between
        or abs(cause.size) > traits_of(cause.name).plausible
        for cause in result.verdict.causes
    )


def _contradictions(result: CalibrationResult, *, as_is: bool) -> set[type[Finding]]:
    """Return the tests that failed.

    Residuals below the stated noise do not contradict the wiring as it is: the noise may be
    declared too large. They do not speak for another one either.
    """
    return {
        type(finding)
        for finding in result.verdict.failed
        if not (
            as_is
            and isinstance(finding, NoiseContradicted)
            and finding.size < finding.stated
        )
    }


def _check_turned(
    measurements: Measurements, options: Options, *, contradicted: bool
) -> None:
    """Raise WiringError if the readings agree with another wiring of the offsets.

    `contradicted`: whether the readings contradict the wiring as it is.
    """
    if not shows_offsets(measurements):
        return

    @cache
    def solution(wiring: Turned) -> tuple[Solved, Measurements] | None:
        turned = turned_readings(measurements, wiring)
        try:
            return solve_joint(turned, options, whole_only=True), turned
        except NotSettledError:
            return None

    def agree(wiring: Turned, options: Options) -> bool:
        if (turned_solution := solution(wiring)) is None:
            return False
        result = judged(*turned_solution, options, advise=False).result
        as_is = wiring == AS_IS
        return _agree(result, as_is=as_is) or (
            contradicted and options.finite_rotations and _fits(result, as_is=as_is)
        )

    # a linear model mistakes rotations for a wrong wiring
    if not options.finite_rotations:
        options = replace(options, misalignment_model="rigid")
        if agree(AS_IS, options):
            return
    plain = replace(options, causes=False)
    sign_known = sign_is_shown(measurements)  # repeats beside the marks
    fitting = (
        []
        if sign_known
        else [pair for pair in PAIRS if any(agree(sign, plain) for sign in pair)]
    )
    candidates = fitting[0] if len(fitting) == 1 else () if fitting else (OTHER_LINES,)
    agreeing = [wiring for wiring in candidates if agree(wiring, options)]
    if agreeing:
        raise turned_error(measurements, agreeing)


def robust_calibrate(
    measurements: Measurements, options: Options | None = None
) -> CalibrationResult:
    """Calibrate without the readings that contradict the others.

    Parameters
    ----------
    measurements : Measurements
        All readings.
    options : Options, optional
        As for `calibrate`.

    Returns
    -------
    CalibrationResult
        `findings` has what was found, ``parts.outliers`` lists the readings removed,
        ``parts.slips`` and ``parts.noisy_views`` the bad views; `rejected` counts the
        removed detections under ``outlier_among_views``. A fault that could not be corrected
        disqualifies the result.

    Raises
    ------
    InputError
        For a known plate.
    NotIdentifiableError
        As `calibrate`.
    """
    from selfcal_ros.estimation.quality.outliers import LEFT, clean  # rarely wanted

    options = replace(options or Options(), robust=True)
    check_wiring(measurements)
    cleaned = clean(measurements, options)
    result = calibrate(cleaned.measurements, replace(options, robust=False))
    spoiling = tuple(
        finding
        for finding in cleaned.findings
        if type(finding) in LEFT or (isinstance(finding, SlipFound) and finding.spoils)
    )
    verdict = replace(
        result.verdict,
        causes=tuple(
            replace(cause, details=replace(cause.details, robust=True))
            for cause in result.verdict.causes
        ),
    )
    if spoiling:
        verdict = replace(
            verdict, grade=Grade.NOT_QUALIFIED, failed=(*verdict.failed, *spoiling)
        )
    return replace(
        result,
        findings=(*result.findings, *cleaned.findings),
        verdict=verdict,
        parts=cleaned.with_tables(result.parts),
    )


def _as_calibrated(measurements: Measurements, plate: KnownPlate) -> Measurements:
    """Return readings of a known plate corrected by the camera of its calibration."""
    if not measurements.has_images:
        return measurements
    if plate.result.kept.images is None:
        raise InputError(
            plate.where,
            "its noise is not separated into that of images and that of marks, but "
            "the readings have images of several marks",
            "recheck with one mark an image, or calibrate with such images",
        )
    camera = known_camera(plate.result)
    return measurements if camera is None else straightened(measurements, camera)


def _camera(
    measurements: Measurements, options: Options
) -> tuple[FittedCamera | None, Measurements]:
    """Return the camera shown by images of several marks, and the readings corrected for it."""
    straight = measurements
    camera = None
    if not measurements.has_images:
        return None, measurements
    plain = replace(
        options,
        terms=(),
        assumed=tuple(
            term for term in options.model_terms(visits=True) if term.block.of_images
        ),
    )
    for _ in range(CAMERA_STEPS):
        camera = camera_of(measurements, fit_joint(straight, plain))
        if camera is None:
            return None, measurements
        straight = straightened(measurements, camera)
    return camera, straight
