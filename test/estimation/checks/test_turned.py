# SPDX-License-Identifier: Apache-2.0
"""Without stops beside the marks, turned or mirrored offsets and reversed lines are named first."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Detection
from selfcal_ros.estimation.api import _agree, _fits, calibrate
from selfcal_ros.estimation.checks.wiring import WiringError
from selfcal_ros.model.findings import Cause
from selfcal_ros.simulation.cell import CellSettings, plan_events
from test.support.collecting import gathered
from test.support.plans import plan_of
from test.support.sessions import START_NS, small_plan
from test.support.truth import random_truth

PLAN = small_plan("0, 90, tx")
NOISE = CellSettings(sigma_xy_m=2e-8, sigma_theta_rad=2e-6, servo_sigma_m=0.0)


def measured(camera=lambda x, y: (x, y), line=1.0, seed=5, plan=PLAN):
    """Return readings at rest on the marks; the camera publishes offsets as it sees them."""
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    events = []
    for event in plan_events(truth, plan, settings=NOISE, rng=rng, start_ns=START_NS):
        if isinstance(event, Detection) and event.kind == 0:
            x, y = camera(event.offset_x, event.offset_y)
            event = replace(event, offset_x=x, offset_y=y)
        elif isinstance(event, Detection):
            event = replace(event, offset_theta=line * event.offset_theta)
        events.append(event)
    return gathered(events).collect()[0]


@pytest.mark.parametrize(
    ("camera", "line", "said"),
    [
        (lambda x, y: (-y, x), 1, "the offsets are turned by 90° counter-clockwise"),
        (lambda x, y: (-x, y), 1, "offset_x has the other sign"),
        (lambda x, y: (y, x), 1, "offset_x and offset_y are exchanged"),
        (
            lambda x, y: (x, y),
            -1,
            "offset_theta has the other sign, or the offsets are turned by 180",
        ),
    ],
)
def test_the_wiring_is_named_before_any_other_cause(camera, line, said):
    """One of each pair that the lines tell apart: the other one of it is not named."""
    with pytest.raises(WiringError) as caught:
        calibrate(measured(camera, line))
    assert caught.value.what.startswith(f"{said}") and "only so do" in caught.value.what
    assert caught.value.what.removeprefix(said)[0] in ":°"
    assert "check_stops" in caught.value.remedy


def test_without_lines_both_signs_are_possible_and_named():
    plan = replace(
        PLAN,
        artifact=replace(PLAN.artifact, angular_count=0),
        views=tuple(replace(view, angular=False) for view in PLAN.views if view.grid),
    )
    with pytest.raises(
        WiringError,
        match="turned by 90° counter-clockwise, or the offsets are "
        "turned by 90° clockwise: only so",
    ):
        calibrate(measured(lambda x, y: (-y, x), plan=plan))


@pytest.mark.parametrize("seed", range(2))
def test_right_offsets_are_not_refused(seed):
    """Nothing contradicts them; both signs would do, and only lines that turn alike tell them."""
    verdict = calibrate(measured(seed=seed)).verdict
    assert [found.name for found in verdict.failed] == ["sign_shown_by_lines"]
    assert not verdict.causes


def test_noise_declared_too_large_contradicts_no_wiring():
    """Residuals of a third of it: nothing shows the sign, and no other wiring is tried."""
    plan = plan_of("0, 90, tx")
    rng = np.random.default_rng(1)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    noise = CellSettings(sigma_xy_m=2e-8)
    events = [
        replace(event, sigma=6e-8) if isinstance(event, Detection) else event
        for event in plan_events(
            truth, plan, settings=noise, rng=rng, start_ns=START_NS
        )
    ]
    result = calibrate(gathered(events).collect()[0])
    names = [failed.name for failed in result.verdict.failed]
    assert names == ["sign_not_shown", "noise_contradicted"]
    assert _agree(result)
    too_small = [
        replace(failed, size=2 * failed.stated) if "stated" in vars(failed) else failed
        for failed in result.verdict.failed
    ]
    verdict = replace(result.verdict, failed=tuple(too_small))
    assert not _agree(replace(result, verdict=verdict))


def test_another_contradiction_is_not_taken_for_wrong_offsets():
    """A plate that slips within a view fits no other wiring either."""
    readings = measured()
    slipped = replace(
        readings.views[1],
        dx=readings.views[1].dx + 5e-6 * (np.arange(len(readings.views[1].m)) > 12),
    )
    spoilt = replace(readings, views=(readings.views[0], slipped, *readings.views[2:]))
    assert not calibrate(spoilt).verdict.qualified


@pytest.mark.parametrize(
    ("scale", "fits"), [(0.05, True), (-0.09, True), (-2.0, False)]
)
def test_a_microscope_that_undoes_the_sign_speaks_against_it(scale, fits):
    """Marks that repeat wrongly in all views made lines of the other sign fit, with a scale of -1.

    The readings were refused for their lines, although these were right.
    """
    result = calibrate(measured())
    cause = Cause(name="microscope", size=scale, u=1e-3, unit="m/m", p=1e-9)
    assert (
        _fits(replace(result, verdict=replace(result.verdict, causes=(cause,)))) is fits
    )
