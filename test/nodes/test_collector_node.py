# SPDX-License-Identifier: Apache-2.0
"""measurement_collector: the QoS it takes the encoder with, status, finish, readings sent on."""

import time
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from rclpy.duration import Duration
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from selfcal_msgs.msg import MarkDetection, ViewCommand
from std_srvs.srv import Trigger

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.inputs import Command, Detection, Phase
from selfcal_ros.model.readings import readings_digest, session_digest
from selfcal_ros.nodes import base, measurement_collector, names
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.sessions import rejections
from selfcal_ros.units import NS_PER_S
from test.support.collecting import scene
from test.support.plans import image_plan, plan_of
from test.support.ros import publish_events
from test.support.sessions import collected, events_of, small_plan

FINISH = "measurement_collector/finish"


def encoder_subscriptions(graph) -> list[ReliabilityPolicy]:
    return [
        info.qos_profile.reliability
        for info in graph.hand.get_subscriptions_info_by_topic("/stage/joint_states")
    ]


def received(node, counts: dict[str, int]) -> bool:
    return list(node.session.collector.received.values()) == list(counts.values())


@pytest.mark.parametrize(
    "offer, policy",
    [
        (names.ENCODER, ReliabilityPolicy.RELIABLE),
        (names.ENCODER_EITHER[1], ReliabilityPolicy.BEST_EFFORT),
    ],
)
def test_the_encoder_is_taken_as_it_is_offered(graph, offer, policy):
    node = graph.node(MeasurementCollector)
    publisher = graph.publisher(offer)
    assert encoder_subscriptions(graph) == [policy]
    publisher.publish(names.ENCODER.type(name=["x"], position=[1.0]))
    graph.until(lambda: node.session.collector.received["encoder"] == 1, "the sample")


def test_an_encoder_that_becomes_best_effort_is_still_heard(graph):
    node = graph.node(MeasurementCollector)
    graph.publisher(names.ENCODER)
    graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER_EITHER[1].qos
    )
    graph.until(
        lambda: encoder_subscriptions(graph) == [ReliabilityPolicy.BEST_EFFORT],
        "a subscription that matches both publishers",
    )
    for publisher in list(graph.hand.publishers):
        if publisher.topic_name == "/stage/joint_states":
            graph.until(lambda p=publisher: p.get_subscription_count() == 1, "a match")
            publisher.publish(names.ENCODER.type(name=["x"], position=[1.0]))
    graph.until(lambda: node.session.collector.received["encoder"] == 2, "both samples")


def test_a_late_listener_receives_every_cell_of_every_view(graph):
    """Images of 7 x 7 marks: 98 measurements, which were published before it came."""
    events = scene(image_plan(7, marks=7)).events
    node = graph.node(MeasurementCollector)
    early = graph.listen(names.MEASUREMENT)
    counts = publish_events(graph, events)
    graph.until(lambda: received(node, counts), "all messages")
    assert graph.call(Trigger, FINISH).success
    graph.until(lambda: len({m.view_name for m in early}) == 2 * 49, "all cells")
    late = graph.listen(names.MEASUREMENT)
    graph.until(
        lambda: {m.view_name for m in late} == {m.view_name for m in early}, "all again"
    )


def test_what_it_publishes_is_what_the_messages_hold_bit_for_bit(graph):
    events = events_of(small_plan())
    _, measurements, progress = collected(events)
    node = graph.node(MeasurementCollector)
    heard, status = graph.listen(names.MEASUREMENT), graph.listen(names.STATUS)
    counts = publish_events(graph, events)
    graph.until(lambda: received(node, counts), "all messages")
    answer = graph.call(Trigger, FINISH)
    expected = {
        index: readings_digest(item.readings, measurements.rejected)
        for index, item in progress.items()
    }
    assert answer.success
    assert answer.message == session_digest(expected)
    graph.until(lambda: {m.view_index for m in heard} == set(expected), "all views")
    newest = {message.view_index: message for message in heard}
    for index, message in newest.items():
        found = readings_digest(to_model.view_readings(message), measurements.rejected)
        assert found == expected[index]
        assert message.plan_id == measurements.plan_id
        assert to_model.artifact_of(message) == measurements.artifact
    graph.until(
        lambda: {m.view_index for m in status if m.complete} == set(expected), "status"
    )


