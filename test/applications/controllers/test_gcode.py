# SPDX-License-Identifier: Apache-2.0
"""Corrected programs: what is refused, and the way of a machine that runs what is not."""

import contextlib
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.controllers.gcode import (
    Rewriter,
    corrected_program,
    simplified,
)
from selfcal_ros.applications.controllers.gcode_codes import DIALECTS
from selfcal_ros.applications.controllers.grid import Wiring, wanted
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.gcode_machines import INERT, Machine, Wrong, farthest, run_both
from test.support.maps import random_map

# errors of some 5 um, from site to site
MAP = random_map(Artifact(11, 0.01), 4, gain=20.0)
FRAME = MachineFrame(unit="m", home_x_m=-0.003, home_y_m=0.005)
FRAMES = [
    FRAME,
    MachineFrame(unit="m", home_x_m=0.01, reverse_x=True),
    MachineFrame(unit="m", home_y_m=-0.02, reverse_y=True),
]
CORRECTIONS = {frame: wanted(MAP, Wiring(frame)) for frame in FRAMES}
STAGE = Compensator(MAP)
ROUNDING_MM = 3e-5

MILL = """%
(pocket, 4 mm mill)
N10 G21 G17 G90 G94 G54 G91.1
N15 G64 P0.01 Q0
N20 T1 M6
N25 G43 H1
N30 S12000 M3
N40 G0 X0. Y0. Z5.
N50 G1 Z-1. F200 ; plunge
N60 G1 X40. Y0. F800
N70 X50. Y10. M8 (coolant on the way)
N80 G3 X40. Y20. I-10. J0.
N90 X30. Y10. J-10.
N100 g 2 X30. Y10. Z-2. I5. J5.
N120 G91
N130 G1 X5. Y2.5
N140 Y-20. Z-.5
N150 G90 G0 Z5.
N160 G98 G81 X10. Y10. Z-3. R1. F100
N170 X20.
N180 G80
N190 G0 X0. Y0. Z5. M5
N195 G53 G0 Z0
N196 G91 G28 X0 Y0
N200 G90 G0 X3 Y3 Z1
N210 G1 X40. Y-20.
N220 M2
%
"""
LASER = """; made by hand (GRBL)
G20
G90 G17
M4 S0
G0 X0Y0
G1X1.5Y0S500F100
X1.5Y0.75
G2X0.5Y0.75I-0.5J0
G3 X-0.25 Y0 I-0.75
g1 x0 y0
G28
M5
G0 X1 Y1
G1 X1.2
M30
"""
PRINTER = """; FLAVOR:Marlin
M117 Printing, layer 1
M201 X1000 Y1000 Z200 E5000
M104 S200 T0
G28 X Y
G90
M83
G92 E0
G1 Z0.2 F3000
G0 X-20 Y-20
G1 X50 Y-20 E2.5 F1800
M205 X8 Y8 E2
G1 Y25 E1.25
G2 X40 Y35 I-10 E1 Z0.4
G1 X-20.000 E2.5;infill
G1 F600 E-1
M82
G92 E0
G1 X10 Y10 E1.5
G91
M83
G1 X-15 Y-15 E3
G1 Z1
G90
M83
G28
G0 X0 Y0 F6000
G1 Z1
G1 X0 Y30 Z5
M84 X Y E
"""
PROGRAMS = [
    (MILL, "linuxcnc"),
    (LASER, "grbl"),
    (PRINTER, "marlin"),
    (re.sub("M20[15].*", "M400", PRINTER).replace("M84 X Y E", "M84"), "klipper"),
]


def rewriter_of(dialect: str, *, um: float = 1.0, frame=FRAME, **kwargs) -> Rewriter:
    return Rewriter(
        CORRECTIONS[frame],
        dialect=dialect,
        tolerance_m=um * 1e-6,
        step_m=MAP.artifact.grid_pitch_m / 32,
        decimals=6,
        **kwargs,
    )


def corrected(text: str, dialect: str, **kwargs) -> str:
    return corrected_program(text, "a.nc", rewriter_of(dialect, **kwargs))


def reached(points_mm: np.ndarray, frame=FRAME) -> np.ndarray:
    """Return where the stage really goes when these positions are commanded, mm."""
    x, y = STAGE.correct(*frame.from_machine(*points_mm.T * 1e-3))
    return np.stack(frame.to_machine(x, y), axis=1) * 1e3


