# SPDX-License-Identifier: Apache-2.0
"""``selfcal export``: tables of other controllers, from the command line."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from test.support.maps import random_map, result_of

MAP = random_map(Artifact(5, 0.01), 3)
PMAC = "--counts-per-unit 1=2000000 --counts-per-unit 2=2000000"


@pytest.fixture(autouse=True)
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(MAP)))


def run(line: str) -> int:
    return main(["export", *line.split()])


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("kmotion", ["t.txt"]),
        ("pmac", ["t.txt"]),
        ("beckhoff", ["t_x.txt", "t_y.txt"]),
        ("linuxcnc", ["t_x.txt", "t_y.txt"]),
        ("siemens", ["t.txt"]),
    ],
)
def test_files_are_written_tried_and_not_overwritten(capsys, name, files):
    line = f"{name} R.json -o t.txt --verify " + PMAC * (name == "pmac")
    assert run(line) == 0
    out = capsys.readouterr().out.splitlines()
    assert out[: len(files)] == files and all(Path(file).is_file() for file in files)
    assert out[len(files)].startswith("true - commanded")
    assert len(out[len(files)]) < 80
    assert out[len(files) + 7] == "to put it into use:" and all(
        line.startswith(f"  {number}. ")
        for number, line in enumerate(out[len(files) + 8 :], 1)
    )
    before, after = map(float, out[len(files) + 1].split()[-2:])
    assert before > 0.1 and after < (
        0.0001
        if (len(files) == 1 and name != "siemens") or name == "beckhoff"
        else 0.99 * before
    )
    assert run(line) == 2
    assert "the file exists" in capsys.readouterr().err
    assert run(line + " --force --json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [entry["file"] for entry in found["files"]] == files
    assert all(Path(entry["old_file"]).is_file() for entry in found["files"])
    assert found["residuals"]["sites"]["after"]["rms"] == pytest.approx(
        1e-6 * after, abs=1e-12
    )


@pytest.mark.parametrize(
    "line",
    [
        "export kmotion R.json -o t.txt",
        "cal export R.json -o t.cal",
        "cal straightness R.json -o s.cal",
    ],
)
def test_a_step_between_neighbours_that_is_not_plausible_is_asked_about(capsys, line):
    """One node of 150 um, the others of a few: 1 % of the pitch is 100 um."""
    gx = MAP.gx.copy()
    gx[3, 1] += 150e-6
    write_json("R.json", result_to_dict(result_of(replace(MAP, gx=gx))))
    assert main(line.split()) == 2
    err = capsys.readouterr().err
    assert re.search(
        r": R.json: gx changes by 1[45]\d(\.\d)? µm from the node at \((0|10), -10\) "
        r"mm to the next along x, 10 mm away: is it real\?; check the readings there; "
        r"if it is, add --steep\n$",
        err,
    )
    assert not list(Path().glob("?.*t*"))
    assert main([*line.split(), "--steep"]) == 0
    gx[3, 1] -= 60e-6
    write_json("R.json", result_to_dict(result_of(replace(MAP, gx=gx))))
    assert main([*line.split(), "--force"]) == 0


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("kmotion", ("Tool Setup, Trajectory Planner: enter t.txt",)),
        (
            "pmac",
            ("send t.txt to the controller, then I51=1", "Mxx69 of motors 3 and 4"),
        ),
        (
            "beckhoff",
            (
                "t_x.txt and t_y.txt to the compensation lists of axes 3 and 4",
                "lr_param.crosscomp2 1",
            ),
        ),
        (
            "linuxcnc",
            (
                "[JOINT_2] write COMP_FILE = t_x.txt and COMP_FILE_TYPE = 0, under [JOINT_3] "
                "COMP_FILE = t_y.txt",
                "halcmd getp joint.2.backlash-corr",
            ),
        ),
        ("siemens", ("MD32710 $MA_CEC_ENABLE of axes AX3 and AX4",)),
    ],
)
def test_the_checklist_names_files_axes_and_the_place_to_look_at(capsys, name, said):
    """The place is that of the largest correction, relative to the controller's zero."""
    line = f"{name} R.json -o t.txt --json --unit mm --x-axis 3 --y-axis 4 --home-x 10 "
    counts = "--counts-per-unit 3=2000000 --counts-per-unit 4=2000000"
    assert run(line + counts * (name == "pmac")) == 0
    *steps, look = json.loads(capsys.readouterr().out)["checklist"]
    assert all(any(part in step for step in steps) for part in said)
    found = re.match(
        r"the correction is largest at x = (\S+) mm, y = (\S+) mm: relative to zero "
        r"the axes go (\S+) µm and (\S+) µm further there; measure it",
        look,
    )
    x, y, cx, cy = map(float, found.groups())
    if name in ("linuxcnc", "siemens"):
        return  # they hold a part of the map
    c = 1e6 * (
        np.stack([MAP.gx, MAP.gy]) - np.stack([MAP.gx, MAP.gy])[:, 3, 2][:, None, None]
    )
    i, j = np.unravel_index(np.hypot(*c).argmax(), MAP.gx.shape)
    assert (x, y) == (10 * (i - 2) - 10, 10 * (j - 2))
    assert (cx, cy) == pytest.approx(c[:, i, j], abs=1e-3)


