# SPDX-License-Identifier: Apache-2.0
"""What the collector publishes and says while messages come, without any middleware."""

from dataclasses import replace

import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Command, Detection, Phase
from selfcal_ros.model.readings import Sense
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Level, Ports
from selfcal_ros.nodes.sessions.rejections import PATIENCE_S
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.collecting import gathered, scene
from test.support.ports import message


class Cell:
    """A session, what it published and said, and a clock that moves by itself."""

    def __init__(self, **parameters):
        self.published, self.said, self.now = [], [], 0.0
        values = CollectorSettings.checked(parameters, "test")
        self.session = CollectingSession(
            values,
            Ports(
                lambda output, fields: self.published.append((output, fields)),
                lambda level, line: self.said.append((level, line)),
                self._now,
                lambda: 0,
            ),
        )

    def _now(self):
        self.now += 1e-3
        return self.now

    def feed(self, events):
        collector = self.session.collector
        for event in events:
            (
                collector.add_command
                if isinstance(event, Command)
                else collector.add_detection
                if isinstance(event, Detection)
                else collector.add_encoder
            )(event)
        self.now += 10.0
        self.session._dirty = True
        self.session.tick()
        return self

    def wait(self):
        self.now += PATIENCE_S
        self.session.tick()

    def of(self, output):
        return [fields for name, fields in self.published if name == output]


def test_a_wrong_sense_is_said_once_while_the_view_is_measured():
    cell, events = Cell(), scene(count=0, sense=Sense.PLATE_MOVES)
    half = events.detections[12].stamp_ns
    cell.feed(e for e in events.events if e.stamp_ns < half)
    assert cell.said == []  # encoder samples and commands may be late
    cell.wait()
    assert [level for level, _ in cell.said] == [Level.WARN]
    said = cell.said[0][1]  # one view does not tell both
    assert said.startswith(
        "12 of 12 detections were rejected as stage_not_at_mark: the plate lies "
        "turned by 180°, not by 0° (or its ids are those of other marks); turn "
        "it as planned"
    )
    assert (
        "the stage is indicated at minus the marks' sites; the sense is reversed"
        in said
    )
    cell.feed(e for e in events.events if e.stamp_ns >= half)
    assert len(cell.said) == 1


def test_a_view_of_which_all_was_rejected_is_published_as_it_is_offline():
    cell, events = Cell(), scene("0, 90", count=0)
    for index in range(25):
        events.spoil(index, m=77)
    cell.feed(events.events).wait()
    rejected, good = cell.of("measurement")
    assert (rejected["view_index"], rejected["m"].size) == (0, 0)
    assert (rejected["reject_reasons"], rejected["reject_counts"]) == (
        ["unknown_mark"],
        [25],
    )
    assert good["detections_used"] == 25
    assert cell.said[0][1].startswith(
        "view '0': 25 of 25 detections were rejected as unknown_mark"
    )


def without_first_view():
    events = scene("0, 90", count=0)
    begin = next(c for c in events.commands if c.view_index == 1).stamp_ns
    return [e for e in events.events if isinstance(e, Command) or e.stamp_ns > begin]


def test_a_view_of_which_nothing_came_is_published_empty_when_it_is_over_as_offline():
    events = without_first_view()
    cell = Cell().feed(events)
    assert [
        (fields["view_index"], len(fields["m"])) for fields in cell.of("measurement")
    ] == [(0, 0), (1, 25)]
    assert [len(view.m) for view in gathered(events).collect()[0].views] == [0, 25]
    begun = [e for e in events if isinstance(e, Command)][:2]
    assert Cell().feed(begun).of("measurement") == []  # it is still to be measured


def test_a_view_that_a_collector_before_this_one_may_have_sent_is_not_published_empty():
    cell, events = Cell(), without_first_view()
    for command in [e for e in events if isinstance(e, Command)][:2]:
        cell.session.take_command(
            message("ViewCommand", from_model.command(command, "s")), True
        )
    cell.feed(events)
    assert [fields["view_index"] for fields in cell.of("measurement")] == [1]


def test_status_names_the_run_and_what_is_missing():
    events = scene(count=0)
    events.commands = [replace(c, run_id="77") for c in events.commands]
    lost = events.detections.pop(7)
    status = Cell().feed(events.events).of("status")[-1]
    assert (status["missing_m"], status["missing_n"]) == ([lost.m], [lost.n])
    assert (status["run_id"], status["complete"]) == ("77", False)


