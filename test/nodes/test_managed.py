# SPDX-License-Identifier: Apache-2.0
"""Managed nodes: bring-up and tear-down ten times over, errors in transitions, health."""

import gc
import sys
import time
import weakref
from types import SimpleNamespace

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.duration import Duration
from rclpy.lifecycle import TransitionCallbackReturn
from std_msgs.msg import String
from std_srvs.srv import Trigger

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.errors import InputError, SelfcalError
from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.hearing import node_of
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.nodes.solver import Solver
from test.support.cameras import DETECTS, camera
from test.support.ros import Graph
from test.support.sessions import decoded, plan_file, small_plan

MANAGED = {
    "measurement_collector": MeasurementCollector,
    "pose_sequencer": PoseSequencer,
    "solver": Solver,
    "compensator": CompensatorNode,
    "mark_detector": MarkDetectorNode,
}
NEEDED = {"mark_detector": DETECTS}


def entities(node) -> dict[str, int]:
    """Return how many entities of each kind a node holds."""
    return {
        kind: len(list(getattr(node, kind)))
        for kind in (
            "publishers",
            "subscriptions",
            "services",
            "clients",
            "timers",
            "waitables",
        )
    }


def change(graph, node: str, transition: int) -> bool:
    return graph.call(
        ChangeState, f"{node}/change_state", transition=Transition(id=transition)
    ).success


def state(graph, node: str) -> str:
    return graph.call(GetState, f"{node}/get_state").current_state.label


@pytest.mark.parametrize("name", MANAGED)
def test_ten_bring_ups_and_tear_downs_leave_nothing_behind(graph, name):
    images = camera(graph)
    node = graph.node(MANAGED[name], autostart=False, **NEEDED.get(name, {}))
    graph.until(
        lambda: node.get_publishers_info_by_topic(images.topic_name), "the camera"
    )
    steps = (
        Transition.TRANSITION_CONFIGURE,
        Transition.TRANSITION_ACTIVATE,
        Transition.TRANSITION_DEACTIVATE,
        Transition.TRANSITION_CLEANUP,
    )
    bare, full, sessions = entities(node), [], []
    for _ in range(10):
        for step in steps:
            assert change(graph, name, step)
            if step == Transition.TRANSITION_ACTIVATE:
                full.append(entities(node))
                sessions.append(weakref.ref(node.session))
        assert entities(node) == bare
    assert all(counts == full[0] for counts in full)
    assert full[0]["subscriptions"] > bare["subscriptions"]
    gc.collect()
    assert [session() for session in sessions] == [None] * 10
    assert state(graph, name) == "unconfigured"


@pytest.mark.parametrize("name", MANAGED)
def test_there_is_no_session_but_from_configuring_to_taking_down(graph, name):
    node = graph.node(MANAGED[name], autostart=False, **NEEDED.get(name, {}))

    def refused():
        with pytest.raises(SelfcalError) as info:
            node.session.diagnosis()
        assert type(info.value) is SelfcalError
        return str(info.value)

    line = f"{name}: there is no session while unconfigured; configure the node first"
    assert refused() == line
    assert change(graph, name, Transition.TRANSITION_CONFIGURE)
    session = node.session
    assert change(graph, name, Transition.TRANSITION_ACTIVATE)
    assert node.session is session
    assert change(graph, name, Transition.TRANSITION_DEACTIVATE)
    assert node.session is session
    assert change(graph, name, Transition.TRANSITION_CLEANUP)
    assert refused() == line


def test_an_active_node_works_as_one_that_starts_by_itself(graph, tmp_path):
    graph.node(
        PoseSequencer,
        autostart=False,
        plan=plan_file(tmp_path, small_plan()),
        start_checks=False,
    )
    assert change(graph, "pose_sequencer", Transition.TRANSITION_CONFIGURE)
    heard = graph.listen(names.COMMAND)
    assert change(graph, "pose_sequencer", Transition.TRANSITION_ACTIVATE)
    assert graph.call(Trigger, "pose_sequencer/start").success
    graph.until(lambda: heard, "the command")
    assert change(graph, "pose_sequencer", Transition.TRANSITION_DEACTIVATE)
    late = graph.listen(names.COMMAND)  # an inactive node keeps what it has latched
    graph.until(lambda: late, "the latched command")


