# SPDX-License-Identifier: Apache-2.0
"""Small views, exact repeats, poses changed without PLACE, and samples with several NaN."""

import math

import numpy as np

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.marks.repeats import reduce_repeats
from selfcal_ros.collection.messages import Command, EncoderSample, Phase
from selfcal_ros.collection.reasons import Reason
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.collection.timeline import build_timeline
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


def rejected_of(draws, marks, repeats, components, seed):
    rng = np.random.default_rng(seed)
    key, none = np.repeat(np.arange(marks), repeats), np.zeros(marks * repeats)
    return sum(int(reduce_repeats(key, rng.normal(0, 2e-8, (components, len(key))), none,
                                  limit=6.0).outlier.sum()) for _ in range(draws))


def test_clean_readings_of_small_views_are_kept():
    # each 60,000 readings: below 1 in 100,000, four or more have a probability under 0.004
    for marks, repeats, components in ((5, 2, 2), (5, 3, 1), (6, 3, 1), (4, 2, 2)):
        draws = 60_000 // (marks * repeats)
        assert rejected_of(draws, marks, repeats, components, seed=marks * repeats) <= 3


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
    commands = [Command(stamp, Phase.MEASURE, "p", 0, View("v", 0.0, (shift, 0.0)), artifact)
                for stamp, shift in ((10, 0.0), (20, 0.01), (30, 0.01))]
    timeline = build_timeline(commands)
    assert [i.reason for i in timeline.intervals] == [Reason.SUPERSEDED, None, None]
    assert timeline.views[0].translation_m == (0.01, 0.0)


def test_a_sample_with_two_nan_is_one_rejected_message():
    collector = Collector(CollectorSettings.checked({}, "test"))
    collector.add_encoder(EncoderSample(1, ("x", "y"), (math.nan, math.nan)))
    view, artifact = View("v", 0.0, (0.0, 0.0)), Artifact(3, 0.01)
    collector.add_command(Command(0, Phase.MEASURE, "p", 0, view, artifact))
    assert collector.collect()[0].rejected == {str(Reason.ENCODER_NOT_FINITE): 1}
