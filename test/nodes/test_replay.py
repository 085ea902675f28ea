# SPDX-License-Identifier: Apache-2.0
"""`selfcal replay`: over DDS, at any pace and in any order, the map of `selfcal solve`."""

import re
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from rclpy.node import Node
from selfcal_msgs.srv import SaveMap
from std_msgs.msg import String
from std_srvs.srv import Trigger

from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.offline import Playlist, bag_input, bag_lines
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.cli import replay as replay_verb
from selfcal_ros.cli.main import main as selfcal
from selfcal_ros.collection.inputs import Command, Detection, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.player import Player
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.replay_session import ReplaySession
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.outputs import write_json
from selfcal_ros.settings.nodes import check_parameters
from test.support.bags import Foreign
from test.support.mark_lists import listed_plan
from test.support.plans import image_plan, placed_plan
from test.support.ports import settings_of
from test.support.sessions import (
    events_of,
    plan_file,
    small_bag,
    small_plan,
    stepped_bag,
)
from test.support.verbs import simulate


def undated(text: str) -> str:
    """Return the text of a result without the instant at which it was made."""
    assert text.count('"created": "') == 1
    return re.sub('"created": "[^"]*"', '"created": ""', text)


REJECTED = {"low_score": 0.05, "unknown_mark": 0.05, "outliers": 0.05}
"""Parts of the detections of the first bag that are rejected."""


def ordered_plan():
    """Return a plan that states in which order its marks are visited."""
    plan = small_plan(repeats=4)
    return replace(
        plan,
        views=tuple(
            replace(view, visit_order="x_back_y_back@plate") for view in plan.views
        ),
    )


PLANS = {
    "on the lattice": ordered_plan(),
    "placed": placed_plan(count=8, repeats=2),
    "images": image_plan(5, count=8, repeats=2),
    "a list of marks": listed_plan(),
    "even sides": image_plan(6, count=8, repeats=2),
}


@pytest.fixture(scope="module")
def solved(request, tmp_path_factory):
    """Return a bag and the text of the result that `selfcal solve` writes for it.

    On the lattice, unless a test names another of `PLANS`.
    """
    folder, plan = (
        tmp_path_factory.mktemp("replay"),
        PLANS[getattr(request, "param", "on the lattice")],
    )
    ordered = bool(plan.views[0].visit_order)
    bag = small_bag(folder, plan, correlation=4.0, **REJECTED if ordered else {})
    assert (
        selfcal(["solve", str(bag), "--quiet", "-o", str(folder / "solved.json")]) == 0
    )
    assert ("rejected_at" in read_json(folder / "solved.json")) is ordered
    return bag, undated((folder / "solved.json").read_text())


@pytest.fixture(scope="module")
def two_cells(tmp_path_factory):
    """Return a bag of two cells."""
    bag = tmp_path_factory.mktemp("two_cells") / "bag"
    for name, plan in (("", "0, 90, tx"), ("/cell2", "0, 90, ty")):
        Foreign(namespace=name).write(
            bag / f"x{name.strip('/')}.mcap", events_of(small_plan(plan, repeats=1))
        )
    return bag


def played(graph, bag, folder, *, rate=0.0, seed=-1, cell=None):
    """Return a session that has played a bag into the nodes, all of them in this process."""
    for node, parameters in (
        (MeasurementCollector, {}),
        (PoseSequencer, {}),
        (Solver, {"result_folder": str(folder)}),
    ):
        graph.node(node, **parameters)
    player = partial(Player, bag=str(bag), rate=rate, seed=seed, namespace=cell)
    session = graph.add(
        ReplaySession(player, str(folder / "saved.json"), context=graph.context)
    )
    graph.until(session.finished.done, "the end of the session")
    return session


def result_text(session, bag, folder, cell=None):
    """Return the text of the result that the command would write."""
    of_bag = bag_lines(bag, settings_of("measurement_collector"), cell)
    data = replay_verb.with_bag(
        read_json(folder / "saved.json"),
        of_bag,
        session.player.playlist.lost,
        bag_input(str(bag)),
    )
    write_json(folder / "replayed.json", data)
    return undated((folder / "replayed.json").read_text())


