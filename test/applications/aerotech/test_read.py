# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.aerotech.model import Severity, TableKind, Unit, UnitWord
from selfcal_ros.applications.aerotech.read import load_cal, parse_cal, read_cal
from selfcal_ros.errors import InputError

STRICT_1D = """\
; accuracy of the first axis
:START 1 POSUNIT=PRIMARY CORUNIT=PRIMARY/1000
:START SAMPLEDIST=10 OFFSET=10 SERIALNUMBER="12;3'4"  ; a comment
0
1.5 ; another
-2e-1
:END
"""
STRICT_2D = """\
:START2D 2 1 1 2 10 20 3
:START2D POSUNIT=PRIMARY CORUNIT=PRIMARY/1000 OFFSETROW=10 OFFSETCOL=20
1 2 3 4 5 6
7 8 9 10 11 12
:END
"""


def read(text, encoding="utf-8", **options):
    return parse_cal(
        text if isinstance(text, bytes) else text.encode(encoding), "f.cal", **options
    )


def said(cal, severity):
    return [(f.line, f.what) for f in cal.of(severity)]


def only_tolerated(text, *want):
    """Read a file of which just `want` (line, what) is tolerated; return its tables."""
    cal = read(text)
    assert said(cal, Severity.ERROR) == []
    assert said(cal, Severity.TOLERATED) == list(want)
    assert all(f.remedy for f in cal.findings)
    return cal.tables


def test_strict_1d_file():
    cal = read(STRICT_1D)
    (table,) = cal.tables
    assert cal.findings == () and cal.comments == ("accuracy of the first axis",)
    assert (table.axis, table.reference, table.sample_dist, table.offset) == (
        1,
        1,
        10.0,
        10.0,
    )
    assert table.serial_number == "12;3'4" and table.kind is TableKind.ONE_D
    assert table.position_unit == Unit(UnitWord.PRIMARY)
    assert table.correction_unit == Unit(UnitWord.PRIMARY, 1000.0)
    np.testing.assert_array_equal(table.values, [0, 1.5, -0.2])
    assert (table.line, table.lines["offset"]) == (2, 3)


def test_strict_2d_file():
    (table,) = read(STRICT_2D).tables
    assert read(STRICT_2D).findings == ()
    assert (table.row_axis, table.column_axis, table.outputs) == (2, 1, (1, 2))
    assert (table.sample_row, table.sample_col) == (10.0, 20.0)
    assert (table.offset_row, table.offset_col) == (10.0, 20.0)
    np.testing.assert_array_equal(table.values[:, :, 0], [[1, 3, 5], [7, 9, 11]])
    np.testing.assert_array_equal(table.values[:, :, 1], [[2, 4, 6], [8, 10, 12]])


def test_every_1d_keyword():
    head = (
        ":START 1 REFERENCEAXIS=2 POSUNIT=SECONDARY/10 CORUNIT=COUNTS SAMPLEDIST=-5 "
        "OFFSET=-1.5 EXPANDCOEFF=1.1e-5 MATERIALTEMP=20.5 NEGPOS NEGCOR ROLLOVER=4000 "
        "HOMEDIRECTION=CCW HOMEOFFSET=2 ABSOLUTEFEEDBACKOFFSET=77 FULLTRAVEL=300 "
        'SERIALNUMBER="A 1"'
    )
    (table,) = only_tolerated(f"{head}\n1\n2\n:END\n")
    assert table.reference_axis == 2 and table.pos_unit == Unit(
        UnitWord.SECONDARY, 10.0
    )
    assert table.cor_unit == Unit(UnitWord.COUNTS) and table.expand_coeff == 1.1e-5
    assert table.material_temp == 20.5 and table.negpos and table.negcor
    assert (table.sample_dist, table.offset, table.rollover) == (-5.0, -1.5, 4000.0)
    assert (table.home_direction, table.home_offset, table.full_travel) == (
        "CCW",
        2.0,
        300.0,
    )
    assert (table.absolute_feedback_offset, table.serial_number) == (77.0, "A 1")


