# SPDX-License-Identifier: Apache-2.0
"""How a node runs as a process."""

import contextlib
import gc
import subprocess
import sys
from types import SimpleNamespace

import pytest
import selfcal_msgs.msg

from selfcal_ros import start
from selfcal_ros.nodes import running
from selfcal_ros.topics import message_texts


@pytest.fixture
def thawed():
    """Give what is frozen back to the collector of garbage; the node freezes it again."""
    gc.unfreeze()


def test_what_a_node_has_loaded_is_not_gone_through_while_it_works(monkeypatch, thawed):
    frozen: list[int] = []
    for name in ("complete_on_signal", "_init"):
        monkeypatch.setattr(running, name, lambda argument: None)
    monkeypatch.setattr(running, "ignore_signals", lambda: None)
    monkeypatch.setattr(running, "rclpy", SimpleNamespace(try_shutdown=lambda: None))
    monkeypatch.setattr(
        running, "spin", lambda node, until: frozen.append(gc.get_freeze_count())
    )
    made: list[list] = []

    def make():
        made.append([[] for _ in range(1000)])
        return SimpleNamespace(destroy_node=lambda: None)

    assert running.run(make) == 0
    assert frozen[0] > 1000
    assert not any(found is made[0] for found in gc.get_objects())


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        (
            "ROS_DOMAIN_ID",
            "999",
            "ROS_DOMAIN_ID: '999' is not a ROS domain; give a num",
        ),
        ("ROS_DOMAIN_ID", "a", "ROS_DOMAIN_ID: 'a' is not a ROS domain; give a number"),
        ("ROS_LOG_DIR", "/proc/x", "variables HOME and ROS_* of the environment: fai"),
        ("ROS_STATIC_PEERS", "///", "variables HOME and ROS_* of the environment: err"),
    ],
)
def test_an_environment_that_ros_refuses_is_one_line(
    ros_environment, name, value, said
):
    done = subprocess.run(
        [sys.executable, "-m", "selfcal_ros.nodes.compensator"],
        env=ros_environment | {name: value},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith(f"selfcal: {said}")
    assert "Traceback" not in done.stderr


HANGING = """
import os, signal, time
from rclpy.task import Future
from selfcal_ros.nodes import running
running.ENDS_S = 0.5
running.complete_on_signal(Future())
def hang():
    os.kill(os.getpid(), signal.SIGTERM)
    while True:
        time.sleep(0.01)
hang()
"""


def test_a_node_that_hangs_when_it_is_to_end_is_ended_and_says_where():
    done = subprocess.run(
        [sys.executable, "-c", HANGING], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert "Timeout" in done.stderr
    assert " in hang" in done.stderr


LEAVING = """
import ctypes, time
from selfcal_ros.nodes import running
running.LEAVES_S = 0.2
with running.ended_at_the_latest(3):
    pass
time.sleep(0.5)
with running.ended_at_the_latest(CODE):
    ctypes.PyDLL(None).sleep(60)  # holds the lock of the interpreter
raise SystemExit(4)
"""


@pytest.mark.parametrize("code", [0, 5])
def test_a_middleware_that_hangs_when_the_work_is_done_does_not_change_the_code(code):
    done = subprocess.run(
        [sys.executable, "-c", LEAVING.replace("CODE", str(code))],
        check=False,
        timeout=50,
        capture_output=True,
    )
    assert (done.returncode, done.stderr) == (code, b"")


@pytest.fixture
def runs_alone(monkeypatch):
    """Let `running.run` run a node of its own, without ROS and signals."""
    for name in ("complete_on_signal", "_init", "spin"):
        monkeypatch.setattr(running, name, lambda *_: None)
    monkeypatch.setattr(running, "ignore_signals", lambda: None)
    monkeypatch.setattr(running, "rclpy", SimpleNamespace(try_shutdown=lambda: None))


@pytest.mark.usefixtures("runs_alone")
def test_only_leaving_the_graph_has_a_limit(monkeypatch):
    """The work at the end, as of images that wait, may take longer."""
    limited: list[str] = []

    @contextlib.contextmanager
    def limit(code):
        limited.append(f"begin {code}")
        yield
        limited.append("end")

    monkeypatch.setattr(running, "ended_at_the_latest", limit)
    node = SimpleNamespace(
        close=lambda: limited.append("work"),
        destroy_node=lambda: limited.append("leave"),
    )
    assert running.run(lambda: node) == 0
    assert limited == ["work", "begin 0", "leave", "end"]


@pytest.mark.usefixtures("runs_alone")
def test_a_crash_is_told_and_has_its_code_before_the_middleware_ends(
    monkeypatch, capsys
):
    codes: list[int] = []
    monkeypatch.setattr(
        running,
        "ended_at_the_latest",
        lambda code: contextlib.nullcontext(codes.append(code)),
    )

    def crash():
        raise RuntimeError("no such thing")

    assert running.run(crash) == 1
    assert codes == [1]
    assert "RuntimeError: no such thing" in capsys.readouterr().err


def test_messages_that_were_built_before_a_field_was_added_are_one_line(
    monkeypatch, capsys
):
    """Else each service call ended with an AttributeError."""
    assert start.missing_ros() == ""
    fields = selfcal_msgs.msg.ViewCommand.get_fields_and_field_types()
    older = {name: kind for name, kind in fields.items() if name != "plan_keys"}
    monkeypatch.setattr(
        selfcal_msgs.msg,
        "ViewCommand",
        SimpleNamespace(get_fields_and_field_types=lambda: older),
    )
    monkeypatch.setattr(start, "hold_interrupts", lambda held: None)
    with pytest.raises(SystemExit) as ended:
        start.begin_node()
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(
        "selfcal: environment: the selfcal_msgs in this environment is of another version: its "
        "ViewCommand has no plan_keys; build it again: run `make setup`, or in the workspace "
        "`colcon build --base-paths src/"
    )
    monkeypatch.delattr(selfcal_msgs.msg, "ViewCommand")
    assert "its ViewCommand has no header" in start.missing_ros()


def test_the_fields_of_a_message_are_those_that_are_built():
    for name, text in message_texts().items():
        assert start.fields_of(text) == [
            *getattr(selfcal_msgs.msg, name).get_fields_and_field_types()
        ]
