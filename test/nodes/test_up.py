# SPDX-License-Identifier: Apache-2.0
"""`selfcal up`, `monitor`, `call`: a whole calibration, nodes that die, nothing left behind."""

import contextlib
import io
import json
import os
import queue
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from selfcal_ros.cli import processes as supervising
from selfcal_ros.cli import up as up_verb
from selfcal_ros.cli.main import build_parser
from selfcal_ros.cli.main import main as selfcal
from selfcal_ros.cli.processes import MOST_RESTARTS, Supervisor
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.nodes import monitor_session
from test.support.sessions import plan_file, small_plan
from test.support.waiting import PATIENCE_S, wait_until

SELFCAL = "import sys; from selfcal_ros.cli.main import main; sys.exit(main())"


class Screen:
    """A command of `selfcal` whose lines are read and whose words are written."""

    def __init__(self, environment: dict, *words: str, before: str = "") -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", before + SELFCAL, *words],
            env=environment,
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,
        )
        self.lines: list[str] = []
        self._queue: queue.Queue = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in self.process.stdout:
            self._queue.put(line.rstrip("\n"))

    def write(self, word: str) -> None:
        self.process.stdin.write(f"{word}\n")
        self.process.stdin.flush()

    def until_all(self, *texts: str) -> list[str]:
        """Return the next lines that hold the texts, which come in any order."""
        begin = len(self.lines)
        for text in texts:
            if not any(text in line for line in self.lines[begin:]):
                self.until(text)
        return [
            next(line for line in self.lines[begin:] if text in line) for text in texts
        ]

    def until(self, text: str) -> str:
        """Return the next line that holds `text`."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            left = deadline - time.monotonic()
            assert left > 0, f"waited in vain for {text!r} in {self.lines}"
            with contextlib.suppress(queue.Empty):
                self.lines.append(self._queue.get(timeout=left))
                if text in self.lines[-1]:
                    return self.lines[-1]

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.communicate()


@pytest.fixture
def start(ros_environment):
    screens = []

    def run(*words: str, before: str = "") -> Screen:
        screens.append(Screen(ros_environment, *words, before=before))
        return screens[-1]

    yield run
    for screen in screens:
        screen.close()


def processes_of(session: int) -> list[str]:
    """Return the processes of a session, each as its id and its arguments."""
    return subprocess.run(
        ["ps", "-ww", "-o", "pid=,args=", "-s", str(session)],
        text=True,
        capture_output=True,
        check=False,
    ).stdout.splitlines()


def pid_of(session: int, node: str) -> int:
    """Return the process of a session that runs a node."""
    for line in processes_of(session):
        pid, _, command = line.strip().partition(" ")
        if f"selfcal_ros.nodes.{node}" in command:
            return int(pid)
    raise AssertionError(f"no {node}")


LINES_FIRST = """
plan_id: lines_first
artifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 8}
views:
  - {name: line, rotation_deg: 45, grid: false, repeats: 2}
  - {name: identity, repeats: 2}
  - {name: rot90, rotation_deg: 90, repeats: 2}
  - {name: shift, translation_pitch: [1, 0], repeats: 2}
"""
VIEWS = ("line", "identity", "rot90", "shift")


def no_error_in(said: str) -> bool:
    """Tell whether nothing went wrong in what a command said."""
    # on a busy machine the compensator rightly says that it skipped samples
    said = re.sub(r"\d+ samples skipped since the last status: [^;\n]*", "", said)
    return not re.search("ERROR|FATAL|Traceback|Error:|stalls|lost", said)


def test_two_calibrations_by_words_the_other_past_the_death_of_two_nodes(
    start, tmp_path
):
    (tmp_path / "plan.yaml").write_text(LINES_FIRST)
    up = start(
        "up",
        "--plan",
        str(tmp_path / "plan.yaml"),
        "--simulate",
        "--compensate",
        "--results",
        str(tmp_path),
        "--bag",
        str(tmp_path / "bag"),
    )
    up.until("now: Press s to start the plan.")
    up.write("start")
    for view in VIEWS:
        up.until(f"PLACE {view}")  # the log is there
        up.write("confirm")
    up.until_all(
        "now: Done. s starts another run.", "map: Good: error up to ", "saved: "
    )
    assert no_error_in("\n".join(up.lines))
    up.write("start")
    for index, view in enumerate(VIEWS):
        up.until(f"now: Place the plate for view '{view}'")
        if index == 1:  # the sequencer comes back in the view where it was
            os.kill(pid_of(up.process.pid, "pose_sequencer"), signal.SIGKILL)
            up.until("pose_sequencer ended with signal 9: restarted")
            up.until("now: Press s to start the plan.")
            up.write("start")
            assert f"in view '{view}', PLACE" in up.until("resumed run ")
        if index == 2:
            os.kill(pid_of(up.process.pid, "solver"), signal.SIGKILL)
            up.until("solver ended with signal 9: restarted")
        up.write("confirm")
    *_, line = up.until_all(
        "now: Done. s starts another run.", "map: Good: error up to ", "saved: "
    )
    saved = Path(line.removeprefix("saved: "))
    assert saved.parent == tmp_path
    assert re.fullmatch(r"plan_simulated_\d{19}\.json", saved.name)
    assert read_json(saved)["verdict"]["qualified"]
    asked = start("call", "confirm")
    assert asked.process.wait(PATIENCE_S) == 2
    asked.until("confirm: pose_sequencer: confirm_view does not fit while done")
    up.write("quit")
    assert up.process.wait(PATIENCE_S) == 0
    assert no_error_in(up.process.stderr.read())
    with pytest.raises(AssertionError, match="no solver"):
        pid_of(up.process.pid, "solver")


ONE_NODE = """
from selfcal_ros.cli import up
up.commands = lambda args, commands=up.commands: {
    "measurement_collector": commands(args)["measurement_collector"]}
