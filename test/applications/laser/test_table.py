# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.applications.laser.table import (
    RequiredColumns,
    dimension_of,
    read_table,
    table_text,
    write_table,
)
from selfcal_ros.errors import InputError, NoDataError

HEAD = "block,rx_pp,ry_pp,rx_np,ry_np,ex_x,ey_y"
GOOD = "7.0711,7.0712,7.0713,7.0714,0.0001,0.0002"
CONVENTIONAL = RequiredColumns((0.01, 0.01), DIAGONALS[2], False)
NEW = RequiredColumns((0.01, 0.01), DIAGONALS[2], True)


def read(tmp_path, text, columns=NEW):
    path = tmp_path / "d.csv"
    path.write_text(text)
    return read_table(path, columns)


def test_a_table_with_repeats_comments_and_blank_lines(tmp_path):
    text = f"\ufeff# made up\n{HEAD},note\n\n2,{GOOD},a\n1,{GOOD},b\n1,7.1711,7,7,7,,0.0004,c\n"
    data, warnings = read(tmp_path, text)
    assert data.n_blocks == 2 and data.samples_m.shape == (2, 2, 2, 2)
    np.testing.assert_allclose(data.readings_m[0, 0], [7.1211e-3, 7.0711e-3])
    np.testing.assert_array_equal(data.counts[:, :, 0], 2)
    np.testing.assert_allclose(data.linear_mean_m[:, 0], [1e-7, 3e-7])
    assert len(warnings) == 1 and warnings[0].endswith("column 'note' is not used")


def test_lines_may_end_as_on_any_system(tmp_path):
    lines = [HEAD, f"1,{GOOD}", f"2,{GOOD}", ""]
    expected, _ = read(tmp_path, "\n".join(lines))
    for end in ("\r", "\r\n"):
        (tmp_path / "d.csv").write_bytes(end.join(lines).encode())
        found, _ = read_table(tmp_path / "d.csv", NEW)
        np.testing.assert_array_equal(found.readings_m, expected.readings_m)


def test_blocks_may_be_numbered_from_zero(tmp_path):
    data, _ = read(tmp_path, f"{HEAD}\n0,{GOOD}\n1,{GOOD}\n")
    assert data.n_blocks == 2


def test_a_table_that_lacks_a_body_diagonal_is_one_of_three_axes_still(tmp_path):
    names = ",".join(f"r{axis}_{name}" for name in DIAGONALS[3][:3] for axis in "xyz")
    (tmp_path / "d.csv").write_text(f"block,{names}\n1,{','.join('5' * 9)}\n")
    assert dimension_of(tmp_path / "d.csv") == 3


@pytest.mark.parametrize("steps", [(0.01, 0.01), (0.01, 0.02, 0.005)])
def test_writing_and_reading_gives_the_same_measurement(tmp_path, steps):
    rng = np.random.default_rng(2)
    data = simulate_step_diagonal(
        random_machine(steps, 4, rng),
        Measurement({}, LaserNoise(1e-8, 0, 1e-8, 2)),
        rng,
    )
    path = tmp_path / "out.csv"
    write_table(path, data, ["two repeats"])
    assert dimension_of(path) == len(steps)
    back, warnings = read_table(
        path, RequiredColumns(steps, DIAGONALS[len(steps)], True)
    )
    np.testing.assert_allclose(back.samples_m, data.samples_m, atol=0.6e-11)
    np.testing.assert_allclose(back.linear_m, data.linear_m, atol=0.6e-11)
    assert not warnings


def test_a_repeat_of_some_blocks_only_is_written_as_such():
    samples = np.full((2, 2, 2, 2), 7e-3)
    samples[1, :, :, 1] = np.nan
    text = table_text(StepDiagonal((0.01, 0.01), DIAGONALS[2], samples))
    assert [line.split(",")[0] for line in text.splitlines()] == [
        "block",
        "1",
        "2",
        "1",
    ]