def test_order_of_arrival_changes_nothing(graph):
    events = events_of(small_plan("0, 90", repeats=1))
    _, measurements, progress = collected(events)
    node = graph.node(MeasurementCollector)
    order = np.random.default_rng(3).permutation(len(events))
    counts = publish_events(graph, [events[i] for i in order])
    graph.until(lambda: received(node, counts), "all messages")
    assert graph.call(Trigger, FINISH).message == session_digest(
        {
            index: readings_digest(item.readings, measurements.rejected)
            for index, item in progress.items()
        }
    )


def test_the_status_counts_marks_and_rejections_while_the_view_is_open(graph):
    events = events_of(small_plan("0", repeats=1))
    commands = [
        index for index, event in enumerate(events) if isinstance(event, Command)
    ]
    events = events[: commands[2]]  # the first view alone, still open
    detections = [event for event in events if isinstance(event, Detection)]
    events.remove(detections[3])
    events += [detections[0], replace(detections[7], m=9)]
    graph.node(MeasurementCollector, status_period=0.02)
    status = graph.listen(names.STATUS)
    publish_events(graph, events)
    graph.until(
        lambda: status and status[-1].detections_rejected == 2, "the rejections"
    )
    last = status[-1]
    assert (last.grid_expected, last.grid_done) == (25, 24)
    assert (last.angular_expected, last.angular_done) == (8, 8)
    assert dict(zip(last.reject_reasons, last.reject_counts, strict=True)) == {
        "duplicate": 1,
        "unknown_mark": 1,
    }
    assert last.detections_used == 32
    assert not last.complete


def test_the_last_detection_of_a_view_is_not_left_to_the_clock(graph, monkeypatch):
    monkeypatch.setattr(measurement_collector, "TICK_S", 3600.0)
    monkeypatch.setattr(measurement_collector, "SOON_TICKS", 10**9)
    events = events_of(small_plan("0", repeats=1))
    commands = [
        index for index, event in enumerate(events) if isinstance(event, Command)
    ]
    node = graph.node(MeasurementCollector, status_period=60.0)
    measured, status = graph.listen(names.MEASUREMENT), graph.listen(names.STATUS)
    publish_events(graph, [events[index] for index in commands[:2]])
    graph.until(lambda: len(node._reception._waiting) == 2, "the commands")
    node._on_timer()
    publish_events(
        graph,
        [
            event
            for event in events[: commands[2]]
            if event.stamp_ns > events[commands[1]].stamp_ns
        ],
    )
    graph.until(lambda: measured and status and status[-1].complete, "the view")
    graph.until(lambda: node._soon.is_canceled(), "rest")
    assert node._looks < 10**6


@pytest.mark.usefixtures("quick_beat")
def test_timers_that_are_woken_neither_hasten_nor_put_off_the_health(graph):
    node = graph.node(MeasurementCollector)
    told = graph.listen(names.of_node("measurement_collector", names.HEALTH))
    graph.until(lambda: told, "the health")
    while not node._beat.is_ready():
        pass
    for _ in range(20):
        node._soon.reset()
        node._busy.reset()
    before = len(told)
    graph.until(lambda: len(told) > before, "the health")
    graph.call(Trigger, FINISH)  # what was due before has been done
    assert node._beat.time_until_next_call() <= base.BEAT_S * NS_PER_S