@pytest.mark.parametrize(
    ("solved", "options"),
    [("on the lattice", {"rate": 50.0}), *((name, {"seed": 3}) for name in PLANS)],
    indirect=["solved"],
)
def test_a_session_gives_the_result_of_solve_bit_for_bit(
    graph, solved, tmp_path, options, capfd
):
    bag, expected = solved
    session = played(graph, bag, tmp_path, **options)
    assert session.exit_code == 0
    assert result_text(session, bag, tmp_path) == expected
    said = capfd.readouterr()
    total = session.player.total
    assert said.out.splitlines()[-1] == f"progress {total} {total}"
    assert "ERROR" not in said.err
    assert "Traceback" not in said.err


@pytest.mark.parametrize("cell", ["/", "/cell2"])
def test_one_of_two_cells_is_played(graph, two_cells, tmp_path, cell):
    session = played(graph, two_cells, tmp_path, cell=cell)
    assert (
        selfcal(
            [
                "solve",
                str(two_cells),
                "--namespace",
                cell,
                "--quiet",
                "-o",
                str(tmp_path / "solved.json"),
            ]
        )
        == 0
    )
    assert result_text(session, two_cells, tmp_path, cell) == undated(
        (tmp_path / "solved.json").read_text()
    )


def test_of_two_cells_one_must_be_named(graph, two_cells):
    player = partial(Player, bag=str(two_cells), rate=0.0, seed=-1, namespace=None)
    with pytest.raises(InputError, match="choose one with --namespace"):
        ReplaySession(player, "saved.json", context=graph.context)


@pytest.mark.parametrize(
    ("options", "arguments"),
    [
        ([], ["1.0", ""]),
        (["--fast"], ["0.0", ""]),
        (["--rate", "50"], ["50.0", ""]),
        (["--namespace", "/"], ["1.0", "/"]),
        (["--namespace", "cell2"], ["1.0", "/cell2"]),
    ],
    ids=" ".join,
)
def test_what_a_session_is_told_and_that_its_code_is_that_of_the_command(
    monkeypatch, two_cells, solved, options, arguments
):
    started, bag = {}, str(two_cells if "cell2" in options else solved[0])

    @contextmanager
    def process(module, given, *_, **__):
        started[module.removeprefix("selfcal_ros.nodes.")] = given
        yield SimpleNamespace(stdout=["progress 3 4\n"], wait=lambda: 4)

    monkeypatch.setattr(replay_verb, "process", process)
    assert selfcal(["replay", bag, *options]) == 4
    assert list(started) == [*replay_verb.NODES, "replay_session"]
    played_bag, *rest = started["replay_session"][:4]
    saved = rest.pop(1)
    assert (played_bag, rest) == (bag, arguments)
    assert f"result_folder:={Path(saved).parent}" in started["solver"]


def test_a_deficient_bag_ends_with_code_3_and_the_result_of_solve(
    graph, tmp_path, capfd
):
    """The session's code is that of the command, as another test has it."""
    bag = small_bag(tmp_path, small_plan("0, 90"), low_score=0.05)
    session = played(graph, bag, tmp_path)
    assert session.exit_code == 3
    [line] = [
        text
        for text in capfd.readouterr().err.splitlines()
        if "selfcal replay: " in text
    ]
    solved = tmp_path / "solved.json"
    assert selfcal(["solve", str(bag), "--quiet", "-o", str(solved)]) == 3
    [same] = [
        text
        for text in capfd.readouterr().err.splitlines()
        if "selfcal solve: " in text
    ]
    assert line.removeprefix("selfcal replay: ") == same.removeprefix("selfcal solve: ")
    assert result_text(session, bag, tmp_path) == undated(solved.read_text())


