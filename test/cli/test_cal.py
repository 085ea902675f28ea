# SPDX-License-Identifier: Apache-2.0
import json
import math
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.read import load_cal
from selfcal_ros.cli.main import main
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import Observability, result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from test.support.maps import random_map, result_of

MAP = random_map(Artifact(7, 0.01, 24), 11)
CAL_1D = """\
:START 1 POSUNIT=PRIMARY CORUNIT=PRIMARY/1000 SAMPLEDIST=10 EXPANDCOEFF=1e-5 MATERIALTEMP=20
:START HOMEDIRECTION=CW HOMEOFFSET=0 FULLTRAVEL=100
0
4
-6
:END
"""


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """Run the command in a folder with RESULT.json; return code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    write_json("r.json", result_to_dict(result_of(MAP)))

    def call(*args):
        try:
            code = main(["cal", *args])
        except SystemExit as bad:
            code = bad.code
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return call


def one_line(err, *parts):
    assert err.startswith("selfcal cal") and err.count("\n") == 1
    assert all(part in err for part in parts)


def test_export_check_eval_verify(run):
    code, out, err = run(
        "export", "r.json", "-o", "f.cal", "--x-axis", "1", "--y-axis", "2"
    )
    first, asks, *steps = out.splitlines()
    assert (code, first, asks, err) == (
        0,
        "f.cal: 2D table for x and y",
        "to put it into use:",
        "",
    )
    assert "CalibrationLoad()" in steps[0] and "Position Calibration All" in steps[2]
    assert "the correction is largest at x = " in steps[3]
    code, out, _ = run("check", "f.cal", "--strict")
    assert code == 0 and out.endswith(
        "f.cal: 1 table, 0 errors, 0 warnings, 0 tolerated\n"
    )
    code, out, _ = run("eval", "f.cal", "--position", "1=10", "--position", "2=-30")
    bias = MAP.gx[3, 3], MAP.gy[3, 3]
    got = json.loads(out)
    assert code == 0 and list(got) == ["1", "2"]
    assert got["1"] == pytest.approx((MAP.gx[4, 0] - bias[0]) * 1e3, abs=1.1e-8)
    assert got["2"] == pytest.approx((MAP.gy[4, 0] - bias[1]) * 1e3, abs=1.1e-8)
    code, out, _ = run("verify", "r.json", "f.cal", "--plot", "f.png")
    assert code == 0 and "49 sites, rms, µm" in out and "36 cell centres" in out
    before, after = (float(word) for word in out.splitlines()[2].split()[-2:])
    assert after < 1e-4 < 0.1 < before
    with open("f.png", "rb") as file:
        assert file.read(8) == b"\x89PNG\r\n\x1a\n"
    found = json.loads(run("verify", "r.json", "f.cal", "--json")[1])
    assert found["sites"]["before"]["max"] == pytest.approx(before * 1e-6, abs=1e-12)
    assert found["sites"]["after"]["max"] < 1e-10 and found["between"]["points"] == 36


@pytest.mark.parametrize(
    "wiring",
    [
        ["--home-x", "-30", "--home-y", "-30"],
        ["--reverse-x", "--unit", "um", "--home-y", "5e3"],
        ["--reverse-y", "--unit", "m", "--x-axis", "5", "--y-axis", "4"],
    ],
)
def test_verify_takes_the_wiring_from_the_file(run, wiring):
    assert run("export", "r.json", "-o", "f.cal", *wiring)[0] == 0
    code, out, _ = run("verify", "r.json", "f.cal", "--json")
    assert code == 0 and json.loads(out)["sites"]["after"]["max"] < 1e-10


def test_verify_of_a_file_without_our_comments_takes_options(run):
    run("export", "r.json", "-o", "f.cal", "--unit", "um", "--home-x", "1000")
    with open("f.cal") as file:
        bare = "".join(line for line in file if not line.startswith(";"))
    with open("bare.cal", "w") as file:
        file.write(bare)
    code, out, _ = run(
        "verify", "r.json", "bare.cal", "--unit", "um", "--home-x", "1000", "--json"
    )
    assert code == 0 and json.loads(out)["sites"]["after"]["max"] < 1e-10
    wrong = json.loads(run("verify", "r.json", "bare.cal", "--unit", "um", "--json")[1])
    assert wrong["sites"]["after"]["max"] > 1e-8


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("home-x=0", "home-x=nan", "home position: nan is not a position"),
        (
            "theta-counts-per-unit=1000",
            "theta-counts-per-unit=0",
            "0.0 is not a positive number",
        ),
        ("y-axis=2", "y-axis=1", "the indices [1, 1, 3] are not distinct"),
    ],
)
def test_a_wiring_in_the_file_without_sense_is_named(run, tmp_path, old, new, message):
    run(
        "export",
        "r.json",
        "-o",
        "f.cal",
        "--theta-axis",
        "3",
        "--counts-per-unit",
        "3=1000",
    )
    text = (tmp_path / "f.cal").read_text()
    assert text.count(old) == 1
    (tmp_path / "f.cal").write_text(text.replace(old, new))
    code, _, err = run("verify", "r.json", "f.cal")
    assert code == 2
    one_line(err, message)


def test_a_file_with_the_wrong_sign_is_refused_by_verify(run):
    run("export", "r.json", "-o", "f.cal")
    with open("f.cal") as file:
        text = file.read()
    with open("bad.cal", "w") as file:
        file.write(
            text.replace(":START2D CORUNIT", ":START2D NEGCOR\n:START2D CORUNIT")
        )
    code, out, err = run("verify", "r.json", "bad.cal")
    assert code == 2 and "49 sites" in out
    one_line(err, "bad.cal: the tables make the machine worse; check signs")


@pytest.mark.parametrize(
    "option, text",
    [("--home-x", "5_0"), ("--home-x", "٥"), ("--x-axis", "1_1"), ("--x-axis", "٣")],
)
def test_an_option_is_a_plain_number(run, option, text):
    """Python's float() and int() read 5_0 as 50 and the digits of every script."""
    code, _, err = run("export", "r.json", "-o", "f.cal", option, text)
    assert code == 2
    one_line(err, f"{option}: ", "is not a ")


