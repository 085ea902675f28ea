# SPDX-License-Identifier: Apache-2.0
"""`selfcal detect READINGS.csv`: a table of readings as a bag."""

import csv

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import Kind
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.settings.estimator import read_plan
from test.support.collecting import gathered, scene
from test.support.options import BARE
from test.support.sources import ROOT

PLAN = ROOT / "config/plans/small.yaml"


@pytest.fixture(scope="module")
def cell():
    return scene(read_plan(PLAN), seed=5)


def rows_of(cell):
    """Return the readings of a cell as rows of a table, lines with k, marks with m and n."""
    stamps = np.array([sample.stamp_ns for sample in cell.samples])
    measured_ns = [command.stamp_ns for command in cell.commands if command.phase == 1]
    for d in cell.detections:
        at = cell.samples[np.abs(stamps - d.stamp_ns).argmin()]
        x, y, theta = at.positions
        view = cell.plan.views[np.searchsorted(measured_ns, d.stamp_ns) - 1]
        line = d.kind == Kind.ANGULAR
        yield {
            "view": view.name,
            "x": x,
            "y": y,
            "theta": theta,
            "m": "" if line else d.m,
            "n": "" if line else d.n,
            "k": d.k if line else "",
            "offset_x": d.offset_x,
            "offset_y": d.offset_y,
            "offset_theta": d.offset_theta,
        }


def write(path, rows, columns=None):
    rows = list(rows)
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, columns or list(rows[0]), extrasaction="ignore")
        table.writeheader()
        table.writerows(rows)
    return path


def detect(table, output, *more):
    return main(["detect", str(table), "--plan", str(PLAN), "-o", str(output), *more])


def test_the_map_is_that_of_the_cell_whose_readings_are_in_the_table(
    cell, tmp_path, capsys
):
    table = write(tmp_path / "readings.csv", rows_of(cell))
    assert detect(table, tmp_path / "bag") == 0
    out = str(tmp_path / "R.json")
    assert main(["solve", str(tmp_path / "bag"), "--model", "none", "-o", out]) == 0
    direct = calibrate(gathered(cell.events).collect()[0], BARE).error_map
    found = read_json(out)["error_map"]
    for name in ("gx", "gy", "g_theta"):
        np.testing.assert_allclose(
            np.array(found[name], float), getattr(direct, name), rtol=0, atol=1e-12
        )
    assert f"bag: {len(cell.detections)} readings" in capsys.readouterr().out


def test_the_map_holds_within_u_by_the_defaults(cell, tmp_path):
    """Without ids, columns in another order, a comment, a byte order mark, and empty columns."""
    columns = ["k", "offset_y", "view", "x", "y", "offset_theta", "theta", "offset_x"]
    table = write(tmp_path / "Readings.CSV", rows_of(cell), columns)
    rows = [f"{line},," for line in table.read_text().splitlines()]
    table.write_text("\n".join(["\ufeff# by hand", *rows]))
    assert detect(table, tmp_path / "bag") == 0
    out = str(tmp_path / "R.json")
    assert main(["solve", str(tmp_path / "bag"), "-o", out]) == 0
    emap = read_json(out)["error_map"]
    found, u = (
        np.array([emap[f"{prefix}{axis}"] for axis in ("gx", "gy")], dtype=float)
        for prefix in ("", "u_")
    )
    truth = cell.truth.g
    error = remove_modes(found - truth, datum_modes(cell.plan.artifact, scale=True))
    assert np.mean(np.abs(error) < 2 * u) > 0.85
    assert np.abs(truth).max() > 5 * u.max()


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"m": "1.5"}, "m: '1.5' is not an id; give the whole number of the mark"),
        ({"m": "99999999999"}, "m: '99999999999' is not an id"),
        ({"m": "", "n": "", "k": "-1"}, "k: '-1' is not an id"),
        ({"n": ""}, "neither a mark nor a line; give m and n"),
        ({"k": "3"}, "neither a mark nor a line; give m and n"),
        ({"offset_y": ""}, "offset_y is empty; leave the row out if nothing was read"),
        ({"offset_x": "nan"}, "offset_x: 'nan' is not a number"),
        ({"view": "other"}, "the plan has no view 'other'"),
        ({"x": "1e3"}, "'1e3' is not a position"),
        ({"dx": "1e-6"}, "no column is named 'dx'"),
        ({"time": "noon"}, "'noon' is not a time with its zone"),
    ],
)
def test_a_wrong_cell_is_named_and_no_bag_written(cell, tmp_path, capsys, change, line):
    first, *others = rows_of(cell)
    columns = [*dict.fromkeys([*first, *change])]
    table = write(tmp_path / "r.csv", [first | change, *others], columns)
    assert detect(table, tmp_path / "bag") == 2
    [printed] = capsys.readouterr().err.splitlines()
    assert line in printed and not (tmp_path / "bag").exists()