def test_a_bag_without_marks_ends_at_once_as_by_solve(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(replay_verb, "process", None)  # no node is started
    bag = Foreign().write(
        tmp_path / "x.mcap",
        [
            event
            for event in events_of(small_plan())
            if not isinstance(event, Detection)
        ],
    )
    assert selfcal(["solve", str(bag)]) == 4
    said = capsys.readouterr().err
    assert "no message on stage/mark_detections; record this topic too" in said
    assert selfcal(["replay", str(bag)]) == 4
    assert capsys.readouterr().err == said.replace(
        "selfcal solve: ", "selfcal replay: "
    )


def test_detections_that_are_all_rejected_end_the_session_with_code_4(
    graph, tmp_path, capfd
):
    bag = Foreign().write(
        tmp_path / "x.mcap",
        [
            replace(event, score=1e-3) if isinstance(event, Detection) else event
            for event in events_of(small_plan())
        ],
    )
    assert played(graph, bag, tmp_path).exit_code == 4
    assert (
        "selfcal replay: plan '0, 90, tx': no grid mark was read"
        in capfd.readouterr().err
    )


def test_a_plate_placed_otherwise_is_bad_input_as_by_solve(
    monkeypatch, tmp_path, capsys
):
    plan = {
        "plan_id": "p",
        "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 0},
        "views": [
            {"name": "a", "repeats": 2},
            {"name": "b", "rotation_deg": 90, "repeats": 2},
            {"name": "c", "translation_pitch": [1, 0], "repeats": 2},
        ],
    }
    simulate(tmp_path, "turned", plan, placed=[{"name": "b", "rotation_deg": 180}])
    simulate(tmp_path, "deficient", plan | {"views": plan["views"][:2]})

    @contextmanager
    def process(module, given, *_, **__):
        """Stand for a session that found the plan not identified."""
        if module.endswith("replay_session"):
            assert selfcal(["solve", given[0], "--quiet", "-o", given[2]]) in (2, 3)
            capsys.readouterr()
        yield SimpleNamespace(stdout=[], wait=lambda: 3)

    monkeypatch.setattr(replay_verb, "process", process)
    assert selfcal(["replay", str(tmp_path / "turned"), "--fast"]) == 2
    [line] = capsys.readouterr().err.splitlines()
    assert (
        "the plate lies turned by 180°, not by 90°" in line
        and "correct this first" in line
    )
    assert selfcal(["replay", str(tmp_path / "deficient"), "--fast"]) == 3
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("noted", [False, True], ids=["played fast", "in real time"])
def test_a_clock_that_stepped_is_said_once_as_solve_says_it(
    monkeypatch, tmp_path, capsys, noted
):
    """Played fast no node can see it; in real time the collector notes the same line."""
    bag, folder = str(stepped_bag(tmp_path, 0.2)), tmp_path
    assert selfcal(["solve", bag, "--quiet", "-o", str(folder / "solved.json")]) == 0
    line = capsys.readouterr().err.splitlines()[0]
    solved = read_json(folder / "solved.json")
    *others, _ = solved["warnings"]

    @contextmanager
    def process(module, given, *_, **__):
        if module.endswith("replay_session"):
            print("what the nodes say", file=sys.stderr)
            write_json(
                given[2], solved | {"warnings": solved["warnings"] if noted else others}
            )
        yield SimpleNamespace(stdout=[], wait=lambda: 0)

    monkeypatch.setattr(replay_verb, "process", process)
    assert (
        selfcal(
            ["replay", bag, "--fast", "--quiet", "-o", str(folder / "replayed.json")]
        )
        == 0
    )
    assert capsys.readouterr().err.splitlines() == [
        line.replace("selfcal solve: ", "selfcal replay: "),
        "what the nodes say",
    ]
    assert undated((folder / "replayed.json").read_text()) == undated(
        (folder / "solved.json").read_text()
    )
    params = folder / "p.yaml"
    params.write_text("measurement_collector: {ros__parameters: {clock_limit: 5.0}}")
    assert selfcal(["replay", bag, "--fast", "--quiet", "--params", str(params)]) == 0
    assert capsys.readouterr().err == "what the nodes say\n"


@pytest.mark.parametrize(("plan", "code"), [("0, 90, tx, ty", 0), ("0, 90", 3)])
def test_many_rejections_are_said_as_solve_says_them(
    monkeypatch, tmp_path, capsys, plan, code
):
    bag = small_bag(tmp_path, small_plan(plan, repeats=4), not_finite=0.2)
    assert (
        selfcal(["solve", str(bag), "--quiet", "-o", str(tmp_path / "solved.json")])
        == code
    )
    said = capsys.readouterr().err.splitlines(keepends=True)[0]
    assert "detections were rejected" in said and "not_finite" in said

    @contextmanager
    def process(module, given, *_, **__):
        if module.endswith("replay_session"):
            write_json(given[2], read_json(tmp_path / "solved.json"))
        yield SimpleNamespace(stdout=[], wait=lambda: code)

    monkeypatch.setattr(replay_verb, "process", process)
    assert selfcal(["replay", str(bag), "--fast", "--quiet"]) == code
    assert capsys.readouterr().err == said.replace(
        "selfcal solve: ", "selfcal replay: "
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (
            "solver: {ros__parameters: {datum_theta: xy_axes}}",
            "datum_theta: solver has no such parameter; did you mean 'theta_datum'",
        ),
        (
            "solvr: {ros__parameters: {robust: true}}",
            "/solvr: no node of this package; did you mean 'solver'",
        ),
        (
            "/**: {ros__parameters: {robust: maybe}}",
            "robust: 'maybe' is not of type bool",
        ),
    ],
)
@pytest.mark.parametrize("verb", [["replay", "bag"], ["up", "--plan", "PLAN"]])
def test_a_parameter_that_no_node_takes_is_refused_before_any_is_started(
    tmp_path, capsys, text, problem, verb
):
    plan, params = plan_file(tmp_path, small_plan()), tmp_path / "p.yaml"
    params.write_text(text)
    words = [plan if word == "PLAN" else word for word in verb]
    assert selfcal([*words, "--params", str(params)]) == 2
    assert f"selfcal {verb[0]}: {params}: {problem}" in capsys.readouterr().err


