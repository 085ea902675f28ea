# SPDX-License-Identifier: Apache-2.0
"""The session of the collector: when it publishes what, and what it warns of."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.collection.clock_steps import ClockStep
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.result import with_input
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.journal_keeper import take_up
from selfcal_ros.nodes.sessions.rejections import PATIENCE_S
from selfcal_ros.nodes.sessions.solving import SolvingSession, solve
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.topics import DETECTION_TOPIC, ENCODER_TOPIC, INPUT_TOPICS
from test.support.collecting import detection_table, encoder_block
from test.support.misplaced import laid
from test.support.ports import START_NS, Hands, message, settings_of
from test.support.sessions import events_of, small_plan
from test.support.truth import random_truth


def as_message(fields: dict) -> object:
    """Return nested fields as an object with attributes."""
    return SimpleNamespace(
        **{
            key: as_message(value) if isinstance(value, dict) else value
            for key, value in fields.items()
        }
    )


class Desk:
    """A session that is fed simulated messages at the instants of their stamps."""

    def __init__(self, **parameters) -> None:
        self.hands = Hands()
        self.session = CollectingSession(
            settings_of("measurement_collector", **parameters), self.hands.ports
        )

    def feed(self, events: list, *, ahead_s: float = 0.0, run_id: str = "") -> None:
        """Give events; the cell's clock is ahead by so much, commands are on this machine's."""
        for event in events:
            at = (event.stamp_ns - START_NS) * 1e-9 + 100.0
            self.hands.seconds = max(self.hands.seconds, at)
            if isinstance(event, Command):
                message = as_message(event_fields(event, "stage")[1])
                message.run_id = run_id
                self.session.take_command(message, False)
                continue
            event = replace(event, stamp_ns=event.stamp_ns + round(ahead_s * 1e9))
            if isinstance(event, Detection):
                self.session.take_detections(detection_table(event))
            else:
                self.session.take_encoder(encoder_block(event))

    def told(self, matched: bool = True):
        return self.session.diagnosis(detections_matched=matched)


def first_view(plan: str = "0", **changes) -> list:
    """Return the messages of the first view alone, still open."""
    events = events_of(small_plan(plan, repeats=1))
    commands = [
        index for index, event in enumerate(events) if isinstance(event, Command)
    ]
    return events[: commands[2]]


@pytest.mark.parametrize("seconds, published", [(0.49, 0), (0.5, 1)])
def test_status_period(seconds, published):
    desk = Desk(status_period=0.5)
    desk.feed(first_view()[:-1])
    desk.session.tick()
    before, began = len(desk.hands.of("status")), desk.hands.seconds
    assert before == 1
    desk.feed(first_view()[-1:])
    desk.hands.seconds += seconds - (desk.hands.seconds - began)
    desk.session.tick()
    assert len(desk.hands.of("status")) == before + published


def test_nothing_new_is_not_told_again():
    desk = Desk()
    desk.feed(first_view())
    desk.session.tick()
    desk.hands.pass_time(60)
    desk.session.tick()
    assert len(desk.hands.of("status")) == 1


def test_a_view_is_published_when_it_is_complete_and_again_only_when_it_changes():
    desk = Desk(status_period=0.02)
    events = first_view()
    desk.feed(events[:-40])
    desk.session.tick()
    assert not desk.hands.of("measurement")
    desk.feed(events[-40:])
    desk.hands.pass_time(1)
    desk.session.tick()
    assert len(desk.hands.of("measurement")) == 1
    desk.feed([event for event in events if isinstance(event, EncoderSample)][-1:])
    desk.hands.pass_time(1)
    desk.session.tick()
    assert len(desk.hands.of("measurement")) == 1
    assert [name for name, _ in desk.hands.published][-2:] == ["status", "status"]


def test_which_views_a_status_is_of():
    """The view that is measured, each that is not complete, and the last one when it is over."""
    desk, events = Desk(), events_of(small_plan("0, 90, tx", repeats=1))[:-1]  # no DONE
    places = [
        n
        for n, event in enumerate(events)
        if isinstance(event, Command) and event.phase == Phase.PLACE
    ]
    views = [
        events[begin:end]
        for begin, end in zip(places, [*places[1:], None], strict=True)
    ]
    views[1].remove(next(event for event in views[1] if isinstance(event, Detection)))
    views.append(
        [replace(event, stamp_ns=event.stamp_ns + 10 * 10**9) for event in views[0]]
    )
    told = []
    for view in views:
        desk.feed(view, run_id="1")
        desk.hands.pass_time(1)
        desk.session.tick()
        told.append([fields["view_index"] for fields in desk.hands.of("status")])
        desk.hands.published.clear()
    assert told == [[0], [1], [1, 2], [1, 3], [0, 1, 3]]


def test_a_step_that_is_found_behind_the_readings_is_sent_with_them_once():
    desk, events = Desk(), events_of(small_plan("0", repeats=1))
    sample = next(
        event for event in reversed(events) if isinstance(event, EncoderSample)
    )
    desk.feed(events)
    desk.session.tick()
    desk.hands.published.clear()
    desk.session._clock.steps["stage/joint_states"] = [
        ClockStep(sample.stamp_ns, 10**9)
    ]
    for _ in range(2):
        desk.session.take_encoder(encoder_block(sample))
        desk.hands.pass_time(1)
        desk.session.tick()
    [sent] = desk.hands.of("measurement")
    [note] = sent["session_notes"]
    assert "the clock that stamps stage/joint_states stepped ahead by 1 s" in note


@pytest.mark.parametrize(
    "spoilt, lines",
    [
        (1, ["view '0': 1 detection rejected as sigma_out_of_range: their sigma is"]),
        (
            1000,
            ["74 of 74 detections were rejected as sigma_out_of_range: their sigma is"],
        ),
    ],
)
def test_what_would_correct_rejections_is_said_once_when_a_view_is_over(spoilt, lines):
    desk, events = Desk(), events_of(small_plan("0, 0", repeats=1))
    marks = [n for n, event in enumerate(events) if isinstance(event, Detection)]
    for n in marks[:spoilt]:
        events[n] = replace(events[n], sigma=1e4)
    for part in (events, events[-3:]):
        desk.feed(part)
        desk.session.tick()
        desk.hands.pass_time(PATIENCE_S)
        desk.session.tick()
    said = [
        line for line in desk.hands.lines(Level.WARN) if "sigma_out_of_range" in line
    ]
    assert [text[: len(line)] for text, line in zip(said, lines, strict=True)] == lines


def test_every_message_of_a_run_names_it():
    desk = Desk()
    desk.feed(events_of(small_plan("0", repeats=1)), run_id="17")
    desk.session.tick()
    assert {
        fields["run_id"]
        for output, fields in desk.hands.published
        if output != "progress"
    } == {"17"}
    assert desk.told().values["run_id"] == "17"
    assert desk.told().values["phase"] == "DONE"


@pytest.mark.parametrize(
    "ahead_s, complete",
    [
        (0.0, True),
        (0.1, True),
        (0.101, False),
        (1.0, False),
        (37.0, False),
        (-0.0001, True),
    ],
)
def test_a_view_is_not_called_complete_on_stamps_from_the_future(ahead_s, complete):
    desk = Desk(clock_limit=0.1)
    desk.feed(first_view(), ahead_s=ahead_s)
    desk.session.tick()
    assert desk.hands.of("status")[-1]["complete"] is complete
    told = desk.told()
    assert ("clock" in told.message) is not complete
    if not complete:
        assert told.level == Level.WARN
        assert (
            f"the cell's clock is {ahead_s:.3g} s ahead of this machine's"
            in told.message
        )


def test_a_clock_behind_is_told():
    desk = Desk(clock_limit=0.1)
    desk.feed(first_view(), ahead_s=-1.0)
    assert "the cell's clock is 1 s behind this machine's" in desk.told().message


@pytest.mark.parametrize(
    "by_s, words",
    [
        (-1.0, "stepped back by 1 s in view '"),
        (37.0, "stepped ahead by 37 s in view '"),
    ],
)
def test_a_clock_that_steps_within_a_view_is_said_once_and_told_to_the_end_of_the_run(
    by_s, words
):
    desk, events = Desk(), events_of(small_plan("0, 90"))
    half = next(
        n
        for n, event in enumerate(events)
        if event.stamp_ns > events[0].stamp_ns + 4 * 10**8
    )
    desk.feed(events[:half], run_id="1")
    assert desk.told().level == Level.OK
    desk.feed(events[half:], ahead_s=by_s, run_id="1")
    desk.session.tick()
    assert words in desk.told().message and desk.told().level == Level.WARN
    last = next(event for event in reversed(events) if isinstance(event, EncoderSample))
    desk.session.take_encoder(encoder_block(last))
    desk.session.tick()
    assert sum(words in line for line in desk.hands.lines(Level.WARN)) == 1
    again = [replace(event, stamp_ns=event.stamp_ns + 100 * 10**9) for event in events]
    desk.feed(again, run_id="2")
    desk.session.tick()
    assert words not in desk.told().message


def solved_live(desk: Desk):
    """Return the result of what the collector's session has published."""
    session = SolvingSession(settings_of("solver"), Hands().ports)
    for fields in desk.hands.of("measurement"):
        session.take_measurement(message("ViewMeasurement", fields))
    session.take(solve(session.next_job()))
    return session.result


