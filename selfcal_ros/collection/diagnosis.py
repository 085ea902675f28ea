# SPDX-License-Identifier: Apache-2.0
"""Why most detections were rejected, in one line with the correction.

A wrong parameter or a wrong clock affects nearly all detections at once, but each is rejected for
a reason that does not name it. Here all rejections of a session are evaluated together.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np

from selfcal_ros.collection.inputs import REMEDY, Reason
from selfcal_ros.collection.marks.seen_poses import NamedMarks
from selfcal_ros.model.readings import Sense
from selfcal_ros.units import NS_PER_S

MOST = 0.5
"""Fraction of the detections above which one reason of rejection is diagnosed."""
AT_LEAST = 5
"""Smallest number of detections for a diagnosis."""
SCALES = {
    1.0: "",
    1e3: "1000 times those of the marks: they are in mm",
    1e-3: "a thousandth of those of the marks: they are in km, or their unit is unknown",
    1e6: "a million times those of the marks: they are in µm",
}
"""Indicated position over true position -> meaning."""
UNUSABLE = {
    Reason.ENCODER_MALFORMED: "give each name of a joint state its position",
    Reason.ENCODER_NOT_FINITE: "publish positions that are finite",
}
"""Encoder samples that cannot be used -> remedy."""
PLACED = (
    Reason.NOT_AT_MARK,
    Reason.TOO_FAR,
    Reason.MOVING,
    Reason.CONTRADICTION,
    Reason.NOT_IN_VIEW,
    Reason.AMBIGUOUS,
    Reason.OUTLIER,
    Reason.ROTATION,
)
"""Reasons possibly caused by a stage away from all marks."""

UNSTAMPED = (
    "stamped 0: fill in header.stamp, with the instant of the exposure or reading; a node with "
    "use_sim_time that hears no /clock stamps 0 too"
)
Span = tuple[int, int] | None
STOPPED = 20
"""Number of the last marks of a view at all of which a stage that no longer moves is indicated at
one place."""


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
    marks : tuple of NamedMarks
        Grid marks with ids, of each view.
    pitch_m, limit_m : float
        Distance between marks, and largest distance of the stage from a mark's site.
    sense : Sense
        Sense of measurement.
    lies : str
        Pose of the plate, or what the ids are, and remedy, if the marks are not seen as planned.
    joints : bool
        Whether the joints may be wrong: no view is seen as planned.
    late : str
        When the stage rests at the marks, and remedy, if not at the stamps of the detections.
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
    marks: tuple[NamedMarks, ...] = ()
    pitch_m: float = 0.0
    limit_m: float = 0.0
    sense: Sense = Sense.MICROSCOPE_MOVES
    lies: str = ""
    joints: bool = True
    late: str = ""


@dataclass(frozen=True)
class RejectionFinding:
    """A reason for which many detections were rejected, or none as yet: counts, cause, remedy."""

    reason: str
    count: int
    total: int
    text: str

    def __str__(self) -> str:
        """Return it as one line."""
        if not self.count:
            return self.text
        return (
            f"{self.count} of {self.total} detections were rejected as {self.reason}: "
            f"{self.text}"
        )


def main_reason(
    rejected: Mapping[str, int], used: int, *, placed: bool = False
) -> tuple[str, int, int] | None:
    """Return the reason of most rejections, its count, and the total considered; or None.

    Detections of other runs and plans, redone views, and duplicates are not faults. `placed`:
    whether all reasons of `PLACED` have one cause, and count together.
    """
    bad = {reason: count for reason, count in rejected.items() if reason in REMEDY}
    total = used + sum(bad.values())
    if total < AT_LEAST or not bad:
        return None
    reason = max(sorted(bad), key=lambda name: bad[name])
    count = (
        sum(bad.get(placed_reason, 0) for placed_reason in PLACED)
        if placed and reason in PLACED
        else bad[reason]
    )
    return (reason, count, total) if count > MOST * total else None


def diagnose(evidence: Evidence) -> RejectionFinding | None:
    """Return why most of the detections were rejected; None if no reason dominates."""
    main = main_reason(
        evidence.rejected, evidence.used, placed=bool(evidence.lies or evidence.late)
    )
    if main is None:
        return None
    reason, count, total = main
    cause = None
    if reason == Reason.NO_ENCODER:
        cause = (
            _joints(evidence)
            or _unstamped(
                {
                    "detections": evidence.detections_ns,
                    "encoder samples": evidence.encoder_ns,
                }
            )
            or _clock(evidence)
            or _rate(evidence)
        )
    elif reason == Reason.OUTSIDE_VIEWS:
        cause = _unstamped(
            {
                "detections": evidence.detections_ns,
                "view commands": evidence.commands_ns,
            }
        ) or _command_clock(evidence)
    elif reason in PLACED:
        cause = _stage(evidence, reason)
    return RejectionFinding(reason, count, total, cause or REMEDY[Reason(reason)])


def _joints(e: Evidence) -> str | None:
    if not e.missing_joints:
        return None
    for reason, remedy in UNUSABLE.items():
        if e.rejected.get(reason) and not e.seen_joints:
            return (
                f"no encoder sample came that can be used, {e.rejected[reason]} were rejected "
                f"as {reason}; {remedy}"
            )
    received = ", ".join(repr(name) for name in e.seen_joints) or "none"
    missing = ", ".join(repr(name) for name in e.missing_joints)
    return (
        f"no encoder sample of the joint {missing} arrived; joints received: {received}; set "
        "joint_x, joint_y, joint_theta"
    )


def _unstamped(span_of_message: Mapping[str, Span]) -> str | None:
    """Return which messages are all stamped 0; None if none are."""
    names = [name for name, span in span_of_message.items() if span == (0, 0)]
    return f"the {' and the '.join(names)} are {UNSTAMPED}" if names else None


def _clock(e: Evidence) -> str | None:
    if e.detections_ns is None or e.encoder_ns is None:
        return None
    (first, last), (begin, end) = e.detections_ns, e.encoder_ns
    if first <= end and last >= begin:
        return None
    offset = (last - end) / NS_PER_S
    return (
        f"the detections are stamped about {_seconds(offset)} "
        f"{'after' if offset > 0 else 'before'} the encoder samples; stamp both by one "
        "clock"
    )


def _rate(e: Evidence) -> str | None:
    if not e.encoder_step_s > e.max_gap_s:
        return None
    return (
        f"the encoder sends a sample every {e.encoder_step_s:.3g} s, and max_encoder_gap is "
        f"{e.max_gap_s:g} s; send them more often, or raise max_encoder_gap"
    )


def _command_clock(e: Evidence) -> str | None:
    if e.detections_ns is None or e.commands_ns is None:
        return None
    (first, last), (begin, end) = e.detections_ns, e.commands_ns
    if first <= end and last >= begin:
        return None
    offset = (first - begin if last < begin else last - end) / NS_PER_S
    return (
        f"all detections are stamped {'before the first' if offset < 0 else 'after the last'} "
        f"view command, about {_seconds(offset)} off; synchronise the clocks of the cell and "
        "the sequencer"
    )


def _seconds(offset_s: float) -> str:
    return f"{abs(offset_s):.0f} s" if abs(offset_s) >= 10 else f"{abs(offset_s):.2g} s"


def _stage(e: Evidence, reason: str) -> str | None:
    """Return why the stage is away from the marks; None if it is not or unknown."""
    elsewhen = _encoder_stopped(e) or e.late
    if elsewhen:
        return elsewhen
    joints = wrong_joints(e) if e.joints else None
    if e.lies and len(e.marks) == 1:
        return "; or, if it lies as planned: ".join(filter(None, (e.lies, joints)))
    if joints or e.lies:
        return "; or, if the joints are right: ".join(filter(None, (joints, e.lies)))
    away = _away(e, lambda stage: stage)
    if away <= e.limit_m or reason == Reason.CONTRADICTION:  # of which place?
        return None
    where = np.concatenate([view.stage for view in e.marks]) * e.pitch_m
    middle = complex(np.median(where.real), np.median(where.imag))
    if np.quantile(np.abs(where - middle), 0.9) < e.pitch_m / 4:
        return (
            f"the stage did not move: it is indicated at {_place(e, middle)} at all of them; "
            "name the joints that move, in joint_x and joint_y"
        )
    check = "joint_x and joint_y, " if e.joints else ""
    return (
        f"the stage stands {away:.3g} m from the sites of the detected marks (median); "
        f"check {check}the ids of the marks and how the plate lies"
    )


def _encoder_stopped(e: Evidence) -> str | None:
    """Return that the encoder stands still since some mark, and was at the marks before.

    One whose stamps are late is at none of them, and at rest where the view has ended.
    """
    for view in e.marks:
        stage, sites = view.stage, view.sites
        from_last = np.abs(stage - stage[-1:])
        elsewhere = np.flatnonzero(from_last > 1 / 4)
        if not len(elsewhere) or from_last.max() <= 1 / 2:
            continue
        moved = slice(elsewhere[-1] + 1)
        last = slice(-STOPPED, None)
        still = len(stage) - moved.stop >= STOPPED
        off_sites_m = np.abs(stage + view.cells - sites)[moved] * e.pitch_m
        was_at_marks = np.median(off_sites_m) <= e.limit_m
        if still and was_at_marks and np.abs(sites - sites[-1])[last].max() > 1:
            return (
                f"the stage has stopped: it is indicated at {_place(e, stage[-1] * e.pitch_m)} "
                f"at each of the last {STOPPED} marks; check the encoder and what publishes "
                "its joints"
            )
    return None


def _place(e: Evidence, stage_m: complex) -> str:
    """Return where the stage is indicated, from its place in the sense of the measurement."""
    at = e.sense.sign * stage_m
    return f"x = {at.real:.6g} m, y = {at.imag:.6g} m"


def wrong_joints(e: Evidence) -> str | None:
    """Return the fault of the joints without which the stage is at the marks of all views."""
    if not _away(e, lambda stage: stage) > e.limit_m:
        return None
    for scale, swapped, signs in product(
        SCALES, (False, True), ((1, 1), (-1, -1), (-1, 1), (1, -1))
    ):

        def tried(
            stage: np.ndarray,
            scale: float = scale,
            swapped: bool = swapped,
            signs: tuple[int, int] = signs,
        ) -> np.ndarray:
            x, y = (stage.imag, stage.real) if swapped else (stage.real, stage.imag)
            return (signs[0] * x + 1j * signs[1] * y) / scale

        if _away(e, tried) <= e.limit_m:
            return fault_text(scale, swapped=swapped, signs=signs, sense=e.sense)
    return None


def _away(e: Evidence, changed: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the largest median distance of a view's marks from their sites, m; 0 if unknown."""
    sites = np.concatenate(
        [view.sites for view in e.marks] or [np.zeros(0, dtype=complex)]
    )
    if len(sites) < AT_LEAST or min(np.ptp(sites.real), np.ptp(sites.imag)) < 1:
        return 0.0
    return max(view.away(changed(view.stage)) for view in e.marks) * e.pitch_m


def fault_text(
    scale: float, *, swapped: bool, signs: tuple[int, int], sense: Sense
) -> str:
    """Return the fault and the remedy for a combination that fits."""
    faults, remedy = [], []
    if SCALES[scale]:
        faults.append(f"the indicated positions are {SCALES[scale]}")
        remedy.append("publish joint positions in metres")
    if swapped:
        faults.append("x and y are exchanged")
        remedy.append("exchange joint_x and joint_y")
    if signs == (-1, -1):
        other_sense = next(s for s in Sense if s is not sense)
        faults.append("the stage is indicated at minus the marks' sites")
        remedy.append(
            f"the sense is reversed: measurement_sense {other_sense} (--sense {other_sense})"
        )
    elif signs != (1, 1):
        axis = "x" if signs == (-1, 1) else "y"
        faults.append(f"{axis} is indicated with the wrong sign")
        remedy.append(f"reverse the sign of {axis}")
    return f"{' and '.join(faults)}; {', and '.join(remedy)}"
