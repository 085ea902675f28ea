# SPDX-License-Identifier: Apache-2.0
"""``selfcal measure`` as a user runs it, also if it is killed."""

import io
import json
import re
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from test.support.cells import CELL, DETECTOR, PLAN, write_cell
from test.support.power_cuts import Cut, detections, measured, outcome, prepare
from test.support.terminals import SELFCAL

pytestmark = pytest.mark.usefixtures("jumping_clocks")
LINES = PLAN.replace("angular_count: 0", "angular_count: 4")


def test_from_the_plate_to_the_report_in_one_command(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    _, machine = write_cell(tmp_path, plan=LINES)
    assert (
        main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--json"]) == 0
    )
    out, err = capsys.readouterr()
    result = json.loads(out)
    assert "view 2 of 3 'rot90'" in err
    assert re.search(r"9 of 9 marks, 4 of 4 lines, noise 0\.\d+ µm", err)
    assert result == json.loads(Path("bag.json").read_text())
    assert Path("bag.html").is_file()
    found = np.array([result["error_map"]["gx"], result["error_map"]["gy"]]).reshape(
        2, -1
    )
    true = machine.truth.g.reshape(2, -1)
    x, y = (index.ravel() for index in np.mgrid[-1:2, -1:2])
    columns = np.array(
        [[*(x * 0 + 1), *x * 0], [*x * 0, *(x * 0 + 1)], [*-y, *x], [*x, *y]]
    ).T
    away = (found - true).ravel()
    away -= columns @ np.linalg.lstsq(columns, away, rcond=None)[0]
    assert np.abs(away).max() < 2e-8 < 0.1 * np.ptp(true)


def test_a_run_that_is_killed_is_resumed_to_the_same_map(tmp_path):
    """Killed in a move, with half of a message written, and before its first file is whole."""
    whole = tmp_path / "whole"
    prepare(whole, marks=3)
    assert measured(whole).returncode == 0
    for number, cut in enumerate(
        [
            Cut("in a move", 50),
            Cut("half of a message written", 150),
            Cut("before a file is on the disk", 1),
        ]
    ):
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


@pytest.mark.parametrize(
    ("words", "cell", "said"),
    [
        (
            ["--yes"],
            CELL.replace("robot", "person"),
            "--yes, but a person places the plate",
        ),
        ([], CELL, "there is nobody to ask: it is not a terminal; give --yes"),
    ],
)
def test_nobody_who_could_answer(tmp_path, capsys, monkeypatch, words, cell, said):
    monkeypatch.setattr("sys.stdin", io.StringIO())
    write_cell(tmp_path, cell=cell)
    assert (
        main(
            [
                "measure",
                str(tmp_path / "plan.yaml"),
                str(tmp_path / "cell.yaml"),
                "-o",
                str(tmp_path / "bag"),
                *words,
            ]
        )
        == 2
    )
    assert said in capsys.readouterr().err
    assert not (tmp_path / "bag").exists()


def test_a_measurement_goes_on_when_nobody_reads_it(tmp_path):
    """As in `selfcal measure ... | head -1`."""
    write_cell(tmp_path)
    command = [*SELFCAL, "measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"]
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as measure:
        measure.stdout.readline()
        measure.stdout.close()
        assert measure.stderr.read() == b""
    assert measure.returncode == 0
    assert json.loads((tmp_path / "bag.json").read_text())["views"][2]["used"]


LEFT_ALONE = """
import os
import signal
import subprocess
from pathlib import Path

from selfcal_ros.machine.simulated import SimulatedMachine


class LeftAlone(SimulatedMachine):
    moves = 0

    def move_to(self, position):
        LeftAlone.moves += 1
        super().move_to(position)
        if LeftAlone.moves == 9:
            os.kill(os.getpid(), signal.SIGNAL)

    def stop(self):
        super().stop()
        Path("stopped.txt").touch()
"""


def write_left_alone(folder, name, module):
    """Write a cell whose stage sends a signal to the command in its ninth move."""
    write_cell(folder)
    (folder / f"{module}.py").write_text(LEFT_ALONE.replace("SIGNAL", name))
    cell = folder / "cell.yaml"
    cell.write_text(
        cell.read_text().replace(
            "machine: simulated\nsimulated:", f"machine: {module}:LeftAlone\nLeftAlone:"
        )
    )


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_stops_the_stage_and_keeps_the_bag(
    tmp_path, monkeypatch, capsys, name
):
    monkeypatch.chdir(tmp_path)
    write_left_alone(tmp_path, name, f"left_alone_{name}")
    with pytest.raises(SystemExit) as ended:
        main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"])
    assert ended.value.code == 128 + signal.Signals[name]
    assert "stopped; bag is kept, --resume continues" in capsys.readouterr().err
    assert Path("stopped.txt").exists()
    assert (
        main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--resume"])
        == 0
    )


def test_results_that_stand_beside_the_bag_are_not_replaced(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    write_cell(tmp_path)
    (tmp_path / "bag.json").write_text("mine")
    assert main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"]) == 2
    assert "bag.json: it exists, and the measurement" in capsys.readouterr().err
    assert (tmp_path / "bag.json").read_text() == "mine"
    assert not (tmp_path / "bag").exists()


def test_a_stop_before_the_first_reading_names_no_bag(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_left_alone(tmp_path, "SIGTERM", "left_at_once")
    module = tmp_path / "left_at_once.py"
    module.write_text(
        module.read_text()
        + """
    def __init__(self, *args, **kwargs):
        raise KeyboardInterrupt
"""
    )
    assert main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"]) == 130
    [line] = capsys.readouterr().err.splitlines()
    assert line == "selfcal measure: stopped; nothing was measured yet"


def test_any_error_of_a_run_says_that_its_bag_is_kept(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_cell(tmp_path, camera=True)
    cell = Path("cell.yaml")
    cell.write_text(cell.read_text().replace(DETECTOR, ""))
    words = ["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"]
    assert main(words) == 2
    assert re.search(
        "how marks are found in them is not stated; .*; bag is kept, --resume continues",
        capsys.readouterr().err,
    )
    assert main(words) == 2
    assert "is kept" not in capsys.readouterr().err  # it is that of another run


def test_under_nohup_a_measurement_outlives_its_terminal(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_left_alone(tmp_path, "SIGHUP", "left_by_nohup")
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        assert main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes"]) == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not Path("stopped.txt").exists()
