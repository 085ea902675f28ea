# SPDX-License-Identifier: Apache-2.0
"""True pose of the plate: other turns and shifts of single views, compared with the other views.

A plate that lies otherwise has its marks at the places of others, or they are not identified.

If detections have no ids, or the ids that the plan expects, a wrongly placed plate gives each site
the reading of another mark. With independent stage and plate errors, whose standard deviation is
estimated from the readings, the readings of all views have a normal likelihood for every pose of
the plate: the errors of the marks, which they carry from view to view, show the right one. Each
view has a free offset, rotation, strain and bending, which are not mistaken for another pose. The
stage's errors are independent from site to site; at any pose they are a field as smooth as the
nodes of the map are apart. Of images in three views or more the marks on the optical axis are
compared, of fewer views those of the cells beside it as well, each cell as a view of its own. Of
1,000 clean simulated measurements on the lattice none was refused, and 200 wrongly placed plates
were named.

A plate that was not moved between two views gives every site the same reading in both: that agrees
with a plate without errors, and the map is that of stage and plate together. It is told from such a
plate by its motion, within `PLACED_AGAIN_M`, where plates are compared to `SAME_NOISE_M`: a plate
with errors below that, placed again within that motion, is taken for it. With more noise, or more
motion up to `HARDLY_MOVED_M`, it may be either, which a finding says.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import LEAST_NOISE_M, MAX_REMOVED
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.findings import PlateHardlyMoved
from selfcal_ros.model.pose import EDGE, AnyPose, LatticePose, StagePose
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import View

WINDOW = 3
"""Sites used on either side of the centre of the field."""
EXPLAINED = 1.5
"""Mean square of the standardised readings up to which the plan's poses explain them."""
CONTRADICTED = 4.0
"""Mean square above which another pose does not explain the readings either."""
UNREPEATED = 0.1
"""Noise taken for readings without repeats, over the spread of stage and plate errors."""

FREE = 6
"""Number of complex columns of a view's own motion and shape."""
LEAST_READINGS = 2 * FREE
"""Smallest number of readings in the window for a view to be judged: half of them are left over."""
BETTER = 30.0
"""Gain of the log-likelihood above which another pose is accepted."""
CLEARLY = 10.0
"""Required gain over the second best pose."""
ROUGHER = (1 / 2, 1 / 4)
"""Parts of the distance of a map's nodes over which a stage may change that is too rough for it:
plates that lie as planned contradict each other then, too."""
LEFT = 0.05
"""Part of the plan's mean square which another pose may leave: there may be other faults too."""
STEPS = (-2, -1, 1, 2)
"""Steps along a row of marks by which a plate is tried beside its place."""
SAME_MARK = 0.1
"""Distance, in pitches, within which a mark at another pose lies on a mark of a list."""
PLACED_AGAIN_M, SAME_NOISE_M = 1e-7, 5e-8
"""Motion between two views, m, below which the plate was hardly placed anew, and the largest noise
of the means, m, with which this is asked."""
HARDLY_MOVED_M = 1e-6
"""Motion, m, up to which drift may have moved it."""
NOISE_ALONE = 1.5
"""Mean square of differences, over that of the noise, above which the plate has errors."""
SAME_DEG, SAME_PITCHES = 1e-3, 1e-3
"""Turn, and shift, within which the plan places the plate as before."""
ON_MARKS = 0.8
"""Part of the readings of a view that another pose must have on marks."""


class PlacingError(InputError):
    """Raised if the plate is not placed as planned."""


@dataclass(frozen=True)
class Misplaced:
    """A view in which the plate is not placed as planned; turns in degrees, shifts in pitches."""

    view: str
    planned_deg: float
    found_deg: float
    planned_shift: tuple[float, float]
    found_shift: tuple[float, float]

    @classmethod
    def of(cls, view: str, planned: StagePose, lies: StagePose) -> "Misplaced":
        """Return the difference of two poses."""
        return cls(view, planned.turn_deg, lies.turn_deg, planned.shift, lies.shift)


