# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.aerotech.model import Severity
from selfcal_ros.applications.aerotech.read import parse_cal
from selfcal_ros.applications.aerotech.rules import Gi4


def findings(text, severity=Severity.ERROR, **options):
    found = parse_cal(text.encode(), "f.cal", **options).of(severity)
    assert all(f.remedy for f in found)
    return [(f.line, f.what) for f in found]


def one_d(axis=1, more=""):
    return f":START {axis} SAMPLEDIST=1 {more}\n0\n1\n:END\n"


def two_d(
    head="2 1 1 2 10 10 2", more="POSUNIT=PRIMARY CORUNIT=PRIMARY", rows=2, width=4
):
    return (
        f":START2D {head} {more}\n" + (" ".join("0" * width) + "\n") * rows + ":END\n"
    )


def galvo(head="2 1 1 2 10 10 3", rows=3, columns=3, outs=2, more=""):
    return (
        f":GALVO2D {head} {more}\n" + ("0 " * columns * outs + "\n") * rows + ":END\n"
    )


@pytest.mark.parametrize(
    ("axis", "good"), [(0, False), (1, True), (32, True), (33, False)]
)
def test_axes_count_from_one_to_32(axis, good):
    want = [] if good else [(1, f"axis {axis} is not in 1..32")]
    assert findings(one_d(axis)) == want
    assert findings(one_d(3, f"REFERENCEAXIS={axis}")) == want
    assert findings(two_d(f"2 {axis} 3 4 1 1 2")) == (
        [] if axis != 2 and good else want
    )
    assert findings(two_d("5 6 7 8 1 1 1", f"OUTAXIS3={axis}", width=3)) == want


def test_an_axis_of_zero_gets_the_hint():
    cal = parse_cal(one_d(0).encode(), "f")
    assert cal.findings[0].remedy == "indices in calibration files count from 1"


def test_a_file_holds_100_tables_and_8_for_an_axis():
    hundred = "".join(one_d(n % 32 + 1) for n in range(100))
    assert findings(hundred) == []
    assert findings(hundred + one_d(32)) == [(401, "101 1D tables in the file")]
    assert findings(one_d(3) * 8) == []
    assert findings(one_d(3) * 8 + one_d(4)) == []
    assert findings(one_d(3) * 9) == [(33, "more than 8 tables correct axis 3")]
    # Another reference axis makes no difference: the limit is that of the corrected axis.
    assert findings(one_d(3) * 8 + one_d(3, "REFERENCEAXIS=1")) == [
        (33, "more than 8 tables correct axis 3")
    ]


def test_a_file_holds_10_2d_tables():
    assert findings(two_d() * 10) == []
    assert findings(two_d() * 11) == [(41, "11 2D tables in the file")]


def test_one_table_a_galvo_scanner():
    other = galvo("4 3 3 4 10 10 3")
    assert findings(galvo() + other) == []
    assert findings(galvo() + other + galvo()) == [
        (11, "a second table for the galvo scanner of axis 2, after that of line 1")
    ]
    assert findings(galvo() + galvo("3 1 1 3 10 10 3"))[0][1].endswith(
        "of axis 1, after that of line 1"
    )


def test_reading_stops_at_a_thousand_tables():
    assert findings(one_d(1) * 1500)[-1] == (4001, "more than 1000 tables in the file")


@pytest.mark.parametrize(
    ("first", "second", "what"),
    [
        (one_d(), two_d(), "a 2D table in a file of 1D tables"),
        (two_d(), galvo("4 3 3 4 1 1 3"), "a galvo 2D table in a file of 2D tables"),
        (galvo("4 3 3 4 1 1 3"), one_d(), "a 1D table in a file of galvo 2D tables"),
    ],
)
def test_kinds_do_not_mix(first, second, what):
    assert findings(first + second) == [(first.count("\n") + 1, what)]


@pytest.mark.parametrize(
    "keyword",
    [
        "OFFSETROW=0",
        "OFFSETCOL=0",
        "ABSOLUTEFEEDBACKOFFSETROW=0",
        "ABSOLUTEFEEDBACKOFFSETCOL=0",
        "ROLLOVERROW=1",
        "ROLLOVERCOL=1",
        'SERIALNUMBER="1"',
    ],
)
def test_keywords_that_a_galvo_table_must_not_have(keyword):
    word = keyword.partition("=")[0]
    assert findings(two_d(more=f"CORUNIT=COUNTS {keyword}")) == []
    assert findings(galvo(more=keyword)) == [
        (1, f"a galvo 2D table must not have {word}")
    ]


@pytest.mark.parametrize(
    ("head", "size", "what"),
    [
        ("2 1 3 2 10 10 3", (3, 3), "ColumnAxis is 1, OutputAxis1 3"),
        ("2 1 1 3 10 10 3", (3, 3), "RowAxis is 2, OutputAxis2 3"),
        ("2 1 1 2 -10 10 3", (3, 3), "SampDistRow is negative in a galvo table"),
        ("2 1 1 2 10 -10 3", (3, 3), "SampDistCol is negative in a galvo table"),
        ("2 1 1 2 10 10 3", (4, 3), "a galvo table of 4 rows"),
        ("2 1 1 2 10 10 4", (3, 4), "a galvo table of 4 columns"),
        ("2 1 1 2 10 10 373", (371, 373), "138383 points in a galvo table"),
    ],
)
def test_galvo_rules(head, size, what):
    assert findings(galvo(head, *size)) == [(1, what)]


