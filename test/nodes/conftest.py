# SPDX-License-Identifier: Apache-2.0
"""Every test here gets a ROS domain of its own on loopback; without ROS all of them are skipped."""

import gc
import os
import time
from importlib.util import find_spec
from pathlib import Path

import pytest

from test.support.shared_memory import OLD_S, SHARED, remove_stale

HERE = f"{Path(__file__).parent}{os.sep}"
MISSING = [name for name in ("rclpy", "selfcal_msgs") if find_spec(name) is None]


class ModuleWithoutRos(pytest.Module):
    """A test module that cannot be imported here."""

    def collect(self):
        pytest.skip(f"needs {' and '.join(MISSING)}", allow_module_level=True)


def pytest_pycollect_makemodule(module_path, parent):
    return ModuleWithoutRos.from_parent(parent, path=module_path) if MISSING else None


def pytest_collection_modifyitems(items):
    for item in items:
        if str(item.path).startswith(HERE):
            item.add_marker("ros")
            # the parser that rclpy's type description service loads is older than Python 3.12
            item.add_marker(
                pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning")
            )


@pytest.fixture
def ros_environment(monkeypatch):
    """Yield the environment for processes of this test; this process is in the same domain."""
    from selfcal_ros.cli.replay import domain

    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    with domain() as environment:
        monkeypatch.setenv("ROS_DOMAIN_ID", environment["ROS_DOMAIN_ID"])
        gc.freeze()  # what a thousand tests before this one have left is not gone through
        yield environment
        gc.collect()  # a node that could not be made stays in the graph until then


@pytest.fixture
def graph(ros_environment):
    """Yield an empty ROS graph of this test alone."""
    from test.support.ros import Graph

    graph = Graph(int(ros_environment["ROS_DOMAIN_ID"]))
    yield graph
    graph.close()


@pytest.fixture(scope="session", autouse=True)
def no_stale_segments():
    """Remove the shared memory that killed nodes have left, of this run or an earlier one."""
    remove_stale(SHARED, time.time() - OLD_S)


@pytest.fixture(autouse=not MISSING)
def short_look(monkeypatch):
    """Look for other publishers for a moment only: the graph of a test has only its own."""
    from selfcal_ros.nodes import compensator, player

    monkeypatch.setattr(compensator, "FOUND_S", 0.05)
    monkeypatch.setattr(player, "LOOK_S", 0.05)
    monkeypatch.setattr(player, "FOUND_S", 0.05)


@pytest.fixture
def quick_beat(monkeypatch):
    """Have nodes tell their health at once and often: for tests of what it says, not of when."""
    from selfcal_ros.nodes import base

    monkeypatch.setattr(base, "BEAT_S", 0.05)


@pytest.fixture(scope="session")
def forks():
    """Yield what starts nodes as processes without importing them each time."""
    from test.support.forked import Forks

    forks = Forks()
    yield forks
    forks.close()