"""


@pytest.mark.parametrize(
    ("ending", "code"),
    [(signal.SIGKILL, -signal.SIGKILL), (signal.SIGTERM, 128 + signal.SIGTERM)],
)
def test_a_command_that_is_ended_takes_its_nodes_along(start, tmp_path, ending, code):
    """Of a kill it knows nothing: each node, and the screen's eyes, end by themselves."""
    up = start(
        "up",
        "--plan",
        plan_file(tmp_path, small_plan()),
        "--journal",
        str(tmp_path / "journals"),
        before=ONE_NODE,
    )
    up.until("pose_sequencer is not running")
    wait_until(
        lambda: len(list((tmp_path / "journals").glob("journal_*/*.mcap"))) == 1,
        "the collector's journal",
    )
    up.process.send_signal(ending)
    assert up.process.wait(PATIENCE_S) == code
    wait_until(lambda: not processes_of(up.process.pid), "all nodes to end")
    assert no_error_in("\n".join(up.lines) + up.process.stderr.read())


def test_a_terminal_that_is_closed_takes_the_command_along(ros_environment):
    keyboard, terminal = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-c", SELFCAL, "monitor"],
        env=ros_environment | {"TERM": "xterm"},
        stdin=terminal,
        stdout=terminal,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    os.close(terminal)
    drawn = b""
    while b"pose_sequencer is not running" not in drawn:
        drawn += os.read(keyboard, 4096)
    os.close(keyboard)
    _, said = process.communicate(timeout=PATIENCE_S)
    assert (process.returncode, said) == (0, "")
    assert not processes_of(process.pid)