def without_last_row(text: str) -> str:
    *rows, _, end = text.splitlines(keepends=True)
    return "".join([*rows, end])


def with_a_wrong_entry(text: str) -> str:
    """Return a file with one value of the first row wrong by 0.06 um."""
    lines = text.splitlines(keepends=True)
    row = next(number for number, line in enumerate(lines) if line[0] in "-0123456789")
    first, rest = lines[row].split(" ", 1)
    lines[row] = f"{float(first) + 0.06:.5f} {rest}"
    return "".join(lines)


@pytest.mark.parametrize(
    "spoil",
    [
        with_a_wrong_entry,
        lambda text: text.replace("CORUNIT=PRIMARY/1000", "CORUNIT=PRIMARY/1000000"),
        lambda text: text.replace("OFFSETROW=30", "OFFSETROW=35"),
        lambda text: text.replace("=30\n", "=-30\n"),
        without_last_row,
    ],
)
def test_a_table_that_is_not_that_of_the_map_does_not_pass(run, tmp_path, spoil):
    """None of these makes the machine worse."""
    run("export", "r.json", "-o", "f.cal")
    right = (tmp_path / "f.cal").read_text()
    (tmp_path / "bad.cal").write_text(spoil(right))
    assert spoil(right) != right and run("check", "bad.cal")[0] == 0
    code, out, err = run("verify", "r.json", "bad.cal")
    assert code == 5 and "49 sites" in out
    one_line(
        err,
        "bad.cal: the tables leave ",
        "% of the error at the sites",
        "they are not those of this map; check offset, unit",
    )


def test_a_theta_table_that_does_nothing_does_not_pass(run, tmp_path):
    run("export", "r.json", "-o", "f.cal", "--theta-axis", "3")
    right = (tmp_path / "f_theta.cal").read_text()
    (tmp_path / "bad.cal").write_text(right.replace("PRIMARY/3600", "PRIMARY/3600000"))
    assert run("verify", "r.json", "f_theta.cal")[0] == 0
    code, _, err = run("verify", "r.json", "bad.cal")
    assert code == 5
    one_line(err, "bad.cal: the tables leave 100 % of the error at the lines")


