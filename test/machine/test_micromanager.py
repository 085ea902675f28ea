# SPDX-License-Identifier: Apache-2.0
"""Micro-Manager's real core with its demo stage; the plate lies where that stage says it is."""

import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.machine import MachineError
from selfcal_ros.machine.cell import open_machine, read_cell, with_values
from selfcal_ros.machine.measuring import Run, collector_settings
from selfcal_ros.machine.micromanager import MicroManagerMachine
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support.cells import Agreeing

pymmcore = pytest.importorskip("pymmcore")
pytest.importorskip("mm_test_adapters")
EXAMPLE = Path(__file__).parents[2] / "examples" / "microscope"


@pytest.fixture
def config(tmp_path):
    shutil.copytree(EXAMPLE, tmp_path, dirs_exist_ok=True)
    plan = tmp_path / "plan.yaml"
    plan.write_text(plan.read_text().replace("grid_size: 5", "grid_size: 3"))
    return str(tmp_path / "demo.cfg")


@pytest.mark.usefixtures("jumping_clocks")
def test_the_example_finds_the_map_within_its_uncertainty(tmp_path, config):
    with_values(
        tmp_path / "cell.yaml", "detector", {"pixel_size": 1e-6, "turn": 3.0}, {}
    )
    cell = read_cell(tmp_path / "cell.yaml")
    machine = open_machine(cell)
    try:
        Run(
            read_plan(tmp_path / "plan.yaml"),
            cell,
            machine,
            tmp_path / "bag",
            Agreeing(),
        ).measure()
    finally:
        machine.close()
    away, result = away_from(
        machine.plate.truth, tmp_path / "bag", collector_settings(cell)
    )
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
        with pytest.raises(MachineError, match=r"demo\.cfg: the move: .*timed out"):
            machine.move_to((5e-2, 0.0))
        assert stopped == ["Stage"]
    finally:
        machine._core = core
        machine.close()


@pytest.mark.parametrize(
    ("name", "other", "said"),
    [
        ("Core,XYStage,Stage", "Core,XYStage,", "no XY stage"),
        ("DXYStage", "NoStage", "cannot be loaded"),
    ],
)
def test_a_configuration_that_does_not_do(config, name, other, said):
    path = Path(config)
    path.write_text(path.read_text().replace(name, other))
    with pytest.raises(MachineError, match=said):
        MicroManagerMachine(config)


def test_an_exposure_that_is_clipped_is_refused(config):
    with pytest.raises(MachineError, match=r"demo\.cfg: exposure: "):
        MicroManagerMachine(config, exposure=1e5)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(MachineError, match="there is no such file"):
        MicroManagerMachine("none.cfg", folder=str(tmp_path))
