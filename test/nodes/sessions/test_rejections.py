# SPDX-License-Identifier: Apache-2.0
"""The collector warns of rejections that last, not of messages that are late."""

from collections.abc import Iterable
from dataclasses import replace

import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.diagnosis import AT_LEAST
from selfcal_ros.collection.inputs import (
    REMEDY,
    Command,
    Detection,
    EncoderSample,
    Kind,
    Phase,
    Reason,
)
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.rejections import PATIENCE_S
from test.support.collecting import detection_table, encoder_block, scene
from test.support.ports import Hands, message, settings_of

CLOCK = "stamp both by one clock"
STEP_S = 0.5


class Late:
    """A collector that receives the messages of a scene by their stamps, some of them later."""

    def __init__(self) -> None:
        self.hands = Hands()
        self.session = CollectingSession(
            settings_of("measurement_collector"), self.hands.ports
        )

    def give(self, events: Iterable) -> None:
        for event in events:
            if isinstance(event, Command):
                self.session.take_command(
                    message("ViewCommand", from_model.command(event, "stage")), False
                )
            elif isinstance(event, EncoderSample):
                self.session.take_encoder(encoder_block(event))
            else:
                self.session.take_detections(detection_table(event))

    def play(self, arrivals: list, *, rest_s: float = 0.0) -> list[str]:
        """Give (seconds, message) when they arrive, and look twice a second; return the warnings.

        `rest_s`: how long no more comes in the end.
        """
        began, end = self.hands.seconds, max(when for when, _ in arrivals) + rest_s
        waiting = sorted(arrivals, key=lambda one: one[0])
        while self.hands.seconds - began <= end + STEP_S:
            passed = self.hands.seconds - began
            self.give(event for when, event in waiting if when <= passed)
            waiting = [one for one in waiting if one[0] > passed]
            self.session.tick()
            told = self.session.diagnosis(detections_matched=True).message
            assert "rejected as" not in told or self.hands.lines(Level.WARN), told
            self.hands.pass_time(STEP_S)
        return self.hands.lines(Level.WARN)


def arrivals(late: type, by_s: float, *, plan: str = "0, 90, 180") -> list:
    events = scene(plan, count=0).events
    first = min(event.stamp_ns for event in events)
    return [
        (
            (event.stamp_ns - first) * 1e-9
            + (by_s if isinstance(event, late) else 0.0),
            event,
        )
        for event in events
    ]


@pytest.mark.parametrize("by_s", [0.0, 1.0, 3.0, 5.0])
@pytest.mark.parametrize("late", [EncoderSample, Command])
def test_messages_that_are_late_are_no_fault(late, by_s):
    cell = Late()
    assert cell.play(arrivals(late, by_s), rest_s=2 * PATIENCE_S) == []
    assert all(not view.rejected for view in cell.session.collector.collect()[0].views)


@pytest.mark.parametrize("by_s", [1.0, 5.0])
def test_views_whose_commands_come_after_all_detections_are_no_fault(by_s):
    """Until then their detections count in the first view, where the stage is at other marks."""
    cell, events = Late(), scene("0, 90, 180", count=0)
    cell.give([*events.commands[:2], *events.samples, *events.detections])
    cell.session.tick()
    assert (
        cell.session.collector.collect()[0].views[0].rejected["stage_not_at_mark"] > 40
    )
    cell.hands.pass_time(by_s)
    cell.session.tick()
    cell.give(events.commands[2:])
    cell.session.tick()
    cell.hands.pass_time(2 * PATIENCE_S)
    cell.session.tick()
    assert cell.hands.said == []


def offset(by_s: float) -> list:
    """Return the arrivals of a cell whose encoder is stamped earlier by so much."""
    return [
        (
            when,
            replace(event, stamp_ns=event.stamp_ns - round(by_s * 1e9))
            if isinstance(event, EncoderSample)
            else event,
        )
        for when, event in arrivals(EncoderSample, 0.0, plan="0")
    ]


