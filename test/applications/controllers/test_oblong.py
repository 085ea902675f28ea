# SPDX-License-Identifier: Apache-2.0
"""Tables of fields that are wider than deep, with numbers worked out by hand."""

import re
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.controllers import planes
from selfcal_ros.applications.controllers.export import FORMATS, loaded
from selfcal_ros.applications.controllers.grid import Grid, Source, Wiring, filled
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.compensation.residual import bends_between, combined
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map

WIDE, DEEP = Artifact(5, 0.01, 0, 3), Artifact(3, 0.01, 0, 5)
MM = MachineFrame(1, 2)


def numbered(plate: Artifact):
    """Return the map of (i + 1) and 100 (j + 1) tenths of a um at node i, j."""
    i, j = np.indices(plate.shape)
    return replace(random_map(plate, 1), gx=1e-7 * (i + 1.0), gy=1e-5 * (j + 1.0))


@pytest.mark.parametrize("plate", [WIDE, DEEP])
def test_kmotion_has_a_line_for_each_row_and_column(plate):
    lines = FORMATS["kmotion"].write(numbered(plate), Wiring(MM))[""]
    nx, ny = plate.shape
    assert lines[0] == f"{ny},{nx}" and lines[1] == "10,10"
    assert len(lines) == 3 + nx * ny
    for line in lines[3:]:
        row, column, x, y, _ = map(float, line.split(","))
        assert x == pytest.approx(
            10 * (column - nx // 2) + 1e-4 * (column + 1), abs=1e-8
        )
        assert y == pytest.approx(10 * (row - ny // 2) + 1e-2 * (row + 1), abs=1e-8)


@pytest.mark.parametrize("integers", [False, True])
@pytest.mark.parametrize("plate", [WIDE, DEEP])
def test_beckhoff_has_the_second_master_first(plate, integers):
    files = FORMATS["beckhoff"].write(numbered(plate), Wiring(MM, integers=integers))
    for name, value in (("x", lambda i, j: i + 1), ("y", lambda i, j: 100 * (j + 1))):
        entries = [
            re.fullmatch(
                r"kw\.crosscomp2\.table\[(\d+)\]\[(\d+)\]\.correction (\S+)", line
            )
            for line in files[name]
            if "table" in line
        ]
        found = {(int(m[2]), int(m[1])): float(m[3]) for m in entries}
        assert set(found) == set(np.ndindex(plate.shape))
        assert all(
            v == pytest.approx(value(i, j), abs=1e-4) for (i, j), v in found.items()
        )
        assert all(m[3].isdigit() for m in entries) == integers


@pytest.mark.parametrize(
    ("shape", "points"),
    [((101, 103), 10_403), ((103, 101), 10_403), ((103, 99), None), ((99, 103), None)],
)
def test_beckhoff_is_told_of_the_points_of_an_oblong_field(shape, points):
    emap = random_map(Artifact(shape[0], 1e-3, 0, shape[1]), 1, gain=0.01)
    for lines in FORMATS["beckhoff"].write(emap, Wiring(MM)).values():
        assert [int(line.split()[1]) for line in lines if "max_points" in line] == (
            [points] if points else []
        )


def beckhoff(last1, last2, entries=()):
    return Source(
        "\n".join(
            [
                "kopf.achs_nr 1",
                *(
                    f"kw.crosscomp2.{key} {value}"
                    for key, value in {
                        "interval": 10,
                        "last_index_master1": last1,
                        "last_index_master2": last2,
                        "start_position_master1": 0,
                        "start_position_master2": 0,
                        "unit": 1,
                        "master1_ax_nr": 1,
                        "master2_ax_nr": 2,
                    }.items()
                ),
                *(
                    f"kw.crosscomp2.table[{j}][{i}].correction {value}"
                    for i, j, value in entries
                ),
            ]
        ),
        "file",
    )


@pytest.mark.parametrize(
    ("last1", "last2", "size"),
    [(-1, 2, "0 x 3"), (2, -1, "3 x 0"), (4, 2, "5 x 3"), (2, 4, "3 x 5")],
)
def test_beckhoff_s_reader_has_bounds_for_both_masters(monkeypatch, last1, last2, size):
    monkeypatch.setattr(planes, "MAX_ENTRIES", 14)
    with pytest.raises(
        InputError, match=f"^file: interval 10, unit 1, {size} points, masters"
    ):
        loaded("beckhoff", [beckhoff(last1, last2)] * 2, Wiring(MM))


@pytest.mark.parametrize("shape", [(5, 2), (2, 5)])
def test_beckhoff_s_reader_takes_as_many_points_as_it_may(monkeypatch, shape):
    monkeypatch.setattr(planes, "MAX_ENTRIES", 10)
    source = beckhoff(
        shape[0] - 1, shape[1] - 1, [(i, j, 10 * i + j) for i, j in np.ndindex(shape)]
    )
    other = Source(source.text.replace("achs_nr 1", "achs_nr 2"), "other")
    cx, cy = loaded("beckhoff", [source, other], Wiring(MM))(
        np.array([0.0, 1e-3, 1.0]), np.array([0.0, 1e-3, 1.0])
    )
    last = 10 * (shape[0] - 1) + shape[1] - 1
    np.testing.assert_allclose(cx, [0, 11e-4, last * 1e-4], atol=1e-12)
    np.testing.assert_array_equal(cx, cy)


@pytest.mark.parametrize(
    ("head", "entries", "message"),
    [
        ("0.2", "1 2", "2 entries for 0.2; 2 belong to it"),
        ("2.0", "1 2", "2 entries for 2.0; 2 belong to it"),
        ("1.2", "1 2 3", "3 entries for 1.2; 5 belong to it"),
    ],
)
def test_pmac_s_reader_names_rows_and_columns(head, entries, message):
    text = f"DEFINE COMP {head},#1D,#2D,#1,900,900\n{entries}"
    with pytest.raises(InputError, match=f"^file:1: {message}"):
        loaded("pmac", [Source(text, "file")], Wiring(MM, (1.0, 1.0)))


@pytest.mark.parametrize("spans", ["0,900", "900,0"])
def test_pmac_s_reader_needs_two_spans(spans):
    with pytest.raises(InputError, match=r"^file:1: 3 entries for 1\.1; 3 belong"):
        loaded(
            "pmac",
            [Source(f"DEFINE COMP 1.1,#1D,#2D,#1,{spans}\n1 2 3", "file")],
            Wiring(MM, (1.0, 1.0)),
        )


def geo(rows, columns, entries):
    return Source(
        "\n".join(
            [
                f"{rows},{columns}",
                "1,1",
                "0,0",
                *(f"{row},{column},{column},{row},0" for row, column in entries),
            ]
        ),
        "file",
    )


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (3, 2)])
def test_kmotion_s_reader_has_bounds_for_rows_and_columns(rows, columns):
    places = list(np.ndindex(rows, columns))
    cx, _ = loaded("kmotion", [geo(rows, columns, places)], Wiring(MM))(
        np.array([1.0]), np.array([1.0])
    )
    assert cx == 0
    for place in ((rows, 0), (0, columns)):
        with pytest.raises(
            InputError, match=f"row {place[0]}, column {place[1]} is not in the"
        ):
            loaded("kmotion", [geo(rows, columns, [*places[:-1], place])], Wiring(MM))


@pytest.mark.parametrize(("rows", "columns"), [(2, 1), (1, 2), (2, 4001), (4001, 2)])
def test_kmotion_s_reader_has_limits_of_rows_and_of_columns(rows, columns):
    with pytest.raises(InputError, match=f"^file: {rows} rows and {columns} columns"):
        loaded("kmotion", [geo(rows, columns, [])], Wiring(MM))


@pytest.mark.parametrize("shape", [(2, 3), (3, 2)])
def test_entries_have_the_bounds_of_their_own_axis(shape):
    entries = {place: 10.0 * place[0] + place[1] for place in np.ndindex(shape)}
    np.testing.assert_array_equal(
        filled(entries, shape, "file"),
        np.add.outer(10 * np.arange(shape[0]), np.arange(shape[1])),
    )
    del entries[0, 0]
    for beyond in ((shape[0], 0), (0, shape[1])):
        with pytest.raises(
            InputError, match=f"6 entries, not those of {shape[0]} x {shape[1]}"
        ):
            filled(entries | {beyond: 1.0}, shape, "file")


@pytest.mark.parametrize(
    "frame",
    [
        MachineFrame(reverse_x=True),
        MachineFrame(reverse_y=True, home_y_m=0.004),
        MachineFrame(),
    ],
)
def test_a_table_is_combined_in_the_sense_of_its_own_axis(frame):
    """The active table adds 3 um to x and 5 um to y of the controller everywhere."""
    emap = numbered(WIDE)
    found = combined(emap, frame, lambda px, py: (0 * px + 3e-3, 0 * py + 5e-3))
    np.testing.assert_allclose(
        found.gx - emap.gx, -3e-6 if frame.reverse_x else 3e-6, rtol=1e-9
    )
    np.testing.assert_allclose(
        found.gy - emap.gy, -5e-6 if frame.reverse_y else 5e-6, rtol=1e-9
    )


@pytest.mark.parametrize("plate", [WIDE, DEEP])
def test_bends_are_found_in_the_last_cells_of_both_axes(plate):
    """A roof of 2 um in the middle of the last cell of x, then of y; mm."""
    half = [10.0 * h for h in plate.half]
    for axis in range(2):
        first, step, values = [-100.0, -100.0], [200.0, 200.0], np.zeros((2, 2))
        first[axis], step[axis] = half[axis] - 10, 5.0
        values = np.moveaxis(np.outer([0, 2e-3, 0], [1, 1]), 0, axis)
        roof = Grid(tuple(first), tuple(step), values, "hold")
        bent = bends_between(
            numbered(plate), MM, lambda px, py, r=roof: (r.at(px, py), 0 * px)
        )
        assert bent == pytest.approx(2e-6, rel=1e-9)


@pytest.mark.parametrize("axes", [(1, 2), (7, 4)])
def test_pmac_defines_the_higher_motor_first(axes):
    """The tables are stored downwards from the last motor."""
    lines = FORMATS["pmac"].write(
        numbered(WIDE), Wiring(MachineFrame(*axes), (1e4, 1e4))
    )[""]
    assert [line for line in lines if re.fullmatch(r"#\d", line)] == [
        f"#{axis}" for axis in sorted(axes, reverse=True)
    ]


def test_beckhoff_names_the_slave_of_each_list():
    files = FORMATS["beckhoff"].write(numbered(WIDE), Wiring(MachineFrame(5, 3)))
    assert files["x"][:2] == ["kopf.achs_nr 5", "kopf.log_achs_name X"]
    assert files["y"][:2] == ["kopf.achs_nr 3", "kopf.log_achs_name Y"]
