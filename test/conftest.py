# SPDX-License-Identifier: Apache-2.0
"""For every test: the same examples in every run, no clock, one thread of linear algebra.

Two workers with two threads each would wait for one another in matrices of a few hundred rows.
The number is set before NumPy is loaded; processes that tests start inherit it.
"""

import gc
import os
import signal
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies

for _libraries in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_libraries, "1")

settings.register_profile(
    "repeatable", deadline=None, derandomize=True, max_examples=50
)
settings.load_profile("repeatable")
# in the background of a shell: children too
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # under nohup
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
gc.disable()  # nothing that is collected goes before the tests do

RARELY = (100_000, 50, 100)
"""Objects and rounds between two looks for garbage: tests leave little in circles."""


@given(strategies.none())
def first_example(nothing: None) -> None:
    """Have Hypothesis ask once, before the freeze, what holds the generators of random numbers.

    Older versions ask the garbage collector, which does not know what is frozen, and warn.
    """


def pytest_collection(session):
    """Let each of several workers begin with modules of its own.

    All of them import all modules; in a fresh clone the one that comes first compiles a module, and
    without this they come at once and each compiles it.
    """
    folders = [Path(arg) for arg in session.config.args if Path(arg).is_dir()]
    if len(folders) < len(session.config.args) or not (turn := worker(session.config)):
        return
    modules = sorted(
        str(path) for folder in folders for path in folder.rglob("test_*.py")
    )
    first = len(modules) * turn[0] // turn[1]
    session.config.args[:] = modules[first:] + modules[:first]


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Bring the tests of all workers into one order."""
    if worker(config):
        items.sort(key=lambda item: item.path)


def worker(config: pytest.Config) -> tuple[int, int] | None:
    """Tell which of how many workers of pytest-xdist this process is."""
    told = getattr(config, "workerinput", None)
    return told and (int(told["workerid"].removeprefix("gw")), told["workercount"])


def pytest_collection_finish():
    """Look for garbage again, but no more through modules and tests."""
    first_example()  # collects, or what collecting has left stays
    gc.freeze()
    gc.set_threshold(*RARELY)
    gc.enable()


@pytest.fixture
def jumping_clocks(monkeypatch):
    """Let the clocks of runs on machines jump ahead where they would wait.

    Each jump is seen by all of them: a bag that is resumed does not lie in the future.
    """
    from selfcal_ros.machine.clock import Clock
    from selfcal_ros.units import NS_PER_S

    jumps_ns = []
    now_ns = Clock.now_ns
    monkeypatch.setattr(Clock, "now_ns", lambda self: now_ns(self) + sum(jumps_ns))
    monkeypatch.setattr(
        Clock, "sleep", lambda self, seconds: jumps_ns.append(round(seconds * NS_PER_S))
    )