def logged(folder, events: list):
    """Write a bag of these events and the instants at which they were logged; return `folder`."""
    with BagWriter(folder) as writer:
        for topic, typename in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [])
        for event, logged_ns in events:
            topic, fields = event_fields(event, "stage")
            writer.write(f"/{topic}", fields, logged_ns)
    return folder


def solved_offline(folder):
    found = collect_bag(folder, settings_of("measurement_collector"))
    return with_input(calibrate(found.measurements), {}, found.lost)


@pytest.mark.parametrize("by_s", [0.15, -0.3])
def test_a_clock_that_stepped_is_in_the_live_result_as_in_the_offline_one(
    tmp_path, by_s
):
    desk, events = Desk(), events_of(small_plan("0, 90, tx", repeats=4))
    half = (
        next(
            n
            for n, event in enumerate(events)
            if isinstance(event, Command) and event.view_index == 1
        )
        + 400
    )
    later = [
        event
        if isinstance(event, Command)
        else replace(event, stamp_ns=event.stamp_ns + round(by_s * 1e9))
        for event in events[half:]
    ]
    desk.feed(events[:half])
    desk.session.tick()
    desk.feed(events[half:], ahead_s=by_s)
    desk.session.tick()
    desk.session.finish()
    live = solved_live(desk)
    bag = logged(
        tmp_path / "bag",
        [
            *zip(
                [*events[:half], *later],
                [event.stamp_ns for event in events],
                strict=True,
            )
        ],
    )
    offline = solved_offline(bag)
    lines = [
        [
            re.sub(r"at \d+\.\d{3} s", "at T", line)
            for line in result.warnings
            if "clock" in line
        ]
        for result in (live, offline)
    ]
    assert lines[0] == lines[1]
    assert len(lines[0]) == 1
    assert (
        f"{'ahead' if by_s > 0 else 'back'} by {abs(by_s)} s in view '90', at T: "
        in lines[0][0]
    )
    assert [line for line in live.warnings if "clock" in line] == desk.session._stepped
    np.testing.assert_array_equal(live.error_map.gx, offline.error_map.gx)
    again = Desk()  # that takes up the journal
    taken = take_up([*bag.glob("*.mcap")], again.session.settings)
    again.session.adopt(taken.collector, "journal", taken.steps)
    again.session.finish()
    assert [line for line in offline.warnings if "clock" in line] == again.hands.of(
        "measurement"
    )[-1]["session_notes"]


