# SPDX-License-Identifier: Apache-2.0
"""1D tables of x and y, and fine 2D ones: right ones pass, wrong ones do not, whatever is left."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.export import (
    AxisCorrection,
    line_table,
    map_line,
    map_orthogonality,
    table_xy,
    without_slope,
)
from selfcal_ros.applications.aerotech.verify import verify_tables
from selfcal_ros.cli.main import main
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from test.support.maps import first_order, random_map, result_of

OTHER = {"x": "y", "y": "x"}
FRAMES = [
    MachineFrame(),
    MachineFrame(2, 1, unit="um", reverse_x=True, home_x_m=0.03, home_y_m=-0.05),
]


def stage(u_m: float = 8e-9) -> ErrorMap:
    """Return a map that depends on x, on y, on both, and is not square."""
    artifact = Artifact(9, 0.01, 0, 7)
    x, y = artifact.x_m, artifact.y_m
    both = (x / 0.04) * (y / 0.03)
    gx = 1e-6 * np.sin(60 * x + 1) + 0.4e-6 * np.cos(80 * y) + 3e-6 * y + 0.3e-6 * both
    gy = (
        1e-6 * np.sin(60 * y + 2)
        + 0.5e-6 * np.sin(90 * x)
        + 3e-6 * x
        + 0.2e-6 * both * x / 0.04
    )
    gx, gy = gx - gx.mean(), gy - gy.mean()
    turn = (x * gy - y * gx).sum() / (x**2 + y**2).sum()
    gx, gy = gx + turn * y, gy - turn * x
    u = np.full(artifact.shape, u_m)
    return ErrorMap(
        artifact,
        gx,
        gy,
        u,
        u,
        np.zeros(0),
        np.zeros(0),
        nonorthogonality=first_order(artifact, gx, gy)[0],
    )


def accuracy(error_map, frame):
    return [
        line_table(map_line(error_map, axis, axis), frame, along=axis, corrected=axis)
        for axis in "xy"
    ]


def straightness(error_map, frame):
    return [
        line_table(
            without_slope(map_line(error_map, axis, OTHER[axis])),
            frame,
            along=axis,
            corrected=OTHER[axis],
        )
        for axis in "xy"
    ]


def square(error_map, frame):
    return [
        line_table(map_orthogonality(error_map, "x"), frame, along="x", corrected="y")
    ]


def means(error_map, frame):
    """Return the tables that leave the least of all 1D tables."""
    tables = []
    for along in "xy":
        for corrected, field in (("x", error_map.gx), ("y", error_map.gy)):
            nodes = map_line(error_map, along, corrected).positions_m
            line = AxisCorrection(nodes, field.mean(axis=1 if along == "x" else 0))
            tables.append(line_table(line, frame, along=along, corrected=corrected))
    return tables


def everything(error_map, frame):
    return [
        table
        for write in (accuracy, straightness, square)
        for table in write(error_map, frame)
    ]


def with_a_wrong_entry(table):
    values = table.values.copy()
    values[len(values) // 3] += 0.3 * np.ptp(values)
    return replace(table, values=values)


def unfit(error_map, tables, frame):
    return [
        part.name
        for part in verify_tables(error_map, tables, frame).one_axis.parts
        if part.unfit
    ]


WRITERS = [accuracy, straightness, square, means, everything]


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("write", WRITERS)
def test_tables_of_a_map_pass(write, frame):
    error_map = stage()
    found = verify_tables(error_map, write(error_map, frame), frame)
    assert not any(part.unfit for part in found.one_axis.parts) and not found.worse


@pytest.mark.parametrize(
    "spoil",
    [
        lambda table: replace(table, values=table.values / 1000),
        lambda table: replace(table, values=table.values * 0),
        lambda table: replace(table, negcor=True),
        lambda table: replace(table, offset=table.offset + table.sample_dist / 2),
        with_a_wrong_entry,
    ],
    ids=["unit", "zero", "sign", "offset", "entry"],
)
@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("write", WRITERS)
def test_spoilt_tables_do_not_pass(write, frame, spoil):
    error_map = stage()
    tables = write(error_map, frame)
    for number, table in enumerate(tables):
        spoilt = [*tables[:number], spoil(table), *tables[number + 1 :]]
        assert unfit(error_map, spoilt, frame)


def test_the_part_that_no_table_corrects_is_stated_alone():
    """The best 1D tables leave it, to the digits of the tables and the shift by the zero bias."""
    error_map, frame = stage(), FRAMES[0]
    found = verify_tables(error_map, means(error_map, frame), frame)
    assert found.one_axis.beyond == pytest.approx(found.sites.rms("after"), rel=1e-3)
    assert found.one_axis.beyond > 0.1e-6 and not found.one_axis.squareness_left


def test_straightness_says_that_it_leaves_the_squareness():
    error_map, frame = stage(), FRAMES[0]
    fit = verify_tables(error_map, straightness(error_map, frame), frame).one_axis
    assert fit.squareness_left == pytest.approx(
        2 * error_map.nonorthogonality, rel=1e-9
    )


def test_a_table_of_x_alone_is_not_blamed_for_y():
    error_map, frame = stage(), FRAMES[0]
    assert unfit(error_map, accuracy(error_map, frame)[:1], frame) == []


def test_a_wrong_entry_between_the_nodes_does_not_pass():
    error_map, frame = stage(), FRAMES[0]
    line = map_line(error_map, "x", "x")
    nodes = np.linspace(line.positions_m[0], line.positions_m[-1], 17)
    dense = AxisCorrection(
        nodes, np.interp(nodes, line.positions_m, line.corrections_m)
    )
    table = line_table(dense, frame, along="x", corrected="x")
    assert unfit(error_map, [table], frame) == []
    values = table.values.copy()
    values[7] += 1.0
    assert unfit(error_map, [replace(table, values=values)], frame) == [
        "x from the position of x"
    ]


@pytest.mark.parametrize("frame", FRAMES)
@pytest.mark.parametrize("entry", [(3, 3), (3, 4), (4, 3)])
def test_a_wrong_entry_of_a_fine_2d_table_does_not_pass(frame, entry):
    """Between the sites, in the middle of a cell and on its edges; a right one passes."""
    error_map = stage()
    table = table_xy(error_map, frame)
    values = table.values
    for axis in (0, 1):
        fine = np.arange(2 * values.shape[axis] - 1) / 2
        values = np.apply_along_axis(
            lambda line, fine=fine: np.interp(fine, np.arange(len(line)), line),
            axis,
            values,
        )
    table = replace(
        table,
        values=values,
        sample_row=table.sample_row / 2,
        sample_col=table.sample_col / 2,
    )
    assert verify_tables(error_map, [table], frame).unfit(error_map) == []
    values = values.copy()
    values[entry] += 1.0
    found = verify_tables(error_map, [replace(table, values=values)], frame)
    assert [residual.place for residual in found.unfit(error_map)] == ["entries"]


def test_what_is_within_u_of_the_map_is_not_blamed():
    error_map, frame = stage(u_m=2e-6), FRAMES[0]
    assert (
        unfit(
            error_map,
            [
                replace(table, values=table.values / 1000)
                for table in accuracy(error_map, frame)
            ],
            frame,
        )
        == []
    )


def test_gaps_of_a_map_do_not_matter():
    error_map, frame = stage(), FRAMES[0]
    tables = accuracy(error_map, frame)
    gx, gy = error_map.gx.copy(), error_map.gy.copy()
    gx[1, 1] = gy[1, 1] = np.nan
    assert unfit(replace(error_map, gx=gx, gy=gy), tables, frame) == []


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return a folder with a result and its tables of accuracy, x.cal and y.cal."""
    monkeypatch.chdir(tmp_path)
    write_json("r.json", result_to_dict(result_of(stage())))
    for axis in "xy":
        assert (
            main(
                [
                    "cal",
                    "accuracy",
                    "r.json",
                    "--along",
                    axis,
                    "-o",
                    f"{axis}.cal",
                    "--steep",
                ]
            )
            == 0
        )
    return tmp_path


