# SPDX-License-Identifier: Apache-2.0
"""``selfcal measure`` as a user runs it, also if it is killed."""

import io
import json
import signal
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from test.support.cells import CELL, PLAN, write_cell
from test.support.power_cuts import Cut, detections, measured, outcome, prepare

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
    """Killed in a move, with half of a message written, and before its first file is whole."""
    whole = tmp_path / "whole"
    prepare(whole, marks=3)
    assert measured(whole).returncode == 0
    for number, cut in enumerate([
            Cut("in a move", 50), Cut("half of a message written", 150),
            Cut("before a file is on the disk", 1)]):
        folder = tmp_path / str(number)
        prepare(folder, marks=3)
        assert measured(folder, cut).returncode == -signal.SIGKILL
        kept = detections(folder)
        assert bool(kept) is (cut.number > 1)
        resumed = measured(folder)
        assert resumed.returncode == 0, resumed.stderr
        found = outcome(folder, whole, kept)
        assert (found.lost, found.doubled, found.qualified) == (0, 0, True)
        assert found.away < 4


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
