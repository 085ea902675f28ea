# SPDX-License-Identifier: Apache-2.0
import io
import json
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_from_dict, result_to_dict, with_digests
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.summary.sections import summary_text
from test.support.truth import hu_plan, random_truth, simulate_measurements

ROOT = Path(__file__).parents[2]


@cache
def calibrated(seed, sigma_m=2e-8, sigma_rad=2e-5):
    """Return the JSON form of a real calibration and of its truth."""
    rng = np.random.default_rng(seed)
    artifact = Artifact(5, 0.01, 8)
    plan = hu_plan(artifact, 3)
    truth = random_truth(artifact, len(plan.views), rng)
    result = calibrate(
        simulate_measurements(
            truth, plan, rng, sigma_m=sigma_m, sigma_theta_rad=sigma_rad
        )
    )
    return result_to_dict(result), {
        "gx": truth.g[0].tolist(),
        "gy": truth.g[1].tolist(),
        "g_theta": truth.g_theta.tolist(),
    }


@pytest.fixture
def folder(tmp_path):
    result, truth = calibrated(4)
    write_json(tmp_path / "result.json", result)
    write_json(tmp_path / "truth.json", truth)
    return tmp_path


def test_report_lies_beside_the_result_by_default(folder, capsys):
    assert main(["report", str(folder / "result.json")]) == 0
    html = (folder / "result.html").read_text(encoding="utf-8")
    assert html.startswith("<!DOCTYPE html>") and "Calibrated from 4 views" in html
    assert capsys.readouterr().out == f"written: {folder / 'result.html'}\n"


def test_report_picture_summary_and_truth(folder, capsys):
    code = main(
        [
            "report",
            str(folder / "result.json"),
            "-o",
            str(folder / "r.html"),
            "--plot",
            str(folder / "m.png"),
            "--truth",
            str(folder / "truth.json"),
            "--text",
        ]
    )
    assert code == 0
    out = capsys.readouterr().out
    assert "Against the known truth" in out and f"written: {folder / 'm.png'}" in out
    assert imread(folder / "m.png").shape[1] == 2175
    assert "Against the known truth" in (folder / "r.html").read_text(encoding="utf-8")


