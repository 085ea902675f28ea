# SPDX-License-Identifier: Apache-2.0
"""Micro-Manager's real core with its demo stage; the plate lies where that stage says it is."""

import math

import numpy as np
import pytest

from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.machine.micromanager import MicroManagerMachine
from test.machine.test_measuring import away_from
from test.support.cells import Agreeing, write_cell

pymmcore = pytest.importorskip("pymmcore")
pytest.importorskip("mm_test_adapters")
CONFIG = """Property,Core,Initialize,0
Device,Stage,DemoCamera,DXYStage
Device,Camera,DemoCamera,DCam
Property,Core,Initialize,1
Property,Core,XYStage,Stage
Property,Core,Camera,Camera
"""


class PlateCore:
    """The real core, with a camera that renders the plate at the position of the demo stage."""

    def __init__(self, simulated) -> None:
        self._core, self._simulated = pymmcore.CMMCore(), simulated

    def __getattr__(self, name):
        return getattr(self._core, name)

    def snapImage(self):
        self._core.snapImage()
        x, y = self._core.getXYPosition(self._core.getXYStageDevice())
        self._simulated.move_to((x * 1e-6, y * 1e-6, 0.0))

    def getImage(self):
        return self._simulated.image().pixels


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "demo.cfg"
    path.write_text(CONFIG)
    return str(path)


def test_the_map_is_right_within_its_uncertainty(tmp_path, config):
    cell, simulated = write_cell(tmp_path, camera=True, simulation=(
        "plan: plan.yaml\nseed: 3\ntruth: {g: 2.0e-7, a: 2.0e-7, t: 5.0e-6, phi: 1.0e-3}\n"
        "cell: {servo_sigma: 0.0}\n"))
    machine = MicroManagerMachine(config, core=PlateCore(simulated))
    machine.place = simulated.place
    try:
        Run(read_plan(tmp_path / "plan.yaml"), cell, machine, tmp_path / "bag",
            Agreeing()).measure()
    finally:
        machine.close()
    away, result = away_from(simulated.truth, tmp_path / "bag")
    u = np.concatenate([result.error_map.u_gx.ravel(), result.error_map.u_gy.ravel()])
    assert np.abs(away).max() < 4 * u.max() < 1e-7


def test_position_camera_and_exposure_of_the_demo_devices(config):
    machine = MicroManagerMachine(config, exposure=0.01)
    try:
        machine.move_to((1e-3, -5e-4))
        x, y = machine.position()
        assert math.hypot(x - 1e-3, y + 5e-4) < 2e-8
        pixels = machine.image().pixels
        assert pixels.shape == (512, 512)
        assert pixels.dtype in (np.uint8, np.uint16)
        machine.stop()
    finally:
        machine.close()


def test_a_stage_that_does_not_arrive_in_time_is_stopped(config):
    core = pymmcore.CMMCore()
    machine = MicroManagerMachine(config, speed=1e6, core=core)
    try:
        stopped = []

        class Slow:
            def __getattr__(self, name):
                return getattr(core, name)

            def waitForDevice(self, name):
                core.setTimeoutMs(1)
                core.waitForDevice(name)

            def stop(self, name):
                stopped.append(name)

        machine._core = Slow()
        with pytest.raises(MachineError, match="the move fails"):
            machine.move_to((5e-2, 0.0))
        assert stopped == ["Stage"]
    finally:
        machine._core = core
        machine.close()


@pytest.mark.parametrize(("text", "said"), [
    ("".join(line for line in CONFIG.splitlines(True) if "Stage" not in line), "no XY stage"),
    (CONFIG.replace("DXYStage", "NoStage"), "cannot be loaded")])
def test_a_configuration_that_does_not_do(config, text, said):
    with open(config, "w") as file:
        file.write(text)
    with pytest.raises(MachineError, match=said):
        MicroManagerMachine(config)


def test_an_exposure_that_is_clipped_is_refused(config):
    with pytest.raises(MachineError, match=r"the exposure|fails"):
        MicroManagerMachine(config, exposure=1e5)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(MachineError, match="there is no such file"):
        MicroManagerMachine("none.cfg", folder=str(tmp_path))
