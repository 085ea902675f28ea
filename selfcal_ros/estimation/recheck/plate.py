# SPDX-License-Identifier: Apache-2.0
"""The plate that a calibration made known, and the map of the stage that it found with it.

What was read must be that plate, placed as planned (method eq. 13.5). With the stage as it was, the
readings of a view less both known maps leave motion, strain and noise. A wrong pose or another
plate leaves differences of marks instead: unlike a change of the stage, they have nothing in common
from one mark to the next.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.blocks import block_of
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.placing import (
    BETTER,
    CLEARLY,
    CONTRADICTED,
    LEAST_READINGS,
    ON_MARKS,
    Misplaced,
    motions,
    on_marks,
    said,
)
from selfcal_ros.estimation.checks.wiring import BEYOND
from selfcal_ros.estimation.comparison.covariance import Together, together
from selfcal_ros.estimation.joint.solve import MICROSCOPE_PARTS
from selfcal_ros.estimation.lattice.maps import MapSpline
from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.pose import EDGE
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verdict import Finding
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
    reference : ReferenceLength, optional
        Reference length of the calibration at the temperature of the plate now; None if that
        temperature or the length is not known: then no map has a scale.
    """

    result: CalibrationResult
    together: Together
    where: str
    reference: ReferenceLength | None = None

    @property
    def field(self) -> np.ndarray:
        """Error of the plate now, complex (nx, ny), m; NaN where unknown.

        With the expansion since its calibration, where the temperatures of both are known.
        """
        plate, lattice = self.result.artifact_map, self.result.plate
        longer = 0.0
        if self._lengths is not None:
            now, then = self._lengths
            longer = now.relative_error - then.relative_error
        nominal = lattice.x_m + 1j * lattice.y_m
        return np.where(
            self.together.marks,
            plate.ax + 1j * plate.ay + longer * nominal,
            complex(np.nan, np.nan),
        )

    @property
    def _lengths(self) -> tuple[ReferenceLength, ReferenceLength] | None:
        """Reference lengths now and at the calibration; None if one is not known."""
        now, then = self.reference, self.result.reference
        return None if now is None or then is None else (now, then)

    @property
    def variance_of_length(self) -> float:
        """Variance of the plate's length now beyond that at its calibration, 1 = (m/m)^2."""
        if self._lengths is None:
            return 0.0
        now, then = self._lengths
        return max(now.u_relative**2 - then.u_relative**2, 0.0)

    @property
    def variance_of_expansion(self) -> float:
        """Variance of the expansion since the calibration, by both temperatures, (m/m)^2."""
        if self._lengths is None:
            return 0.0
        now, then = (length.certified for length in self._lengths)
        if now is None or then is None:
            return 0.0
        u_kelvin = np.hypot(now.u_temperature_k, then.u_temperature_k)
        warmer = now.temperature_c - then.temperature_c
        return float((now.expansion_per_k * u_kelvin) ** 2 + (warmer * now.u_expansion_per_k) ** 2)

    def length_at(self, marks: np.ndarray) -> np.ndarray:
        """Return what a relative expansion of 1 adds to Ax, Ay of marks, and to the microscope.

        Of the marks in a bool array (nx, ny): (2 m + 4,), m.
        """
        lattice = self.result.plate
        return np.concatenate([lattice.x_m[marks], lattice.y_m[marks], np.zeros(4)])

    @property
    def of_offsets(self) -> np.ndarray:
        """Coefficients of the microscope that it found, (4,); NaN if it did not estimate them."""
        found = {
            each.component: each.value
            for term in self.result.model.terms
            if block_of(term.name).of_microscope
            for each in term.estimates
        }
        return np.array([found.get(part, 0.0 if found else np.nan) for part in MICROSCOPE_PARTS])


