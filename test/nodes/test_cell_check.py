# SPDX-License-Identifier: Apache-2.0
"""`selfcal cell check` beside the simulated cell: all well, and each fault by its name.

The cell moves the time of both on, by a step for each look at its clock: a machine that is busy
makes it slow, and nothing late.
"""

import json
import re
import signal
import subprocess
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rosgraph_msgs.msg import Clock

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.cli import cell
from selfcal_ros.cli.main import main
from selfcal_ros.cli.processes import process
from selfcal_ros.collection.inputs import Detection, EncoderSample, Phase
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.nodes import cell_checker, names
from selfcal_ros.nodes.cell_checker import CellChecker
from selfcal_ros.nodes.sessions import cell_check
from selfcal_ros.nodes.stage_simulator import StageSimulator
from test.support.mark_lists import listed_plan
from test.support.plans import plan_of
from test.support.sessions import plan_file, small_plan
from test.support.sources import ROOT

SECOND = 10**9
STEP_NS = 40_000_000
CHECKS = [
    "publishers",
    "joints",
    "encoder rate",
    "encoder clock",
    "abort",
    "detection clock",
    "rest",
    "ids",
    "marks",
    "check stops",
    "signs",
    "theta",
    "revisits",
    "old commands",
]


class FaultyCell(StageSimulator):
    """The simulated cell with a fault of the integration."""

    def __init__(self, fault, **kwargs):
        self.fault, self.number = fault, 0
        super().__init__(**kwargs)
        self._clock_voice = self.create_publisher(Clock, "/clock", names._qos(10))

    def _on_timer(self):
        now = self.get_clock().now().nanoseconds
        if now:
            super()._on_timer()
        elif not all(
            self.count_subscribers(topic.name)
            for topic in (names.ENCODER, names.DETECTIONS)
        ):
            return  # time begins when somebody listens
        second, nanosecond = divmod(now + STEP_NS if now else time.time_ns(), SECOND)
        self._clock_voice.publish(Clock(clock=Time(sec=second, nanosec=nanosecond)))

    def _on_command(self, message):
        command = to_model.command(message)
        if self.fault == "deaf":
            return
        if self.fault == "goes on after ABORT" and command.phase == Phase.ABORT:
            return
        if self.fault == "acts again":
            self._duty._acted.clear()
        super()._on_command(message)

    def _on_status(self, message):
        if self.fault != "never revisits":
            super()._on_status(message)

    def _measure(self, command, again):
        if self.fault == "no check stops":
            command = replace(
                command, view=replace(command.view, check_marks=0, check_offset_m=0.0)
            )
        super()._measure(command, again)

    def tell(self, event):
        is_detection = isinstance(event, Detection)
        self.number += is_detection
        if self.fault == "loses" and is_detection and self.number % 7 == 0:
            return
        shift = {
            "detections ahead": 3 * SECOND * is_detection,
            "all behind": -5 * SECOND,
            "while it moves": 5_000_000 * is_detection,
        }.get(self.fault, 0)
        if self.fault == "other joints" and isinstance(event, EncoderSample):
            event = replace(event, names=("a", "b", "c"))
        if "turned" in self.fault and is_detection and event.kind == 0:
            turn = np.exp(1j * np.deg2rad(float(self.fault.split()[1])))
            seen = turn * (event.offset_x + 1j * event.offset_y)
            event = replace(event, offset_x=seen.real, offset_y=seen.imag)
        if self.fault == "wrong ids" and is_detection and event.kind == 0:
            event = replace(event, m=event.n, n=event.m)
        if self.fault == "m reversed" and is_detection and event.kind == 0:
            # an even side has m from -N/2 to N/2 - 1
            event = replace(event, m=-1 - event.m)
        if self.fault == "m negated" and is_detection and event.kind == 0:
            event = replace(event, m=-event.m)
        if self.fault == "k shifted" and is_detection and event.kind == 1:
            event = replace(event, k=(event.k + 1) % 8)
        if self.fault == "reversed offset_theta" and is_detection and event.kind == 1:
            event = replace(event, offset_theta=-event.offset_theta)
        super().tell(replace(event, stamp_ns=event.stamp_ns + shift))


class Checker(CellChecker):
    """Waits by the time of the cell."""

    def ports(self, publish):
        return replace(
            super().ports(publish),
            now_s=lambda: self.get_clock().now().nanoseconds / SECOND,
        )


@pytest.fixture
def short(monkeypatch):
    """Let the check wait for less: this cell exposes a hundred times a second."""
    for name, seconds in (
        ("LISTEN_S", 0.5),
        ("WATCH_S", 0.5),
        ("REVISIT_S", 3.0),
        ("STALL_S", 1.0),
    ):
        monkeypatch.setattr(cell_check, name, seconds)