@pytest.mark.parametrize("by_s", [5.0, 37.0])
def test_clocks_that_differ_are_told_after_a_while(by_s):
    cell, messages = Late(), offset(by_s)
    cell.give(event for _, event in messages)
    cell.session.tick()
    cell.hands.pass_time(0.99 * PATIENCE_S)
    cell.session.tick()
    assert cell.hands.said == []
    cell.hands.pass_time(0.01 * PATIENCE_S + 1e-6)
    cell.session.tick()
    [line] = cell.hands.lines(Level.WARN)
    assert (
        f"the detections are stamped about {by_s:g} s after the encoder samples; {CLOCK}"
        in line
    )
    assert line in cell.session.diagnosis(detections_matched=True).message
    cell.hands.pass_time(PATIENCE_S)
    cell.session.tick()
    assert cell.hands.lines(Level.WARN) == [line]


@pytest.mark.parametrize("by_s", [5.0, 37.0])
def test_clocks_that_differ_are_told_at_once_when_all_messages_have_come(by_s):
    cell = Late()
    cell.give(event for _, event in offset(by_s))
    cell.session.finish()
    assert [CLOCK in line for line in cell.hands.lines(Level.WARN)] == [True]


def test_the_time_is_counted_anew_when_a_fault_comes_again():
    cell, events = Late(), scene("0", count=0)
    samples = [event for event in events.events if isinstance(event, EncoderSample)]
    cut = events.detections[10].stamp_ns - 1
    cell.give([*events.commands, *events.detections[:10]])
    cell.session.tick()
    cell.hands.pass_time(0.9 * PATIENCE_S)
    cell.give(sample for sample in samples if sample.stamp_ns < cut)
    cell.session.tick()
    cell.give(events.detections[10:])
    for _ in range(3):
        cell.hands.pass_time(0.6 * PATIENCE_S)
        assert cell.hands.said == []
        cell.session.tick()
    [line] = cell.hands.lines(Level.WARN)
    assert line.startswith(
        "15 of 25 detections were rejected as no_encoder_sample_near"
    )


def test_a_view_that_no_longer_advances_says_why_before_most_of_it_is_rejected():
    """The marks are read; the lines that remain are seen again and again, and never used."""
    cell, events = Late(), scene("0", count=8).events
    lost = [
        event
        for event in events
        if isinstance(event, Detection) and event.k == 3 and event.kind == Kind.ANGULAR
    ]
    cell.give(
        event
        for event in events
        if event not in lost
        and not (isinstance(event, Command) and event.phase == Phase.DONE)
    )
    cell.session.tick()
    for number in range(AT_LEAST):
        cell.give([replace(lost[0], offset_theta=0.3 + number * 1e-6)])
        cell.hands.pass_time(PATIENCE_S - STEP_S)
        cell.session.tick()
    assert cell.hands.said == []
    cell.hands.pass_time(PATIENCE_S)
    cell.session.tick()
    [line] = cell.hands.lines(Level.WARN)
    assert line == (
        f"view '0': none of the last ones was used: {AT_LEAST} of {AT_LEAST} "
        f"detections were rejected as too_far_from_nominal: {REMEDY[Reason.TOO_FAR]}"
    )
    assert line in cell.session.diagnosis(detections_matched=True).message
    cell.give(lost)
    cell.hands.pass_time(STEP_S)
    cell.session.tick()
    assert (
        "none of the last"
        not in cell.session.diagnosis(detections_matched=True).message
    )


def test_lines_without_their_joint_are_told_although_the_marks_are_more():
    cell, events = Late(), scene("0", count=8).events
    lines = [
        event
        for event in events
        if isinstance(event, Detection) and event.kind == Kind.ANGULAR
    ]
    cell.give(
        replace(
            event, names=event.names[:2], positions=event.positions[:2], velocities=()
        )
        if isinstance(event, EncoderSample)
        else event
        for event in events
        if event not in lines[1:]
        and not (isinstance(event, Command) and event.phase == Phase.DONE)
    )
    cell.session.tick()
    cell.give(lines[1:])
    for _ in range(2):
        cell.hands.pass_time(PATIENCE_S)
        cell.session.tick()
    [line] = cell.hands.lines(Level.WARN)
    assert line == (
        "view '0': none of the last ones was used: 7 of 7 detections were rejected as no_encoder_"
        "sample_near: no encoder sample of the joint 'theta' arrived; joints received: 'x', 'y'; "
        "set joint_x, joint_y, joint_theta"
    )