def reference_now(result: CalibrationResult, where: str, at: str) -> ReferenceLength | None:
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
    before = result.reference
    if before is None or before.certified is None or not before.kind.of_plate:
        raise InputError(
            "--reference-at",
            f"{where} has no reference length of its plate with the temperature of the calibration",
            "leave it out: the map then has no "
            "scale; or calibrate with --reference and --reference-at",
        )
    certified = before.certified
    now = replace(
        before, relative_error=certified.relative_error, u_relative=certified.u_relative
    ).at_temperature(at)
    for name in ("expansion_per_k", "u_expansion_per_k", "certified_at_c"):
        changed, known = getattr(now.certified, name), getattr(certified, name)
        if not np.isclose(changed, known, rtol=1e-9, atol=0.0):
            raise InputError(
                "--reference-at",
                f"{name} is {changed:g}, and {known:g} in {where}",
                "change the temperature alone",
            )
    return now


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
        raise InputError(
            where,
            "is itself a recheck, which does not calibrate a plate",
            f"name the calibration that it used, {result.recheck.of}",
        )
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(where, "is not qualified, so its plate is not known", "calibrate again")
    covariances = together(result)
    if covariances is None:
        raise InputError(
            where,
            "does not contain the covariance of its plate",
            "calibrate with the method joint and with uncertainty; a plate may have "
            "31 x 31 marks at most",
        )
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
        other.shape,
        other.angular_count,
        other.marks,
    ) or abs(mine.grid_pitch_m / other.grid_pitch_m - 1) > GAP:
        raise InputError(
            plate.where,
            f"its plate has {_described(other)}, not {_described(mine)}",
            "name the calibration of that plate",
        )
    if mine.map_grid is None and other.map_grid is not None:
        mine = replace(mine, map_grid=other.map_grid)
    if not mine.harmonics:
        mine = replace(mine, harmonics=other.harmonics)
    return replace(measurements, artifact=mine)


def _described(artifact: Artifact) -> str:
    nx, ny = artifact.shape
    if artifact.marks:
        return f"a list of {nx} marks and {artifact.angular_count or 'no'} lines"
    return (
        f"{nx} x {ny} marks {artifact.grid_pitch_m * MM_PER_M:g} mm apart and "
        f"{artifact.angular_count or 'no'} lines"
    )


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


LEAST = 0.01
"""Part of the known errors of the marks by which those of another plate differ at least."""

STEPS = 6
"""Steps to the motion of a view by least absolute values."""

PLANNED = (1 + 0j, 0j)
"""No further turn, no further shift."""

RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))
"""Median length of a vector whose two components have the standard deviation 1."""


