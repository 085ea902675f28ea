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
from scipy.spatial import KDTree

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
    placing_error,
)
from selfcal_ros.estimation.checks.wiring import BEYOND
from selfcal_ros.estimation.comparison.covariance import Together, together
from selfcal_ros.estimation.joint.solve import MICROSCOPE_PARTS
from selfcal_ros.estimation.lattice.maps import MapSpline
from selfcal_ros.estimation.normal.angular import GAP
from selfcal_ros.model.artifact import Artifact, Interpolation
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.findings import Finding, OtherPlate
from selfcal_ros.model.pose import EDGE, PlacedPose
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.reference import CERTIFIED_WITH, ReferenceLength
from selfcal_ros.model.result import COMBINED, CalibrationResult
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
    reference : ReferenceLength or None
        Reference length of the calibration at the temperature of the plate now; None if that
        temperature or the length is not known: then no map has a scale.
    """

    result: CalibrationResult
    together: Together
    where: str
    reference: ReferenceLength | None

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
        now = self.reference
        then = self.result.reference
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
        return float(
            (now.expansion_per_k * u_kelvin) ** 2
            + (warmer * now.u_expansion_per_k) ** 2
        )

    def length_at(self, marks: np.ndarray) -> np.ndarray:
        """Return what a relative expansion of 1 adds to Ax, Ay of marks, and to the microscope.

        Of the marks in a bool array (nx, ny): (2 m + 4,), m.
        """
        lattice = self.result.plate
        return np.concatenate([lattice.x_m[marks], lattice.y_m[marks], np.zeros(4)])

    @property
    def of_offsets(self) -> np.ndarray:
        """Coefficients of the microscope that it found, (4,); NaN if it did not estimate them."""
        values = {
            estimate.component: estimate.value
            for term in self.result.model.terms
            if block_of(term.name).of_microscope
            for estimate in term.estimates
        }
        return np.array(
            [
                values.get(component, 0.0 if values else np.nan)
                for component in MICROSCOPE_PARTS
            ]
        )


def reference_now(
    result: CalibrationResult, where: str, at: str
) -> ReferenceLength | None:
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
            "leave it out: the map then has no scale; or calibrate with --reference "
            "and --reference-at",
        )
    certified = before.certified
    now = replace(
        before, relative_error=certified.relative_error, u_relative=certified.u_relative
    ).at_temperature(at)
    for name in CERTIFIED_WITH:
        value_now = getattr(now.certified, name)
        certified_value = getattr(certified, name)
        if not np.isclose(value_now, certified_value, rtol=1e-9, atol=0.0):
            raise InputError(
                "--reference-at",
                f"{name} is {value_now:g}, and {certified_value:g} in {where}",
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
    otherwise = "or measure a plan that identifies the stage by itself"
    if result.recheck is not None:
        raise InputError(
            where,
            "is itself a recheck, which does not calibrate a plate",
            f"name the calibration that it used, {result.recheck.of}, {otherwise}",
        )
    if result.method == COMBINED:
        raise InputError(
            where,
            "is a mean of several runs, which has no map of a plate",
            f"name the calibration of this plate, {otherwise}",
        )
    if not result.observability.identifiable or not result.verdict.qualified:
        raise InputError(
            where, "is not qualified, so its plate is not known", "calibrate again"
        )
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
    artifact = measurements.artifact
    of_calibration = plate.result.plate
    if (artifact.shape, artifact.angular_count, artifact.marks) != (
        of_calibration.shape,
        of_calibration.angular_count,
        of_calibration.marks,
    ) or abs(artifact.grid_pitch_m / of_calibration.grid_pitch_m - 1) > GAP:
        raise InputError(
            plate.where,
            f"its plate has {_described(of_calibration)}, not {_described(artifact)}",
            "name the calibration of that plate",
        )
    if artifact.map_grid is None and of_calibration.map_grid is not None:
        artifact = replace(artifact, map_grid=of_calibration.map_grid)
    if not artifact.harmonics:
        artifact = replace(artifact, harmonics=of_calibration.harmonics)
    return replace(measurements, artifact=artifact)


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
    known_sites = plate.together.sites
    old = plate.result.artifact
    grid = plate.result.plate.map_grid
    how = Interpolation.BICUBIC if grid is None else grid.interpolation
    spline = MapSpline.of(old, how if known_sites.all() else Interpolation.BILINEAR)
    n = known_sites.size
    unit = spline.coefficients(np.eye(n).reshape(n, *known_sites.shape)).reshape(n, n).T
    rows = spline.rows(places) @ unit
    inside = np.abs(rows[:, ~known_sites.ravel()]).sum(axis=1) < EDGE
    reach = (np.array(old.half) + EDGE) * old.grid_pitch_m
    inside &= (np.abs(places.real) <= reach[0]) & (np.abs(places.imag) <= reach[1])
    return rows[:, known_sites.ravel()], inside


LEAST = 0.01
"""Part of the known errors of the marks by which those of another plate differ at least."""

STEPS = 6
"""Steps to the motion of a view by least absolute values."""

NEIGHBOURS = 8
"""Marks around one that show where it should be."""

AGREEING = 6
"""How many of them agree as far as a stage that changes continuously lets them."""

PLANNED = (1 + 0j, 0j)
"""No further turn, no further shift."""

RAYLEIGH_MEDIAN = math.sqrt(2 * math.log(2))
"""Median length of a vector whose two components have the standard deviation 1."""


@dataclass(frozen=True, eq=False)
class _ReadMarks:
    """Readings of one view: marks, complex (n,), and offsets less the stage, stage frame, m."""

    marks: np.ndarray
    offsets: np.ndarray
    turn: complex
    shift: complex
    u: float

    def remaining_at(
        self, plate: np.ndarray, artifact: Artifact, pose: tuple[complex, complex]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return what the known plate leaves, and of which readings; None if they are not on it.

        `pose`: factor of a further turn, and shift of the plate's centre, in its pitches.
        """
        mark, is_on_plate = on_marks(artifact, (self.marks - pose[1]) / pose[0])
        if is_on_plate.mean() < ON_MARKS:
            return None
        differences = self.offsets - self.turn * pose[0] * np.where(
            is_on_plate, plate.flat[mark], np.nan
        )
        readable = np.isfinite(differences)
        if readable.sum() < LEAST_READINGS:
            return None
        z = self.marks[readable]
        free = np.stack([np.ones(len(z)), z, z.conj()], axis=1)
        remaining = differences[readable]
        weight = np.ones((len(z), 1))
        for _ in range(STEPS):  # least sum of lengths: single marks may be far off
            remaining = (
                differences[readable]
                - free
                @ np.linalg.lstsq(
                    weight * free, weight[:, 0] * differences[readable], rcond=None
                )[0]
            )
            weight = np.maximum(abs(remaining), self.u)[:, None] ** -0.5
        return remaining, readable


