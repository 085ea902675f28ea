# SPDX-License-Identifier: Apache-2.0
"""The plate that a calibration made known, and the map of the stage that it found with it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.maps import PITCH_TOLERANCE
from selfcal_ros.estimation.comparison.together import Together, together
from selfcal_ros.estimation.joint.solved import MICROSCOPE_PARTS
from selfcal_ros.estimation.lattice.placed import MapSpline
from selfcal_ros.estimation.options import ReferenceKind, ReferenceLength
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.pose import EDGE
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.units import MM_PER_M


@dataclass(frozen=True, eq=False)
class KnownPlate:
    """A calibrated plate.

    Attributes
    ----------
    result : CalibrationResult
        The calibration that made it known.
    together : Together
        What it knows of stage and plate together.
    where : str
        Its file, for messages.
    reference : dict or None
        Reference length of the calibration at the temperature of the plate now; None if that
        temperature or the length is not known: then no map has a scale.
    """

    result: CalibrationResult
    together: Together
    where: str
    reference: dict[str, Any] | None = None

    @property
    def field(self) -> np.ndarray:
        """Error of the plate now, complex (nx, ny), m; NaN where unknown.

        With the expansion since its calibration, where the temperatures of both are known.
        """
        plate, lattice = self.result.artifact_map, self.result.plate
        longer = 0.0
        if self.reference is not None and self.result.reference is not None:
            longer = self.reference["relative_error"] - self.result.reference["relative_error"]
        nominal = lattice.x_m + 1j * lattice.y_m
        return np.where(self.together.marks, plate.ax + 1j * plate.ay + longer * nominal,
                        complex(np.nan, np.nan))

    @property
    def variance_of_length(self) -> float:
        """Variance of the plate's length now beyond that at its calibration, 1 = (m/m)^2."""
        if self.reference is None or self.result.reference is None:
            return 0.0
        now, then = (each["u_relative"] for each in (self.reference, self.result.reference))
        return max(now**2 - then**2, 0.0)

    @property
    def variance_of_expansion(self) -> float:
        """Variance of the expansion since the calibration, by both temperatures, (m/m)^2."""
        if self.reference is None or self.result.reference is None:
            return 0.0
        now, then = (each["certified"] for each in (self.reference, self.result.reference))
        u_kelvin = np.hypot(now["u_temperature_k"], then["u_temperature_k"])
        warmer = now["temperature_c"] - then["temperature_c"]
        return float((now["expansion_per_k"] * u_kelvin)**2
                     + (warmer * now["u_expansion_per_k"])**2)

    def length_at(self, marks: np.ndarray) -> np.ndarray:
        """Return what a relative expansion of 1 adds to Ax, Ay of marks, and to the microscope.

        Of the marks in a bool array (nx, ny): (2 m + 4,), m.
        """
        lattice = self.result.plate
        return np.concatenate([lattice.x_m[marks], lattice.y_m[marks], np.zeros(4)])

    @property
    def of_offsets(self) -> np.ndarray | None:
        """Coefficients of the microscope that it found, (4,); None if it did not estimate them."""
        term = next((term for term in self.result.model.terms
                     if block_of(term.name).of_offsets), None)
        if term is None:
            return None
        found = {each.component: each.value for each in term.estimates}
        values = np.array([found.get(part, 0.0) for part in MICROSCOPE_PARTS])
        return values if np.isfinite(values).all() else None