@dataclass(frozen=True, eq=False)
class _Read:
    """Readings of one view: marks, complex (n,), and offsets less the stage, stage frame, m."""

    marks: np.ndarray
    offsets: np.ndarray
    turn: complex
    shift: complex
    u: float

    def left(
        self,
        plate: np.ndarray,
        artifact: Artifact,
        pose: tuple[complex, complex],
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return what the known plate leaves, and of which readings; None if they are not on it.

        `pose`: factor of a further turn, and shift of the plate's centre, in its pitches.
        """
        mark, there = on_marks(artifact, (self.marks - pose[1]) / pose[0])
        if there.mean() < ON_MARKS:
            return None
        rest = self.offsets - self.turn * pose[0] * np.where(there, plate.flat[mark], np.nan)
        here = np.isfinite(rest)
        if here.sum() < LEAST_READINGS:
            return None
        z = self.marks[here]
        free = np.stack([np.ones(len(z)), z, z.conj()], axis=1)
        left, weight = rest[here], np.ones((len(z), 1))
        for _ in range(STEPS):  # least sum of lengths: single marks may be far off
            left = (
                rest[here]
                - free @ np.linalg.lstsq(weight * free, weight[:, 0] * rest[here], rcond=None)[0]
            )
            weight = np.maximum(abs(left), self.u)[:, None] ** -0.5
        return left, here


def check_plate(measurements: Measurements, plate: KnownPlate, sigma: float) -> Finding | None:
    """Return a finding if another plate was read, or one whose marks have changed.

    Of images by the marks on the optical axis.

    Parameters
    ----------
    measurements : Measurements
        Views of the plate.
    plate : KnownPlate
        What is known of it, and of the stage.
    sigma : float
        Noise of a reading, m.

    Raises
    ------
    PlacingError
        If the plate is not placed as planned.
    """
    for view in (one for one in measurements.views if one.view.cell in (None, (0, 0))):
        seen = _read(view, measurements, plate, sigma)
        planned = None if seen is None else seen.left(plate.field, measurements.artifact, PLANNED)
        if seen is None or planned is None:
            continue
        rest, here = planned
        if (many := _size(rest) / seen.u) ** 2 < CONTRADICTED:
            continue
        other = _other_pose(seen, plate.field, measurements.artifact)
        if other is not None:
            raise said(_misplaced(view, seen, other), f"plan '{measurements.plan_id}', ")
        if _of_marks(seen.marks[here], rest, seen.u):
            return Finding(
                "other_plate",
                _size(rest),
                seen.u,
                "m",
                view=view.view.name,
                details={"times": many, "of": plate.where},
            )
    return None


def _read(
    view: ViewReadings, measurements: Measurements, plate: KnownPlate, sigma: float
) -> _Read | None:
    """Return the readings of a view less the stage as it was, where it was known."""
    artifact, pitch = measurements.artifact, measurements.artifact.grid_pitch_m
    if not len(view.m):
        return None
    at, old = view.view.pose.places(artifact, view.m, view.n), plate.result.error_map
    sign = measurements.sense.sign
    rows, there = rows_at(sign * at, plate)
    stage = sign * (rows @ (old.gx + 1j * old.gy)[plate.together.sites])
    marks = plate.result.artifact_map
    u = [
        sigma / np.sqrt(view.count.mean()),
        rms(np.stack([old.u_gx, old.u_gy])),
        rms(np.stack([marks.u_ax, marks.u_ay])),
        LEAST * rms(np.stack([marks.ax, marks.ay])),
    ]
    offsets = np.where(there, view.dx + 1j * view.dy - stage, complex(np.nan, np.nan))
    x, y = artifact.places(view.m, view.n)
    return _Read(
        x + 1j * y,
        offsets,
        complex(np.exp(1j * view.view.rotation_rad)),
        complex(*view.view.translation_m) / pitch,
        float(np.linalg.norm(u)),
    )


def _other_pose(
    seen: _Read, plate: np.ndarray, artifact: Artifact
) -> tuple[complex, complex] | None:
    """Return the pose that explains the readings much better than the planned one; else None.

    By the gain of the log-likelihood of differences of unknown size. Poses that do not explain most
    of them count as not tried: some gain by chance.
    """
    tried = []
    for pose in motions(artifact, seen.turn, seen.shift):
        here, planned = (seen.left(plate, artifact, each) for each in (pose, PLANNED))
        if here is None or planned is None:
            continue
        before, after = (max(_size(rest), seen.u) for rest, _ in (planned, here))
        if before**2 > CONTRADICTED * after**2:
            tried.append((2 * len(here[0]) * float(np.log(before / after)), pose))
    tried.sort(key=lambda item: -item[0])
    second = tried[1][0] if len(tried) > 1 else 0.0
    if not tried or tried[0][0] < BETTER or tried[0][0] - second < CLEARLY:
        return None
    return tried[0][1]


def _size(rest: np.ndarray) -> float:
    """Return the standard deviation of a component by the median, which few marks do not move."""
    return float(np.median(np.abs(rest))) / RAYLEIGH_MEDIAN


def _misplaced(view: ViewReadings, seen: _Read, pose: tuple[complex, complex]) -> Misplaced:
    """Return how the plate lies, turns in degrees, shifts in pitches along the stage's axes."""
    deg, moved = np.degrees(view.view.rotation_rad), seen.shift + seen.turn * pose[1]
    planned, found = (
        tuple(float(np.round(part, 6)) for part in (at.real, at.imag)) for at in (seen.shift, moved)
    )
    turned = deg + np.degrees(np.angle(pose[0]))
    return Misplaced(
        view.view.name,
        round(float(deg) % 360, 6),
        round(float(turned) % 360, 6),
        (planned[0], planned[1]),
        (found[0], found[1]),
    )


def _of_marks(marks: np.ndarray, rest: np.ndarray, u: float) -> bool:
    """Return whether what is left is of the marks: a stage alone changes continuously.

    Both are normal: of the stage with a correlation that falls with the distance, exponentially, of
    the marks each by itself. That the part of the marks contradicts u must be likelier than that it
    does not. Sizes and lengths are tried by halves and doubles, with the best scale.
    Single marks that are far off count as far off as others.
    """
    away = np.abs(marks[:, None] - marks)
    rest = rest / np.maximum(np.abs(rest) / (BEYOND * _size(rest)), 1.0)
    best = {True: -math.inf, False: -math.inf}
    length = 1.0
    while length < 2 * away.max():
        alike, axes = np.linalg.eigh(np.exp(-away / length))
        power = np.abs(axes.T @ rest) ** 2
        for own in 2.0 ** np.arange(-20, 20):
            variance = np.mean(power / (alike + own)) / 2
            likelihood = -len(rest) * np.log(variance) - np.log(alike + own).sum()
            differs = bool(own * variance > CONTRADICTED * u**2)
            best[differs] = max(best[differs], float(likelihood))
        length *= 2
    return best[True] > best[False]
