# SPDX-License-Identifier: Apache-2.0
"""Every node among hostile publishers and clients: each field at its worst, torn bytes."""

import importlib
import io
import json
import os
import pickle
from collections import Counter
from dataclasses import replace
from functools import partial
from itertools import batched, islice
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from selfcal_msgs.action import RunCalibration
from std_srvs.srv import Trigger

from selfcal_ros import nodes as every_node
from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.errors import InputError, SelfcalError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.nodes import monitor_session, names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.callbacks import Guarded
from selfcal_ros.nodes.cell_checker import CellChecker
from selfcal_ros.nodes.cell_driver import CellDriver
from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.player import Player
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.replay_session import ReplaySession
from selfcal_ros.nodes.sessions.health import Refusals
from selfcal_ros.nodes.sessions.solving import SolvingSession, solve
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.nodes.stage_simulator import StageSimulator
from test.support.cameras import DETECTS
from test.support.hostile import TEXTS, torn, worst
from test.support.maps import random_map, result_of
from test.support.plans import plan_of
from test.support.ports import Hands, settings_of
from test.support.sessions import (
    cdr_of,
    collected,
    events_of,
    plan_file,
    small_bag,
    small_plan,
)

PLAN = small_plan("0, 90, tx", repeats=1)
TEXT_FIELDS = (
    "stamp.sec",
    "nanosec",
    "_id",
    "view_name",
    "reasons",
    "_terms",
    "_counts",
    "missing_m",
    "stamp",
    "approach_x",
    "approach_y",
    "session_notes",
)
ALONG_Y = ("dy", "_y")
"""Fields that are solved as those along x are, which are tried."""
MILD = (2, 4001, 4.2e-3)
"""Numbers that a cell may well send: other tests solve such, and search for their causes."""
HEARD_BY = {
    EncoderSample: (names.ENCODER, 3),
    Detection: (names.DETECTIONS, 2),
    Command: (names.COMMAND, 5),
}
"""How many of the nodes hear what a cell says."""
IMAGES = names.image_topics("raw", 100)[0]
LATER_NS = 10_000_000_000_000_000
"""How much later the good run is than the hostile one."""
AT_ONCE = 20
"""Messages that are sent before they are waited for; less than the smallest queue."""
SIMULATED_CELL = Path(__file__).parents[2] / "config/cells/simulated.yaml"


@pytest.fixture(scope="module")
def good():
    """Return (topic, fields of a message as it should be) for the topics that nodes hear."""
    events = events_of(PLAN)
    collector, measurements, progress = collected(events)
    view, stamp = progress[1], collector.timeline.last_stamp_ns

    def event(kind):
        return next(e for e in events if isinstance(e, kind))

    return [
        (names.ENCODER, from_model.joint_state(event(EncoderSample), "stage")),
        (names.MOTION, from_model.joint_state(event(EncoderSample), "stage")),
        (names.DETECTIONS, from_model.detection(event(Detection), "stage")),
        (
            names.COMMAND,
            from_model.command(
                next(e for e in events if isinstance(e, Command) and e.phase == 1),
                "stage",
            ),
        ),
        (names.STATUS, from_model.view_status(view, PLAN.plan_id, stamp, "stage")),
        (
            names.MEASUREMENT,
            from_model.view_measurement(view, measurements, stamp, "stage"),
        ),
        (
            names.ERROR_MAP,
            from_model.error_map(
                result_of(random_map(PLAN.artifact, 3)), stamp, "stage"
            ),
        ),
        (
            names.SUMMARY,
            {
                "header": from_model.header(stamp, "stage"),
                "qualified": True,
                "state": "Calibrated.",
                "views_done": 3,
                "views_planned": 3,
                "advice": ["none"],
                "causes": ["none"],
            },
        ),
    ]


@pytest.fixture
def refused(monkeypatch):
    """Return a list that fills with (place, error) of all that the nodes of this process refuse."""
    found, add = [], Refusals.add

    def note(self, place, error):
        found.append((place, error))
        add(self, place, error)

    monkeypatch.setattr(Refusals, "add", note)
    return found


