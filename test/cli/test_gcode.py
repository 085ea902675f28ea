# SPDX-License-Identifier: Apache-2.0
"""``selfcal gcode`` from the command line."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from test.support.maps import random_map, result_of

MAP = random_map(Artifact(5, 0.01), 3)


@pytest.fixture(autouse=True)
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(MAP)))
    Path("in.nc").write_text("G0 X0 Y0 ; begin\nG1 X10 F100\n")


def run(line: str) -> int:
    return main(["gcode", *line.split()])


def test_points_are_commanded_with_the_error_added(capsys):
    assert run("in.nc R.json -o out.nc --decimals 6") == 0
    assert capsys.readouterr().out == "written: out.nc, 2 moves as 2\n"
    form = r"; command: selfcal .*\n; result: R.json\n; sha256 of the result: \w{64}\n" \
        r"G0 X(\S+) Y(\S+) ; begin\nG1 X(\S+) Y(\S+) F100\n"
    found = map(float, re.fullmatch(form, Path("out.nc").read_text()).groups())
    assert list(found) == pytest.approx([
        1e3 * MAP.gx[2, 2], 1e3 * MAP.gy[2, 2], 10 + 1e3 * MAP.gx[3, 2], 1e3 * MAP.gy[3, 2]],
        abs=6e-7)


@pytest.mark.parametrize(("options", "site", "sign"), [
    ("--home-x -10 --home-y 20", (1, 4), 1), ("--reverse-x --home-x 10", (3, 2), -1)])
def test_the_programs_zero_and_the_sense_of_the_axes(options, site, sign, capsys):
    assert run(f"in.nc R.json -o - --decimals 6 {options}") == 0
    first = capsys.readouterr().out.splitlines()[3].split()
    assert float(first[1][1:]) == pytest.approx(sign * 1e3 * MAP.gx[site], abs=6e-7)
    assert float(first[2][1:]) == pytest.approx(1e3 * MAP.gy[site], abs=6e-7)


def test_inches_without_a_word_for_them_are_told(capsys):
    Path("in.nc").write_text("G0 X0.3937007874 Y0\n")
    assert run("in.nc R.json -o - --unit in --json --decimals 7") == 0
    word = json.loads(capsys.readouterr().out)["program"].splitlines()[3].split()[1]
    assert float(word[1:]) * 0.0254 == pytest.approx(0.01 + MAP.gx[3, 2], abs=1e-10)


@pytest.mark.parametrize(("line", "message"), [
    ("in.nc R.json -o in.nc", "in.nc: would be overwritten"),
    ("in.nc R.json -o o.nc --tolerance 0", "--tolerance, --decimals: 0.0 um, 5; give"),
    ("in.nc R.json -o o.nc --decimals 12", "--tolerance, --decimals: 1.0 um, 12; give"),
    ("bad.nc R.json -o o.nc", "bad.nc:1: G92 moves the coordinates")])
def test_what_is_not_possible_is_one_line(capsys, line, message):
    Path("bad.nc").write_text("G92 X0 Y0\n")
    assert run(line) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"selfcal gcode: {message}") and err.count("\n") == 1
    assert not Path("o.nc").exists()


def test_not_qualified_is_code_5(capsys):
    write_json("R.json", result_to_dict(replace(result_of(MAP), verdict=Verdict(
        Grade.NOT_QUALIFIED, sentence="Not qualified: too noisy."))))
    assert run("in.nc R.json -o o.nc") == 5
    assert "too noisy" in capsys.readouterr().err and Path("o.nc").exists()
