# SPDX-License-Identifier: Apache-2.0
"""Identification of marks by id, or as the nearest nominal mark of the view."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.collection.inputs import Reason
from selfcal_ros.collection.marks import rigid as rigids
from selfcal_ros.collection.marks.repeats import PART, distances
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import LatticePose, StagePose
from selfcal_ros.model.view import View

TOO_FAR_FROM_ANY = 0.75
"""Distance to the nearest mark, in pitches, beyond which a detection is not of a mark."""
SURE = 0.25
"""Largest error of a predicted position, in pitches, for which the nearest mark is the detected
one: with an unknown offset of a quarter pitch it stays below half a pitch."""
OFF_ANY_PLATE_M = 1e9
"""Coordinates beyond this are clipped."""
LOOKED_AT = 50
"""Detections from which the offset of a view without ids is found on a list of marks."""
CANDIDATES = 4
"""Marks that each of them may be."""
ON_MARK = 0.1
"""Distance, in pitches, within which a detection lies on a mark of a list."""
HALF_A_LINE = 0.45
"""Largest possible rotation, in lines, for which the nearest line is the detected one."""


@dataclass(frozen=True)
class IdentityRules:
    """Limits of identification; see the collector's parameters of the same names."""

    max_deviation_m: float
    ambiguity_ratio: float
    max_rotation_rad: float
    max_stage_distance_m: float = 0.0

    def stage_limit_m(self, artifact: Artifact) -> float:
        """Return the largest distance of the stage from the site of a detected mark, m.

        Default: half a pitch plus the motion of the plate's rim by the largest rotation.
        """
        rim = self.max_rotation_rad * float(np.hypot(*artifact.reach))
        return self.max_stage_distance_m or (0.5 + rim) * artifact.grid_pitch_m


@dataclass(frozen=True)
class MarkAssignment:
    """Marks of readings: indices, deviations (rows, n), and reasons of rejection.

    `residual` is the deviation without the view's own motion `rigid`; `phi_error_rad` is the
    largest error of its rotation.
    """

    index: np.ndarray
    deviation: np.ndarray
    residual: np.ndarray
    reasons: np.ndarray
    rigid: rigids.Rigid
    phi_error_rad: float = float("inf")


def identify_grid(
    artifact: Artifact,
    view: View,
    reading_m: np.ndarray,
    *,
    ids: np.ndarray,
    has_id: np.ndarray,
    rules: IdentityRules,
    stage_m: np.ndarray | None = None,
    beside_m: np.ndarray | None = None,
) -> MarkAssignment:
    """Identify grid marks and return their deviations from the nominal places of the view.

    A mark is rejected if the stage is not at its site, and not used for the others.

    Parameters
    ----------
    artifact, view
        The plate and its pose.
    reading_m : float array (2, n)
        Positions of the marks as read, stage frame.
    ids : int array (2, n)
        (m, n) where `has_id`.
    has_id : bool array (n,)
        Whether the detection names its mark.
    rules : IdentityRules
        Limits.
    stage_m : float array (2, n), optional
        Indicated site of the stage, plus `beside_m`; None = at the mark.
    beside_m : float array (2, n), optional
        Place in the image at which each mark is seen; None = at the optical axis.
    """
    pose = view.on_stage(artifact)
    pitch = artifact.grid_pitch_m
    if not view.grid:
        return _not_in_view(ids, reading_m)
    reasons = np.full(reading_m.shape[1], None, dtype=object)
    named_unknown = has_id & ~artifact.has(*ids)
    marks = np.where(
        has_id & ~named_unknown,
        ids,
        np.array([[artifact.marks.ids[0]], [0]]) if artifact.marks else 0,
    )
    # squares stay finite
    reading_m = np.clip(reading_m, -OFF_ANY_PLATE_M, OFF_ANY_PLATE_M)
    # about the plate's centre
    centred = reading_m - np.array(pose.shift)[:, None] * pitch
    limit_m = rules.stage_limit_m(artifact) + view.check_offset_m
    astray = _astray(pose, marks, stage_m, artifact, limit_m, among=has_id)
    named = has_id & ~named_unknown & ~astray
    free = ~has_id
    estimate, fit = _settle(pose, centred, artifact, marks, (named, free), rules)
    rigid = estimate.rigid if fit.marks < 3 else fit.rigid
    far, unsure, ambiguous = (np.zeros(marks.shape[1], dtype=bool) for _ in range(3))
    if free.any():
        marks[:, free], far[free], unsure[free], ambiguous[free] = _identified(
            pose, centred[:, free], artifact, estimate, rules
        )
    site = np.stack(pose.site_of(*artifact.places(*marks)))
    deviation = reading_m - site * pitch
    about = _about(pose, marks, artifact)
    few = _at_most_two(artifact.flat(*marks)[~far & ~ambiguous & ~unsure])
    limit = pitch / 4 if few else min(rules.max_deviation_m, pitch / 4)
    residual = deviation - rigid.at(about)
    far |= ~ambiguous & (distances(residual) > limit)
    astray |= _astray(pose, marks, stage_m, artifact, limit_m, among=free & ~far)
    stop = site if beside_m is None else np.round(site - beside_m / pitch, 9)
    beyond = pose.beyond_field(stop, artifact) & ~unsure
    for where, reason in (
        (far, Reason.TOO_FAR),
        (astray, Reason.NOT_AT_MARK),
        (ambiguous, Reason.AMBIGUOUS),
        (unsure, Reason.ROTATION),
        (beyond, Reason.NOT_IN_VIEW),
        (named_unknown, Reason.UNKNOWN_MARK),
    ):
        reasons[where] = reason
    return MarkAssignment(
        index=marks,
        deviation=deviation,
        residual=residual,
        reasons=reasons,
        rigid=rigid,
        phi_error_rad=fit.phi_error_rad,
    )