def test_what_remains_is_said_before_the_table_of_linuxcnc_is_written(capsys):
    """Its table holds one axis at a time, and is zero at the controller's zero: c = 0 there."""
    assert run("linuxcnc R.json -o t.txt --home-x 5 --verify") == 0
    out, err = capsys.readouterr()
    before, after = map(float, out.splitlines()[3].split()[-2:])
    assert (
        "cannot hold the whole map: left at the nodes on a simulated controller: "
        f"{after:.3g} µm rms"
        in err
        and f"of {before:.3g} µm rms" in err
    )
    rows = [
        list(map(float, row.split()))
        for row in Path("t_x.txt").read_text().splitlines()[:5]
    ]
    at, forward, _ = np.array(rows).T
    means = 1e3 * MAP.gx.mean(axis=1)
    at_zero = (means[2] + means[3]) / 2  # the zero is at x = 5 mm, between two columns
    np.testing.assert_allclose(at, [-25, -15, -5, 5, 15])
    np.testing.assert_allclose(at - forward, means - at_zero, atol=2e-8)
    assert np.interp(0.0, at, at - forward) == pytest.approx(0.0, abs=2e-8)


def test_kmotion_is_in_inches_unless_told_otherwise(capsys):
    assert (
        run("kmotion R.json -o inch.txt")
        == run("kmotion R.json -o mm.txt --unit mm")
        == 0
    )
    first = [
        float(line.split(",")[0])
        for line in (
            Path("inch.txt").read_text().splitlines()[2],
            Path("mm.txt").read_text().splitlines()[2],
        )
    ]
    assert first == [pytest.approx(-20 / 25.4), -20]
    assert "# unit of the positions: in; " in Path("inch.txt").read_text()
    assert "# unit of the positions: mm; " in Path("mm.txt").read_text()


def test_onto_combines_with_the_active_table(capsys):
    assert run("kmotion R.json -o old.txt --unit mm") == 0
    assert run("kmotion R.json -o new.txt --unit mm --onto old.txt") == 0
    old, new = (
        Path(name).read_text().splitlines()[3 + 12] for name in ("old.txt", "new.txt")
    )
    assert old.startswith("2,2,") and new.startswith("2,2,")
    g = [1e3 * MAP.gx[2, 2], 1e3 * MAP.gy[2, 2]]
    for column, value in zip((2, 3), g, strict=True):
        assert float(old.split(",")[column]) == pytest.approx(value, abs=1e-7)
        assert float(new.split(",")[column]) == pytest.approx(2 * value, abs=1e-6)
    assert run("kmotion R.json -o new.txt --onto R.json --unit mm --force") == 2
    assert re.fullmatch(r"selfcal export: R.json:1: .*\n", capsys.readouterr().err)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (
            "kmotion R.json -o t.txt --negate",
            "--negate: the sense of kmotion is known; leave it out",
        ),
        ("siemens R.json -o t.txt --integers", "--integers: siemens needs none"),
        (
            f"kmotion R.json -o t.txt {PMAC}",
            "--counts-per-unit: kmotion is not in counts; leave it out",
        ),
        (
            "pmac R.json -o t.txt --counts-per-unit 1=5",
            "--counts-per-unit: it is given for [1]",
        ),
        ("pmac R.json -o t.txt", "--counts-per-unit: PMAC's tables are in counts"),
        (
            "pmac R.json -o t.txt --counts-per-unit 1=2 --counts-per-unit 2=2",
            "--counts-per-unit: every entry of motor 1 would be 0: it is in 31.2 µm, and the "
            "corrections are at most ",
        ),
        (
            "pmac R.json -o t.txt --counts-per-unit 1=2000 --counts-per-unit 2=2",
            "--counts-per-unit: every entry of motor 2 would be 0: it is in 31.2 µm, and the "
            "corrections are at most ",
        ),
        ("kmotion R.json -o R.json", "R.json: would be overwritten"),
        ("linuxcnc R.json -o t.txt --onto a", "a: no such file"),
        (
            "siemens R.json -o t.txt --y-axis 1",
            "axes: the indices [1, 1] are not distinct",
        ),
    ],
)
def test_what_is_not_possible_is_one_line(capsys, line, message):
    assert run(line) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"selfcal export: {message}") and err.count("\n") == 1
    assert not Path("t.txt").exists()


def test_integers_are_for_the_old_controller():
    assert run("beckhoff R.json -o t.lis --integers") == 0
    values = re.findall(r"correction (\S+)$", Path("t_x.lis").read_text(), re.M)
    assert len(values) == 25 and all(re.fullmatch(r"-?\d+", value) for value in values)
    assert int(values[12]) == round(MAP.gx[2, 2] / 1e-7)


