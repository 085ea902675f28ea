# SPDX-License-Identifier: Apache-2.0
"""Maps, coefficients and all their uncertainties are those of one dense least squares."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.estimation.joint import solve
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms import equations
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import default_terms, parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.dense_fit import DenseFit
from test.support.truth import simulate_measurements

PITCH = 0.01
DEGREE = 2
QUIET = {"servo_sigma_m": 0.0, "servo_sigma_theta_rad": 0.0, "stop_sigma_m": 20e-6}
MODELS = {
    "none": "",
    "assumed": ",".join(map(str, default_terms())),
    "sized": "microscope:0.01:0.02:0.001,drift:5e-8,plate_scale:3e-7,plate_shape:2e-8,"
    "approach:3e-8,plate_strain:2e-7,line_eccentricity:3e-6,"
    "line_scale:0.01,rotation:1e-6",
    "free": "microscope,drift,plate_scale,approach,rotation",
    "mixed": "microscope:0:0.01:0.002,drift,plate_scale:1e-7,approach,line_eccentricity:2e-6,"
    "line_scale:0.02",
}
MACHINE = Spread(
    microscope_rotation_rad=4e-3,
    microscope_scale=-5e-3,
    microscope_shear=5e-4,
    microscope_stretch=3e-4,
    backlash_x_m=20e-9,
    backlash_y_m=-15e-9,
    plate_scale=3e-7,
    plate_shape_m=4e-9,
    plate_strain=1e-7,
    line_eccentricity_rad=3e-6,
    line_factor=1.008,
    drift_linear_m=40e-9,
    drift_quadratic_m=30e-9,
)
PARTS = {
    "microscope": (
        "microscope_rotation_rad",
        "microscope_scale",
        "microscope_shear",
        "microscope_stretch",
    ),
    "approach": ("backlash_x_m", "backlash_y_m"),
    "plate_scale": ("plate_scale",),
    "plate_shape": ("plate_shape_m",),
    "plate_strain": ("plate_strain",),
    "line_eccentricity": ("line_eccentricity_rad",),
    "line_scale": ("line_factor",),
    "drift": ("drift_linear_m", "drift_quadratic_m"),
}


def views(*poses, lines, repeats, order):
    named = [
        View(name, q * np.pi / 2, (a * PITCH, b * PITCH), True, lines > 0, n, order)
        for (name, q, a, b), n in zip(poses, repeats, strict=True)
    ]
    turned = (
        [View("line", 2 * np.pi / lines, (0.0, 0.0), False, True, 3)] if lines else []
    )
    return (*named[:2], *turned, *named[2:])


FIVE = (
    ("0", 0, 0, 0),
    ("90", 1, 0, 0),
    ("+x", 0, 1, 0),
    ("-x", 0, -1, 0),
    ("+y", 0, 0, 1),
)
PLANS = {
    "lines": Plan(
        "lines",
        Artifact(5, PITCH, 8),
        views(*FIVE, lines=8, repeats=[4] * 5, order="x_back_y_back"),
    ),
    "oblong": Plan(
        "oblong",
        Artifact(5, PITCH, 12, 3),
        views(
            ("0", 0, 0, 0),
            ("180", 2, 0, 0),
            ("90", 1, 0, 0),
            ("tx", 0, 1, 0),
            ("-ty", 3, 0, -1),
            lines=12,
            repeats=[4, 2, 4, 6, 4],
            order="there_and_back@plate",
        ),
    ),
    "no lines": Plan(
        "no lines",
        Artifact(3, PITCH),
        views(*FIVE, lines=0, repeats=[4] * 5, order="x_back_y_back"),
    ),
}


@pytest.fixture(autouse=True)
def _equal_white_noise(monkeypatch):
    """What else noise may be, and doubt, have their own tests (test_axes.py, test_sizes.py)."""
    monkeypatch.setattr(solve, "MAX_NODES", 0)
    monkeypatch.setattr(equations, "DOUBT_LEVEL", equations.CAUSE_LEVEL)


@cache
def measured(plan, model, sense=Sense.MICROSCOPE_MOVES, missing=0.0, rotation="linear"):
    """Readings of a machine that has what the model holds, and no more."""
    plan, rng = PLANS[plan], np.random.default_rng(3)
    held = {term.name for term in parse_terms([MODELS[model]], "")}
    spread = replace(
        MACHINE,
        rotation=rotation,
        **{
            part: getattr(Spread(), part)
            for name, parts in PARTS.items()
            if name not in held
            for part in parts
        },
    )
    truth = random_truth(plan.artifact, len(plan.views), rng, spread)
    return simulate_measurements(
        truth,
        plan,
        rng,
        missing=missing,
        visits=True,
        settings=CellSettings(sense, 20e-9, 2e-6, **QUIET),
    )


def solved(readings, model, **how):
    terms = parse_terms([MODELS[model]], "")
    result = solve_joint(
        readings,
        Options(
            terms=terms, uncertainty=True, drift_degree=DEGREE, **{"assumed": (), **how}
        ),
    ).result
    # none is contradicted
    assert all(term.size_used is None for term in result.model.terms)
    return result


def both(readings, model, **how):
    terms, result = parse_terms([MODELS[model]], ""), solved(readings, model, **how)
    noise = result.noise
    least = min(noise.sigma_xy_repeats, noise.sigma_xy_residuals)
    dense = DenseFit(
        readings,
        terms,
        (noise.sigma_xy, noise.sigma_theta),
        degree=DEGREE,
        rigid=result.model.misalignment == "rigid",
        shared=least / noise.sigma_xy,
        places=how.get("at_places", True),
    )
    return result, dense


def require_same(result, dense, *, of_u=0.01, axes=False):
    """Require all values within a part of their uncertainty, and the uncertainties themselves.

    An estimate has converged when nothing changes by a thousandth of its uncertainty any more.
    """
    emap = result.error_map
    valid = np.isfinite(emap.gx)
    assert valid.sum() > 0.7 * valid.size
    pairs = [(emap.gx, emap.u_gx), (emap.gy, emap.u_gy)]
    for (value, u), wanted, spread in zip(pairs, *dense.grid(valid), strict=True):
        assert np.abs(u[valid] / spread[valid] - 1).max() < 0.1 * of_u
        assert np.abs((value - wanted)[valid] / u[valid]).max() < of_u
    if result.artifact.angular_count:
        known = np.isfinite(emap.g_theta)
        wanted, spread = dense.theta(known, axes)
        assert np.abs(emap.u_g_theta[known] / spread[known] - 1).max() < 0.1 * of_u
        assert np.abs((emap.g_theta - wanted)[known] / spread[known]).max() < of_u
    if not axes:
        require_same_plate(result, dense, of_u)
    found = {
        (term.name, e.view, e.component): e
        for term in result.model.terms
        for e in term.estimates
    }
    coefficients = dense.coefficients()
    assert set(found) == set(coefficients)
    for key, (value, spread) in coefficients.items():
        assert found[key].u == pytest.approx(spread, rel=0.1 * of_u), key
        assert abs(found[key].value - value) < of_u * spread, key


def require_same_plate(result, dense, of_u):
    """Require the same of the plate's map."""
    plate = result.artifact_map
    known, sites = np.isfinite(plate.ax), np.isfinite(result.error_map.gx)
    for value, u, wanted, spread in zip(
        (plate.ax, plate.ay),
        (plate.u_ax, plate.u_ay),
        *dense.plate(known, sites),
        strict=True,
    ):
        assert np.abs(u[known] / spread[known] - 1).max() < 0.1 * of_u
        assert np.abs((value - wanted)[known] / u[known]).max() < of_u
    if result.artifact.angular_count:
        wanted, spread = dense.plate_theta(
            np.isfinite(result.error_map.g_theta), sites, known
        )
        known = np.isfinite(plate.a_theta)
        assert np.abs(plate.u_a_theta[known] / spread[known] - 1).max() < 0.1 * of_u
        assert np.abs((plate.a_theta - wanted)[known] / spread[known]).max() < of_u


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(
    ("plan", "sense"),
    [
        ("lines", Sense.MICROSCOPE_MOVES),
        ("oblong", Sense.PLATE_MOVES),
        ("no lines", Sense.PLATE_MOVES),
    ],
)
def test_a_model_as_the_dense_matrix_has_it(plan, model, sense):
    require_same(
        *both(measured(plan, model, sense), model, misalignment_model="linear")
    )


