# SPDX-License-Identifier: Apache-2.0
"""A result in words: what estimation gave as data becomes sentence, reasons, causes, warnings."""

from dataclasses import replace

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.words.screening import warning
from selfcal_ros.reporting.words.verdict import worded_verdict


def worded(result: CalibrationResult) -> CalibrationResult:
    """Return a result with its words; one that has them stays as it is.

    Parameters
    ----------
    result : CalibrationResult
        As `selfcal_ros.estimation.api.calibrate` gives it, with its validation if there is one.
    """
    return replace(
        result, verdict=worded_verdict(result.verdict, result.noise), findings=(),
        warnings=(*result.warnings, *(warning(finding) for finding in result.findings)))