def checked(graph, fault="", checker=(), plan=None, **cell):
    """Return the node that has checked a cell, and its items by name."""
    graph.node(partial(FaultyCell, fault), servo_sigma=1e-9, use_sim_time=True, **cell)
    node = graph.node(
        partial(Checker, plan or small_plan(), settle_s=0.2, patience_s=5.0),
        use_sim_time=True,
        **dict(checker),
    )
    graph.until(node.finished.done, "the end of the check")
    return node, {item.name: item for item in node.session.items}


def failed(items):
    return {name for name, item in items.items() if not item.passed}


@pytest.mark.usefixtures("short")
def test_a_node_of_another_package_in_error_is_heard(graph):
    """Published again and again, as the checker may not have been found yet."""
    publisher = graph.hand.create_publisher(DiagnosticArray, "/diagnostics", 10)
    hot = DiagnosticStatus(
        name="motor x", level=DiagnosticStatus.ERROR, message="too hot"
    )
    graph.hand.create_timer(
        0.1, lambda: publisher.publish(DiagnosticArray(status=[hot]))
    )
    node, items = checked(graph)
    assert failed(items) == {"diagnostics"}, items
    assert items["diagnostics"].figure == "ERROR on /diagnostics: motor x: too hot"
    assert node.exit_code == ExitCode.NOT_QUALIFIED


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
def test_a_good_cell_passes_every_check(graph, sense):
    node, items = checked(
        graph, measurement_sense=sense, checker={"measurement_sense": sense}
    )
    assert failed(items) == set(), items
    assert node.exit_code == ExitCode.DONE
    assert list(items) == CHECKS
    assert "9 of 9 marks and 8 of 8 lines 2 times" in items["marks"].figure
    assert items["check stops"].figure == "5 of 5 marks from all four sides"
    assert re.search(r"x -(1\.00|0\.99)\d, y -(1\.00|0\.99)\d ", items["signs"].figure)
    assert not any(item.remedy for item in items.values())


@pytest.mark.usefixtures("short")
def test_a_plate_with_a_list_of_marks_is_checked_by_the_innermost(graph):
    _, items = checked(graph, plan=listed_plan())
    assert failed(items) == set(), items
    assert "9 of 9 marks and 8 of 8 lines 2 times" in items["marks"].figure


@pytest.mark.usefixtures("short")
def test_a_plate_of_even_sides_is_checked_about_the_same_centre(graph):
    """With a centre mark the stage would stop half a pitch beside every mark."""
    _, items = checked(graph, plan=plan_of("0, 90, tx", 6, size_y=5, count=8))
    assert failed(items) == set(), items
    assert "12 of 12 marks and 8 of 8 lines 2 times" in items["marks"].figure


@pytest.mark.usefixtures("short")
def test_a_cell_without_ids_passes_and_that_is_said(graph):
    _, items = checked(graph, with_ids=False)
    assert failed(items) == set(), items
    assert items["ids"].figure.endswith(
        "name their mark: marks are identified by their positions"
    )


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("cell", "figure", "remedy"),
    [
        ({"microscope_axes": "-x-y"}, "offsets of the other sign", "reverse the sign"),
        (
            {"microscope_axes": "-xy"},
            "offsets of the other sign: offset_x",
            "reverse the sign",
        ),
        ({"microscope_axes": "yx"}, "exchanged axes", "along the stage's axes"),
        (
            {"microscope_pixels": 2.0},
            "offsets in wrong units",
            "correct the pixel size",
        ),
        (
            {"microscope_pixels": 0.5},
            "offsets in wrong units",
            "correct the pixel size",
        ),
    ],
    ids=lambda value: (
        "-".join(map(str, value.values())) if isinstance(value, dict) else ""
    ),
)
def test_offsets_that_do_not_follow_the_stage(graph, cell, figure, remedy):
    node, items = checked(graph, **cell)
    assert "signs" in failed(items)
    assert items["signs"].figure.startswith(figure)
    assert remedy in items["signs"].remedy
    assert node.exit_code == ExitCode.NOT_QUALIFIED


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("fault", "name", "figure"),
    [
        ("deaf", "commands", "0 detections in 5 s after MEASURE"),
        ("goes on after ABORT", "abort", "detections exposed later than"),
        (
            "acts again",
            "old commands",
            "detections after a finished MEASURE was sent again",
        ),
        ("never revisits", "revisits", "not measured again within 3 s"),
        ("no check stops", "check stops", "0 of 5 marks from all four sides"),
        ("loses", "marks", "of 9 marks"),
        ("detections ahead", "detection clock", "stamps -2"),
        ("all behind", "encoder clock", "stamps 5"),
        ("while it moves", "rest", "exposures while the stage moved"),
        ("other joints", "joints", "heard a, b, c"),
        ("wrong ids", "ids", "m and n are exchanged"),
        ("reversed offset_theta", "theta", ": offset_theta has the other sign"),
        ("turned 90", "signs", "the offsets are turned by +90."),
        ("turned -30", "signs", "the offsets are turned by -30."),
    ],
)
def test_a_fault_of_the_cell_is_named(graph, fault, name, figure):
    node, items = checked(
        graph, fault, exposure_period=0.04 if "ABORT" in fault else 0.01
    )
    assert name in failed(items), items
    assert next(item.name for item in node.session.items if not item.passed) == name
    assert figure in items[name].figure
    assert items[name].remedy
    assert node.exit_code == ExitCode.NOT_QUALIFIED


