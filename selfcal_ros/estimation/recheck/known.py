# SPDX-License-Identifier: Apache-2.0
"""The plate that an earlier calibration has made known, with the covariance of all it gave."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import PITCH_TOLERANCE
from selfcal_ros.estimation.comparison.together import Together, together
from selfcal_ros.estimation.joint.solved import MICROSCOPE_PARTS
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.terms import TermName
from selfcal_ros.units import MM_PER_M


@dataclass(frozen=True, eq=False)
class KnownPlate:
    """A calibrated plate.

    Attributes
    ----------
    result : CalibrationResult
        The calibration that made it known.
    kept : Together
        What it knows of stage and plate together.
    where : str
        Its file, for messages.
    """

    result: CalibrationResult
    kept: Together
    where: str

    @property
    def field(self) -> np.ndarray:
        """Error of the plate, complex (nx, ny), m; NaN where unknown."""
        plate = self.result.artifact_map
        return np.where(self.kept.marks, plate.ax + 1j * plate.ay, complex(np.nan, np.nan))

    @property
    def microscope(self) -> np.ndarray | None:
        """Coefficients of the microscope that it found, (4,); None if it did not seek them."""
        term = next((term for term in self.result.model.terms
                     if term.name == TermName.MICROSCOPE), None)
        if term is None:
            return None
        found = {each.component: each.value for each in term.estimates}
        values = np.array([found.get(part, 0.0) for part in MICROSCOPE_PARTS])
        return values if np.isfinite(values).all() else None


def known_plate(result: CalibrationResult, where: str) -> KnownPlate:
    """Return the plate of a calibration.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    where : str
        Its file, for messages.

    Raises
    ------
    InputError
        If it is not qualified, or does not have what the plate's covariance needs.
    """
    if "recheck" in result.extra:
        raise InputError(where, "a recheck itself: it has no plate of its own",
                         f"name the calibration it was made with, {result.extra['recheck']['of']}")
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(where, "its readings contradict the model: its plate is not known",
                         "calibrate anew")
    kept = together(result)
    if kept is None:
        raise InputError(where, "the covariance of its plate is not kept",
                         "calibrate jointly, with the uncertainty, a plate of at most 31 x 31 "
                         "marks; results of version 0.1 do not have it")
    return KnownPlate(result, kept, where)


def on_plate(measurements: Measurements, plate: KnownPlate) -> Measurements:
    """Return the readings with the nodes of the earlier map, if they do not ask for others.

    Raises
    ------
    InputError
        If they are of another plate.
    """
    mine, other = measurements.artifact, plate.result.plate
    if (mine.shape, mine.angular_count) != (other.shape, other.angular_count) or abs(
            mine.grid_pitch_m / other.grid_pitch_m - 1) > PITCH_TOLERANCE:
        raise InputError(plate.where, f"its plate has {_said(other)}, the one that was read "
                         f"{_said(mine)}", "name the result of this plate")
    if mine.map_grid is None and other.map_grid is not None:
        mine = replace(mine, map_grid=other.map_grid)
    return replace(measurements, artifact=mine)


def _said(artifact: Artifact) -> str:
    nx, ny = artifact.shape
    return (f"{nx} x {ny} marks {artifact.grid_pitch_m * MM_PER_M:g} mm apart and "
            f"{artifact.angular_count} lines")
