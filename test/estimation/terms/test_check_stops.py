# SPDX-License-Identifier: Apache-2.0
"""Check stops show scale, turn and shear of the microscope, through messages and collector."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import ModelTerm
from selfcal_ros.model.verdict import Grade
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings, plan_events
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.collecting import START_NS, collect
from test.support.options import BARE, bare
from test.support.refusals import refused
from test.support.results import covered

NOISE, OFFSET, MARKS, REPEATS = 20e-9, 20e-6, 5, 5
MACHINE = Spread(
    phi_rad=5e-5,
    t_m=5e-6,
    microscope_scale=0.01,
    microscope_rotation_rad=5e-3,
    microscope_shear=2e-3,
)
FREE = bare(terms=(ModelTerm("microscope"),))


def measured(sense, *, marks=MARKS, seed=1, **settings):
    """Return the truth and the readings of Hu's views of a plate that lies straight."""
    views = tuple(
        View(
            name,
            turn,
            (shift, 0.0),
            True,
            False,
            REPEATS,
            "x_back_y_back@plate",
            marks,
            OFFSET if marks else 0.0,
        )
        for name, turn, shift in (("0", 0, 0), ("90", np.pi / 2, 0), ("x", 0, 0.01))
    )
    plan, rng = Plan("p", Artifact(7, 0.01, 0), views), np.random.default_rng(seed)
    truth = random_truth(plan.artifact, 3, rng, MACHINE)
    how = CellSettings(sense, NOISE, **settings)
    events = plan_events(truth, plan, settings=how, rng=rng, start_ns=START_NS)
    found, progress = collect(events, measurement_sense=str(sense))
    assert found.all_rejected() == {}
    assert all(view.complete for view in progress.values())
    return truth, found


def estimated(measurements):
    [term] = calibrate(measurements, FREE).model.terms
    return {one.component: (one.value, one.u) for one in term.estimates}


@pytest.mark.parametrize("sense", list(Sense))
def test_scale_turn_and_shear_are_found_within_their_uncertainty(sense):
    _, measurements = measured(sense)
    found = estimated(measurements)
    for part, true in (
        ("scale", 0.01),
        ("turn", 5e-3),
        ("stretch", 0.0),
        ("shear", 2e-3),
    ):
        value, u = found[part]
        assert abs(value - true) < 3 * u
        # noise over the offsets of as many readings along both axes
        assert u == pytest.approx(NOISE / (OFFSET * np.sqrt(4 * MARKS * 3)), rel=0.25)


def test_the_map_of_a_wrong_microscope_is_right_however_it_is_known():
    truth, measurements = measured(Sense.MICROSCOPE_MOVES)
    for options, grade in (
        (FREE, Grade.GOOD),
        (BARE, Grade.ENLARGED),
        (Options(), Grade.GOOD),
    ):
        result = calibrate(measurements, options)
        assert result.verdict.grade is grade
        assert covered(result, truth.g) > 0.85


def test_without_check_stops_the_same_machine_does_not_show_it():
    _, measurements = measured(Sense.MICROSCOPE_MOVES, marks=0)
    with refused("ask for check_stops in the plan"):
        estimated(measurements)


@pytest.mark.parametrize("consecutive", [False, True])
def test_a_check_stop_that_was_lost_does_not_bias_the_map_with_the_term(consecutive):
    """The mean of its mark then has a mean offset, which the columns of the term have as well."""
    _, measurements = measured(
        Sense.MICROSCOPE_MOVES, servo_sigma_m=0.0, consecutive=consecutive
    )
    view = measurements.views[0]
    visits = view.visits
    last = int(np.argmax(visits.offset_y))  # the one at -y of a mark
    mark = visits.mark[last]
    keep = np.arange(len(visits.mark)) != last
    count = view.count - (np.arange(len(view.m)) == mark)
    columns = {
        name: getattr(visits, name)[keep]
        for name in (
            "mark",
            "dx",
            "dy",
            "count",
            "stamp_ns",
            "offset_x",
            "offset_y",
            "approach_x",
            "approach_y",
        )
    }
    mean = {
        name: (
            getattr(view, name) * view.count
            - (np.arange(len(view.m)) == mark) * getattr(visits, name)[last]
        )
        / count
        for name in ("dx", "dy")
    }
    lost = replace(view, count=count, visits=replace(visits, **columns), **mean)
    short = replace(measurements, views=(lost, *measurements.views[1:]))
    whole, with_loss = (calibrate(m, FREE).error_map for m in (measurements, short))
    moved = np.abs(np.stack([whole.gx - with_loss.gx, whole.gy - with_loss.gy])).max()
    biased, unbiased = (calibrate(m, BARE).error_map for m in (short, measurements))
    without = np.abs(np.stack([biased.gx - unbiased.gx, biased.gy - unbiased.gy])).max()
    assert moved < 2 * NOISE / np.sqrt(count.min())
    assert without > moved