@pytest.fixture
def cell(graph, refused, tmp_path, monkeypatch):
    """Yield all nodes of a cell, each with every topic that it may hear."""
    monkeypatch.setattr(monitor_session.sys, "stdin", io.StringIO())
    nodes = [
        graph.node(
            MeasurementCollector, journal=str(tmp_path / "journals"), status_period=0.02
        ),
        graph.node(PoseSequencer, plan=plan_file(tmp_path, PLAN)),
        graph.node(Solver, result_folder=str(tmp_path)),
        graph.node(CompensatorNode, require_qualified=False),
        graph.node(BagRecorder, bag=str(tmp_path / "bag"), all_topics=True),
    ]
    graph.add(monitor_session.MonitorSession("", context=graph.context))
    play(graph, events_of(PLAN))  # what is spoilt below belongs to this run
    graph.until(lambda: nodes[2].session.result is not None, "a map")
    yield nodes
    nodes[-1].close()


@pytest.fixture
def all_kinds(graph, cell, tmp_path):
    """Return a node of every kind: those beside the cell in a namespace of their own."""
    (tmp_path / "beside").mkdir()
    bag = str(small_bag(tmp_path / "beside"))
    graph.node(partial(StageSimulator, namespace="beside"))
    graph.node(partial(MarkDetectorNode, namespace="beside"), **DETECTS)
    graph.node(
        partial(BagPlayer, namespace="beside"),
        bag=bag,
        wait_for_subscribers=3600.0,
        beside_others=True,
    )
    graph.node(partial(CellDriver, namespace="driven"), cell=str(SIMULATED_CELL))
    graph.node(
        partial(CellChecker, PLAN, namespace="beside", settle_s=0.0, patience_s=3600.0)
    )
    graph.add(
        ReplaySession(
            partial(Player, bag=bag, rate=1.0, seed=-1, beside_others=True),
            "none.json",
            namespace="replay",
            context=graph.context,
        )
    )
    nodes = [node for node in graph.nodes if node is not graph.hand]
    assert {type(node) for node in nodes} == set(kinds())
    return nodes


def kinds():
    """Yield the class of each node that the package can run as a process."""
    for file in sorted(Path(every_node.__file__).parent.glob("*.py")):
        if "\ndef main(" in file.read_text():
            module = importlib.import_module(f"{every_node.__name__}.{file.stem}")
            yield from (
                item
                for item in vars(module).values()
                if isinstance(item, type)
                and issubclass(item, Guarded)
                and item.__module__ == module.__name__
            )


def play(graph, events) -> None:
    """Publish the messages of a run, once all nodes that are to hear them do."""
    voices = {
        kind: graph.publisher(topic, readers=readers)
        for kind, (topic, readers) in HEARD_BY.items()
    }
    for event in events:
        voices[type(event)].publish(cdr_of(event))


def send(graph, topic, messages) -> None:
    """Publish messages, or the bytes of some, to all that hear them, and wait for their arrival."""
    heard: list = []
    ear = graph.hand.create_subscription(
        topic.type, topic.name, heard.append, topic.qos, raw=True
    )
    name = graph.hand.resolve_topic_name(topic.name)
    readers = sum(
        name in subscribed(node) for node in graph.nodes if node is not graph.hand
    )
    voice, sent = graph.publisher(topic, readers=1 + readers), 0
    for group in batched(messages, min(AT_ONCE, topic.qos.depth)):
        for one in group:
            voice.publish(one)
        sent += len(group)
        graph.until(lambda n=sent: len(heard) >= n, f"{sent} messages on {topic.name}")
    graph.hand.destroy_subscription(ear)
    graph.hand.destroy_publisher(voice)


def good_run():
    """Return the messages of a run after the hostile messages."""
    return [
        replace(event, stamp_ns=event.stamp_ns + LATER_NS) for event in events_of(PLAN)
    ]


