# SPDX-License-Identifier: Apache-2.0
"""The line of progress: what a person reads in `ros2 topic echo selfcal/progress`."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.collecting import PROGRESS_S, STUCK_S, CollectingSession
from selfcal_ros.nodes.sessions.health import Ports
from selfcal_ros.nodes.sessions.progress import progress_line
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.collecting import scene
from test.support.ports import message

VIEW = View("rot90", np.pi / 2)
COMMAND = Command(5, Phase.MEASURE, "hu", 1, VIEW, Artifact(11, 0.01, 24), 4)
READ = ViewReadings(
    VIEW, sigma_xy=19.2e-9, rejected={"low_score": 1, "stage_moving": 2}
)
PROGRESS = ViewProgress(1, VIEW, 121, 83, 24, 12, READ, 9)


def test_a_view_that_is_measured_word_for_word():
    assert progress_line(COMMAND, PROGRESS) == (
        "view 2 of 4 'rot90': 83 of 121 marks, 12 of 24 lines, 3 rejected (stage_moving 2, "
        "low_score 1), σ 0.0192 µm"
    )


@pytest.mark.parametrize(
    ("command", "view", "line"),
    [
        (
            replace(COMMAND, phase=Phase.PLACE),
            None,
            "view 2 of 4 'rot90': the plate is to be placed",
        ),
        (replace(COMMAND, phase=Phase.DONE), PROGRESS, "plan 'hu' done"),
        (replace(COMMAND, phase=Phase.ABORT), None, "plan 'hu' aborted"),
        (
            replace(COMMAND, views_planned=0),
            replace(PROGRESS, readings=ViewReadings(VIEW)),
            "view 2 'rot90': 83 of 121 marks, 12 of 24 lines",
        ),
        (
            COMMAND,
            replace(
                PROGRESS,
                grid_expected=0,
                readings=ViewReadings(VIEW, sigma_theta=np.deg2rad(1.5 / 3600)),
            ),
            "view 2 of 4 'rot90': 12 of 24 lines, σ 1.50 arcsec",
        ),
        (
            COMMAND,
            replace(
                PROGRESS,
                check_done=4,
                view=replace(VIEW, check_marks=5),
                readings=ViewReadings(VIEW),
            ),
            "view 2 of 4 'rot90': 83 of 121 marks, 12 of 24 lines, 4 of 5 check stops",
        ),
    ],
)
def test_other_states(command, view, line):
    assert progress_line(command, view) == line


def test_repeats_are_counted_while_no_mark_is_complete():
    twice = replace(VIEW, repeats=2)
    read = ViewReadings(
        twice, np.array([0, 0]), np.array([0, 1]), count=np.array([1, 1])
    )
    view = ViewProgress(1, twice, 4, 0, 0, 0, read, 9)
    assert progress_line(COMMAND, view).endswith(": 0 of 4 marks, 25 % of 2 repeats")


class Desk:
    """A session with a clock that is set, and the lines and statuses that it published."""

    def __init__(self):
        self.now, self.lines, self.statuses = 0.0, [], []
        self.session = CollectingSession(
            CollectorSettings.checked({}, "test"),
            Ports(self._publish, lambda level, line: None, lambda: self.now, lambda: 0),
        )

    def _publish(self, output, fields):
        if output == "progress":
            self.lines.append(fields["data"])
        elif output == "status":
            self.statuses.append(fields)

    def feed(self, events):
        collector: Collector = self.session.collector
        for event in events:
            if isinstance(event, Command):
                self.session.take_command(
                    message("ViewCommand", from_model.command(event, "stage")), False
                )
            else:
                add = {
                    Detection: collector.add_detection,
                    EncoderSample: collector.add_encoder,
                }
                add[type(event)](event)
        self.session._dirty = True

    def tick(self, at_s):
        self.now = at_s
        self.session.tick()


def test_a_line_is_published_when_it_changes_and_at_most_twice_a_second():
    desk, events = Desk(), scene(count=0).events
    for number, event in enumerate(events):
        desk.feed([event])
        desk.tick(number * 0.01)
    assert 1 < len(desk.lines) <= 1 + number * 0.01 / PROGRESS_S
    for at_s in (100.0, 200.0):
        desk.tick(at_s)  # the newest line is not withheld, and not repeated
    assert len(desk.lines) == len(set(desk.lines))
    assert desk.lines[-1] == "plan '0' done"
    assert desk.lines[0].startswith("view 1 of ")


def test_missing_marks_are_named_if_few_or_if_the_view_is_stuck():
    events = scene(count=0)
    detections = {id(event) for event in events.detections[4:]}
    begun = [
        event
        for event in events.events
        if id(event) not in detections
        and not (isinstance(event, Command) and event.phase == Phase.DONE)
    ]
    desk = Desk()
    desk.feed(begun)
    desk.tick(1.0)
    assert (desk.statuses[-1]["grid_done"], desk.statuses[-1]["missing_m"]) == (4, [])
    desk.tick(1.0 + STUCK_S)  # without any further message
    last = desk.statuses[-1]
    assert len(last["missing_m"]) == len(last["missing_n"]) == 21
    desk.tick(2.0 + STUCK_S)
    assert desk.statuses[-1] is last  # once
    desk.feed(events.detections[4:6])
    desk.tick(3.0 + STUCK_S)
    assert len(desk.statuses[-1]["missing_m"]) == 19