def test_a_galvo_table_may_have_138000_points_whatever_its_outputs():
    assert 371 * 371 < 138_000 < 373 * 371
    assert findings(galvo("2 1 1 2 10 10 371 OUTAXIS3=3", 371, 371, 3)) == []


def test_gi4_restrictions_only_on_request():
    assert findings(galvo()) == []
    assert findings(galvo(), gi4=Gi4()) == [
        (1, "3 rows and 3 columns for a GI4"),
        (1, "SampDistRow is 10 counts for a GI4"),
        (1, "SampDistCol is 10 counts for a GI4"),
    ]
    good = galvo("2 1 1 2 1024 1024 65", 65, 65)
    assert findings(good, gi4=Gi4(16)) == []
    assert findings(good, gi4=Gi4(20)) == [
        (1, "SampDistRow is 1024 counts for a GI4"),
        (1, "SampDistCol is 1024 counts for a GI4"),
    ]
    assert (
        findings(
            galvo("2 1 1 2 32768 32768 65", 65, 65, more="POSUNIT=COUNTS/2"),
            gi4=Gi4(20),
        )
        == []
    )
    primary = galvo("2 1 1 2 1 1 65", 65, 65, more="POSUNIT=PRIMARY CORUNIT=PRIMARY")
    assert findings(primary, gi4=Gi4()) == []
    assert "cannot be compared" in findings(primary, Severity.WARNING, gi4=Gi4())[0][1]
    assert findings(two_d(), gi4=Gi4()) == []


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (":START 1 SAMPLEDIST=0\n0\n:END\n", "sample dist is zero"),
        (two_d("2 1 1 2 0 10 2"), "sample row is zero"),
        (two_d("2 1 1 2 10 0 2"), "sample col is zero"),
        (one_d(more="ROLLOVER=0"), "the rollover is not positive"),
        (one_d(more="ROLLOVER=-5"), "the rollover is not positive"),
        (two_d(more="CORUNIT=COUNTS ROLLOVERROW=0"), "the rollover is not positive"),
        (two_d("1 1 1 2 10 10 2"), "RowAxis and ColumnAxis are both 1"),
        (two_d("2 1 1 1 10 10 2"), "an output axis is named twice"),
        (
            two_d("2 1 1 2 10 10 2", "CORUNIT=COUNTS OUTAXIS3=2", width=6),
            "an output axis is named twice",
        ),
    ],
)
def test_values_that_no_table_can_have(text, what):
    assert findings(text) == [(1, what)]


@pytest.mark.parametrize(
    ("more", "what"),
    [
        ("HOMEOFFSET=5", "HOMEOFFSET is ignored without HOMEDIRECTION"),
        ("FULLTRAVEL=5", "FULLTRAVEL is ignored without HOMEDIRECTION"),
        ("EXPANDCOEFF=1e-5", "EXPANDCOEFF is ignored without MATERIALTEMP"),
        ("MATERIALTEMP=20", "MATERIALTEMP is ignored without EXPANDCOEFF"),
        (
            "HOMEDIRECTION=CW",
            "HOMEDIRECTION without HOMEOFFSET: a home offset of 0 is assumed",
        ),
        (
            "REFERENCEAXIS=2 EXPANDCOEFF=1e-5 MATERIALTEMP=20",
            "thermal expansion in a table that corrects another axis",
        ),
        (
            "OFFSET=1.5",
            "the home position lies outside of the table, which covers -1.5 to -0.5",
        ),
        (
            "OFFSET=-0.5",
            "the home position lies outside of the table, which covers 0.5 to 1.5",
        ),
    ],
)
def test_what_is_legal_but_hardly_meant_is_a_warning(more, what):
    text = f":START 1 SAMPLEDIST=1\n:START {more}\n0\n1\n:END\n"
    assert findings(text) == [] and findings(text, Severity.WARNING) == [(2, what)]


def test_the_home_position_may_lie_on_the_edge_of_a_table():
    for more in ("", "OFFSET=0", "OFFSET=1", "OFFSET=5 ROLLOVER=9"):
        assert findings(one_d(more=more), Severity.WARNING) == []
    tenths = ":START 1 SAMPLEDIST=0.1 OFFSET=0.7\n" + "0\n" * 8 + ":END\n"
    assert np.arange(8)[-1] * 0.1 != 0.7 and findings(tenths, Severity.WARNING) == []


def test_a_2d_table_whose_corrections_are_counts_by_omission():
    assert findings(two_d(more="POSUNIT=PRIMARY"), Severity.WARNING) == [
        (1, "CORUNIT is missing: the corrections are counts, not POSUNIT")
    ]
    assert findings(two_d(more=""), Severity.WARNING) == []


def test_2d_home_outside_loses_its_zero_bias():
    text = two_d(more="POSUNIT=PRIMARY CORUNIT=PRIMARY OFFSETROW=-1")
    assert findings(text, Severity.WARNING) == [
        (
            1,
            "the home position of the row axis lies outside of the table, which covers 1 to 11: "
            "no zero bias",
        )
    ]
    longer = two_d(
        more="POSUNIT=PRIMARY CORUNIT=PRIMARY OFFSETROW=-1 OFFSETCOL=-1", rows=3
    )
    assert [
        text.split("table, ")[1] for _, text in findings(longer, Severity.WARNING)
    ] == ["which covers 1 to 21: no zero bias", "which covers 1 to 11: no zero bias"]