def check_plate(
    measurements: Measurements, plate: KnownPlate, sigma: float
) -> Finding | None:
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
    for view in (
        readings
        for readings in measurements.views
        if readings.view.cell in (None, (0, 0))
    ):
        read_marks = _read(view, measurements, plate, sigma)
        planned = (
            None
            if read_marks is None
            else read_marks.remaining_at(plate.field, measurements.artifact, PLANNED)
        )
        if read_marks is None or planned is None:
            continue
        remaining, readable = planned
        if (many := _size(remaining) / read_marks.u) ** 2 < CONTRADICTED:
            continue
        other_pose = _other_pose(read_marks, plate.field, measurements.artifact)
        if other_pose is not None:
            raise placing_error(
                _misplaced(view, read_marks, other_pose),
                f"plan '{measurements.plan_id}', ",
            )
        if _of_marks(read_marks.marks[readable], remaining, read_marks.u):
            return OtherPlate(
                size=_size(remaining),
                u=read_marks.u,
                unit="m",
                view=view.view.name,
                times=many,
                of=plate.where,
            )
    return None


@dataclass(frozen=True)
class LoneMark:
    """A mark that is off by itself: the plate's (m, n), how far, m, and how far over its limit."""

    mark: tuple[int, int]
    away: float
    over: float


def lone_marks(
    measurements: Measurements, plate: KnownPlate, sigma: float
) -> list[LoneMark]:
    """Return marks that are off by themselves, the clearest first: a stage changes continuously.

    A mark is, if what the known plate leaves of it differs from the median of its neighbours, and
    from the plane through them, by more than noise and the differences of most of them explain.
    Parameters as for `check_plate`.
    """
    found = []
    for view in measurements.views:
        if view.view.cell not in (None, (0, 0)):
            continue
        read_marks = _read(view, measurements, plate, sigma)
        if read_marks is None:
            continue
        left = read_marks.remaining_at(plate.field, measurements.artifact, PLANNED)
        if left is None or len(left[0]) <= NEIGHBOURS:
            continue
        remaining, readable = left
        away, spread = _beside_neighbours(read_marks.marks[readable], remaining)
        over = away / (2 * BEYOND * np.hypot(spread, read_marks.u))
        m, n = view.m[readable], view.n[readable]
        found += [
            LoneMark((int(m[i]), int(n[i])), float(away[i]), float(over[i]))
            for i in np.flatnonzero(over > 1)
        ]
    return sorted(found, key=lambda lone: -lone.over)


