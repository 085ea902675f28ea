# SPDX-License-Identifier: Apache-2.0
"""Which mark was seen: by its id, or as the nearest nominal mark of the view."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.reasons import Reason
from selfcal_ros.collection.rigid import Rigid, fit_rigid
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

TOO_FAR_FROM_ANY = 0.75
"""Distance to the nearest mark, in pitches, beyond which a detection is of no mark at all."""


@dataclass(frozen=True)
class IdentityRules:
    """Limits of identification; see the collector's parameters of the same names."""

    max_deviation_m: float
    ambiguity_ratio: float
    max_rotation_rad: float


@dataclass(frozen=True)
class Identified:
    """Marks behind readings: indices, deviations (rows, n), and reasons where rejected."""

    index: np.ndarray
    deviation: np.ndarray
    reasons: np.ndarray
    rigid: Rigid


def identify_grid(artifact: Artifact, view: View, reading_m: np.ndarray, *, ids: np.ndarray,
                  has_id: np.ndarray, rules: IdentityRules) -> Identified:
    """Identify grid marks and return their deviations from the nominal places of the view.

    Parameters
    ----------
    artifact, view
        The plate and how it lies.
    reading_m : float array (2, n)
        Positions of the marks as read, stage frame.
    ids : int array (2, n)
        (m, n) where `has_id`.
    has_id : bool array (n,)
        Whether the detection names its mark.
    rules : IdentityRules
        Limits.
    """
    pose = view.lattice_pose(artifact)
    pitch = artifact.grid_pitch_m
    reasons = np.full(reading_m.shape[1], None, dtype=object)
    if not view.grid or pose.quarter_turns is None:
        reasons[:] = Reason.NOT_IN_VIEW
        return Identified(ids, np.zeros_like(reading_m), reasons, Rigid())
    half = np.array(artifact.half)[:, None]
    named_unknown = has_id & (np.abs(ids) > half).any(axis=0)
    marks = np.where(has_id & ~named_unknown, ids, 0)
    centred = reading_m - np.array(pose.shift)[:, None] * pitch  # about the plate's centre
    rigid = _settle_rigid(pose, centred, marks, has_id & ~named_unknown, pitch, half, rules)
    free = ~has_id
    nearest, ratio, distance = _nearest(pose, centred - _moved(rigid, centred), pitch, half)
    marks[:, free] = nearest[:, free]
    far = free & (distance > TOO_FAR_FROM_ANY * pitch)
    ambiguous = free & ~far & (ratio > rules.ambiguity_ratio)
    site = np.stack(pose.site_of(marks[0], marks[1]))
    deviation = reading_m - site * pitch
    about = (site - np.array(pose.shift)[:, None]) * pitch
    limit = min(rules.max_deviation_m, pitch / 4)
    if np.unique(marks[:, ~far & ~ambiguous], axis=1).shape[1] < 3:
        limit = pitch / 4  # too few marks to know the view's own rotation and offset
    far |= ~ambiguous & (np.hypot(*(deviation - rigid.at(about))) > limit)
    reasons[far] = Reason.TOO_FAR
    reasons[ambiguous] = Reason.AMBIGUOUS
    reasons[(np.abs(site) > half).any(axis=0)] = Reason.NOT_IN_VIEW
    reasons[named_unknown] = Reason.UNKNOWN_MARK
    return Identified(marks, deviation, reasons, rigid)


def _moved(rigid: Rigid, centred: np.ndarray) -> np.ndarray:
    """Return the misalignment at readings that already contain it (two fixed-point steps)."""
    nominal = centred - rigid.at(centred)
    return rigid.at(centred - rigid.at(nominal))


