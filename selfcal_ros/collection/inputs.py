# SPDX-License-Identifier: Apache-2.0
"""The inputs of a calibration, without middleware, and the reasons of rejection.

The content of messages is validated here, before memory is allocated for it. Stamps are integer
nanoseconds.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from enum import IntEnum, StrEnum

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.plan_form import MAX_VIEWS
from selfcal_ros.model.readings import REPEAT_OUTLIER, GridVisits, ViewReadings
from selfcal_ros.model.view import View
from selfcal_ros.topics import MEASUREMENT_TOPIC
from selfcal_ros.units import NS_PER_S

MAX_REPEATS = 1_000_000
"""Largest number of repeats of a mark in a view."""
SITES_A_MARK = 1000
"""Number of sites per mark read above which a plate cannot be calibrated."""
LARGEST, LARGEST_OFFSET = 1e3, 100.0
"""Largest valid deviation or uncertainty, and offset of a single detection, m or rad: with a
stage off by up to 10 m, deviations stay below the former."""
SMALLEST_SIGMA = 1e-12
"""Smallest valid standard uncertainty of a detection, m or rad; 0 = unknown."""
SMALLEST_U = SMALLEST_SIGMA / math.sqrt(MAX_REPEATS)
"""The same for a mean."""
SIGMA_SPAN = 1e4
"""Smallest ratio of a declared sigma to the median of its view: a reading of larger weight would
dominate the map."""
MAX_AHEAD_NS = 60 * NS_PER_S
"""Largest lead of a stamp over the clock of the receiving node: beyond, it would hide
later messages stamped by a correct clock."""
MAX_TEXT = 8192
"""Largest length of the texts that name a plan and a run: nodes keep them."""
MAX_EXPOSURES = 5_000_000
"""Largest number of exposures of a view in the simulated cell: 240 MB."""
DETECTED = {
    "kind": "u1",
    "has_id": "?",
    "m": "i8",
    "n": "i8",
    "k": "i8",
    "offset_x": "f8",
    "offset_y": "f8",
    "offset_theta": "f8",
    "sigma": "f8",
    "score": "f8",
}
"""Fields of selfcal_msgs/MarkDetection below its header -> numpy type."""
DETECTION = np.dtype([("stamp", "i8"), *DETECTED.items()])
"""Many detections as a table: fields as in `Detection`."""


class Kind(IntEnum):
    """Kind of a detection; values of selfcal_msgs/MarkDetection."""

    GRID = 0
    ANGULAR = 1


class Phase(IntEnum):
    """Phase of a command; values of selfcal_msgs/ViewCommand."""

    PLACE = 0
    MEASURE = 1
    DONE = 2
    ABORT = 3


@dataclass(frozen=True, slots=True)
class EncoderSample:
    """Indicated positions of some joints at one instant: m, rad, m/s, rad/s."""

    stamp_ns: int
    names: tuple[str, ...]
    positions: tuple[float, ...]
    velocities: tuple[float, ...] = ()

    @property
    def by_joint(self) -> dict[str, float]:
        """Joint -> its position."""
        return dict(zip(self.names, self.positions, strict=False))


@dataclass(frozen=True)
class EncoderBlock:
    """Encoder samples of the same joints.

    Attributes
    ----------
    stamps_ns : int64 array (n,)
        Stamps of the headers.
    names : tuple of str
        Joints, as named in the messages.
    positions : float array (n, j)
        Indicated positions, m or rad; j differs from the number of names in malformed messages.
    velocities : float array (n, i) or None
        m/s or rad/s; None if not in the messages.
    """

    stamps_ns: np.ndarray
    names: tuple[str, ...]
    positions: np.ndarray
    velocities: np.ndarray | None

    @classmethod
    def of(cls, samples: Sequence[EncoderSample]) -> "EncoderBlock":
        """Return samples of the same joints as a block."""
        velocities = [sample.velocities for sample in samples]
        return cls(
            np.array([sample.stamp_ns for sample in samples]),
            samples[0].names,
            np.array([sample.positions for sample in samples], dtype=float),
            np.array(velocities, dtype=float) if velocities[0] else None,
        )

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class Detection:
    """One detected mark; fields as in selfcal_msgs/MarkDetection (m, rad, stage axes)."""

    stamp_ns: int
    kind: int
    has_id: bool
    m: int
    n: int
    k: int
    offset_x: float
    offset_y: float
    offset_theta: float
    sigma: float
    score: float

    def as_table(self) -> np.ndarray:
        """Return it as a table of one row, structured array (1,) of `DETECTION`."""
        return np.array([astuple(self)], dtype=DETECTION)


@dataclass(frozen=True, slots=True)
class Command:
    """One view command. `artifact` and `view` are None for DONE and ABORT.

    `model_terms` are the terms of the plan to be estimated with the map, as text; `artifact_from`
    is the result that made the plate known, `verify` that whose correction is on.
    """

    stamp_ns: int
    phase: Phase
    plan_id: str
    view_index: int = 0
    view: View | None = None
    artifact: Artifact | None = None
    views_planned: int = 0
    run_id: str = ""
    model_terms: tuple[str, ...] = ()
    artifact_from: str = ""
    verify: str = ""

    def placed(self) -> View:
        """Return the view of a PLACE or MEASURE.

        Raises
        ------
        ValueError
            For a command without one.
        """
        if self.view is None:
            raise ValueError(f"{self.phase.name} names no view")
        return self.view

    def plate(self) -> Artifact:
        """Return the plate of a PLACE or MEASURE.

        Raises
        ------
        ValueError
            For a command without one.
        """
        if self.artifact is None:
            raise ValueError(f"{self.phase.name} names no plate")
        return self.artifact


def begun_ns(run_id: str) -> int | None:
    """Return the beginning of a run from its name; None if the name is not a stamp."""
    return (
        int(run_id)
        if run_id.isascii() and run_id.isdecimal() and len(run_id) <= 20
        else None
    )


def check_command(command: Command) -> None:
    """Raise InputError for an impossible command.

    It has an impossible pose, asks for no marks, or contains an absurd number.
    """
    where = f"view command {command.view_index}"
    if (
        not 0 <= command.view_index <= MAX_VIEWS
        or not 0 <= command.views_planned <= MAX_VIEWS
    ):
        raise InputError(
            where, f"a plan has at most {MAX_VIEWS} views", "correct the view_index"
        )
    if len(command.plan_id) + len(command.run_id) > MAX_TEXT:
        raise InputError(
            where,
            f"plan_id and run_id are longer than {MAX_TEXT} characters",
            "shorten plan_id; let run_id be a stamp",
        )
    begun = begun_ns(command.run_id)
    if begun is not None and begun > command.stamp_ns:
        raise InputError(
            where,
            f"its run {command.run_id} begins after its own stamp",
            "let run_id be the stamp of the run's first command, ns",
        )
    if command.view is None or command.artifact is None:
        if command.phase in (Phase.PLACE, Phase.MEASURE):
            raise InputError(
                where, "it describes no view", "fill in its pose and its plate"
            )
        return
    if not (command.view.grid or command.view.angular):
        raise InputError(
            where, "neither grid nor angular marks are requested", "set one to true"
        )
    if not 1 <= command.view.repeats <= MAX_REPEATS:
        raise InputError(
            where, f"{command.view.repeats} repeats", f"ask for 1 to {MAX_REPEATS}"
        )
    command.view.on_stage(command.artifact)
    command.view.require_check_stops(command.artifact)


def check_view(readings: ViewReadings, artifact: Artifact, view_index: int) -> None:
    """Raise InputError for invalid readings of a view, or of marks that do not exist."""
    where = f"{MEASUREMENT_TOPIC} of '{readings.view.name}'"
    if not 0 <= view_index <= MAX_VIEWS:
        raise InputError(
            where, f"a plan has at most {MAX_VIEWS} views", "correct the view_index"
        )
    readings.view.on_stage(artifact)
    limits = [("k", readings.k, 0, artifact.angular_count - 1)]
    if artifact.marks is None:
        limits[:0] = [
            (name, index, *ends)
            for name, index, ends in zip(
                "mn", (readings.m, readings.n), artifact.limits, strict=True
            )
        ]
    elif not artifact.has(readings.m, readings.n).all():
        raise InputError(
            where, "an id that is not in the list of marks", "correct the publisher"
        )
    for name, index, least, most in limits:
        if len(index) and not least <= np.min(index) <= np.max(index) <= most:
            raise InputError(
                where, f"{name} goes beyond {least} to {most}", "correct the publisher"
            )
    _check_values(
        where,
        readings,
        ("dx", "dy", "dtheta"),
        ("u", "u_theta", "sigma_xy", "sigma_theta"),
    )
    if not abs(readings.axis_theta) <= np.pi:
        raise InputError(where, "axis_theta is not an angle", "give rad")
    if readings.visits is not None:
        _check_values(
            f"{where}, visits",
            readings.visits,
            ("dx", "dy", "offset_x", "offset_y"),
            ("u", "sigma_m"),
        )
        if np.min(readings.visits.count) < 1:
            raise InputError(
                f"{where}, visits", "a count below 1", "correct the publisher"
            )


def good_sigmas(sigma: np.ndarray) -> np.ndarray:
    """Return which sigmas of a view's detections of one kind are usable, bool array (n,).

    A collector accepts no others, so that a solver can use its output.
    """
    in_range = (sigma >= SMALLEST_SIGMA) & (sigma <= LARGEST)
    least = np.median(sigma[in_range]) / SIGMA_SPAN if in_range.any() else 0.0
    return (sigma == 0) | (in_range & (sigma >= least))


def _check_values(
    where: str,
    table: ViewReadings | GridVisits,
    required: Iterable[str],
    perhaps: Iterable[str],
) -> None:
    """Raise InputError for values that are too large, or NaN where required."""
    for name in (*required, *perhaps):
        size = np.abs(getattr(table, name))
        if np.any(size > LARGEST) or (name in required and np.isnan(size).any()):
            raise InputError(
                where, f"{name} is not a number up to {LARGEST:g}", "give m and rad"
            )
        if name in ("u", "u_theta") and np.any((size > 0) & (size < SMALLEST_U)):
            raise InputError(where, f"{name} is below {SMALLEST_U:g}", "give m and rad")


def check_plate(artifact: Artifact, views: Iterable[ViewReadings]) -> None:
    """Raise InputError for a plate that is too large for the marks read."""
    marks = sum(len(view.m) for view in views)
    sites = math.prod(artifact.shape)
    if sites > SITES_A_MARK * (1 + marks):
        raise InputError(
            MEASUREMENT_TOPIC,
            f"{marks} readings of a plate with {sites} marks",
            "correct grid_size, or measure more of it",
        )


def check_simulated(command: Command) -> None:
    """Raise InputError for an impossible view, or one too large for a simulated cell."""
    check_command(command)
    view, artifact = command.view, command.artifact
    if view is None or artifact is None:
        return  # DONE or ABORT: nothing to simulate
    exposures = max(math.prod(artifact.shape), artifact.angular_count) * view.repeats
    if exposures > MAX_EXPOSURES:
        raise InputError(
            f"view command {command.view_index}",
            f"{exposures} exposures exceed the {MAX_EXPOSURES} of a simulated cell",
            "ask for fewer marks, repeats",
        )


class Reason(StrEnum):
    """Reasons of rejection; those of encoder samples start with ``encoder_sample``."""

    NO_ENCODER = "no_encoder_sample_near"
    MOVING = "stage_moving"
    OUTSIDE_VIEWS = "outside_every_view"
    SUPERSEDED = "superseded_by_redo"
    OTHER_PLAN = "other_plan"
    OTHER_RUN = "other_run"
    CONTRADICTION = "encoder_contradiction"
    NOT_FINITE = "not_finite"
    BAD_SIGMA = "sigma_out_of_range"
    UNKNOWN_KIND = "unknown_kind"
    UNKNOWN_MARK = "unknown_mark"
    NOT_IN_VIEW = "mark_not_in_view"
    AMBIGUOUS = "ambiguous_mark"
    ROTATION = "rotation_not_known"
    TOO_FAR = "too_far_from_nominal"
    NOT_AT_MARK = "stage_not_at_mark"
    OUTSIDE_IMAGE = "outside_the_image"
    SEVERAL = "other_mark_of_one_exposure"
    LOW_SCORE = "low_score"
    DUPLICATE = "duplicate"
    OUTLIER = REPEAT_OUTLIER
    ENCODER_UNKNOWN_JOINT = "encoder_sample_unknown_joint"
    ENCODER_NOT_FINITE = "encoder_sample_not_finite"
    ENCODER_MALFORMED = "encoder_sample_malformed"
    ENCODER_FUTURE = "encoder_sample_from_the_future"
    COMMAND_BAD = "command_unusable"
    COMMAND_FUTURE = "command_from_the_future"
    FUTURE = "from_the_future"


ADVICE = {
    Reason.ROTATION: "the view's rotation is not known well enough to tell these marks or lines "
    "from their neighbours; give the detections ids, or measure grid marks in the "
    "same view, or state a max_rotation of less than half a line",
    Reason.BAD_SIGMA: "their sigma is not a standard uncertainty in m or rad (1e-12 to 1000, 0 = "
    "not known), or 10,000 times smaller than that of the others; correct the "
    "publisher of the detections",
    Reason.FUTURE: "they were stamped more than a minute ahead of the collector's clock; set the "
    "clock that stamps them",
}
"""Remedies for reasons reported even for a single detection."""

REMEDY = {
    Reason.NO_ENCODER: "the encoder has a gap around the exposures; make it publish without gaps, "
    "or raise max_encoder_gap",
    Reason.MOVING: "the stage moved at the exposure; expose at rest, stamp the exposure itself, or "
    "raise max_speed and max_angular_speed",
    Reason.OUTSIDE_VIEWS: "they were exposed when no view was being measured; expose between "
    "MEASURE and the next command, stamped by one clock",
    Reason.CONTRADICTION: "encoder samples contradict each other; publish the joints from one "
    "source, with a clock that does not step",
    Reason.NOT_FINITE: "NaN, infinite or negative where a length or an angle is expected; correct "
    "the publisher of the detections",
    Reason.BAD_SIGMA: ADVICE[Reason.BAD_SIGMA],
    Reason.FUTURE: ADVICE[Reason.FUTURE],
    Reason.UNKNOWN_KIND: "kind is neither GRID nor ANGULAR; correct the publisher of the "
    "detections",
    Reason.UNKNOWN_MARK: "their ids are not on the plate; check grid_size, angular_count and the "
    "numbering of the marks (m, n from -h to h, k from 0)",
    Reason.NOT_IN_VIEW: "the view does not ask for these marks; check its pose and its kinds of "
    "marks in the plan",
    Reason.AMBIGUOUS: "two marks are about equally near; give the detections ids",
    Reason.ROTATION: ADVICE[Reason.ROTATION],
    Reason.TOO_FAR: "the marks are not where the view places them; check how the plate lies, the "
    "unit of the offsets (m, stage axes) and the ids, or raise max_deviation",
    Reason.NOT_AT_MARK: "the stage does not stand at the detected marks; check joint_x, "
    "joint_y and measurement_sense, or set max_stage_distance",
    Reason.OUTSIDE_IMAGE: "they lie beyond the marks that an image shows; raise nx and ny under "
    "image in the plan, or if the plate lies half a pitch or more off its place: "
    "state that in the plan (translation_mm of the views), or give the detections ids",
    Reason.SEVERAL: "an exposure shows several marks, but the plan expects one; state in the plan "
    "how many an image shows (image: {nx: 3, ny: 3}), or publish only the mark "
    "nearest to the optical axis",
    Reason.LOW_SCORE: "their score is below min_score; correct the detection, or lower min_score",
    Reason.OUTLIER: "repeats of a mark contradict each other; check the stage for backlash, that "
    "one node alone publishes detections (ros2 topic info -v), that each id belongs to one mark, "
    "or raise outlier_limit",
}
"""Remedies if most detections are rejected for a reason; reasons not listed are not faults."""


MANY = 0.1
"""Part of the detections above which the reason of most rejections is stated with a result."""
HARMLESS = (Reason.OUTSIDE_VIEWS, Reason.MOVING, Reason.NOT_IN_VIEW)
"""Reasons that are normal where a detector publishes all the time."""


def rejections(rejected: Mapping[str, int], used: int) -> list[str]:
    """Return what to say of the rejections of a session whose cause is not known."""
    bad = {
        reason: count
        for reason, count in rejected.items()
        if reason in REMEDY and reason not in HARMLESS
    }
    total = used + sum(bad.values())
    reason = max(bad, key=lambda name: bad[name], default="")
    if reason in ADVICE or sum(bad.values()) <= MANY * total:
        return advice(rejected)
    return [
        f"{sum(bad.values())} of {total} detections were rejected, {bad[reason]} of them as "
        f"{reason}: {REMEDY[Reason(reason)]}",
        *advice(rejected),
    ]


def advice(rejected: Mapping[str, int]) -> list[str]:
    """Return one line for each reason in `rejected` with advice, with its count."""
    return [
        f"{count} detection{'s' * (count != 1)} rejected as {reason}: {text}"
        for reason, text in ADVICE.items()
        if (count := rejected.get(reason))
    ]