def test_every_2d_keyword_and_a_galvo_table():
    head = (
        ":START2D 2 1 1 2 10 10 1 OUTAXIS3=4 POSUNIT=PRIMARY CORUNIT=PRIMARY OFFSETROW=0 "
        "OFFSETCOL=0 ABSOLUTEFEEDBACKOFFSETROW=1 ABSOLUTEFEEDBACKOFFSETCOL=2 NEGCOR "
        'ROLLOVERROW=3 ROLLOVERCOL=4 SERIALNUMBER="S"'
    )
    (table,) = only_tolerated(f"{head}\n1 2 3\n:END\n")
    assert (
        table.outputs == (1, 2, 4) and table.values.shape == (1, 1, 3) and table.negcor
    )
    assert (table.absolute_feedback_offset_row, table.absolute_feedback_offset_col) == (
        1.0,
        2.0,
    )
    assert (table.rollover_row, table.rollover_col, table.serial_number) == (
        3.0,
        4.0,
        "S",
    )
    (table,) = only_tolerated(
        ":GALVO2D 2 1 1 2 10 10 1 NEGCOR OUTAXIS3=3\n0 0 0\n:END\n"
    )
    assert table.kind is TableKind.GALVO and table.galvo and table.outputs == (1, 2, 3)


def test_several_tables_and_several_start_lines():
    tables = only_tolerated(
        ":START 1\n:START SAMPLEDIST=1\n:START NEGPOS\n0\n:END\n\n" + STRICT_1D
    )
    assert [t.line for t in tables] == [1, 8] and tables[0].negpos


WILD = [
    (
        "' by an older controller\n" + STRICT_1D,
        (1, "a comment that starts with an apostrophe"),
    ),
    (
        STRICT_1D.replace("; another", "' another"),
        (5, "a comment that starts with an apostrophe"),
    ),
    (
        "*" * 60 + "\n* Factory file *\n" + "*" * 60 + "\n" + STRICT_1D,
        (1, "text outside of a table is ignored (and in 2 more lines)"),
    ),
    (STRICT_2D.replace(":START2D 2", ":Start2D 2"), (1, "a token in mixed case")),
    (STRICT_2D.replace("OFFSETROW=", "OFFSETROW = "), (2, "blanks around =")),
    (STRICT_1D.replace("SAMPLEDIST=", "SAMPLEDIST= "), (3, "blanks around =")),
    (
        STRICT_1D.replace("POSUNIT=PRIMARY", "POSUNIT=METRIC"),
        (2, "the unit METRIC of older controllers, read as PRIMARY"),
    ),
    (
        STRICT_1D.replace("CORUNIT=PRIMARY/", "CORUNIT=Primary/"),
        (2, "a unit in lower case"),
    ),
    (STRICT_1D.replace("OFFSET=", "Offset="), (3, "a keyword in lower case")),
    (
        STRICT_1D.replace("0\n1.5", "0 1.5"),
        (4, "several values on a line of a 1D table"),
    ),
    (STRICT_2D.replace("1 2 3 4 5 6", "1\n2\n3\n4\n5\n6"), (3, "lines are not rows")),
    (STRICT_2D.replace("1 2 3 4 5 6\n", "1 2 3 4 5 6 "), (3, "lines are not rows")),
    (
        STRICT_2D.replace(
            "1 2 3 4 5 6\n7 8 9 10 11 12", "1 2 3 4\n5 6\n7 8 9 10\n11 12"
        ),
        (3, "lines are not rows"),
    ),
    (STRICT_1D.replace("\n", "\r\n"), (1, "lines end with CR or CRLF")),
    (STRICT_1D.removesuffix("\n"), (7, "the last line has no end")),
    (STRICT_1D.replace(":END", ":END of the table"), (7, "text after :END is ignored")),
    (STRICT_1D + "\nbye\n", (9, "text outside of a table is ignored")),
    (
        STRICT_1D.replace("; another", "; 20 °C").encode("cp1252"),
        (5, "Windows-1252 characters in a comment"),
    ),
    (
        "**** 20 °C ****\n".encode("cp1252") + STRICT_1D.encode(),
        (1, "Windows-1252 characters in a comment"),
        (1, "text outside of a table is ignored"),
    ),
    (
        b"\xef\xbb\xbf" + STRICT_1D.encode(),
        (1, "a byte order mark before the first line"),
    ),
    (
        STRICT_1D.replace('"', "").replace(";3'4", ""),
        (3, "a serial number without quotes"),
    ),
    (
        ":START 1 SAMPLEDIST=1 PRIMARYABSOLUTEFEEDBACKOFFSET=5\n0\n:END\n",
        (1, "the keyword 'PRIMARYABSOLUTEFEEDBACKOFFSET'"),
    ),
    (":START SAMPLEDIST=1 2\n0\n:END\n", (1, "an argument of :START after a keyword")),
    (
        ":START NEGPOS 2\n:START SAMPLEDIST=1\n0\n:END\n",
        (1, "an argument of :START after a keyword"),
    ),
    (
        STRICT_2D.replace("2 1 1 2 10 20 3", "2 1 1 2 OUTAXIS3=3 10 20 2"),
        (1, "an argument of :START2D after a keyword"),
    ),
    (
        ":START 1 SAMPLEDIST=1 HOMEOFFSET=0 HOMEDIRECTION=cw\n0\n:END\n",
        (1, "a home direction in lower case"),
    ),
]