@pytest.mark.usefixtures("quick_beat")
def test_a_node_whose_timers_are_due_when_it_is_first_spun_tells_its_health_in_time(
    graph,
):
    node = MeasurementCollector(context=graph.context)
    node.autostart()
    told = graph.listen(names.of_node("measurement_collector", names.HEALTH))
    while not all(timer.is_ready() or timer.is_canceled() for timer in node.timers):
        pass
    graph.add(node)
    graph.until(lambda: told, "the health")
    graph.call(Trigger, FINISH)  # what was due before has been done
    assert node._beat.time_until_next_call() <= base.BEAT_S * NS_PER_S


def test_finish_without_a_command_says_what_is_missing(graph):
    graph.node(MeasurementCollector)
    answer = graph.call(Trigger, FINISH)
    assert not answer.success
    assert answer.message.startswith("selfcal/view_command: no MEASURE command")


def test_a_command_that_cannot_be_used_is_counted_and_does_not_end_the_node(graph):
    node = graph.node(MeasurementCollector)
    commands = graph.publisher(names.COMMAND)
    commands.publish(ViewCommand(phase=9))
    commands.publish(
        ViewCommand(
            phase=1,
            grid=True,
            grid_size=5,
            grid_pitch=0.01,
            repeats=1,
            translation_x=0.0042,
        )
    )
    graph.until(
        lambda: node.session.collector.received["command"] == 2, "both commands"
    )
    publish_events(graph, events_of(small_plan("0", repeats=1)))
    graph.until(
        lambda: node.session.collector.received["command"] == 2 + 5, "the good commands"
    )
    measurements, _ = node.session.collector.collect()
    assert measurements.rejected["command_unusable"] == 2


def small_run(start_s: int) -> list:
    """Return the messages of a plan of two views, all stamps later by `start_s`."""
    return [
        replace(event, stamp_ns=event.stamp_ns + start_s * 10**9)
        for event in events_of(small_plan("0", repeats=1))
    ]


def test_a_view_measured_again_in_a_second_run_is_called_complete(graph):
    first, second = small_run(0), small_run(1000)
    commands = [
        index for index, event in enumerate(second) if isinstance(event, Command)
    ]
    node = graph.node(MeasurementCollector, status_period=0.02)
    counts = publish_events(graph, first)
    graph.until(lambda: received(node, counts), "the first run")
    status = graph.listen(names.STATUS)
    publish_events(graph, second[: commands[2]])  # its first view, still open
    graph.until(
        lambda: any(m.complete and m.view_index == 0 for m in status),
        "the first view of the second run",
    )


def test_the_readings_of_a_view_are_sent_before_it_is_called_complete(
    graph, monkeypatch
):
    node = graph.node(MeasurementCollector)
    counts = publish_events(graph, events_of(small_plan("0", repeats=1)))
    graph.until(lambda: received(node, counts), "all messages")
    node.session._published.clear()
    sent: list[str] = []
    monkeypatch.setattr(
        node,
        "_outputs",
        {
            name: lambda fields, name=name: sent.append(
                f"{name} {fields['view_index']}"
            )
            for name in ("status", "measurement")
        },
    )
    node.session.finish()
    assert sent == ["measurement 0", "status 0", "measurement 1", "status 1"]


@pytest.mark.usefixtures("quick_beat")
def test_a_collector_that_starts_within_a_view_names_it_until_it_is_placed_anew(graph):
    place, measure = (
        event for event in events_of(small_plan("0"))[:9] if isinstance(event, Command)
    )
    diagnostics: list = []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 10
    )
    commands = graph.publisher(names.COMMAND, readers=0)
    for command in (place, measure):
        commands.publish(
            fill(names.COMMAND.type(), from_model.command(command, "stage"))
        )
    node = graph.node(MeasurementCollector)
    line = f"began before this node: {measure.view.name}"
    graph.until(
        lambda: any(
            line in s.message and s.level == DiagnosticStatus.WARN
            for m in diagnostics
            for s in m.status
        ),
        line,
    )
    for number, command in enumerate((measure, place, measure), 1):
        # until it is measured anew
        assert set(node.session.missed.values()) == {measure.view.name}
        command = replace(command, stamp_ns=command.stamp_ns + number * 10**9)
        commands.publish(
            fill(names.COMMAND.type(), from_model.command(command, "stage"))
        )
        graph.until(
            lambda number=number: (
                node.session.collector.received["command"] == 2 + number
            ),
            "the command",
        )
    graph.until(
        lambda: (
            diagnostics[-1].status[0].message
            == ("no encoder samples are received; view '0': 0 % of the readings taken")
        ),
        "a view that is whole",
    )


