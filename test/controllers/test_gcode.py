# SPDX-License-Identifier: Apache-2.0
"""Corrected programs: their words, and the path of a stage that runs them."""

import random
import re
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.controllers.gcode import Rewriter, commented, corrected_program, simplified
from selfcal_ros.controllers.grid import Wiring, wanted
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.maps import random_map
from test.support.programs import farthest, run_program

MAP = random_map(Artifact(11, 0.01), 4, gain=20.0)  # errors of some 5 um, from site to site
FRAME = MachineFrame(unit="m", home_x_m=-0.03, home_y_m=0.005)

MILL = """%
O1234 (pocket, 4 mm mill)
N10 G21 G17 G90 G94 G54
N20 T1 M6
N30 S12000 M3
N40 G0 X0. Y0. Z5.
N50 G1 Z-1. F200 ; plunge
N60 G1 X40. Y0. F800
N70 X50. Y10. M8 (coolant on the way)
N80 G3 X40. Y20. I-10. J0.
N90 X30. Y10. R10.
N100 G2 X30. Y10. I5. J5.
/N110 G1 X0.
N120 G91
N130 X5. Y2.5
N140 Y-20. Z-.5
N150 G90 G0 Z5.
N160 G81 X10. Y10. Z-3. R1. F100
N170 X20.
N180 G80
N190 G0 X0. Y0. M5
N200 G1 X40. Y-20. M2
%
"""
LASER = """; made by hand (GRBL)
$H
G20
G90
M4 S0
G0 X0Y0
G1X1.5Y0S500F100
X1.5Y0.75
G2X0.5Y0.75I-0.5J0
G3 X-0.25 Y0 R-0.75
g1 x0 y0
M5
"""
PRINTER = """; FLAVOR:Marlin
M117 Printing, layer 1
START_PRINT BED=60
G28
M83
G90
G92 E0
G1 Z0.2 F3000
G0 X-20 Y-20
G1 X60 Y-20 E2.5 F1800
G1 Y25 E1.25
G1 X-20.000 E2.5;infill
G1 F600 E-1
M82
G92 E0
G1 X10 Y10 E1.5
G1 X-15 Y-15 E3
"""


def corrected(text: str, error_map=MAP, frame=FRAME, *, um=1.0, decimals=6, **kwargs) -> str:
    rewriter = Rewriter(wanted(error_map, Wiring(frame)), tolerance_m=um * 1e-6,
                        step_m=error_map.artifact.grid_pitch_m / 32, decimals=decimals, **kwargs)
    return corrected_program(text, "a.nc", rewriter).text


def true_path(points: np.ndarray, error_map=MAP, frame=FRAME) -> np.ndarray:
    """Return where the stage really goes when these positions are commanded."""
    x, y = Compensator(error_map).correct(*frame.from_machine(*points.T))
    return np.stack(frame.to_machine(x, y), axis=1)


def check_path(text: str, out: str, tolerance: float, **machine) -> int:
    """Compare the true path of a corrected program with the programmed one; return the pieces."""
    wanted_moves, made = run_program(text), run_program(out)
    at = 0
    for motion, ideal in wanted_moves:
        pieces = []
        while True:  # up to the end of this move
            pieces.append(true_path(made[at][1], **machine))
            at += 1
            if np.hypot(*(pieces[-1][-1] - ideal[-1])) < 2e-9:
                break
        assert motion in ("2", "3") or made[at - 1][0] == motion
        way = np.concatenate(pieces)
        assert farthest(way[::5], ideal) < tolerance
        assert farthest(ideal[::9], np.concatenate([ideal[:1], way])) < tolerance
    assert at == len(made)
    return at


@pytest.mark.parametrize("um", [0.5, 2.0])
@pytest.mark.parametrize("program", [MILL, LASER, PRINTER], ids=["mill", "laser", "printer"])
def test_the_stage_follows_the_programmed_path(program, um):
    out = corrected(program, um=um)
    pieces = check_path(program, out, um * 1e-6 + 2e-9)
    moves = len(run_program(program))
    assert moves < pieces < 3000
    uncorrected = [true_path(points) for _, points in run_program(program)]
    off = max(np.hypot(*(way[-1] - ideal[-1])) for way, (_, ideal) in zip(
        uncorrected, run_program(program), strict=True))
    assert off > 3e-6  # without the correction its ends are off


@pytest.mark.parametrize("frame", [
    MachineFrame(unit="m", home_x_m=0.01, reverse_x=True),
    MachineFrame(unit="m", home_y_m=-0.02, reverse_y=True)])
def test_each_sense_of_the_axes_counts(frame):
    out = corrected(LASER, frame=frame)
    check_path(LASER, out, 1e-6 + 2e-9, frame=frame)
    last = run_program(out)[-1][1]  # back at the program's zero
    assert np.abs(true_path(last, frame=frame)[-1]).max() < 2e-9
    for wrong in (FRAME, MachineFrame(unit="m"), replace(frame, reverse_x=not frame.reverse_x),
                  replace(frame, reverse_y=not frame.reverse_y)):
        assert np.abs(true_path(last, frame=wrong)[-1]).max() > 3e-7


