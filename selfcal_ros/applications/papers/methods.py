# SPDX-License-Identifier: Apache-2.0
"""The method that a user chooses: all readings in one least squares, or Hu's published law."""

from dataclasses import replace

from selfcal_ros.applications.papers.law import JOINTLY, solve_law
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate, with_placing
from selfcal_ros.estimation.checks.wiring import check_wiring
from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.verdict.judge import judged
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult

LAW = "law"
"""Name of Hu's law among the methods."""


def calibrate_by(
    method: str, measurements: Measurements, options: Options
) -> CalibrationResult:
    """Calibrate by the method of this name; ``joint`` is `selfcal_ros.estimation.api.calibrate`."""
    return (calibrate_by_law if method == LAW else calibrate)(measurements, options)


@one_thread()
def calibrate_by_law(measurements: Measurements, options: Options) -> CalibrationResult:
    """Calibrate by Hu's law from exactly Hu's four views, all complete.

    Parameters
    ----------
    measurements : Measurements
        Readings; repeats are averaged without weights, as published.
    options : Options
        Datum, uncertainty, and what the verdict needs: it comes from a joint solution of the same
        readings.

    Returns
    -------
    CalibrationResult
        Its `method` is ``law``. It has no correlations of its sites.

    Raises
    ------
    InputError
        If a view is missing, surplus or incomplete, or an option does not apply to the law; if the
        offsets do not follow the stage, or the plate is not placed as planned.
    """
    require_plain(measurements, options)
    check_wiring(measurements)
    options = replace(options, misalignment_model="linear")
    solved = judged(solve_law(measurements, options), measurements, options)
    return with_placing(solved.result, measurements)


def require_plain(measurements: Measurements, options: Options) -> None:
    """Raise InputError if readings or options have what the law cannot use."""
    for name, is_given, why in (
        (
            "robust",
            options.robust,
            "Hu's law needs every reading and cannot leave any out",
        ),
        ("method law", options.plate, "Hu's law cannot use a known plate"),
        (
            "method law",
            measurements.has_images,  # their common noise is not in its U
            "Hu's law cannot use images of several marks",
        ),
        ("method law", options.reference, "Hu's law has no reference length"),
        ("method law", options.terms, "Hu's law has no terms besides stage and plate"),
    ):
        if is_given:
            raise InputError(name, why, JOINTLY)