def test_what_has_waited_for_a_restarted_collector_is_no_step(tmp_path):
    events = events_of(small_plan("0, 90, tx", repeats=4))
    half, waited = len(events) // 2, 400
    ready_ns = events[half + waited].stamp_ns + 2 * 10**9
    later = [
        replace(event, stamp_ns=event.stamp_ns + 5 * 10**9)
        for event in events[half + waited :]
    ]
    before = logged(tmp_path / "0", [(item, item.stamp_ns) for item in events[:half]])
    after = logged(
        tmp_path / "1",
        [(item, ready_ns) for item in events[half : half + waited]]
        + [(item, item.stamp_ns) for item in later],
    )
    files = [*before.glob("*.mcap"), *after.glob("*.mcap")]
    steps = take_up(files, settings_of("measurement_collector")).steps
    assert steps == {ENCODER_TOPIC: [], DETECTION_TOPIC: []}
    assert take_up(files[1:], settings_of("measurement_collector")).steps != steps


def test_no_step_no_note(tmp_path):
    desk = Desk()
    desk.feed(events_of(small_plan("0, 90, tx")))
    desk.session.finish()
    assert {
        len(fields["session_notes"]) for fields in desk.hands.of("measurement")
    } == {0}


def test_a_clock_that_steps_with_this_machines_is_found_by_the_steady_clock(
    monkeypatch,
):
    desk, events = Desk(), events_of(small_plan("0, 90"))
    half = len(events) // 2
    desk.feed(events[:half], run_id="1")
    monkeypatch.setattr(
        Hands,
        "now_ns",
        property(lambda hands: START_NS + round((hands.seconds - 137.0) * 1e9)),
    )
    desk.feed(
        [
            replace(event, stamp_ns=event.stamp_ns - 37 * 10**9)
            if isinstance(event, Command)
            else event
            for event in events[half:]
        ],
        ahead_s=-37.0,
        run_id="1",
    )
    desk.session.tick()
    assert "stepped back by 37 s" in desk.told().message