@pytest.mark.usefixtures("quick_beat")
def test_another_plate_under_the_same_plan_is_said_once_and_in_the_diagnostics(
    graph, monkeypatch
):
    node = graph.node(MeasurementCollector, status_period=0.02)
    said, diagnostics = [], []
    monkeypatch.setattr(node, "get_logger", lambda: SimpleNamespace(error=said.append))
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 10
    )
    commands, detections = (
        graph.publisher(names.COMMAND),
        graph.publisher(names.DETECTIONS),
    )
    for second, size in enumerate((5, 7)):
        plan = plan_of("0", size, count=8)
        commands.publish(
            fill(
                names.COMMAND.type(),
                from_model.command(
                    Command(
                        second * 10**9,
                        Phase.MEASURE,
                        "one",
                        0,
                        plan.views[0],
                        plan.artifact,
                        1,
                    ),
                    "stage",
                ),
            )
        )
    line = "describes a different plate from the rest of plan 'one'"
    received = node.session.collector.received
    for expected in (3, 6, 9):  # each makes the collector look again
        graph.until(
            lambda: any(
                line in s.message and s.level == DiagnosticStatus.WARN
                for m in diagnostics
                for s in m.status
            ),
            "the diagnostics",
        )
        diagnostics.clear()
        for _ in range(3):
            detections.publish(MarkDetection())
        graph.until(lambda n=expected: received["detection"] == n, "the detections")
    assert len(said) == 1
    assert line in said[0]
    assert said[0].endswith("; then start a new run")


@pytest.mark.usefixtures("quick_beat")
def test_diagnostics_count_rejections_before_any_view_and_beat_without_messages(graph):
    node = graph.node(MeasurementCollector)
    diagnostics: list = []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 10
    )
    graph.until(lambda: diagnostics, "a sign of life")
    (status,) = diagnostics[-1].status
    assert (status.level, status.message) == (
        DiagnosticStatus.OK,
        "waiting for a MEASURE command",
    )
    encoder = graph.publisher(names.ENCODER)
    encoder.publish(names.ENCODER.type(name=["spindle"], position=[0.0]))
    encoder.publish(names.ENCODER.type(name=["x"], position=[float("nan")]))
    graph.until(lambda: node.session.collector.received["encoder"] == 2, "the samples")
    wanted = {
        ("rejected encoder_sample_unknown_joint", "1"),
        ("rejected encoder_sample_not_finite", "1"),
    }
    graph.until(
        lambda: any(
            wanted <= {(v.key, v.value) for v in s.values}
            and s.level == DiagnosticStatus.WARN
            for m in diagnostics
            for s in m.status
        ),
        "the counts",
    )


def test_a_late_solver_hears_the_views_that_are_done(graph):
    node = graph.node(MeasurementCollector)
    counts = publish_events(graph, events_of(small_plan("0", repeats=1)))
    graph.until(lambda: received(node, counts), "all messages")
    assert graph.call(Trigger, FINISH).success
    late = graph.listen(names.MEASUREMENT)
    graph.until(lambda: {m.view_index for m in late} == {0, 1}, "the latched views")


