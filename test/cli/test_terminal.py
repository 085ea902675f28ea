# SPDX-License-Identifier: Apache-2.0
"""Progress: on stderr, on a terminal alone, and gone when the work is done."""

import io
import sys
import threading

import pytest

from selfcal_ros.cli.terminal import busy, late_progress


class Terminal(io.StringIO):
    """A terminal that tells when something has been drawn on it."""

    def __init__(self) -> None:
        super().__init__()
        self.drawn = threading.Event()

    def write(self, text: str) -> int:
        if "solving" in text:
            self.drawn.set()
        return super().write(text)

    def isatty(self) -> bool:
        return True


def on_terminal(monkeypatch) -> Terminal:
    """Let stderr be a terminal; in the test itself, as pytest sets its own after fixtures."""
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stderr", Terminal())
    return sys.stderr


def test_work_that_cannot_tell_how_far_it_is_shows_that_it_goes_on(monkeypatch):
    terminal = on_terminal(monkeypatch)
    with busy("solving", after_s=0.0):
        assert terminal.drawn.wait(60)
    assert terminal.getvalue().endswith("\x1b[2K")  # the line is wiped


def test_short_work_and_work_without_a_terminal_show_nothing(monkeypatch):
    terminal = on_terminal(monkeypatch)
    with busy("solving", after_s=1e6):
        pass
    with late_progress("reading", after_s=1e6) as advance:
        advance(1, 2)
    assert terminal.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    with busy("solving", after_s=0.0), late_progress("reading", after_s=0.0) as advance:
        advance(1, 2)
    assert sys.stderr.getvalue() == ""


def test_an_error_in_the_work_goes_on_and_the_line_is_wiped(monkeypatch):
    terminal = on_terminal(monkeypatch)
    with pytest.raises(ValueError, match="no"), busy("solving", after_s=0.0):
        assert terminal.drawn.wait(60)
        raise ValueError("no")
    assert terminal.getvalue().endswith("\x1b[2K")
