# SPDX-License-Identifier: Apache-2.0
"""``selfcal recheck``: what it prints, writes and refuses."""

import json
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.files import read_json
from selfcal_ros.settings.estimator import read_plan

EXACT = Path(__file__).parents[2] / "bags/hu_exact"
PLAN = {
    "plan_id": "first",
    "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 8},
}
SEEDS = {
    "seed": 3,
    "truth": {"phi": 1e-4, "t": 1e-5},
    "noise": {"sigma_xy": 2e-8, "sigma_theta": 2e-6},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A calibration, a view of its stage, one of a stage that has changed, and the result."""
    folder = tmp_path_factory.mktemp("recheck")
    first = [
        {"name": "identity"},
        {"name": "rot90", "rotation_deg": 90},
        {"name": "line", "rotation_deg": 45, "grid": False},
        {"name": "shift_x", "translation_pitch": [1, 0]},
    ]
    for name, views, more in (
        ("first", first, {"noise_seed": 1}),
        ("same", [{"name": "again"}], {"noise_seed": 2}),
        (
            "bent",
            [{"name": "again"}],
            {"noise_seed": 2, "physics": {"stage_bend": 2e-7}},
        ),
    ):
        spec = SEEDS | more | {"plan": PLAN | {"views": views, "plan_id": name}}
        (folder / f"{name}.yaml").write_text(json.dumps(spec))  # YAML, too
        assert (
            main(["simulate", str(folder / f"{name}.yaml"), "-o", str(folder / name)])
            == 0
        )
    assert (
        main(["solve", str(folder / "first"), "-o", str(folder / "r.json"), "--quiet"])
        == 0
    )
    return folder


def test_the_calibration_is_not_overwritten(folder, capsys):
    plate = folder / "r.json"
    before = plate.read_bytes()
    given = [str(plate), str(folder / "same"), "-o", str(plate)]
    assert main(["recheck", *given, "--force"]) == 2
    assert "r.json: would be overwritten" in capsys.readouterr().err
    assert plate.read_bytes() == before


def test_a_stage_that_is_as_it_was(folder, capsys):
    out = folder / "same.json"
    assert (
        main(
            [
                "recheck",
                str(folder / "r.json"),
                str(folder / "same"),
                "-o",
                str(out),
                "--budget",
            ]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert text.startswith(
        "Still good: no change since r.json beyond its uncertainty (p = "
    )
    assert "change since" in text and "against the plate (k=1)" in text
    assert "theta  clearest at line" in text
    assert f"covariance of the plate's map in {folder / 'r.json'}" in text
    data = read_json(out)
    found = data["recheck"]
    assert found["changed"] is False and found["p"] > 0.05
    assert found["of"] == str(folder / "r.json")
    assert found["largest"]["u"] > 0 and data["verdict"]["qualified"] is True
    assert data["warnings"] == []
    assert main(["diff", str(folder / "r.json"), str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["significance_xy"]["correlated"] is True
    assert main(["report", str(out), "-o", str(folder / "same.html")]) == 0
    page = (folder / "same.html").read_text()
    assert "Change since" in page and "detectable in 9 of 10 cases" in page


def test_the_calibrations_own_recording_is_refused(folder, capsys):
    assert main(["recheck", str(folder / "r.json"), str(folder / "first")]) == 2
    assert capsys.readouterr().err == (
        f"selfcal recheck: {folder / 'first'}: the recording that {folder / 'r.json'} was computed "
        "from: it would be compared with itself; record a new view of the plate\n"
    )


def test_a_stage_that_has_changed(folder, capsys):
    out = folder / "bent.json"
    seen = ["recheck", str(folder / "r.json"), str(folder / "bent"), "-o", str(out)]
    assert main(seen) == 5
    assert "a single pass cannot tell a change from drift" in capsys.readouterr().err
    assert (
        main(
            [
                *seen,
                "--force",
                "--model",
                "drift:1e-9",
                "--report",
                str(folder / "bent.html"),
            ]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert text.startswith(
        "Changed since r.json: calibrate again, provided this is the same "
    )
    assert (
        "and the camera was not touched (if it was, declare it: --microscope 0.01); "
        in text
    )
    data = read_json(out)
    assert data["recheck"]["changed"] is True and data["recheck"]["p"] < 1e-3
    assert data["warnings"][0].startswith("Changed since r.json")
    assert (
        abs(data["recheck"]["largest"]["change"]) > 3 * data["recheck"]["largest"]["u"]
    )
    assert "Changed since r.json" in (folder / "bent.html").read_text()


@pytest.mark.parametrize(
    "option", ["--validate", "--robust", "--method=law", "--uncertainty=never"]
)
def test_options_that_one_view_cannot_use_are_not_there(option, folder, capsys):
    with pytest.raises(SystemExit) as ended:
        main(["recheck", str(folder / "r.json"), str(folder / "same"), option])
    assert ended.value.code == 2
    assert (
        f"the option {option.partition('=')[0]} is unknown" in capsys.readouterr().err
    )


def test_a_reference_of_its_own_is_refused_by_its_option(folder, capsys):
    asked = ["recheck", str(folder / "r.json"), str(folder / "same")]
    assert main([*asked, "--reference", "artifact:1e-6:1e-7"]) == 2
    assert capsys.readouterr().err.startswith("selfcal recheck: --reference: a recheck")


@pytest.mark.parametrize(
    ("option", "where"), [("--validate", "--validate"), ("--robust", "robust")]
)
def test_a_plan_of_a_known_plate_refuses_what_needs_more_than_one_view(
    option, where, folder, capsys
):
    plan = {
        "plan_id": "m",
        "artifact_from": str(folder / "r.json"),
        "views": [{"name": "again"}],
    }
    (folder / "view.yaml").write_text(
        json.dumps(SEEDS | {"noise_seed": 4, "plan": plan})
    )
    if not (folder / "view").exists():
        assert (
            main(["simulate", str(folder / "view.yaml"), "-o", str(folder / "view")])
            == 0
        )
    capsys.readouterr()
    assert main(["solve", str(folder / "view"), option]) == 2
    assert (
        f"{where}: the plate is known from {folder / 'r.json'}"
        in capsys.readouterr().err
    )


def test_a_recheck_knows_no_plate(folder, capsys):
    out = str(folder / "again.json")
    assert (
        main(["recheck", str(folder / "r.json"), str(folder / "same"), "-o", out]) == 0
    )
    assert main(["recheck", out, str(folder / "same")]) == 2
    assert "is itself a recheck" in capsys.readouterr().err


def test_a_plan_names_the_calibration_of_its_plate(folder, capsys):
    """FitOfKind, relative to the plan: the plate is that of the result."""
    plan = {
        "plan_id": "morning",
        "artifact_from": "r.json",
        "views": [{"name": "again"}],
    }
    (folder / "plan.yaml").write_text(json.dumps(plan))
    assert main(["plan", "check", str(folder / "plan.yaml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["artifact_from"] == str(folder / "r.json")
    wanted = found["predicted"]
    assert main(["plan", "check", str(folder / "plan.yaml")]) == 0
    text = capsys.readouterr().out
    assert f"1 view of the plate calibrated in {folder / 'r.json'}" in text
    assert (
        f"change of XY since the calibration: rms {wanted['rms_gain_change']:.4f}"
        in text
    )
    assert "a single pass cannot tell a change from drift" in text
    spec = SEEDS | {"noise_seed": 2, "plan": "plan.yaml"}
    (folder / "morning.yaml").write_text(json.dumps(spec))
    bag, one, other = (
        str(folder / name) for name in ("morning", "one.json", "other.json")
    )
    assert main(["simulate", str(folder / "morning.yaml"), "-o", bag]) == 0
    bare = ["--model", "none"]
    assert main(["solve", bag, "-o", one, *bare]) == 0
    assert main(["recheck", str(folder / "r.json"), bag, "-o", other, *bare]) == 0
    one, other = read_json(one), read_json(other)
    for result in (one, other):
        del result["provenance"]["created"]
    assert one == other
    u = np.array([one["error_map"]["u_gx"], one["error_map"]["u_gy"]])
    assert np.sqrt(np.mean(u**2)) / one["noise"]["sigma_xy"] == pytest.approx(
        wanted["rms_gain_xy"], rel=1e-3
    )
    assert one["recheck"]["u_rms"] / one["noise"]["sigma_xy"] == pytest.approx(
        wanted["rms_gain_change"], rel=1e-3
    )


def test_nodes_that_a_shifted_plate_does_not_reach_are_counted(folder, capsys):
    plan = {
        "plan_id": "beside",
        "artifact_from": "r.json",
        "views": [{"name": "beside", "translation_pitch": [1, 0]}],
    }
    (folder / "beside.yaml").write_text(json.dumps(plan))
    assert main(["plan", "check", str(folder / "beside.yaml"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unknown_sites"] == 5
    assert main(["plan", "check", str(folder / "beside.yaml")]) == 0
    assert "\n5 of 25 nodes of the map remain unknown\n" in capsys.readouterr().out


def test_plans_without_the_result_that_they_name(folder, tmp_path, capsys):
    """A plan that describes its plate loads without it."""
    path = tmp_path / "plan.yaml"
    plan = {"plan_id": "p", "artifact_from": "none.json", "views": [{"name": "again"}]}
    path.write_text(json.dumps(plan))
    assert main(["plan", "check", str(path)]) == 2
    assert f"{tmp_path / 'none.json'}: no such file" in capsys.readouterr().err
    path.write_text(json.dumps(plan | {"artifact": PLAN["artifact"]}))
    assert read_plan(path).artifact_from == str(tmp_path / "none.json")
    path.write_text(json.dumps(plan | {"artifact_from": str(folder / "r.json")}))
    assert main(["plan", "suggest", str(path)]) == 2
    assert "its plate is already calibrated" in capsys.readouterr().err


def test_readings_without_noise_are_refused_in_one_line(tmp_path, capsys):
    out = str(tmp_path / "r.json")
    assert main(["solve", str(EXACT), "-o", out, "--quiet"]) == 0
    capsys.readouterr()
    assert main(["recheck", out, str(EXACT)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        "readings: they or those of the calibration have no noise against which" in line
    )
