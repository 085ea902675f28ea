# SPDX-License-Identifier: Apache-2.0
"""The cell's messages: what they say, through the collector, is the truth that was put in."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Kind, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation.cell import CellSettings, plan_events, view_events
from test.support.collecting import START_NS, collect, scene
from test.support.plans import plan_of
from test.support.truth import angular_deviation, grid_deviation, random_truth

PLAN = plan_of("0, 90, tx", 5, count=8, line=True, repeats=2)


def events_of(seed=1, **settings):
    rng = np.random.default_rng(seed)
    truth = random_truth(PLAN.artifact, len(PLAN.views), rng)
    return list(
        plan_events(
            truth, PLAN, settings=CellSettings(**settings), rng=rng, start_ns=START_NS
        )
    )


@pytest.mark.parametrize("sense", list(Sense))
@pytest.mark.parametrize("servo", [0.0, 1.0])
def test_noise_free_messages_give_back_the_deviations(sense, servo):
    cell = scene(
        "0, 90, 180, 270, tx, -ty",
        size=11,
        count=24,
        line=True,
        sense=sense,
        servo_sigma_m=servo * 2e-8,
        servo_sigma_theta_rad=servo * 1e-7,
    )
    found, _ = collect(cell.events, measurement_sense=str(sense))
    for index, readings in enumerate(found.views):
        angular = angular_deviation(cell.truth, index, readings.view, sense=sense)
        # the last bit of a position of 50 mm is 7e-18 m, that of 6 rad 9e-16 rad. Off its place by
        # the servo's 20 nm or 0.1 urad, the stage has the error of another place: below 1e-4 of it
        np.testing.assert_allclose(
            readings.dtheta, angular, rtol=0, atol=4e-15 + servo * 6e-10
        )
        if readings.view.grid:
            want = grid_deviation(cell.truth, index, readings.view, sense=sense)
            want = want[:, readings.m + 5, readings.n + 5]
            off = np.abs(np.stack([readings.dx, readings.dy]) - want).max()
            assert off < 4e-17 + servo * 2e-11


def test_stamps_rise_and_every_view_is_placed_measured_and_done():
    events = events_of()
    stamps = [e.stamp_ns for e in events]
    assert stamps == sorted(stamps)
    assert stamps[0] == START_NS
    commands = [e for e in events if isinstance(e, Command)]
    assert [(c.phase, c.view_index) for c in commands] == [
        (phase, i) for i in range(4) for phase in (Phase.PLACE, Phase.MEASURE)
    ] + [(Phase.DONE, 4)]
    assert all(c.views_planned == 4 for c in commands)


def test_the_encoder_samples_at_its_rate_and_the_stage_rests_while_it_is_exposed():
    events = events_of(encoder_rate_hz=1000.0, exposure_period_s=0.02)
    samples = [e for e in events if isinstance(e, EncoderSample)]
    steps = np.diff([s.stamp_ns for s in samples])
    assert (steps == 1_000_000).sum() == len(
        steps
    ) - 3  # three pauses between four views
    assert (steps > 0).all()
    for number, event in enumerate(events):
        if isinstance(event, Detection):
            before, after = events[number - 1], events[number + 1]
            assert before.positions == after.positions
            assert before.stamp_ns < event.stamp_ns < after.stamp_ns


def test_every_mark_in_the_field_is_seen_as_often_as_the_plan_asks():
    seen = [e for e in events_of() if isinstance(e, Detection)]
    assert sum(d.kind == Kind.GRID for d in seen) == 2 * (25 + 25 + 20)
    assert sum(d.kind == Kind.ANGULAR for d in seen) == 2 * 8 * 4
    assert all(d.has_id for d in seen)


@pytest.mark.parametrize("declare", [True, False])
def test_ids_and_sigma_are_told_only_when_asked(declare):
    seen = [
        e
        for e in events_of(
            with_ids=False, declare_sigma=declare, sigma_xy_m=2e-8, sigma_theta_rad=3e-6
        )
        if isinstance(e, Detection)
    ]
    assert {(d.has_id, d.m, d.n, d.k) for d in seen} == {(False, 0, 0, 0)}
    assert {(d.kind, d.sigma) for d in seen} == {
        (0, declare * 2e-8),
        (1, declare * 3e-6),
    }


def test_noise_has_its_standard_deviation():
    cell = scene(
        "0", size=21, count=72, repeats=5, sigma_xy_m=2e-8, sigma_theta_rad=3e-6
    )
    readings = collect(cell.events)[0].views[0]
    assert readings.sigma_xy == pytest.approx(
        2e-8, rel=4 / np.sqrt(2 * readings.dof_xy)
    )
    assert readings.sigma_theta == pytest.approx(
        3e-6, rel=4 / np.sqrt(2 * readings.dof_theta)
    )


def test_a_seed_determines_every_message():
    assert events_of(4, sigma_xy_m=1e-8) == events_of(4, sigma_xy_m=1e-8)
    assert events_of(4, sigma_xy_m=1e-8) != events_of(5, sigma_xy_m=1e-8)


def test_a_view_lasts_as_long_as_its_exposures():
    truth = random_truth(PLAN.artifact, 4, np.random.default_rng(1))
    events = list(
        view_events(
            truth,
            PLAN,
            2,
            settings=CellSettings(),
            rng=np.random.default_rng(1),
            start_ns=START_NS,
        )
    )
    exposures = 2 * (20 + 8)
    assert sum(isinstance(event, Detection) for event in events) == exposures
    assert events[0].stamp_ns == START_NS
    # and the way there
    assert events[-1].stamp_ns - START_NS == (exposures + 1) * 10_000_000


@pytest.mark.parametrize(
    "settings",
    [
        {"encoder_rate_hz": 400.0},
        {"exposure_period_s": 0.005},
        {"encoder_rate_hz": 0.0},
    ],
)
def test_a_dwell_too_short_for_the_encoder_is_refused(settings):
    with pytest.raises(
        InputError,
        match=r"^simulated cell: \d+ Hz gives fewer than 2.5 encoder "
        r"samples in a dwell of .* s; raise encoder_rate or exposure_period$",
    ):
        CellSettings(**settings)


@pytest.mark.parametrize(
    ("sense", "sign"), [(Sense.MICROSCOPE_MOVES, 1), (Sense.PLATE_MOVES, -1)]
)
def test_the_stage_comes_from_minus_and_goes_from_mark_to_mark(sense, sign):
    events = events_of(sense=sense, servo_sigma_m=0.0, visit_order="raster")
    first = [e for e in events if isinstance(e, Detection)][:6]
    samples = [e for e in events if isinstance(e, EncoderSample)]
    assert samples[0].positions[:2] == pytest.approx(
        (-sign * 0.02 - 0.005, -sign * 0.02 - 0.005)
    )
    for number, seen in enumerate(first):
        (before,) = [s for s in samples if 0 < seen.stamp_ns - s.stamp_ns < 2_000_000]
        i, j = (number // 5 - 2, number % 5 - 2)
        assert before.positions[:2] == pytest.approx((sign * i * 0.01, sign * j * 0.01))
        assert (seen.m, seen.n) == (i, j)


def test_a_view_that_asks_for_an_order_gets_it_and_others_that_of_the_cell():
    rng = np.random.default_rng(1)
    truth = random_truth(PLAN.artifact, 4, rng)
    views = (replace(PLAN.views[0], visit_order="x_then_y"), PLAN.views[0])
    plan = replace(PLAN, views=views)
    settings = CellSettings(visit_order="raster@plate")
    asked, free = (
        [
            (e.m, e.n)
            for e in view_events(
                truth, plan, index, settings=settings, rng=rng, start_ns=START_NS
            )
            if isinstance(e, Detection) and e.kind == Kind.GRID
        ]
        for index in range(2)
    )
    along_y = [(m, n) for n in range(-2, 3) for m in range(-2, 3)]
    assert free == sorted(along_y) * 2
    assert asked == sorted(along_y) + along_y


def test_an_order_that_is_not_known_is_refused():
    with pytest.raises(
        InputError, match=r"^simulated cell: visit_order: 'spiral' is not a "
    ):
        CellSettings(visit_order="spiral")
