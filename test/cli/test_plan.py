# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan``: every shipped plan, exit codes, JSON keys, files written."""

import contextlib
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from selfcal_ros.cli import plan as plan_verb
from selfcal_ros.cli import terminal
from selfcal_ros.cli.main import main
from selfcal_ros.cli.plan import field_note
from selfcal_ros.cli.plan_terms import length_m
from selfcal_ros.estimation.observability.plan_check import predict_plan
from selfcal_ros.files import read_json, read_yaml
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.plan_form import plan_from_dict

PLANS = sorted((Path(__file__).parents[2] / "config" / "plans").glob("*.yaml"))


def once(function):
    """Return a function that finds once what several tests ask of a plan."""
    known = {}

    def found(*args, **how):
        asked = repr((args, how))
        if asked not in known:
            known[asked] = function(*args, **how)
        return known[asked]

    return found


ONCE = {
    name: once(getattr(plan_verb, name))
    for name in ("check_plan", "predict_plan", "_with_terms", "plan_budget")
}


@pytest.fixture(autouse=True)
def judged_once(monkeypatch):
    for name, found in ONCE.items():
        monkeypatch.setattr(plan_verb, name, found)


def shipped(name):
    return str(PLANS[0].parent / f"{name}.yaml")


@pytest.mark.parametrize(
    "path", [path for path in PLANS if path.stem != "recheck"], ids=lambda p: p.stem
)
def test_every_shipped_plan_is_what_its_name_says(path, capsys):
    deficient = path.stem.startswith("deficient_")
    assert main(["plan", "check", str(path), "--json"]) == (3 if deficient else 0)
    found = json.loads(capsys.readouterr().out)
    assert found["plan_id"] == path.stem
    assert found["identifiable"] is not deficient
    assert (found["deficiency"] > 0) is deficient
    assert bool(found["modes"]) is deficient and bool(found["advice"]) is deficient
    assert (
        found["unchecked_sites"]
        == found["unchecked_lines"]
        == (None if deficient else 0)
    )
    if deficient:
        assert found["predicted"] is None
    else:
        assert (
            0.2
            < found["predicted"]["rms_gain_xy"]
            < found["predicted"]["max_gain_xy"]
            < 1.5
        )