@pytest.mark.parametrize("late_s, checked", [(1.0, True), (1.01, False)])
def test_recorded_messages_are_not_held_against_the_clock(late_s, checked):
    desk = Desk()
    desk.hands.pass_time(late_s)  # all stamps lie in the past by that
    events = first_view()
    for event in events:
        desk.hands.seconds = (event.stamp_ns - START_NS) * 1e-9 + 100.0 + late_s
        desk.feed([event])
    assert ("clock_offset_s" in desk.told().values) is checked


@pytest.mark.parametrize("seconds, heard", [(1.0, "yes"), (1.01, "no")])
def test_the_encoder_is_heard_for_a_second(seconds, heard):
    desk = Desk()
    desk.feed(first_view())
    desk.hands.pass_time(seconds)
    told = desk.told(matched=False)
    assert (told.values["encoder_heard"], told.values["detections_matched"]) == (
        heard,
        "no",
    )
    assert (told.level == Level.WARN) is (heard == "no")


def test_a_gap_of_the_encoder_is_told_while_a_view_is_measured():
    desk = Desk(max_encoder_gap=0.1)
    events = first_view()
    encoder = [event for event in events if isinstance(event, EncoderSample)]
    cut = encoder[10].stamp_ns
    desk.feed(
        [
            event
            for event in events
            if isinstance(event, Command)
            or not cut < event.stamp_ns < cut + 150_000_000
        ]
    )
    assert (
        "s between encoder samples: exposures in it are rejected" in desk.told().message
    )
    # of the last second only
    assert "between encoder samples" not in desk.told().message


@pytest.mark.parametrize(
    "limit, level", [(1e-12, Level.WARN), (1e-3, Level.OK), (0.0, Level.OK)]
)
def test_repeatability_against_its_limit(limit, level):
    desk = Desk(repeatability_xy_limit=limit)
    desk.feed(events_of(small_plan("0", repeats=2)))
    desk.session.tick()
    told = desk.told()
    assert told.level == level
    assert float(told.values["repeatability_xy_um"]) == pytest.approx(0.02, rel=0.5)


def test_a_wrong_sense_is_told_in_the_log_and_in_the_health():
    desk = Desk(measurement_sense="plate_moves", status_period=0.02)
    desk.feed(first_view())
    desk.session.tick()
    assert (desk.told().level, desk.hands.lines(Level.WARN)) == (Level.OK, [])
    desk.hands.pass_time(PATIENCE_S)
    desk.session.tick()
    [line] = desk.hands.lines(Level.WARN)
    assert "measurement_sense" in line
    told = desk.told()
    assert told.level == Level.WARN
    assert told.message.startswith(line)


def complete(desk) -> bool:
    return desk.hands.of("status")[-1]["complete"]


@pytest.mark.parametrize("missing, told", [(0, True), (1, False)])
def test_a_view_is_told_complete_at_once_whatever_the_period(missing, told):
    desk, events = Desk(status_period=60.0), first_view()
    last = max(event.stamp_ns for event in events if isinstance(event, Detection))
    before = [event for event in events if event.stamp_ns < last]
    dropped = [event for event in before[60:] if isinstance(event, Detection)][:missing]
    desk.feed(before[:60])
    desk.session.tick()
    desk.feed([event for event in before[60:] if event not in dropped])
    desk.session.tick()
    desk.feed([event for event in events if event.stamp_ns == last])
    desk.hands.pass_time(0.001)
    desk.session.tick()
    assert len(desk.hands.of("status")) == 1  # no sample beside the last exposure yet
    desk.feed([event for event in events if event.stamp_ns > last])
    desk.session.tick()
    assert complete(desk) is told
    assert len(desk.hands.of("status")) == 1 + told
    assert len(desk.hands.of("measurement")) == told