def everybody_is_well(graph, cell, refused, capsys, begun=0) -> None:
    """Check that each node tells its health anew, and that a good run gives its map.

    So many messages of it have been played.
    """
    solver = cell[2]
    assert [node.state for node in cell[:4]] == ["active"] * 4
    assert [
        (place, error)
        for place, error in refused
        if not isinstance(error, SelfcalError)
    ] == []
    told = {
        node: graph.listen(names.of_node(node.get_name(), names.HEALTH))
        for node in cell
    }
    graph.until(
        lambda: all(len(heard) > 1 for heard in told.values()), "the health of all"
    )
    graph.call(Trigger, "pose_sequencer/abort")  # it followed the commands of others
    events = good_run()
    play(graph, events[begun:])
    expected = calibrate(collected(events)[1]).error_map.gx
    graph.until(
        lambda: (
            solver.session.result is not None
            and np.array_equal(solver.session.result.error_map.gx, expected)
        ),
        "the map of a good run",
    )
    capsys.readouterr()
    said: list = []

    def shown() -> bool:
        said.extend(map(json.loads, capsys.readouterr().out.splitlines()))
        return any(line["picture"]["map"] for line in said if "picture" in line)

    graph.until(shown, "the picture of the map")


def hostile_to(topic, fields):
    """Yield messages of a topic with one field at its worst.

    A command of the end of time is left out: it would be the newest for ever, as it says.
    """
    for _, message in worst(fill(topic.type(), fields)):
        if topic is not names.COMMAND or message.header.stamp.sec < 2**31 - 1:
            yield message


def test_each_field_at_its_worst_ends_nothing(
    graph, cell, all_kinds, refused, good, capfd
):
    status = dict.fromkeys(("view", "command_stamp", "views", "run_id"), "1")
    private = [
        (
            names.of_node(node, names.HEALTH),
            worst(
                names.HEALTH.type(
                    level=b"\1",
                    name=node,
                    message="as told",
                    values=[
                        KeyValue(key=key, value=value) for key, value in status.items()
                    ],
                )
            ),
        )
        for node in monitor_session.WATCHED
    ]
    for topic, fields in good:
        send(graph, topic, hostile_to(topic, fields))
    for topic, messages in private:
        send(graph, topic, (message for _, message in messages))
    strange = [
        (names.of_node(node, topic), [message for _, message in worst(message)])
        for node, topic, message in (
            (
                "measurement_collector",
                names.RECEIVED,
                names.RECEIVED.type(data=[1, 2, 3]),
            ),
            ("solver", names.SOLVED, names.SOLVED.type(data="digest")),
        )
    ]
    image = from_model.image(np.full((40, 40), 90), "mono8", 10**8, "camera")
    strange.append(
        (IMAGES, [message for _, message in worst(fill(IMAGES.type(), image))])
    )
    # its commands move a machine
    heard = set().union(
        *(subscribed(node) for node in all_kinds if not isinstance(node, CellDriver))
    )
    for space in ("/beside", "/replay"):
        for topic, messages in [
            *((topic, hostile_to(topic, fields)) for topic, fields in good),
            *strange,
        ]:
            if f"{space}/{topic.name}" in heard:
                send(graph, replace(topic, name=f"{space}/{topic.name}"), messages)
    foreign = DiagnosticStatus(
        level=b"\2",
        name="of others",
        message="as told",
        values=[KeyValue(key="key", value="1")],
    )
    send(
        graph,
        names.DIAGNOSTICS,
        (message for _, message in worst(names.DIAGNOSTICS.type(status=[foreign]))),
    )
    everybody_is_well(graph, cell, refused, capfd)
    places = {place for place, _ in refused}
    assert {names.COMMAND.name, names.MEASUREMENT.name, names.ERROR_MAP.name} <= places
    assert any("longer than 8192 bytes" in str(error) for _, error in refused)
    sent = {
        f"{space}/{topic.name}"
        for space in ("", "/beside", "/replay")
        for topic, _ in [*good, *private, *strange]
    } | {names.DIAGNOSTICS.name}
    only_recorded = {f"/{names.CORRECTED.name}"}  # the recorder looks into no message
    assert heard - only_recorded <= sent
    assert {f"/{topic.name}" for topic, _ in [*good, *private]} <= heard


