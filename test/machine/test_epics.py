# SPDX-License-Identifier: Apache-2.0
"""Motor records of a soft IOC, driven by ophyd's EpicsMotor over Channel Access."""

import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import types
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.machine.ophyd import OphydMachine
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support.cells import FEW, QUIET, Agreeing, write_cell

for library in ("ophyd", "epics", "caproto"):
    pytest.importorskip(library, exc_type=ImportError)
pytestmark = pytest.mark.filterwarnings("ignore")  # of their imports
IOC = """
from caproto.ioc_examples.fake_motor_record import FakeMotor
from caproto.server import PVGroup, SubGroup, run

class Stage(PVGroup):
    x, y = (SubGroup(FakeMotor, velocity=1e3, precision=6, tick_rate_hz=200.0, prefix=name)
            for name in "xy")

run(Stage(prefix="stage:").pvdb, interfaces=["127.0.0.1"])
"""


@pytest.fixture
def ioc(monkeypatch):
    """Run the IOC on a free port of this machine; processes that are started find it."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("EPICS_CA_SERVER_PORT", str(free.getsockname()[1]))
    monkeypatch.setenv("EPICS_CA_ADDR_LIST", "127.0.0.1")
    monkeypatch.setenv("EPICS_CA_AUTO_ADDR_LIST", "NO")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    running = subprocess.Popen([sys.executable, "-c", IOC])
    yield running.pid
    running.kill()
    running.wait()


def stage():
    """Return the machine of the IOC's two motors."""
    from ophyd import EpicsMotor

    beamline = sys.modules["beamline"] = types.ModuleType("beamline")
    beamline.x, beamline.y = (EpicsMotor(f"stage:{name}", name=name) for name in "xy")
    return OphydMachine("beamline:x", "beamline:y")


def measure(folder):
    """Measure a plan; return the largest error of the map."""
    cell, simulated = write_cell(folder, plan=FEW, camera=True, simulation=QUIET)
    machine = stage()

    def image():
        simulated.move_to((*machine.position(), 0.0))
        return simulated.image()

    machine.place, machine.image = simulated.place, image
    Run(
        read_plan(folder / "plan.yaml"), cell, machine, folder / "bag", Agreeing()
    ).measure()
    away, result = away_from(simulated.truth, folder / "bag")
    assert result.verdict.qualified
    return np.abs(away).max()


def said_of_hanging(pid) -> list[str]:
    """Return what is said of position and stop while the IOC hangs."""
    machine = stage()
    machine.move_to((0.001, 0.0))
    os.kill(pid, signal.SIGSTOP)
    said = []
    for act in (machine.position, machine.stop):
        with pytest.raises(MachineError) as error:
            act()
        said.append(str(error.value))
    return said


def in_a_process(function, value):
    """Return what a function returns; the library reads its environment once."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, value).result()


def test_a_plan_is_measured_with_motor_records(ioc, tmp_path):
    assert in_a_process(measure, tmp_path) < 5e-8


def test_an_ioc_that_hangs_has_no_position_and_cannot_be_stopped(ioc):
    """Channel Access notices it after half a minute, and goes on telling the last position."""
    for line in in_a_process(said_of_hanging, ioc):
        assert "Failed to read stage:x.RBV" in line
