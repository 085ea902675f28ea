# SPDX-License-Identifier: Apache-2.0
"""Why most detections were rejected, in one line with the correction.

A wrong parameter or a wrong clock affects nearly all detections at once, but each is rejected for
a reason that does not name it. Here all rejections of a session are evaluated together.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import product

import numpy as np

from selfcal_ros.collection.exposures import Exposures
from selfcal_ros.collection.inputs import REMEDY, Kind, Reason
from selfcal_ros.collection.marks.identify import IdentityRules
from selfcal_ros.collection.marks.stops import places_of_cells
from selfcal_ros.estimation.checks.placing import Misplaced, other_poses, said
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense, ViewReadings
from selfcal_ros.units import NS_PER_S

MOST = 0.5
"""Fraction of the detections above which one reason of rejection is diagnosed."""
AT_LEAST = 5
"""Smallest number of detections for a diagnosis."""
SCALES = {1.0: "", 1e3: "1000 times what the marks ask for: they are in mm",
          1e-3: "a thousandth of what the marks ask for: they are in km, or their unit is unknown",
          1e6: "a million times what the marks ask for: they are in µm"}
"""Indicated position over true position -> meaning."""
PLACED = (Reason.NOT_AT_MARK, Reason.TOO_FAR, Reason.MOVING, Reason.CONTRADICTION,
          Reason.NOT_IN_VIEW, Reason.AMBIGUOUS, Reason.OUTLIER, Reason.ROTATION)
"""Reasons possibly caused by a stage away from all marks."""

Span = tuple[int, int] | None
LOOKED_AT = 2000
"""Number of the last detections whose stage positions are examined."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Facts on the detections of a view, or of a session.

    Attributes
    ----------
    rejected : dict
        Reason -> number of detections.
    used : int
        Detections that became readings.
    missing_joints, seen_joints : tuple of str
        Names of needed joints without any sample, and other names in the encoder messages.
    detections_ns, encoder_ns, commands_ns : tuple of int or None
        First and last stamp of each.
    encoder_step_s, max_gap_s : float
        Usual time between encoder samples (NaN = unknown), and the largest allowed.
    stage_m, site_m : float array (2, n)
        Indicated positions at grid detections with ids, and the nominal sites of their marks.
    pitch_m, limit_m : float
        Distance between marks, and largest distance of the stage from a mark's site.
    sense : Sense
        Sense of measurement.
    lies : str
        Actual pose of the plate, and remedy, if the ids of the marks show another pose than
        planned.
    alone : bool
        Whether no other view tells a wrong pose from wrong joints.
    """

    rejected: Mapping[str, int]
    used: int
    missing_joints: tuple[str, ...] = ()
    seen_joints: tuple[str, ...] = ()
    detections_ns: Span = None
    encoder_ns: Span = None
    commands_ns: Span = None
    encoder_step_s: float = float("nan")
    max_gap_s: float = 0.0
    stage_m: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))
    site_m: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))
    pitch_m: float = 0.0
    limit_m: float = 0.0
    sense: Sense = Sense.MICROSCOPE_MOVES
    lies: str = ""
    alone: bool = False


@dataclass(frozen=True)
class RejectionFinding:
    """A reason for which most detections were rejected: counts, cause and remedy."""

    reason: str
    count: int
    total: int
    text: str

    def __str__(self) -> str:
        """Return it as one line."""
        return (f"{self.count} of {self.total} detections were rejected as {self.reason}: "
                f"{self.text}")


def main_reason(rejected: Mapping[str, int], used: int) -> tuple[str, int, int] | None:
    """Return the reason of most rejections, its count, and the total considered; or None.

    Detections of other runs and plans, redone views, and duplicates are not faults.
    """
    bad = {reason: count for reason, count in rejected.items() if reason in REMEDY}
    total = used + sum(bad.values())
    if total < AT_LEAST or not bad:
        return None
    reason = max(sorted(bad), key=lambda name: bad[name])
    return (reason, bad[reason], total) if bad[reason] > MOST * total else None


def diagnose(evidence: Evidence) -> RejectionFinding | None:
    """Return why most of the detections were rejected; None if no reason dominates."""
    found = main_reason(evidence.rejected, evidence.used)
    if found is None:
        return None
    reason, count, total = found
    cause = None
    if reason == Reason.NO_ENCODER:
        cause = _joints(evidence) or _clock(evidence) or _rate(evidence)
    elif reason == Reason.OUTSIDE_VIEWS:
        cause = _command_clock(evidence)
    elif reason in PLACED:
        cause = "; or, if it lies as planned: ".join(filter(None, (
            evidence.lies, _stage(evidence) if evidence.alone or not evidence.lies else None)))
    return RejectionFinding(reason, count, total, cause or REMEDY[Reason(reason)])


def _joints(e: Evidence) -> str | None:
    if not e.missing_joints:
        return None
    seen = ", ".join(repr(name) for name in e.seen_joints) or "none"
    missing = ", ".join(repr(name) for name in e.missing_joints)
    return (f"no encoder sample of the joint {missing} came; names that came: {seen}; set joint_x, "
            "joint_y, joint_theta")


def _clock(e: Evidence) -> str | None:
    if e.detections_ns is None or e.encoder_ns is None:
        return None
    (first, last), (begin, end) = e.detections_ns, e.encoder_ns
    if first <= end and last >= begin:
        return None
    offset = (last - end) / NS_PER_S
    return (f"the detections are stamped about {_seconds(offset)} "
            f"{'after' if offset > 0 else 'before'} the encoder samples; let both be stamped by "
            "one clock")


def _rate(e: Evidence) -> str | None:
    if not e.encoder_step_s > e.max_gap_s:
        return None
    return (f"the encoder sends a sample every {e.encoder_step_s:.3g} s, and max_encoder_gap is "
            f"{e.max_gap_s:g} s; send more, or raise max_encoder_gap")


def _command_clock(e: Evidence) -> str | None:
    if e.detections_ns is None or e.commands_ns is None:
        return None
    (first, last), (begin, end) = e.detections_ns, e.commands_ns
    if first <= end and last >= begin:
        return None
    offset = (first - begin if last < begin else last - end) / NS_PER_S
    return (f"all detections are stamped {'before the first' if offset < 0 else 'after the last'} "
            f"view command, about {_seconds(offset)} off; let the cell and the sequencer have one "
            "clock")


def _seconds(offset_s: float) -> str:
    return f"{abs(offset_s):.0f} s" if abs(offset_s) >= 10 else f"{abs(offset_s):.2g} s"


def _stage(e: Evidence) -> str | None:
    """Return why the stage is away from the marks; None if it is not or unknown."""
    where = e.stage_m * (-1 if e.sense is Sense.PLATE_MOVES else 1)
    if where.shape[1] < AT_LEAST or (np.ptp(e.site_m, axis=1) < e.pitch_m).any():
        return None
    if _away(where, e) <= e.limit_m:
        return None
    for scale, swapped, signs in product(SCALES, (False, True), ((1, 1), (-1, -1), (-1, 1),
                                                                 (1, -1))):
        tried = (where[::-1] if swapped else where) * np.array(signs)[:, None] / scale
        if _away(tried, e) <= e.limit_m:
            return _said(scale, swapped=swapped, signs=signs, sense=e.sense)
    middle = np.median(where, axis=1)
    if np.quantile(np.hypot(*(where - middle[:, None])), 0.9) < e.pitch_m / 4:
        return (f"the stage did not move: it is indicated at x = {middle[0]:.6g} m, y = "
                f"{middle[1]:.6g} m at all of them; name the joints that move, in joint_x and "
                "joint_y")
    return (f"the stage stands {_away(where, e):.3g} m from the sites of the marks that are seen "
            "(median); check joint_x and joint_y, the ids of the marks and how the plate lies")


def _away(where: np.ndarray, e: Evidence) -> float:
    """Return the median distance from the sites, for marks away from the centre."""
    outer = np.hypot(*e.site_m) > e.pitch_m / 4
    return float(np.median(np.hypot(*(where - e.site_m))[outer]))


def _said(scale: float, *, swapped: bool, signs: tuple[int, int], sense: Sense) -> str:
    """Return the fault and the remedy for a combination that fits."""
    what, remedy = [], []
    if SCALES[scale]:
        what.append(f"the indicated positions are {SCALES[scale]}")
        remedy.append("publish joint positions in metres")
    if swapped:
        what.append("x and y are exchanged")
        remedy.append("exchange joint_x and joint_y")
    if signs == (-1, -1):
        other = next(s for s in Sense if s is not sense)
        what.append("the stage is indicated at minus the marks' sites")
        remedy.append(f"the sense is the other one: measurement_sense {other} (--sense {other})")
    elif signs != (1, 1):
        axis = "x" if signs == (-1, 1) else "y"
        what.append(f"{axis} is indicated with the wrong sign")
        remedy.append(f"turn the sign of {axis}")
    return f"{' and '.join(what)}; {', and '.join(remedy)}"


@dataclass(frozen=True)
class EncoderFacts:
    """Summary of the encoder messages.

    Attributes
    ----------
    names : dict
        Axis -> name of its joint.
    sampled : dict
        Axis -> whether it has samples.
    foreign : tuple of str
        Other joint names received.
    span_ns : tuple of int or None
        First and last stamp.
    step_s, max_gap_s : float
        Usual time between samples of x, NaN if unknown, and the largest allowed.
    """

    names: Mapping[str, str]
    sampled: Mapping[str, bool]
    foreign: tuple[str, ...]
    span_ns: Span
    step_s: float
    max_gap_s: float


@dataclass(frozen=True)
class DetectionsSeen:
    """All detections of a session with the stage at their exposures.

    Attributes
    ----------
    table : structured array of `reduce.DETECTION`
        The detections.
    view_of : int array
        View of each, -1 for none.
    exposures : Exposures
        The stage at their instants.
    encoder : callable
        Returns the `EncoderFacts`; called only if there is a fault.
    commands_ns : tuple of int
        First and last stamp of the commands.
    artifact : Artifact
        The plate.
    rules : IdentityRules
        Limits of identification.
    sense : Sense
        Sense of measurement.
    """

    table: np.ndarray
    view_of: np.ndarray
    exposures: Exposures
    encoder: Callable[[], EncoderFacts]
    commands_ns: Span
    artifact: Artifact
    rules: IdentityRules
    sense: Sense

    def findings(self, views: Mapping[int, ViewReadings], loose: Mapping[str, int],
                 ) -> dict[int | None, RejectionFinding]:
        """Return why most detections of the session (key None), or of single views, were rejected.

        Parameters
        ----------
        views : dict
            view_index -> readings.
        loose : dict
            Reason -> detections that belong to no view.
        """
        rejected = dict(loose)
        for readings in views.values():
            for reason, count in readings.rejected.items():
                rejected[reason] = rejected.get(reason, 0) + count
        used = sum(readings.used for readings in views.values())
        whole = self._finding(rejected, used, views, whole=True)
        if whole is not None:
            return {None: whole}
        found = {index: self._finding(readings.rejected, readings.used, {index: readings})
                 for index, readings in views.items()}
        return {index: finding for index, finding in found.items() if finding is not None}

    def _finding(self, rejected: Mapping[str, int], used: int, views: Mapping[int, ViewReadings], *,
                 whole: bool = False) -> RejectionFinding | None:
        if main_reason(rejected, used) is None:
            return None
        here = np.isin(self.view_of, list(views))
        rows = np.flatnonzero(here if here.any() else np.ones(len(here), dtype=bool))
        table, encoder = self.table[rows], self.encoder()
        kinds = {"x": Kind.GRID, "y": Kind.GRID, "theta": Kind.ANGULAR}
        missing = tuple(encoder.names[axis] for axis, kind in kinds.items()
                        if not encoder.sampled[axis] and (table["kind"] == kind).any())
        came = (*(name for axis, name in encoder.names.items() if encoder.sampled[axis]),
                *encoder.foreign)
        stage, site = self._stage_and_sites(rows[-LOOKED_AT:], views)
        # if all views are affected the sense may be wrong: it looks like half a turn
        alone = whole and len(views) == 1
        lies = self._lies(rows[-LOOKED_AT:], views) if alone or not whole else ""
        return diagnose(Evidence(
            rejected, used, missing, came, _span(table["stamp"]), encoder.span_ns,
            self.commands_ns, encoder.step_s, encoder.max_gap_s, stage, site,
            self.artifact.grid_pitch_m, self.rules.stage_limit_m(self.artifact), self.sense, lies,
            alone))

    def _lies(self, rows: np.ndarray, views: Mapping[int, ViewReadings]) -> str:
        """Return the actual pose of a view's plate, if its marks match another pose."""
        ((_, readings),) = views.items()
        table, view = self.table[rows], readings.view
        if not view.grid:
            return ""
        stage, limit = self.exposures.at(table["stamp"]), self.rules.stage_limit_m(self.artifact)
        where = np.stack([stage.x.position, stage.y.position])
        where *= -1 if self.sense is Sense.PLATE_MOVES else 1
        good = (table["kind"] == Kind.GRID) & table["has_id"] & np.isfinite(where).all(axis=0)
        if self.artifact.marks:
            good &= self.artifact.has(table["m"], table["n"])
        places = np.zeros((2, len(table)))
        places[:, good] = self.artifact.places(table["m"][good], table["n"][good])
        where += places_of_cells(view, np.stack([table["ox"], table["oy"]]))
        pose = view.on_stage(self.artifact)
        away = []
        for other in (pose, *other_poses(pose)):
            site = np.stack(other.site_of(*places)) * self.artifact.grid_pitch_m
            away.append(np.quantile(np.hypot(*(where - site))[good], 0.9) if good.any() else np.inf)
        best = int(np.argmin(away))
        if not best or away[best] > limit:
            return ""
        error = said(Misplaced.of(view.name, pose, [*other_poses(pose)][best - 1]))
        return f"{error.what}; {error.remedy}"

    def _stage_and_sites(self, rows: np.ndarray, views: Mapping[int, ViewReadings],
                         ) -> tuple[np.ndarray, np.ndarray]:
        """Return indicated positions and sites, both (2, n), of grid marks with ids."""
        table, view_of = self.table[rows], self.view_of[rows]
        pitch = self.artifact.grid_pitch_m
        stage = self.exposures.at(table["stamp"])
        where = np.stack([stage.x.position, stage.y.position])
        good = (table["kind"] == Kind.GRID) & table["has_id"] & np.isfinite(where).all(axis=0)
        good &= self.artifact.has(table["m"], table["n"])
        parts = [np.zeros((4, 0))]
        for index, readings in views.items():
            here = good & (view_of == index)
            if here.any() and readings.view.grid:
                pose = readings.view.on_stage(self.artifact)
                marks = self.artifact.places(table["m"][here], table["n"][here])
                site = np.stack(pose.site_of(*marks)) * pitch
                offset = np.stack([table["ox"][here], table["oy"][here]])
                site = site - places_of_cells(readings.view, offset)
                parts.append(np.concatenate([where[:, here], site]))
        both = np.concatenate(parts, axis=1)
        return both[:2], both[2:]


def _span(stamps_ns: Iterable[int]) -> Span:
    stamps = np.asarray(stamps_ns)
    return (int(stamps.min()), int(stamps.max())) if len(stamps) else None