def closing(**parameters) -> tuple[Desk, list, list]:
    """Return a desk that waits for the last mark of a view, that detection, and what is behind."""
    desk, events = Desk(status_period=60.0, **parameters), first_view()
    last = max(event.stamp_ns for event in events if isinstance(event, Detection))
    desk.hands.costs = 0.01
    desk.feed([event for event in events if event.stamp_ns < last])
    desk.session.tick()  # because of the command, whatever the period
    return (
        desk,
        [event for event in events if event.stamp_ns == last],
        [event for event in events if event.stamp_ns > last],
    )


def test_a_complete_view_does_not_wait_because_the_last_status_was_dear():
    desk, detection, behind = closing()
    desk.feed([*detection, *behind])
    desk.hands.seconds = desk.session._next_status - 59.999  # as good as now
    desk.session.tick()
    assert complete(desk)


def test_early_looks_in_vain_take_a_sixth_of_the_time_at_most():
    desk, [detection], behind = closing()
    wrong = [
        replace(detection, k=77, stamp_ns=detection.stamp_ns + number)
        for number in range(3)
    ]
    desk.feed([*wrong[:1], *behind])
    desk.session.tick()
    began = desk.hands.seconds - desk.hands.costs
    assert len(desk.hands.of("status")) == 2
    for after_s, told in ((0.0499, 2), (0.0501, 3)):
        desk.session.take_detections(detection_table(wrong.pop()))
        desk.hands.seconds = began + after_s
        desk.session.tick()
        assert len(desk.hands.of("status")) == told


def test_joints_that_tell_their_samples_apart_are_waited_for():
    desk, detection, behind = closing()
    block = encoder_block(behind[0])
    assert block.names == ("x", "y", "theta")
    desk.feed(detection)
    for column, name in enumerate(block.names):
        assert not complete(desk)
        assert len(desk.hands.of("status")) == 1
        desk.session.take_encoder(
            replace(
                block,
                names=(name,),
                velocities=None,
                positions=block.positions[:, column : column + 1],
            )
        )
        desk.session.tick()
    assert complete(desk)


@pytest.mark.parametrize("is_early", [True, False])
def test_a_detection_stamped_in_the_future_holds_up_no_other(is_early):
    desk, detection, behind = closing()
    [last] = detection
    stray = replace(last, stamp_ns=last.stamp_ns + 3600 * 10**9)
    desk.session.take_detections(detection_table(stray))
    if is_early:  # a status has told of it
        desk.hands.pass_time(61.0)
        desk.session.tick()
    before = len(desk.hands.of("status"))
    desk.feed(detection)
    desk.session.tick()
    assert len(desk.hands.of("status")) == before
    desk.feed(behind)
    desk.session.tick()
    assert len(desk.hands.of("status")) == before + 1
    assert len(desk.hands.of("measurement")) == 1


@pytest.mark.parametrize("more, expected", [(0, False), (1, True)])
def test_detections_that_are_not_decoded_yet_are_reckoned_with(more, expected):
    desk, _, _ = closing()
    assert desk.session.expects_end(more) is expected


@pytest.mark.parametrize("after_ns, expected", [(-1, False), (0, True), (1, True)])
def test_a_detection_counts_for_its_view_from_the_instant_of_its_command_on(
    after_ns, expected
):
    desk, [last], _ = closing()
    begin = desk.session.collector.timeline.intervals[-1].start_ns
    assert begin == next(
        event.stamp_ns
        for event in first_view()
        if isinstance(event, Command) and event.phase == Phase.MEASURE
    )
    desk.session.take_detections(
        detection_table(replace(last, stamp_ns=begin + after_ns))
    )
    assert desk.session.expects_end() is expected