def words_of(text: str, drop: str = "") -> list[str]:
    text = re.sub(r"(?i)([XYZE])\s*[-+.\d]+", r"\1", text)
    return [w for w in re.findall(r"\(.*?\)|;.*|[A-Za-z_]+[-+.\d]*|\S", text) if w[0] not in drop]


@pytest.mark.parametrize("program", [MILL, LASER, PRINTER], ids=["mill", "laser", "printer"])
def test_words_comments_and_order_are_kept(program):
    """Of each line all but coordinates, arcs and the words of added pieces."""
    rewriter = Rewriter(wanted(MAP, Wiring(FRAME)), tolerance_m=1e-6, step_m=3e-4)
    for number, line in enumerate(program.splitlines(), 1):
        first, *more = rewriter.line(line, f"a.nc:{number}")
        arc = [w for w in words_of(line) if w in ("G2", "G3")]
        kept = words_of(line, "XYIJRxyijr" if re.search("[IJR]", line) and not (
            "G81" in line or "PRINT" in line) else "XYxy")
        there = words_of(first, "XYxy")
        moved = {"M2"} & set(kept) if more else set()
        assert [w for w in there if w != "G1" or not arc] == [
            w for w in kept if w not in (*arc, *moved)], line
        for piece in more:
            assert re.fullmatch(r"X\S+ Y\S+( Z\S+)?( E\S+)?( M2)?", piece), piece
        assert (more[-1].endswith(" M2") if more else True) == (not more or "M2" in line)


def test_lines_without_motion_are_kept_letter_by_letter():
    out = corrected(PRINTER).splitlines()
    for line in PRINTER.splitlines():
        if not re.search("[XY]", line.partition(";")[0]) or "PRINT" in line or "M117" in line:
            assert line in out


def test_other_axes_share_a_split_move():
    out = corrected(PRINTER, um=0.3)
    relative, absolute = out.split("M82")
    lines = [line for line in relative.splitlines() if "E" in line and "X" in line
             and not line.startswith("START")]
    given = [float(e) for line in lines for e in re.findall(r"E([-.\d]+)", line)]
    assert len(given) > 10 and sum(given) == pytest.approx(6.25, abs=1e-9)
    e = [float(v) for v in re.findall(r"E([-.\d]+)", absolute)][1:]
    assert e[-1] == 3 and 1.5 in e and len(e) > 5 and e == sorted(e)
    xs = [float(v) for v in re.findall(r"X([-.\d]+)", absolute)]
    for x, value in zip(xs[e.index(1.5):], e[e.index(1.5):], strict=True):
        assert value == pytest.approx(1.5 + 1.5 * (10 - x) / 25, abs=2e-3)


def test_increments_do_not_add_up_their_rounding():
    steps = "".join("G1 X0.3333 Y0.1\n" for _ in range(60))
    out = corrected(f"G90\nG0 X0 Y0\nG91\n{steps}", decimals=3, um=500.0)
    ends = [points[-1] for _, points in run_program(out)]
    reached = true_path(np.array([ends[-1]]))[0]
    assert np.abs(reached - [60 * 0.3333e-3, 6e-3]).max() < 0.6e-6


@pytest.mark.parametrize(("text", "message"), [
    ("G91\nG1 X5 Y5", "a.nc:2: the position before this line is not known"),
    ("G1 X5", "a.nc:1: the position before this line is not known"),
    ("G0 X0 Y0\nG28\nG1 X5", "a.nc:3: the position before this line is not known"),
    ("G10 L2 P1 X0", "a.nc:1: G10 moves the coordinates"),
    ("G92 X0", "a.nc:1: G92 moves the coordinates"),
    ("G54\nG0 X0 Y0\nG55", "a.nc:3: G55 changes the origin"),
    ("G53 G0 X0", "a.nc:1: G53 uses machine coordinates"), ("G41 D1", "a.nc:1: G41 offsets"),
    ("G1 X#1 Y0", "a.nc:1: 'X' is not part of a word"), ("G1 X[1+2]", "a.nc:1: 'X' is not"),
    ("G1 X1 X2 Y0", "a.nc:1: a coordinate is given twice"),
    ("G0 X0 Y0\nG2 X10 Y0 R4", "a.nc:2: no arc of this radius"),
    ("G0 X0 Y0\nG2 X10 Y0 R4.99999", "a.nc:2: no arc of this radius"),
    ("G0 X0 Y0\nG2 R5", "a.nc:2: no arc of this radius"),
    ("G0 X0 Y0\nG2 X10 Y0 I4 J0", "a.nc:2: the ends of the arc are not equally far"),
    ("G0 X0 Y0\nG2 X10.0051 Y0 I5", "a.nc:2: the ends of the arc are not equally far"),
    ("G0 X0 Y0\nG2 X10 I5\nX20 Y5", "a.nc:3: the arc has no I, J or R; give its centre, or"),
    ("G0 X0 Y0 Z0\nG3 X10 I5\nZ5", "a.nc:3: the arc has no I, J or R"),
    ("G90.1\nG0 X0 Y0\nG2 X10 Y0 I5", "a.nc:3: G90.1 needs I and J; give its"),
    ("G7.1 C50", "a.nc:1: G7.1 wraps the plane round a cylinder"),
    ("G12.1", "a.nc:1: G12.1 uses polar coordinates"), ("G112", "a.nc:1: G112 uses polar"),
    ("G0 X0 Y0\nG187 X1", "a.nc:2: G187 is not known, and may mean something else by X and Y"),
    ("G0 X0 Y0\nG28.2 X0 Y0\nG1 X5", "a.nc:3: the position before this line is not known"),
    ("G18\nG0 X0 Y0\nG2 X1 Y0 I.5", "a.nc:3: the arc is not one turn in the XY plane"),
    ("G2 X1 Y0 I1", "a.nc:1: the arc is not one turn in the XY plane from a known point"),
    ("G0 X0 Y0\nG1 X60 Y20 Z1", "a.nc:2: Z before this line is not known, and the move is"),
    ("G0 X0 Y0\nG81 X1 Y1 Z-1 R1 L3", "a.nc:2: a cycle is repeated"),
    ("G0 X0 Y0\nG1 X900000000 Y0", "a.nc:2: the move is too long")])