def _not_in_view(ids: np.ndarray, reading: np.ndarray) -> MarkAssignment:
    """Return the rejection of all detections of a kind that the view does not ask for."""
    reasons = np.full(reading.shape[-1], Reason.NOT_IN_VIEW, dtype=object)
    nothing = np.zeros(reading.shape)
    return MarkAssignment(ids, nothing, nothing, reasons, rigids.Rigid())


def _identified(
    pose: StagePose,
    centred_m: np.ndarray,
    artifact: Artifact,
    estimate: rigids.MotionEstimate,
    rules: IdentityRules,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the mark nearest to each reading about the plate's centre, (2, n), and three flags.

    Bool (n,) each: whether there is none, whether the rotation is known too badly to tell, and
    whether another mark is nearly as near.
    """
    nominal = estimate.rigid.undo(centred_m)
    marks, ratio, distance, apart = _nearest(pose, nominal, artifact)
    error = estimate.error_at(nominal)
    reach = TOO_FAR_FROM_ANY * artifact.grid_pitch_m
    near = distance <= reach
    unsure = (error > SURE * artifact.grid_pitch_m) & (distance <= reach + error)
    between = (error > SURE * apart) & ~unsure
    ambiguous = near & (between | (ratio > rules.ambiguity_ratio))
    return marks, ~near & ~unsure, unsure, ambiguous


def _at_most_two(numbers: np.ndarray) -> bool:
    """Return whether the numbers have no more than two different values."""
    return not len(numbers) or bool(
        ((numbers == numbers.min()) | (numbers == numbers.max())).all()
    )


def _astray(
    pose: StagePose,
    marks: np.ndarray,
    stage_m: np.ndarray | None,
    artifact: Artifact,
    limit_m: float,
    *,
    among: np.ndarray,
) -> np.ndarray:
    """Return which of the `among` marks (2, n) have the stage too far from their sites."""
    if stage_m is None or not among.any():
        return np.zeros(marks.shape[1], dtype=bool)
    astray = np.empty(marks.shape[1], dtype=bool)
    for start in range(0, len(astray), PART):
        columns = slice(start, start + PART)
        site = (
            np.stack(pose.site_of(*artifact.places(*marks[:, columns])))
            * artifact.grid_pitch_m
        )
        away = np.clip(stage_m[:, columns] - site, -OFF_ANY_PLATE_M, OFF_ANY_PLATE_M)
        astray[columns] = distances(away) > limit_m
    return astray & among


def _nearest(
    pose: StagePose, centred: np.ndarray, artifact: Artifact
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return nearest mark (2, n), distance ratio to the second nearest, distance in m.

    Also, of a list of marks, the distance of the two nearest ones from each other, m.
    """
    pitch = artifact.grid_pitch_m
    far_apart_m = np.full(centred.shape[1], np.inf)
    if artifact.marks:
        plate = np.stack(pose.turned_back(centred[0], centred[1]))
        away, two = artifact.marks.tree.query(
            np.nan_to_num(plate.T, nan=OFF_ANY_PLATE_M), 2
        )
        between_marks_m = distances(
            np.diff(artifact.marks.places_m[:, two], axis=2)[:, :, 0]
        )
        mark = np.stack(
            [artifact.marks.id_array[two[:, 0]], np.zeros(len(two), dtype=int)]
        )
        return (
            mark,
            away[:, 0] / np.maximum(away[:, 1], 1e-12 * pitch),
            away[:, 0],
            between_marks_m,
        )
    (first_m, last_m), (first_n, last_n) = artifact.limits
    step = centred / pitch
    plate = np.stack(pose.turned_back(step[0], step[1]))
    mark = np.clip(
        artifact.nearest(*plate), [[first_m], [first_n]], [[last_m], [last_n]]
    )
    away = np.abs(plate - np.stack(artifact.places(*mark)))
    first = distances(away)
    second = np.minimum(np.hypot(1 - away[0], away[1]), np.hypot(away[0], 1 - away[1]))
    return (
        mark.astype(np.int64),
        first / np.maximum(second, 1e-12),
        first * pitch,
        far_apart_m,
    )


def _settle(
    pose: StagePose,
    centred: np.ndarray,
    artifact: Artifact,
    ids: np.ndarray,
    kinds: tuple[np.ndarray, np.ndarray],
    rules: IdentityRules,
) -> tuple[rigids.MotionEstimate, rigids.RigidFit]:
    """Return the estimate of the view's own motion, extended outwards from unambiguous marks.

    Far from the centre a rotational misalignment may exceed half a pitch. So marks without ids
    are used only where the motion known so far cannot confuse them: around the named marks, or
    around the innermost one if none is named; the motion from these reaches further out.
    """
    named, free = kinds
    pitch = artifact.grid_pitch_m
    about = _about(pose, ids, artifact)
    use = named
    fit = rigids.fit_motion(*rigids.columns_where(named, about, centred - about))
    innermost = _innermost_of_list if artifact.marks else _innermost
    estimate = (
        fit.known(pitch, rules.max_rotation_rad)
        if named.any()
        else innermost(
            _rows(pose, artifact), centred[:, free], artifact, rules.max_rotation_rad
        )
    )
    while free.any():
        nominal = estimate.rigid.undo(centred)
        nearest, ratio, _, apart = _nearest(pose, nominal, artifact)
        sure = (estimate.error_at(nominal) <= SURE * np.minimum(pitch, apart)) & (
            ratio < 0.5
        )
        wider = named | (free & sure)
        if wider.sum() <= use.sum():
            break
        use = wider
        mark = np.where(named, ids, nearest)
        about = _about(pose, mark, artifact)
        fit = rigids.fit_motion(*rigids.columns_where(use, about, centred - about))
        estimate = fit.known(pitch, rules.max_rotation_rad)
    offset_determined = named.any() or artifact.marks
    return (
        (estimate, fit)
        if offset_determined
        else _folded(_rows(pose, artifact), estimate, fit, pitch)
    )


def _rows(pose: StagePose, artifact: Artifact) -> StagePose:
    """Return the pose as far as rows of marks turn with it: on the lattice not at all.

    Unless the rows lie otherwise about the centre along x than along y.
    """
    alike = isinstance(pose, LatticePose) and len(set(artifact.off_centre)) == 1
    return LatticePose(0, (0, 0), None) if alike else pose


def _innermost(
    rows: StagePose, centred: np.ndarray, artifact: Artifact, max_rotation_rad: float
) -> rigids.MotionEstimate:
    """Return the offset at the innermost mark from marks around it, up to whole pitches."""
    pitch = artifact.grid_pitch_m
    if not centred.shape[1]:
        return rigids.MotionEstimate(phi_error_rad=max_rotation_rad)
    centre = centred[:, np.argmin(np.hypot(*centred))]
    near = np.hypot(*(centred - centre[:, None])) * max_rotation_rad <= SURE * pitch
    offset = np.array(
        [
            _middle((row - off * pitch) * (2 * np.pi / pitch), 2 * np.pi)
            * pitch
            / (2 * np.pi)
            for row, off in zip(
                rows.turned_back(*centred[:, near]), artifact.off_centre, strict=True
            )
        ]
    )
    x, y = map(float, rows.turned(*offset))
    return rigids.MotionEstimate(
        rigids.Rigid(0.0, x, y),
        (float(centre[0]), float(centre[1])),
        0.0,
        max_rotation_rad,
    )


def _innermost_of_list(
    pose: StagePose, centred: np.ndarray, artifact: Artifact, max_rotation_rad: float
) -> rigids.MotionEstimate:
    """Return the offset with which most detections near the innermost one lie on marks of a list.

    The smallest one of those with nearly as many: a list may have parts like a lattice.
    """
    pitch, marks = artifact.grid_pitch_m, artifact.marks
    if not centred.shape[1] or marks is None:
        return rigids.MotionEstimate(phi_error_rad=max_rotation_rad)
    nearest = np.argsort(np.hypot(*centred), kind="stable")
    centre = centred[:, nearest[0]]
    near = centred[:, nearest]
    near = near[
        :, np.hypot(*(near - centre[:, None])) * max_rotation_rad <= SURE * pitch
    ]
    some = np.stack(pose.turned_back(*near[:, :LOOKED_AT]))
    among = marks.tree.query(some.T, CANDIDATES)[1]
    offsets = (some[:, :, None] - marks.places_m[:, among]).reshape(2, -1)
    on_plate_m = some[:, None] - offsets[:, :, None]
    hits = (
        marks.tree.query(on_plate_m.reshape(2, -1).T)[0].reshape(len(offsets[0]), -1)
        < ON_MARK * pitch
    ).sum(axis=1)
    away = np.where(hits >= 0.9 * hits.max(), np.hypot(*offsets), np.inf)
    x, y = map(float, pose.turned(*offsets[:, int(away.argmin())]))
    return rigids.MotionEstimate(
        rigids.Rigid(0.0, x, y),
        (float(centre[0]), float(centre[1])),
        ON_MARK * pitch,
        max_rotation_rad,
    )


def _folded(
    rows: StagePose, estimate: rigids.MotionEstimate, fit: rigids.RigidFit, pitch: float
) -> tuple[rigids.MotionEstimate, rigids.RigidFit]:
    """Return the motion whose offset at the plate's centre is below half a pitch.

    Marks without ids determine it only up to whole pitches, and not at all if they are so far out
    that the rotation does not give the offset at the centre.
    """
    if estimate.error_at(np.zeros((2, 1)))[0] > SURE * pitch:
        return replace(estimate, offset_error_m=float("inf")), fit
    offset = rows.turned_back(*np.array([estimate.rigid.tx_m, estimate.rigid.ty_m]))
    x, y = map(float, rows.turned(*np.rint(np.array(offset) / pitch) * pitch))
    folded = [
        replace(rigid, tx_m=rigid.tx_m - x, ty_m=rigid.ty_m - y)
        for rigid in (estimate.rigid, fit.rigid)
    ]
    return replace(estimate, rigid=folded[0]), replace(fit, rigid=folded[1])


def _about(pose: StagePose, marks: np.ndarray, artifact: Artifact) -> np.ndarray:
    return np.stack(pose.turned(*artifact.places(*marks))) * artifact.grid_pitch_m


def identify_angular(
    artifact: Artifact,
    view: View,
    reading_rad: np.ndarray,
    *,
    ids: np.ndarray,
    has_id: np.ndarray,
    rules: IdentityRules,
    phi_rad: float | None,
) -> MarkAssignment:
    """Identify angular lines and return their deviations, wrapped to (-pi, pi].

    Parameters
    ----------
    artifact, view
        The plate and its pose.
    reading_rad : float array (n,)
        Directions of the lines as read, stage frame.
    ids : int array (n,)
        k where `has_id`.
    has_id : bool array (n,)
        Whether the detection names its line.
    rules : IdentityRules
        Limits.
    phi_rad : float or None
        The view's rotation from the grid marks. If neither they nor ids determine it, and
        the nearest line may be wrong, lines without ids are rejected.
    """
    count = artifact.angular_count
    if not count or not view.angular:
        return _not_in_view(ids, reading_rad)
    reasons = np.full(len(reading_rad), None, dtype=object)
    step = 2 * np.pi / count
    whole_lines, fraction = divmod(view.on_stage(artifact).s, 1)
    # a turn between two lines only for a Fourier map
    base = int(whole_lines)
    between = fraction * step
    reading_rad = wrap(reading_rad - between) if between else reading_rad
    has_known_id = has_id & (ids >= 0) & (ids < count)
    rotation_known = phi_rad is not None or has_known_id.any()
    if phi_rad is None:
        named = wrap(reading_rad - (ids + base) * step)[has_known_id]
        phi_rad = (
            _middle(named, 2 * np.pi) if len(named) else _middle(reading_rad, step)
        )
    nearest = np.rint(wrap(reading_rad - phi_rad) / step).astype(np.int64) - base
    line = np.where(has_known_id, ids, np.remainder(nearest, count))
    deviation = wrap(reading_rad - (line + base) * step)
    residual = wrap(deviation - phi_rad)
    away = np.abs(residual)
    turned = abs(phi_rad) > max(rigids.LARGEST_TURN_RAD, step / 2)
    reasons[(away > step / 4) | turned] = Reason.TOO_FAR
    reasons[~has_id & (away > rules.ambiguity_ratio * (step - away))] = Reason.AMBIGUOUS
    if not rotation_known and not _nearest_line_is_sure(
        phi_rad, step, rules.max_rotation_rad
    ):
        reasons[~has_id] = Reason.ROTATION
    reasons[has_id & ~has_known_id] = Reason.UNKNOWN_MARK
    return MarkAssignment(line, deviation, residual, reasons, rigids.Rigid(phi_rad))


def _nearest_line_is_sure(
    phi_rad: float, step_rad: float, max_rotation_rad: float
) -> bool:
    """Return whether lines that are off by `phi_rad` are certainly the nearest ones.

    Lines determine a rotation only up to whole steps. The apparent rotation is the true one if
    every possible rotation is below half a step, and the apparent one is possible.
    """
    return max_rotation_rad <= HALF_A_LINE * step_rad and abs(phi_rad) <= max(
        max_rotation_rad, step_rad / 4
    )


def _middle(angles_rad: np.ndarray, period_rad: float) -> float:
    """Return the median of angles on a circle of a given period, within half a period about 0."""
    if not len(angles_rad):
        return 0.0
    turn = 2 * np.pi / period_rad
    start = np.angle(np.exp(1j * turn * angles_rad).mean()) / turn
    about_start_rad = (
        np.remainder(angles_rad - start + period_rad / 2, period_rad) - period_rad / 2
    )
    middle = start + np.median(about_start_rad)
    return float(middle - period_rad * np.rint(middle / period_rad))


def wrap(angle_rad: np.ndarray) -> np.ndarray:
    """Return angles wrapped to (-pi, pi]; angles in this range are unchanged."""
    inside = (angle_rad > -np.pi) & (angle_rad <= np.pi)
    turns = np.where(inside, 0.0, np.rint(angle_rad / (2 * np.pi)))
    return angle_rad - turns * (2 * np.pi)