@pytest.mark.usefixtures("short")
def test_a_check_that_an_error_ends_has_failed(graph, monkeypatch):
    def fails(*_):
        raise InputError("view 'check'", "does not lie on the lattice", "shift it")

    monkeypatch.setattr(cell_check, "explaining", fails)
    node, items = checked(graph, "wrong ids")
    assert failed(items) == {"check"}
    assert items["check"].figure == (
        "ended by an error: view 'check': does not lie on the lattice; shift it"
    )
    assert node.exit_code == ExitCode.NOT_QUALIFIED


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("fault", ["m reversed", "m negated"])
def test_reversed_ids_of_an_even_side_are_named(graph, fault):
    _, items = checked(graph, fault, plan=plan_of("0, 90, tx", 6, size_y=5, count=8))
    assert items["ids"].figure.startswith("m is counted against plate x (")


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize(
    ("sense", "deg"), [("microscope_moves", "-45"), ("plate_moves", "+45")]
)
def test_lines_that_are_counted_from_another_one_are_named(graph, sense, deg):
    _, items = checked(
        graph,
        "k shifted",
        measurement_sense=sense,
        checker={"measurement_sense": sense},
    )
    assert items["ids"].figure.startswith(
        f"theta is indicated {deg}° from where the lines are ("
    )


@pytest.mark.usefixtures("short")
def test_detections_of_another_quality_of_service_are_named(graph, monkeypatch):
    unheard = replace(names.DETECTIONS, qos=names.CORRECTED.qos)  # best effort
    monkeypatch.setattr(names, "DETECTIONS", unheard)
    graph.node(partial(FaultyCell, ""), servo_sigma=1e-9, use_sim_time=True)
    monkeypatch.undo()
    node = graph.node(
        partial(Checker, small_plan(), settle_s=0.2, patience_s=5.0), use_sim_time=True
    )
    graph.until(node.finished.done, "the end of the check")
    item = node.session.items[-1]
    assert item.name == "commands" and not item.passed
    assert "no messages are received from /stage_simulator (" in item.figure
    assert item.remedy == "offer the QoS in docs/reference/ros2.md"


@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("topic", [names.ENCODER, names.DETECTIONS])
def test_two_publishers_of_a_topic_are_the_first_fault_and_the_only_one(graph, topic):
    graph.hand.create_publisher(topic.type, topic.name, topic.qos)
    _, items = checked(graph)
    assert list(items) == ["publishers"] and failed(items) == {"publishers"}
    assert (
        items["publishers"].figure
        == f"2 publishers of {topic.name}: hand, stage_simulator"
    )


@pytest.mark.usefixtures("short")
def test_a_cell_that_says_nothing(graph):
    node = graph.node(partial(CellChecker, small_plan(), settle_s=0.0, patience_s=0.5))
    graph.until(node.finished.done, "the end of the check")
    [item] = node.session.items
    assert (item.name, item.passed) == ("encoder", False)


def test_a_sequencer_beside_it_is_refused(graph):
    node = graph.node(partial(CellChecker, small_plan(), settle_s=0.0, patience_s=60.0))
    graph.hand.create_publisher(
        names.COMMAND.type, names.COMMAND.name, names.COMMAND.qos
    )
    graph.until(node.finished.done, "the refusal")
    assert node.exit_code == ExitCode.BAD_INPUT
    assert node.session.items == []
    sent = []
    node._outputs["command"] = sent.append
    node.close()  # without a word to the cell, which the other commands
    assert sent == []