def test_theta_goes_into_a_file_of_its_own(run):
    code, out, err = run("export", "r.json", "-o", "f.cal", "--theta-axis", "3")
    assert code == 0 and out.splitlines()[:2] == [
        "f.cal: 2D table for x and y",
        "f_theta.cal: 1D table for theta",
    ]
    one_line(err, "--counts-per-unit 3=COUNTS makes it roll over")
    (table,) = load_cal("f_theta.cal").tables
    assert table.rollover is None and len(table.values) == 49
    code, out, err = run(
        "export",
        "r.json",
        "-o",
        "g.cal",
        "--theta-axis",
        "3",
        "--theta-output",
        "t.cal",
        "--counts-per-unit",
        "3=1000",
    )
    assert code == 0 and err == ""
    (table,) = load_cal("t.cal").tables
    assert table.rollover == 360_000 and len(table.values) == 25
    code, out, _ = run(
        "eval", "t.cal", "--position", "3=-345", "--counts-per-unit", "3=1000"
    )
    want = math.degrees(MAP.g_theta[1] - MAP.g_theta[0])
    assert code == 0 and json.loads(out) == {"3": pytest.approx(want, abs=1e-8)}
    code, out, _ = run("verify", "r.json", "t.cal")
    assert code == 0 and "24 angular lines, rms, arcsec" in out
    code, _, err = run(
        "export",
        "r.json",
        "-o",
        "h.cal",
        "--theta-axis",
        "3",
        "--theta-output",
        "./h.cal",
    )
    assert code == 2
    one_line(err, "a 1D and a 2D table cannot share a file")


def test_existing_files_stay_and_are_kept(run, tmp_path):
    (tmp_path / "f_theta.cal").write_text("old")
    code, _, err = run("export", "r.json", "-o", "f.cal", "--theta-axis", "3")
    assert code == 2 and not (tmp_path / "f.cal").exists()
    one_line(err, "f_theta.cal: the file exists")
    code, out, _ = run(
        "export", "r.json", "-o", "f.cal", "--theta-axis", "3", "--force"
    )
    (backup,) = tmp_path.glob("f_theta.cal.*.bak")
    assert (
        code == 0
        and backup.read_text() == "old"
        and f"the old file is {backup.name}" in out
    )


def test_results_that_cannot_be_exported(run):
    holes = random_map(Artifact(7, 0.01, 24), 11, unknown=[(0, 0), (3, 2)])
    write_json("holes.json", result_to_dict(result_of(holes)))
    code, _, err = run("export", "holes.json", "-o", "f.cal")
    assert code == 2
    one_line(err, "2 sites are unknown, and a table has no holes")
    code, _, err = run("export", "holes.json", "-o", "f.cal", "--fill")
    assert code == 0
    one_line(err, "2 unknown sites filled")
    assert any("2 sites were not measured" in c for c in load_cal("f.cal").comments)
    unseen = replace(result_of(MAP), observability=Observability(1, 2, 1, False))
    write_json("unseen.json", result_to_dict(unseen))
    code, _, err = run("export", "unseen.json", "-o", "g.cal")
    assert code == 3
    one_line(err, "does not identify the stage")
    write_json(
        "o.json", result_to_dict(result_of(replace(MAP, nonorthogonality=math.nan)))
    )
    code, _, err = run("orthogonality", "o.json", "--along", "x")
    assert code == 2
    one_line(err, "its non-orthogonality is not known")


