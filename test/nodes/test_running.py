# SPDX-License-Identifier: Apache-2.0
"""How a node runs as a process."""

import gc
import subprocess
import sys
from types import SimpleNamespace

import pytest

from selfcal_ros.nodes import running


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
    monkeypatch.setattr(running, "spin", lambda node, until: frozen.append(gc.get_freeze_count()))
    made: list[list] = []

    def make():
        made.append([[] for _ in range(1000)])
        return SimpleNamespace(destroy_node=lambda: None)
    assert running.run(make) == 0
    assert frozen[0] > 1000
    assert not any(found is made[0] for found in gc.get_objects())


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
    done = subprocess.run([sys.executable, "-c", HANGING], capture_output=True, text=True,
                          check=False)
    assert done.returncode == 1
    assert "Timeout" in done.stderr
    assert " in hang" in done.stderr
