# SPDX-License-Identifier: Apache-2.0
"""Motors and a detector of ophyd's own simulation."""

import sys
import types

import numpy as np
import pytest

from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.machine.ophyd import OphydMachine
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support.cells import QUIET, Agreeing, Jumping, write_cell

pytest.importorskip("ophyd", exc_type=ImportError)
# of its own and its libraries' imports
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture
def devices(monkeypatch):
    """Return a module with two motors; others are put into it."""
    from ophyd.sim import SynAxis

    module = types.ModuleType("beamline")
    # as motors that do not know their unit
    module.x, module.y = SynAxis(name="x", egu=""), SynAxis(name="y", egu="")
    monkeypatch.setitem(sys.modules, "beamline", module)
    return module


def test_an_axis_that_cannot_be_stopped_does_not_keep_the_other_moving(devices):
    def lost():
        raise OSError("not connected")

    stops = []
    devices.x.stop, devices.y.stop = lost, lambda: stops.append("y")
    machine = OphydMachine("beamline:x", "beamline:y")
    with pytest.raises(MachineError, match="x: OSError: not connected"):
        machine.stop()
    assert stops == ["y"]


def test_a_plan_is_measured_to_its_true_map(tmp_path, devices):
    from ophyd import Component, Device
    from ophyd.sim import SynSignal

    cell, simulated = write_cell(tmp_path, camera=True, simulation=QUIET)

    def picture():
        simulated.move_to((devices.x.position / 1e3, devices.y.position / 1e3, 0.0))
        return simulated.image().pixels

    class Detector(Device):
        frame = Component(SynSignal, func=picture)

        def trigger(self):
            return self.frame.trigger()

    devices.camera = Detector(name="camera")
    machine = OphydMachine(
        "beamline:x", "beamline:y", detector="beamline:camera", image="frame"
    )
    machine.place = simulated.place
    Run(
        read_plan(tmp_path / "plan.yaml"),
        cell,
        machine,
        tmp_path / "bag",
        Agreeing(),
        Jumping(),
    ).measure()
    away, result = away_from(simulated.truth, tmp_path / "bag")
    assert result.verdict.qualified
    assert np.abs(away).max() < 5e-8


@pytest.mark.parametrize(
    ("egu", "unit", "named"),
    [
        ("mm", "mm", ""),
        ("Microns", "um", ""),
        ("", "mm", ""),
        ("steps", "mm", ""),
        ("um", "mm", "x: its motor counts in um, stated is mm"),
        ("mm", "um", "x: its motor counts in mm, stated is um"),
        ("degrees", "mm", "x: its motor counts in degrees, stated is mm"),
    ],
)
def test_a_unit_that_the_motors_contradict_is_refused(devices, egu, unit, named):
    """A motor record has its own unit, EGU."""
    devices.x = types.SimpleNamespace(position=0.0, egu=egu)
    if not named:
        OphydMachine("beamline:x", "beamline:y", unit=unit)
        return
    with pytest.raises(MachineError, match=named):
        OphydMachine("beamline:x", "beamline:y", unit=unit)


def test_positions_are_in_the_unit_of_the_motors(devices):
    machine = OphydMachine("beamline:x", "beamline:y", theta="beamline:y", unit="um")
    machine.move_to((1e-3, 2e-3, np.pi))
    assert devices.x.position == pytest.approx(1000.0)
    assert devices.y.position == pytest.approx(180.0)
    assert machine.position()[2] == pytest.approx(np.pi)
    assert machine.image() is None


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"x": "beamline:z"}, "'beamline:z' cannot be had"),
        ({"x": "no_such_lab:x"}, "'no_such_lab:x' cannot be had"),
        ({"unit": "inch"}, "the unit 'inch' is unknown"),
    ],
)
def test_keys_that_cannot_be(devices, keys, said):
    with pytest.raises(MachineError, match=said):
        OphydMachine(**{"x": "beamline:x", "y": "beamline:y"} | keys)


def test_a_motor_that_refuses_stops_all(devices):
    stopped = []

    class Limited(type(devices.x)):
        def set(self, value):
            raise ValueError("beyond the soft limits")

    devices.y = Limited(name="y")
    devices.x.stop = lambda: stopped.append("x")
    machine = OphydMachine("beamline:x", "beamline:y")
    with pytest.raises(MachineError, match="beyond the soft limits"):
        machine.move_to((0.0, 1e-3))
    assert stopped == ["x"]
