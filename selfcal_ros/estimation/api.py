# SPDX-License-Identifier: Apache-2.0
"""The public call of the estimators: readings in, calibration out."""

from selfcal_ros.estimation.checks.placing import check_placing
from selfcal_ros.estimation.checks.wiring import check_wiring
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.law.solve import solve_law
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.judge import judged
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult


def calibrate(measurements: Measurements, options: Options | None = None) -> CalibrationResult:
    """Estimate stage error, plate error and misalignments from readings.

    Parameters
    ----------
    measurements : Measurements
        All readings, in any order within a view.
    options : Options, optional
        Method, datum, reference length, model.

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
    check_wiring(measurements)
    options = options or Options()
    solve = solve_law if options.method == "law" else solve_joint
    result = judged(solve(measurements, options), measurements, options)
    if not result.verdict.qualified:
        check_placing(measurements)
    return result