def test_summary_on_a_terminal_without_symbols(folder, monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii", errors="strict")
    monkeypatch.setattr(sys, "stdout", stream)
    assert main(["report", str(folder / "result.json"), "--text"]) == 0
    stream.flush()
    assert b"tx um" in stream.buffer.getvalue()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["none.json"], "none.json: no such file; check the path"),
        (
            ["text.json"],
            "text.json:1:1: not JSON (Expecting value); give a file that `selfcal` wrote",
        ),
        (
            ["list.json"],
            "list.json: not a result of schema selfcal.result/1; give a RESULT.json that "
            "`selfcal solve` wrote",
        ),
        (
            ["result.json", "-o", "result.json"],
            "result.json: would be overwritten; name another output file",
        ),
        (
            ["result.json", "-o", "a.html", "--plot", "a.html"],
            "a.html: would be overwritten; name another output file",
        ),
        (
            ["result.json", "-o", "a.html", "--plot", "a.gif"],
            "a.gif: not a picture format by its suffix; name a file that ends in "
            ".png, .svg or .pdf",
        ),
        (
            ["result.json", "-o", "a.txt"],
            "a.txt: a report is HTML or PDF; end the name in .html or .pdf",
        ),
        (
            ["result.json", "-o", "a.html", "--plot", "none/a.png"],
            "none/a.png: cannot be written (No such file or directory); name an existing, "
            "writable folder",
        ),
        (
            ["result.json", "-o", "none/a.html"],
            "none/a.html: cannot be written (No such file or directory); name an existing, "
            "writable folder",
        ),
        (
            ["result.json", "--truth", "list.json"],
            "list.json: not a mapping; give gx, gy (m) and g_theta (rad)",
        ),
        (
            ["result.json", "--truth", "result.json"],
            "truth gx: missing; give gx, gy (m) and g_theta (rad)",
        ),
    ],
)
def test_unusable_input_is_one_line_and_code_2(
    folder, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(folder)
    (folder / "text.json").write_text("hello")
    (folder / "list.json").write_text("[]")
    before = (folder / "result.json").read_bytes()
    assert main(["report", *arguments]) == 2
    assert capsys.readouterr().err == f"selfcal report: {message}\n"
    assert (folder / "result.json").read_bytes() == before
    assert not list(folder.glob("*.html"))


def paths(value, at=()):
    """Yield the path of every key and of the first two items of every list."""
    if isinstance(value, dict):
        for key in value:
            yield (*at, key)
            yield from paths(value[key], (*at, key))
    elif isinstance(value, list):
        for index in range(min(len(value), 2)):
            yield from paths(value[index], (*at, index))


def test_no_damage_to_a_result_file_ends_in_a_traceback(folder):
    """Every value replaced by others of wrong type: reported or tolerated, never a crash."""
    whole = json.loads((folder / "result.json").read_text())
    outcomes = {"refused": 0, "tolerated": 0}
    for path in paths(whole):
        for wrong in (None, "x", [], {}, -1, 1e400, True):
            holder = whole
            for step in path[:-1]:
                holder = holder[step]
            right, holder[path[-1]] = holder[path[-1]], wrong
            try:
                summary_text(result_from_dict(whole, "r.json"))
                outcomes["tolerated"] += 1
            except InputError as error:
                assert "\n" not in str(error)
                outcomes["refused"] += 1
            holder[path[-1]] = right
    assert whole == json.loads((folder / "result.json").read_text())
    assert min(outcomes.values()) > 50


REFERENCE = {
    "kind": "artifact",
    "relative_error": 1e-6,
    "u_relative": 1e-7,
    "certificate": "C 1",
}
ROW = {
    "quantity": "xy",
    "component": "reading noise",
    "type": "A",
    "value": 0.0,
    "u": 2e-8,
    "unit": "m",
    "effect_rms": 1e-9,
    "effect_max": 2e-9,
    "dof": None,
    "source": "readings",
    "details": {},
    "text": "scatter of repeats",
}


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        (
            "reference",
            REFERENCE | {"kind": "moon"},
            "'moon' is not a valid ReferenceKind",
        ),
        ("reference", REFERENCE | {"relative_error": "x"}, "'x' is not a number"),
        (
            "reference",
            REFERENCE | {"u_relative": None},
            "nan is not a standard uncertainty",
        ),
        (
            "reference",
            REFERENCE | {"u_relative": -1.0},
            "-1.0 is not a standard uncertainty",
        ),
        ("reference", REFERENCE | {"certificate": 3}, "3 is not of type str"),
        ("reference", {}, "the key 'kind' is missing"),
        ("reference", [], "[] is not of type dict"),
        ("budget", [{"effect_rms": 1e-9}], "the key 'dof' is missing"),
        ("budget", [ROW | {"quantity": 3}], "3 is not of type str"),
        ("budget", [ROW | {"details": 3}], "3 is not of type dict"),
        ("budget", [ROW | {"dof": "many"}], "'many' is not a number"),
        ("budget", [ROW | {"effect_max": [1]}], "[1] is not a number"),
        ("budget", [3], "3 is not of type dict"),
        ("budget", "x", "'x' is not of type list"),
    ],
)
def test_an_unusable_reference_or_budget_is_one_line(
    folder, monkeypatch, capsys, key, value, said
):
    monkeypatch.chdir(folder)
    whole = json.loads(Path("result.json").read_text())
    for name, good in (("reference", REFERENCE), ("budget", [ROW])):
        Path("good.json").write_text(json.dumps(with_digests(whole | {name: good})))
        assert main(["report", "good.json", "--force"]) == 0
    Path("bad.json").write_text(json.dumps(whole | {key: value}))
    capsys.readouterr()
    assert main(["report", "bad.json"]) == 2
    err = capsys.readouterr().err
    assert (
        err.startswith("selfcal report: bad.json: damaged result (")
        and err.count("\n") == 1
    )
    assert said in err


def test_solve_writes_the_report_of_its_result(tmp_path, capsys):
    bag = str(ROOT / "bags/hu_noise")
    assert (
        main(
            [
                "solve",
                bag,
                "--quiet",
                "-o",
                str(tmp_path / "r.json"),
                "--report",
                str(tmp_path / "r.html"),
            ]
        )
        == 0
    )
    assert (
        main(
            [
                "report",
                str(tmp_path / "r.json"),
                "-o",
                str(tmp_path / "again.html"),
                "--truth",
                f"{bag}/truth.json",
            ]
        )
        == 0
    )
    html = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert html == (tmp_path / "again.html").read_text(encoding="utf-8")
    assert "Against the known truth" in html and "Mean residuals over the time" in html
    assert len(html) < 2_000_000
    capsys.readouterr()
    assert main(["solve", bag, "--report", str(tmp_path / "r.txt")]) == 2
    assert capsys.readouterr().err.endswith(
        "r.txt: a report is HTML or PDF; end the name in .html or .pdf\n"
    )