def test_an_interrupted_check_aborts_its_view(graph, ros_environment, tmp_path):
    """Between PLACE and MEASURE, where the check itself sends no ABORT."""
    plan, phases = plan_file(tmp_path, small_plan()), []
    graph.hand.create_subscription(
        names.COMMAND.type,
        names.COMMAND.name,
        lambda message: phases.append(to_model.command(message).phase),
        names.COMMAND.qos,
    )
    with (
        process("selfcal_ros.nodes.stage_simulator", [], ros_environment),
        process(
            "selfcal_ros.nodes.cell_checker",
            [plan, "60", "60"],
            ros_environment,
            stdout=subprocess.DEVNULL,
        ) as checker,
    ):
        graph.until(lambda: phases, "PLACE")
        checker.send_signal(signal.SIGINT)
        graph.until(lambda: len(phases) > 1, "ABORT")
    assert phases == [Phase.PLACE, Phase.ABORT]


def test_the_verb_checks_a_simulated_cell(ros_environment, tmp_path, capfd):
    """The cell tells the offsets of doubled pixels."""
    plan = plan_file(tmp_path, small_plan())
    with process(
        "selfcal_ros.nodes.stage_simulator",
        ["--ros-args", "-r", "__ns:=/left", "-p", "microscope_pixels:=2.0"],
        ros_environment,
    ):
        assert main(["cell", "check", "--plan", plan, "--namespace", "left"]) == 5
    said = capfd.readouterr().out
    assert [
        re.match("(pass|FAIL)  (.*?): ", line)[2]
        for line in said.splitlines()[:-1]
        if not line.startswith(" ")
    ] == [name for name in CHECKS if name != "theta"]
    assert "FAIL  signs: offsets in wrong units" in said
    assert said.splitlines()[-1].endswith(" of 13 checks failed")


@pytest.mark.parametrize(
    ("code", "words", "said"),
    [
        (
            0,
            [],
            "pass  rest: still\nall 1 checks passed: the cell is ready for a calibration\n",
        ),
        (
            0,
            ["--json"],
            {
                "passed": True,
                "items": [
                    {
                        "name": "rest",
                        "passed": True,
                        "figure": "still",
                        "remedy": "",
                        "follows": "",
                    }
                ],
            },
        ),
        (
            5,
            ["--json"],
            {
                "passed": False,
                "items": [
                    {
                        "name": "rest",
                        "passed": False,
                        "figure": "moves",
                        "remedy": "wait",
                        "follows": "",
                    }
                ],
            },
        ),
        (5, [], "FAIL  rest: moves\n      wait\n1 of 1 checks failed\n"),
    ],
)
def test_what_the_verb_says(tmp_path, monkeypatch, capfd, code, words, said):
    item = {
        "name": "rest",
        "passed": not code,
        "figure": "moves" if code else "still",
        "remedy": "wait" if code else "",
        "follows": "",
    }

    @contextmanager
    def child(*_, **__):
        lines = ["a word of the middleware\n", json.dumps(item)]
        yield SimpleNamespace(stdout=lines, wait=lambda: code)

    monkeypatch.setattr(cell, "process", child)
    assert (
        main(["cell", "check", "--plan", plan_file(tmp_path, small_plan()), *words])
        == code
    )
    found, aside = capfd.readouterr()
    assert aside == "a word of the middleware\n"
    assert (json.loads(found) if words else found) == said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--settle", "-1"], "--settle: -1 s is not a waiting time; give 0 or more"),
        (
            ["--patience", "nan"],
            "--patience: nan s is not a waiting time; give 0 or more",
        ),
        (["--params", "none.yaml"], "none.yaml"),
    ],
)
def test_bad_options_of_the_verb(tmp_path, capsys, words, said):
    plan = plan_file(tmp_path, small_plan())
    assert main(["cell", "check", "--plan", plan, *words]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.usefixtures("short")
def test_the_response_of_each_axis_is_its_own(graph):
    _, items = checked(graph, microscope_stretch=0.02)
    x, y = (
        float(part.split()[1])
        for part in items["signs"]
        .figure.removeprefix("offset against stage ")
        .split(", ")[:2]
    )
    assert (x, y) == (
        pytest.approx(-1 / 1.02, abs=3e-3),
        pytest.approx(-1 / 0.98, abs=3e-3),
    )


def test_what_follows_the_three_arguments_of_a_check_is_for_ros(monkeypatch):
    given = []
    monkeypatch.setattr(cell_checker, "run", lambda make, args: given.append(args) or 3)
    for more in ([], ["--ros-args", "-p", "a:=1", "-p", "b:=2", "-p", "c:=3"]):
        plan = str(ROOT / "config/plans/small.yaml")
        monkeypatch.setattr("sys.argv", ["check", plan, "0.5", "30", *more])
        with pytest.raises(SystemExit) as ended:
            cell_checker.main()
        assert ended.value.code == 3 and given.pop() == more