def pieces(
    text: str, dialect: str, *, um: float = 1.0, frame=FRAME, seen=FRAME, **kwargs
) -> int:
    """Run both programs as `seen` wires the stage; return the number of pieces."""
    return run_both(
        text,
        rewriter_of(dialect, um=um, frame=frame, **kwargs),
        lambda points: reached(points, seen),
        um * 1e-3 + ROUNDING_MM,
    )


@pytest.mark.parametrize(("program", "dialect"), PROGRAMS, ids=lambda value: value[:8])
def test_the_stage_follows_the_programmed_path(program, dialect):
    assert 100 < pieces(program, dialect) < 5000


@pytest.mark.parametrize("frame", FRAMES, ids=["plain", "reversed x", "reversed y"])
@pytest.mark.parametrize("seen", FRAMES, ids=["plain", "reversed x", "reversed y"])
def test_each_sense_of_the_axes_counts(frame, seen):
    if seen is frame:
        assert pieces(LASER, "grbl", frame=frame, seen=seen)
    else:
        with pytest.raises(AssertionError):
            pieces(LASER, "grbl", frame=frame, seen=seen)


@pytest.mark.parametrize(("program", "dialect"), PROGRAMS, ids=lambda value: value[:8])
def test_every_line_of_a_move_names_its_command(program, dialect):
    out = corrected(program, dialect)
    lines = [re.sub(r"\(.*?\)|;.*|M117.*", "", line) for line in out.splitlines()]
    moves = [line for line in lines if re.search("[XYZE]", line)]
    assert len(moves) > 100 and all(re.search(r"[GM]\d", line) for line in moves)


SAID = {
    "linuxcnc": "G21 G90 G17\nG64 Q0\nF300\nG0 X0 Y0 Z5\n",
    "grbl": "G21 G90 G17\nF300\nG0 X0 Y0 Z5\n",
    **dict.fromkeys(("marlin", "klipper"), "G21\nG90\nM82\nG0 X0 Y0 Z5\nG92 E0\n"),
}
KNOWN = {code.partition(".")[0] for codes in DIALECTS.values() for code in codes}
ALL = [
    f"{letter}{number}{part}"
    for letter in "GM"
    for number in range(201)
    for part in (
        "",
        *(".1", ".2", ".3", ".4", ".5")[: 5 * (f"{letter}{number}" in KNOWN)],
    )
]
FOLLOWING = [
    "",
    " X10 Y7",
    " P1",
    " Z2",
    " E1",
    " H1",
    " Z-1 R2 X3",
    " X10 R8",
    " X10 I5",
]


@pytest.mark.parametrize("dialect", DIALECTS)
def test_no_code_of_a_dialect_leads_the_stage_elsewhere(dialect):
    """Each code with each following, then moves that show what it has changed."""
    ran, known = 0, set()
    for code in [*ALL, "T1", "T1 M6", "$H", "O100", "SET_GCODE_OFFSET X=2", "PARK"]:
        for words in FOLLOWING if code in DIALECTS[dialect] else FOLLOWING[:2]:
            text = f"{SAID[dialect]}{code}{words}"
            try:
                corrected(text, dialect, um=50.0)
            except InputError:
                continue
            known.add(code)
            for after in ("G1 X12", "G0 X3 Y4\nG1 X9 Y5 Z1")[: 1 + ("X" in words)]:
                with contextlib.suppress(InputError):
                    ran += pieces(f"{text}\n{after}", dialect, um=50.0) > 0
    assert ran > 50 and known >= {"G0", "G1", "G2", "G3", "G4", "G28", "G90", "G21"}
    assert not known & {
        "G10",
        "G20",
        "G29.1",
        "G52",
        "G68",
        "G93",
        "G41",
        "M206",
        "M98",
        "$H",
        "O100",
        "SET_GCODE_OFFSET X=2",
        "PARK",
    }
    # it only names the next tool
    assert ("T1" in known) == (dialect in ("linuxcnc", "grbl"))
    machine, unknown = Machine(dialect), set()
    for code in known:
        try:
            machine.run(
                f"{code} X1 Z1 R1 I1 E1 P1" if code in ("G2", "G3", "G81") else code
            )
        except Wrong as error:
            unknown |= {code} if str(error).startswith("not known") else set()
    assert not unknown


@pytest.mark.parametrize("dialect", DIALECTS)
def test_codes_that_change_no_place_are_inert(dialect):
    """The list of what leaves positions alone against that of the machines of the tests."""
    inert = {
        code.name
        for code in DIALECTS[dialect].values()
        if code.does in ("other", "stop")
    }
    assert inert <= {*INERT[dialect].split(), "G95"}


