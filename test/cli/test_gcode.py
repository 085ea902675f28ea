# SPDX-License-Identifier: Apache-2.0
"""``selfcal gcode`` from the command line."""

import json
import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.result import ArtifactMap, result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from test.support.maps import random_map, result_of

MAP = random_map(Artifact(5, 0.01), 3)
SAID = "G21 G90\n"


@pytest.fixture(autouse=True)
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(MAP)))
    Path("in.nc").write_text(f"{SAID}G0 X0 Y0 ; begin\nG1 X10 F100\n")


def run(line: str) -> int:
    return main(["gcode", "--dialect", "grbl", *line.split()])


def test_points_are_commanded_with_the_error_added(capsys):
    assert run("in.nc R.json -o out.nc --decimals 6") == 0
    assert capsys.readouterr().out == "written: out.nc, 2 moves as 2\n"
    form = (
        r"; command: selfcal .*\n; result: R.json\n; sha256 of the result: \w{64}\n"
        r"G21 G90\nG0 X(\S+) Y(\S+) ; begin\nG1 X(\S+) Y(\S+) F100\n"
    )
    found = map(float, re.fullmatch(form, Path("out.nc").read_text()).groups())
    assert list(found) == pytest.approx(
        [
            1e3 * MAP.gx[2, 2],
            1e3 * MAP.gy[2, 2],
            10 + 1e3 * MAP.gx[3, 2],
            1e3 * MAP.gy[3, 2],
        ],
        abs=6e-7,
    )


@pytest.mark.parametrize(
    ("options", "site", "sign"),
    [("--home-x -10 --home-y 20", (1, 4), 1), ("--reverse-x --home-x 10", (3, 2), -1)],
)
def test_the_programs_zero_and_the_sense_of_the_axes(options, site, sign, capsys):
    assert run(f"in.nc R.json -o - --decimals 6 {options}") == 0
    first = capsys.readouterr().out.splitlines()[4].split()
    assert float(first[1][1:]) == pytest.approx(sign * 1e3 * MAP.gx[site], abs=6e-7)
    assert float(first[2][1:]) == pytest.approx(1e3 * MAP.gy[site], abs=6e-7)


def test_the_json_has_the_program_and_the_unit_is_that_of_home_alone(capsys):
    Path("in.nc").write_text("G90 G21\nG0 X10 Y0\n")
    assert (
        run("in.nc R.json -o - --unit in --home-x 0.3937007874 --json --decimals 7")
        == 0
    )
    word = json.loads(capsys.readouterr().out)["program"].splitlines()[4].split()[1]
    assert float(word[1:]) / 1e3 == pytest.approx(0.01 + MAP.gx[4, 2], abs=1e-9)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("in.nc R.json -o in.nc", "in.nc: would be overwritten"),
        (
            "in.nc R.json -o o.nc --tolerance 0",
            "--tolerance, --decimals: 0.0 µm, 5; give",
        ),
        (
            "in.nc R.json -o o.nc --decimals 12",
            "--tolerance, --decimals: 1.0 µm, 12; give",
        ),
        (
            "in.nc R.json -o o.nc --decimals 2",
            "--decimals: 2 round by more than 1 µm; give more",
        ),
        ("bad.nc R.json -o o.nc", "bad.nc:1: G92 is not in the list of codes"),
    ],
)
def test_what_is_not_possible_is_one_line(capsys, line, message):
    Path("bad.nc").write_text("G92 X0 Y0\n")
    assert run(line) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"selfcal gcode: {message}") and err.count("\n") == 1
    assert not Path("o.nc").exists()


@pytest.mark.parametrize(("gain", "um"), [(20, 0.05), (400, 1.0)])
def test_the_path_is_within_the_tolerance_however_sharply_the_map_bends(
    gain, um, capsys
):
    """Errors of up to 0.2 mm that change from site to site, on ways across many cells."""
    bent = random_map(Artifact(11, 0.01), 4, gain=gain)
    write_json("R.json", result_to_dict(result_of(bent)))
    stage, worst = Compensator(bent), 0.0
    for begin, end in [
        ((-41, -33), (44, 39)),
        ((-45, 20), (43, 9)),
        ((12, -40), (-7, 44)),
    ]:
        Path("in.nc").write_text(
            f"{SAID}G0 X{begin[0]} Y{begin[1]}\nG1 X{end[0]} Y{end[1]} F9\n"
        )
        assert run(f"in.nc R.json -o - --decimals 7 --tolerance {um} --steep") == 0
        words = re.findall(r"X(\S+) Y(\S+)", capsys.readouterr().out)
        points = np.array(words, float) * 1e-3
        way = np.concatenate(
            [a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in pairwise(points)]
        )
        way = np.stack(stage.correct(*way.T), axis=1)
        along = np.subtract(end, begin) / math.dist(begin, end)
        across = (way - np.multiply(begin, 1e-3)) @ [-along[1], along[0]]
        worst = max(worst, np.abs(across).max())
    assert 0.5e-6 * um < worst < 1.02e-6 * um