def test_sections_of_two_cells_may_differ():
    section = {"ros__parameters": {"robust": True}}
    other = {"ros__parameters": {"robust": False, "use_sim_time": True}}
    check_parameters({"/a/solver": section, "/b/solver": other}, "p.yaml")


def test_a_file_may_hold_parameters_of_other_packages():
    camera = {"ros__parameters": {"exposure": 0.01}}
    everywhere = {"ros__parameters": {"exposure": 0.01, "robust": True}}
    check_parameters({"/camera": camera, "/**": everywhere}, "p.yaml")
    everywhere["ros__parameters"]["robsut"] = True
    with pytest.raises(InputError, match="did you mean 'robust'"):
        check_parameters({"/**": everywhere}, "p.yaml")


@pytest.mark.parametrize(("plan", "code"), [("0, 90, tx, ty", 0), ("0, 90, tx", 2)])
def test_a_lost_command_is_said_once_whether_or_not_it_spoils_the_map(
    monkeypatch, tmp_path, capsys, plan, code
):
    bag, plan = tmp_path / "lost.mcap", small_plan(plan, repeats=4)
    index = next(i for i, view in enumerate(plan.views) if view.name == "tx")
    Foreign().write(
        bag,
        [
            event
            for event in events_of(plan)
            if not (
                isinstance(event, Command)
                and event.phase == Phase.MEASURE
                and event.view_index == index
            )
        ],
    )
    solved = tmp_path / "solved.json"
    assert selfcal(["solve", str(bag), "--quiet", "-o", str(solved)]) == code
    lost = capsys.readouterr().err.splitlines()[0]
    assert "view 'tx' was placed, and " in lost and "MEASURE command is missing" in lost

    @contextmanager
    def process(module, given, *_, **__):
        if module.endswith("replay_session"):
            write_json(given[2], read_json(solved))
        yield SimpleNamespace(stdout=[], wait=lambda: 3 if code else 0)

    monkeypatch.setattr(replay_verb, "process", process)
    assert selfcal(["replay", str(bag), "--fast", "--quiet"]) == code
    first, *others = capsys.readouterr().err.splitlines()
    assert first == lost.replace("selfcal solve: ", "selfcal replay: ")
    assert others == [
        f"selfcal replay: {bag}: not identified, for the reason said first; correct this first"
    ] * bool(code)