def reference_now(result: CalibrationResult, where: str, at: str) -> dict[str, Any] | None:
    """Return the reference length of a calibration at the temperature of its plate now.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    where : str
        Its file, for messages.
    at : str
        As for `ReferenceLength.at_temperature`; empty: the temperature is not known, and None is
        returned.

    Raises
    ------
    InputError
        If the calibration has no certified length of its plate with its temperature, or another
        coefficient of expansion or temperature of the certificate.
    """
    if not at:
        return None
    reference = result.reference or {}
    certified = reference.get("certified")
    if not certified or not ReferenceKind(reference["kind"]).of_plate:
        raise InputError("--reference-at", f"{where} has no reference length of its plate with the "
                         "temperature of the calibration", "leave it out: the map then has no "
                         "scale; or calibrate with --reference and --reference-at")
    length = ReferenceLength(
        reference["kind"], certified["relative_error"], certified["u_relative"],
        reference.get("certificate") or "", marks=reference.get("marks")).at_temperature(at)
    assert length.certified is not None
    for name in ("expansion_per_k", "u_expansion_per_k", "certified_at_c"):
        if not np.isclose(length.certified[name], certified[name], rtol=1e-9, atol=0.0):
            raise InputError("--reference-at", f"{name} is {length.certified[name]:g}, and "
                             f"{certified[name]:g} in {where}", "change the temperature alone")
    return {**reference, "relative_error": length.relative_error,
            "u_relative": length.u_relative, "certified": length.certified}


def known_plate(result: CalibrationResult, where: str, at: str = "") -> KnownPlate:
    """Return the plate of a calibration.

    Parameters
    ----------
    result : CalibrationResult
        The calibration.
    where : str
        Its file, for messages.
    at : str
        Temperature of the plate now, as for `reference_now`.

    Raises
    ------
    InputError
        If it is not qualified, or does not have what the plate's covariance needs; or as
        `reference_now`.
    """
    if result.recheck is not None:
        raise InputError(where, "is itself a recheck, which does not calibrate a plate",
                         f"name the calibration that it used, {result.recheck.of}")
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(where, "is not qualified, so its plate is not known",
                         "calibrate again")
    covariances = together(result)
    if covariances is None:
        raise InputError(where, "does not contain the covariance of its plate",
                         "calibrate with the method joint and with uncertainty; a plate may have "
                         "31 x 31 marks at most")
    return KnownPlate(result, covariances, where, reference_now(result, where, at))


def on_plate(measurements: Measurements, plate: KnownPlate) -> Measurements:
    """Return the readings with the nodes of the earlier map, if they do not ask for others.

    Raises
    ------
    InputError
        If they are of another plate.
    """
    mine, other = measurements.artifact, plate.result.plate
    if (mine.shape, mine.angular_count, mine.marks) != (
            other.shape, other.angular_count, other.marks) or abs(
            mine.grid_pitch_m / other.grid_pitch_m - 1) > PITCH_TOLERANCE:
        raise InputError(plate.where, f"its plate has {_described(other)}, not {_described(mine)}",
                         "name the calibration of that plate")
    if mine.map_grid is None and other.map_grid is not None:
        mine = replace(mine, map_grid=other.map_grid)
    if not mine.harmonics:
        mine = replace(mine, harmonics=other.harmonics)
    return replace(measurements, artifact=mine)


def _described(artifact: Artifact) -> str:
    nx, ny = artifact.shape
    if artifact.marks:
        return f"a list of {nx} marks and {artifact.angular_count or 'no'} lines"
    return (f"{nx} x {ny} marks {artifact.grid_pitch_m * MM_PER_M:g} mm apart and "
            f"{artifact.angular_count or 'no'} lines")


def rows_at(places: np.ndarray, plate: KnownPlate) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows from known nodes of the old map to places, complex (P,), m.

    Rows (P, s), and the places where it is known, bool (P,).
    """
    known, old, grid = plate.together.sites, plate.result.artifact, plate.result.plate.map_grid
    how = Interpolation.BICUBIC if grid is None else grid.interpolation
    spline, n = MapSpline.of(old, how if known.all() else Interpolation.BILINEAR), known.size
    unit = spline.coefficients(np.eye(n).reshape(n, *known.shape)).reshape(n, n).T
    rows = spline.rows(places) @ unit
    inside = np.abs(rows[:, ~known.ravel()]).sum(axis=1) < EDGE
    reach = (np.array(old.half) + EDGE) * old.grid_pitch_m
    inside &= (np.abs(places.real) <= reach[0]) & (np.abs(places.imag) <= reach[1])
    return rows[:, known.ravel()], inside