@dataclass(frozen=True)
class Mirrored:
    """A frame of stage and offsets that is left-handed: plates turn the other way in it.

    `axes` are the reflections that explain the readings about equally well, keys of `MIRRORS`.
    """

    axes: tuple[str, ...]


MIRRORS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "x reversed": lambda z: -z.conj(),
    "y reversed": np.conj,
    "x and y exchanged": lambda z: 1j * z.conj(),
    "x and y exchanged and reversed": lambda z: -1j * z.conj(),
}
"""Reflection of a frame -> places and deviations in the right one."""


@dataclass(frozen=True, eq=False)
class _WindowReadings:
    """Readings of one view in the window: places, complex (n,), pitches, deviations, m, repeats."""

    pose: AnyPose
    place: np.ndarray
    deviation: np.ndarray
    count: np.ndarray

    @property
    def marks(self) -> np.ndarray:
        """Places of the marks on the plate, complex (n,), pitches."""
        return (self.place - complex(*self.pose.shift)) * self.pose.phase.conjugate()


def check_placing(measurements: Measurements) -> None:
    """Raise PlacingError if the plate is not placed as planned in a view."""
    if fault := _lies_otherwise(measurements, _compared_views(measurements)):
        raise _error_of_plan(fault, measurements)


def moved_findings(measurements: Measurements) -> Iterator[PlateHardlyMoved]:
    """Yield where the plate may not have been moved before a view of another pose.

    Raises
    ------
    PlacingError
        If it was not.
    """
    same = _same_place(measurements, _compared_views(measurements))
    if same is None:
        return
    if same.is_sure:
        raise _error_of_plan(same.fault, measurements)
    yield PlateHardlyMoved(
        view=same.fault.view, against=same.earlier, size=same.motion_m, unit="m"
    )


def misplaced(measurements: Measurements) -> Misplaced | Mirrored | None:
    """Return the view in which the plate is placed differently, if the readings show one.

    Or that the frame is mirrored, if that explains all views clearly better than another pose of
    one of them.
    """
    compared_views = _compared_views(measurements)
    same = _same_place(measurements, compared_views)
    if same is not None and same.is_sure:
        return same.fault
    return _lies_otherwise(measurements, compared_views)


def _lies_otherwise(
    measurements: Measurements, compared_views: list[tuple[View, _WindowReadings]]
) -> Misplaced | Mirrored | None:
    """Return the view at another pose, or the mirrored frame, that explains the readings."""
    artifact = measurements.artifact
    views = [readings for _, readings in compared_views]
    if len(views) < 3:
        return None
    noise, spread = _sizes(measurements, views)
    if not spread > max(2 * noise, LEAST_NOISE_M):
        return None
    grid = artifact.map_grid
    nodes = grid.pitch_m / artifact.grid_pitch_m if grid else 0.0
    sizes = (max(noise, spread / 1000), spread, _alike(views, nodes))
    as_planned = _FactoredReadings(views, [], *sizes)
    planned, square = as_planned.with_moved([])
    if square < EXPLAINED:
        return None
    tried = []
    names = list(dict.fromkeys(view.plan_view for view, _ in compared_views))
    for view, readings in compared_views:
        # their relative pose alone counts
        if view.cell not in (None, (0, 0)) or (
            len(names) == 2 and view.plan_view == names[0]
        ):
            continue
        moved_views = [
            number
            for number, (also, _) in enumerate(compared_views)
            if also.plan_view == view.plan_view
        ]
        fixed_readings = _FactoredReadings(views, moved_views, *sizes)
        for pose in _poses(readings, artifact):
            likelihood, mean_square = fixed_readings.with_moved(
                [_at_pose(views[number], readings.pose, pose) for number in moved_views]
            )
            tried.append((likelihood - planned, mean_square, view, readings.pose, pose))
    tried.sort(key=lambda item: -item[0])
    otherwise = max(
        as_planned.gain_without_outliers(),
        *(
            _likelihood(views, *sizes[:2], _alike(views, nodes * part))[0] - planned
            for part in ROUGHER
        ),
        # readings noisier than their repeats, as of encoders within their period
        _likelihood(views, sizes[0] * square**0.5, *sizes[1:])[0] - planned,
    )
    best = max(tried[0][0] if tried else 0.0, otherwise)
    enough = max(CONTRADICTED, LEFT * square)
    if mirrored := _mirrored(
        views, planned, sizes, max(best + CLEARLY, BETTER), enough
    ):
        return mirrored
    if not tried:
        return None
    gain, mean_square, view, planned_pose, pose = tried[0]
    second = max(tried[1][0] if len(tried) > 1 else 0.0, otherwise)
    if gain < BETTER or gain - second < CLEARLY or mean_square > enough:
        return None
    return Misplaced.of(view.plan_view, planned_pose, pose)


