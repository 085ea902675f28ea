# SPDX-License-Identifier: Apache-2.0
"""One line for every fault, what was probably meant, units, results on stdout."""

import csv
import io
import itertools
import json
import os
import re
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_svg import RendererSVG

from selfcal_ros.bagio.offline import topics_like
from selfcal_ros.cli.main import build_parser, main
from selfcal_ros.collection.inputs import Detection
from selfcal_ros.errors import InputError, did_you_mean, known_are
from selfcal_ros.files import read_json
from selfcal_ros.model.plan_form import plan_from_dict
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.verdict import Grade, Verdict
from selfcal_ros.outputs import write_json
from test.support.bags import Foreign
from test.support.details import simulated_details
from test.support.results import known_result
from test.support.sessions import events_of, small_bag, small_plan
from test.support.terminals import SELFCAL


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return small_bag(tmp_path_factory.mktemp("comfort"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "solv x",
            "selfcal: VERB 'solv' is unknown; did you mean 'solve'?; see selfcal --help",
        ),
        (
            "--version=3 solve",
            "selfcal: argument --version: ignored explicit argument '3'; see selfcal --help",
        ),
        ("plan", "selfcal plan: new|check|suggest is missing; see selfcal plan --help"),
        ("solve", "selfcal solve: BAG is missing; see selfcal solve --help"),
        (
            "solve b --methd joint",
            "selfcal solve: the option --methd is unknown; did you mean '--method'?; "
            "see selfcal solve --help",
        ),
        (
            "solve b --method jiont",
            "selfcal solve: --method: 'jiont' is unknown; did you mean 'joint'?"
            "; see selfcal solve --help",
        ),
        (
            "solve b --method qqq",
            "selfcal solve: --method: 'qqq' is unknown; known are joint, law; see "
            "selfcal solve --help",
        ),
        (
            "plan chek x",
            "selfcal plan: new|check|suggest 'chek' is unknown; did you mean 'check'?; see "
            "selfcal plan --help",
        ),
        (
            "plan check p --sigmma=3",
            "selfcal plan check: the option --sigmma is unknown; did you mean "
            "'--sigma'?; see selfcal plan check --help",
        ),
        (
            "solve a b",
            "selfcal solve: 'b' is one argument too many; see selfcal solve --help",
        ),
        (
            "cal evl f",
            "selfcal cal: WHAT 'evl' is unknown; did you mean 'eval'?; see selfcal cal --help",
        ),
    ],
)
def test_a_fault_on_the_command_line_is_one_line(capsys, words, message):
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert capsys.readouterr() == ("", message + "\n")


@pytest.mark.parametrize(
    "words",
    [
        "solve LONG",
        "report LONG",
        "table R.json -o LONG.csv",
        "plan check LONG",
        "batch LONG -o out",
        "step-diagonal LONG --method new",
        "cal check LONG",
        "simulate LONG -o out",
        "solve x -o LONG",
        "report .",
    ],
)
def test_a_name_that_no_file_can_have_is_one_line(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(known_result(5, 8)[0]))
    assert main(words.replace("LONG", "x" * 300).split()) == 2
    out, err = capsys.readouterr()
    assert not out
    assert re.fullmatch(
        r"selfcal [a-z -]+: \S+: .*(File name too long|is a folder).*\n", err
    )


def test_names_like_one_another():
    assert did_you_mean("Viws", ["views", "plan_id"]) == "did you mean 'views'?"
    assert did_you_mean("nothing", ["views", "plan_id"]) == ""
    assert did_you_mean("--Datum-theta", ["--theta", "--theta-datum"]) == (
        "did you mean '--theta-datum'?"
    )
    assert known_are("viws", ["views", "artifact"]) == (
        "did you mean 'views'? known are views, artifact"
    )
    assert known_are("zzz", ["views", "artifact"]) == "known are views, artifact"


def test_a_key_of_a_plan_that_is_misspelt():
    with pytest.raises(InputError) as caught:
        plan_from_dict(
            {
                "plan_id": "p",
                "artifact": {"grid_size": 3, "grid_pitch": 0.01, "angular_count": 0},
                "views": [{"name": "a", "repeat": 3}],
            },
            "p.yaml",
        )
    assert str(caught.value).startswith(
        "p.yaml: views[0]: repeat: unknown key; did you mean 'repeats'? known are name, rotation_"
    )