def test_an_error_in_a_transition_is_told_and_can_be_mended(graph, tmp_path):
    plan = tmp_path / "plan.yaml"
    graph.node(PoseSequencer, autostart=False, plan=str(plan))
    health: list = []
    topic = names.of_node("pose_sequencer", names.HEALTH)
    graph.hand.create_subscription(topic.type, topic.name, health.append, topic.qos)
    assert not change(graph, "pose_sequencer", Transition.TRANSITION_CONFIGURE)
    assert state(graph, "pose_sequencer") == "unconfigured"
    line = f"unconfigured: {plan}: no such file; check the path"
    graph.until(
        lambda: any(
            s.message == line and s.level == DiagnosticStatus.ERROR for s in health
        ),
        "the reason",
    )
    plan_file(tmp_path, small_plan())
    assert change(graph, "pose_sequencer", Transition.TRANSITION_CONFIGURE)
    assert state(graph, "pose_sequencer") == "inactive"


def test_an_internal_error_in_a_transition_is_told_too(graph, monkeypatch):
    def broken(self):
        raise ZeroDivisionError("within")

    monkeypatch.setattr(Solver, "configure", broken)
    node = graph.node(Solver, autostart=False)
    assert not change(graph, "solver", Transition.TRANSITION_CONFIGURE)
    assert node.diagnosis().message == "unconfigured: within"
    assert state(graph, "solver") == "unconfigured"


def test_a_node_that_cannot_start_by_itself_raises(graph, tmp_path):
    with pytest.raises(InputError, match=r"no\.yaml: no such file; check the path"):
        graph.node(PoseSequencer, plan=str(tmp_path / "no.yaml"))


