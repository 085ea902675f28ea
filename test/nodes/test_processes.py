# SPDX-License-Identifier: Apache-2.0
"""Each node as a process: it starts, a signal ends it with code 0, and nothing stays behind."""

import contextlib
import fcntl
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray

from selfcal_ros.cli import processes
from selfcal_ros.cli.replay import NODES
from selfcal_ros.nodes import names, running
from selfcal_ros.settings.nodes import NODE_PARAMETERS
from test.support.forked import Fork, Forks
from test.support.sessions import plan_file, small_bag, small_plan
from test.support.shared_memory import remove_stale
from test.support.waiting import PATIENCE_S, wait_until

SIMULATED_CELL = Path(__file__).parents[2] / "config/cells/simulated.yaml"
SELFCAL = "import sys; from selfcal_ros.cli.main import main; sys.exit(main())"


class Group:
    """Processes in a session of their own, as a terminal or a launcher would have them."""

    def __init__(self, environment: dict, forks: Forks) -> None:
        self.environment, self.forks = environment, forks
        self.running: list[subprocess.Popen | Fork] = []

    def start(self, *command: str) -> subprocess.Popen:
        process = subprocess.Popen(
            [sys.executable, *command],
            env=self.environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        self.running.append(process)
        return process

    def node(self, name: str, *arguments: str) -> Fork:
        process = self.forks.start(name, ["--ros-args", *arguments], self.environment)
        self.running.append(process)
        return process

    def customize(self, folder: Path, code: str) -> None:
        """Run `code` as every new interpreter starts."""
        (folder / "site").mkdir()
        (folder / "site" / "sitecustomize.py").write_text(code)
        self.environment["PYTHONPATH"] = os.pathsep.join(
            [str(folder / "site"), self.environment.get("PYTHONPATH", "")]
        )

    def close(self) -> None:
        for process in self.running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


@pytest.fixture
def group(ros_environment, forks):
    group = Group(ros_environment, forks)
    yield group
    group.close()


def alive(session: int) -> bool:
    """Return whether any process of a session still runs."""
    try:
        os.killpg(session, 0)
    except ProcessLookupError:
        return False
    return True


def ended(process: subprocess.Popen | Fork) -> tuple[int, str, str]:
    out, err = process.communicate(timeout=PATIENCE_S)
    wait_until(lambda: not alive(process.pid), "the end of its children")
    return process.returncode, out, err


SIGNALS = {
    "measurement_collector": signal.SIGINT,
    "pose_sequencer": signal.SIGTERM,
    "solver": signal.SIGTERM,
    "compensator": signal.SIGINT,
    "mark_detector": signal.SIGTERM,
    "bag_player": signal.SIGTERM,
    "cell_driver": signal.SIGINT,
    "bag_recorder": signal.SIGTERM,
    "stage_simulator": signal.SIGINT,
}
"""One for each node: all of them take both through the same lines; `selfcal up` sends SIGTERM."""


def test_a_signal_ends_every_node_cleanly(graph, group, tmp_path):
    bag, recorded = small_bag(tmp_path), tmp_path / "recorded"
    needed = {
        "bag_player": [
            "-p",
            f"bag:={bag}",
            "-p",
            "rate:=0.001",
            "-p",
            "beside_others:=true",
        ],
        "bag_recorder": ["-p", f"bag:={recorded}"],
        "cell_driver": ["-p", f"cell:={SIMULATED_CELL}"],
        "mark_detector": ["-p", "pixel_size:=2e-6", "-p", "mark_size:=5e-5"],
        "pose_sequencer": ["-p", f"plan:={plan_file(tmp_path, small_plan())}"],
    }
    diagnostics: list = []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 100
    )
    processes = {
        name: group.node(name, *needed.get(name, [])) for name in NODE_PARAMETERS
    }
    graph.until(
        lambda: set(NODE_PARAMETERS) <= set(graph.hand.get_node_names()), "all nodes"
    )
    graph.until(
        lambda: (
            {status.name for m in diagnostics for status in m.status}
            >= set(NODE_PARAMETERS) - {"bag_player"}
        ),
        "their diagnostics",
    )
    for name, process in processes.items():
        process.send_signal(SIGNALS[name])
    for name, process in processes.items():
        code, _, err = ended(process)
        assert code == 0, f"{name}: {err}"
        assert "Traceback" not in err, name
    info = yaml.safe_load((recorded / "metadata.yaml").read_text())
    assert info["rosbag2_bagfile_information"]["version"] == 9


