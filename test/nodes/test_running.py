# SPDX-License-Identifier: Apache-2.0
"""How a node runs as a process."""

import gc
from types import SimpleNamespace

import pytest

from selfcal_ros.nodes import running


@pytest.fixture
def thawed():
    """Give what a node has frozen back to the collector of garbage."""
    gc.unfreeze()
    yield
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
