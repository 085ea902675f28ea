# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.applications.aerotech import write
from selfcal_ros.applications.aerotech.model import (
    Severity,
    Table1D,
    Table2D,
    same_table,
)
from selfcal_ros.applications.aerotech.read import parse_cal
from selfcal_ros.applications.aerotech.write import cal_text, write_cals
from selfcal_ros.compensation.export import decimal
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import write_together
from test.support.cal_tables import tables_1d, tables_2d, tables_galvo
from test.support.disks import files_no_larger_than

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)


@given(
    tables=st.lists(tables_1d(), min_size=1, max_size=3)
    | st.lists(tables_2d(), min_size=1, max_size=2)
    | st.lists(tables_galvo(), min_size=1, max_size=1)
)
def test_read_write_read_keeps_the_meaning_in_strict_form(tables):
    first = parse_cal(cal_text(tables, comments=["from a test"]).encode(), "f")
    assert first.of(Severity.ERROR) == first.of(Severity.TOLERATED) == []
    assert first.comments == ("from a test",)
    again = parse_cal(cal_text(first.tables, comments=first.comments).encode(), "f")
    for a, b, c in zip(tables, first.tables, again.tables, strict=True):
        assert same_table(a, b) and same_table(b, c)


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_decimals_read_back_exactly_and_have_no_exponent(value):
    assert float(decimal(value)) == value and "e" not in decimal(value)


def test_a_given_number_of_decimals_rounds_and_has_no_minus_zero():
    text = cal_text(
        [Table1D(1, 0.1, np.array([0.0, -1e-9, 1.0 / 3, -0.000005]))], decimals=5
    )
    assert text == (
        ":START 1\n:START SAMPLEDIST=0.1\n0.00000\n0.00000\n0.33333\n-0.00001\n:END\n"
    )


def test_comments_cannot_break_out_of_their_line():
    text = cal_text([Table1D(1, 1.0, np.zeros(1))], comments=["a\n:END\r\0b", ""])
    assert text.startswith("; a :END  b\n;\n:START 1\n")


@pytest.mark.parametrize(
    ("tables", "what"),
    [
        ([], "it has no tables"),
        ([Table1D(0, 1.0, np.zeros(2))], "axis 0 is not in 1..32"),
        ([Table1D(1, 0.0, np.zeros(2))], "sample dist is zero"),
        ([Table1D(1, 1.0, np.zeros(2))] * 9, "more than 8 tables correct axis 1"),
        (
            [
                Table1D(1, 1.0, np.zeros(2)),
                Table2D(2, 1, (1, 2), 1.0, 1.0, np.zeros((3, 3, 2))),
            ],
            "a 2D table in a file of 1D tables",
        ),
    ],
)
def test_tables_that_break_a_rule_are_not_written(tables, what):
    with pytest.raises(InputError, match=what):
        cal_text(tables)


def test_values_that_are_not_finite_are_not_written():
    with pytest.raises(InputError, match="values that are not finite"):
        cal_text([Table1D(1, 1.0, np.array([0.0, np.nan]))])


PLAIN = Table1D(1, 1.0, np.zeros(3))
PLANE = Table2D(2, 1, (1, 2), 1.0, 1.0, np.zeros((3, 3, 2)))


@pytest.mark.parametrize("serial", ["CW", "CCW", "", "it's; 1", " a "])
def test_a_serial_number_is_always_quoted(serial):
    cal = parse_cal(cal_text([replace(PLAIN, serial_number=serial)]).encode(), "f")
    assert cal.tables[0].serial_number == serial and not cal.findings


@pytest.mark.parametrize(
    ("table", "what"),
    [
        (replace(PLAIN, serial_number='a"b'), "unknown keyword"),
        (replace(PLAIN, serial_number="a\nb"), "a stray quote in the serial number"),
        (replace(PLAIN, offset=float("nan")), "OFFSET: 'nan' is not a number"),
        (replace(PLAIN, sample_dist=float("inf")), "SAMPLEDIST: 'inf' is not a number"),
        (
            replace(PLAIN, home_direction="cw"),
            "table 1 holds what the format cannot say",
        ),
        (
            replace(PLAIN, values=np.zeros((2, 2))),
            "table 1 holds what the format cannot say",
        ),
        (replace(PLAIN, values=np.zeros(0)), "the table has no correction values"),
        (
            replace(PLANE, galvo=True, offset_row=1.0),
            "table 1 holds what the format cannot say",
        ),
        (replace(PLANE, output_axes=(1, 2, 3)), "6 values on the line"),
    ],
)
@pytest.mark.parametrize("decimals", [None, 5])
def test_what_would_read_back_differently_is_not_written(table, what, decimals):
    with pytest.raises(InputError) as caught:
        cal_text([table], decimals=decimals)
    assert str(caught.value).startswith("calibration file") and what in str(
        caught.value
    )


def write_cal(path, text, **kwargs):
    return write_cals({path: text}, **kwargs)[path]


def test_an_existing_file_stays_unless_forced_and_then_as_a_dated_backup(tmp_path):
    path = tmp_path / "f.cal"
    assert write_cal(path, "old\n") is None
    with pytest.raises(
        InputError, match="the file exists; name another file, or replace it"
    ):
        write_cal(path, "new\n")
    assert path.read_text() == "old\n"
    first = write_cal(path, "new\n", force=True, now=WHEN)
    second = write_cal(path, "newer\n", force=True, now=WHEN)
    assert first.name == "f.cal.2026-01-02T030405Z.bak" and first.read_text() == "old\n"
    assert (
        second.name == "f.cal.2026-01-02T030405Z-2.bak"
        and second.read_text() == "new\n"
    )
    assert path.read_text() == "newer\n" and len(list(tmp_path.iterdir())) == 3


def test_of_two_files_on_a_full_disk_none_is_replaced(tmp_path):
    x, y = tmp_path / "x.cal", tmp_path / "y.cal"
    write_cals({x: "old x\n", y: "old y\n"})
    with (
        files_no_larger_than(1000),
        pytest.raises(InputError, match=r"y.cal: cannot be written"),
    ):
        write_cals({x: "new x\n", y: "y" * 2000}, force=True)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {
        "x.cal": "old x\n",
        "y.cal": "old y\n",
    }


@pytest.mark.parametrize("force", [False, True])
def test_what_another_command_writes_meanwhile_stays(tmp_path, monkeypatch, force):
    """A new file, and the copy of the old one that both replace."""
    path, backup = tmp_path / "f.cal", tmp_path / "f.cal.2026-01-02T030405Z.bak"
    if force:
        path.write_text("old\n")
    theirs = backup if force else path

    def written_meanwhile(contents):
        theirs.write_text("theirs\n")
        write_together(contents)

    monkeypatch.setattr(write, "write_together", written_meanwhile)
    with pytest.raises(InputError, match="was written by another command meanwhile"):
        write_cal(path, "new\n", force=force, now=WHEN)
    kept = {path.name: "old\n"} if force else {}
    assert {one.name: one.read_text() for one in tmp_path.iterdir()} == {
        **kept,
        theirs.name: "theirs\n",
    }


def test_an_empty_file_has_nothing_to_lose(tmp_path):
    path = tmp_path / "f.cal"
    path.touch()
    assert write_cal(path, "new\n") is None
    assert [one.read_text() for one in tmp_path.iterdir()] == ["new\n"]


def test_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        write_cal(tmp_path, "x", force=True)
    with pytest.raises(InputError, match="cannot be written"):
        write_cal(tmp_path / "none" / "f.cal", "x")