def test_files_that_are_loaded_together_are_added(run, tmp_path):
    for number, values in enumerate(("0 2 5", "0 -1 1")):
        (tmp_path / f"{number}.cal").write_text(
            f":START 1 POSUNIT=PRIMARY CORUNIT=PRIMARY SAMPLEDIST=10\n{values}\n:END\n"
        )
    code, out, _ = run("eval", "0.cal", "1.cal", "--position", "1=15")
    assert code == 0 and json.loads(out) == {"1": (2 + 5) / 2 + (-1 + 1) / 2}
    (tmp_path / "copy.cal").write_text(
        "; of another day\n" + (tmp_path / "0.cal").read_text()
    )
    for again in ("0.cal", "./0.cal", "copy.cal"):
        code, out, err = run("eval", "0.cal", "1.cal", again, "--position", "1=15")
        assert (code, out) == (2, "")
        one_line(err, f"{again}: is the same as 0.cal, and would be added twice")


def test_each_of_several_pipes_is_read_once(run, tmp_path):
    pipes = []
    for values in ("0 2 5", "0 -1 1"):
        end, start = os.pipe()
        os.write(
            start,
            f":START 1 POSUNIT=PRIMARY CORUNIT=PRIMARY SAMPLEDIST=10\n{values}\n:END\n".encode(),
        )
        os.close(start)
        pipes.append(f"/dev/fd/{end}")
    code, out, _ = run("eval", *pipes, "--position", "1=15")
    assert code == 0 and json.loads(out) == {"1": 3.5}
    for path in pipes:
        os.close(int(path.removeprefix("/dev/fd/")))


def test_verify_loads_all_files(run):
    wiring = "--x-axis", "2", "--y-axis", "1", "--theta-axis", "3"
    run("export", "r.json", "-o", "f.cal", *wiring, "--counts-per-unit", "3=1000")
    both = json.loads(run("verify", "r.json", "f.cal", "f_theta.cal", "--json")[1])
    assert list(both) == ["sites", "between", "lines"]
    assert all(
        both[place]["after"]["rms"] < 1e-2 * both[place]["before"]["rms"]
        for place in ("sites", "lines")
    )
    run("accuracy", "r.json", "--along", "x", "-o", "x.cal", *wiring[:4])
    twice = json.loads(run("verify", "r.json", "f.cal", "x.cal", "--json")[1])
    assert twice["sites"]["after"]["rms"] > 1e2 * both["sites"]["after"]["rms"]
    run(
        "accuracy",
        "r.json",
        "--along",
        "x",
        "-o",
        "other.cal",
        *wiring[:4],
        "--home-x",
        "5",
    )
    code, _, err = run("verify", "r.json", "f.cal", "other.cal")
    assert code == 2
    one_line(
        err,
        "the tables are for different axes, 'machine: x-axis=2 y-axis=1 unit=mm home-x=5",
    )


@pytest.mark.parametrize(
    "verb", ["export", "orthogonality", "accuracy", "straightness"]
)
def test_a_table_of_a_result_that_is_not_qualified_says_so_everywhere(run, verb):
    why = "the plate slipped: measure it again"
    doubted = Verdict(
        Grade.NOT_QUALIFIED, sentence=f"Not qualified: {why}", reasons=(why,)
    )
    write_json("r.json", result_to_dict(replace(result_of(MAP), verdict=doubted)))
    along = [] if verb == "export" else ["--along", "x"]
    code, out, err = run(verb, "r.json", *along, "-o", "f.cal")
    assert (code, err) == (5, f"selfcal: Not qualified: {why}\n")
    assert out.startswith("f.cal: ")
    comments = load_cal("f.cal").comments
    assert "verdict: NOT QUALIFIED" in comments
    assert f"because: {why}" in comments
    code, _, err = run(verb, "r.json", *along, "-o", "f.cal")
    assert code == 2
    one_line(err, "f.cal: ")  # it is there; nothing was handed on


