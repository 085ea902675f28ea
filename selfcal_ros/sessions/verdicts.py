# SPDX-License-Identifier: Apache-2.0
"""Whether a result may be used."""

from selfcal_ros.model.result import CalibrationResult


def is_qualified(result: CalibrationResult) -> bool:
    """Return whether the stage error is identified and the readings do not contradict the model."""
    return result.observability.identifiable and result.verdict.qualified