@pytest.mark.parametrize(
    ("heard", "missed"),
    [
        ([(0, Phase.MEASURE, True)], ["0"]),
        ([(0, Phase.MEASURE, False)], []),
        ([(0, Phase.PLACE, True), (0, Phase.MEASURE, True)], ["0"]),
        ([(0, Phase.PLACE, False), (0, Phase.MEASURE, False)], []),
        (
            [(0, Phase.MEASURE, True), (0, Phase.PLACE, False)],
            ["0"],
        ),  # the redo has not begun
        (
            [
                (0, Phase.MEASURE, True),
                (0, Phase.PLACE, False),
                (0, Phase.MEASURE, False),
            ],
            [],
        ),
        (
            [
                (0, Phase.MEASURE, True),
                (1, Phase.PLACE, False),
                (1, Phase.MEASURE, False),
            ],
            ["0"],
        ),
        ([(0, Phase.MEASURE, True), (0, Phase.MEASURE, False)], ["0"]),
    ],
)
def test_a_view_that_began_before_the_node_is_missed_until_it_is_measured_again(
    heard, missed
):
    """Commands: view, phase, and whether it was published before this node listened."""
    events, cell = scene("0, 90", count=0), Cell()
    for number, (view, phase, is_older) in enumerate(heard):
        like = next(
            c for c in events.commands if (c.view_index, c.phase) == (view, phase)
        )
        cell.session.take_command(
            message(
                "ViewCommand",
                from_model.command(
                    replace(like, stamp_ns=events.commands[0].stamp_ns + number),
                    "stage",
                ),
            ),
            is_older,
        )
    assert list(cell.session.missed.values()) == missed
    late = heard[-1][2] or (Phase.MEASURE, True) in [item[1:] for item in heard]
    assert [line for _, line in cell.said] == (
        [
            "view '0' began before this node: earlier detections are missing here; "
            "redo_view measures it again"
        ]
        if late
        else []
    )
    state = cell.session.diagnosis(detections_matched=True).message
    assert state.endswith("began before this node: 0") == bool(missed)


@pytest.mark.parametrize("run_id", ["", "b"])
def test_a_second_run_is_published_anew(run_id):
    events = scene("0, 90", count=0)
    cell = Cell().feed(events.events)
    first = cell.of("measurement")
    later = [replace(e, stamp_ns=e.stamp_ns + 10**12) for e in events.events]
    later = [replace(e, run_id=run_id) if isinstance(e, Command) else e for e in later]
    begin = next(
        e.stamp_ns for e in later if isinstance(e, Command) and e.view_index == 1
    )
    cell.feed(e for e in later if e.stamp_ns < begin)
    second = cell.of("measurement")[len(first) :]
    assert [fields["view_index"] for fields in first] == [0, 1]
    assert [fields["view_index"] for fields in second] == [0]
    assert (
        first[0]["run_id"]
        != second[0]["run_id"]
        == (run_id or str(events.commands[0].stamp_ns + 10**12))
    )
    assert second[0]["session_reject_reasons"] == ["other_run"]


def test_a_run_with_two_plates_is_an_error_until_the_next_run():
    cell, events = Cell(), scene("0, 90", count=0)
    first = events.commands[0]
    other = replace(
        first,
        artifact=replace(first.artifact, grid_size=7),
        view_index=1,
        stamp_ns=first.stamp_ns + 5,
        phase=Phase.MEASURE,
    )
    run = [
        replace(event, run_id="1") if isinstance(event, Command) else event
        for event in events.events
    ]
    cell.feed([*run, replace(other, run_id="1")])
    [(level, line)] = cell.said
    assert (level, line.partition("use one")[2]) == (
        Level.ERROR,
        " plate in one plan; then start a new run",
    )
    told = cell.session.diagnosis(detections_matched=True)
    assert told.level == Level.WARN and "describes a different plate" in told.message
    later = events.commands[-1].stamp_ns + 10**9
    cell.feed(
        [
            replace(
                first,
                stamp_ns=later,
                run_id=str(later),
                phase=Phase.MEASURE,
                artifact=replace(first.artifact, grid_size=7),
            )
        ]
    )
    assert len(cell.said) == 1
    told = cell.session.diagnosis(detections_matched=True)
    assert "another plate" not in told.message