@pytest.mark.parametrize("grade", [Grade.GOOD, Grade.ENLARGED])
def test_a_table_names_what_its_uncertainty_assumes(run, grade):
    said = Verdict(grade, sentence="Good; U assumes a plate that bends by 0.005 µm")
    write_json("r.json", result_to_dict(replace(result_of(MAP), verdict=said)))
    assert run("export", "r.json", "-o", "f.cal")[0] == 0
    text = Path("f.cal").read_bytes().decode("ascii")
    assert "; verdict: Good; U assumes a plate that bends by 0.005 um\n" in text


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--x-axis", "0"], "--x-axis: 0 is not in 1..32"),
        (["--x-axis", "2"], "the indices [2, 2] are not distinct"),
        (["--home-x", "nan"], "--home-x: nan is not a position"),
        (
            ["--theta-axis", "3", "--counts-per-unit", "4=1000"],
            "axis 4 is not the theta axis; write",
        ),
        (
            ["--counts-per-unit", "3=1000"],
            "axis 3 is not the theta axis; name --theta-axis",
        ),
        (
            ["--theta-output", "t.cal"],
            "--theta-output: no theta table is written; name --theta-axis",
        ),
        (
            ["--home-theta", "0"],
            "--home-theta: there is no theta axis; name --theta-axis",
        ),
        (
            ["--reverse-theta"],
            "--reverse-theta: there is no theta axis; name --theta-axis",
        ),
        (
            ["--theta-axis", "3", "--counts-per-unit", "3=0"],
            "'0' is not a positive number",
        ),
        (
            ["--theta-axis", "3", "--counts-per-unit", "1000"],
            "'1000' is not AXIS=VALUE",
        ),
    ],
)
def test_options_of_export_without_sense(run, args, message):
    code, _, err = run("export", "r.json", "-o", "f.cal", *args)
    assert code == 2
    one_line(err, message)


def test_check_prints_findings_and_exits_2_for_errors(run, tmp_path):
    (tmp_path / "f.cal").write_text(
        CAL_1D.replace(":START 1", ":Start 0").replace("4", "4,0")
    )
    code, out, err = run("check", "f.cal")
    assert code == 2
    assert out.splitlines()[0].startswith(
        "f.cal:1: tolerated: a token in mixed case; write"
    )
    assert "f.cal:4: error: '4,0' is not a number; use a point as decimal mark" in out
    one_line(err, "f.cal:4: '4,0' is not a number")
    code, out, _ = run("check", "f.cal", "--json")
    assert code == 2 and json.loads(out)["errors"] == 1


def test_check_strict_refuses_what_is_tolerated(run, tmp_path):
    (tmp_path / "f.cal").write_text(CAL_1D.replace(":START 1", ":Start 1"))
    assert run("check", "f.cal")[0] == 0
    code, _, err = run("check", "f.cal", "--strict")
    assert code == 2
    one_line(err, "f.cal:1: a token in mixed case")


def test_eval_refuses_a_length_of_an_axis_that_turns(run):
    assert (
        run(
            "export",
            "r.json",
            "-o",
            "f.cal",
            "--theta-axis",
            "3",
            "--theta-output",
            "t.cal",
            "--counts-per-unit",
            "3=1000",
        )[0]
        == 0
    )
    counts = "--counts-per-unit", "3=1000"
    assert run("eval", "t.cal", "--position", "3=10", *counts)[0] == 0
    # told by where the table rolls over, or by its comments
    for text in (without_comments, str):
        code, out, err = run("eval", text("t.cal"), "--position", "3=10mm", *counts)
        assert (code, out) == (2, "")
        one_line(
            err,
            "'3=10mm' is a length, and axis 3 is rotary; write 3=10.5, in its primary unit",
        )
    assert run("export", "r.json", "-o", "g.cal", "--theta-axis", "3")[0] == 0
    code, _, err = run("eval", "g_theta.cal", "--position", "3=10mm")
    assert code == 2
    one_line(err, "'3=10mm' is a length, and axis 3 is rotary")
    assert run("eval", "f.cal", "--position", "1=10mm", "--position", "2=1")[0] == 0


def without_comments(path):
    """Return the name of a copy of a calibration file without its comments."""
    with open(path) as file:
        kept = [line for line in file if not line.startswith(";")]
    with open("bare.cal", "w") as file:
        file.writelines(kept)
    return "bare.cal"


def test_a_table_of_a_map_without_uncertainty_says_so(run):
    nan = np.full(MAP.gx.shape, np.nan)
    write_json("n.json", result_to_dict(result_of(replace(MAP, u_gx=nan, u_gy=nan))))
    assert run("export", "n.json", "-o", "n.cal")[0] == 0
    comments = load_cal("n.cal").comments
    assert any(line.strip() == "uncertainty: not computed" for line in comments)
    assert not any("nan" in line for line in comments)