def test_the_command_ends_with_5_and_names_the_part(folder, capsys):
    capsys.readouterr()
    assert main(["cal", "verify", "r.json", "x.cal", "y.cal"]) == 0
    out, err = capsys.readouterr()
    assert "no 1D table of these axes corrects" in out and err == ""
    text = (folder / "x.cal").read_text()
    assert text.count("PRIMARY/1000") == 1
    (folder / "bad.cal").write_text(text.replace("PRIMARY/1000", "PRIMARY/1000000"))
    assert main(["cal", "verify", "r.json", "bad.cal", "y.cal"]) == 5
    out, err = capsys.readouterr()
    assert err.startswith(
        "selfcal cal verify: bad.cal, y.cal: of x from the position of x, which "
        "1D tables can correct, the tables leave "
    )
    assert "y from the position of y," not in err and err.count("\n") == 1


def test_tables_of_a_middle_line_unlike_the_field_are_named_as_such(folder, capsys):
    """White errors: what is right on one line is wrong on all others."""
    write_json(
        "white.json", result_to_dict(result_of(random_map(Artifact(9, 0.01), 4)))
    )
    assert main(["cal", "accuracy", "white.json", "-o", "white.cal", "--steep"]) == 0
    capsys.readouterr()
    assert main(["cal", "verify", "white.json", "white.cal"]) == 2
    assert "the middle line better and the field worse" in capsys.readouterr().err