def test_a_signal_that_comes_again_and_again_changes_nothing(graph, group):
    """Ctrl-C reaches a node from the terminal and once more from `ros2 launch`."""
    process = group.node("compensator")
    graph.until(lambda: "compensator" in graph.hand.get_node_names(), "the node")
    deadline = time.monotonic() + PATIENCE_S
    while process.poll() is None:
        assert time.monotonic() < deadline
        process.send_signal(signal.SIGINT)
    code, _, err = ended(process)
    assert code == 0
    assert "Traceback" not in err


def test_a_player_ends_by_itself_when_the_bag_is_played(group, tmp_path):
    code, _, err = ended(
        group.start(
            "-m",
            "selfcal_ros.nodes.bag_player",
            "--ros-args",
            "-p",
            f"bag:={small_bag(tmp_path)}",
            "-p",
            "rate:=0.0",
            "-p",
            "wait_for_subscribers:=0.0",
        )
    )
    assert code == 0
    assert "played" in err


def test_bad_input_is_one_line_and_code_2(group, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text(
        yaml.safe_dump({"compensator": {"ros__parameters": {"joint_tetha": "c"}}})
    )
    not_ros = "arguments after --ros-args: "
    cases = [
        (
            "compensator",
            ["-p", "metod:=joint"],
            "parameters of compensator: metod: compensator has no such parameter",
            "",
        ),
        (
            "pose_sequencer",
            ["-p", "plan:=/no/plan.yaml"],
            "/no/plan.yaml: no such file",
            "",
        ),
        ("bag_player", ["-p", "bag:=/no/bag"], "/no/bag: no such file or folder", ""),
        (
            "compensator",
            ["--params-file", str(file)],
            "joint_tetha: compensator has no such parameter; did you mean 'joint_theta'? known are",
            "",
        ),
        (
            "compensator",
            ["--params-file", "/no/p.yaml"],
            "Couldn't parse params file",
            not_ros,
        ),
        ("compensator", ["--bogus"], "['--bogus']", not_ros),
    ]
    processes = [group.node(node, *words) for node, words, _, _ in cases]
    for process, (_, _, problem, begin) in zip(processes, cases, strict=True):
        code, _, err = ended(process)
        assert code == 2
        [line] = [text for text in err.splitlines() if text.startswith("selfcal: ")]
        assert line.startswith(f"selfcal: {begin}")
        assert problem in line
        assert " at /" not in line
        assert "Traceback" not in err


def test_a_recorder_whose_disk_is_full_ends_with_code_2(graph, group, tmp_path):
    bag = f"bag:={tmp_path / 'recorded'}"
    recorder = group.start(
        "-m", "selfcal_ros.nodes.bag_recorder", "--ros-args", "-p", bag
    )
    diagnostics: list = []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 100
    )
    bag_files: list[Path] = []

    def is_recording() -> bool:
        bag_files[:] = tmp_path.glob("recorded/*.mcap")
        return bool(diagnostics and bag_files)

    graph.until(is_recording, "the recorder and its bag")
    [file] = bag_files
    resource.prlimit(
        recorder.pid,
        resource.RLIMIT_FSIZE,
        (file.stat().st_size, resource.RLIM_INFINITY),
    )
    publisher = graph.publisher(names.ENCODER)
    publisher.publish(names.ENCODER.type(name=["x"], position=[0.25]))
    graph.until(
        lambda: any("recording has ended" in m.status[0].message for m in diagnostics),
        "the end of the recording",
    )
    recorder.send_signal(signal.SIGTERM)
    code, _, err = ended(recorder)
    assert code == 2
    assert err.count("recording has ended") == 1 and "Traceback" not in err


