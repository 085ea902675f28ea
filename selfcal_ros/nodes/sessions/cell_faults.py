# SPDX-License-Identifier: Apache-2.0
"""The one fault of a cell that explains its rejections: what would be used if it were not there.

Each possible fault is undone in the recorded messages, which are collected again.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from math import degrees, isfinite, nan, pi, radians
from typing import NamedTuple

import numpy as np

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.diagnosis import fault_text
from selfcal_ros.collection.inputs import (
    Command,
    Detection,
    EncoderBlock,
    EncoderSample,
    Kind,
)
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.checks.wiring import wiring_faults
from selfcal_ros.model.artifact import MAX_GRID_SIZE
from selfcal_ros.model.readings import RepeatMotion, Sense
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.units import MM_PER_M

type Event = EncoderSample | Detection

AT_ONE_PLACE_M = 1e-4
"""Way that is none: the stops beside a mark."""
STILL = 0.25
"""Part of the pitch within which a stage has not moved."""


FOLLOWS = 0.9
"""Fraction of the variance of an offset that must follow the stage for a valid slope."""
NEAR_FACTOR = 4.0
"""Factor by which the response of an offset to the stage may differ from -1: a wrong unit makes at
least 10, a turn or a wrong size of a pixel less."""


@dataclass(frozen=True)
class Fault:
    """A fault, its remedy, and the messages as they would be without it."""

    what: str
    remedy: str
    command: Command
    events: tuple[Event, ...] = ()


def explaining(
    command: Command, events: Sequence[Event], settings: CollectorSettings
) -> Fault | None:
    """Return the fault without which most of the rejected detections would be used, if any.

    Of several, one whose offsets then follow the stage; all of them if nothing tells them apart.

    Parameters
    ----------
    command : Command
        MEASURE of the view.
    events : sequence of EncoderSample or Detection
        All messages of the view.
    settings : CollectorSettings
        Names of the joints, sense, limits.
    """
    standing = _standing(command, events, settings)
    if standing is not None:
        return standing
    total = sum(isinstance(event, Detection) for event in events)
    recorded = _worth(Fault("", "", command, tuple(events)), settings)
    faults: list[Fault] = []
    best = Worth((recorded.used + total) / 2, -np.inf, 0, 0)
    for fault in _faults(command, events, settings):
        try:
            worth = _worth(fault, settings)
        except InputError:  # an even and an odd side do not lie so
            continue
        # without ids, positions in mm are all those of one mark
        if worth.seen < recorded.seen:
            continue
        # any offset is small enough in another unit
        if not worth.following:
            continue
        if worth > best:
            faults = []
            best = worth
        if worth == best:
            faults.append(fault)
    return (
        replace(
            faults[0],
            what=", or ".join(fault.what for fault in faults),
            remedy="; or ".join(fault.remedy for fault in faults),
        )
        if faults
        else None
    )


class Worth(NamedTuple):
    """What messages are worth, the more the better.

    Attributes
    ----------
    used : float
        Detections that would be used.
    faults : float
        Minus the faults of the offsets.
    following : int
        Of x and y, how many offsets follow the stage; 2 if no check stops show it.
    seen : int
        Marks and lines seen.
    """

    used: float
    faults: float
    following: int
    seen: int


def _worth(fault: Fault, settings: CollectorSettings) -> Worth:
    """Return what the messages would be worth without a fault."""
    collector = Collector(settings)
    collector.add_command(fault.command)
    samples = [event for event in fault.events if isinstance(event, EncoderSample)]
    for _, alike in groupby(
        samples,
        key=lambda sample: (
            sample.names,
            len(sample.positions),
            len(sample.velocities),
        ),
    ):
        collector.add_encoder_block(EncoderBlock.of([*alike]))
    for event in fault.events:
        if isinstance(event, Detection):
            collector.add_detection(event)
    measurements, progress = collector.collect()
    views = measurements.views
    slopes = [slope_of(view.motion, axis) for view in views for axis in (0, 1)]
    following = sum(
        slope is not None and 1 / NEAR_FACTOR < -slope < NEAR_FACTOR for slope in slopes
    )
    has_stops = any(view.check_done for view in progress.values())
    return Worth(
        used=sum(view.used for view in views),
        faults=-len(wiring_faults(measurements)),
        following=following if has_stops else 2,
        seen=sum(len(view.m) + len(view.k) for view in views),
    )


def slope_of(motion: RepeatMotion | None, axis: int) -> float | None:
    """Return the response of an offset to its axis; None if mostly noise."""
    if motion is None:
        return None
    n = len(motion.products) // 2
    place, offset, cross = (
        float(motion.products[index])
        for index in ((axis, axis), (n + axis, n + axis), (axis, n + axis))
    )
    return cross / place if cross**2 > FOLLOWS * place * offset else None


def _standing(
    command: Command, events: Sequence[Event], settings: CollectorSettings
) -> Fault | None:
    """Return the fault of a stage that is indicated at one place, or turn, during the view."""
    plate = command.artifact
    samples = [event for event in events if isinstance(event, EncoderSample)]
    places = np.array(
        [place for sample in samples if (place := _place(sample, settings)) is not None]
    )
    if not len(places) or plate is None:
        return None
    way_m = float(np.ptp(places, axis=0).max())
    if way_m <= STILL * plate.grid_pitch_m:
        x, y = np.median(places, axis=0) * MM_PER_M
        return Fault(
            f"the stage moves by {way_m * MM_PER_M:.3g} mm alone during the whole view"
            if way_m > AT_ONE_PLACE_M
            else f"the stage does not move: it is indicated at x = {x:.6g} mm, "
            f"y = {y:.6g} mm during the whole view",
            "move the stage to each mark, name the joints that move in joint_x and joint_y, "
            "and publish them in m",
            command,
        )
    for axis, way in zip("xy", np.ptp(places, axis=0).tolist(), strict=True):
        if way <= STILL * plate.grid_pitch_m:
            return Fault(
                f"{axis} does not move: it is indicated within {way * MM_PER_M:.3g} mm during "
                "the whole view",
                f"move the stage to each mark, and name the joint that moves in joint_{axis}",
                command,
            )
    lines = {
        event.k for event in events if isinstance(event, Detection) and _is_line(event)
    }
    _, turns = _turns(samples, settings)
    if (
        len(lines) > 1
        and len(turns)
        and np.ptp(turns) <= STILL * 2 * pi / plate.angular_count
    ):
        return Fault(
            f"theta does not move: it is indicated at {np.median(turns):.6g} rad during "
            "the whole view",
            "turn the stage to each line, and name the joint that turns in joint_theta",
            command,
        )
    return None


def _place(
    sample: EncoderSample, settings: CollectorSettings
) -> tuple[float, float] | None:
    """Return the indicated x and y of a sample that has both, as numbers."""
    where = dict(zip(sample.names, sample.positions, strict=False))
    x, y = (where.get(joint, nan) for joint in (settings.joint_x, settings.joint_y))
    return (x, y) if isfinite(x) and isfinite(y) else None


def _faults(
    command: Command, events: Sequence[Event], settings: CollectorSettings
) -> Iterator[Fault]:
    """Yield the faults that are tried."""
    readings = [event for event in events if isinstance(event, Detection)]
    samples = [event for event in events if isinstance(event, EncoderSample)]

    def fault(what: str, remedy: str, detections: Sequence[Detection]) -> Fault:
        return Fault(what, remedy, command, (*samples, *detections))

    yield from _counts(command, samples, readings, settings, fault)
    yield fault(
        "m and n are exchanged",
        "m counts the marks along plate x, n along plate y",
        [replace(reading, m=reading.n, n=reading.m) for reading in readings],
    )
    for scale, unit in ((1e3, "mm"), (1e6, "µm or pixels")):
        yield fault(
            f"the offsets are in {unit}",
            "publish offset_x and offset_y in m",
            [
                replace(
                    reading,
                    offset_x=reading.offset_x / scale,
                    offset_y=reading.offset_y / scale,
                )
                for reading in readings
            ],
        )
    places = _places_at(samples, readings, settings)
    yield fault(
        "the offsets are places of the marks on the stage",
        "publish mark - optical axis: leave out the position of the stage",
        [
            replace(
                reading,
                offset_x=reading.offset_x - place.real,
                offset_y=reading.offset_y - place.imag,
            )
            for reading, place in zip(readings, places, strict=True)
        ],
    )
    for late in (1, 2):
        exposures = f"{late} exposure{'s' * (late > 1)}"
        yield fault(
            f"each detection shows the mark of {exposures} before its stamp",
            "stamp detections with the time of the exposure, and read each image once",
            [
                replace(reading, stamp_ns=before.stamp_ns)
                for reading, before in zip(readings[late:], readings, strict=False)
            ],
        )
        yield fault(
            f"each detection shows the mark of {exposures} after its stamp",
            "stamp detections with the time of the exposure",
            [
                replace(reading, stamp_ns=after.stamp_ns)
                for reading, after in zip(readings, readings[late:], strict=False)
            ],
        )
    turns = list(product((1.0,), (False, True), ((1, 1), (-1, -1), (-1, 1), (1, -1))))
    for scale, swapped, signs in (
        *turns[1:],
        (1e3, False, (1, 1)),
        (1e6, False, (1, 1)),
    ):
        what, _, remedy = fault_text(
            scale, swapped=swapped, signs=signs, sense=Sense(settings.measurement_sense)
        ).partition("; ")
        yield Fault(
            what,
            remedy,
            command,
            (
                *(
                    _sample_at(
                        sample, settings, scale=scale, swapped=swapped, signs=signs
                    )
                    for sample in samples
                ),
                *readings,
            ),
        )
    for what, remedy, factor in (
        ("theta is indicated with the wrong sign", "reverse the sign of theta", -1.0),
        ("theta is indicated in degrees", "publish theta in rad", radians(1.0)),
    ):
        yield Fault(
            what,
            remedy,
            command,
            (
                *(_turned(sample, settings, factor=factor) for sample in samples),
                *readings,
            ),
        )
    yield from _placings(command, events)


def _counts(
    command: Command,
    samples: Sequence[EncoderSample],
    detections: Sequence[Detection],
    settings: CollectorSettings,
    fault: Callable[[str, str, Sequence[Detection]], Fault],
) -> Iterator[Fault]:
    """Yield that marks or lines are counted otherwise; `fault` makes one of other detections."""
    view, plate = command.view, command.artifact
    if view is None or plate is None:
        return
    for signs, what in (
        ((-1, 1), "m is counted against plate x"),
        ((1, -1), "n is counted against plate y"),
        ((-1, -1), "m and n are counted against plate x and y"),
    ):
        even = [
            sign < 0 and size % 2 == 0
            for sign, size in zip(signs, plate.shape, strict=True)
        ]
        yield fault(
            what,
            "m counts the marks along plate x, n along plate y",
            [
                replace(
                    detection,
                    m=signs[0] * detection.m - even[0],
                    n=signs[1] * detection.n - even[1],
                )
                for detection in detections
            ],
        )
    shift = _other_origin(command, samples, detections, settings)
    if any(shift):
        yield fault(
            "m and n are counted from another mark: the one in the middle is called "
            f"({shift[0]}, {shift[1]})",
            "call the mark in the middle of the plate (0, 0): m and n begin at -(N//2)",
            [
                replace(detection, m=detection.m - shift[0], n=detection.n - shift[1])
                for detection in detections
            ],
        )
    lines = [detection for detection in detections if _is_line(detection)]
    if not lines or not plate.angular_count:
        return
    yield fault(
        "the lines are counted clockwise",
        "count k counter-clockwise",
        [
            replace(detection, k=-detection.k % plate.angular_count)
            for detection in detections
        ],
    )
    zero = _other_zero(view.rotation_rad, plate.angular_count, samples, lines, settings)
    yield Fault(
        f"theta is indicated {degrees(zero):+.4g}° from where the lines are",
        "count k from the line along plate x, and set theta to 0 where that line is read",
        command,
        (
            *(_turned(sample, settings, zero_rad=zero) for sample in samples),
            *detections,
        ),
    )


def _other_origin(
    command: Command,
    samples: Sequence[EncoderSample],
    detections: Sequence[Detection],
    settings: CollectorSettings,
) -> tuple[int, int]:
    """Return by how much m and n are usually higher than those of the mark at the axis."""
    view, plate = command.view, command.artifact
    marks = [
        detection
        for detection in detections
        if detection.kind == Kind.GRID and detection.has_id
    ]
    if view is None or plate is None or plate.marks or not marks:
        return 0, 0
    at = _places_at(samples, marks, settings)
    at = Sense(settings.measurement_sense).sign * at - complex(*view.translation_m)
    at *= np.exp(-1j * view.rotation_rad) / plate.grid_pitch_m
    off_m, off_n = plate.off_centre
    higher = (
        np.median([mark.m for mark in marks] - at.real + off_m),
        np.median([mark.n for mark in marks] - at.imag + off_n),
    )
    if not max(map(abs, higher)) < MAX_GRID_SIZE:  # then the places are wrong
        return 0, 0
    return round(higher[0]), round(higher[1])


def _places_at(
    samples: Sequence[EncoderSample],
    detections: Sequence[Detection],
    settings: CollectorSettings,
) -> np.ndarray:
    """Return x + i y indicated at each detection, complex array, m; NaN if nothing is indicated."""
    places = [
        (sample.stamp_ns, complex(*place))
        for sample in samples
        if (place := _place(sample, settings)) is not None
    ]
    if not places:
        return np.full(len(detections), np.nan + 0j)
    stamps, at = zip(*places, strict=True)
    exposed_ns = [detection.stamp_ns for detection in detections]
    return np.interp(exposed_ns, stamps, at)


def _other_zero(
    rotation_rad: float,
    count: int,
    samples: Sequence[EncoderSample],
    lines: Sequence[Detection],
    settings: CollectorSettings,
) -> float:
    """Return the mean difference of the indicated theta to that of the lines, rad."""
    stamps, turns = _turns(samples, settings)
    if not turns:
        return 0.0
    theta_rad = np.interp([line.stamp_ns for line in lines], stamps, turns)
    sites = rotation_rad + 2 * pi * np.array([line.k for line in lines]) / count
    return float(
        np.angle(
            np.exp(
                1j * (theta_rad - Sense(settings.measurement_sense).sign * sites)
            ).mean()
        )
    )


def _is_line(event: Detection) -> bool:
    """Return whether a detection names an angular line."""
    return event.kind == Kind.ANGULAR and event.has_id


def _turns(
    samples: Sequence[EncoderSample], settings: CollectorSettings
) -> tuple[list[int], list[float]]:
    """Return stamps, ns, and theta, rad, of the samples that have it."""
    turns = [
        (sample.stamp_ns, theta)
        for sample in samples
        if (
            theta := dict(zip(sample.names, sample.positions, strict=False)).get(
                settings.joint_theta
            )
        )
        is not None
    ]
    return [stamp for stamp, _ in turns], [theta for _, theta in turns]


def _turned(
    sample: EncoderSample,
    settings: CollectorSettings,
    *,
    factor: float = 1.0,
    zero_rad: float = 0.0,
) -> EncoderSample:
    """Return a sample with another theta."""
    return replace(
        sample,
        positions=tuple(
            factor * position - zero_rad if name == settings.joint_theta else position
            for name, position in zip(sample.names, sample.positions, strict=False)
        ),
    )


def _sample_at(
    sample: EncoderSample,
    settings: CollectorSettings,
    *,
    scale: float,
    swapped: bool,
    signs: tuple[int, int],
) -> EncoderSample:
    """Return a sample with other x and y."""
    place = _place(sample, settings)
    if place is None:
        return sample
    x, y = place[::-1] if swapped else place
    joint_positions = {
        settings.joint_x: signs[0] * x / scale,
        settings.joint_y: signs[1] * y / scale,
    }
    return replace(
        sample,
        positions=tuple(
            joint_positions.get(name, position)
            for name, position in zip(sample.names, sample.positions, strict=False)
        ),
    )


def _placings(command: Command, events: Sequence[Event]) -> Iterator[Fault]:
    """Yield that the plate lies, or the cell goes, otherwise than commanded."""
    view, plate = command.view, command.artifact
    if view is None or plate is None:
        return
    remedy = "place the plate as commanded, and measure the view of the command"
    for deg in (90, 180, 270):
        yield Fault(
            f"the marks are those of a plate turned by {deg}°",
            remedy,
            replace(command, view=replace(view, rotation_rad=radians(deg))),
            tuple(events),
        )
    for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        yield Fault(
            f"the marks are those of a plate shifted by {a or b:+d} pitch along "
            f"{'x' if a else 'y'}",
            remedy,
            replace(
                command,
                view=replace(
                    view, translation_m=(a * plate.grid_pitch_m, b * plate.grid_pitch_m)
                ),
            ),
            tuple(events),
        )