def test_measured_errors_in_another_unit_are_asked_about(run, tmp_path):
    """An error of 0.4 um over 10 mm given in nm, and a square with its units exchanged."""
    (tmp_path / "nm.csv").write_text("position,error\n0,0\n10,400\n20,100\n")
    for verb, step in (("accuracy", 400), ("straightness", 350)):
        code, _, err = run(verb, "nm.csv", "-o", "x.cal")
        assert code == 2
        one_line(
            err, f"nm.csv: the error changes by {step} µm within 10 mm: is it real?"
        )
        assert not (tmp_path / "x.cal").exists()
    assert run("accuracy", "nm.csv", "--steep", "-o", "x.cal")[0] == 0
    square = ["--measured", "5mm", "--over", "200um", "--travel", "900mm"]
    for more in ([], ["--home", "end", "-o", "y.cal"]):
        code, _, err = run("orthogonality", *square, *more)
        assert code == 2
        one_line(err, "--measured: the error changes by 5000 µm within 0.2 mm")
    assert run("orthogonality", *square, "--steep")[0] == 0


def test_a_straightedge_may_be_tilted(run, tmp_path):
    """By 2 %, from which it departs by 1 um: the slope is taken off."""
    (tmp_path / "t.csv").write_text("position,error\n0,0\n10,201\n20,400\n30,600\n")
    assert run("straightness", "t.csv", "-o", "x.cal")[0] == 0
    assert run("accuracy", "t.csv", "-o", "y.cal")[0] == 2


def test_check_gi4(run, tmp_path):
    (tmp_path / "g.cal").write_text(
        ":GALVO2D 2 1 1 2 1024 1024 65\n" + ("0 " * 130 + "\n") * 65 + ":END\n"
    )
    assert run("check", "--gi4", "g.cal")[0] == 0
    (tmp_path / "p.cal").write_text(":START2D 2 1 1 2 1 1 2\n0 0 0 0\n0 0 0 0\n:END\n")
    assert run("check", "p.cal")[0] == 0
    code, _, err = run("check", "--gi4", "p.cal")
    assert code == 2 and "p.cal: it has no galvo table" in err
    code, _, err = run("check", "g.cal", "--gi4", "--scanner-bits", "20")
    assert code == 2
    one_line(err, "needs 16384, 1/64 of its range")
    assert run("check", "g.cal", "--gi4", "--scanner-bits", "99")[0] == 2
    code, out, err = run("check", "g.cal", "--scanner-bits", "20")
    assert code == 2 and not out
    one_line(err, "--scanner-bits: it belongs to a GI4; add --gi4")


@pytest.mark.parametrize(
    ("args", "want"),
    [
        (["1=10"], 4e-3),
        (["1=5"], 2e-3),
        (["1=99"], -6e-3),
        (["1=10", "--temperature", "25"], 4e-3 - 10 * 1e-5 * 5),
        (["1=110", "--home-direction", "1=CCW"], 4e-3 - 0.0),
        (["1=7", "--home-offset", "1=3"], 4e-3 - 1.2e-3),
    ],
)
def test_eval_options(run, tmp_path, args, want):
    (tmp_path / "f.cal").write_text(CAL_1D)
    code, out, err = run("eval", "f.cal", "--position", *args)
    assert (code, err) == (0, "") and json.loads(out) == {
        "1": pytest.approx(want, abs=1e-12)
    }


