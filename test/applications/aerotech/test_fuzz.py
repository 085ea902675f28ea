# SPDX-License-Identifier: Apache-2.0
"""Damaged files: no exception but our own, a line and a reason for each, and no long work."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.applications.aerotech.evaluate import (
    AxisSetup,
    CalEvaluator,
    MachineSetup,
)
from selfcal_ros.applications.aerotech.model import Severity, same_table
from selfcal_ros.applications.aerotech.read import parse_cal, refuse_errors
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.errors import InputError

SEEDS = [
    b"; a\n:START 1 POSUNIT=PRIMARY CORUNIT=PRIMARY/1000\n:START SAMPLEDIST=10 OFFSET=-5 NEGPOS\n"
    b"0\n1.5\n-2\n:END\n:START 2 REFERENCEAXIS=1 SAMPLEDIST=1 ROLLOVER=360\n0\n1\n:END\n",
    b":START2D 2 1 1 2 10 -20 3 OUTAXIS3=3\n:START2D POSUNIT=METRIC CORUNIT = PRIMARY/3600 "
    b'OFFSETROW=10 SERIALNUMBER="a;b"\n1 2 3 4 5 6 7 8 9\n7 8 9 10 11 12 1 2 3\n:END\nend\n',
    b"' \xb0C\r\n:GALVO2D 2 1 1 2 10 20 3 NEGCOR\r\n"
    + b"0 1 2 3 4 5\r\n" * 3
    + b":END\r\n",
]
PIECES = [
    b"1e999",
    b"-1e308",
    b"1e-400",
    b"nan",
    b"inf",
    b":START 1",
    b":START2D",
    b":END\n",
    b"\0",
    b"\xff",
    b"\xc3",
    b'"',
    b";",
    b"'",
    b"/",
    b"=",
    b"\t",
    b"\r",
    b"\n\n",
    b"99999999999",
    b"POSUNIT=",
    b"SECONDARY/1e-15",
    b"ROLLOVER=1e-15",
    b"\xe2\x80\xa8",
    b"\x0b\x1f",
    b"\xd9\xa3",
    b"1_0",
    b"0x1",
    b"-",
    b"+",
    b".",
    b"e",
    b"9" * 500,
    b"SAMPLEDIST=1e-15",
]
SETUP = MachineSetup(
    {a: AxisSetup(1000.0, 10.0, "CW", 1.0, 5.0) for a in range(1, 33)}, 25.0
)


def survive(data, *, write=True):
    """Read, check, evaluate and write `data`; return whether it was good."""
    cal = parse_cal(data, "f.cal")
    lines = data.count(b"\n") + data.count(b"\r") + 1
    assert all(
        0 <= f.line <= lines and f.what and f.remedy and "\n" not in f.text("f.cal")
        for f in cal.findings
    )
    if cal.of(Severity.ERROR):
        return False
    assert cal.tables
    evaluator = CalEvaluator(cal.tables, SETUP)
    evaluator.corrections({axis: [-1e15, 0.0, 3.3, 1e15] for axis in evaluator.inputs})
    if not write:
        return True
    again = parse_cal(cal_text(cal.tables).encode(), "again")
    assert not again.of(Severity.ERROR) and not again.of(Severity.TOLERATED)
    assert all(same_table(a, b) for a, b in zip(cal.tables, again.tables, strict=True))
    return True


def mutate(data, rng):
    data = bytearray(data)
    for _ in range(rng.randint(1, 4)):
        at, what = rng.randrange(len(data) + 1), rng.randrange(6)
        if what == 0:
            data[at:at] = rng.choice(PIECES)
        elif what == 1:
            del data[at:]
        elif what == 2:
            del data[at : at + rng.randint(1, 12)]
        elif what == 3:
            data[at : at + 1] = bytes([rng.randrange(256)])
        elif what == 4:
            start = rng.randrange(len(data) + 1)
            data[at:at] = data[start : start + rng.randint(1, 60)]
        else:
            data[at : at + rng.randint(0, 6)] = rng.choice(PIECES)
        data = data or bytearray(b"\n")
    return bytes(data)


def test_the_seeds_themselves_are_good():
    assert all(survive(seed) for seed in SEEDS)


@pytest.mark.parametrize("seed", SEEDS, ids=["1d", "2d", "galvo"])
def test_mutated_files(seed):
    rng = random.Random(7)
    good = sum(survive(mutate(seed, rng)) for _ in range(1500))
    assert 10 < good < 1400  # both ways are exercised


@given(st.binary(max_size=200))
def test_any_bytes(data):
    survive(data)


@given(
    st.lists(
        st.sampled_from(
            [*PIECES, b":START 1 SAMPLEDIST=1", b"\n", b" ", b"0", b":END"]
        ),
        max_size=30,
    )
)
def test_any_pieces(pieces):
    survive(b"".join(pieces))


HUGE = {
    "a million columns on a line": b":START2D 2 1 1 2 1 1 1000000\n"
    + b"0 1 " * 10**6
    + b"\n:END\n",
    "a million columns, few values": b":START2D 2 1 1 2 1 1 1000000\n0 1\n:END\n",
    "300,000 words in a head": b":START 1 SAMPLEDIST=1 "
    + b"A " * 300_000
    + b"\n0\n:END\n",
    "300,000 numbers in a head": b":START 1 SAMPLEDIST=1 "
    + b"1 " * 300_000
    + b"\n0\n:END\n",
    "one word of a million letters": b":START 1 SAMPLEDIST=1 "
    + b"A" * 10**6
    + b"\n0\n:END\n",
    "300,000 quotes": b":START 1 SAMPLEDIST=1 SERIALNUMBER="
    + b'"' * 300_000
    + b"\n0\n:END\n",
    "a million blanks": b":START 1 SAMPLEDIST" + b" " * 10**6 + b"x\n0\n:END\n",
    "a number of a million digits": b":START 1 SAMPLEDIST="
    + b"1" * 10**6
    + b"\n0\n:END\n",
    "a value of a million digits": b":START 1 SAMPLEDIST=1\n0."
    + b"1" * 10**6
    + b"\n:END\n",
    "nested starts": b":START 1 SAMPLEDIST=1\n0\n" * 40_000,
    "start lines only": b":START 1 SAMPLEDIST=1\n" * 40_000,
    "repeated keywords": b":START 1 SAMPLEDIST=1\n"
    + b":START NEGCOR\n" * 40_000
    + b"0\n:END\n",
    "40,000 tables": b":START 1 SAMPLEDIST=1\n0\n:END\n" * 40_000,
    "comments only": b"; x\n" * 40_000 + b"' y\n" * 40_000,
    "words outside": b"words outside\n" * 40_000,
    "carriage returns only": b"\r" * 10**6,
    "letters in the table": b":START 1 SAMPLEDIST=1\n" + b"x\n" * 40_000 + b":END\n",
}
"""Large enough that what grows with the square of a count takes minutes, or all memory."""


@pytest.mark.parametrize("data", HUGE.values(), ids=HUGE.keys())
def test_huge_files_end(data):
    good = survive(data, write=False)
    assert good == (
        data
        in (HUGE["a million columns on a line"], HUGE["a value of a million digits"])
    )


def test_refusals_are_one_line():
    for data in (b"", b"\xff\xfe", b"\0", b":START"):
        cal = parse_cal(data, "f.cal")
        with pytest.raises(InputError, match=r"^f\.cal[^\n]*; [^\n]+$"):
            refuse_errors(cal)
