# SPDX-License-Identifier: Apache-2.0
"""No callback ends a node: rclpy's own answer with a failure, and spin goes on."""

from types import SimpleNamespace

import pytest
import rclpy
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import ListParameters, SetParameters, SetParametersAtomically
from rclpy.action import ActionClient, ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.exceptions import InvalidHandle
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from selfcal_msgs.action import RunCalibration

from selfcal_ros.nodes import names, running
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.callbacks import Numbered
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.names import Topic, _qos
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from test.support.sessions import plan_file, small_plan

STRANGE = Parameter(name="hardware_id", value=ParameterValue(type=99))
PLAIN = Parameter(name="no_such", value=ParameterValue(type=1))


def test_a_parameter_of_an_unknown_type_is_a_failure_of_each_that_was_asked_for(graph):
    node = graph.node(Solver)
    answer = graph.call(
        SetParameters, "solver/set_parameters", parameters=[PLAIN, STRANGE, PLAIN]
    )
    assert [result.successful for result in answer.results] == [False] * 3
    first, *others = (result.reason for result in answer.results)
    assert first.startswith("Invalid access to undeclared parameter")
    assert others == ["ValueError: 99 is not a valid Parameter.Type"] * 2
    answer = graph.call(
        SetParametersAtomically,
        "solver/set_parameters_atomically",
        parameters=[STRANGE],
    )
    assert (answer.result.successful, answer.result.reason) == (False, others[0])
    assert (
        "solver"
        not in graph.call(ListParameters, "solver/list_parameters").result.names
    )
    told = node.refusals.diagnosis()
    assert told.values == {
        "refused set_parameters": 1,
        "refused set_parameters_atomically": 1,
    }
    assert "99 is not a valid Parameter.Type" in told.message


def test_an_answer_that_cannot_be_sent_is_counted(graph):
    node = graph.node(Solver)
    service = next(
        s for s in node.services if s.service_name.endswith("/get_parameters")
    )
    service.send_response("no response", None)
    assert node.refusals.counts == {"get_parameters": 1}


def test_a_clock_before_time_is_counted_and_the_next_one_is_taken(graph):
    node = graph.node(Solver, use_sim_time=True)
    voice = graph.publisher(Topic("/clock", Clock, _qos(1)))
    for second in (-1, 7):
        message = Clock()
        message.clock.sec = second
        voice.publish(message)
        graph.until(lambda: sum(node.refusals.counts.values()), "the refusal")
    assert node.refusals.counts == {"/clock": 1}
    graph.until(lambda: node.get_clock().now().nanoseconds == 7 * 10**9, "the time")


@pytest.fixture
def sequencer(graph, tmp_path):
    return graph.node(PoseSequencer, plan=plan_file(tmp_path, small_plan()))


@pytest.fixture
def sent(graph, sequencer):
    """Send a goal that cannot be reached; whether it is accepted comes later, if at all."""
    client = ActionClient(graph.hand, RunCalibration, "pose_sequencer/run_calibration")
    graph.until(client.server_is_ready, "the action")
    yield lambda: client.send_goal_async(RunCalibration.Goal(plan_path="no such"))
    client.destroy()


class Lost(dict):
    """Keeps nothing."""

    def __setitem__(self, key, value):
        """Leave it out."""


def test_a_task_of_an_action_that_fails_is_counted(graph, sequencer, sent, monkeypatch):
    """In rclpy 7.1.6 the events executor ends the process when a task raises."""
    [server] = [item for item in sequencer.waitables if isinstance(item, ActionServer)]
    with monkeypatch.context() as patch:
        patch.setattr(server, "_result_futures", Lost())
        sent()
        graph.until(
            lambda: sequencer.refusals.counts["ActionServer"] == 1,
            "the request's refusal",
        )
    with monkeypatch.context() as patch:
        patch.setattr(ServerGoalHandle, "abort", lambda goal: 1 / 0)
        sent()
        graph.until(
            lambda: sequencer.refusals.counts["ActionServer"] == 2, "the goal's refusal"
        )
    accepted = graph.finish(sent(), "a goal")
    result = graph.finish(accepted.get_result_async(), "its result").result
    assert result.message == "no such: no such file; check the path"


def test_spin_goes_on_after_an_error(ros_environment):
    rclpy.init(args=[])
    try:
        node, until, called = Solver(), Future(), []

        def raising():
            called.append(node.refusals.counts["executor"])
            if len(called) == 3:
                until.set_result(None)
            raise ZeroDivisionError

        node.create_timer(0.01, raising)
        running.spin(node, until)
        assert called == [0, 1, 2]
        assert node.refusals.counts == {"executor": 3}
        node.destroy_node()
    finally:
        rclpy.try_shutdown()


@pytest.mark.parametrize(
    ("numbers_and_publishers", "lost"),
    [
        pytest.param([(7, 1), (8, 1), (13, 1), (15, 1)], [4, 1], id="only one"),
        pytest.param([(7, 1), (1, 1), (2, 1), (5, 1)], [2], id="started anew"),
        pytest.param([(7, 1), (1, 2), (9, 2), (12, 1)], [], id="two at once"),
        pytest.param([(7, 1), (1, 1), (8, 1), (9, 1)], [], id="one that came and went"),
        pytest.param([(7, 1), (8, 1), (20, 0)], [11], id="one that has ended"),
        pytest.param([(None, 1), (None, 1)], [], id="middleware without numbers"),
    ],
)
def test_the_numbers_of_an_only_publisher_tell_what_is_missing(
    numbers_and_publishers, lost
):
    taken, found = [], []
    callback = Numbered(taken.append, found.append)
    for number, publishers in numbers_and_publishers:
        callback.subscription = SimpleNamespace(
            get_publisher_count=lambda publishers=publishers: publishers
        )
        callback("message", {"publication_sequence_number": number})
    assert found == lost
    assert taken == ["message"] * len(numbers_and_publishers)


def test_a_message_that_was_due_when_its_subscription_ended_is_taken():
    def ended():
        raise InvalidHandle("destruction was requested")

    taken = []
    callback = Numbered(taken.append, taken.append)
    callback.subscription = SimpleNamespace(get_publisher_count=ended)
    callback("message", {"publication_sequence_number": 7})
    assert taken == ["message"]


def test_what_a_recorder_did_not_receive_is_in_its_health(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    detections = graph.publisher(names.DETECTIONS)
    published = names.DETECTIONS.qos.depth + 1 + 700
    detections.publish(names.DETECTIONS.type())

    def kept():
        return recorder._writer.counts["/stage/mark_detections"]

    graph.until(lambda: kept() == 1, "the first")
    for _ in range(published - 1):  # nobody spins meanwhile
        detections.publish(names.DETECTIONS.type())
    lost = recorder.losses.counts
    graph.until(lambda: kept() + lost[names.DETECTIONS.name] == published, "the others")
    recorder.close()
    assert lost[names.DETECTIONS.name] > 0


def test_no_event_of_lost_messages_is_taken(graph, tmp_path):
    """Taken while more are lost, it may lock the node for ever (rmw_fastrtps 890)."""
    plan = plan_file(tmp_path, small_plan())
    for kind, parameters in (
        (MeasurementCollector, {}),
        (PoseSequencer, {"plan": plan}),
        (Solver, {}),
        (BagRecorder, {"bag": str(tmp_path / "bag")}),
    ):
        node = graph.node(kind, **parameters)
        assert not any(item.event_handlers for item in node.subscriptions)
    node.close()