def test_eval_counts(run, tmp_path):
    (tmp_path / "f.cal").write_text(
        ":START 2 SAMPLEDIST=100 REFERENCEAXIS=1 ABSOLUTEFEEDBACKOFFSET=0\n0\n10\n:END\n"
    )
    code, _, err = run("eval", "f.cal", "--position", "1=1")
    assert code == 2
    one_line(err, "axis 1: POSUNIT of the table of line 1 is in counts")
    counts = ["--counts-per-unit", "1=50", "--counts-per-unit", "2=1000"]
    assert json.loads(run("eval", "f.cal", "--position", "1=1", *counts)[1]) == {
        "2": 0.005
    }
    moved = [*counts, "--absolute-feedback-offset", "1=-100"]
    assert json.loads(run("eval", "f.cal", "--position", "1=-1", *moved)[1]) == {
        "2": pytest.approx(-0.005)
    }


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "--position: no position given"),
        (["--position", "2=1"], "axis 1: its position is needed"),
        (["--position", "1"], "'1' is not AXIS=VALUE"),
        (["--position", "33=1"], "'33=1' is not AXIS=VALUE"),
        (["--position", "1=x"], "'x' is not a number"),
        (["--position", "1=1_0"], "'1_0' is not a number"),
        (["--position", "1=inf"], "'inf' is not a number"),
        (["--position", "1=1", "--position", "1=2"], "axis 1 is given twice"),
        (
            ["--position", "1=1", "--home-direction", "1=UP"],
            "'UP' is not a home direction",
        ),
        (["--position", "1=1", "--temperature", "nan"], "is not a temperature"),
        (["--position", "1=1", "--temperature", "296"], "is it in K?"),
    ],
)
def test_eval_without_sense(run, tmp_path, args, message):
    (tmp_path / "f.cal").write_text(CAL_1D)
    code, out, err = run("eval", "f.cal", *args)
    assert (code, out) == (2, "")
    one_line(err, message)


def test_the_example_of_the_source(run):
    code, out, _ = run(
        "orthogonality", "--measured", "5um", "--over", "200mm", "--travel", "900mm"
    )
    rows = [line.split() for line in out.splitlines() if line.startswith("  ")]
    assert code == 0 and "-22.5 µm" in out
    assert [row for row in rows if row[0] != "position"] == [
        ["0", "0"],
        ["900", "-22.5"],
        ["-450", "0"],
        ["450", "-22.5"],
        ["-450", "11.25"],
        ["450", "-11.25"],
    ]
    code, out, _ = run(
        "orthogonality",
        "--measured",
        "-5um",
        "--over",
        "200mm",
        "--travel",
        "900mm",
        "--home",
        "end",
        "--json",
        "--unit",
        "um",
    )
    assert json.loads(out)["tables"] == {"end": [[0.0, 0.0], [900000.0, 22.5]]}
    square = [
        "orthogonality",
        "--measured",
        "5um",
        "--over",
        "200mm",
        "--travel",
        "900mm",
    ]
    assert run(*square, "--home", "middle", "-o", "o.cal")[0] == 0
    (table,) = load_cal("o.cal").tables
    assert (table.axis, table.reference, table.offset) == (2, 1, 450.0)
    np.testing.assert_array_equal(table.values, [0, -22.5])
    code, out, _ = run("eval", "o.cal", "--position", "1=450")
    assert json.loads(out) == {"2": pytest.approx(-11.25e-3)}


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--measured", "5um"], "the measurement is not complete"),
        (["--measured", "5", "--over", "1m", "--travel", "1m"], "'5' is not a length"),
        (
            ["--measured", "5um", "--over", "0m", "--travel", "1m"],
            "not a positive length",
        ),
        (
            ["--measured", "5um", "--over", "1m", "--travel", "1m", "-o", "o.cal"],
            "give end, middle",
        ),
        (
            ["--measured", "5um", "--over", "1m", "--travel", "1m", "--home-x", "1"],
            "use --home",
        ),
        (["r.json", "--over", "1m"], "exclude each other"),
    ],
)
def test_orthogonality_without_sense(run, args, message):
    code, _, err = run("orthogonality", *args)
    assert code == 2
    one_line(err, message)