def subscribed(node) -> set[str]:
    """Return the full names of the topics that a node hears, as the graph has them."""
    found = node.get_subscriber_names_and_types_by_node(
        node.get_name(), node.get_namespace()
    )
    return {name for name, _ in found}


def test_torn_bytes_end_nothing(graph, cell, refused, good, capfd):
    for seed, (topic, fields) in enumerate(good):
        send(graph, topic, torn(fill(topic.type(), fields), seed))
    everybody_is_well(graph, cell, refused, capfd)
    assert "decoding" in {place for place, _ in refused}


def test_numbers_of_readings_at_their_worst_are_solved_or_refused_in_one_line():
    plan = plan_of("0, 90, tx", 3, count=4)
    _, measurements, progress = collected(events_of(plan))
    views = [
        fill(
            names.MEASUREMENT.type(),
            from_model.view_measurement(view, measurements, 5, "stage"),
        )
        for view in progress.values()
    ]
    answers, solved = Counter(), set()
    for name, spoilt in worst(views[1]):
        if name.endswith(TEXT_FIELDS) or isinstance(getattr(spoilt, name, None), str):
            continue
        session = SolvingSession(settings_of("solver"), Hands().ports)
        for view in views:
            session.take_measurement(view)
        try:
            session.take_measurement(spoilt)
            job = session.next_job()
            same = pickle.dumps(job)
            mild = any(value in MILD for value in np.ravel(getattr(spoilt, name))[:1])
            # or of other plans
            if same not in solved and not mild and not name.endswith(ALONG_Y):
                session.take(solve(job))
            solved.add(same)
            answers["solved"] += 1
        except InputError as error:
            answers[error.what.partition(" ")[0]] += 1
    assert answers["solved"] > 50
    enormous_or_none = 5  # of FLOATS
    assert answers["dtheta"] == enormous_or_none
    # of means and of visits
    assert answers["dx"] == answers["dy"] == 2 * enormous_or_none


RAISED_BY_RCLPY = {"set_parameters", "set_parameters_atomically"}
"""Services of rclpy whose own callback raises something at the worst requests."""
ACTION = "/pose_sequencer/run_calibration/_action"
TEXT = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="x")
BASES = {
    "parameters": [
        [Parameter(name=name, value=TEXT)] for name in ("hardware_id", "use_sim_time")
    ],
    "names": [["none"]],
    "prefixes": [["none"]],
}
"""What stands in the sequences of a request whose elements are spoilt."""


@pytest.fixture
def traps(tmp_path):
    """Return names of files that hang, are without end, or large, or folders."""
    os.mkfifo(tmp_path / "pipe")
    with (tmp_path / "large").open("wb") as file:
        file.truncate(120_000_000)
    (tmp_path / "deep").write_text("[" * 100_000)
    (tmp_path / "long").write_text("- 1\n" * 1_000_000)
    return [
        *(str(tmp_path / name) for name in ("pipe", "large", "deep", "long", "")),
        "/dev/zero",
        "/dev/stdin",
        "/proc/kmsg",
        "/proc/self/mem",
        "/proc/self/pagemap",
        "a\0b",
    ]


def requests_of(kind, traps):
    """Yield requests of a service: an empty one, and one with each field at its worst."""
    fields = kind.Request.get_fields_and_field_types()
    [name] = BASES.keys() & fields or [None]
    for base in BASES.get(name, [None]):
        request = kind.Request(**({} if name is None else {name: base}))
        yield request
        for place, spoilt in worst(request):
            # the value is a text: arrays are not read
            if not place.endswith("_array_value"):
                yield spoilt
    for path in traps if "path" in fields else ():
        yield kind.Request(path=path)


