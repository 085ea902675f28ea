# SPDX-License-Identifier: Apache-2.0
"""A round of `make chaos`, short, and that its judgement sees what is wrong."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Detection
from test.support.chaos import (
    HARMLESS,
    STEPS_S,
    attacked,
    clock_ahead,
    faults_of,
    full_disk,
    killed_sequencers,
    one_round,
    story,
)


def test_nothing_is_lost_without_a_word_and_the_maps_are_the_right_ones(
    ros_environment, tmp_path, forks
):
    lines, wrong = one_round(2, ros_environment, tmp_path, kills=1, forks=forks)
    assert wrong == []
    assert [line.partition(":")[0] for line in lines] == [
        "quiet_messages",
        "lost_messages",
    ]
    assert all(" used + " in line for line in lines)
    assert [line.rpartition("killed ")[2] for line in lines] == [
        "measurement_collector",
        "solver",
    ]


def test_a_disk_that_is_full_for_a_while_costs_its_part_of_the_journal_alone(
    ros_environment, tmp_path, forks
):
    line, wrong = full_disk(3, ros_environment, tmp_path, forks=forks)
    assert wrong == []
    assert " used + " in line


def test_a_run_whose_sequencers_are_killed_is_taken_up_in_its_view(
    ros_environment, tmp_path, forks
):
    line, wrong = killed_sequencers(6, ros_environment, tmp_path, kills=2, forks=forks)
    assert wrong == []
    assert line.startswith("killed in views ")


def test_a_run_after_one_that_was_stamped_a_day_ahead_is_as_if_that_had_not_been(
    ros_environment, tmp_path, forks
):
    line, wrong = clock_ahead(4, ros_environment, tmp_path, kills=1, forks=forks)
    assert wrong == []
    assert " used + " in line


def test_a_cell_among_strangers_who_would_harm_gives_the_map_of_the_undisturbed_run(
    ros_environment, tmp_path, forks
):
    line, wrong = attacked(5, ros_environment, tmp_path, forks=forks)
    assert wrong == []
    assert " used + " in line


@pytest.mark.parametrize("seed", range(4))
def test_each_step_of_the_clock_has_its_round(seed):
    """Whatever the step, back and ahead, the readings are those of a quiet process."""
    assert faults_of(seed)[1].clock_step_s == STEPS_S[seed]
    assert faults_of(seed)[0].clock_step_s == 0.0


class Result:
    """A cell whose result is known."""

    namespace, folder = "cell", None

    def __init__(self):
        self.found = {}

    def saved(self):
        return self.found


def test_the_judgement_sees_a_detection_that_is_not_accounted_for_and_another_map():
    cell = Result()
    told = story(cell, HARMLESS, np.random.default_rng(1), kills=0)
    sent = sum(isinstance(event, Detection) for event in told.arriving)
    nothing = {
        name: [0.0] for name in ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta")
    }
    cell.found = {
        "views": [{"used": sent - 1}],
        "rejected": {"duplicate": 2},
        "error_map": nothing,
    }
    told.judge()
    assert told.faults[0] == f"{sent} detections sent, {sent - 1} used and 2 rejected"
    assert "gx is not that of these messages" in told.faults
    assert "gx is not that of the undisturbed run" in told.faults
    lost = replace(told, faults=[])
    cell.found = "no map"
    assert lost.judge() == "refused: no map"
    assert lost.faults == ["no map: no map"]
