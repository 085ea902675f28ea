# SPDX-License-Identifier: Apache-2.0
"""A plate whose marks are a list, with the verbs that follow a calibration."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.files import read_json
from test.support.details import simulated_details
from test.support.mark_lists import scatter
from test.support.verbs import two_and_a_view

MARKS = scatter(90).marks
VIEWS = [
    {"name": "0", "repeats": 2},
    {"name": "90", "rotation_deg": 90, "repeats": 2},
    {"name": "37", "rotation_deg": 37, "translation_mm": [6.5, -3.2], "angular": False},
    {"name": "shifted", "translation_mm": [9, 4], "repeats": 2},
    {"name": "line", "rotation_deg": 45, "grid": False},
]
MACHINE = {
    "seed": 5,
    "truth": {"correlation": 4, "phi": 1e-4},
    "noise": {"sigma_xy": 2e-8, "sigma_theta": 1e-6},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two calibrations of one machine and plate, their results, and a view on another day."""
    folder = tmp_path_factory.mktemp("list")
    (folder / "marks.csv").write_text(
        "id,x,y\n"
        + "".join(
            f"{mark},{x!r},{y!r}\n"
            for mark, x, y in zip(MARKS.ids, MARKS.x_m, MARKS.y_m, strict=True)
        )
    )
    plan = {
        "plan_id": "list",
        "artifact": {"marks": "marks.csv", "angular_count": 8},
        "map": {"grid_size": 5},
        "views": VIEWS,
    }
    return two_and_a_view(folder, plan, (38, 39, 12), **MACHINE)


def test_plates_are_compared_and_maps_combined(said):
    found = json.loads(said("diff", "--artifact", "one.json", "two.json", "--json"))
    assert found["significance_xy"]["dof"] == 2 * 90 - 4 and not found["significant"]
    said("combine", "one.json", "two.json", "-o", "mean.json")
    both, one = (
        np.array(read_json(f"{name}.json")["error_map"]["u_gx"])
        for name in ("mean", "one")
    )
    assert np.nanmean(both / one) == pytest.approx(1.0, abs=0.35)


def test_the_stage_is_rechecked_with_one_view_of_the_list(said):
    assert said("recheck", "one.json", "again", "-o", "now.json").startswith(
        "Still good: "
    )
    found = read_json("now.json")["recheck"]
    assert found["p"] > 0.01 and found["detectable"]["smooth"] < found["u_rms"]
    assert 4 < found["detectable"]["one_node"] / found["u_rms"] < 8


def test_two_marks_are_named_by_their_ids_as_the_reference(said):
    pair = [
        MARKS.ids[np.argmin(sign * (np.array(MARKS.x_m) + MARKS.y_m))]
        for sign in (1, -1)
    ]
    places = dict(zip(MARKS.ids, zip(MARKS.x_m, MARKS.y_m, strict=True), strict=True))
    length = math.dist(*(places[mark] for mark in pair)) * (1 + 5e-6)
    said(
        "solve",
        "one",
        "--reference",
        f"marks:{pair[0]}:{pair[1]}:{length!r}:2e-8",
        "-o",
        "r.json",
    )
    plate = read_json("r.json")
    ids, found = plate["artifact"]["marks"]["id"], plate["artifact_map"]
    (x1, y1), (x2, y2) = (
        (
            places[mark][0] + np.ravel(found["ax"])[ids.index(mark)],
            places[mark][1] + np.ravel(found["ay"])[ids.index(mark)],
        )
        for mark in pair
    )
    assert math.hypot(x2 - x1, y2 - y1) == pytest.approx(length, abs=1e-15)
    assert "not ID:ID:LENGTH:U; write e.g. 17:42:0.1" in said(
        "solve", "one", "--reference", "marks:1:x:0.1:1e-8", code=2
    )


def test_its_map_is_exported_drawn_and_certified_as_any_other(said):
    for words in (
        ["table", "one.json", "-o", "map.csv"],
        ["plot", "one.json", "-o", "map.svg"],
        ["export", "kmotion", "one.json", "-o", "k.txt"],
        ["report", "one.json", "-o", "r.html"],
        ["cal", "export", "one.json", "-o", "a.cal"],
        ["iso230", "one"],
        ["certificate", "one.json", simulated_details(Path.cwd()), "-o", "c.xml"],
        ["batch", "one", "two", "-o", "many"],
    ):
        said(*words)
    rows = [line.split(",") for line in Path("map.csv").read_text().split()[1:]]
    want = np.array(read_json("one.json")["error_map"]["gx"]).ravel()
    assert [float(row[4]) for row in rows[:25]] == pytest.approx(
        want.tolist(), rel=1e-12
    )
    assert read_json("many/batch.json")["qualified"] == 2