@pytest.mark.parametrize("unknown", [False, True])
def test_between_the_nodes_of_a_spline_the_path_is_that_of_the_spline(unknown, capsys):
    """As `apply` and the compensator use it, linearly where a node was filled."""
    emap = MAP
    if unknown:
        gx, gy = MAP.gx.copy(), MAP.gy.copy()
        gx[0, 0] = gy[0, 0] = np.nan
        emap = replace(MAP, gx=gx, gy=gy)
    plate = Artifact(7, 0.01, map_grid=MapGrid(5, 0.01))
    marks = ArtifactMap(np.zeros((7, 7)), np.zeros((7, 7)), np.zeros(0))
    result = replace(result_of(emap), placed_plate=plate, artifact_map=marks)
    write_json("R.json", result_to_dict(result))
    Path("in.nc").write_text(f"{SAID}G0 X5 Y-3\n")
    assert run(f"in.nc R.json -o - --decimals 7{' --fill' * unknown}") == 0
    found = re.findall(r"X(\S+) Y(\S+)", capsys.readouterr().out)[-1]
    ways = [Compensator(MAP, method=way) for way in ("bicubic", "bilinear")]
    spline, linear = (1e3 * np.array(way.command(0.005, -0.003)) for way in ways)
    assert np.abs(spline - linear).max() > 5e-6
    expected = linear if unknown else spline
    assert list(map(float, found)) == pytest.approx(expected, abs=2e-7)


def test_not_qualified_is_code_5(capsys):
    write_json(
        "R.json",
        result_to_dict(
            replace(
                result_of(MAP),
                verdict=Verdict(
                    Grade.NOT_QUALIFIED, sentence="Not qualified: too noisy."
                ),
            )
        ),
    )
    assert run("in.nc R.json -o o.nc") == 5
    assert "too noisy" in capsys.readouterr().err and Path("o.nc").exists()


def test_a_dialect_must_be_named(capsys):
    with pytest.raises(SystemExit) as left:
        main(["gcode", "in.nc", "R.json", "-o", "o.nc"])
    assert left.value.code == 2 and "--dialect" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("end", "leaves"), [("20", False), ("20.001", True), ("-20.5", True)]
)
def test_moves_beyond_the_field_are_named(end, leaves, capsys):
    """The field is 40 mm wide."""
    Path("in.nc").write_text(f"{SAID}G0 X0 Y0\nG0 X{end}\n")
    assert run("in.nc R.json -o o.nc") == 0
    assert ("in.nc: moves leave the field" in capsys.readouterr().err) == leaves
    assert ("; moves leave the field" in Path("o.nc").read_text()) == leaves


@pytest.mark.parametrize(
    ("program", "options", "span"),
    [
        ("G21 G90\nG0 X25 Y1\nG0 X70\n", "", "x from 25 to 70 mm, y from 1 to 1 mm"),
        ("G20 G90\nG0 X-10 Y1\n", "", "x from -254 to -254 mm, y from 25.4 to 25.4 mm"),
        (SAID + "G0 X0 Y0\n", "--home-y 0.5 --unit in", None),
        (SAID + "G0 X0 Y0\n", "--home-y 25 --reverse-y", "y from 0 to 0 mm"),
    ],
)
def test_a_program_that_never_enters_the_field_is_refused(
    program, options, span, capsys
):
    """Its zero or its unit is another one: the edge's error would be nobody's."""
    Path("in.nc").write_text(program)
    assert run(f"in.nc R.json -o o.nc {options}") == (0 if span is None else 2)
    said = capsys.readouterr().err
    assert ("in.nc: all moves lie outside the field (x from " in said) == bool(span)
    assert (span or "") in said and Path("o.nc").exists() == (span is None)
