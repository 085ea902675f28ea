# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan``: every shipped plan, exit codes, JSON keys, files written."""

import json
from pathlib import Path

import pytest
import yaml

from selfcal_ros.cli.main import main
from selfcal_ros.files import read_yaml
from selfcal_ros.model.view import plan_from_dict

PLANS = sorted((Path(__file__).parents[2] / "config" / "plans").glob("*.yaml"))


def shipped(name):
    return str(PLANS[0].parent / f"{name}.yaml")


@pytest.mark.parametrize("path", PLANS, ids=lambda p: p.stem)
def test_every_shipped_plan_is_what_its_name_says(path, capsys):
    deficient = path.stem.startswith("deficient_")
    assert main(["plan", "check", str(path), "--json"]) == (3 if deficient else 0)
    found = json.loads(capsys.readouterr().out)
    assert found["plan_id"] == path.stem
    assert found["identifiable"] is not deficient
    assert (found["deficiency"] > 0) is deficient
    assert bool(found["modes"]) is deficient and bool(found["advice"]) is deficient
    if deficient:
        assert found["predicted"] is None
    else:
        assert 0.4 < found["predicted"]["rms_gain_xy"] < found["predicted"]["max_gain_xy"] < 1.5


def test_check_as_json_has_the_keys_of_the_contract(capsys):
    assert main(["plan", "check", shipped("hu"), "--json", "--map"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["rank"], found["unknowns"], found["deficiency"]) == (493, 493, 0)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    assert found["predicted"]["rms_gain_theta"] == pytest.approx(0.752, abs=5e-4)
    assert len(found["predicted"]["u_gx"]) == 11 and len(found["predicted"]["u_g_theta"]) == 24
    assert main(["plan", "check", shipped("hu"), "--json", "--theta-datum", "zero_mean"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["rms_gain_theta"] == pytest.approx(0.677, abs=5e-4)
    assert main(["plan", "check", shipped("qiao"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["predicted"]["rms_gain_theta"] is None


def test_check_in_words(capsys):
    assert main(["plan", "check", shipped("deficient_shifts")]) == 3
    text = capsys.readouterr().out
    assert "rank 491 of 493 unknowns, 2 unseen modes" in text
    assert "  - non-orthogonality of the axes" in text and "  - add a view turned by 90 deg" in text
    assert main(["plan", "check", shipped("hu"), "--map"]) == 0
    text = capsys.readouterr().out
    assert "XY     rms 0.8905   largest 1.2154" in text and "theta  rms 0.7523" in text
    assert len(text.splitlines()[-1].split()) == 11


def test_suggest_next_views(capsys, tmp_path):
    out = tmp_path / "next.yaml"
    assert main(["plan", "suggest", shipped("qiao"), "--json", "--top", "2", "-o", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["suggestions"]) == 2
    assert found["now"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    first = found["suggestions"][0]
    assert first["rms_gain_xy"] == pytest.approx(0.659, abs=5e-4)
    plan = plan_from_dict(read_yaml(out), "next")
    assert len(plan.views) == 4 and plan.views[-1].name == first["view"]["name"]
    assert main(["plan", "suggest", shipped("deficient_qiao_180")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("plan deficient_qiao_180: 10 modes unseen\n")


def test_suggest_does_not_write_over_its_plan(capsys, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_bytes(Path(shipped("qiao")).read_bytes())
    assert main(["plan", "suggest", str(plan), "-o", str(plan)]) == 2
    assert "would be written over" in capsys.readouterr().err
    assert plan.read_bytes() == Path(shipped("qiao")).read_bytes()


def test_suggest_the_best_plan(capsys, tmp_path):
    out = tmp_path / "best.yaml"
    assert main(["plan", "suggest", shipped("deficient_no_line"), "--views", "4", "-o",
                 str(out)]) == 0
    assert "best plan of 4 views" in capsys.readouterr().out
    assert main(["plan", "check", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    assert main(["plan", "suggest", shipped("qiao"), "--views", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found["views"]) == 3
    assert found["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)


@pytest.mark.parametrize(("arguments", "message"), [
    (["suggest", "--views", "2"], "--views: 2 views cannot identify the stage; give 3 or more"),
    (["suggest", "--top", "0"], "--top: 0 is not positive"),
    (["suggest", "-o", "/no/such/folder/p.yaml"], "cannot be written"),
])
def test_bad_arguments(arguments, message, capsys):
    assert main(["plan", arguments[0], shipped("qiao"), *arguments[1:]]) == 2
    assert message in capsys.readouterr().err


def test_bad_plans_name_the_place(tmp_path, capsys):
    data = yaml.safe_load(Path(shipped("hu")).read_text())
    data["views"][1]["rotation_deg"] = 45
    path = tmp_path / "off.yaml"
    path.write_text(yaml.safe_dump(data))
    assert main(["plan", "check", str(path)]) == 2
    error = capsys.readouterr().err
    assert "view 'rot90'" in error and len(error.splitlines()) == 1
    assert main(["plan", "check", str(tmp_path / "none.yaml")]) == 2
    assert "no such file" in capsys.readouterr().err