@pytest.mark.parametrize("whole_group", [True, False], ids=["ctrl-c", "kill -INT"])
def test_an_interrupted_replay_leaves_no_process(graph, group, tmp_path, whole_group):
    # and the session: a first and a last child
    bag, nodes = (small_bag(tmp_path), NODES[1:2])
    some = f"from selfcal_ros.cli import replay; replay.NODES = {nodes}; "
    replay = group.start(
        "-c",
        some + SELFCAL,
        "replay",
        str(bag),
        "--rate",
        "0.001",
        "--domain",
        group.environment["ROS_DOMAIN_ID"],
    )
    graph.until(
        lambda: {"bag_player", *nodes} <= set(graph.hand.get_node_names()), "the nodes"
    )
    (os.killpg if whole_group else os.kill)(replay.pid, signal.SIGINT)
    code, _, err = ended(replay)
    assert code == 128 + signal.SIGINT
    assert "selfcal replay: interrupted" in err
    assert "Traceback" not in err


INTERRUPT_WHILE_IMPORTING = """
import signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name in {modules!r}:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder())
from selfcal_ros import start
sys.argv = {argv!r}
sys.exit(start.{command}())
"""


def test_a_signal_while_a_node_is_imported_ends_it_cleanly(group):
    """Again and again: before the first library, between them, and before the last module."""
    code, out, err = ended(
        group.start(
            "-c",
            INTERRUPT_WHILE_IMPORTING.format(
                modules=("numpy", "rclpy", "selfcal_ros.nodes.running"),
                argv=["compensator"],
                command="compensator",
            ),
        )
    )
    assert (code, out, err) == (0, "", "")


SITE = """
import signal, sys

class Finder:
    def find_spec(self, name, *_):
        if name == "diagnostic_msgs.msg":  # by every node, not by the command itself
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder())
"""


def test_a_signal_while_a_node_is_imported_by_its_module_ends_it_cleanly(
    group, tmp_path
):
    group.customize(tmp_path, SITE)
    code, out, err = ended(group.start("-m", "selfcal_ros.nodes.compensator"))
    assert (code, out, err) == (0, "", "")


HIDING = """
import sys
from importlib.machinery import PathFinder

class Finder:
    def find_spec(self, name, *more):
        return None if name == {module!r} else PathFinder.find_spec(name, *more)

sys.meta_path[sys.meta_path.index(PathFinder)] = Finder()
"""


@pytest.mark.parametrize(
    ("module", "remedy"),
    [
        (
            "selfcal_msgs",
            "run `make setup`, or in the workspace `colcon build --base-paths "
            "src/selfcal_ros src/selfcal_ros/msg_defs` and source install/setup.bash",
        ),
        ("threadpoolctl", "`sudo apt install python3-threadpoolctl`, or with pip"),
    ],
)
@pytest.mark.parametrize(
    ("words", "who"),
    [
        (["-m", "selfcal_ros.nodes.solver"], "selfcal"),
        (["-c", "from selfcal_ros import start; start.pose_sequencer()"], "selfcal"),
        (["-m", "selfcal_ros", "monitor"], "selfcal monitor"),
    ],
)
def test_whatever_needs_a_module_that_is_not_there_says_what_brings_it(
    group, tmp_path, module, remedy, words, who
):
    group.customize(tmp_path, HIDING.format(module=module))
    code, out, err = ended(group.start(*words))
    assert (code, out) == (2, "")
    assert (
        err
        == f"{who}: environment: there is no {module} in this environment; {remedy}\n"
    )


@pytest.mark.parametrize(
    "module",
    [
        "argparse",
        "selfcal_ros.cli.solve",
        "selfcal_ros.errors",
        "selfcal_ros.portable",
        "selfcal_ros.topics",
    ],
)
def test_a_signal_while_the_command_is_imported_is_one_line(group, module):
    code, out, err = ended(
        group.start(
            "-c",
            INTERRUPT_WHILE_IMPORTING.format(
                modules=(module,), argv=["selfcal", "solve", "none"], command="selfcal"
            ),
        )
    )
    assert (out, err) == ("", "selfcal: interrupted\n")
    # the interpreter may repeat the signal for its parent: a shell has 130 for both
    assert code in (128 + signal.SIGINT, -signal.SIGINT)