@pytest.mark.parametrize("model", ["none", "free"])
def test_nothing_more_is_assumed_of_a_linear_model(model):
    require_same(
        *both(
            measured("lines", model),
            model,
            misalignment_model="linear",
            assumed=default_terms(),
        )
    )


@pytest.mark.parametrize(
    ("model", "sense"),
    [
        ("assumed", Sense.MICROSCOPE_MOVES),
        ("sized", Sense.PLATE_MOVES),
        ("mixed", Sense.PLATE_MOVES),
    ],
)
def test_with_marks_and_lines_missing(model, sense):
    require_same(
        *both(
            measured("lines", model, sense, missing=0.15),
            model,
            misalignment_model="linear",
            at_places=False,
        )
    )


@pytest.mark.parametrize(
    ("model", "sense"),
    [("assumed", Sense.MICROSCOPE_MOVES), ("sized", Sense.PLATE_MOVES)],
)
def test_in_the_datum_of_the_axes(model, sense):
    require_same(
        *both(
            measured("lines", model, sense),
            model,
            misalignment_model="linear",
            datum_theta="xy_axes",
        ),
        axes=True,
    )


@pytest.mark.parametrize(
    ("model", "sense"),
    [("none", Sense.MICROSCOPE_MOVES), ("assumed", Sense.PLATE_MOVES)],
)
def test_plates_that_turn_by_finite_angles(model, sense):
    require_same(
        *both(measured("lines", model, sense, rotation="finite"), model), of_u=0.03
    )


