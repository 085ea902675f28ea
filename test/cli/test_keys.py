# SPDX-License-Identifier: Apache-2.0
"""Keys of `selfcal up` and `monitor` on a terminal, and a terminal that is closed."""

import os
import termios

import pytest

from selfcal_ros.cli import monitor


@pytest.fixture
def terminal(monkeypatch):
    """Yield (keyboard, the function that returns what was pressed) of a terminal of its own."""
    keyboard, own = os.openpty()
    with os.fdopen(own) as stdin:
        monkeypatch.setattr(monitor.sys, "stdin", stdin)
        before = termios.tcgetattr(own)
        with monitor._keys() as pressed:
            yield keyboard, pressed
        if keyboard_is_open(keyboard):
            assert termios.tcgetattr(own) == before
            os.close(keyboard)


def keyboard_is_open(keyboard: int) -> bool:
    try:
        os.fstat(keyboard)
    except OSError:
        return False
    return True


def test_keys_typed_at_once_are_all_taken_and_others_are_none(terminal):
    keyboard, pressed = terminal
    assert pressed() == []
    os.write(keyboard, "scxr\u00e4\x1b[Aka".encode())
    assert pressed() == ["start", "confirm", "redo", "skip", "abort"]
    assert pressed() == []
    os.write(keyboard, b"q")
    assert pressed() == ["quit"]


def test_a_terminal_that_is_closed_ends_the_command(terminal):
    keyboard, pressed = terminal
    os.close(keyboard)
    assert pressed() == ["quit"]