def test_topics_that_were_probably_meant():
    joints, marks = "sensor_msgs/msg/JointState", "selfcal_msgs/msg/MarkDetection"
    topics = {
        "/joint_states": joints,
        "/cell/stage/joint_states": joints,
        "/cam/marks": marks,
        "/chatter": "std_msgs/msg/String",
        "/stage/mark_detection": "x_msgs/msg/Y",
    }
    assert topics_like("stage/joint_states", topics) == (
        "is it /joint_states? then remap it to stage/joint_states, or "
    )
    assert topics_like("stage/mark_detections", topics) == (
        "is it /cam/marks? then remap it to stage/mark_detections, or "
    )
    del topics["/cam/marks"]
    assert topics_like("stage/mark_detections", topics) == (
        "did you mean '/stage/mark_detection'? then remap it, or "
    )
    assert topics_like("selfcal/view_command", topics) == ""


def test_a_bag_with_topics_of_other_names_says_which(tmp_path, capsys):
    events = events_of(small_plan())
    path = Foreign(others=True).write(
        tmp_path / "x.mcap", [e for e in events if not isinstance(e, Detection)]
    )
    assert main(["solve", str(path)]) == 4
    assert (
        "no message on stage/mark_detections; record this topic"
        in capsys.readouterr().err
    )


def test_the_result_on_stdout_and_all_else_on_stderr(bag, tmp_path, capsys):
    assert main(["solve", str(bag), "-o", str(tmp_path / "r.json")]) in (0, 5)
    summary = capsys.readouterr().out
    wanted = read_json(tmp_path / "r.json")
    for options in (
        ["-o", "-"],
        ["--json"],
        ["--json", "-o", str(tmp_path / "again.json")],
    ):
        assert main(["solve", str(bag), *options]) in (0, 5)
        printed = capsys.readouterr()
        found = json.loads(printed.out)
        for result in (found, wanted):
            result["provenance"].pop("created", None)
        assert found == wanted
        assert summary.splitlines()[0] in printed.err
    assert (tmp_path / "again.json").exists() and not (tmp_path / "-").exists()