def test_holes_are_filled_on_request_and_the_file_says_so(capsys):
    write_json(
        "R.json",
        result_to_dict(result_of(random_map(Artifact(5, 0.01), 3, unknown=((1, 1),)))),
    )
    assert run("siemens R.json -o t.txt") == 2
    assert "1 sites are unknown" in capsys.readouterr().err
    assert run("siemens R.json -o t.txt --fill") == 0
    assert capsys.readouterr().err.startswith(
        "selfcal export: 1 unknown sites filled from their neighbours\n"
    )
    assert "1 sites were not measured" in Path("t.txt").read_text()


def test_not_qualified_is_code_5_and_not_identified_code_3(capsys):
    found = result_of(MAP)
    write_json(
        "R.json",
        result_to_dict(
            replace(
                found,
                verdict=Verdict(
                    Grade.NOT_QUALIFIED,
                    sentence="Not qualified: too noisy.",
                    reasons=("too noisy",),
                ),
            )
        ),
    )
    assert run("kmotion R.json -o t.txt") == 5
    assert (
        "too noisy" in capsys.readouterr().err
        and "NOT QUALIFIED" in Path("t.txt").read_text()
    )
    write_json(
        "R.json",
        result_to_dict(
            replace(
                found, observability=replace(found.observability, identifiable=False)
            )
        ),
    )
    assert run("kmotion R.json -o u.txt") == 3 and not Path("u.txt").exists()


def test_cal_export_combines_too(capsys):
    assert main(["cal", "export", "R.json", "-o", "old.cal"]) == 0
    assert main(["cal", "export", "R.json", "-o", "new.cal", "--onto", "old.cal"]) == 0
    assert "replaces the table" in Path("new.cal").read_text()
    capsys.readouterr()
    assert (
        main(["cal", "verify", "R.json", "new.cal", "--onto", "old.cal", "--json"]) == 0
    )
    sites = json.loads(capsys.readouterr().out)["sites"]
    assert sites["after"]["max"] < 1e-10 < 1e-7 < sites["before"]["max"]
    # twice the correction
    assert main(["cal", "verify", "R.json", "new.cal", "--json"]) == 2
    words = ["R.json", "-o", "n.cal", "--onto", "old.cal", "--y-axis", "3"]
    assert main(["cal", "export", *words]) == 2
    assert "it is for axes" in capsys.readouterr().err


def test_errors_of_an_axis_below_half_an_entry_of_pmac_are_zeros():
    """With 2000 counts in a mm an entry is 31 nm; y is good to 1 nm, and x has to be corrected."""
    small = replace(MAP, gy=MAP.gy * 1e-9 / np.abs(MAP.gy).max())
    write_json("R.json", result_to_dict(result_of(small)))
    counts = "--counts-per-unit 1=2000 --counts-per-unit 2=2000"
    assert run(f"pmac R.json -o t.txt {counts}") == 0
    of_y, of_x = Path("t.txt").read_text().split("#2\n")[1].split("#1\n")
    entries_of_y, entries_of_x = (
        set(map(int, " ".join(re.findall("^[-0-9 ]+$", text, re.M)).split()))
        for text in (of_y, of_x)
    )
    assert entries_of_y == {0} and len(entries_of_x) > 5


@pytest.mark.parametrize("axes", [(1, 2), (2, 1)])
def test_the_counts_of_pmac_are_those_of_their_motors(axes):
    """Six cells of 10 mm along x with 1000 counts in a mm, along y with 3000."""
    x, y = axes
    assert (
        run(
            f"pmac R.json -o t.txt --x-axis {x} --y-axis {y} --counts-per-unit {x}=1000 "
            f"--counts-per-unit {y}=3000"
        )
        == 0
    )
    heads = re.findall(r"DEFINE COMP (.*)", Path("t.txt").read_text())
    assert {head.split(",", 4)[4] for head in heads} == {"60000,180000"}


@pytest.mark.parametrize(
    ("options", "offset"),
    [
        ("--home-theta 30", 390.0),
        ("--home-theta 30 --counts-per-unit 3=1000", 30.0),
        ("--home-theta 30 --reverse-theta --counts-per-unit 3=1000", -30.0),
    ],
)
def test_the_home_of_theta_is_in_degrees_of_the_stage(options, offset):
    """The first line of the stage, at 0 or at -360 degrees, is that far below the home."""
    write_json("T.json", result_to_dict(result_of(random_map(Artifact(5, 0.01, 8), 3))))
    words = f"cal export T.json -o t.cal --theta-axis 3 {options}".split()
    assert main(words) == 0
    found = re.search(
        r"^:START\S* OFFSET=(\S+)$", Path("t_theta.cal").read_text(), re.M
    )
    assert float(found[1]) == offset