def test_messages_of_the_future_are_rejected_by_the_command_as_by_solve(
    monkeypatch, tmp_path
):
    """They are not played: here a detection that is stamped a day late."""
    bag = stepped_bag(tmp_path, 0.0)
    with BagWriter(tmp_path / "more") as writer:
        writer.add_topic(
            f"/{names.DETECTIONS.name}", "selfcal_msgs/msg/MarkDetection", []
        )
        late = next(e for e in events_of(small_plan()) if isinstance(e, Detection))
        writer.write(
            f"/{names.DETECTIONS.name}",
            event_fields(
                replace(late, stamp_ns=late.stamp_ns + 86400 * 10**9), "stage"
            )[1],
            late.stamp_ns,
        )
    (tmp_path / "more" / "more_0.mcap").rename(bag / "bag_1.mcap")
    (bag / "metadata.yaml").unlink()
    assert (
        selfcal(["solve", str(bag), "--quiet", "-o", str(tmp_path / "solved.json")])
        == 0
    )
    solved = read_json(tmp_path / "solved.json")
    assert solved["rejected"] == {"from_the_future": 1}
    *before, line = solved["warnings"]
    assert "stage/mark_detections: what was stamped more than 60 s ahead" in line

    @contextmanager
    def process(module, given, *_, **__):
        if module.endswith("replay_session"):
            write_json(given[2], solved | {"rejected": {}, "warnings": before})
        yield SimpleNamespace(
            stdout=[f"lost {text}" for text in Playlist(bag).lost], wait=lambda: 0
        )

    monkeypatch.setattr(replay_verb, "process", process)
    assert (
        selfcal(
            ["replay", str(bag), "--fast", "--quiet", "-o", str(tmp_path / "r.json")]
        )
        == 0
    )
    assert undated((tmp_path / "r.json").read_text()) == undated(
        (tmp_path / "solved.json").read_text()
    )


def serve(graph, finish=lambda _, answer: answer, save=lambda _, answer: answer):
    """Answer the requests of a session as collector and solver do."""
    for name, kind, service, answer in (
        ("measurement_collector", Trigger, "~/finish", finish),
        ("solver", SaveMap, "~/save_map", save),
    ):
        node = graph.add(Node(name, context=graph.context))
        node.create_service(kind, service, answer)


def test_the_map_is_saved_once_the_solver_has_solved_what_the_collector_sent_last(
    graph,
):
    told, saved, turns = [], [], []

    def answer(_, response):
        response.success, response.message = True, "of all views"
        return response

    def save(_, response):
        saved.append(told[-1])
        response.success = True
        return response

    serve(graph, answer, save)
    solver = graph.hand.create_publisher(String, "solver/solved", names.SOLVED.qos)

    def tell(text):
        told.append(text)
        solver.publish(String(data=text))

    tell("of three views")
    player = SimpleNamespace(
        deaf=list,
        done=True,
        step=lambda: None,
        played=1,
        total=1,
        arrived=True,
        alone_on=[],
        is_alone=lambda: True,
        playlist=SimpleNamespace(lost=[]),
    )
    session = graph.add(
        ReplaySession(lambda _: player, "map.json", context=graph.context)
    )
    graph.hand.create_timer(0.005, lambda: turns.append(session._digest))
    graph.until(
        lambda: turns.count("of all views") > 20, "the session to wait for the solver"
    )
    tell("of all views")
    graph.until(session.finished.done, "the end of the session")
    assert (saved, session.exit_code) == (["of all views"], 0)


@pytest.mark.parametrize(
    ("topic", "played"),
    [
        (names.ENCODER, "stage/joint_states"),
        (names.ERROR_MAP, "selfcal/error_map"),
        (names.MOTION, "stage/command"),
    ],
)
def test_a_session_plays_nothing_where_somebody_else_publishes(
    graph, solved, tmp_path, capfd, topic, played
):
    graph.hand.create_publisher(topic.type, topic.name, topic.qos)
    heard = graph.listen(names.DETECTIONS)
    player = partial(Player, bag=str(solved[0]), rate=0.0, seed=-1)
    session = graph.add(
        ReplaySession(player, str(tmp_path / "r.json"), context=graph.context)
    )
    graph.until(session.finished.done, "the end of the session")
    domain = graph.context.get_domain_id()
    assert (session.exit_code, heard) == (2, [])
    assert capfd.readouterr().err == (
        f"selfcal replay: ROS domain {domain}: /hand publishes {played} as well; 0 messages were "
        "played; end it, or play in another ROS domain\n"
    )


