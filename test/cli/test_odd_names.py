# SPDX-License-Identifier: Apache-2.0
"""Whatever a view is called: every place that shows a verdict shows its reasons whole."""

import csv
import html
import io
import json
from pathlib import Path

import pytest
import yaml

from selfcal_ros.applications.aerotech.read import load_cal
from selfcal_ros.cli.main import main
from selfcal_ros.outputs import to_ascii

VIEWS = {
    "run 1: rest": (0, [0, 0]),
    "run 1: turn x": (90, [0, 0]),
    "run 2: shift x": (0, [1, 0]),
    "run 2: shift y": (0, [0, 1]),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A session whose plate has another size in each view, solved in a batch of one bag."""
    folder = tmp_path_factory.mktemp("odd")
    plan = {
        "plan_id": "odd",
        "artifact": {"grid_size": 7, "grid_pitch": 0.01, "angular_count": 0},
        "views": [
            {
                "name": name,
                "rotation_deg": turn,
                "translation_pitch": shift,
                "repeats": 2,
            }
            for name, (turn, shift) in VIEWS.items()
        ],
    }
    (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    (folder / "sim.yaml").write_text(
        yaml.safe_dump(
            {
                "plan": str(folder / "plan.yaml"),
                "seed": 3,
                "noise": {"sigma_xy": 2.0e-8},
                "physics": {"plate_scale": 5.0e-6},
            }
        )
    )
    assert main(["simulate", str(folder / "sim.yaml"), "-o", str(folder / "bag")]) == 0
    main(["batch", str(folder / "bag"), "-o", str(folder / "batch"), "--workers", "1"])
    (result,) = (folder / "batch" / "results").iterdir()
    (folder / "r.json").write_text(result.read_text())
    return folder


def test_a_program_reads_which_view_to_measure_again(folder):
    cause, *_ = json.loads((folder / "r.json").read_text())["verdict"]["causes"]
    assert cause["name"] == "plate_strain" and cause["view"] in VIEWS
    assert {"view": cause["view"]} in cause["remedies"]
    (record,) = json.loads((folder / "batch" / "batch.json").read_text())["records"]
    assert record["causes"][0] == cause
    (row,) = csv.DictReader(io.StringIO((folder / "batch" / "table.csv").read_text()))
    assert (row["cause"], row["cause_view"]) == ("plate_strain", cause["view"])


def test_no_reason_is_cut(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    verdict = json.loads(Path("r.json").read_text())["verdict"]
    cause = verdict["causes"][0]
    reason, sentence = verdict["reasons"][0], verdict["sentence"]
    assert f" µm/m in view '{cause['view']}', " in reason
    assert reason.endswith(" times the size assumed")
    what = reason.removeprefix("the readings show ")
    (remedy,) = (each["action"] for each in cause["remedies"] if "action" in each)
    (model,) = (each["model"] for each in cause["remedies"] if "model" in each)
    remedy = f"solve with --model {model}, or {remedy}"
    assert cause["text"] == f"{what}: {remedy}"
    said, _, assumed = sentence.partition("; U assumes ")
    assert said == f"Good within an enlarged U: {cause['text']}"
    assert assumed.startswith("a microscope known to 1 % (k=1)")
    assert main(["report", "r.json", "-o", "r.html"]) == 0
    page = html.unescape(Path("r.html").read_text())
    for cell in (what, remedy):
        assert f">{cell}</td>" in page
    assert f"failed: {reason}" in page
    capsys.readouterr()
    assert (
        main(
            ["cal", "export", "r.json", "-o", "t.cal", "--x-axis", "1", "--y-axis", "2"]
        )
        == 0
    )
    assert f"because: {to_ascii(reason)}" in "\n".join(load_cal("t.cal").comments)
    capsys.readouterr()
    assert main(["diff", "r.json", "r.json"]) == 0
    assert (
        capsys.readouterr().err.splitlines()
        == [f"selfcal diff: r.json: {sentence}"] * 2
    )
    (record,) = json.loads(Path("batch/batch.json").read_text())["records"]
    assert record["message"] == sentence


def test_no_name_of_a_file_reaches_the_terminal_with_control_characters(
    folder, monkeypatch, capsys
):
    monkeypatch.chdir(folder)
    odd = "a\x1b[31m\u202e"
    Path(f"{odd}.json").write_text(Path("r.json").read_text())
    for line in (
        f"report {odd}.json -o {odd}.html --plot {odd}.svg",
        f"table {odd}.json -o {odd}.csv",
        f"cal export {odd}.json -o {odd}.cal",
        f"cal check {odd}.cal",
        f"export kmotion {odd}.json -o {odd}.txt",
        "history .",
        f"solve bag -o {odd}2.json",
    ):
        main(line.split(" "))
        shown = "".join(capsys.readouterr())
        assert "a\\x1b[31m\\u202e" in shown, line
        assert all(part.isprintable() for part in shown.split("\n")), line
    main(["table", f"{odd}.json", "-o", "-"])
    assert capsys.readouterr().out == Path(f"{odd}.csv").read_text()