def test_lines_from_a_result_and_from_measured_errors(run, tmp_path):
    assert run("orthogonality", "r.json", "-o", "o.cal", "--along", "y")[0] == 0
    assert load_cal("o.cal").tables[0].reference == 2
    code, out, _ = run(
        "accuracy", "r.json", "--along", "y", "--y-axis", "7", "--home-y", "-30"
    )
    assert code == 0 and ":START 7\n" in out and ":START OFFSET=0\n" in out
    values = [float(line) for line in out.splitlines() if line[0] not in ":;"]
    np.testing.assert_allclose(values, MAP.gy[3] * 1e6, atol=0.6e-5)
    code, out, _ = run("straightness", "r.json")
    assert code == 0 and ":START 2\n:START REFERENCEAXIS=1\n" in out
    (tmp_path / "d.csv").write_text("position,error\n0,0\n10,1\n20,3\n")
    assert run("accuracy", "d.csv", "-o", "a.cal")[0] == 0
    np.testing.assert_array_equal(load_cal("a.cal").tables[0].values, [0, -1, -3])
    code, _, err = run("accuracy", "d.csv", "-o", "a.cal")
    assert code == 2
    one_line(err, "a.cal: the file exists")


@pytest.mark.parametrize(
    "args",
    [
        ["accuracy", "d.csv"],
        ["straightness", "d.csv"],
        ["orthogonality", "--measured", "5um", "--over", "1m", "--travel", "1m"],
    ],
)
def test_force_without_a_file_to_replace_is_refused(run, tmp_path, args):
    (tmp_path / "d.csv").write_text("position,error\n0,0\n10,1\n20,3\n")
    assert run(*args)[0] == 0
    code, out, err = run(*args, "--force")
    assert code == 2 and not out
    one_line(err, "--force: it replaces a file, and none is named; name one with -o")


@pytest.mark.parametrize(
    "args",
    [
        ["accuracy", "d.csv", "--home-x", "-50"],
        ["accuracy", "d.csv", "--reverse-x"],
        ["straightness", "d.csv", "--along", "y", "--home-y", "5"],
        [
            "orthogonality",
            "--measured",
            "5um",
            "--over",
            "1m",
            "--travel",
            "1m",
            "--reverse-y",
        ],
    ],
)
def test_what_was_measured_is_in_the_controllers_own_coordinates(run, tmp_path, args):
    (tmp_path / "d.csv").write_text("position,error\n0,0\n10,1\n20,3\n")
    code, out, err = run(*args)
    assert code == 2 and not out
    one_line(err, "it has no meaning for")


def test_all_outputs_of_an_export_are_checked_first(run, tmp_path):
    args = ("export", "r.json", "--theta-axis", "3", "-o", "f.cal")
    code, _, err = run(*args, "--theta-output", "no/t.cal")
    assert code == 2 and not (tmp_path / "f.cal").exists()
    one_line(err, "no/t.cal: cannot be written")
    code, _, err = run("export", "r.json", "-o", "r.json", "--force")
    assert code == 2
    one_line(err, "r.json: would be overwritten")
    (tmp_path / "d.csv").write_text("position,error\n0,0\n10,1\n20,3\n")
    for verb, source in (
        ("orthogonality", "r.json"),
        ("accuracy", "r.json"),
        ("straightness", "d.csv"),
    ):
        before = (tmp_path / source).read_bytes()
        code, _, err = run(verb, source, "-o", source, "--force")
        assert code == 2 and (tmp_path / source).read_bytes() == before
        one_line(err, f"{source}: would be overwritten")


def test_bad_paths_and_bad_plots(run, tmp_path):
    run("export", "r.json", "-o", "f.cal")
    (tmp_path / "x.json").write_text("{}")
    for args, message in (
        (["check", "none.cal"], "none.cal: no such file"),
        (["eval", ".", "--position", "1=0"], "cannot be read"),
        (["export", "x.json", "-o", "g.cal"], "not a result of schema"),
        (["export", "r.json", "-o", "no/g.cal"], "cannot be written"),
        (
            ["verify", "r.json", "f.cal", "--plot", "f.gif"],
            "not a picture format by its suffix",
        ),
    ):
        code, _, err = run(*args)
        assert code == 2
        one_line(err, message)


def test_help_of_every_sub_verb(run):
    for name in (
        "check",
        "eval",
        "export",
        "verify",
        "orthogonality",
        "accuracy",
        "straightness",
    ):
        code, out, _ = run(name, "--help")
        assert code == 0 and f"selfcal cal {name}" in out
