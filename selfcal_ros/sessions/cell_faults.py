# SPDX-License-Identifier: Apache-2.0
"""The one fault of a cell that explains its rejections: what would be used if it were not there.

Each possible fault is undone in the recorded messages, which are collected again.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, product
from math import radians

import numpy as np

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.diagnosis import fault_text
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.estimation.checks.wiring import wiring_faults
from selfcal_ros.model.readings import Sense
from selfcal_ros.units import MM_PER_M

type Event = EncoderSample | Detection

STILL = 0.25
"""Part of the pitch within which a stage has not moved."""


@dataclass(frozen=True)
class Fault:
    """A fault, its remedy, and the messages as they would be without it."""

    what: str
    remedy: str
    command: Command
    events: tuple[Event, ...] = ()


def explaining(command: Command, events: Sequence[Event], settings: CollectorSettings
               ) -> Fault | None:
    """Return the fault without which most of the rejected detections would be used, if any.

    Of several, one whose offsets then follow the stage.

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
    used, _ = _outcome(Fault("", "", command, tuple(events)), settings)
    found, best = None, ((used + total) / 2, -np.inf)
    for fault in _faults(command, events, settings):
        outcome = _outcome(fault, settings)
        if outcome > best:
            found, best = fault, outcome
        if best == (total, 0):
            break
    return found


def _outcome(fault: Fault, settings: CollectorSettings) -> tuple[int, int]:
    """Return the detections that would be used, and minus the faults of the offsets."""
    collector = Collector(settings)
    collector.add_command(fault.command)
    samples = [event for event in fault.events if isinstance(event, EncoderSample)]
    for (names, _, _), alike in groupby(samples, key=lambda sample: (
            sample.names, len(sample.positions), len(sample.velocities))):
        stamps, positions, velocities = zip(*(
            (sample.stamp_ns, sample.positions, sample.velocities) for sample in alike),
            strict=True)
        collector.add_encoder_block(np.array(stamps), names, np.array(positions, dtype=float),
                                    np.array(velocities, dtype=float))
    for event in fault.events:
        if isinstance(event, Detection):
            collector.add_detection(event)
    measurements, _ = collector.collect()
    return (sum(view.used for view in measurements.views), -len(list(wiring_faults(measurements))))


def _standing(command: Command, events: Sequence[Event], settings: CollectorSettings
              ) -> Fault | None:
    """Return the fault of a stage that is indicated at one place during the whole view."""
    places = np.array([place for event in events if isinstance(event, EncoderSample)
                       and (place := _place(event, settings)) is not None])
    if not len(places) or command.artifact is None or (
            np.ptp(places, axis=0).max() > STILL * command.artifact.grid_pitch_m):
        return None
    x, y = np.median(places, axis=0) * MM_PER_M
    return Fault(f"the stage does not move: it is indicated at x = {x:.6g} mm, y = {y:.6g} mm "
                 "during the whole view", "move the stage to each mark, and name the joints that "
                 "move in joint_x and joint_y", command)


def _place(sample: EncoderSample, settings: CollectorSettings) -> tuple[float, float] | None:
    """Return the indicated x and y of a sample that has both."""
    where = dict(zip(sample.names, sample.positions, strict=False))
    if settings.joint_x not in where or settings.joint_y not in where:
        return None
    return where[settings.joint_x], where[settings.joint_y]


def _faults(command: Command, events: Sequence[Event], settings: CollectorSettings
            ) -> Iterator[Fault]:
    """Yield the faults that are tried."""
    seen = [event for event in events if isinstance(event, Detection)]
    samples = [event for event in events if isinstance(event, EncoderSample)]

    def fault(what: str, remedy: str, detections: Sequence[Detection]) -> Fault:
        return Fault(what, remedy, command, (*samples, *detections))

    yield fault("m and n are exchanged", "m counts the marks along plate x, n along plate y",
                [replace(one, m=one.n, n=one.m) for one in seen])
    for scale, unit in ((1e3, "mm"), (1e6, "µm")):
        yield fault(f"the offsets are in {unit}", "publish offset_x and offset_y in m",
                    [replace(one, offset_x=one.offset_x / scale, offset_y=one.offset_y / scale)
                     for one in seen])
    for late in (1, 2):
        exposures = f"{late} exposure{'s' * (late > 1)}"
        yield fault(f"each detection shows the mark of {exposures} before its stamp",
                    "stamp detections with the time of the exposure, and read each image once",
                    [replace(one, stamp_ns=before.stamp_ns)
                     for one, before in zip(seen[late:], seen, strict=False)])
        yield fault(f"each detection shows the mark of {exposures} after its stamp",
                    "stamp detections with the time of the exposure",
                    [replace(one, stamp_ns=after.stamp_ns)
                     for one, after in zip(seen, seen[late:], strict=False)])
    turns = list(product((1.0,), (False, True), ((1, 1), (-1, -1), (-1, 1), (1, -1))))
    for scale, swapped, signs in (*turns[1:], (1e3, False, (1, 1)), (1e6, False, (1, 1))):
        what, _, remedy = fault_text(scale, swapped=swapped, signs=signs,
                                     sense=Sense(settings.measurement_sense)).partition("; ")
        yield Fault(what, remedy, command, (*(
            _moved(sample, settings, scale=scale, swapped=swapped, signs=signs)
            for sample in samples), *seen))
    yield from _placings(command, events)


def _moved(sample: EncoderSample, settings: CollectorSettings, *, scale: float, swapped: bool,
           signs: tuple[int, int]) -> EncoderSample:
    """Return a sample with other x and y."""
    place = _place(sample, settings)
    if place is None:
        return sample
    x, y = place[::-1] if swapped else place
    moved = {settings.joint_x: signs[0] * x / scale, settings.joint_y: signs[1] * y / scale}
    return replace(sample, positions=tuple(
        moved.get(name, position) for name, position in
        zip(sample.names, sample.positions, strict=False)))


def _placings(command: Command, events: Sequence[Event]) -> Iterator[Fault]:
    """Yield that the plate lies, or the cell goes, otherwise than commanded."""
    view, plate = command.view, command.artifact
    if view is None or plate is None:
        return
    remedy = "place the plate as commanded, and measure the view of the command"
    for deg in (90, 180, 270):
        yield Fault(f"the marks are those of a plate turned by {deg}°", remedy, replace(
            command, view=replace(view, rotation_rad=radians(deg))), tuple(events))
    for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        yield Fault(f"the marks are those of a plate shifted by {a or b:+d} pitch along "
                    f"{'x' if a else 'y'}", remedy, replace(command, view=replace(
                        view, translation_m=(a * plate.grid_pitch_m, b * plate.grid_pitch_m))),
                    tuple(events))