@dataclass(frozen=True)
class _SamePlace:
    """A view with the plate where it lay in an `earlier` one, but for a motion, m."""

    fault: Misplaced
    earlier: str
    motion_m: float
    is_sure: bool


def _same_place(
    measurements: Measurements, compared_views: list[tuple[View, _WindowReadings]]
) -> _SamePlace | None:
    """Return the first view whose plate was not moved since an earlier one, or may not be."""
    doubtful = None
    for later, (view, readings) in enumerate(compared_views):
        for earlier_view, earlier in compared_views[:later]:
            if view.cell != earlier_view.cell or _placed_alike(
                readings.pose, earlier.pose
            ):
                continue
            motion = _motion_between(measurements, earlier, readings)
            if motion is None:
                continue
            same = _SamePlace(
                Misplaced.of(view.plan_view, readings.pose, earlier.pose),
                earlier_view.plan_view,
                *motion,
            )
            if same.is_sure:
                return same
            doubtful = doubtful or same
    return doubtful


def _placed_alike(pose: StagePose, other: StagePose) -> bool:
    """Return whether the plan places the plate as before, also where lines are read once."""
    turned_deg = (pose.turn_deg - other.turn_deg + 180) % 360 - 180
    shifted = np.subtract(pose.shift, other.shift)
    return bool(abs(turned_deg) < SAME_DEG and np.abs(shifted).max() < SAME_PITCHES)


def _motion_between(
    measurements: Measurements, earlier: _WindowReadings, later: _WindowReadings
) -> tuple[float, bool] | None:
    """Return the motion, m, of a plate between two views, and whether it was surely not moved.

    None from `HARDLY_MOVED_M` on, and if its marks do not lie at the same places of the stage, but
    for motion and noise.
    """
    earlier_site, later_site = (
        np.round(readings.place / SAME_MARK) for readings in (earlier, later)
    )
    _, first, second = np.intersect1d(earlier_site, later_site, return_indices=True)
    if len(first) < LEAST_READINGS:
        return None
    moved = later.deviation[second] - earlier.deviation[first]
    z = later.place[second] / WINDOW
    columns = np.stack([np.ones(len(z)), 1j * z], axis=1)
    lies = np.linalg.lstsq(columns, moved, rcond=None)[0]
    motion = float(np.sqrt(np.mean(np.abs(columns @ lies) ** 2)))
    if motion >= HARDLY_MOVED_M:
        return None
    residuals = moved - columns @ lies
    scatter = np.sqrt(np.sum(np.abs(residuals) ** 2) / (4 * (len(z) - 2)))
    noise, spread = _sizes(measurements, [earlier, later])
    if not any(view.dof_xy for view in measurements.views):
        noise = scatter  # which nothing else tells
    noise = max(noise, LEAST_NOISE_M)
    if spread <= 2 * noise or scatter**2 >= NOISE_ALONE * noise**2:
        return None
    return motion, bool(motion < PLACED_AGAIN_M and noise < SAME_NOISE_M)


