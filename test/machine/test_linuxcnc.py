# SPDX-License-Identifier: Apache-2.0
"""A real LinuxCNC in simulation, where it is installed, is driven over linuxcncrsh."""

import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.controllers.export import export
from selfcal_ros.applications.controllers.grid import Wiring
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.settings.estimator import read_plan
from test.machine.test_measuring import away_from
from test.support import linuxcnc
from test.support.cells import CELL, FEW, QUIET, Agreeing, WithPlate, write_cell
from test.support.maps import random_map, result_of
from test.support.waiting import wait_until

pytest.importorskip("serial")


@pytest.mark.skipif(
    shutil.which("linuxcncrsh") is None, reason="LinuxCNC is not installed"
)
def test_a_real_linuxcnc_measures_a_plan_and_loads_the_tables(tmp_path):
    """Its numbers are the machine's own, in mm; what lies beyond its limits it refuses.

    Its motors go to the true position and the error of the map there, but for that at its zero.
    """
    cell, simulated = write_cell(
        tmp_path, camera=True, simulation=QUIET, plan=FEW, cell=CELL
    )
    emap = random_map(Artifact(5, 0.005, 0, 5), 1)
    emap = replace(emap, gx=emap.gx[:, :1] + 0 * emap.gx, gy=emap.gy[:1] + 0 * emap.gy)
    with tempfile.TemporaryDirectory() as folder:
        for name, text in export(
            "linuxcnc", result_of(emap), Wiring(MachineFrame()), "comp.txt"
        ).files.items():
            Path(folder, name).write_text(text)
        with linuxcnc.running(Path(folder)) as port:
            machine = WithPlate(simulated, port=port, dialect="linuxcnc")
            try:
                Run(
                    read_plan(tmp_path / "plan.yaml"),
                    cell,
                    machine,
                    tmp_path / "bag",
                    Agreeing(),
                ).measure()
                check_limits(machine)
                check_tables(machine, emap)
            finally:
                machine.close()
    away, _ = away_from(simulated.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8


def check_limits(machine):
    machine.move_to((0.0015, -0.00225))
    assert machine.position() == pytest.approx((0.0015, -0.00225), abs=1e-9)
    with pytest.raises(
        MachineError, match=r"'set mdi G53 G1 X30.000000 Y0.000000 .* NAK'"
    ):
        machine.move_to((0.03, 0.0))
    assert machine.position() == pytest.approx((0.0015, -0.00225), abs=1e-9)


def check_tables(machine, emap):
    for i, x in enumerate((-0.01, -0.005, 0.0, 0.005, 0.01)):
        j, y = 4 - i, -x
        machine.move_to((x, y))
        wanted = (
            1e3 * (x + emap.gx[i, 0] - emap.gx[2, 0]),
            1e3 * (y + emap.gy[0, j] - emap.gy[0, 2]),
        )
        wait_until(
            lambda wanted=wanted: linuxcnc.motors() == pytest.approx(wanted, abs=1e-7),
            f"motors at {wanted} mm",
        )
