# SPDX-License-Identifier: Apache-2.0
"""``--onto``: the table that replaces an active one, on a machine that reads the text itself."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from test.support.maps import random_map, result_of

PLATE = Artifact(5, 0.01, 0, 7)
G = random_map(PLATE, 8, gain=20.0)


class Table:
    """A .cal file with one 2D table, read by hand: mm, and um for the corrections."""

    def __init__(self, text: str) -> None:
        lines = [line for line in text.splitlines() if line and line[0] not in ";"]
        row, column, *outputs, down, across, width = lines[0].split()[1:]
        offset = {m[1]: float(m[2]) for line in lines
                  if (m := re.fullmatch(r":START2D OFFSET(ROW|COL)=(\S+)", line))}
        assert ":START2D POSUNIT=PRIMARY" in lines and ":START2D CORUNIT=PRIMARY/1000" in lines
        values = np.array([line.split() for line in lines if line[0] != ":"], dtype=float)
        assert values.shape[1] == 2 * int(width)
        self.axes, self.outputs = (int(column), int(row)), tuple(map(int, outputs))
        self.x = float(across) * np.arange(int(width)) - offset["COL"]
        self.y = float(down) * np.arange(len(values)) - offset["ROW"]
        self.values = values.reshape(len(values), -1, 2) * 1e-3

    def at(self, px: float, py: float) -> np.ndarray:
        """Return what is added to the commands of both axes, mm; nothing at home."""
        return self._sum(px, py) - self._sum(0.0, 0.0)

    def _sum(self, px, py):
        hats = [np.interp(p, *(a[::s] for a, s in ((nodes, s), (unit, s))))
                for nodes, p in ((self.y, py), (self.x, px))
                for s in [1 if nodes[1] > nodes[0] else -1]
                for unit in np.eye(len(nodes))]
        down, across = np.array(hats[:len(self.y)]), np.array(hats[len(self.y):])
        return np.einsum("r,c,rck->k", down, across, self.values)


class Machine:
    """A stage with the error G, and a controller whose x and y have these homes and directions."""

    def __init__(self, home=(0.0, 0.0), sign=(1, 1)):
        self.home, self.sign = np.array(home), np.array(sign)
        self.nodes = [half * np.linspace(-1, 1, n) for half, n in ((0.02, 5), (0.03, 7))]

    def error(self, t):
        """Return G at a true position, m; nothing at home, so that tables have no bias there."""
        return self._field(t) - self._field(self.home)

    def _field(self, t):
        hats = [np.array([np.interp(p, nodes, unit) for unit in np.eye(len(nodes))])
                for nodes, p in zip(self.nodes, t, strict=True)]
        return np.array([hats[0] @ g @ hats[1] for g in (G.gx, G.gy)])

    def shown(self, t, table):
        """Return what the controller shows, m in the stage frame, while the stage is at t."""
        encoder = self.sign * (np.array(t) + self.error(t) - self.home) * 1e3
        command = encoder
        for _ in range(8):
            command = encoder - table.at(*command)
        return self.sign * command * 1e-3 + self.home

    def reached(self, t, table, sense=1):
        """Return where the stage goes when t is commanded, m."""
        command = self.sign * (np.array(t) - self.home) * 1e3
        encoder = self.sign * (command + sense * table.at(*command)) * 1e-3 + self.home
        true = encoder
        for _ in range(8):
            true = encoder - self.error(true)
        return true


OLD = """; nodes of its own, some um
:START2D {row} {column} {column} {row} 14 -13 4
:START2D POSUNIT=PRIMARY
:START2D CORUNIT=PRIMARY/1000
:START2D OFFSETROW=31
:START2D OFFSETCOL=-20
 3.1 -2.0  0.4 1.5  -2.6 2.2  1.0 -3.0
-1.2  2.7  2.9 0.3   1.1 -1.8 -2.4 0.9
 0.5 -0.6 -3.0 2.8   2.0  1.4  0.2 -2.2