@pytest.mark.parametrize(("text", "want"), [(text, want) for text, *want in WILD])
def test_files_met_in_the_wild_are_read_and_reported(text, want):
    (table,) = only_tolerated(text, *want)
    if table.kind is TableKind.TWO_D:
        np.testing.assert_array_equal(table.values.ravel(), np.arange(1, 13))


def test_tabs_blank_lines_and_arcseconds_are_strict_enough():
    text = STRICT_1D.replace(" ", "\t").replace("PRIMARY/1000", "PRIMARY/3600") + "\n\n"
    (table,) = only_tolerated(text)
    assert table.cor_unit == Unit(UnitWord.PRIMARY, 3600.0)


def test_utf8_comments_are_strict():
    assert read(STRICT_1D.replace("; another", "; 20 °C")).findings == ()


def test_negative_distance_with_positive_offset_is_read_with_a_warning():
    cal = read(STRICT_2D.replace("10 20 3", "10 -20 3"))
    assert cal.tables[0].sample_col == -20.0 and cal.of(Severity.ERROR) == []
    (warning,) = cal.of(Severity.WARNING)
    assert warning.line == 2 and "column axis lies outside" in warning.what
    assert "-60 to -20" in warning.what


ONE = ":START 1 SAMPLEDIST=1\n0\n:END\n"
BROKEN = [
    ("", 0, "no table in the file"),
    ("just text\n", 0, "no table in the file"),
    (":START 1 SAMPLEDIST=1\n0\n", 2, "the table of line 1 has no :END"),
    (
        ":START 1 SAMPLEDIST=1\n0\n" + ONE,
        3,
        ":START before the :END of the table of line 1",
    ),
    (":END\n" + ONE, 1, ":END without a start"),
    ("5\n" + ONE, 1, "values outside of a table"),
    (ONE + ":STOP\n", 4, "unknown token ':STOP'"),
    (":START 1\n0\n:END\n", 1, "SAMPLEDIST is missing"),
    (":START SAMPLEDIST=1\n0\n:END\n", 1, ":START has 0 arguments, not 1"),
    (":START 1 2 SAMPLEDIST=1\n0\n:END\n", 1, ":START has 2 arguments, not 1"),
    (":START 1\n:START 2 SAMPLEDIST=1\n0\n:END\n", 2, "'2' on a later :START line"),
    (
        ":START 1\n:START2D SAMPLEDIST=1\n0\n:END\n",
        2,
        "a :START2D line in the 1D table of line 1",
    ),
    (
        ":START 1.5 SAMPLEDIST=1\n0\n:END\n",
        1,
        "axis_index: '1.5' is not a whole number",
    ),
    (":START 1 SAMPLEDIST=1\n:END\n", 1, "the table has no correction values"),
    (
        ":START 1 SAMPLEDIST=1\n:START POSUNIT=COUNTS\n:END\n",
        2,
        "the table has no correction values",
    ),
    (":START 1 SAMPLEDIST=1\n0\n1,5\n:END\n", 3, "'1,5' is not a number"),
    (":START 1 SAMPLEDIST=1\n0\nnan\n:END\n", 3, "'nan' is not a number"),
    (":START 1 SAMPLEDIST=1\n0\n1 inf\n:END\n", 3, "'inf' is not a number"),
    (":START 1 SAMPLEDIST=1\n0\n1_0\n:END\n", 3, "'1_0' is not a number"),
    (":START 1 SAMPLEDIST=1\n0\n1e999\n:END\n", 3, "'1e999' is too large"),
    (":START 1 SAMPLEDIST=1\n0\n\n1-2\n:END\n", 4, "'1-2' is not a number"),
    (
        ":START 1 SAMPLEDIST=1\n0\n1\u00a02\n:END\n",
        3,
        "odd characters between the numbers",
    ),
    (":START 1 SAMPLEDIST=one\n0\n:END\n", 1, "SAMPLEDIST: 'one' is not a number"),
    (
        ":START 1 SAMPLEDIST=\u0663\n0\n:END\n",
        1,
        "SAMPLEDIST: '\u0663' is not a number",
    ),
    (
        ":START \u0661 SAMPLEDIST=1\n0\n:END\n",
        1,
        "axis_index: '\u0661' is not a whole number",
    ),
    (":START 1 SAMPLEDIST=\n0\n:END\n", 1, "SAMPLEDIST has no argument"),
    (":START 1 SAMPLEDIST\n0\n:END\n", 1, "SAMPLEDIST has no argument"),
    (":START 1 SAMPLEDIST=1 NEGCOR=1\n0\n:END\n", 1, "NEGCOR takes no argument"),
    (":START 1 SAMPLEDIST=1 INTABLE\n0\n:END\n", 1, "unknown keyword 'INTABLE'"),
    (
        ":START 1 SAMPLEDIST=1 OFFSETROW=1\n0\n:END\n",
        1,
        "a 1D table must not have OFFSETROW",
    ),
    (
        ":START 1 SAMPLEDIST=1\n:START SAMPLEDIST=2\n0\n:END\n",
        2,
        "SAMPLEDIST is given twice, here and in line 1, and differs",
    ),
    (
        ":START 1 SAMPLEDIST=1 POSUNIT=PRIMARY /1000\n0\n:END\n",
        1,
        "white space before the / of a unit",
    ),
    (
        ":START 1 SAMPLEDIST=1 POSUNIT=PRIMARY/ 1000\n0\n:END\n",
        1,
        "POSUNIT: the / of a unit has no divisor after it",
    ),
    (
        ":START 1 SAMPLEDIST=1 POSUNIT=PRIMARY/0\n0\n:END\n",
        1,
        "POSUNIT: the divisor '0' is not positive",
    ),
    (":START 1 SAMPLEDIST=1 POSUNIT=MM\n0\n:END\n", 1, "POSUNIT: 'MM' is not a unit"),
    (
        ":START 1 SAMPLEDIST=1 HOMEDIRECTION=LEFT\n0\n:END\n",
        1,
        "HOMEDIRECTION: 'LEFT' is not a home direction",
    ),
    (
        ':START 1 SAMPLEDIST=1 SERIALNUMBER="5\n0\n:END\n',
        1,
        "SERIALNUMBER: a stray quote in the serial number",
    ),
    (":START2D 1 2 1 2 10 10\n0 0\n:END\n", 1, ":START2D has 6 arguments, not 7"),
    (":START2D 1 2 1 2 10 10 0\n0 0\n:END\n", 1, "NumCols is 0"),
    (
        ":START2D 1 2 1 2 10 10 2 SAMPLEDIST=1\n0 0 0 0\n:END\n",
        1,
        "a 2D table must not have SAMPLEDIST",
    ),
    (
        STRICT_2D.replace("9 10 ", "9 "),
        4,
        "5 values on the line; a row has 3 columns of 2 values = 6",
    ),
    (
        STRICT_2D.replace("5 6", "5 6 6"),
        3,
        "7 values on the line; a row has 3 columns of 2 values = 6",
    ),
    (
        STRICT_2D.replace("10 20 3", "10 20 5"),
        4,
        "6 values on the line; a row has 5 columns of 2 values = 10",
    ),
    (
        STRICT_2D.replace("10 20 3", "10 20 999999999"),
        4,
        "the last row has 12 values; a row has 999999999 columns of 2 values = 1999999998",
    ),
    (STRICT_1D.replace("1.5", "1.5 °").encode("cp1252"), 5, "the line is not UTF-8"),
    (STRICT_1D.encode("utf-16"), 1, "the file is UTF-16"),
    (b":START 1\n\0\0", 2, "a zero byte: this is not a text file"),
    (ONE + STRICT_2D, 4, "a 2D table in a file of 1D tables"),
]


