# SPDX-License-Identifier: Apache-2.0
"""Images as views of their own: two turns are enough."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.observability.plan_check import check_plan, predict_plan
from selfcal_ros.estimation.observability.suggest import rank_next
from selfcal_ros.model.error_map import ThetaDatum
from selfcal_ros.model.readings import Sense
from test.support.collecting import collect, scene
from test.support.plans import image_plan
from test.support.refusals import in_words


@pytest.mark.parametrize("sense", Sense)
def test_two_turns_give_the_map(sense):
    shot = scene(image_plan(7), sense=sense, servo_sigma_m=0.0)
    measurements, _ = collect(shot.events, measurement_sense=str(sense))
    found = calibrate(measurements)
    np.testing.assert_allclose(
        [found.error_map.gx, found.error_map.gy], shot.truth.g, atol=2e-11
    )
    for view, result in zip(measurements.views, found.views, strict=True):
        assert result.phi == pytest.approx(
            shot.truth.phi_rad[int(view.view.plan_view == "90")], abs=1e-7
        )


def test_two_turns_are_predicted_to_be_enough():
    plan = image_plan(7)
    assert check_plan(plan).observability.identifiable
    assert predict_plan(plan, ThetaDatum.ZERO_MEAN).rms_xy == pytest.approx(
        0.2722, abs=1e-4
    )
    alone = replace(plan, views=tuple(replace(view, image=None) for view in plan.views))
    assert not check_plan(alone).observability.identifiable


def test_one_turn_is_not_and_the_other_is_suggested():
    plan = image_plan(7, turns=(0,))
    seen = check_plan(plan).observability
    assert seen.deficiency == 2
    assert "90°" in in_words(seen.advice)[0]
    _, ranked = rank_next(plan, criterion="rms", datum=ThetaDatum.ZERO_MEAN)
    assert ranked[0].view.image == plan.views[0].image
    assert ranked[0].score.deficiency == 0
    measurements, _ = collect(scene(plan).events)
    with pytest.raises(NotIdentifiableError):
        calibrate(measurements)