-2.1  1.9  1.3 -2.5 -0.7  0.8  2.6 1.2
 1.6  0.1 -0.9 3.0   2.3 -1.1 -1.7 2.4
:END
"""


def off(machine, table, sense=1):
    """Return the residuals at the nodes without their common shift, m, (nodes, 2)."""
    nodes = [(x, y) for x in machine.nodes[0] for y in machine.nodes[1]]
    found = np.array([machine.reached(t, table, sense) - t for t in nodes])
    return found - found.mean(axis=0)


@pytest.mark.parametrize(("options", "machine"), [
    ("", Machine()), ("--home-x -10 --home-y 20", Machine((-10e-3, 20e-3))),
    ("--reverse-x", Machine(sign=(-1, 1))),
    ("--reverse-y --home-x 10 --x-axis 3 --y-axis 1", Machine((10e-3, 0), (1, -1)))])
def test_cal_export_replaces_the_active_table(tmp_path, monkeypatch, capsys, options, machine):
    """Noise-free: what is left at the nodes is the rounding of 0.01 nm, of x, y and home."""
    monkeypatch.chdir(tmp_path)
    column, row = (3, 1) if "axis" in options else (1, 2)
    text = OLD.format(row=row, column=column)
    Path("old.cal").write_text(text)
    old, seen = Table(text), np.empty((2, *PLATE.shape))
    for i, x in enumerate(machine.nodes[0]):
        for j, y in enumerate(machine.nodes[1]):
            seen[:, i, j] = machine.shown((x, y), old) - (x, y)
    write_json("R.json", result_to_dict(result_of(replace(G, gx=seen[0], gy=seen[1]))))
    words = f"R.json -o new.cal --onto old.cal {options}".split()
    assert main(["cal", "export", *words]) == 0
    assert "bends between the nodes" in capsys.readouterr().err
    new = Table(Path("new.cal").read_text())
    assert new.axes == new.outputs == (column, row)
    assert np.abs(off(machine, old)).max() > 1e-6  # the stage as it was calibrated
    assert np.abs(off(machine, new)).max() < 2e-11
    assert np.abs(off(machine, new, sense=-1)).max() > 1e-6
    wrong = "--reverse-y" if "--reverse-y" not in options else "--home-y 1"
    assert main(["cal", "export", *words, *wrong.split(), "--force"]) == 0
    assert np.abs(off(machine, Table(Path("new.cal").read_text()))).max() > 1e-7


@pytest.mark.parametrize("verb", [["export", "kmotion"], ["cal", "export"]])
def test_a_table_that_does_not_fit_is_refused_as_such(tmp_path, monkeypatch, capsys, verb):
    """Of KMotion beyond a field of 40 um; of .cal with a wrong unit of corrections."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(random_map(Artifact(5, 0.01), 3))))
    write_json("S.json", result_to_dict(result_of(random_map(Artifact(5, 1e-5), 4, gain=0.5))))
    assert main([*verb, "S.json", "-o", "small", *(["--unit", "mm"] if "kmotion" in verb else [])
                 ]) == 0
    if "cal" in verb:
        text = Path("small").read_text().replace("PRIMARY/1000", "PRIMARY/0.01")
        Path("small").write_text(text.replace("2D 2 1 1 2 0.01 0.01", "2D 2 1 1 2 10 10"))
    capsys.readouterr()
    assert main([*verb, "R.json", "-o", "new", "--onto", "small",
                 *(["--unit", "mm"] if "kmotion" in verb else [])]) == 2
    assert re.fullmatch(
        r"selfcal (cal|export): --onto: the active table changes by up to [\d.e+]+ mm between "
        r"neighbouring sites 10 mm apart; is it that of this stage, in this unit\? beyond its own "
        r"field a table may extrapolate\n", capsys.readouterr().err)
    assert not Path("new").exists()