def test_check_as_json_has_the_keys_of_the_contract(capsys):
    assert main(["plan", "check", shipped("hu"), "--json", "--map"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["rank"], found["unknowns"], found["deficiency"]) == (493, 493, 0)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    assert found["predicted"]["rms_gain_theta"] == pytest.approx(0.677, abs=5e-4)
    assert (
        len(found["predicted"]["u_gx"]) == 11
        and len(found["predicted"]["u_g_theta"]) == 24
    )
    assert (
        main(["plan", "check", shipped("hu"), "--json", "--theta-datum", "xy_axes"])
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["rms_gain_theta"] == pytest.approx(0.752, abs=5e-4)
    assert main(["plan", "check", shipped("qiao"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["predicted"]["rms_gain_theta"] is None


def test_check_tells_what_nothing_checks(tmp_path, capsys):
    text = (
        Path(shipped("hu")).read_text().replace("size: 11", "size: 11, grid_size_y: 5")
    )
    (tmp_path / "long.yaml").write_text(text)
    assert main(["plan", "check", str(tmp_path / "long.yaml")]) == 0
    assert (
        "\n30 sites depend on single readings that no other reading checks: another view "
        "would check them\n"
    ) in capsys.readouterr().out


def test_check_in_words(capsys):
    assert main(["plan", "check", shipped("deficient_shifts")]) == 3
    text = capsys.readouterr().out
    assert "rank 491 of 493 unknowns, 2 undetermined modes" in text
    assert (
        "  - non-orthogonality of the axes" in text
        and "  - add a view turned by 90°" in text
    )
    assert main(["plan", "check", shipped("hu"), "--map"]) == 0
    text = capsys.readouterr().out
    assert "XY     rms 0.8905   largest 1.2154" in text and "theta  rms 0.6766" in text
    assert len(text.splitlines()[-1].split()) == 11


def test_nodes_that_stay_unknown_are_counted(tmp_path, capsys):
    """A turn of 5 deg determines 45 of 81 nodes: an independent dense solution says so as well."""
    plan = {
        "plan_id": "p",
        "artifact": {"grid_size": 11, "grid_pitch": 0.01, "angular_count": 0},
        "map": {"grid_size": 9, "interpolation": "bicubic"},
        "views": [
            {"name": "a"},
            {"name": "b", "rotation_deg": 5},
            {"name": "c", "translation_pitch": [1, 0]},
        ],
    }
    (tmp_path / "plan.yaml").write_text(json.dumps(plan))
    spec = {"plan": "plan.yaml", "seed": 5, "noise": {"sigma_xy": 2e-8}}
    (tmp_path / "spec.yaml").write_text(json.dumps(spec))
    path, bag, out = (str(tmp_path / name) for name in ("plan.yaml", "bag", "r.json"))
    assert main(["plan", "check", path, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["unknown_sites"], found["deficiency"]) == (36, 0)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(2.010, abs=1e-3)
    assert main(["plan", "check", path]) == 0
    assert (
        "at 45 of 81 nodes of the map: the other 36 remain unknown"
        in capsys.readouterr().out
    )
    assert main(["simulate", str(tmp_path / "spec.yaml"), "-o", bag]) == 0
    # neither repeats nor a finer map test the nodes
    assert main(["solve", bag, "-o", out, "--model", "none"]) == 5
    assert "Calibrated at 45 of 81 sites from 3 views" in capsys.readouterr().out
    assert (
        np.isnan(np.array(read_json(out)["error_map"]["gx"], dtype=float)).sum() == 36
    )


def test_check_judges_every_term(capsys):
    assert (
        main(["plan", "check", shipped("hu_repeated"), "--json", "--sigma", "20nm"])
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    terms = {term["name"]: term for term in found["terms"]}
    assert list(terms) == [
        "microscope",
        "drift",
        "plate_scale",
        "plate_shape",
        "approach",
        "plate_strain",
    ]
    assert {
        "name",
        "told",
        "unseen_modes",
        "size",
        "unit",
        "effect_rms_m",
        "effect_max_m",
        "power",
    } < set(terms["drift"])
    assert (terms["plate_shape"]["told"], terms["plate_shape"]["unseen_modes"]) == (
        False,
        7,
    )
    assert terms["drift"]["told"] is True and terms["drift"]["unit"] == "m"
    assert terms["plate_shape"]["effect_rms_m"] == pytest.approx(31.66e-9, abs=1e-11)
    assert (
        found["predicted"]["rms_gain_xy_with_terms"]
        == found["predicted"]["rms_gain_xy"]
    )
    # half the noise notices more; an effect does not depend on noise, and grows with its size
    assert (
        main(
            [
                "plan",
                "check",
                shipped("hu_repeated"),
                "--json",
                "--sigma",
                "10e-9",
                "--against",
                "plate_shape:20e-9",
            ]
        )
        == 0
    )
    other = {
        term["name"]: term for term in json.loads(capsys.readouterr().out)["terms"]
    }
    assert other["approach"]["power"] > terms["approach"]["power"]
    assert other["approach"]["effect_rms_m"] == pytest.approx(
        terms["approach"]["effect_rms_m"]
    )
    assert other["plate_shape"]["effect_rms_m"] == pytest.approx(
        2 * terms["plate_shape"]["effect_rms_m"]
    )
    assert main(["plan", "check", shipped("deficient_shifts"), "--json"]) == 3
    assert json.loads(capsys.readouterr().out)["terms"] == []


def test_free_terms_that_a_plan_does_not_tell_are_refused(capsys, tmp_path):
    asked = ["--model", "drift", "--order", "there_and_back", "--repeats", "2"]
    assert main(["plan", "check", shipped("qiao"), *asked, "--drift-degree", "1"]) == 0
    text = capsys.readouterr().out
    assert "  XY with drift: rms 0.8905   largest 1.2154\n" in text
    assert "  drift        free  yes" in text
    assert (
        "assumed: order there_and_back; drifts of degree 1; 0.02 µm noise of one reading;"
        in text
    )
    assert main(["plan", "check", shipped("qiao"), *asked, "--drift-degree", "2"]) == 3
    text = capsys.readouterr().out
    assert "  - drift: 2 modes of the stage look like it\n" in text
    assert "  - drift: visit the marks in more than one order" in text
    assert main(["plan", "check", shipped("qiao"), *asked, "--json"]) == 3
    found = json.loads(capsys.readouterr().out)
    assert (found["identifiable"], found["deficiency"]) == (False, 2)
    assert found["predicted"]["rms_gain_xy_with_terms"] is None
    # the plan's own terms count as well, and an option goes before them
    data = yaml.safe_load(Path(shipped("qiao")).read_text())
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(data | {"model_terms": ["plate_shape"]}))
    assert main(["plan", "check", str(path)]) == 3
    assert (
        "  - plate_shape: add views shifted both ways along both axes, and one "
        "along a diagonal, or give it a size"
    ) in capsys.readouterr().out
    assert main(["plan", "check", str(path), "--model", "plate_shape:30e-9"]) == 0
    assert "XY with plate_shape:3e-08: rms" in capsys.readouterr().out


def test_check_shows_what_is_assumed_and_what_removes_it(capsys):
    asked = ["plan", "check", shipped("qiao"), "--placing", "0.02deg"]
    assert main([*asked, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["budget"]
    assert (found["sigma_m"], found["sigma_rad"]) == (
        20e-9,
        pytest.approx(math.radians(1e-3)),
    )
    lines = {line["component"]: line for line in found["lines"]}
    assert list(lines) == [
        "reading noise",
        "microscope",
        "plate_shape",
        "plate_strain",
        "drift",
    ]
    assert lines["drift"]["removal"]["text"].startswith("visit the marks in the order ")
    assert lines["plate_shape"]["removal"]["text"].startswith(
        "add an unturned view shifted by -1 pitch along X"
    )
    microscope = lines["microscope"]
    assert (microscope["quantity"], microscope["u"], microscope["source"]) == (
        "xy",
        0.01,
        "default",
    )
    assert 0.05 < microscope["share"] < 0.5 and sum(
        line["share"] for line in lines.values()
    ) == pytest.approx(1)
    assert microscope["removal"] is None  # of a tenth of u^2
    assert found["U_xy"] == pytest.approx(
        2 * math.hypot(*(line["effect_rms"] for line in lines.values()))
    )
    assert found["U_xy_noise"] == pytest.approx(
        2 * lines["reading noise"]["effect_rms"]
    )
    assert main([*asked, "--model", "drift:0", "--json"]) == 0
    of_lines = json.loads(capsys.readouterr().out)["budget"]["lines"]
    (removal,) = (
        line["removal"] for line in of_lines if line["component"] == "microscope"
    )
    assert removal["kind"] == "check_stops"
    assert removal["effect_rms"] < 0.2 * microscope["effect_rms"]
    assert main([*asked, "--model", "drift:0"]) == 0
    assert "%  add check_stops: {marks: 5, offset: 20e-6}: " in capsys.readouterr().out
    assert main(asked) == 0
    text = capsys.readouterr().out
    larger = found["U_xy_if_larger"]
    assert 2 * found["U_xy"] < larger < 3 * found["U_xy"]
    assert (
        f"from noise alone 0.0356 µm; {larger * 1e6:.3g} µm if all that is assumed"
        in text
    )
    assert main([*asked, "--model", "none", "--json"]) == 0
    assert [
        line["component"]
        for line in json.loads(capsys.readouterr().out)["budget"]["lines"]
    ] == ["reading noise"]
    # what the plan declares takes the place of the default; lines have a budget of their own
    assert (
        main(
            [
                "plan",
                "check",
                shipped("hu_repeated"),
                "--json",
                "--sigma-theta",
                "0.04arcsec",
                "--model",
                "plate_strain:3e-7",
            ]
        )
        == 0
    )
    lines = {
        (line["quantity"], line["component"]): line
        for line in json.loads(capsys.readouterr().out)["budget"]["lines"]
    }
    strain, circle = lines["xy", "plate_strain"], lines["theta", "line_eccentricity"]
    assert (strain["source"], strain["removal"]["kind"]) == ("declared", "certificate")
    assert strain["removal"]["text"].startswith("declare a smaller plate_strain:SIZE")
    assert (circle["source"], circle["unit"]) == ("default", "rad") and circle[
        "share"
    ] > 0.9


def test_check_stops_are_a_next_step_where_the_microscope_costs_most(capsys, tmp_path):
    out = tmp_path / "next.yaml"
    assert (
        main(
            [
                "plan",
                "suggest",
                shipped("qiao"),
                "--placing",
                "0.02deg",
                "--stage-error",
                "10um",
                "--sigma",
                "1nm",
                "--against",
                "plate_shape:1e-12",
                "--json",
                "-o",
                str(out),
            ]
        )
        == 0
    )
    first = json.loads(capsys.readouterr().out)["suggestions"][0]
    assert first["text"] == "add check_stops: {marks: 5, offset: 20e-6}"
    assert (first["view"], first["visit_order"]) == (None, None)
    plan = plan_from_dict(read_yaml(out), "next")
    assert {(view.check_marks, view.check_offset_m) for view in plan.views} == {
        (5, 20e-6)
    }


def test_an_order_that_is_cut_off_is_said(capsys):
    asked = [
        "plan",
        "check",
        shipped("hu_repeated"),
        "--order",
        "x_back_y_back",
        "--repeats",
    ]
    assert main([*asked, "3"]) == 0
    assert (
        "  the order x_back_y_back needs 4 repeats: it is truncated in the views 'identity', "
        "'rot90', 'shift_x'\n"
    ) in capsys.readouterr().out
    assert main([*asked, "4"]) == 0
    assert "truncated" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["hu_repeated", "six_views", "resistant", "recheck"])
def test_a_shipped_plan_has_nothing_against_itself(capsys, name):
    """The result that recheck.yaml names is not shipped."""
    assert main(["plan", "check", shipped(name)]) == 0
    said = capsys.readouterr()
    assert not said.err and "truncated" not in said.out


def test_a_plan_of_a_known_plate_leaves_open_whether_it_is_identified(capsys):
    assert main(["plan", "check", shipped("recheck"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["identifiable"] is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["--sigma", "20 miles"],
            "--sigma: '20 miles' is not a positive length; give m, or a number "
            "and one of m, mm, um, nm",
        ),
        (["--sigma=-1nm"], "--sigma: '-1nm' is not a positive length"),
        (["--stop-error", "0"], "--stop-error: '0' is not a positive length"),
        (["--stage-error=-1nm"], "--stage-error: '-1nm' is not a positive length"),
        (
            ["--sigma-theta", "3 turns"],
            "--sigma-theta: '3 turns' is not a positive angle; give rad, or a number "
            "and one of rad, mrad, urad, deg, arcsec",
        ),
        (["--placing", "0"], "--placing: '0' is not a positive angle"),
        (
            ["--drift-degree", "10"],
            "--drift-degree: 10 is not a degree of a drift; give 1 to 9",
        ),
        (
            ["--drift-degree", "0"],
            "--drift-degree: 0 is not a degree of a drift; give 1 to 9",
        ),
        (["--order", "spiral"], "--order: 'spiral' is not a visiting order"),
        (["--model", "creep"], "--model: the term 'creep' is unknown"),
        (
            ["--model", "yaw"],
            "model: yaw: no reading of this plan depends on it; leave it out",
        ),
        (
            ["--model", "line_scale"],
            "model: line_scale: no reading of this plan depends on it",
        ),
        (
            ["--against", "drift"],
            "--against: drift: a size is missing; write drift:SIZE",
        ),
        (["--repeats", "0"], "--repeats: 0 is not positive; give 1 or more"),
    ],
)
def test_bad_options_of_check(arguments, message, capsys):
    assert main(["plan", "check", shipped("qiao"), *arguments]) == 2
    error = capsys.readouterr().err
    assert message in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    "text", ["20e-9", "20nm", "20 nm", "0.02um", "0.02µm", "2e-5mm", "2E-8 m"]
)
def test_lengths_with_and_without_a_unit(text):
    assert length_m(text, "--sigma") == pytest.approx(20e-9, rel=1e-12)


def test_suggest_next_views(capsys, tmp_path):
    out = tmp_path / "next.yaml"
    assert (
        main(
            [
                "plan",
                "suggest",
                shipped("qiao"),
                "--json",
                "--top",
                "2",
                "-o",
                str(out),
                "--against",
                "none",
            ]
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert len(found["suggestions"]) == 2
    assert found["now"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    first = found["suggestions"][0]
    assert first["rms_gain_xy"] == pytest.approx(0.659, abs=5e-4)
    plan = plan_from_dict(read_yaml(out), "next")
    assert len(plan.views) == 4 and plan.views[-1].name == first["view"]["name"]
    assert main(["plan", "suggest", shipped("deficient_qiao_180")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("plan deficient_qiao_180: 10 undetermined modes\n")


def test_suggest_against_terms(capsys, tmp_path):
    out = tmp_path / "next.yaml"
    asked = [
        "plan",
        "suggest",
        shipped("qiao"),
        "--against",
        "drift:500e-9",
        "--order",
        "raster",
    ]
    assert main([*asked, "--top", "1", "-o", str(out)]) == 0
    text = capsys.readouterr().out
    assert (
        text.startswith("plan qiao: u XY rms ") and " µm  max " in text.splitlines()[0]
    )
    assert "visit the marks in the order x_back_y_back, 4 repeats for 1" in text
    plan = plan_from_dict(read_yaml(out), "next")
    assert {(v.visit_order, v.repeats) for v in plan.views} == {("x_back_y_back", 4)}
    assert main([*asked, "--json", "--sigma", "10nm"]) == 0
    found = json.loads(capsys.readouterr().out)
    first = found["suggestions"][0]
    assert first["view"] is None and first["visit_order"] == "x_back_y_back"
    assert first["u_rms_m"] == pytest.approx(first["rms_gain_xy"] * 10e-9)
    assert found["now"]["u_max_m"] == pytest.approx(found["now"]["max_gain_xy"] * 10e-9)
    # terms of the plan itself count as well, and stay in what is written
    data = yaml.safe_load(Path(shipped("qiao")).read_text())
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(data | {"model_terms": ["plate_shape:30e-9"]}))
    assert main(["plan", "suggest", str(path), "-o", str(out), "--force"]) == 0
    assert "  u XY rms " in capsys.readouterr().out
    assert plan_from_dict(read_yaml(out), "next").model_terms == ("plate_shape:3e-08",)


def test_the_best_plan_is_judged_as_it_is_written(capsys, tmp_path):
    """With the order and the repeats of the plan's grid views, which tell a drift."""
    plan, out = tmp_path / "plan.yaml", tmp_path / "best.yaml"
    plan.write_text(
        yaml.safe_dump(
            {
                "plan_id": "p",
                "visit_order": "x_back_y_back",
                "model_terms": ["drift"],
                "artifact": {"grid_size": 3, "grid_pitch": 0.01, "angular_count": 4},
                "views": [
                    {"name": "a", "repeats": 4},
                    {"name": "b", "rotation_deg": 90, "repeats": 4},
                    {"name": "c", "translation_pitch": [1, 0], "repeats": 4},
                    {"name": "l", "rotation_deg": 90, "grid": False, "repeats": 1},
                ],
            }
        )
    )
    assert (
        main(["plan", "suggest", str(plan), "--views", "4", "--json", "-o", str(out)])
        == 0
    )
    best = json.loads(capsys.readouterr().out)
    assert best["deficiency"] == 0
    assert {view["repeats"] for view in best["views"]} == {4}
    assert main(["plan", "check", str(out), "--json", "--sigma", "20nm"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert best["u_rms_m"] == pytest.approx(found["budget"]["U_xy"] / 2)
    # by default the terms that are assumed of every measurement count, too
    of_model = found["predicted"]["rms_u_xy_um_with_terms"] * 1e-6
    assert best["u_rms_m"] > 1.0001 * of_model
    assert (
        main(
            [
                "plan",
                "suggest",
                str(plan),
                "--views",
                "4",
                "--json",
                "--against",
                "none",
            ]
        )
        == 0
    )
    assert json.loads(capsys.readouterr().out)["u_rms_m"] < 1.0001 * of_model


def test_suggest_does_not_write_over_its_plan(capsys, tmp_path):
    plan = tmp_path / "plan.yaml"
    plan.write_bytes(Path(shipped("qiao")).read_bytes())
    assert main(["plan", "suggest", str(plan), "-o", str(plan)]) == 2
    assert "would be overwritten" in capsys.readouterr().err
    assert plan.read_bytes() == Path(shipped("qiao")).read_bytes()


def test_suggest_the_best_plan(capsys, tmp_path):
    out = tmp_path / "best.yaml"
    assert (
        main(
            [
                "plan",
                "suggest",
                shipped("deficient_no_line"),
                "--views",
                "4",
                "-o",
                str(out),
            ]
        )
        == 0
    )
    assert "best plan of 4 views" in capsys.readouterr().out
    assert main(["plan", "check", str(out), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)
    assert (
        main(
            [
                "plan",
                "suggest",
                shipped("qiao"),
                "--views",
                "3",
                "--json",
                "--against",
                "none",
            ]
        )
        == 0
    )
    found = json.loads(capsys.readouterr().out)
    assert len(found["views"]) == 3
    assert found["rms_gain_xy"] == pytest.approx(0.890, abs=5e-4)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["suggest", "--views", "2"],
            "--views: 2 views cannot identify the stage; give 3 or more",
        ),
        (["suggest", "--top", "0"], "--top: 0 is not positive"),
        (
            ["suggest", "--views", "4", "--top", "2"],
            "--top: with --views one plan is found, not a list; omit it",
        ),
        (["suggest", "-o", "/no/such/folder/p.yaml"], "cannot be written"),
    ],
)
def test_bad_arguments(arguments, message, capsys):
    assert main(["plan", arguments[0], shipped("qiao"), *arguments[1:]]) == 2
    assert message in capsys.readouterr().err


def test_the_best_plan_off_the_lattice_identifies_the_stage(tmp_path, capsys):
    """Half a turn leaves nodes unknown, and what is known of the others looks small."""
    best = tmp_path / "best.yaml"
    assert (
        main(["plan", "suggest", shipped("general"), "--views", "3", "-o", str(best)])
        == 0
    )
    capsys.readouterr()
    assert main(["plan", "check", str(best), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["unknown_sites"] == 0
    assert yaml.safe_load(best.read_text())["map"]["grid_size"] == 7


def test_bad_plans_name_the_place(tmp_path, capsys):
    data = yaml.safe_load(Path(shipped("hu")).read_text())
    data["views"][1]["rotation_deg"] = 46
    data["views"][1]["angular"] = True
    path = tmp_path / "off.yaml"
    path.write_text(yaml.safe_dump(data))
    assert main(["plan", "check", str(path)]) == 2
    error = capsys.readouterr().err
    assert "view 'rot90'" in error and len(error.splitlines()) == 1
    assert main(["plan", "check", str(tmp_path / "none.yaml")]) == 2
    assert "no such file" in capsys.readouterr().err


def test_progress_shows_only_what_takes_long(monkeypatch):
    clock, drawn = [100.0], []

    @contextlib.contextmanager
    def bar(label):
        drawn.append(label)
        yield lambda *at: drawn.append(at)

    monkeypatch.setattr(terminal.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(terminal, "progress_bar", bar)
    with terminal.late_progress("plans") as advance:
        advance(1, 9)
        clock[0] = 101.9
        advance(2, 9)
        assert drawn == []
        clock[0] = 102.0
        advance(3, 9)
        advance(4, None)
    assert drawn == ["plans", (3, 9), (4, None)]


def test_a_large_field_is_said_to_be_predicted_on_a_smaller_one(monkeypatch):
    plan = plan_from_dict(read_yaml(shipped("hu")), "p")
    assert field_note(predict_plan(plan, ThetaDatum.ZERO_MEAN), plan) == ""
    where = "selfcal_ros.estimation.observability.plan_check"
    monkeypatch.setattr(f"{where}.UNASKED_SITES", 20)
    monkeypatch.setattr(f"{where}.PROXY_SIZE", 5)
    assert field_note(predict_plan(plan, ThetaDatum.ZERO_MEAN), plan) == (
        "predicted for a field of 5 x 5 sites; XY is about 5 % larger for each doubling of the "
        "field"
    )


def test_images_tell_the_camera_and_suffice_with_two_turns(tmp_path, capsys):
    plan = {
        "plan_id": "camera",
        "artifact": {"grid_size": 7, "grid_pitch": 1e-3, "angular_count": 0},
        "views": [{"name": "a"}, {"name": "b", "rotation_deg": 90}],
        "image": {"nx": 3, "ny": 3},
    }
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(plan))
    assert main(["plan", "check", str(tmp_path / "p.yaml")]) == 0
    told = capsys.readouterr().out
    assert "images of 3 x 3 marks" in told
    assert "images show scale, turn, distortion and sign of the camera" in told
    assert main(["plan", "check", str(tmp_path / "p.yaml"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["predicted"]["rms_gain_xy"] == pytest.approx(0.2722, abs=1e-4)
    assert "microscope" not in [line["component"] for line in found["budget"]["lines"]]
    plan["views"] = plan["views"][:1]
    (tmp_path / "p.yaml").write_text(yaml.safe_dump(plan))
    assert main(["plan", "check", str(tmp_path / "p.yaml")]) == 3
    assert (
        main(
            [
                "plan",
                "suggest",
                str(tmp_path / "p.yaml"),
                "-o",
                str(tmp_path / "q.yaml"),
            ]
        )
        == 0
    )
    better = plan_from_dict(read_yaml(tmp_path / "q.yaml"), "q")
    assert better.views[1].image == better.views[0].image
    assert better.views[1].image.nx == 3


def test_a_size_of_0_takes_a_default_term_out_of_the_predicted_u(capsys):
    components = {}
    for size in ("5e-9", "0"):
        words = [
            "plan",
            "check",
            shipped("hu"),
            "--json",
            "--model",
            f"plate_shape:{size}",
        ]
        assert main(words) == 0
        lines = json.loads(capsys.readouterr().out)["budget"]["lines"]
        components[size] = {
            line["component"] for line in lines if line["quantity"] == "xy"
        }
    assert components["5e-9"] - components["0"] == {"plate_shape"}


def test_the_predictions_stand_together_below_their_heading(capsys):
    options = ["--model", "drift,plate_shape:30e-9", "--sigma", "20nm"]
    assert main(["plan", "check", shipped("hu_repeated"), *options]) == 0
    head, _, text = capsys.readouterr().out.partition("predicted standard uncertainty,")
    assert "check stops: 5 marks" in head and "every reading lies at a node" in head
    _, *predicted = text.partition("predicted uncertainty budget")[0].splitlines()
    assert [line.split(" rms ")[0].strip() for line in predicted] == [
        "XY",
        "theta",
        "XY",
        "XY with drift, plate_shape:3e-08:",
        "XY with drift, plate_shape:3e-08:",
    ]


def test_a_plan_whose_harmonics_nothing_tests_says_so_before_it_is_measured(
    tmp_path, capsys
):
    text = Path(shipped("rotary")).read_text()
    fewer = tmp_path / "two_views.yaml"
    fewer.write_text(
        text.replace(
            "  - {name: turned_101, rotation_deg: 101, grid: false}\n", ""
        ).replace("[1, 0]}", "[1, 0], angular: false}")
    )
    said = "do not show whether the harmonics of the angular map suffice"
    for path, is_said in ((fewer, True), (shipped("rotary"), False)):
        assert main(["plan", "check", str(path)]) == 0
        assert (said in capsys.readouterr().out) is is_said
        main(["plan", "check", str(path), "--json"])
        assert json.loads(capsys.readouterr().out)["harmonics_untested"] is is_said


def test_a_plan_that_does_not_show_the_sign_of_the_lines_says_so(tmp_path, capsys):
    text = Path(shipped("rotary")).read_text()
    once = tmp_path / "once.yaml"
    once.write_text(text.replace("[1, 0]}", "[1, 0], angular: false}"))
    said = "marks and lines are read together in fewer than two views: the sign of "
    for path, is_said in ((once, True), (shipped("rotary"), False)):
        assert main(["plan", "check", str(path)]) == 0
        assert (said in capsys.readouterr().out) is is_said


@pytest.mark.parametrize(("marks", "is_said"), [(4, True), (7, False)])
def test_repeats_do_not_test_the_nodes_with_few_marks(tmp_path, capsys, marks, is_said):
    data = {
        "plan_id": "few",
        "artifact": {"grid_size": marks, "grid_pitch": 0.01, "angular_count": 0},
        "map": {"grid_size": 3, "interpolation": "bilinear"},
        "views": [
            {"name": "as_it_is", "repeats": 4},
            {"name": "turned", "rotation_deg": 37, "repeats": 4},
            {"name": "shifted", "translation_pitch": [0.5, 0.4], "repeats": 4},
        ],
    }
    path = tmp_path / "plan.yaml"
    path.write_text(yaml.safe_dump(data))
    assert main(["plan", "check", str(path)]) == 0
    said = capsys.readouterr().out
    assert ("whether the nodes of the map suffice" in said) is is_said


def test_a_plan_whose_nodes_nothing_tests_says_so_before_it_is_measured(
    tmp_path, capsys
):
    data = {
        "plan_id": "fine",
        "artifact": {"grid_size": 23, "grid_pitch": 0.01, "angular_count": 0},
        "map": {"grid_size": 19},
        "views": [
            {"name": "as_it_is"},
            {"name": "turned", "rotation_deg": 90},
            {"name": "shifted", "rotation_deg": 37, "translation_pitch": [0.6, -0.7]},
        ],
    }
    said = "do not show whether the nodes of the map suffice"
    path = tmp_path / "plan.yaml"
    for repeats, nodes, is_said in ((1, 19, True), (2, 19, False), (1, 17, False)):
        for view in data["views"]:
            view["repeats"] = repeats
        data["map"]["grid_size"] = nodes
        path.write_text(yaml.safe_dump(data))
        assert main(["plan", "check", str(path)]) == 0
        assert (said in capsys.readouterr().out) is is_said
        main(["plan", "check", str(path), "--json"])
        assert json.loads(capsys.readouterr().out)["nodes_untested"] is is_said