@pytest.mark.parametrize("cells", [6, 11])
def test_a_row_that_lacks_cells_has_no_offset_of_nought(cell, tmp_path, capsys, cells):
    """The last of its columns would count as 0; one more may come of a decimal comma."""
    table = write(tmp_path / "r.csv", rows_of(cell))
    lines = table.read_text().splitlines()
    row = (lines[2] + ",").split(",")
    table.write_text("\n".join([*lines[:2], ",".join(row[:cells]), *lines[3:]]))
    assert detect(table, tmp_path / "bag") == 2
    [printed] = capsys.readouterr().err.splitlines()
    assert f"r.csv:3: {cells} cells, and the heading names 10" in printed
    assert not (tmp_path / "bag").exists()


def test_cells_below_no_name_are_not_passed_over(cell, tmp_path, capsys):
    table = write(tmp_path / "r.csv", rows_of(cell))
    heading, first, *lines = table.read_text().splitlines()
    rows = [f"{heading},", f"{first},5", *(f"{line}," for line in lines)]
    table.write_text("\n".join(rows))
    assert detect(table, tmp_path / "bag") == 2
    [printed] = capsys.readouterr().err.splitlines()
    assert "r.csv:2: 11 cells, and the heading names 10" in printed


def test_a_column_without_a_name_is_named(cell, tmp_path, capsys):
    """Libraries of tables write the number of each row into one."""
    table = write(tmp_path / "r.csv", rows_of(cell))
    rows = [f",{line}" for line in table.read_text().splitlines()]
    table.write_text("\n".join(rows))
    assert detect(table, tmp_path / "bag") == 2
    [printed] = capsys.readouterr().err.splitlines()
    assert "a column without a name; delete it" in printed


@pytest.mark.parametrize(
    ("missing", "line"),
    [
        ("theta", "a line without the indicated angle; add a column theta"),
        ("offset_x", "one of offset_x and offset_y without the other"),
        ("offset_y", "one of offset_x and offset_y without the other"),
    ],
)
def test_a_column_that_would_count_as_0_is_missed(
    cell, tmp_path, capsys, missing, line
):
    first, *others = rows_of(cell)
    columns = [column for column in first if column != missing]
    table = write(tmp_path / "r.csv", [first, *others], columns)
    assert detect(table, tmp_path / "bag") == 2
    [printed] = capsys.readouterr().err.splitlines()
    assert line in printed and not (tmp_path / "bag").exists()


def test_what_is_of_images_is_refused_beside_a_table(cell, tmp_path, capsys):
    table = write(tmp_path / "r.csv", rows_of(cell))
    assert detect(table, tmp_path / "bag", "--mark-size", "1e-5") == 2
    assert "--mark-size: is of images, and" in capsys.readouterr().err
    assert main(["detect", str(table), "-o", str(tmp_path / "bag")]) == 2
    assert "the plan is missing; give --plan PLAN.yaml" in capsys.readouterr().err