def _compared_views(measurements: Measurements) -> list[tuple[View, _WindowReadings]]:
    """Return the views with their readings in the window; of images those on the optical axis.

    Or of their neighbours as well, where those alone are fewer than three.
    """
    window_views = [
        (view.view, readings)
        for view in measurements.views
        if sum(map(abs, view.view.cell or (0, 0))) < 2  # the others would cost seconds
        and (readings := _readings_in_window(measurements.artifact, view)) is not None
    ]
    on_axis = [item for item in window_views if item[0].cell in (None, (0, 0))]
    return on_axis if len(on_axis) >= 3 else window_views


def _mirrored(
    views: list[_WindowReadings],
    planned: float,
    sizes: tuple[float, float, np.ndarray],
    least: float,
    enough: float,
) -> Mirrored | None:
    """Return the reflections that gain the most, if that is more than `least`."""
    gains = {}
    for name, reflect in MIRRORS.items():
        likelihood, mean_square = _likelihood(
            [
                replace(
                    readings,
                    place=reflect(readings.place),
                    deviation=reflect(readings.deviation),
                )
                for readings in views
            ],
            *sizes,
        )
        if likelihood - planned > least and mean_square < enough:
            gains[name] = likelihood - planned
    best = max(gains.values(), default=0.0)
    axes = tuple(name for name, gain in gains.items() if gain > best - CLEARLY)
    return Mirrored(axes) if axes else None


def _at_pose(
    readings: _WindowReadings, planned: AnyPose, pose: AnyPose
) -> _WindowReadings:
    """Return the readings of a cell of images at the pose of their view; the camera stays."""
    if readings.pose == planned:
        return replace(readings, pose=pose)
    a, b = readings.pose.shift
    x, y = planned.shift
    u, v = pose.shift
    return replace(readings, pose=replace(pose, shift=(a + u - x, b + v - y)))


def other_poses(pose: LatticePose) -> Iterator[LatticePose]:
    """Yield other poses of a plate on the lattice: turned, shifted differently, not at all."""
    a, b = pose.shift
    yield from (replace(pose, quarter_turns=q) for q in range(4) if q != pose.q)
    shifts = {
        (0, 0),
        (-a, -b),
        (b, a),
        (-b, -a),
        *((a + step, b) for step in STEPS),
        *((a, b + step) for step in STEPS),
    }
    yield from (replace(pose, shift=shift) for shift in sorted(shifts - {pose.shift}))


def _poses(readings: _WindowReadings, artifact: Artifact) -> Iterator[AnyPose]:
    """Yield the other poses with which the readings of a view are of marks of the plate."""
    pose = readings.pose
    if isinstance(pose, LatticePose):
        yield from other_poses(pose)
        return
    phase = pose.phase
    shift = complex(*pose.shift)
    for turn, step in motions(artifact, phase, shift):
        new_shift = shift + phase * step
        new_pose = replace(
            pose, phase=phase * turn, shift=(new_shift.real, new_shift.imag)
        )
        if (
            on_marks(artifact, replace(readings, pose=new_pose).marks)[1].mean()
            >= ON_MARKS
        ):
            yield new_pose


