# SPDX-License-Identifier: Apache-2.0
"""A certified plate that is not as it was certified: its growth is in U of the scale."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.map_covariance import map_covariance
from test.support.options import bare, reference_length
from test.support.truth import simulate_measurements

PITCH, SIZE = 0.01, 1e-6
ARTIFACT = Artifact(5, PITCH, 0)
X, Y = ARTIFACT.x_m, ARTIFACT.y_m
VIEWS = (("0", 0, (0, 0)), ("90", 1, (0, 0)), ("+x", 0, (1, 0)), ("-x", 0, (-1, 0)))
PLATE = ReferenceLength("artifact", 0.0)


def measured(seed, grown, *, sense=Sense.MICROSCOPE_MOVES, sigma=1e-10, marks=None):
    """Return truth and readings of a plate that is larger by `grown` in each view."""
    views = tuple(
        View(name, q * np.pi / 2, (a * PITCH, b * PITCH), True, False, 2)
        for name, q, (a, b) in VIEWS
    )
    plan, rng = Plan("p", ARTIFACT, views), np.random.default_rng(seed)
    truth = random_truth(ARTIFACT, len(views), rng, Spread(rotation="finite"))
    radial = scale_in(truth.a)
    if marks is not None:
        one, two = (np.s_[:, m + 2, n + 2] for m, n in marks)
        apart = np.stack([X, Y])[two] - np.stack([X, Y])[one]
        radial = (truth.a[two] - truth.a[one]) @ apart / (apart @ apart)
    # it was certified without an error of its length
    truth.a[:] -= radial * np.stack([X, Y])
    truth = replace(truth, plate_scale=np.asarray(grown))
    return truth, simulate_measurements(truth, plan, rng, sigma_m=sigma, sense=sense)


def options(term, reference=PLATE):
    return bare(terms=parse_terms([term], ""), reference=reference)


def scale_in(field):
    return float(np.sum(field * np.stack([X, Y])) / np.sum(X**2 + Y**2))


def scale_error(result, truth):
    emap = result.error_map
    return scale_in(np.stack([emap.gx, emap.gy]) - truth.g)


def u_of_scale(readings, chosen):
    rows = (np.stack([X, Y]) / np.sum(X**2 + Y**2))[None]
    return float(np.sqrt(map_covariance(readings, chosen).of(rows)[0, 0]))


@pytest.mark.parametrize("reference", [PLATE, reference_length("marks")])
@pytest.mark.parametrize("sense", Sense)
def test_growth_that_all_views_share_is_in_the_uncertainty_of_the_scale(
    sense, reference
):
    """No reading tells the mean growth: known to SIZE in each view, to SIZE / sqrt(n) in all."""
    chosen = options(f"plate_scale:{SIZE}", reference)
    truth, readings = measured(1, 4 * [SIZE], sense=sense, marks=reference.marks)
    result = calibrate(readings, chosen)
    assert result.verdict.qualified
    assert abs(scale_error(result, truth)) == pytest.approx(SIZE, rel=0.02)
    u = u_of_scale(readings, chosen)
    assert u == pytest.approx(SIZE / np.sqrt(len(VIEWS)), rel=0.02)
    corner = result.error_map.u_gx[0, 0]
    assert corner == pytest.approx(u * abs(X[0, 0]), rel=0.05)


def test_errors_of_the_scale_are_as_large_as_their_uncertainty():
    chosen, rng = options(f"plate_scale:{SIZE}"), np.random.default_rng(7)
    drawn = [
        measured(seed, rng.normal(0, SIZE, len(VIEWS)), sigma=2e-9)
        for seed in range(60)
    ]
    u = u_of_scale(drawn[0][1], chosen)  # of all: the noise is small beside the size
    errors = [
        scale_error(solve_joint(readings, chosen).result, truth)
        for truth, readings in drawn
    ]
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(u, rel=0.3)


@pytest.mark.parametrize("reference", [ReferenceLength("stage_x", 0.0), None])
def test_the_scale_of_an_axis_does_not_depend_on_the_plate(reference):
    _, readings = measured(1, 4 * [SIZE])
    assert u_of_scale(readings, options(f"plate_scale:{SIZE}", reference)) < 0.01 * SIZE