def test_a_view_whose_lines_cannot_be_told_apart_says_once_what_to_do(
    graph, monkeypatch
):
    events = [
        replace(event, has_id=False) if isinstance(event, Detection) else event
        for event in events_of(plan_of("0", 3, count=96, line=True))
    ]
    node = graph.node(MeasurementCollector, status_period=0.02)
    said: list[str] = []
    monkeypatch.setattr(
        node, "get_logger", lambda: SimpleNamespace(warning=said.append)
    )
    counts = publish_events(graph, events)
    graph.until(lambda: received(node, counts), "all messages")
    for _ in range(2):
        assert graph.call(Trigger, FINISH).success
    [line] = [text for text in said if text.startswith("view 'line': ")]
    assert "rotation_not_known" in line


@pytest.mark.parametrize("offset_s", [0.0, 5.0])
def test_an_encoder_that_is_heard_late_is_no_fault_and_one_with_a_clock_of_its_own_is(
    graph, monkeypatch, offset_s
):
    patience_s = 2.0
    monkeypatch.setattr(rejections, "PATIENCE_S", patience_s)
    events = scene("0", count=0)
    first, late = (
        [*events.commands[:-1], *events.detections],
        [
            replace(sample, stamp_ns=sample.stamp_ns - round(offset_s * NS_PER_S))
            for sample in events.samples
        ],
    )
    node = graph.node(MeasurementCollector, status_period=0.02)
    said: list[tuple[float, str]] = []
    monkeypatch.setattr(
        node,
        "get_logger",
        lambda: SimpleNamespace(
            warning=lambda line: said.append((time.monotonic(), line))
        ),
    )
    status = graph.listen(names.STATUS)
    publish_events(graph, first)
    graph.until(
        lambda: status and status[-1].detections_rejected == 25, "all of them rejected"
    )
    rejected_s = time.monotonic()
    publish_events(graph, late)
    if not offset_s:
        graph.until(lambda: status[-1].detections_used == 25, "the readings")
        graph.until(
            lambda: time.monotonic() > rejected_s + 1.5 * patience_s, "the time"
        )
        assert said == []
        return
    graph.until(lambda: said, "the warning")
    [(told_s, line)] = said
    assert told_s - rejected_s > 0.5 * patience_s
    assert "the detections are stamped about 5 s after the encoder samples" in line


@pytest.mark.usefixtures("quick_beat")
def test_diagnostics_count_what_was_received(graph):
    graph.node(MeasurementCollector)
    heard: list = []
    graph.hand.create_subscription(DiagnosticArray, "/diagnostics", heard.append, 10)
    graph.publisher(names.DETECTIONS).publish(MarkDetection())
    wanted = ("detection_received", "1")
    graph.until(
        lambda: any(
            wanted == (v.key, v.value)
            for m in heard
            for s in m.status
            for v in s.values
        ),
        "the count",
    )
    assert heard[-1].status[0].name == "measurement_collector"


def test_simulated_time_that_ends_without_done_loses_no_view(graph):
    events = events_of(small_plan("0, 90", repeats=1))
    assert events[-1].phase == Phase.DONE
    measure = max(
        index
        for index, event in enumerate(events)
        if isinstance(event, Command) and event.phase == Phase.MEASURE
    )
    marks = sum(isinstance(event, Detection) for event in events[measure:])
    node = graph.node(MeasurementCollector, use_sim_time=True)
    heard = graph.listen(names.MEASUREMENT)
    clock = graph.hand.create_publisher(Clock, "/clock", names.STATUS.qos)
    graph.until(lambda: clock.get_subscription_count() > 0, "the node's ear for /clock")
    stamp_s, stamp_ns = divmod(events[0].stamp_ns, 10**9)
    clock.publish(Clock(clock=Time(sec=stamp_s, nanosec=stamp_ns)))  # then it stands
    graph.until(
        lambda: node.get_clock().now().nanoseconds == events[0].stamp_ns, "the time"
    )
    publish_events(graph, events[:-1])
    graph.until(
        lambda: (
            {m.view_index: len(m.m) + len(m.k) for m in heard}.get(
                events[measure].view_index
            )
            == marks
        ),
        "the readings of the last view",
    )


