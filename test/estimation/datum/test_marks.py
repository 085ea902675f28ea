# SPDX-License-Identifier: Apache-2.0
"""The distance of two marks as the reference: sign, exactness, uncertainty, refusals."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint.solve import solve_joint
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import SolverSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.lattice_plans import plan_of
from test.support.options import bare
from test.support.truth import simulate_measurements

ARTIFACT = Artifact(5, 0.01)
PLACE = np.stack([ARTIFACT.x_m, ARTIFACT.y_m])
PLAN = plan_of("0,90,tx,ty", ARTIFACT)
PAIR = ((-2, -1), (2, 0))


def distance(truth, pair=PAIR):
    """Return the true distance of two marks, m."""
    one, two = (np.s_[:, m + 2, n + 2] for m, n in pair)
    return float(np.hypot(*(PLACE + truth.a)[two] - (PLACE + truth.a)[one]))


def known(truth, pair=PAIR, u_m=0.0, error_m=0.0):
    """Return the reference with the true distance, and an error."""
    return ReferenceLength.between(
        f"{pair[0][0]},{pair[0][1]}:{pair[1][0]},{pair[1][1]}:{distance(truth, pair) + error_m!r}"
        f":{u_m!r}",
        ARTIFACT,
    )


def drawn(seed, *, sense=Sense.MICROSCOPE_MOVES, sigma_m=0.0, spread=None):
    rng = np.random.default_rng(seed)
    truth = random_truth(
        ARTIFACT, len(PLAN.views), rng, spread or Spread(rotation="finite")
    )
    truth = replace(truth, g=truth.g + 3e-6 * PLACE)  # encoders that indicate too much
    return truth, simulate_measurements(truth, PLAN, rng, sense=sense, sigma_m=sigma_m)


@pytest.mark.parametrize("sense", Sense)
@pytest.mark.parametrize("pair", [PAIR, PAIR[::-1], ((0, -2), (1, 2))])
def test_the_map_of_a_stage_that_indicates_too_much_is_the_true_one(sense, pair):
    truth, readings = drawn(3, sense=sense)
    found = calibrate(readings, bare(reference=known(truth, pair))).error_map
    assert np.abs(np.stack([found.gx, found.gy]) - truth.g).max() < 1e-12


def test_marks_of_a_rough_plate_are_a_length_apart_not_its_projection():
    """Across the line of the marks 50 µm move: 31 nm in a distance of 41 mm."""
    truth, readings = drawn(5, spread=Spread(a_m=50e-6, rotation="finite"))
    plate = calibrate(readings, bare(reference=known(truth))).artifact_map
    found = distance(replace(truth, a=np.stack([plate.ax, plate.ay])))
    assert found == pytest.approx(distance(truth), abs=2e-12)


def test_errors_of_the_scale_are_as_large_as_their_uncertainty():
    """Of 200 machines with noise and a distance that is known to 20 nm."""
    normalised, scales = [], []
    for seed in range(200):
        truth, readings = drawn(seed, sigma_m=1e-8)
        error_m = np.random.default_rng((seed, 1)).normal(0, 2e-8)
        emap = solve_joint(
            readings, bare(reference=known(truth, u_m=2e-8, error_m=error_m))
        ).result.error_map
        off = np.stack([emap.gx, emap.gy]) - truth.g
        normalised.append(off / np.stack([emap.u_gx, emap.u_gy]))
        scales.append((off * PLACE).sum() / (PLACE**2).sum())
    z = np.array(normalised)
    assert np.mean(np.abs(z) <= 2) == pytest.approx(0.9545, abs=0.025)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=0.08)
    # the distance of 41 mm is known to 20 nm, the plate's map at two marks to a little less
    assert 2e-8 / 0.0412 < np.std(scales) < 3e-8 / 0.0412


def test_a_certified_distance_belongs_to_its_temperature():
    reference = ReferenceLength.between("-2,0:2,0:0.04000004:4e-9", ARTIFACT, "PTB 1")
    assert reference.relative_error == pytest.approx(1e-6)
    assert reference.u_relative == pytest.approx(1e-7)
    warm = reference.at_temperature("23:0:8e-6:0")
    assert warm.relative_error == pytest.approx(25e-6)
    assert warm.marks == ((-2, 0), (2, 0)) and warm.certificate == "PTB 1"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("-2,0:2,0:0.04", "is not M,N:M,N:LENGTH:U"),
        ("-2,0:x,0:0.04:0", "is not M,N:M,N:LENGTH:U"),
        ("-2,0:2,0,1:0.04:0", "is not M,N:M,N:LENGTH:U"),
        ("", "is not M,N:M,N:LENGTH:U"),
        (
            "-2,0:3,0:0.05:0",
            r"no mark \(3, 0\); its marks go from \(-2, -2\) to \(2, 2\)",
        ),
        ("1,0:1,0:0.01:0", "names one mark twice; name two marks"),
        ("-2,0:2,0:40:0", "40 in .* the distance of these marks, nominally 0.04 m"),
        ("-2,0:2,0:nan:0", "nan in .* the distance of these marks"),
        ("-2,0:2,0:0.04:-1", "is not a standard uncertainty"),
    ],
)
def test_what_is_no_distance_of_two_marks_is_refused(text, message):
    with pytest.raises(InputError, match=message):
        ReferenceLength.between(text, ARTIFACT)


def test_a_mark_that_was_not_measured_is_refused():
    truth, readings = drawn(3)
    views = tuple(
        replace(
            view,
            **{
                name: getattr(view, name)[(view.m != 2) | (view.n != 0)]
                for name in ("dx", "dy", "count", "m", "n")
            },
        )
        for view in readings.views
    )
    with pytest.raises(
        InputError, match=r"the mark \(2, 0\) was not measured; measure it, or"
    ):
        calibrate(replace(readings, views=views), bare(reference=known(truth)))


@pytest.mark.parametrize(
    "given",
    [
        {"reference_kind": "marks"},
        {"reference_marks": "-2,0:2,0:0.04:0"},
        {"reference_kind": "artifact", "reference_marks": "-2,0:2,0:0.04:0"},
    ],
)
def test_kind_and_marks_belong_together(given):
    with pytest.raises(
        InputError, match=r"reference_marks: .* does not fit reference_kind"
    ):
        solver_options(SolverSettings.checked(given, "here"))


def test_the_solver_takes_the_marks_of_the_plate_that_was_measured():
    settings = SolverSettings(
        reference_kind="marks",
        reference_marks="-2,0:2,0:0.04000004:4e-9",
        reference_certificate="PTB 1",
        reference_at="21:0:5e-7:0",
    )
    reference = solver_options(settings, drawn(3)[1]).reference
    assert reference.relative_error == pytest.approx(1.5e-6)
    assert (reference.marks, reference.certificate) == (((-2, 0), (2, 0)), "PTB 1")