def _nearest(pose, centred: np.ndarray, pitch: float, half: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return nearest mark (2, n), distance ratio to the second nearest, and distance in m."""
    step = centred / pitch
    back = type(pose)((4 - pose.quarter_turns) % 4, (0, 0), None)
    plate = np.stack(back.site_of(step[0], step[1]))
    mark = np.clip(np.rint(plate), -half, half)
    away = np.abs(plate - mark)
    first = np.hypot(*away)
    second = np.minimum(np.hypot(1 - away[0], away[1]), np.hypot(away[0], 1 - away[1]))
    return mark.astype(np.int64), first / np.maximum(second, 1e-12), first * pitch


def _settle_rigid(pose, centred: np.ndarray, ids: np.ndarray, named: np.ndarray, pitch: float,
                  half: np.ndarray, rules: IdentityRules) -> Rigid:
    """Return the view's own motion: from named marks, or grown outwards from the centre.

    Far from the centre a misalignment in rotation may exceed half a pitch; so marks without
    ids are used only out to where the rotation known so far cannot confuse them.
    """
    if named.any():
        about = _about(pose, ids[:, named], pitch)
        return fit_rigid(about, centred[:, named] - about)
    rigid, reach = Rigid(), 0.2 * pitch / rules.max_rotation_rad
    radius = np.hypot(*centred)
    rim = radius.max(initial=0.0)
    while True:
        mark, ratio, distance = _nearest(pose, centred - _moved(rigid, centred), pitch, half)
        use = (radius <= max(reach, 2 * pitch)) & (ratio < 0.5) & (distance < 0.4 * pitch)
        about = _about(pose, mark[:, use], pitch)
        rigid = fit_rigid(about, centred[:, use] - about)
        if reach > rim:
            return rigid
        reach *= 2


def _about(pose, marks: np.ndarray, pitch: float) -> np.ndarray:
    site = np.stack(pose.site_of(marks[0], marks[1]))
    return (site - np.array(pose.shift)[:, None]) * pitch


def identify_angular(artifact: Artifact, view: View, reading_rad: np.ndarray, *, ids: np.ndarray,
                     has_id: np.ndarray, rules: IdentityRules, phi_rad: float | None,
                     ) -> Identified:
    """Identify angular lines and return their deviations, wrapped to (-pi, pi].

    Parameters
    ----------
    artifact, view
        The plate and how it lies.
    reading_rad : float array (n,)
        Directions of the lines as read, stage frame.
    ids : int array (n,)
        k where `has_id`.
    has_id : bool array (n,)
        Whether the detection names its line.
    rules : IdentityRules
        Limits.
    phi_rad : float or None
        The view's rotation where the grid marks told it.
    """
    reasons = np.full(len(reading_rad), None, dtype=object)
    count = artifact.angular_count
    if not count or not view.angular:
        reasons[:] = Reason.NOT_IN_VIEW
        return Identified(np.zeros(len(ids), int), np.zeros(len(ids)), reasons, Rigid())
    step = 2 * np.pi / count
    base = view.lattice_pose(artifact).turn_lines
    known = has_id & (ids < count)
    if phi_rad is None:
        named = wrap(reading_rad - (ids + base) * step)[known]
        free = np.remainder(reading_rad / step + 0.5, 1) * step - step / 2
        values = named if len(named) else free
        phi_rad = float(np.median(values)) if len(values) else 0.0
    nearest = np.rint(wrap(reading_rad - phi_rad) / step).astype(np.int64) - base
    line = np.where(known, ids, np.remainder(nearest, count))
    deviation = wrap(reading_rad - (line + base) * step)
    away = np.abs(wrap(deviation - phi_rad))
    reasons[away > step / 4] = Reason.TOO_FAR
    reasons[~has_id & (away > rules.ambiguity_ratio * (step - away))] = Reason.AMBIGUOUS
    reasons[has_id & ~known] = Reason.UNKNOWN_MARK
    return Identified(line, deviation, reasons, Rigid(phi_rad))


def wrap(angle_rad: np.ndarray) -> np.ndarray:
    """Return angles wrapped to (-pi, pi]; those already there keep their bits."""
    inside = (angle_rad > -np.pi) & (angle_rad <= np.pi)
    turns = np.where(inside, 0.0, np.rint(angle_rad / (2 * np.pi)))
    return angle_rad - turns * (2 * np.pi)
