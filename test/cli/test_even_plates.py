# SPDX-License-Identifier: Apache-2.0
"""A plate of even sides through all verbs: from the simulated cell to the tables."""

import json
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.files import read_json
from test.support.details import simulated_details
from test.support.verbs import simulate, two_and_a_view

VIEWS = [
    {"name": "0", "repeats": 2},
    {"name": "90", "rotation_deg": 90, "repeats": 2},
    {"name": "180", "rotation_deg": 180, "repeats": 2},
    {"name": "tx", "translation_pitch": [-1, 0], "repeats": 2},
    {"name": "ty", "translation_pitch": [0, 1], "repeats": 2},
    {"name": "line", "rotation_deg": 45, "grid": False},
]
PLATE = {"grid_size": [6, 4], "grid_pitch": 0.01, "angular_count": 8}
PLAN = {"plan_id": "even", "artifact": PLATE, "views": VIEWS}
MACHINE = {"seed": 5, "truth": {"correlation": 4, "phi": 1e-4}}
NOISE = {"sigma_xy": 2e-8, "sigma_theta": 1e-6}
X, Y = np.array([-25, -15, -5, 5, 15, 25]) * 1e-3, np.array([-15, -5, 5, 15]) * 1e-3


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two calibrations of one machine and plate, their results, and a view on another day."""
    return two_and_a_view(
        tmp_path_factory.mktemp("even"), PLAN, (1, 2, 3), noise=NOISE, **MACHINE
    )


def numbers(line):
    return [float(cell) for cell in line.replace(",", " ").split()]


@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
@pytest.mark.parametrize("with_ids", [True, False])
def test_a_bag_without_noise_gives_the_truth(tmp_path, sense, with_ids):
    cell = {
        "with_ids": with_ids,
        "sense": sense,
        "servo_sigma": 0.0,
        "servo_sigma_theta": 0.0,
    }
    simulate(tmp_path, "exact", PLAN, seed=5, cell=cell, truth={"phi": 1e-4})
    on_its_targets = 5  # where all offsets might have the other sign: not qualified
    assert (
        main(
            [
                "solve",
                str(tmp_path / "exact"),
                "--sense",
                sense,
                "--quiet",
                "-o",
                str(tmp_path / "r.json"),
            ]
        )
        == on_its_targets
    )
    found, truth = (
        read_json(tmp_path / name) for name in ("r.json", "exact/truth.json")
    )
    for axis in ("gx", "gy"):
        difference = np.array(found["error_map"][axis]) - np.array(truth[axis])
        assert np.abs(difference).max() < 1e-12
    assert found["artifact"]["grid_size"] == 6 and found["artifact"]["grid_size_y"] == 4


def test_tables_name_the_nodes_by_their_places(said):
    said("table", "one.json", "-o", "map.csv")
    rows = [line.split(",") for line in Path("map.csv").read_text().split()[1:25]]
    assert [[int(cell) for cell in rows[at][:2]] for at in (0, -1)] == [
        [-3, -2],
        [2, 1],
    ]
    places = np.array([[float(cell) for cell in row[2:4]] for row in rows]).reshape(
        6, 4, 2
    )
    np.testing.assert_allclose(places[:, 0, 0], X, atol=1e-17)
    np.testing.assert_allclose(places[0, :, 1], Y, atol=1e-17)
    said("table", "one.json", "-o", "map.npz")
    gx = np.load("map.npz")["gx"]
    assert gx.shape == (6, 4)
    assert [float(row[4]) for row in rows] == pytest.approx(
        gx.ravel().tolist(), rel=1e-12
    )


def test_tables_of_controllers_have_the_nodes_at_their_places(said):
    said("cal", "export", "one.json", "-o", "a.cal")
    lines = Path("a.cal").read_text().splitlines()
    assert ":START2D 2 1 1 2 10 10 6" in lines
    assert {":START2D OFFSETROW=15", ":START2D OFFSETCOL=25"} <= set(lines)
    counts = ["--counts-per-unit", "1=1000", "--counts-per-unit", "2=1000"]
    for kind in ("kmotion", "pmac", "beckhoff", "linuxcnc", "siemens"):
        said(
            "export",
            kind,
            "one.json",
            "-o",
            f"{kind}.txt",
            "--unit",
            "mm",
            "--verify",
            *(counts if kind == "pmac" else ()),
        )
    emap = read_json("one.json")["error_map"]
    gx, gy = np.array(emap["gx"]), np.array(emap["gy"])
    rows = [
        numbers(line)
        for line in Path("kmotion.txt").read_text().splitlines()
        if line and line[0] in "-0123456789"
    ]
    assert rows[:3] == [[4, 6], [10, 10], [-25, -15]]
    for row in (rows[3], rows[-1]):
        j, i = int(row[0]), int(row[1])
        assert row[2:4] == pytest.approx(
            [1e3 * (X[i] + gx[i, j]), 1e3 * (Y[j] + gy[i, j])], abs=1e-8
        )
    assert rows[-1][:2] == [3, 5]
    beckhoff = Path("beckhoff_x.txt").read_text()
    assert "start_position_master1 -250000" in beckhoff  # 0.1 um
    assert "last_index_master1 5" in beckhoff and "last_index_master2 3" in beckhoff
    axis = [
        numbers(line)
        for line in Path("linuxcnc_x.txt").read_text().splitlines()
        if line and line[0] in "-0123456789"
    ]
    assert [row[0] for row in axis] == (1e3 * X).tolist()
    siemens = Path("siemens.txt").read_text()
    assert "$AN_CEC_MIN[0]=-25" in siemens and "$AN_CEC_MAX[0]=25" in siemens


def test_positions_are_corrected_about_the_centre_between_marks(said):
    points = Path("points.csv")
    points.write_text("x,y\n0.025,0.015\n-0.025,-0.015\n0.0,0.0\n")
    said("apply", "one.json", "points.csv", "-o", "commands.csv")
    rows = [numbers(line) for line in Path("commands.csv").read_text().split()[1:]]
    gx = np.array(read_json("one.json")["error_map"]["gx"])
    want = [0.025 + gx[5, 3], -0.025 + gx[0, 0], gx[2:4, 1:3].mean()]
    assert [row[2] for row in rows] == pytest.approx(want, abs=1e-12)


def test_results_are_compared_combined_and_rechecked(said):
    found = json.loads(said("diff", "one.json", "two.json", "--json"))
    assert not found["significant"]
    said("combine", "one.json", "two.json", "-o", "mean.json")
    assert said("recheck", "one.json", "again", "-o", "now.json").startswith(
        "Still good: "
    )


def test_every_other_verb_takes_the_result(said):
    for words in (
        ["plot", "one.json", "-o", "map.svg"],
        ["report", "one.json", "-o", "r.html"],
        ["iso230", "one"],
        ["certificate", "one.json", simulated_details(Path.cwd()), "-o", "c.xml"],
        ["batch", "one", "two", "-o", "many"],
        ["plan", "check", "one_plan.yaml"],
    ):
        said(*words)
    assert read_json("many/batch.json")["qualified"] == 2
    assert "axis x at y = 5 mm, 6 positions from -25 to 25 mm" in said("iso230", "one")
    assert "turned" in said("plan", "suggest", "again_plan.yaml")