INTERRUPTED_REPLAY = """
import os, signal, sys
from selfcal_ros import start
from selfcal_ros.cli import replay

def play(*args, play=replay._play, **more):
    try:
        return play(*args, **more)
    finally:
        os.kill(os.getpid(), signal.SIGINT)

replay._play = play
replay.NODES = replay.NODES[1:2]
sys.argv = {argv!r}
sys.exit(start.selfcal())
"""


def test_a_replay_interrupted_while_its_nodes_are_imported_is_one_line(group, tmp_path):
    group.customize(tmp_path, SITE)
    argv = ["selfcal", "replay", str(small_bag(tmp_path)), "--rate", "0.001"]
    code, out, err = ended(group.start("-c", INTERRUPTED_REPLAY.format(argv=argv)))
    assert (code, out, err) == (
        128 + signal.SIGINT,
        "",
        "selfcal replay: interrupted\n",
    )


INTERRUPTED_DEMO = (
    INTERRUPT_WHILE_IMPORTING.partition("from selfcal_ros")[0]
    + """
import runpy
runpy.run_path({demo!r}, run_name="__main__")
"""
)


@pytest.mark.parametrize(
    "module, who",
    [("selfcal_ros.bagio.offline", "demo"), ("selfcal_ros.cli.processes", "selfcal")],
)
def test_a_demo_that_is_interrupted_is_one_line(group, module, who):
    code, _, err = ended(
        group.start(
            "-c",
            INTERRUPTED_DEMO.format(
                modules=(module,), demo=str(Path(__file__).parents[2] / "tools/demo.py")
            ),
        )
    )
    assert (code, err) == (128 + signal.SIGINT, f"{who}: interrupted\n")


def test_a_domain_is_no_cells_and_on_this_machine_alone(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET")
    monkeypatch.setenv("ROS_DISCOVERY_SERVER", "10.0.0.1:11811")
    monkeypatch.setenv("ROS_STATIC_PEERS", "10.0.0.2")
    with processes.domain() as first, processes.domain() as second:
        numbers = [int(environment["ROS_DOMAIN_ID"]) for environment in (first, second)]
    assert len(set(numbers)) == 2 and all(50 <= number < 100 for number in numbers)
    assert first["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"
    assert not {"ROS_DISCOVERY_SERVER", "ROS_STATIC_PEERS"} & first.keys()
    with processes.domain(7) as chosen:
        assert chosen["ROS_DOMAIN_ID"] == "7"
        assert chosen["ROS_AUTOMATIC_DISCOVERY_RANGE"] == "LOCALHOST"


def test_a_domain_that_somebody_uses_is_left_to_him():
    with processes.domain() as environment:
        free = int(environment["ROS_DOMAIN_ID"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as participant:
        participant.bind(("", 7400 + 250 * free + 10))
        with processes.domain() as environment:
            assert int(environment["ROS_DOMAIN_ID"]) != free


def test_a_node_without_a_home_says_so(monkeypatch, capsys):
    for name in running.LOG_FOLDERS:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(running, "complete_on_signal", lambda _: None)
    monkeypatch.setattr(running, "ignore_signals", lambda: None)
    assert running.run(lambda: pytest.fail("made"), []) == 2
    assert capsys.readouterr().err == (
        "selfcal: HOME: is not set, and ROS keeps its log there; set it, or ROS_LOG_DIR\n"
    )


def test_shared_memory_of_nodes_that_are_gone_is_removed_and_no_other(tmp_path):
    for name in (
        "fastrtps_1",
        "fastrtps_1_el",
        "fastrtps_port7",
        "fastrtps_port7_el",
        "sem.fastrtps_port7_mutex",
        "fastrtps_2",
        "fastrtps_2_el",
        "other_el",
    ):
        (tmp_path / name).touch()
    with (tmp_path / "fastrtps_2_el").open("rb") as alive:
        fcntl.flock(alive, fcntl.LOCK_EX)
        remove_stale(tmp_path, 0.0)
        assert len(list(tmp_path.iterdir())) == 8
        remove_stale(tmp_path, time.time() + 60.0)
    assert {file.name for file in tmp_path.iterdir()} == {
        "fastrtps_2",
        "fastrtps_2_el",
        "other_el",
    }