def test_a_transition_that_does_not_exist_is_refused_and_ends_nothing(graph):
    node = graph.node(Solver)
    assert state(graph, "solver") == "active"
    assert not change(graph, "solver", Transition.TRANSITION_CONFIGURE)
    assert not change(graph, "solver", 250)
    assert state(graph, "solver") == "active"
    assert change(graph, "solver", Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state(graph, "solver") == "finalized"
    assert node.diagnosis() == Diagnosis(
        Level.ERROR,
        "finalized: shut down on request; end this process and start the node again",
    )


def test_an_inactive_node_says_so(graph):
    node = graph.node(Solver, autostart=False)
    assert (
        node.diagnosis().message
        == "unconfigured: a managed node that waits to be activated"
    )


def test_work_goes_on_under_a_simulated_time_that_stands_still(graph, tmp_path):
    graph.node(
        PoseSequencer,
        use_sim_time=True,
        plan=plan_file(tmp_path, small_plan()),
        start_checks=False,
        auto_start=True,
        auto_confirm=True,
        settle_time=0.0,
    )
    heard = graph.listen(names.COMMAND)
    graph.until(lambda: len(heard) == 2, "PLACE and MEASURE")


@pytest.mark.parametrize("name", MANAGED)
def test_a_destroyed_node_leaves_the_graph(graph, name):
    node = graph.node(MANAGED[name], **NEEDED.get(name, {}))
    graph.until(lambda: name in graph.hand.get_node_names(), "the node")
    gc.disable()  # or it would go when circles of references are broken, some time later
    try:
        graph.remove(node)
        graph.until(lambda: name not in graph.hand.get_node_names(), "its end")
        assert node.state == "finalized"  # what still refers to it may ask
    finally:
        gc.enable()


@pytest.mark.parametrize("name", [*MANAGED, "bag_player"])
def test_a_node_that_cannot_be_made_leaves_the_graph(graph, name):
    make = MANAGED.get(name, BagPlayer)
    gc.disable()
    try:
        with pytest.raises(InputError, match="hardware_id: 7 is not of type str"):
            graph.node(make, hardware_id=7)
        graph.until(lambda: name not in graph.hand.get_node_names(), "its end")
        assert set(graph.hand.get_node_names()) == {"hand"}
    finally:
        gc.enable()


def test_whatever_a_message_does_is_counted_and_told(graph):
    node = graph.node(Solver)
    publisher = graph.publisher(names.MEASUREMENT)
    publisher.publish(names.MEASUREMENT.type(grid_size=5, grid_pitch=0.01, dx=[0.0]))
    graph.until(
        lambda: node.refusals.counts["selfcal/view_measurement"] == 1, "the count"
    )

    def broken(_):
        raise OverflowError("int too large")

    guarded = node.guarded(broken, "selfcal/view_command")
    assert guarded(None) is None
    told = node.refusals.diagnosis()
    assert told.values == {
        "refused selfcal/view_command": 1,
        "refused selfcal/view_measurement": 1,
    }
    assert (
        "selfcal/view_command: cannot be used (OverflowError: int too large)"
        in told.message
    )


@pytest.mark.usefixtures("quick_beat")
def test_a_publisher_that_cannot_be_heard_is_named(graph, capfd):
    node = graph.node(MeasurementCollector)
    deaf = names._qos(10, reliable=False)
    graph.hand.create_publisher(names.DETECTIONS.type, names.DETECTIONS.name, deaf)
    heard: list = []
    topic = names.of_node("measurement_collector", names.HEALTH)
    graph.hand.create_subscription(topic.type, topic.name, heard.append, topic.qos)
    graph.until(
        lambda: any(
            "stage/mark_detections: no messages are received from /hand (" in s.message
            and s.level == DiagnosticStatus.ERROR
            for s in heard
        ),
        "its name",
    )
    assert node.get_name() == "measurement_collector"
    graph.until(lambda: len(heard) > 5, "further reports")
    assert capfd.readouterr().err.count("no messages are received from /hand") == 1


@pytest.mark.usefixtures("quick_beat")
def test_a_publisher_of_another_type_is_named(graph, capfd):
    """Nothing is received from it, and DDS does not say so."""
    graph.node(MeasurementCollector)
    line = (
        "stage/mark_detections: no messages are received from /hand (it publishes "
        "std_msgs/msg/String); publish selfcal_msgs/msg/MarkDetection, or remap its topic"
    )
    said = []
    other = Graph(graph.context.get_domain_id())
    try:
        other.hand.create_publisher(String, names.DETECTIONS.name, names.DETECTIONS.qos)
        graph.until(
            lambda: said.append(capfd.readouterr().err) or line in "".join(said),
            "its type",
        )
    finally:
        other.close()


def test_no_event_of_a_stranger_is_due_when_a_subscription_ends(graph):
    """One of its incompatible QoS, due at that instant, ended the node: rclpy issue 1644."""
    node = graph.node(MeasurementCollector)
    own = [
        subscription
        for subscription in node.subscriptions
        if subscription.topic_name.removeprefix("/")
        in {topic.name for topic in names.INPUTS}
    ]
    assert len(own) > 1 and not any(item.event_handlers for item in own)
    outputs = {topic.name for topic in (names.STATUS, names.MEASUREMENT)}
    published = [
        publisher
        for publisher in node.publishers
        if publisher.topic_name.removeprefix("/") in outputs
    ]
    assert len(published) == len(outputs)
    assert not any(publisher.event_handlers for publisher in published)


@pytest.mark.usefixtures("quick_beat")
@pytest.mark.parametrize(
    ("kind", "qos", "line"),
    [
        (
            names.CORRECTED.type,
            names._qos(10),
            "stage/corrected_joint_states: no messages reach /hand (Best effort publisher and "
            "reliable subscription); subscribe with the QoS in docs/reference/ros2.md",
        ),
        (
            String,
            names.CORRECTED.qos,
            "stage/corrected_joint_states: no messages reach /hand (it subscribes to "
            "std_msgs/msg/String); subscribe to sensor_msgs/msg/JointState, or remap its topic",
        ),
    ],
)
def test_a_subscriber_that_is_not_reached_is_named_once(graph, capfd, kind, qos, line):
    graph.node(CompensatorNode)
    heard: list = []
    topic = names.of_node("compensator", names.HEALTH)
    graph.hand.create_subscription(topic.type, topic.name, heard.append, topic.qos)
    other = Graph(graph.context.get_domain_id())
    try:
        other.hand.create_subscription(kind, names.CORRECTED.name, print, qos)
        graph.until(
            lambda: any(
                line in s.message and s.level == DiagnosticStatus.WARN for s in heard
            ),
            line,
        )
        heard.clear()
        graph.until(lambda: len(heard) > 5, "further reports")
    finally:
        other.close()
    assert capfd.readouterr().err.count("no messages reach /hand") == 1


def test_a_node_whose_name_is_not_known_yet_is_said_in_words():
    endpoint = SimpleNamespace(
        node_name="_NODE_NAME_UNKNOWN_", node_namespace="_NODE_NAMESPACE_UNKNOWN_"
    )
    assert node_of(endpoint) == "a node of unknown name"


@pytest.mark.usefixtures("quick_beat")
def test_two_solvers_are_named(graph):
    first = graph.node(Solver)
    graph.hand.create_publisher(
        names.ERROR_MAP.type, names.ERROR_MAP.name, names.ERROR_MAP.qos
    )
    heard: list = []
    topic = names.of_node("solver", names.HEALTH)
    graph.hand.create_subscription(topic.type, topic.name, heard.append, topic.qos)
    line = "selfcal/error_map has 2 publishers: /hand, /solver; only one is allowed"
    graph.until(
        lambda: any(
            line in s.message and s.level == DiagnosticStatus.WARN for s in heard
        ),
        line,
    )
    assert first.get_name() == "solver"


def test_diagnostics_come_once_a_second_whatever_is_received(graph):
    node = graph.node(MeasurementCollector)
    told: list = []
    original = node.diagnose
    node.diagnose = lambda diagnosis: (told.append(1), original(diagnosis))
    encoder = graph.publisher(names.ENCODER)
    for _ in range(3000):
        encoder.publish(names.ENCODER.type(name=["x"], position=[0.0]))
    began, before = time.monotonic(), len(told)
    graph.until(
        lambda: node.session.collector.received["encoder"] >= 3000, "the samples"
    )
    graph.until(lambda: len(told) > before, "a report")
    assert len(told) - before <= time.monotonic() - began + 2


def test_what_was_due_when_a_node_was_deactivated_is_not_called(graph):
    node, called = graph.node(MeasurementCollector), []
    node._making = "activate"
    due = node.guarded(called.append, "due")
    node._making = ""
    due(1)
    assert node.trigger_deactivate() == TransitionCallbackReturn.SUCCESS
    assert node.trigger_activate() == TransitionCallbackReturn.SUCCESS
    due(2)  # of the time before
    assert called == [1]
    assert node.refusals.counts == {}


def test_what_has_come_is_in_the_journal_when_a_collector_is_taken_down(
    graph, tmp_path
):
    node = graph.node(MeasurementCollector, journal=str(tmp_path))
    detections = graph.publisher(names.DETECTIONS)
    received = node.session.collector.received
    for k in range(7):
        detections.publish(names.DETECTIONS.type(k=k))
    assert detections.wait_for_all_acked(Duration(seconds=30))
    graph.remove(node)  # before it looked
    assert received["detection"] == 7
    (journal,) = tmp_path.glob("journal_*")
    assert [topic for topic, *_ in decoded(BagReader(journal))] == [
        names.DETECTIONS.name
    ] * 7


@pytest.mark.parametrize("name", ["measurement_collector", "mark_detector"])
def test_what_was_received_is_told_again_to_who_missed_it(graph, monkeypatch, name):
    make = MANAGED[name]
    monkeypatch.setattr(sys.modules[make.__module__], "BEAT_S", 0.05)
    told = graph.listen(names.of_node(name, names.RECEIVED))
    graph.node(make, **NEEDED.get(name, {}))
    graph.until(lambda: len(told) > 2, "the same counts again")
    assert all(list(message.data) == [0, 0, 0] for message in told)