NUMBERS = st.one_of(
    st.integers(-40, 40).map(str),
    st.floats(-40, 40).map("{:.3f}".format),
    st.sampled_from(["1.", "+.5", "-0", "5 5", "1e3", "1..2", "--1", "#1", "[2]"]),
)
WORDS = st.one_of(
    st.tuples(st.sampled_from("XYZXYZEIJRFPKLST"), NUMBERS).map("".join),
    st.tuples(st.sampled_from("xyUVWABC"), NUMBERS).map(" ".join),
)
ANY_CODE = st.sampled_from(
    [
        "G0",
        "G1",
        "G2",
        "G3",
        "G4",
        "G10",
        "G18",
        "G20",
        "G28",
        "G30",
        "G38.2",
        "G41",
        "G43",
        "G49",
        "G53",
        "G55",
        "G64",
        "G73",
        "G80",
        "G81",
        "G82",
        "G90",
        "G91",
        "G92",
        "G93",
        "M0",
        "M2",
        "M3",
        "M6",
        "M18",
        "M82",
        "M83",
        "M84",
        "M205",
        "M206",
        "T1",
    ]
)
LINES = st.builds(
    lambda before, codes, words, between, after: (
        before + between.join([*codes, *words]) + after
    ),
    st.sampled_from(["", "", "", "/", "N5 "]),
    st.lists(ANY_CODE | st.sampled_from(["G0", "G1", "G2", "G3"]), max_size=2),
    st.lists(WORDS, max_size=4),
    st.sampled_from([" ", ""]),
    st.sampled_from(["", "", "; X9", "(G91)"]),
)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    st.sampled_from(sorted(DIALECTS)),
    st.lists(LINES, min_size=1, max_size=8),
    st.booleans(),
)
def test_no_random_program_leads_the_stage_elsewhere(dialect, lines, said):
    """Of a program its lines that are not refused after one another."""
    kept = (SAID[dialect] if said else "").splitlines()
    for line in lines:
        try:
            corrected("\n".join([*kept, line]), dialect, um=20.0)
        except InputError as error:
            assert "\n" not in str(error) and str(error).startswith(
                f"a.nc:{len(kept) + 1}: "
            )
        else:
            kept.append(line)
    pieces("\n".join(kept), dialect, um=20.0)