def test_a_session_plays_nothing_where_somebody_else_answers_its_requests(graph, capfd):
    serve(graph)
    graph.add(Node("stranger", context=graph.context)).create_service(
        SaveMap, "/solver/save_map", lambda _, response: response
    )
    player = SimpleNamespace(
        deaf=list,
        alone_on=[],
        is_alone=lambda: True,
        played=0,
        playlist=SimpleNamespace(lost=[]),
    )
    session = graph.add(
        ReplaySession(lambda _: player, "map.json", context=graph.context)
    )
    graph.until(session.finished.done, "the end of the session")
    domain = graph.context.get_domain_id()
    assert session.exit_code == 2
    assert capfd.readouterr().err == (
        f"selfcal replay: ROS domain {domain}: /stranger answers /solver/save_map as well; "
        "0 messages were played; end it, or play in another ROS domain\n"
    )


def test_what_was_received_beyond_what_was_sent_is_somebody_elses(graph, capfd):
    player = SimpleNamespace(
        deaf=list,
        done=True,
        step=lambda: None,
        played=5,
        total=5,
        arrived=False,
        alone_on=[],
        is_alone=lambda: True,
        overheard=True,
        taken=None,
        sent={"encoder": 3, "detection": 2},
        heard={"encoder": 9, "detection": 2},
        playlist=SimpleNamespace(lost=[]),
    )
    serve(graph)
    session = graph.add(
        ReplaySession(lambda _: player, "map.json", context=graph.context)
    )
    graph.until(session.finished.done, "the end of the session")
    assert session.exit_code == 2
    assert capfd.readouterr().err == (
        "selfcal replay: the nodes heard somebody else as well: 9 of 3 encoder messages received, "
        "2 of 2 detection messages received; play in a ROS domain of its own\n"
    )


def test_nothing_is_played_before_the_nodes_listen(graph):
    deaf, steps, turns = ["a node does not listen to encoder"], [], []
    player = SimpleNamespace(
        deaf=lambda: turns.append(1) or deaf,
        done=True,
        step=lambda: steps.append(1),
        played=5,
        total=5,
        arrived=False,
        alone_on=[],
        is_alone=lambda: True,
        overheard=True,
        taken=None,
        sent={},
        heard={},
        playlist=SimpleNamespace(lost=[]),
    )
    serve(graph)
    session = graph.add(
        ReplaySession(lambda _: player, "map.json", context=graph.context)
    )
    graph.until(lambda: len(turns) > 20, "the session to wait for the nodes")
    assert not steps
    deaf.clear()
    graph.until(session.finished.done, "the end of the session")
    assert steps


@pytest.mark.parametrize(
    "options, problem",
    [
        (
            ["--domain", "233"],
            "--domain: 233 is not a ROS domain; give a number from 0 to 232",
        ),
        (["--rate", "0"], "--rate: 0 is not a speed; give a number above 0"),
    ],
)
def test_speeds_and_domains_that_are_none(options, problem, capsys):
    assert selfcal(["replay", "bag", *options]) == 2
    assert problem in capsys.readouterr().err


def test_what_follows_the_four_arguments_of_a_session_is_for_ros(monkeypatch):
    from selfcal_ros.nodes import replay_session

    given = []
    monkeypatch.setattr(
        replay_session, "run", lambda make, args: given.append(args) or 3
    )
    for more in (
        [],
        ["--ros-args", "-p", "a:=1", "-p", "b:=2", "-p", "c:=3", "-p", "d:=4"],
    ):
        monkeypatch.setattr(
            "sys.argv", ["session", "bag", "2.0", "r.json", "/cell", *more]
        )
        with pytest.raises(SystemExit) as ended:
            replay_session.main()
        assert ended.value.code == 3 and given.pop() == more
