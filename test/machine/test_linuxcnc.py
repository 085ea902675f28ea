# SPDX-License-Identifier: Apache-2.0
"""A real LinuxCNC in simulation, where it is installed, is driven over linuxcncrsh."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.collection.settings.estimator import read_plan
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from test.machine.test_gcode import PLAN, QUIET, WithPlate
from test.machine.test_measuring import away_from
from test.support import linuxcnc
from test.support.cells import CELL, Agreeing, write_cell

pytest.importorskip("serial")


@pytest.mark.skipif(shutil.which("linuxcncrsh") is None, reason="LinuxCNC is not installed")
def test_a_plan_is_measured_by_a_real_linuxcnc(tmp_path):
    """Its numbers are the machine's own, in mm, and it refuses what lies beyond its limits."""
    cell, simulated = write_cell(tmp_path, camera=True, simulation=QUIET, plan=PLAN, cell=CELL)
    with tempfile.TemporaryDirectory() as folder, linuxcnc.running(Path(folder)) as port:
        machine = WithPlate(None, simulated, port=port, dialect="linuxcnc")
        try:
            Run(read_plan(tmp_path / "plan.yaml"), cell, machine, tmp_path / "bag",
                Agreeing()).measure()
            machine.move_to((0.0015, -0.00225))
            assert machine.position() == pytest.approx((0.0015, -0.00225), abs=1e-9)
            with pytest.raises(MachineError, match=r"'set mdi G53 G1 X30.000000 Y0.000000 .* NAK'"):
                machine.move_to((0.03, 0.0))
            assert machine.position() == pytest.approx((0.0015, -0.00225), abs=1e-9)
        finally:
            machine.close()
    away, _ = away_from(simulated.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8