def on_marks(artifact: Artifact, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the nearest marks of a plate, flat, to places (n,), pitches, and if they are there."""
    marks = (artifact.x_m + 1j * artifact.y_m).ravel() / artifact.grid_pitch_m
    away = np.abs(places[:, None] - marks)
    return away.argmin(axis=1), away.min(axis=1) < SAME_MARK


def motions(
    artifact: Artifact, phase: complex, shift: complex
) -> list[tuple[complex, complex]]:
    """Return turns, and shifts in pitches of the plate, with which marks may lie on marks.

    A shift by a pitch, in no, the opposite or another direction, and quarter turns; of a list, by
    the distance of neighbours, and turns that carry one of the outermost marks to the others.
    """
    if artifact.marks is not None:
        marks = (artifact.x_m + 1j * artifact.y_m).ravel() / artifact.grid_pitch_m
        candidates = [
            *_symmetries(marks),
            *((1, step) for step in _steps(phase, shift)),
        ]
        return [
            motion
            for number, motion in enumerate(candidates)
            if not any(
                abs(motion[0] - turn) + abs(motion[1] - step) < SAME_MARK
                for turn, step in candidates[:number]
            )
        ]
    steps = {
        complex(np.round(step))
        for step in (0, 1, -1, 1j, -1j, *_steps(phase, shift))
        if abs(step - np.round(step)) < EDGE
    }
    return [
        (1j**q, step)
        for step in sorted(steps, key=lambda s: (s.real, s.imag))
        for q in range(4)
        if q or step
    ]


def _steps(phase: complex, shift: complex) -> list[complex]:
    """Return the steps on the plate from a shift to none, and to its other directions."""
    return [
        (place - shift) / phase
        for place in (0, -shift, 1j * shift, -1j * shift)
        if shift
    ]


def _symmetries(marks: np.ndarray) -> Iterator[tuple[complex, complex]]:
    """Yield the turns, and shifts by the least step between two marks, that may fit on a list."""
    outer = marks[np.abs(np.abs(marks) - np.abs(marks).max()) < SAME_MARK]
    yield from ((mark / outer[0] / abs(mark / outer[0]), 0j) for mark in outer[1:])
    steps = marks - marks[np.abs(marks).argmin()]
    steps = steps[np.abs(steps) > SAME_MARK]
    yield from (
        (1 + 0j, step) for step in steps[np.argsort(np.abs(steps))[:4]].tolist()
    )


def _readings_in_window(
    artifact: Artifact, view: ViewReadings
) -> _WindowReadings | None:
    """Return the readings of a view in the window; None if too few, or without a grid."""
    pose = view.view.on_stage(artifact)
    if not pose.has_sites or not len(view.m):
        return None
    i, j = pose.site_of(*artifact.places(view.m, view.n))
    inside = np.maximum(np.abs(i), np.abs(j)) <= WINDOW + EDGE
    if inside.sum() < LEAST_READINGS:
        return None
    return _WindowReadings(
        cast(AnyPose, pose),
        (i + 1j * j)[inside],
        (view.dx + 1j * view.dy)[inside],
        view.count[inside],
    )


def _sizes(
    measurements: Measurements, views: list[_WindowReadings]
) -> tuple[float, float]:
    """Return the noise of a mean and the spread of stage and plate errors, m, by component."""
    total, free = 0.0, 0
    for readings in views:
        motion = _motion(readings)
        lies = np.linalg.lstsq(motion, readings.deviation, rcond=None)[0]
        residuals_m = readings.deviation - motion @ lies
        total = total + float(np.sum(np.abs(residuals_m) ** 2))
        free = free + len(residuals_m) - FREE
    spread = float(np.sqrt(total / (2 * max(free, 1))))
    repeated = [view for view in measurements.views if view.dof_xy]
    if not repeated:
        return UNREPEATED * spread, spread
    share = np.concatenate([1 / readings.count for readings in views]).mean()
    variance = np.average(
        [view.sigma_xy**2 for view in repeated],
        weights=[view.dof_xy for view in repeated],
    )
    return float(np.sqrt(variance * share)), spread


def _motion(readings: _WindowReadings) -> np.ndarray:
    """Return the columns of a view's own parameters, complex (n, FREE).

    Offset, rotation, strain and bending; the residual belongs to the marks.
    """
    z = readings.place / WINDOW
    return np.stack(
        [np.ones(len(z)), z, z.conj(), z * z, z * z.conj(), z.conj() ** 2], axis=1
    )


def _alike(views: list[_WindowReadings], nodes: float) -> np.ndarray:
    """Return the correlation of the stage's errors at the places of all readings, (n, n).

    Neither another pose of the plate nor a mirrored frame changes it.

    Parameters
    ----------
    views : list of _WindowReadings
        Readings.
    nodes : float
        Distance of the nodes of the map, in pitches; 0 on the lattice.
    """
    site = np.concatenate([readings.place for readings in views])
    if not nodes:
        return np.equal.outer(site, site)
    x, y = (
        np.subtract.outer(coordinate, coordinate)
        for coordinate in (site.real, site.imag)
    )
    return np.exp(-(x * x + y * y) / (2 * nodes**2))


def _likelihood(
    views: list[_WindowReadings], noise: float, spread: float, stage: np.ndarray
) -> tuple[float, float]:
    """Return the log-likelihood of all readings, and their mean standardised square.

    Each view's own parameters are removed. `stage`: see `_alike`.
    """
    return _FactoredReadings(views, [], noise, spread, stage).with_moved([])


class _FactoredReadings:
    """Readings that stay while others are tried at many poses, factored once for all of them.

    Parameters
    ----------
    views : list of _WindowReadings
        Readings of all views.
    moved_views : list of int
        Those of which other poses are tried.
    noise, spread, stage
        As `_likelihood` takes them.
    """

    def __init__(
        self,
        views: list[_WindowReadings],
        moved_views: list[int],
        noise: float,
        spread: float,
        stage: np.ndarray,
    ) -> None:
        self.noise, self.spread, self.free = noise, spread, FREE * len(views)
        of_view = np.repeat(
            np.arange(len(views)), [len(readings.place) for readings in views]
        )
        tried = np.isin(of_view, moved_views)
        fixed = np.flatnonzero(~tried)
        self.beside, self.own = stage[np.ix_(fixed, tried)], stage[np.ix_(tried, tried)]
        self.views = [
            readings
            for number, readings in enumerate(views)
            if number not in moved_views
        ]
        self.factor = np.linalg.cholesky(
            self._covariance(self.views, self.views, stage[np.ix_(fixed, fixed)])
        )
        self.sizes = np.diag(self.factor).real
        self.white = np.linalg.solve(self.factor, self._columns(self.views, 0))

    def with_moved(self, moved_readings: list[_WindowReadings]) -> tuple[float, float]:
        """Return the likelihood of all readings with those of the others at these poses."""
        white, sizes = self.white, self.sizes
        if moved_readings:
            whitened_cross = self.whiten @ self._covariance(
                self.views, moved_readings, self.beside
            )
            factor = np.linalg.cholesky(
                self._covariance(moved_readings, moved_readings, self.own)
                - whitened_cross.conj().T @ whitened_cross
            )
            residual_columns = (
                self._columns(moved_readings, len(self.views))
                - whitened_cross.conj().T @ white
            )
            white = np.concatenate([white, np.linalg.solve(factor, residual_columns)])
            sizes = np.concatenate([sizes, np.diag(factor).real])
        inner = white[:, :-1].conj().T @ white
        square = (
            np.linalg.norm(white[:, -1]) ** 2
            - (inner[:, -1].conj() @ np.linalg.solve(inner[:, :-1], inner[:, -1])).real
        )
        likelihood = (
            -square / 2 - 2 * np.log(sizes).sum() - np.linalg.slogdet(inner[:, :-1])[1]
        )
        return float(likelihood), float(square / 2 / (len(white) - self.free))

    def gain_without_outliers(self) -> float:
        """Return how far the log-likelihood grows if the readings that are off are left out.

        The worst one after another, as long as each gains more than chance does. A single reading
        that is off contradicts all that share its mark or its site, as a plate does that lies
        otherwise, and at another pose it may share neither with any.
        """
        columns, deviations = self.white[:, :-1], self.white[:, -1]
        basis = np.linalg.qr(columns)[0]
        fitted = self.whiten - basis @ (basis.conj().T @ self.whiten)
        precision = fitted.conj().T @ fitted
        pull = fitted.conj().T @ deviations
        least = np.sqrt(np.finfo(float).eps) * precision.diagonal().real.max()
        total = 0.0
        for _ in range(int(MAX_REMOVED * len(pull))):
            checked = np.maximum(precision.diagonal().real, least)
            gains = np.abs(pull) ** 2 / checked / 2
            worst = int(gains.argmax())
            if gains[worst] < CLEARLY:
                break
            total += float(gains[worst]) - CLEARLY
            response = precision[:, worst] / checked[worst]
            pull = pull - response * pull[worst]
            precision = precision - np.outer(response, precision[worst])
        return total

    @cached_property
    def whiten(self) -> np.ndarray:
        """What makes the readings that stay independent, with unit noise, complex (n, n)."""
        return np.linalg.inv(self.factor)

    def _covariance(
        self,
        some: list[_WindowReadings],
        others: list[_WindowReadings],
        stage: np.ndarray,
    ) -> np.ndarray:
        """Return the covariance of readings, `stage` that of the stage's errors in them."""
        (turn, mark), (other_turn, other_mark) = map(_on_plate, (some, others))
        covariance = self.spread**2 / 2 * stage.astype(complex)
        row, column = np.equal.outer(mark, other_mark).nonzero()
        covariance[row, column] += (
            self.spread**2 / 2 * turn[row] * other_turn[column].conj()
        )
        if some is others:
            covariance.flat[:: len(mark) + 1] += self.noise**2
        return covariance

    def _columns(self, views: list[_WindowReadings], first: int) -> np.ndarray:
        """Return the columns of all views' own parameters, and the deviations; `first`: of these.

        Complex (n, free + 1).
        """
        rows = [np.zeros((0, self.free + 1), dtype=complex)]
        for number, readings in enumerate(views, first):
            row = np.zeros((len(readings.place), self.free + 1), dtype=complex)
            row[:, FREE * number : FREE * (number + 1)] = _motion(readings)
            row[:, -1] = readings.deviation
            rows.append(row)
        return np.concatenate(rows)


def _on_plate(views: list[_WindowReadings]) -> tuple[np.ndarray, np.ndarray]:
    """Return turns of the plate and marks of all readings, complex (n,) each."""
    none = np.zeros(0, dtype=complex)
    return (
        np.concatenate(
            [
                none,
                *(
                    np.full(len(readings.place), readings.pose.phase)
                    for readings in views
                ),
            ]
        ),
        np.round(np.concatenate([none, *(readings.marks for readings in views)]), 3),
    )


def placing_error(pose_fault: Misplaced | Mirrored, where: str = "") -> PlacingError:
    """Return in one line how the plate is placed, and how to continue."""
    if isinstance(pose_fault, Mirrored):
        return PlacingError(
            f"{where}all views",
            "the plate turns and shifts as in a mirrored frame: stage and offsets "
            f"have {', or '.join(pose_fault.axes)}",
            "correct the axes of both, so that a plate turned counter-clockwise "
            "turns from +x to +y",
        )
    if pose_fault.found_deg != pose_fault.planned_deg:
        fault = (
            f"the plate lies turned by {pose_fault.found_deg:g}°, not by "
            f"{pose_fault.planned_deg:g}°"
        )
        wrong_way = (pose_fault.found_deg + pose_fault.planned_deg) % 360 == 0
        how = "turn it counter-clockwise" if wrong_way else "turn it as planned"
    else:
        fault = (
            f"the plate lies shifted by {_pitches(pose_fault.found_shift)}, not by "
            f"{_pitches(pose_fault.planned_shift)}"
        )
        how = "shift it as planned"
    return PlacingError(
        f"{where}view '{pose_fault.view}'",
        fault,
        f"{how} and measure this view again, or correct its pose in the plan",
    )


def _error_of_plan(
    fault: Misplaced | Mirrored, measurements: Measurements
) -> PlacingError:
    return placing_error(fault, f"plan '{measurements.plan_id}', ")


def _pitches(shift: tuple[float, float]) -> str:
    x, y = np.round(shift, 6) + 0.0
    return f"({x:+g}, {y:+g}) pitches"