REFUSED = """
grbl | G21 // G1 X5 Y5 | 2: the program has not said G90 or G91
grbl | G90 // G0 X5 Y5 | 2: the program has not said G20 or G21
grbl | G21 G90 // G0 X5 Y5 // G2 X6 Y6 I1 | 3: the program has not said G17
linuxcnc | G21 G90 // G0 X5 Y5 // G1 X6 | 3: the program has not said G61 or G61.1 or G64
linuxcnc | G64 P0.01 Q0.01 | 1: G64 P merges
linuxcnc | G64 P0.01 | 1: G64 P merges the pieces of corrected lines; write Q0 behind it
grbl | G21 G90 // X5 | 2: the line does not name its command
grbl | +G91 // G0 X5 | 5: the position before this line is not known
grbl | +G90 // G0 X0 Y0 // G28 // G1 X5 | 7: the position before this line is not known
grbl | +G0 X0 Y0 Z5 // G53 G0 Z0 // G1 X40 Y20 Z1 | 6: Z before this line is not
grbl | +G38.2 Z0 | 4: G38.2 is not in the list
grbl | +G53 G0 X0 | 4: G53 leaves the frame of the map; write G0 or G1, and Z alone
grbl | +G53 G2 X1 I1 | 4: G53 leaves the frame
grbl | +G28 X0 Y0 | 4: the way home passes a point
grbl | +G91 // G90 G28 X0 | 5: the way home
grbl | +G91 G28 X0 Y1 | 4: the way home passes a point that is not corrected; write G91
grbl | +G54 // G0 X0 Y0 // G55 | 6: G55 follows a move in X or Y; set the frame before
linuxcnc | +G43 H1 // G0 X0 Y0 // G43 H2 | 6: G43 follows a move in X or Y
grbl | +G0 X0 Y0 // G20 | 5: G20 follows a move in X or Y
grbl | G92 X0 | 1: G92 is not in the list of codes that are known of grbl; set the frame
marlin | G92 X0 E0 | 1: X is not a word of G92
marlin | G92 | 1: G92 moves the frame
klipper | G92 | 1: G92 moves the frame
linuxcnc | G41 D1 | 1: G41 is not in the list
grbl | $H | 1: '$' does not
grbl | $J=G91 X1 F9 | 1: '$'
grbl | G0 X1 !  | 1: '!' acts on grbl
grbl | (what is this?) | 1: '?' acts on grbl even in a comment
linuxcnc | (PY,x) | 1: '(PY' acts
linuxcnc | /G0 X1 | 1: '/' does not belong
linuxcnc | o100 sub | 1: 's' does
linuxcnc | M2 // G0 X1 | 2: the line follows the end
linuxcnc | % // M5 // % // M3 | 4
linuxcnc | +G1 X#1 Y0 | 4: 'X' does not
linuxcnc | +G0 X[1+2] | 4: 'X' does not
grbl | +G1 X1 X2 | 4: X is given twice
grbl | +G0 X0 Y0 // G1 X9 F0 | 5: F0 is not a feed; give one above 0
klipper | +G0 X0 Y0 // G1 X9 F-.5 | 5: F-.5 is not a feed
grbl | +G0 G1 X1 | 4: G0 G1 in one
grbl | +G0 X0 M30 | 4: the program stops in the line of a move; stop in the next line
linuxcnc | +G0 X0 M1 | 4: the program stops
grbl | +G0 X1 0 | 4: '0' does not
grbl | +G0 X1e3 | 4: E is not a word of G0
grbl | +G4 P1 X5 | 4: X is not a
linuxcnc | +G0 X1 Y1 C5 | 4: C is not a word of G0
linuxcnc | +G64 // G0 X0 Y0 Z5 // G81 X1 Z-1 R1 L3 | 6: L is not a word of G81; write each
linuxcnc | +G64 // G0 X0 Y0 // G91 // G81 X1 Z-1 R1 | 7: G81 by increments; write G90
grbl | +G18 | 4: G18 is not in the list of codes that are known of grbl; have arcs written in
grbl | +G0 X0 Y0 // G2 X10 Y0 R4 | 5: R is not a word of G2
grbl | +G0 X0 Y0 // G2 X10 I5 // X20 Y5 | 6: the arc has no centre; give I and J
grbl | +G0 X0 Y0 // G2 X10 I10 | 5: the arc has no centre
grbl | +G0 X0 Y0 // G91 // G2 X10 I5 | 6: G2 by increments; write G90 before arcs
grbl | +G2 X1 I5 | 4: the position
grbl | +G0 X0 Y0 // G2 I5 | 5: grbl needs X or Y
linuxcnc | +G64 // G0 X0 Y0 Z5 // G81 X1 Z-1 R1 // G81 R2 | 7: G81 names no axis
grbl | +G0 X0 Y0 // G2 X10.0011 Y0 I5 | 5: the arc ends at 1.000220 times its radius
grbl | +G0 X0 Y0 // G2 X0 Y0.0001 I5 | 5: the arc ends
grbl | +G0 X0 Y0 // G2 X10 I5 P2 | 5: P is not a word of G2; write each repeat, turn
grbl | +G1 X5 Y5 | 4: the position before this line is not known
marlin | +G1 X5 Y5 | 4: the position before this line is not known; write an absolute move of X and
klipper | G28 // +G0 X0 Y0 // G28 // G1 X5 Y5 ; E1 | 7: the position before this line is not known
klipper | +G0 X0 Y0 // G28 // G0 X5 Y5 | 6: G28 has ended an offset that G92 may have set before
marlin | G28 Y // +G0 X0 Y0 // G28 X // G0 X5 | 7: G28 has ended an offset that G92 may have set
grbl | +G0 Z5 // G49 X5 | 5: G49 G0 in one line; write a line for each
grbl | +G1 G49 X5 | 4: G1 G49 in one line
marlin | +G1 X5 Y5 E1 | 4: the position before this line is not known
marlin | +G0 X0 Y0 // G1 X40 Y20 E1 | 5: E before this line is not known
linuxcnc | +G61 // G0 X0 Y0 // G2 I5 G64 P0.01 Q0 | 6: G2 G64 in one line; write a line
marlin | G21 G90 | 1: G21 G90 in one line
marlin | X5 | 1: the line does not
marlin | X5 G1 | 1: the line does not begin
marlin | T0 | 1: the line does not
marlin | N5 G1 X1*33 | 1: '*' does not belong
marlin | +g1 X5 | 4: 'g' does not
klipper | G01 X5 | 1: G01 is not understood by all firmware; write G1
marlin | G0 X | 1: X has no number
marlin | G90 // G1 E1 | 2: the program has not said M82 or M83; write it after the last G90
marlin | M83 // G90 // G1 E1 | 3: the program has not said M82
marlin | G91 // M82 | 2: firmware disagrees on M82 after G91; write G90
klipper | +G0 X0 Y0 // G2 X5 R5 | 5: R is not a word of G2
klipper | G20 | 1: G20
klipper | SET_GCODE_OFFSET X=2 | 1: '_' does not belong to a word of klipper
klipper | PARK | 1: the line does not begin with a command
klipper | G1 X5 (a) | 1: '(' does
"""
"""Dialect, program (+: its modes are said; //: end of line), line and reason."""
CASES = [
    tuple(part.strip() for part in row.split(" | "))
    for row in REFUSED.strip().splitlines()
]
CASES += [
    ("marlin", "\tG1 X5", "1: '\\t' does not belong to a word of marlin"),
    ("grbl", "(\u212a)", "1: '\u212a' acts on grbl even in"),
    ("marlin", "; a\rG1 X5", "1: '\\r' acts"),
    ("grbl", f"+G0 X0 Y0\nG1 X9 F{'0' * 70}9", "5: the corrected line is too long"),
]
BEFORE = dict.fromkeys(("grbl", "linuxcnc"), "G21 G90\nG17\nF9\n") | dict.fromkeys(
    ("marlin", "klipper"), "G21\nG90\nM82\n"
)