@pytest.mark.parametrize(("text", "line", "what"), BROKEN)
def test_broken_files_name_line_reason_and_mend(text, line, what):
    cal = read(text)
    first = cal.of(Severity.ERROR)[0]
    assert (first.line, first.what) == (line, what)
    assert first.remedy


def test_utf16_is_read_on_for_its_other_errors():
    cal = read(STRICT_1D.replace("OFFSET=10", "OFFSET=x").encode("utf-16"))
    assert said(cal, Severity.ERROR) == [
        (1, "the file is UTF-16"),
        (3, "OFFSET: 'x' is not a number"),
    ]


def test_a_broken_table_does_not_hide_the_next_one():
    cal = read(":START 1 SAMPLEDIST=1\nx\n:END\n" + STRICT_1D)
    assert len(cal.tables) == 1 and cal.tables[0].line == 5


def test_a_keyword_given_twice_alike_is_a_warning():
    cal = read(":START 1 SAMPLEDIST=1 SAMPLEDIST=1.0\n0\n:END\n")
    assert said(cal, Severity.WARNING) == [(1, "SAMPLEDIST is given twice")]


def test_reading_stops_after_a_hundred_findings():
    cal = read("5\n" * 100_000)
    assert len(cal.findings) == 101
    assert cal.findings[-1].what == "reading stopped after 100 findings"
    assert cal.findings[-1].line == 100


def test_files_are_read_from_disk_and_errors_refused(tmp_path):
    path = tmp_path / "a.cal"
    path.write_text(STRICT_1D)
    assert len(load_cal(path).tables) == len(read_cal(path).tables) == 1
    path.write_text(STRICT_1D.replace("1.5", "x").replace("OFFSET=10", "OFFSET=y"))
    with pytest.raises(InputError) as caught:
        load_cal(path)
    assert str(caught.value) == (
        f"{path}:3: OFFSET: 'y' is not a number; write a plain decimal number (1 more errors)"
    )
    path.write_text(STRICT_1D.replace("OFFSET=10", "OFFSET=y"))
    with pytest.raises(InputError) as caught:
        load_cal(path)
    assert str(caught.value) == (
        f"{path}:3: OFFSET: 'y' is not a number; write a plain decimal number"
    )
    with pytest.raises(InputError, match="no such file"):
        read_cal(tmp_path / "none.cal")