def test_who_comes_late_gets_the_newest_status(graph):
    events = events_of(small_plan("0", repeats=1))
    graph.node(MeasurementCollector, status_period=0.02)
    status = graph.listen(names.STATUS)
    publish_events(graph, events)
    graph.until(lambda: status and status[-1].complete, "the view")
    late = graph.listen(names.STATUS)
    graph.until(lambda: late and late[-1].complete, "the newest status")
    assert late[-1].view_index == status[-1].view_index


@pytest.mark.usefixtures("quick_beat")
@pytest.mark.parametrize(
    ("given", "told"), [({}, "stage"), ({"hardware_id": "XY-7"}, "XY-7")]
)
def test_the_health_names_the_stage(graph, given, told):
    heard = graph.listen(names.of_node("measurement_collector", names.HEALTH))
    graph.node(MeasurementCollector, **given)
    graph.until(lambda: heard, "the health")
    assert heard[-1].hardware_id == told


def losses(graph, topic: str = names.ENCODER.name) -> list:
    """Return a list that fills with what the collector's health tells of lost messages."""
    told: list = []
    graph.hand.create_subscription(
        DiagnosticStatus,
        "measurement_collector/health",
        lambda status: told.extend(
            (int(value.value), status.level, status.message)
            for value in status.values
            if value.key == f"lost {topic}"
        ),
        names.HEALTH.qos,
    )
    return told


@pytest.mark.usefixtures("quick_beat")
def test_messages_that_were_overwritten_before_they_were_taken_are_counted(graph):
    graph.node(MeasurementCollector)
    told, depth = losses(graph), names.ENCODER.qos.depth
    encoder = graph.publisher(names.ENCODER)
    sample = names.ENCODER.type(name=["x"], position=[0.0])
    encoder.publish(sample)
    graph.until(
        lambda: graph.nodes[-1].session.collector.received["encoder"] == 1, "the first"
    )
    for _ in range(depth + 700):  # nobody spins meanwhile
        encoder.publish(sample)
    graph.until(lambda: told, "the loss")
    lost, level, message = told[-1]
    graph.until(
        lambda: (
            graph.nodes[-1].session.collector.received["encoder"]
            == 1 + depth + 700 - lost
        ),
        "the others",
    )
    assert lost > 0
    assert level == DiagnosticStatus.WARN
    assert message.startswith(f"stage/joint_states: {lost} messages lost")


@pytest.mark.usefixtures("quick_beat")
def test_detections_that_were_overwritten_are_counted_too(graph):
    node = graph.node(MeasurementCollector)
    told, depth = losses(graph, names.DETECTIONS.name), names.DETECTIONS.qos.depth
    detections = graph.publisher(names.DETECTIONS)
    detections.publish(MarkDetection())
    graph.until(lambda: node.session.collector.received["detection"] == 1, "the first")
    for _ in range(depth + 700):  # nobody spins meanwhile
        detections.publish(MarkDetection())
    graph.until(lambda: told, "the loss")
    graph.until(
        lambda: (
            node.session.collector.received["detection"]
            == 1 + depth + 700 - told[-1][0]
        ),
        "the others",
    )
    assert told[-1][0] > 0


@pytest.mark.usefixtures("quick_beat")
def test_the_numbers_of_two_publishers_that_interleave_are_no_loss(graph):
    node = graph.node(MeasurementCollector)
    first = graph.publisher(names.ENCODER)
    second = graph.hand.create_publisher(
        names.ENCODER.type, names.ENCODER.name, names.ENCODER.qos
    )
    graph.until(lambda: second.get_subscription_count() == 1, "both")
    sample = names.ENCODER.type(name=["x"], position=[0.0])
    for number in range(12):
        (second if number == 8 else first).publish(sample)
        graph.until(
            lambda n=number: node.session.collector.received["encoder"] == n + 1, "it"
        )
    assert not node.losses.counts