@pytest.mark.parametrize(("dialect", "text", "message"), CASES)
def test_what_cannot_be_corrected_is_one_line(dialect, text, message):
    text = re.sub(" // ", "\n", text)
    text = re.sub(r"^\+", BEFORE[dialect], text, count=1, flags=re.MULTILINE)
    with pytest.raises(InputError) as raised:
        corrected(text, dialect)
    assert str(raised.value).startswith(f"a.nc:{message}") and "\n" not in str(
        raised.value
    )


def test_increments_do_not_add_up_their_rounding():
    steps = "".join("G1 X0.3333 Y0.1\n" for _ in range(60))
    text = f"G21 G90\nG0 X0 Y0\nG91 F9\n{steps}"
    rewriter = Rewriter(
        wanted(MAP, Wiring(FRAME)),
        dialect="grbl",
        tolerance_m=5e-4,
        step_m=3e-4,
        decimals=3,
    )
    machine = Machine("grbl")
    for line in corrected_program(text, "a.nc", rewriter).splitlines():
        machine.run(line)
    assert np.abs(reached(machine.at[None, :2]) - [60 * 0.3333, 6]).max() < 0.6e-3


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_each_end_of_line_is_kept_and_nothing_else_ends_a_line(end):
    comment = "(next line \x85, separator \u2028 in it)"
    text = end.join(["G21 G90 G64", "G0 X0 Y0 " + comment, "G1 X40 Y20 F100", "M2", ""])
    lines = corrected(text, "linuxcnc").split(end)
    assert lines[1].endswith(comment) and not {"\r", "\n"} & set("".join(lines))
    assert lines[-2:] == ["M2", ""] and len(lines) > 5


def test_lines_without_motion_are_kept_letter_by_letter():
    out = corrected(PRINTER, "marlin").splitlines()
    kept = [line for line in PRINTER.splitlines() if not re.match("G[0-3] ", line)]
    assert [line for line in out if not re.match("G[0-3] ", line)] == kept and len(
        kept
    ) > 15


def test_the_polygon_of_few_points_stays_within_the_tolerance():
    t = np.linspace(0, 2 * np.pi, 5000)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    kept = simplified(np.exp(1j * t), 1e-3)
    assert 40 < len(kept) < 200 and farthest(circle[::13], circle[kept]) <= 1e-3 + 1e-6


def test_the_page_lists_the_known_codes_with_their_words():
    page = (Path(__file__).parents[3] / "docs/guides/controllers.md").read_text()
    rows = [
        re.split(r"\s*\|\s*", line)[1:-1]
        for line in page.splitlines()
        if line[:2] == "| "
    ]
    head = next(row for row in rows if row[1:] == list(DIALECTS))
    listed = {
        (dialect, name, words, row[0].partition(":")[0])
        for row in rows[rows.index(head) + 1 :]
        if len(row) == len(head)
        for dialect, cell in zip(DIALECTS, row[1:], strict=True)
        for names, words in re.findall(r"([GM][^;()]*)(?:\((\w+)\))?", cell)
        for name in names.split()
    }
    assert listed == {
        (dialect, code.name, code.words, code.does)
        for dialect, codes in DIALECTS.items()
        for code in codes.values()
    }