def _beside_neighbours(
    places: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each complex value is from those of its neighbours, and how far they differ.

    From their median, or from the plane through them if that is nearer, (n,); and the largest
    distance from the median of the `AGREEING` nearest to it, (n,).
    """
    points = np.column_stack([places.real, places.imag])
    _, nearest = KDTree(points).query(points, k=NEIGHBOURS + 1)
    nearest = nearest[:, 1:]  # the first is the mark itself
    near = values[nearest]
    middle = np.median(near.real, axis=1) + 1j * np.median(near.imag, axis=1)
    step = places[nearest] - places[:, None]
    design = np.stack([np.ones_like(step.real), step.real, step.imag], axis=-1)
    plane = (np.linalg.pinv(design)[:, 0] * near).sum(axis=1)
    away = np.minimum(np.abs(values - middle), np.abs(values - plane))
    of_neighbours = np.sort(np.abs(near - middle[:, None]), axis=1)
    return away, of_neighbours[:, AGREEING - 1]


def _read(
    view: ViewReadings, measurements: Measurements, plate: KnownPlate, sigma: float
) -> _ReadMarks | None:
    """Return the readings of a view less the stage as it was, where it was known."""
    artifact = measurements.artifact
    pitch = measurements.artifact.grid_pitch_m
    if not len(view.m):
        return None
    places = view.view.pose.places(artifact, view.m, view.n)
    old = plate.result.error_map
    sign = measurements.sense.sign
    rows, stage_known = rows_at(sign * places, plate)
    stage = sign * (rows @ (old.gx + 1j * old.gy)[plate.together.sites])
    marks = plate.result.artifact_map
    u = [
        sigma / np.sqrt(view.count.mean()),
        rms(np.stack([old.u_gx, old.u_gy])),
        rms(np.stack([marks.u_ax, marks.u_ay])),
        LEAST * rms(np.stack([marks.ax, marks.ay])),
    ]
    offsets = np.where(
        stage_known, view.dx + 1j * view.dy - stage, complex(np.nan, np.nan)
    )
    x, y = artifact.places(view.m, view.n)
    return _ReadMarks(
        x + 1j * y,
        offsets,
        complex(np.exp(1j * view.view.rotation_rad)),
        complex(*view.view.translation_m) / pitch,
        float(np.linalg.norm(u)),
    )


def _other_pose(
    read_marks: _ReadMarks, plate: np.ndarray, artifact: Artifact
) -> tuple[complex, complex] | None:
    """Return the pose that explains the readings much better than the planned one; else None.

    By the gain of the log-likelihood of differences of unknown size. Poses that do not explain most
    of them count as not tried: some gain by chance.
    """
    tried = []
    for pose in motions(artifact, read_marks.turn, read_marks.shift):
        at_pose, planned = (
            read_marks.remaining_at(plate, artifact, tried_pose)
            for tried_pose in (pose, PLANNED)
        )
        if at_pose is None or planned is None:
            continue
        before, after = (
            max(_size(remaining), read_marks.u) for remaining, _ in (planned, at_pose)
        )
        if before**2 > CONTRADICTED * after**2:
            tried.append((2 * len(at_pose[0]) * float(np.log(before / after)), pose))
    tried.sort(key=lambda item: -item[0])
    second = tried[1][0] if len(tried) > 1 else 0.0
    if not tried or tried[0][0] < BETTER or tried[0][0] - second < CLEARLY:
        return None
    return tried[0][1]


def _size(remaining: np.ndarray) -> float:
    """Return the standard deviation of a component by the median, which few marks do not move."""
    return float(np.median(np.abs(remaining))) / RAYLEIGH_MEDIAN


def _misplaced(
    view: ViewReadings, read_marks: _ReadMarks, pose: tuple[complex, complex]
) -> Misplaced:
    """Return how the plate lies in place of its planned pose."""
    turn, shift = read_marks.turn, read_marks.shift
    lies_at = shift + turn * pose[1]
    return Misplaced.of(
        view.view.name,
        PlacedPose(turn, (shift.real, shift.imag), None),
        PlacedPose(turn * pose[0], (lies_at.real, lies_at.imag), None),
    )


def _of_marks(marks: np.ndarray, remaining: np.ndarray, u: float) -> bool:
    """Return whether what is left is of the marks: a stage alone changes continuously.

    Both are normal: of the stage with a correlation that falls with the distance, exponentially, of
    the marks each by itself. That the part of the marks contradicts u must be likelier than that it
    does not. Sizes and lengths are tried by halves and doubles, with the best scale.
    Single marks that are far off count as far off as others.
    """
    away = np.abs(marks[:, None] - marks)
    remaining = remaining / np.maximum(
        np.abs(remaining) / (BEYOND * _size(remaining)), 1.0
    )
    best = {True: -math.inf, False: -math.inf}
    length = 1.0
    while length < 2 * away.max():
        alike, axes = np.linalg.eigh(np.exp(-away / length))
        power = np.abs(axes.T @ remaining) ** 2
        for own_variance in 2.0 ** np.arange(-20, 20):
            variance = np.mean(power / (alike + own_variance)) / 2
            likelihood = (
                -len(remaining) * np.log(variance) - np.log(alike + own_variance).sum()
            )
            differs = bool(own_variance * variance > CONTRADICTED * u**2)
            best[differs] = max(best[differs], float(likelihood))
        length *= 2
    return best[True] > best[False]