@pytest.mark.parametrize(
    ("words", "folder"),
    [
        ([], "state/selfcal/HERE/journals"),
        (["--simulate"], "state/selfcal/HERE/journals_simulated"),
        (["--results", "other"], "state/selfcal/HERE_other/journals"),
        (["--journal", "own"], "own"),
        (["--simulate", "--journal", "own"], "own"),
    ],
)
def test_a_simulated_run_keeps_its_journals_apart(tmp_path, monkeypatch, words, folder):
    """Those of each folder of results, in none that the user works in."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    args = build_parser().parse_args(["up", "--plan", "p.yaml", *words])
    given = up_verb.commands(args)["measurement_collector"]
    here = str(tmp_path).strip("/").replace("/", "_")
    assert given[-2:] == ["-p", f"journal:={tmp_path / folder.replace('HERE', here)}"]


def test_states_without_a_home_are_asked_for(monkeypatch):
    monkeypatch.delenv("XDG_STATE_HOME", raising=False)
    monkeypatch.setenv("HOME", "/home/me")
    assert str(up_verb.state_folder("/data")) == "/home/me/.local/state/selfcal/data"
    monkeypatch.delenv("HOME")
    with pytest.raises(
        InputError,
        match="HOME: is not set, and journals are kept there; set it, or give --journal FOLDER",
    ):
        up_verb.state_folder("/data")


def test_a_parameter_file_may_name_where_the_map_goes(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.yaml").write_text("solver: {ros__parameters: {}}")
    args = build_parser().parse_args(
        ["up", "--plan", "p.yaml", "--params", "cell.yaml"]
    )
    given = up_verb.commands(args)["solver"]
    assert given[:3] == ["--ros-args", "-p", f"save_path:={tmp_path}/p_{{run_id}}.json"]
    # the later one counts
    assert given[3:5] == ["--params-file", str(tmp_path / "cell.yaml")]
    assert given[-2:] == ["-p", f"result_folder:={tmp_path}"]


def test_a_request_without_a_cell_and_an_unknown_one_say_so(graph, monkeypatch, capsys):
    monkeypatch.setattr(monitor_session.sys, "stdin", io.StringIO("go\nstart\n"))
    monkeypatch.setattr(monitor_session, "PATIENCE_S", 0.0)
    graph.add(monitor_session.MonitorSession("", context=graph.context))
    said: list = []

    def answers() -> list[dict]:
        said.extend(map(json.loads, capsys.readouterr().out.splitlines()))
        return [line for line in said if "answer" in line]

    graph.until(lambda: len(answers()) == 2, "the answers")
    assert answers() == [
        {
            "success": False,
            "answer": "go: is unknown; give start, confirm, redo, skip, abort, quit",
        },
        {
            "success": False,
            "answer": "start: pose_sequencer does not answer; is "
            "it running in this namespace and ROS_DOMAIN_ID?",
        },
    ]


@pytest.mark.parametrize(
    "words, line",
    [
        (
            ["--plan", "/no/plan.yaml"],
            "selfcal up: /no/plan.yaml: no such file; check the path",
        ),
        (
            ["--plan", "PLAN", "--bag", "/tmp"],
            "selfcal up: /tmp: exists already; remove it or name another folder",
        ),
        (
            ["--plan", "PLAN", "--results", "/no"],
            "selfcal up: /no: is not a folder; name one that exists",
        ),
    ],
)
def test_bad_input_is_one_line_before_anything_is_started(
    tmp_path, monkeypatch, capsys, words, line
):
    monkeypatch.setattr(supervising, "process", None)  # nothing can be started
    plan = plan_file(tmp_path, small_plan())
    assert selfcal(["up", *[plan if word == "PLAN" else word for word in words]]) == 2
    assert capsys.readouterr() == ("", f"{line}\n")


@pytest.mark.parametrize("name", ["a b", "1x", "/a/2", "ä", "a//b"])
@pytest.mark.parametrize(
    "words", ["up --plan p.yaml", "monitor", "call start", "cell check --plan p.yaml"]
)
def test_a_namespace_that_ros_does_not_know_is_refused(capsys, words, name):
    assert selfcal([*words.split(), "--namespace", name]) == 2
    line = (
        f"--namespace: {name!r} is not a name of ROS; write letters, digits and _, no"
    )
    assert line in capsys.readouterr().err


class Child:
    def __init__(self, code: int | None) -> None:
        self.code, self.stderr = code, iter(())

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        self.code = -15


@pytest.fixture
def dying(monkeypatch):
    """Return a supervisor whose nodes end with the codes that are given, and its clock."""

    def make(codes: list, node: str = "solver"):
        left, clock = list(codes), SimpleNamespace(now=0.0)

        @contextlib.contextmanager
        def process(*_, **__):
            yield Child(left.pop(0) if left else None)

        monkeypatch.setattr(supervising, "process", process)
        return Supervisor({node: []}, {}, lambda: clock.now), clock

    return make


def test_a_node_that_dies_again_and_again_is_given_up(dying):
    supervisor, _ = dying([-9] * (MOST_RESTARTS + 3))
    with supervisor:
        for _ in range(MOST_RESTARTS + 3):
            supervisor.step()
        assert supervisor.log == ["solver ended with signal 9: restarted"] * (
            MOST_RESTARTS
        ) + ["solver ended with signal 9, 6 times within 60 s: not restarted"]


@pytest.mark.parametrize("seconds, kept", [(59.9, False), (60.0, True)])
def test_deaths_of_long_ago_do_not_count(dying, seconds, kept):
    supervisor, clock = dying([1] * (MOST_RESTARTS + 1))
    with supervisor:
        for _ in range(MOST_RESTARTS):
            supervisor.step()
        clock.now = seconds
        supervisor.step()
        assert supervisor.log[-1].endswith(": restarted") is kept


@pytest.mark.parametrize(
    "code, node, line",
    [
        (2, "solver", "solver ended with code 2 and is not restarted"),
        (-9, "bag_recorder", "bag_recorder ended with signal 9 and is not restarted"),
    ],
)
def test_what_would_only_fail_again_is_not_started_again(dying, code, node, line):
    supervisor, _ = dying([code], node)
    with supervisor:
        supervisor.step()
        supervisor.step()
        assert supervisor.log == [line]


def test_marks_are_detected_on_request(tmp_path):
    params = tmp_path / "n.yaml"
    params.write_text("mark_detector: {ros__parameters: {}}")
    for more, there in (([], False), (["--detect"], True)):
        args = build_parser("up").parse_args(
            [
                "up",
                "--plan",
                "p.yaml",
                "--params",
                str(params),
                "--results",
                str(tmp_path),
                *more,
            ]
        )
        nodes = up_verb.commands(args)
        assert ("mark_detector" in nodes) is there
    assert nodes["mark_detector"][1:] == ["--params-file", str(params)]