@pytest.mark.parametrize(
    "repeats", [(3, 2, 1, 1), (2, 3, 2, 4), (1, 1, 1, 2), (2, 1, 3, 1)]
)
def test_diagonals_and_axes_of_unequal_repeats_lose_nothing(tmp_path, repeats):
    rng = np.random.default_rng(3)
    samples = 7.07e-3 + rng.normal(0, 1e-8, (max(repeats[:2]), 2, 2, 3))
    linear = rng.normal(0, 1e-8, (max(repeats[2:]), 2, 3))
    for index in range(2):
        samples[repeats[index] :, index] = np.nan
        linear[repeats[2 + index] :, index] = np.nan
    path = tmp_path / "out.csv"
    write_table(path, StepDiagonal((0.01, 0.01), DIAGONALS[2], samples, linear))
    back, _ = read_table(path, RequiredColumns((0.01, 0.01), DIAGONALS[2], True))
    rows = max(repeats)
    for got, want in ((back.samples_m, samples), (back.linear_m, linear)):
        assert got.shape[0] == rows
        np.testing.assert_allclose(got[: len(want)], want, atol=0.6e-11)
        assert np.isnan(got[len(want) :]).all()


ROW = f"1,{GOOD}\n"
HOSTILE = {
    "empty": ("", NoDataError, "the table is empty"),
    "header only": (HEAD + "\n", NoDataError, "the table has a header only"),
    "missing block": (
        f"{HEAD}\n1,{GOOD}\n3,{GOOD}\n",
        InputError,
        "block 2 is missing",
    ),
    "missing block from zero": (
        f"{HEAD}\n0,{GOOD}\n2,{GOOD}\n",
        InputError,
        "block 1 is missing; measure every block from 0 to 2",
    ),
    "first block missing": (f"{HEAD}\n2,{GOOD}\n", InputError, "block 1 is missing"),
    "nan": (
        HEAD + "\n1,nan,7,7,7,0,0\n",
        InputError,
        "d.csv:2: rx_pp: 'nan' is not a finite",
    ),
    "inf": (
        HEAD + "\n1,7,inf,7,7,0,0\n",
        InputError,
        "d.csv:2: ry_pp: 'inf' is not a finite",
    ),
    "text": (
        HEAD + "\n1,7,7,seven,7,0,0\n",
        InputError,
        "d.csv:2: rx_np: 'seven' is not a num",
    ),
    "underscore": (
        HEAD + "\n1,7_0,7,7,7,0,0\n",
        InputError,
        "rx_pp: '7_0' is not a number",
    ),
    "empty cell": (
        HEAD + "\n1,7,7,,7,0,0\n",
        InputError,
        "d.csv:2: rx_np: the cell is empty",
    ),
    "empty cell of a repeat": (
        f"{HEAD}\n{ROW}1,7,7,,7,0,0\n",
        InputError,
        "d.csv:3: rx_np: the cell is empty",
    ),
    "diagonal never read": (
        f"{HEAD}\n{ROW}2,7,7,,,0,0\n2,7,7,,,0,0\n",
        InputError,
        "d.csv:3: rx_np: the cell is empty",
    ),
    "micrometres": (
        HEAD + "\n1,7071.1,7,7,7,0,0\n",
        InputError,
        "rx_pp: 7071.1 where 7.07107 mm is nominal: it looks like micrometres",
    ),
    "mixed units": (
        f"{HEAD}\n{ROW}2,7,0.0070711,7,7,0,0\n",
        InputError,
        "d.csv:3: ry_pp: 0.0070711 where 7.07107 mm is nominal: it looks like metres",
    ),
    "nanometres": (
        HEAD + "\n1,7071100,7,7,7,0,0\n",
        InputError,
        "looks like nanometres",
    ),
    "inches": (HEAD + "\n1,0.2784,7,7,7,0,0\n", InputError, "looks like inches"),
    "sign of np": (
        HEAD + "\n1,7,7,-7,7,0,0\n",
        InputError,
        "rx_np: -7 where 7.07107 mm is nominal: the sign is wrong; readings are",
    ),
    "zero": (
        HEAD + "\n1,0,7,7,7,0,0\n",
        InputError,
        "rx_pp: 0 where 7.07107 mm is nominal; check",
    ),
    "other step": (
        HEAD + "\n1,14.1,7,7,7,0,0\n",
        InputError,
        "check the unit and --step-x",
    ),
    "linear in um": (
        HEAD + "\n1,7,7,7,7,0.9,0\n",
        InputError,
        "ex_x: a linear error of 0.9 mm in a step of 10 mm; it looks like micromet",
    ),
    "linear is the step": (
        HEAD + "\n1,7,7,7,7,10.0001,0\n",
        InputError,
        "it looks like the step itself",
    ),
    "linear nan": (
        HEAD + "\n1,7,7,7,7,nan,0\n",
        InputError,
        "ex_x: 'nan' is not a finite",
    ),
    "linear never given": (
        HEAD + "\n1,7,7,7,7,,0\n",
        InputError,
        "linear errors: a block has no value",
    ),
    "short line": (
        HEAD + "\n1,7,7,7\n",
        InputError,
        "d.csv:2: 4 cells where the header has 7",
    ),
    "block 1.5": (
        HEAD + "\n1.5,7,7,7,7,0,0\n",
        InputError,
        "'1.5' is not a block number",
    ),
    "negative block": (
        HEAD + "\n-1,7,7,7,7,0,0\n",
        InputError,
        "'-1' is not a block number",
    ),
    "huge block": (
        HEAD + "\n1000000,7,7,7,7,0,0\n",
        InputError,
        "is not a block number",
    ),
    "twice": (
        "block,rx_pp,rx_pp\n1,7,7\n",
        InputError,
        "the column 'rx_pp' appears twice",
    ),
    "no block": (
        "rx_pp,ry_pp,rx_np,ry_np\n7,7,7,7\n",
        InputError,
        "column 'block' is missing",
    ),
    "one diagonal": (
        "block,rx_pp,ry_pp,ex_x,ey_y\n1,7,7,0,0\n",
        InputError,
        "d.csv:1: no readings of the diagonal np; measure every diagonal",
    ),
    "one column": (
        "block,rx_pp,ry_pp,rx_np,ex_x,ey_y\n1,7,7,7,0,0\n",
        InputError,
        "the column 'ry_np' is missing",
    ),
    "no linear": (
        "block,rx_pp,ry_pp,rx_np,ry_np\n1,7,7,7,7\n",
        InputError,
        "the column 'ex_x', 'ey_y' is missing; the new formulation needs the linear",
    ),
    "one linear": (
        "block,rx_pp,ry_pp,rx_np,ry_np,ex_x\n1,7,7,7,7,0\n",
        InputError,
        "the column 'ey_y' is missing",
    ),
    "long cell": (
        f"{HEAD}\n{'1' * 140_000},7\n",
        InputError,
        "d.csv:2: not a line of a table (field larger than field limit (131072)); correct the line",
    ),
    "semicolons": ("block;rx_pp\n1;7,07\n", InputError, "separated by semicolons"),
}


@pytest.mark.parametrize("fault", HOSTILE)
def test_a_fault_is_named_in_one_line(tmp_path, fault):
    text, kind, message = HOSTILE[fault]
    with pytest.raises(kind) as caught:
        read(tmp_path, text)
    assert message in str(caught.value) and "\n" not in str(caught.value)
    assert kind is NoDataError or not isinstance(caught.value, NoDataError)


def test_the_conventional_method_needs_no_linear_errors(tmp_path):
    data, _ = read(tmp_path, "block,rx_pp,ry_pp,rx_np,ry_np\n1,7,7,7,7\n", CONVENTIONAL)
    assert data.linear_m is None


def test_a_block_without_a_reading_is_refused():
    with pytest.raises(InputError, match="a block has no reading"):
        StepDiagonal((0.01, 0.01), ("pp",), np.full((1, 1, 2, 1), np.nan))