def test_a_plan_is_judged_in_um_where_the_noise_is_given(capsys, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        yaml.safe_dump(
            {
                "plan_id": "p",
                "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 0},
                "views": [
                    {"name": "a", "repeats": 4},
                    {"name": "b", "rotation_deg": 90, "repeats": 4},
                    {"name": "c", "translation_pitch": [1, 0], "repeats": 4},
                ],
            }
        )
    )
    assert main(["plan", "check", str(plan)]) == 0
    assert (
        " µm"
        not in capsys.readouterr().out.partition("predicted uncertainty budget")[0]
    )
    for sigma in ("20nm", "2e-5 mm"):
        assert main(["plan", "check", str(plan), "--sigma", sigma, "--json"]) == 0
        found = json.loads(capsys.readouterr().out)["predicted"]
        # 20 nm, averaged over 4 repeats: 0.01 um
        assert found["rms_u_xy_um"] == pytest.approx(
            0.01 * found["rms_gain_xy"], rel=1e-12
        )
        assert found["max_u_xy_um"] == pytest.approx(
            0.01 * found["max_gain_xy"], rel=1e-12
        )
    assert main(["plan", "check", str(plan), "--sigma", "20nm"]) == 0
    assert (
        f"  XY     rms {found['rms_u_xy_um']:.4f} µm   largest {found['max_u_xy_um']:.4f} µm "
        "(k=1) for 0.02 µm noise of one reading"
    ) in capsys.readouterr().out
    terms = [str(plan), "--model", "plate_scale:1e-6", "--sigma", "20nm"]
    assert main(["plan", "check", *terms, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["predicted"]
    for name in ("rms", "max"):
        assert found[f"{name}_u_xy_um_with_terms"] == pytest.approx(
            0.01 * found[f"{name}_gain_xy_with_terms"], rel=1e-12
        )
    assert main(["plan", "check", *terms]) == 0
    assert (
        f"  XY with plate_scale:1e-06: rms {found['rms_u_xy_um_with_terms']:.4f} µm   largest "
        f"{found['max_u_xy_um_with_terms']:.4f} µm (k=1) for"
    ) in capsys.readouterr().out


@pytest.mark.parametrize("more", [[], ["--views", "3"]])
def test_plans_are_ranked_in_um_where_the_noise_is_given(capsys, tmp_path, more):
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        yaml.safe_dump(
            {
                "plan_id": "p",
                "artifact": {"grid_size": 3, "grid_pitch": 0.01, "angular_count": 0},
                "views": [
                    {"name": "a", "repeats": 4},
                    {"name": "b", "rotation_deg": 90, "repeats": 4},
                    {"name": "c", "translation_pitch": [1, 0], "repeats": 4},
                ],
            }
        )
    )
    asked = ["plan", "suggest", str(plan), "--against", "none", *more]
    assert main(asked) == 0
    assert "µm" not in capsys.readouterr().out  # by the noise alone: gains
    assert main([*asked, "--sigma", "20nm", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    best = found if more else found["suggestions"][0]
    # 20 nm, averaged over 4 repeats: 10 nm
    assert best["u_rms_m"] == pytest.approx(1e-8 * best["rms_gain_xy"], rel=1e-12)
    assert main([*asked, "--sigma", "20nm"]) == 0
    assert (
        f"u XY rms {best['u_rms_m'] * 1e6:.5f} µm  max {best['u_max_m'] * 1e6:.5f} µm"
        in capsys.readouterr().out
    )


def test_a_position_with_its_unit(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_json("r.json", result_to_dict(known_result(5, 8)[0]))
    for unit, number in (("mm", "10.5"), ("um", "10500"), ("m", "0.0105")):
        assert (
            main(["cal", "export", "r.json", "-o", f"{unit}.cal", "--unit", unit]) == 0
        )
        found = []
        for text in (number, "10.5mm", "0.0105m", "10500um", "1.05e4µm"):
            capsys.readouterr()
            assert (
                main(
                    [
                        "cal",
                        "eval",
                        f"{unit}.cal",
                        "--position",
                        f"1={text}",
                        "--position",
                        "2=-3mm",
                        "--json",
                    ]
                )
                == 0
            )
            found.append(capsys.readouterr().out)
        assert len(set(found)) == 1 and json.loads(found[0])["1"] != 0
    assert main(["cal", "eval", "mm.cal", "--position", "1=10furlong"]) == 2
    assert "'10furlong' is not a number" in capsys.readouterr().err


def test_the_table_of_a_result(tmp_path, capsys):
    result = known_result(5, 8)[0]
    emap = replace(result.error_map, gx=result.error_map.gx.copy())
    emap.gx[0, 1] = np.nan
    write_json(tmp_path / "r.json", result_to_dict(replace(result, error_map=emap)))
    assert (
        main(
            ["table", str(tmp_path / "r.json"), "-o", str(tmp_path / "t.csv"), "--json"]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out) == {
        "written": str(tmp_path / "t.csv"),
        "kind": "csv",
    }
    rows = list(csv.DictReader(io.StringIO((tmp_path / "t.csv").read_text())))
    nx, ny = result.artifact.shape
    assert len(rows) == nx * ny + result.artifact.angular_count
    first, line = rows[0], rows[nx * ny + 1]
    half, pitch = result.artifact.half, result.artifact.grid_pitch_m
    assert (int(first["m"]), int(first["n"])) == (-half[0], -half[1])
    assert float(first["x_m"]) == pytest.approx(-half[0] * pitch, rel=1e-15)
    assert (
        float(rows[ny]["gx_m"]) == emap.gx[1, 0]
        and float(rows[1]["gy_m"]) == emap.gy[0, 1]
    )
    assert rows[1]["gx_m"] == "" and first["k"] == "" and line["gx_m"] == ""
    assert float(line["g_theta_rad"]) == emap.g_theta[1]
    assert float(line["angle_rad"]) == pytest.approx(
        2 * np.pi / result.artifact.angular_count
    )
    assert main(["table", str(tmp_path / "r.json"), "-o", str(tmp_path / "t.npz")]) == 0
    with np.load(tmp_path / "t.npz") as file:
        arrays = dict(file)
    np.testing.assert_array_equal(arrays["gx"], emap.gx)
    np.testing.assert_array_equal(arrays["ay"], result.artifact_map.ay)
    assert main(["table", str(tmp_path / "r.json"), "-o", str(tmp_path / "t.txt")]) == 2
    assert capsys.readouterr().err == (
        f"selfcal table: {tmp_path / 't.txt'}: its suffix is not "
        "that of a table; name a file that ends in .csv or .npz, "
        "or - for stdout\n"
    )
    text = (tmp_path / "t.csv").read_text()
    assert main(["table", str(tmp_path / "r.json"), "-o", "-"]) == 0
    assert capsys.readouterr().out == text
    assert main(["table", str(tmp_path / "r.json"), "-o", "-", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"csv": text}
    doubted = replace(
        result,
        verdict=Verdict(
            Grade.NOT_QUALIFIED, sentence="Not qualified: the plate slipped"
        ),
    )
    write_json(tmp_path / "r.json", result_to_dict(doubted))
    assert (
        main(
            [
                "table",
                str(tmp_path / "r.json"),
                "-o",
                str(tmp_path / "t.csv"),
                "--force",
            ]
        )
        == 5
    )
    assert capsys.readouterr().err == "selfcal: Not qualified: the plate slipped\n"


def leaves(parser, name=""):
    """Yield name and parser of every verb that does something."""
    groups = [a for a in parser._actions if hasattr(a, "_name_parser_map")]
    if not groups:
        yield name.strip(), parser
    for group in groups:
        for word, sub in group._name_parser_map.items():
            yield from leaves(sub, f"{name} {word}")


LEAVES = dict(leaves(build_parser()))


@pytest.mark.parametrize("name", sorted(LEAVES))
def test_every_verb_takes_json_and_is_documented(name):
    from pathlib import Path

    import selfcal_ros

    assert "--json" in LEAVES[name]._option_string_actions, (
        "call add_json(parser) of cli/terminal.py in configure, and say() in run"
    )
    docs = Path(selfcal_ros.__file__).parents[1] / "docs/reference/json.md"
    assert f"`{name}`" in docs.read_text(), (
        f"add a row for `{name}` to docs/reference/json.md"
    )


@pytest.mark.parametrize("verb", ["solve", "plan", "cal", "step-diagonal"])
def test_the_parser_of_one_verb_takes_what_that_of_all_does(verb):
    own = {
        name: parser.format_help()
        for name, parser in LEAVES.items()
        if name.split()[0] == verb
    }
    assert own and own == {
        name: parser.format_help() for name, parser in leaves(build_parser(verb))
    }


@pytest.mark.parametrize("word", ["", "--help", "slove", "main", "step_diagonal"])
def test_a_word_that_is_no_verb_is_answered_from_all_verbs(word):
    assert build_parser(word).format_help() == build_parser().format_help()


RUNS = {
    "solve": "solve BAG -o s.json",
    "batch": "batch BAG -o batch",
    "diff": "diff S S",
    "apply": "apply R POINTS -o a.csv",
    "report": "report R",
    "plot": "plot R -o t.svg",
    "table": "table S -o t.csv",
    "combine": "combine S u.csv -o mean.json",
    "certificate": "certificate S DETAILS -o c.xml",
    "iso230": "iso230 S",
    "plan new": "plan new -o n.yaml --travel 1m --marks 5 --pitch 1mm --minutes 20",
    "plan check": "plan check PLAN",
    "plate": "plate PLAN -o plate.svg",
    "plan suggest": "plan suggest PLAN",
    "simulate": "simulate SIM -o made",
    "reproduce": "reproduce hu --draws 2",
    "cal export": "cal export R -o f.cal",
    "cal check": "cal check f.cal",
    "cal eval": "cal eval f.cal --position 1=1 --position 2=2",
    "export": "export siemens R -o f.ini",
    "gcode": "gcode NC R -o o.nc --dialect grbl",
    "cal verify": "cal verify R f.cal",
    "cal accuracy": "cal accuracy R",
    "cal straightness": "cal straightness R -o s.cal",
    "cal orthogonality": "cal orthogonality --measured 5um --over 200mm --travel 300mm",
    "step-diagonal": "step-diagonal DATA --method new -o d.json",
}
NEEDS_NODES = {"replay", "up", "monitor", "call", "cell check"}
ELSEWHERE = {
    "detect": "test_detect.py",
    "recheck": "test_recheck.py",
    "camera init": "test_camera.py",
    "measure": "test_measure.py",
    "cell try": "test_cell_try.py",
    "verify": "test_verify.py",
    "history": "test_history.py",
}
"""Verbs whose bags are made by other tests."""


def test_every_verb_prints_one_json_object(bag, tmp_path, capsys, monkeypatch):
    from pathlib import Path

    monkeypatch.chdir(tmp_path)
    root = Path(__file__).parents[2]
    write_json("r.json", result_to_dict(known_result(5, 8)[0]))
    places = {
        "BAG": bag,
        "R": "r.json",
        "S": "s.json",
        "PLAN": bag.parent / "plan.yaml",
        "SIM": bag.parent / "simulation.yaml",
        "POINTS": "p.csv",
        "NC": "in.nc",
        "DETAILS": simulated_details(tmp_path),
        "DATA": root / "config/step_diagonal/case_study.csv",
    }
    Path("p.csv").write_text("x,y\n0,0\n")
    Path("in.nc").write_text("G21 G90\nG0 X0 Y0\n")
    run = set(RUNS) | NEEDS_NODES | set(ELSEWHERE)
    assert run == set(LEAVES), (
        f"in RUNS above, add or remove {sorted(run ^ set(LEAVES))}"
    )
    for name, line in RUNS.items():
        words = [str(places.get(word, word)) for word in line.split()]
        if name == "combine":  # the map of another calibration
            rows = list(csv.DictReader(Path("t.csv").read_text().splitlines()))
            with Path("u.csv").open("w") as table:
                writer = csv.DictWriter(table, rows[0])
                writer.writeheader()
                for sign, row in zip(itertools.cycle((1, -1)), rows, strict=False):
                    row["gx_m"] = row["gx_m"] and float(row["gx_m"]) + sign * 1e-9
                    writer.writerow(row)
        assert main([*words, "--json"]) in (0, 5), name
        found = json.loads(capsys.readouterr().out)
        assert isinstance(found, dict) and found, name


@pytest.mark.parametrize(
    ("kind", "begins", "lines"),
    [("png", b"\x89PNG", 0), ("svg", b"<?xml", 8), ("pdf", b"%PDF", 0)],
)
def test_the_picture_of_a_result_is_what_its_ending_says_and_repeatable(
    tmp_path, capsys, kind, begins, lines
):
    """Only SVG names what it draws, by numbers that a salt makes repeatable: here with lines."""
    write_json(tmp_path / "r.json", result_to_dict(known_result(5, lines)[0]))
    data = []
    for name in ("a", "b"):
        path = tmp_path / f"{name}.{kind}"
        assert (
            main(
                ["plot", str(tmp_path / "r.json"), "-o", str(path), "--json", "--force"]
            )
            == 0
        )
        assert json.loads(capsys.readouterr().out) == {
            "written": str(path),
            "kind": kind,
        }
        data.append(path.read_bytes())
    # matplotlib 3.8 names them by their address
    if not hasattr(RendererSVG, "_get_clippath_id"):
        data = [re.sub(rb"\bp[0-9a-f]{10}\b", b"path", found) for found in data]
    assert data[0] == data[1] and data[0].startswith(begins) and len(data[0]) > 5000


def test_a_home_that_cannot_be_written_is_no_word_beside_a_picture(tmp_path):
    write_json(tmp_path / "r.json", result_to_dict(known_result(5, 0)[0]))
    homes = ("HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")
    said = subprocess.run(
        [*SELFCAL, "plot", "r.json", "-o", "r.svg"],
        cwd=tmp_path,
        env=os.environ | dict.fromkeys(homes, "/proc/none"),
        capture_output=True,
        text=True,
        check=True,
    )
    assert (said.stdout, said.stderr) == ("written: r.svg\n", "")


def test_a_picture_of_no_kind(tmp_path, capsys):
    write_json(tmp_path / "r.json", result_to_dict(known_result(5, 8)[0]))
    assert main(["plot", str(tmp_path / "r.json"), "-o", str(tmp_path / "a.gif")]) == 2
    assert capsys.readouterr() == (
        "",
        (
            f"selfcal plot: {tmp_path / 'a.gif'}: not a picture format by "
            "its suffix; name a file that "
            "ends in .png, .svg or .pdf\n"
        ),
    )