def reached(graph, kind, name, hello=None):
    """Return a client that is answered: a server drops answers until it has found the client."""
    client, asked = graph.hand.create_client(kind, name), []
    graph.until(client.service_is_ready, f"service {name}")

    def is_answered():
        asked.append(client.call_async(hello or kind.Request()))
        graph.executor.spin_once(timeout_sec=0.02)
        return any(one.done() for one in asked)

    graph.until(is_answered, f"an answer of {name}")
    return client


def ask(graph, client, requests):
    """Return the answers to all requests; each has one."""
    answers, requests = [], iter(requests)
    while group := list(islice(requests, AT_ONCE // 4)):  # services have queues of 10
        futures = [client.call_async(request) for request in group]
        graph.until(
            lambda asked=futures: all(one.done() for one in asked),
            f"answers of {client.service_name}",
        )
        answers += [one.result() for one in futures]
    return answers


def goal_of(path, number):
    """Return the request of a goal."""
    request = RunCalibration.Impl.SendGoalService.Request()
    request.goal.plan_path, request.goal_id.uuid = (
        path,
        [*divmod(number, 256), *[0] * 14],
    )
    return request


def results_of(graph, traps):
    """Return the results of goals of which none can be reached, one after the other."""
    impl, found = RunCalibration.Impl, []
    send = reached(
        graph, impl.SendGoalService, f"{ACTION}/send_goal", goal_of("no such", 0)
    )
    get = reached(graph, impl.GetResultService, f"{ACTION}/get_result")
    cancel = reached(graph, impl.CancelGoalService, f"{ACTION}/cancel_goal")
    # "" is the plan it has
    for number, path in enumerate([*filter(None, TEXTS), *traps], 1):
        goal = goal_of(path, number)
        assert [answer.accepted for answer in ask(graph, send, [goal, goal])] == [
            True,
            False,
        ]
        asked = impl.GetResultService.Request(goal_id=goal.goal_id)
        found += ask(graph, get, [asked])
        ask(graph, cancel, [impl.CancelGoalService.Request(), asked_to_end(goal)])
    return [item.result for item in found]


def asked_to_end(goal):
    """Return the request that cancels a goal which has ended."""
    request = RunCalibration.Impl.CancelGoalService.Request()
    request.goal_info.goal_id = goal.goal_id
    return request


def test_each_request_at_its_worst_is_answered_and_ends_nothing(
    graph, cell, all_kinds, refused, traps, capfd
):
    asked, called = (
        Counter(),
        {*(f"{ACTION}/{part}" for part in ("send_goal", "get_result", "cancel_goal"))},
    )
    half = len(good_run()) // 2
    play(graph, good_run()[:half])
    for node in all_kinds:
        for service in [*node.services]:
            client = reached(graph, service.srv_type, service.service_name)
            answers = ask(graph, client, requests_of(service.srv_type, traps))
            asked[node.get_fully_qualified_name()] += len(answers)
            called.add(service.service_name)
            graph.hand.destroy_client(client)
    assert len(asked) == len(all_kinds) and min(asked.values()) > 200, asked

    def offered():
        return {
            name
            for node in all_kinds
            for name, _ in node.get_service_names_and_types_by_node(
                node.get_name(), node.get_namespace()
            )
        }

    graph.until(
        lambda: offered() == called, "the services that were called, and no other"
    )
    graph.call(Trigger, "pose_sequencer/abort")  # or it rejects goals
    results = results_of(graph, traps)
    assert {result.error_code for result in results} == {2}
    odd = [
        (place, error)
        for place, error in refused
        if not isinstance(error, SelfcalError)
    ]
    assert {place for place, _ in odd} == RAISED_BY_RCLPY, [
        (place, error) for place, error in odd if place not in RAISED_BY_RCLPY
    ] or odd
    refused.clear()
    everybody_is_well(graph, cell, refused, capfd, half)
