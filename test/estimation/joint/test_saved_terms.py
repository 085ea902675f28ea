# SPDX-License-Identifier: Apache-2.0
"""The factors of a covariance that a result keeps: how large a field, which way round."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.comparison.covariance import covariance_of
from selfcal_ros.estimation.datum.covariance import LinesCovariance, MapsCovariance
from selfcal_ros.estimation.joint.solve import saved_terms, solve_joint
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.terms.columns import Column, TermColumns, WithinMarks
from selfcal_ros.estimation.terms.equations import roots_by_term
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense, lines_turned_over
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.truth import hu_plan, simulate_measurements

SIGMA = 3.0
"""Standard deviation of the one coefficient, in units of the noise of a reading."""


def cover_of(field, known):
    """Return the covariance of a map that one coefficient moves by `field`, complex (nx, ny)."""
    grid = SimpleNamespace(n_sites=field.size, views=SimpleNamespace(shape=field.shape))
    return SimpleNamespace(
        system=SimpleNamespace(grid=grid),
        maps_of_terms=lambda: (np.where(known, field, 0.0).reshape(-1, 1), None),
    )


def kept(shape, sense=Sense.MICROSCOPE_MOVES, size=float("inf")):
    """Return the field, which sites are known, and what is kept of it."""
    rng = np.random.default_rng(1)
    field = rng.normal(size=(*shape, 2)) @ [1, 1j]
    known = rng.random(shape) < 0.9
    columns = TermColumns(
        (Column("plate_scale", 1, "b", size),),
        np.zeros((1, 2, *shape)),
        WithinMarks(np.zeros((1, 1)), np.zeros(1), 0.0, 0),
        [],
    )
    roots = roots_by_term(np.array([[SIGMA**2]]), columns)
    return (
        field,
        known,
        saved_terms(
            cover_of(field, known), roots, sense, {"microscope": np.zeros((1, 4))}
        ),
    )


@pytest.mark.parametrize(
    ("shape", "is_kept"),
    [
        ((3, 5), True),
        ((31, 31), True),
        ((1, 961), True),
        ((1, 962), False),
        ((31, 33), False),
        ((33, 31), False),
        ((33, 33), False),
    ],
)
def test_factors_are_kept_up_to_31_by_31_sites(shape, is_kept):
    _, _, found = kept(shape)
    assert (found is not None) == is_kept


@pytest.mark.parametrize(
    ("size", "names"), [(float("inf"), [""]), (1e-6, ["plate_scale"])]
)
@pytest.mark.parametrize("sense", Sense)
def test_a_factor_is_what_a_standard_deviation_of_the_coefficient_does_to_the_map(
    sense, size, names
):
    """With the plate moving the map is seen from the other end: H(x) = -G(-x)."""
    field, known, found = kept((5, 3), sense, size)
    moved = SIGMA * np.where(known, field, 0.0)
    if sense is Sense.PLATE_MOVES:
        moved = -moved[::-1, ::-1]
    assert list(found.terms) == names
    (factor,) = found.of_map
    turned = factor[0] + 1j * factor[1]
    sign = np.sign((turned * moved.conj()).sum().real)  # L L' is the same for -L
    assert turned == pytest.approx(sign * moved, rel=1e-6)


@pytest.mark.parametrize("datum", ThetaDatum)
@pytest.mark.parametrize("sense", Sense)
def test_what_terms_and_noise_are_in_u_of_the_angular_map_adds_up(sense, datum):
    """A microscope and the offsets of lines are shown by the same rotations: not told apart."""
    artifact, rng = Artifact(5, 0.01, 24), np.random.default_rng(3)
    plan, settings = hu_plan(artifact, 4), CellSettings(sense, 2e-8, 2e-6)
    truth = random_truth(artifact, len(plan.views), rng, Spread(phi_rad=1e-3))
    readings = simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    solved = solve_joint(readings, Options(datum_theta=datum))
    problem, fitted = solved.joint.problem, solved.joint.fitted
    lines = LinesCovariance(
        MapsCovariance(
            problem.system, fitted.inverse, half_width_m=problem.half_width_m
        ),
        (fitted.xy.sigma, fitted.theta.sigma),
    )
    of_noise = lines.of_stage(problem.conditions)[0]
    parts = solved.result.kept.angular
    assert {"microscope", "line_eccentricity", "line_scale"} <= set(parts)
    of_terms = sum(u**2 for u in parts.values())
    assert solved.result.error_map.u_g_theta**2 == pytest.approx(
        of_terms + lines_turned_over(sense, of_noise, sign=1), rel=1e-5
    )


def test_a_result_without_its_lines_is_read_again():
    """Of a plate with lines, none of which was read."""
    rng = np.random.default_rng(1)
    plan = hu_plan(Artifact(5, 0.01, 8), 2)
    plan = replace(
        plan,
        views=tuple(replace(view, angular=False) for view in plan.views if view.grid),
    )
    truth = random_truth(plan.artifact, len(plan.views), rng)
    readings = simulate_measurements(truth, plan, rng, sigma_m=2e-8, visits=True)
    result = calibrate(readings, Options())
    again = result_from_dict(result_to_dict(worded(result)), "R.json")
    known_sites = result.error_map.valid
    np.testing.assert_allclose(
        covariance_of(again, "xy", known_sites),
        covariance_of(result, "xy", known_sites),
        rtol=1e-5,
        atol=1e-24,
    )
    assert again.kept.factors.beside["lines"].shape[1:] == (2, 8)
