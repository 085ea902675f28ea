# SPDX-License-Identifier: Apache-2.0
"""Small views, exact repeats, poses changed without PLACE, and samples with several NaN."""

import math

import numpy as np
import pytest

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.inputs import Command, EncoderSample, Phase, Reason
from selfcal_ros.collection.marks.repeats import reduce_repeats
from selfcal_ros.collection.timeline import build_timeline
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View
from selfcal_ros.settings.nodes import CollectorSettings


def test_clean_readings_of_small_views_are_kept():
    """Even at a limit of 4.5: below 1 in 100,000 of 18,000, two or more happen once in 70."""
    rng, key, bad = np.random.default_rng(18), np.repeat(np.arange(6), 3), 0
    for _ in range(1000):
        bad += reduce_repeats(
            key, rng.normal(0, 2e-8, (1, 18)), np.zeros(18), limit=4.5
        ).outlier.sum()
    assert bad <= 1


@pytest.mark.parametrize(
    ("marks", "repeats", "components"), [(5, 2, 2), (5, 3, 1), (4, 2, 2), (11, 2, 1)]
)
def test_fewer_pairs_than_tell_an_outlier_reject_nothing_at_all(
    marks, repeats, components
):
    """However far it is off: whatever the noise does, no clean reading is lost."""
    key, rng = np.repeat(np.arange(marks), repeats), np.random.default_rng(1)
    values = rng.normal(0, 2e-8, (components, len(key)))
    values[0, 0] = 1.0
    assert not reduce_repeats(key, values, np.zeros(len(key)), limit=6.0).outlier.any()


@pytest.mark.parametrize(
    ("marks", "repeats", "components"), [(6, 3, 1), (12, 2, 1), (6, 2, 2)]
)
def test_twelve_pairs_tell_an_outlier(marks, repeats, components):
    key, rng = np.repeat(np.arange(marks), repeats), np.random.default_rng(1)
    values = rng.normal(0, 2e-8, (components, len(key)))
    values[0, 0] = 1.0
    found = reduce_repeats(key, values, np.zeros(len(key)), limit=6.0).outlier
    assert np.flatnonzero(found).tolist() == ([0] if repeats == 3 else [0, 1])


def test_what_differs_by_the_rounding_of_positions_is_no_outlier():
    key = np.repeat(np.arange(20), 5)
    values = np.zeros((2, 100))
    values[:, ::5] = 1.4e-17
    kept = reduce_repeats(key, values, np.zeros(100), limit=6.0, extent=0.1)
    assert not kept.outlier.any()
    values[0, 7] = 1e-6
    found = reduce_repeats(key, values, np.zeros(100), limit=6.0, extent=0.1)
    assert np.flatnonzero(found.outlier).tolist() == [7]


def test_a_measure_in_another_pose_supersedes_what_was_read_in_the_first():
    artifact = Artifact(3, 0.01)
    commands = [
        Command(stamp, Phase.MEASURE, "p", 0, View("v", 0.0, (shift, 0.0)), artifact)
        for stamp, shift in ((10, 0.0), (20, 0.01), (30, 0.01))
    ]
    timeline = build_timeline(commands)
    assert [i.reason for i in timeline.intervals] == [Reason.SUPERSEDED, None, None]
    assert timeline.views[0].translation_m == (0.01, 0.0)


def test_a_sample_with_two_nan_is_one_rejected_message():
    collector = Collector(CollectorSettings.checked({}, "test"))
    collector.add_encoder(EncoderSample(1, ("x", "y"), (math.nan, math.nan)))
    view, artifact = View("v", 0.0, (0.0, 0.0)), Artifact(3, 0.01)
    collector.add_command(Command(0, Phase.MEASURE, "p", 0, view, artifact))
    assert collector.collect()[0].rejected == {str(Reason.ENCODER_NOT_FINITE): 1}