@pytest.mark.parametrize(
    "taken_down_by", ["deactivate", "clean up", "destroy", "new subscriptions"]
)
def test_what_was_acknowledged_is_used_and_written_when_the_node_is_taken_down(
    graph, tmp_path, taken_down_by
):
    node = graph.node(MeasurementCollector, journal=str(tmp_path))
    samples, marks = graph.publisher(names.ENCODER), graph.publisher(names.DETECTIONS)
    session = node.session
    graph.executor.remove_node(node)  # from here on nothing takes what comes
    for number in range(30):
        samples.publish(names.ENCODER.type(name=["x"], position=[0.0]))
        marks.publish(MarkDetection(m=number))
    for publisher in (samples, marks):
        assert publisher.wait_for_all_acked(Duration(seconds=60))
    if taken_down_by == "new subscriptions":
        for item in [*node._subscriptions]:
            node.destroy_subscription(item)
        node._drain()
    elif taken_down_by == "destroy":
        graph.nodes.remove(node)
        node.destroy_node()
    else:
        node.trigger_deactivate()
        assert session.collector.received == {
            "encoder": 30,
            "detection": 30,
            "command": 0,
        }
        if taken_down_by == "clean up":
            node.trigger_cleanup()
    assert session.collector.received == {"encoder": 30, "detection": 30, "command": 0}
    assert not node.refusals.counts
    [path] = (path for path in tmp_path.iterdir() if path.is_dir())
    written = [item for _, item in BagReader(path).columns()]
    assert sum(map(len, written)) == 60


def test_losses_are_counted_over_the_life_of_the_node(graph):
    node = graph.node(MeasurementCollector)
    marks = graph.publisher(names.DETECTIONS)
    marks.publish(MarkDetection())
    graph.until(lambda: node.session.collector.received["detection"] == 1, "the first")
    node.losses.add(names.DETECTIONS.name, 10)
    node.trigger_deactivate()
    graph.until(lambda: marks.get_subscription_count() == 0, "its end")
    for _ in range(6):
        marks.publish(MarkDetection())
    node.trigger_activate()
    graph.until(lambda: marks.get_subscription_count() == 1, "the collector again")
    graph.until(lambda: node._detections.get_publisher_count() == 1, "its publisher")
    marks.publish(MarkDetection())
    graph.until(lambda: node.session.collector.received["detection"] == 2, "the second")
    assert node.losses.counts == {
        names.DETECTIONS.name: 10,
        f"{names.DETECTIONS.name}, not listening": 6,
    }


def test_a_remapped_topic_is_in_the_journal_under_the_name_of_the_contract(
    graph, tmp_path
):
    remapped = partial(
        MeasurementCollector,
        namespace="cell",
        cli_args=["--ros-args", "-r", "stage/joint_states:=/robot/joint_states"],
    )
    node = graph.node(remapped, journal=str(tmp_path))
    encoder = graph.publisher(replace(names.ENCODER, name="/robot/joint_states"))
    encoder.publish(names.ENCODER.type(name=["x"], position=[0.0]))
    graph.until(lambda: node.session.collector.received["encoder"] == 1, "the sample")
    graph.remove(node)
    [file] = (tmp_path / "cell").glob("journal_*/*.mcap")
    with file.open("rb") as stream:
        heard = {
            channel.topic: channel.metadata.get("heard_on")
            for channel in make_reader(stream).get_summary().channels.values()
        }
    assert heard == {
        "/cell/stage/joint_states": "/robot/joint_states",
        "/cell/stage/mark_detections": None,
        "/cell/selfcal/view_command": None,
    }
    again = graph.node(remapped, journal=str(tmp_path))
    graph.until(lambda: again.session.collector.received["encoder"] == 1, "the journal")


@pytest.mark.parametrize("journal", ["", "none"])
def test_no_journal_is_kept_where_none_is_wanted(graph, tmp_path, monkeypatch, journal):
    monkeypatch.chdir(tmp_path)
    graph.node(MeasurementCollector, journal=journal)
    assert not list(tmp_path.iterdir())