def test_the_health_tells_what_a_status_costs():
    desk = Desk(status_period=0.02)
    names = ("status_ms", "status_ms_max", "status_cpu_ms_max")
    assert [desk.told().values[name] for name in names] == ["0.0"] * 3
    desk.feed(first_view())
    for spent in (0.001, 0.007, 0.002):
        desk.hands.costs, desk.hands.works = spent, spent / 2
        desk.hands.pass_time(1)
        desk.session.take_detections(
            detection_table(
                next(event for event in first_view() if isinstance(event, Detection))
            )
        )
        desk.session.tick()
    assert [desk.told().values[name] for name in names] == ["2.0", "7.0", "3.5"]


@pytest.mark.parametrize(
    "limit, level", [(0.0, Level.OK), (0.00019, Level.WARN), (0.00021, Level.OK)]
)
def test_the_jitter_of_the_encoder_is_told_and_held_against_its_limit(limit, level):
    desk = Desk(encoder_jitter_limit=limit)
    events = first_view()
    stamps = {
        id(event): number
        for number, event in enumerate(
            event for event in events if isinstance(event, EncoderSample)
        )
    }
    desk.feed(
        [
            replace(event, stamp_ns=event.stamp_ns + 200_000 * (stamps[id(event)] % 2))
            if id(event) in stamps
            else event
            for event in events
        ]
    )
    told = desk.told()
    assert float(told.values["encoder_jitter_s"]) == pytest.approx(2e-4, rel=0.01)
    assert told.level == level
    assert ("vary by 0.0002 s, the limit is 0.00019 s" in told.message) is (
        level == Level.WARN
    )


def test_a_sigma_that_cannot_be_costs_that_detection_and_is_a_warning():
    desk, events = Desk(), first_view()
    index = next(n for n, event in enumerate(events) if isinstance(event, Detection))
    events[index] = replace(events[index], sigma=1e4)
    desk.feed(events)
    desk.session.tick()
    status = desk.hands.of("status")[-1]
    assert (status["reject_reasons"], status["reject_counts"]) == (
        ["sigma_out_of_range"],
        [1],
    )
    assert status["missing_m"] == [events[index].m] and status["missing_n"] == [
        events[index].n
    ]
    told = desk.told()
    assert told.level == Level.WARN
    assert (
        "1 detection rejected as sigma_out_of_range: their sigma is not a "
        in told.message
    )
    assert told.values["rejected sigma_out_of_range"] == 1


def test_reversed_offsets_are_an_error_while_the_first_view_is_measured():
    desk = Desk()
    rng = np.random.default_rng(4)
    plan = small_plan(repeats=6)
    cell = CellSettings(sigma_xy_m=1e-8, servo_sigma_m=5e-8, sigma_theta_rad=1e-5)
    events = list(
        plan_events(
            random_truth(plan.artifact, 4, rng),
            plan,
            settings=cell,
            rng=rng,
            start_ns=START_NS,
        )
    )
    spoilt = [
        replace(e, offset_y=-e.offset_y) if isinstance(e, Detection) else e
        for e in events
    ]
    end = next(
        i for i, e in enumerate(spoilt) if isinstance(e, Command) and e.view_index == 1
    )
    for event in spoilt[:end]:
        desk.feed([event])
        desk.session.tick()
        if desk.told().level is Level.ERROR:
            break
    (line,) = [line for level, line in desk.hands.said if level is Level.ERROR]
    assert line.startswith(
        "stage/mark_detections: offsets of the other sign: offset_y rises where"
    )
    assert desk.told().message.startswith(line)
    assert 0 < len(desk.session.collector.collect()[0].views[0].visits.mark) < 150
    desk.feed(spoilt[end:])
    desk.session.tick()
    assert [line for level, line in desk.hands.said if level is Level.ERROR] == [line]


def test_a_plate_laid_the_other_way_round_is_an_error_during_the_next_view():
    cell, _ = laid("0, 90, tx, ty", "0, 270, tx, ty", with_ids=False)
    last = {c.view_index: c.stamp_ns for c in cell.commands}
    desk, events = Desk(), sorted(cell.events, key=lambda e: e.stamp_ns)
    for number, event in enumerate(events):
        desk.feed([event])
        if number % 50 == 0:
            desk.session.tick()
        if desk.told().level is Level.ERROR:
            break
    (line,) = [line for level, line in desk.hands.said if level is Level.ERROR]
    assert line == (
        "view '90': the plate lies turned by 270°, not by 90°; turn it counter-"
        "clockwise and measure this view again, or correct its pose in the plan"
    )
    assert last[2] < event.stamp_ns < last[3] and desk.told().message.startswith(line)
