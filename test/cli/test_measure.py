# SPDX-License-Identifier: Apache-2.0
"""``selfcal measure`` as a user runs it, also if it is killed."""

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from test.support.cells import CELL, PLAN, write_cell

LINES = PLAN.replace("angular_count: 0", "angular_count: 4")


def test_from_the_plate_to_the_report_in_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, machine = write_cell(tmp_path, plan=LINES)
    assert main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--json"]) == 0
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert "view 2 of 3 'rot90'" in err
    assert "9 of 9 marks, 4 of 4 lines" in err
    assert result == json.loads(Path("bag.json").read_text())
    assert Path("bag.html").is_file()
    found = np.array([result["error_map"]["gx"], result["error_map"]["gy"]]).reshape(2, -1)
    true = machine.truth.g.reshape(2, -1)
    x, y = (index.ravel() for index in np.mgrid[-1:2, -1:2])
    columns = np.array([[*(x * 0 + 1), *x * 0], [*x * 0, *(x * 0 + 1)], [*-y, *x], [*x, *y]]).T
    away = (found - true).ravel()
    away -= columns @ np.linalg.lstsq(columns, away, rcond=None)[0]
    assert np.abs(away).max() < 2e-8 < 0.1 * np.ptp(true)


def test_a_run_that_is_killed_is_resumed_to_the_same_map(tmp_path):
    """Killed after several exposures, over and over; each time the same command continues."""
    write_cell(tmp_path, plan=LINES)
    kill = tmp_path / "sitecustomize.py"
    kill.write_text(
        "import os, signal\n"
        "from selfcal_ros.machine import simulated\n"
        "image = simulated.SimulatedMachine.offsets\n"
        "n = [0]\n"
        "def offsets(self):\n"
        "    n[0] += 1\n"
        "    if n[0] == int(os.environ['KILLED_AT']):\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "    return image(self)\n"
        "simulated.SimulatedMachine.offsets = offsets\n")
    run = [sys.executable, "-c", f"exec(open({str(kill)!r}).read()); import sys; "
           "from selfcal_ros.cli.main import main; sys.exit(main(sys.argv[1:]))",
           "measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--resume"]
    codes = []
    for killed_at in [20, 33, 35, 40, 10**9]:
        done = subprocess.run(run, cwd=tmp_path, env=os.environ | {"KILLED_AT": str(killed_at)},
                              check=False, capture_output=True, text=True)
        codes.append(done.returncode)
    assert codes[:4] == [-signal.SIGKILL] * 4, done.stderr
    assert codes[4] == 0, done.stderr
    result = json.loads((tmp_path / "bag.json").read_text())
    assert result["verdict"]["qualified"]
    assert main(["measure", str(tmp_path / "plan.yaml"), str(tmp_path / "cell.yaml"), "-o",
                 str(tmp_path / "whole"), "--yes"]) == 0
    whole = json.loads((tmp_path / "whole.json").read_text())
    for axis in ("gx", "gy"):
        away = np.subtract(result["error_map"][axis], whole["error_map"][axis])
        u = np.hypot(result["error_map"][f"u_{axis}"], whole["error_map"][f"u_{axis}"])
        assert np.abs(away).max() < 4 * u.max()


@pytest.mark.parametrize(("words", "cell", "said"), [
    (["--yes"], CELL.replace("robot", "person"), "--yes, but a person places the plate"),
    ([], CELL, "there is nobody to ask: it is not a terminal; give --yes")])
def test_nobody_who_could_answer(tmp_path, capsys, monkeypatch, words, cell, said):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    write_cell(tmp_path, cell=cell)
    assert main(["measure", str(tmp_path / "plan.yaml"), str(tmp_path / "cell.yaml"), "-o",
                 str(tmp_path / "bag"), *words]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()