def maps_of(result):
    emap = result.error_map
    return np.stack([emap.gx, emap.gy]), np.stack([emap.u_gx, emap.u_gy])


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("model", ["linear", "rigid"])
def test_a_stage_that_stands_a_tenth_of_a_pitch_off_the_sites(model, sense):
    """Its error is taken where it stood, and u is that of readings there."""
    plan, rng = PLANS["lines"], np.random.default_rng(3)
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        rng,
        Spread(rotation="linear" if model == "linear" else "finite", t_m=1e-3),
    )
    settings = CellSettings(sense, 20e-9, 2e-6, follow_mark=True, **QUIET)
    readings = simulate_measurements(truth, plan, rng, visits=True, settings=settings)
    result, dense = both(readings, "none", misalignment_model=model)
    at_sites = solved(readings, "none", misalignment_model=model, at_places=False)
    dense.with_places_in_covariance()
    wanted, spread = dense.grid(np.isfinite(result.error_map.gx))
    (found, u), (other, u_other) = maps_of(result), maps_of(at_sites)
    assert np.abs((found - wanted) / u).max() < 0.03
    assert np.abs(other - wanted).max() > 3 * u.max()
    np.testing.assert_allclose(u, spread, rtol=0.1)
    assert np.sqrt(np.mean((u / spread) ** 2)) == pytest.approx(1, abs=0.01)
    same_noise = at_sites.noise.sigma_xy / result.noise.sigma_xy
    assert np.sqrt(np.mean((u / u_other) ** 2)) * same_noise == pytest.approx(
        1.054, abs=0.01
    )


@pytest.mark.parametrize("sense", Sense)
def test_an_approach_turns_with_the_frame_of_the_plate(sense):
    """Of 2 um, with plates rotated by 2 degrees: 70 nm if it did not."""
    plan = PLANS["no lines"]
    truth = random_truth(
        plan.artifact,
        len(plan.views),
        np.random.default_rng(3),
        Spread(phi_rad=0.035, backlash_x_m=2e-6, backlash_y_m=-1e-6),
    )
    found = solve_joint(
        simulate_measurements(
            truth,
            plan,
            np.random.default_rng(4),
            settings=CellSettings(sense, servo_sigma_m=0.0),
        ),
        Options(terms=parse_terms(["approach"], ""), assumed=(), at_places=False),
    ).result
    (term,) = found.model.terms
    values = {estimate.component: estimate.value for estimate in term.estimates}
    assert values == pytest.approx({"x": 2e-6, "y": -1e-6}, rel=1e-4)
    g = np.stack([found.error_map.gx, found.error_map.gy])
    np.testing.assert_allclose(g, truth.g, atol=1e-10)