def test_what_cannot_be_corrected_is_one_line(text, message):
    with pytest.raises(InputError) as raised:
        corrected(text + "\n")
    assert str(raised.value).startswith(message) and "\n" not in str(raised.value)


def test_dwell_subprograms_and_homing():
    text = "G0 X0 Y0\nG4 X2.5\nG28 Z0\nX1 Y1\nM98 P100\nG0 X2 Y2\n"
    out = corrected(text).splitlines()
    assert (out[1], out[2], out[4]) == ("G4 X2.5", "G28 Z0", "M98 P100")
    assert out[0] != "G0 X0 Y0" and out[3] != "X1 Y1"


def test_homing_and_words_without_coordinates_are_kept():
    kept = ["G28.2 X0 Y0", "G187 P2", "G30 X0 Y0", "G4 X1"]
    out = corrected("G0 X10 Y10\n" + "\n".join(kept) + "\nG1 X5 Y5\n").splitlines()
    assert out[1:5] == kept and out[0] != "G0 X10 Y10" and out[5] != "G1 X5 Y5"


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_each_end_of_line_is_kept_and_nothing_else_ends_a_line(end):
    comment = "(form feed \x0c, next line \x85, separator \u2028 in it)"
    out = corrected(end.join(["G0 X0 Y0 " + comment, "G1 X40 Y20 F100", "M2", ""]))
    assert comment in out
    lines = out.split(end)
    assert not {"\r", "\n"} & set("".join(lines))
    assert lines[-2:] == ["M2", ""] and len(lines) > 4
    assert commented(out, ["first"]).split(end)[0] == "(first)"


def test_a_move_of_one_axis_gets_the_other_as_well():
    _, second = corrected("G0 X10 Y10\nG0 X20 (only x) F5\n").splitlines()
    point = np.array([20e-3, 10e-3])
    x, y = wanted(MAP, Wiring(FRAME))(*point)
    match = re.fullmatch(r"G0 X(\S+) Y(\S+) \(only x\) F5", second)
    assert [float(v) * 1e-3 for v in match.groups()] == pytest.approx(
        [point[0] + x, point[1] + y], abs=1e-9)


def test_a_circle_is_run_once():
    out = run_program(corrected("G0 X10 Y0\nG2 X10 Y0 I-10 J0\n", um=5.0))
    ends = np.array([points[-1] for _, points in out])
    length = np.hypot(*np.diff(ends, axis=0).T).sum()
    assert length == pytest.approx(2 * np.pi * 10e-3, rel=1e-2) and ends[1, 1] < ends[0, 1]


def test_line_ends_are_kept_and_absolute_centres_understood():
    text = "G90.1\r\nG0 X0 Y0\r\nG3 X10 Y0 I5 J0\r\nG91.1\r\nG3 X0 Y0 I-5 J0"
    out = corrected(text)
    assert out.count("\n") == out.count("\r\n") and not out.endswith("\n")
    y = [float(v) for v in re.findall(r"Y([-.\d]+)", out)]
    assert min(y) < -4.9 and max(y) > 4.9


def test_the_polygon_of_few_points_stays_within_the_tolerance():
    t = np.linspace(0, 2 * np.pi, 5000)
    circle = np.stack([np.cos(t), np.sin(t)], axis=1)
    kept = simplified(circle, 1e-3)
    assert 40 < len(kept) < 200 and farthest(circle[::13], circle[kept]) <= 1e-3 + 1e-6


def test_a_damaged_program_is_corrected_or_refused_in_one_line():
    rng, refused = random.Random(3), 0
    for program in (MILL, LASER, PRINTER):
        for _ in range(100):
            at = rng.randrange(len(program))
            text = program[:at] + rng.choice(["", "X", "#", "G91", "\n", "9", "-", "G2", "é", "("]
                                             ) + program[at + rng.randrange(3):]
            try:
                corrected(text, um=50.0)
            except InputError as error:
                refused += 1
                assert str(error).startswith("a.nc:") and "\n" not in str(error)
    assert 20 < refused < 280
