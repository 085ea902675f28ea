# SPDX-License-Identifier: Apache-2.0
"""A camera that was touched is not taken for a changed stage, nor a changed stage for a camera."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.estimation.recheck.solve import recheck, recheck_of
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan, View
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.truth import simulate_measurements

PLATE = Artifact(9, 0.01)
FIRST = Plan(
    "first",
    PLATE,
    tuple(
        View(name, turn, shift, True, False, repeats=2)
        for name, turn, shift in (
            ("a", 0.0, (0.0, 0.0)),
            ("b", np.pi / 2, (0.0, 0.0)),
            ("c", 0.0, (0.01, 0.0)),
            ("d", 0.0, (0.0, -0.01)),
        )
    ),
)
STOPS = {"check_marks": 5, "check_offset_m": 20e-6}


def settings(sense=Sense.MICROSCOPE_MOVES, stop_m=0.0, noise_m=20e-9):
    return CellSettings(
        sense, noise_m, 2e-6, stop_sigma_m=stop_m, visit_order="there_and_back"
    )


@cache
def calibrated(sense=Sense.MICROSCOPE_MOVES):
    """Return the truth of a cell and its known plate."""
    rng = np.random.default_rng(8)
    truth = random_truth(
        PLATE,
        len(FIRST.views),
        rng,
        Spread(phi_rad=1e-3, t_m=3e-5, correlation_pitches=3.0),
    )
    readings = simulate_measurements(
        truth, FIRST, rng, visits=True, settings=settings(sense)
    )
    return truth, known_plate(
        worded(calibrate(readings, Options(causes=False))), "first.json"
    )


def later(truth, view, sense=Sense.MICROSCOPE_MOVES, **cell):
    """Return the readings of one view of the plate."""
    plan = Plan("again", PLATE, (replace(FIRST.views[0], name="again", **view),))
    return simulate_measurements(
        truth,
        plan,
        np.random.default_rng(9),
        visits=True,
        settings=settings(sense, **cell),
    )


def rechecked(change, view=None, sense=Sense.MICROSCOPE_MOVES, **cell):
    truth, plate = calibrated(sense)
    return recheck(later(change(truth), view or {}, sense, **cell), Options(), plate)


def touched(scale=0.0, turn=0.0):
    microscope = Spread(microscope_scale=scale, microscope_rotation_rad=turn).microscope
    return lambda truth: replace(truth, microscope=microscope)


def another_stage(truth):
    x, y = PLATE.x_m, PLATE.y_m
    return replace(
        truth,
        g=truth.g + 1e-7 * np.stack([np.sin(60 * x + 40 * y), np.cos(70 * x - 20 * y)]),
    )


def larger_errors(truth):
    return replace(truth, g=1.5 * truth.g)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize(
    "scale, turn", [(-0.1, 0.0), (0.1, 0.0), (0.0, 0.1), (-0.05, -0.1)]
)
def test_a_touched_camera_is_named_beside_a_changed_stage(scale, turn, sense):
    result = rechecked(touched(scale, turn), sense=sense)
    assert result.recheck.changed and result.verdict.grade is Grade.NOT_QUALIFIED
    (found,) = result.verdict.failed
    assert found.name == "changed_or_microscope"
    for name, true in (("scale", scale), ("turn", turn)):
        assert abs(getattr(found, name) - true) < 4 * getattr(found, f"u_{name}") < 0.1


@pytest.mark.parametrize("view", [{}, STOPS], ids=["", "check stops"])
def test_a_changed_stage_that_no_camera_explains_is_changed(view):
    result = rechecked(another_stage, view)
    assert result.verdict.qualified and result.findings[0].name == "changed"


def test_errors_that_have_grown_are_a_changed_stage_where_check_stops_show_the_camera():
    result = rechecked(larger_errors, STOPS)
    assert result.verdict.qualified and [found.name for found in result.findings] == [
        "changed"
    ]


@pytest.mark.parametrize("view, stop_m", [(STOPS, 0.0), ({}, 30e-6), (STOPS, 30e-6)])
@pytest.mark.parametrize("sense", Sense)
def test_a_touched_camera_that_visits_show_is_no_changed_stage(view, stop_m, sense):
    result = rechecked(touched(-0.1, 0.05), view, sense, stop_m=stop_m)
    assert result.verdict.qualified and not result.recheck.changed
    (found,) = result.findings
    assert found.name == "microscope_off" and found.size == pytest.approx(
        -0.1, abs=4 * found.u
    )
    assert found.turn == pytest.approx(0.05, abs=4 * found.u_turn)
    _, plate = calibrated(sense)
    assert result.noise.sigma_xy < 1.5 * plate.result.noise.sigma_xy


@pytest.mark.parametrize("scale", [-0.1, 0.1])
def test_the_microscope_is_exact_beyond_its_first_order(scale):
    truth, plate = calibrated()
    readings = later(touched(scale)(truth), STOPS, noise_m=1e-9)
    seen = recheck_of(readings, Options(), plate).microscope
    assert seen.values[0] == pytest.approx(scale, abs=1e-3)


def test_noise_alone_shows_no_microscope():
    truth, plate = calibrated()
    assert recheck_of(later(truth, {}), Options(), plate).microscope is None


def test_an_unchanged_cell_has_nothing_to_say():
    for view in ({}, STOPS):
        result = rechecked(touched(), view)
        assert result.verdict.qualified and result.findings == ()


def test_a_program_sees_the_exit_code(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    plate = {"grid_size": 7, "grid_pitch": 0.01, "angular_count": 0}
    views = [
        {"name": "a", "repeats": 4},
        {"name": "b", "rotation_deg": 90, "repeats": 4},
        {"name": "c", "translation_pitch": [1, 0], "repeats": 4},
    ]
    for name, views_of, physics in (
        ("first", views, {}),
        ("again", views[:1], {"microscope_scale": -0.1}),
    ):
        spec = {
            "seed": 3,
            "noise": {"sigma_xy": 2e-8},
            "physics": physics,
            "cell": {"visit_order": "x_back_y_back", "stop_sigma": 0.0},
            "plan": {"plan_id": name, "artifact": plate, "views": views_of},
        }
        (tmp_path / f"{name}.yaml").write_text(json.dumps(spec))
        assert main(["simulate", f"{name}.yaml", "-o", name]) == 0
    assert main(["solve", "first", "-o", "r.json", "--quiet"]) == 0
    capsys.readouterr()
    assert main(["recheck", "r.json", "again", "-o", "now.json"]) == 5
    err = capsys.readouterr().err
    assert "a changed stage, or a microscope with a scale wrong by " in err
    assert "explains it alike: measure check stops" in err
