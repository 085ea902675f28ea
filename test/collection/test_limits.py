# SPDX-License-Identifier: Apache-2.0
"""Messages that claim what cannot be: refused with a reason, before anything is allocated."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import (
    MAX_EXPOSURES,
    Command,
    Phase,
    check_simulated,
    good_sigmas,
)
from selfcal_ros.errors import InputError, SelfcalError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.solving import SolvingSession, solve
from test.support.collecting import collect, scene
from test.support.ports import Hands, message, settings_of
from test.support.sessions import collected, events_of, small_plan

SMALL = Artifact(5, 0.01, 8)


def first_view(**changes):
    """Return the ViewMeasurement of a view with 25 marks and 8 lines, some fields changed."""
    _, measurements, progress = collected(events_of(small_plan("0", repeats=1)))
    return message(
        "ViewMeasurement",
        from_model.view_measurement(progress[0], measurements, 10, "stage") | changes,
    )


@pytest.fixture
def session():
    return SolvingSession(settings_of("solver"), Hands().ports)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"translation_x": 1e300}, "pitches are beyond every field; is it in mm?"),
        (
            {"translation_y": float("nan")},
            "(0.0, nan) are not two lengths; give a finite",
        ),
        ({"rotation": float("inf")}, "inf is not an angle"),
        (
            {"view_index": 2**31},
            "a plan has at most 1000 views; correct the view_index",
        ),
        ({"grid_size": 3}, "m goes beyond -1 to 1; correct the publisher"),
        ({"angular_count": 4}, "k goes beyond 0 to 3; correct the publisher"),
        ({"grid_size": 2**31 + 1}, "rows of marks are more than 401; "),
        ({"angular_count": 2**32 - 4}, "is not a number from 3 to "),
        ({"dx": [1000.1] * 25}, "'0': dx is not a number up to 1000; give m and rad"),
        ({"dy": [float("nan")] * 25}, "'0': dy is not a number up to 1000"),
        ({"dtheta": [float("-inf")] * 8}, "'0': dtheta is not a number up to 1000"),
        ({"u": [1e300] * 25}, "'0': u is not a number up to 1000"),
        ({"u": [1e-200] + [2e-8] * 24}, "'0': u is below 1e-15; give m and rad"),
        ({"u_theta": [9e-16] * 8}, "'0': u_theta is below 1e-15; give m and rad"),
        ({"sigma_theta": -1e4}, "'0': sigma_theta is not a number up to 1000"),
        (
            {"visit_offset_y": [float("nan")] * 25},
            "'0', visits: offset_y is not a number up to 1000",
        ),
        (
            {"visit_count": [0] * 25},
            "'0', visits: a count below 1; correct the publisher",
        ),
    ],
)
def test_a_view_that_cannot_be_is_refused_and_forgotten(session, changes, reason):
    with pytest.raises(InputError) as caught:
        session.take_measurement(first_view(**changes))
    assert reason in str(caught.value)
    assert session.next_job() is None


def test_uncertainties_that_are_not_known_are_no_reason_to_refuse(session):
    nothing = float("nan")
    session.take_measurement(
        first_view(
            sigma_xy=nothing,
            sigma_theta=nothing,
            u=[nothing] * 25,
            dx=[1000.0] * 25,
            sigma_visit=nothing,
        )
    )
    assert session.next_job() is not None


def test_a_plate_that_is_enormous_beside_what_was_read_is_not_solved(session):
    session.take_measurement(first_view(grid_size=401))
    tracemalloc.start()
    with pytest.raises(
        InputError, match="25 readings of a plate with 160801 marks; correct "
    ):
        session.next_job()
    assert tracemalloc.get_traced_memory()[1] < 1e6
    tracemalloc.stop()


def test_a_thousand_sites_for_each_mark_are_still_solved(session):
    # 25921 sites, 26 * 1000 is the limit
    session.take_measurement(first_view(grid_size=161))
    assert session.next_job() is not None
    session.take_measurement(first_view(grid_size=163))
    with pytest.raises(InputError, match="25 readings of a plate with 26569 marks"):
        session.next_job()


@pytest.mark.parametrize(
    ("view", "artifact", "reason"),
    [
        (
            View("a", repeats=32),
            Artifact(401, 0.01),
            "5145632 exposures exceed the 5000000 of a",
        ),
        (
            View("a", repeats=2**32 - 1),
            SMALL,
            "4294967295 repeats; ask for 1 to 1000000",
        ),
        (View("a", repeats=200_001), SMALL, "5000025 exposures exceed"),
        (
            View("a", grid=False, angular=False),
            SMALL,
            "neither grid nor angular marks are requested",
        ),
        (View("a", translation_m=(1e17, 0.0)), SMALL, "pitches are beyond every field"),
    ],
)
def test_what_the_simulated_cell_cannot_hold_is_refused(view, artifact, reason):
    command = Command(5, Phase.MEASURE, "p", 0, view, artifact, 1)
    with pytest.raises(InputError) as caught:
        check_simulated(command)
    assert reason in str(caught.value)


def test_the_limit_itself_is_simulated():
    command = Command(
        5, Phase.MEASURE, "p", 0, View("a", repeats=MAX_EXPOSURES // 25), SMALL, 1
    )
    check_simulated(command)
    with pytest.raises(InputError, match="at most 1000 views"):
        check_simulated(replace(command, view_index=2**31))


@pytest.mark.parametrize(
    ("sigma", "good"),
    [
        ([0.0], [True]),
        ([1e-12], [True]),
        ([0.99e-12], [False]),
        ([1000.0], [True]),
        ([1000.1], [False]),
        ([1e-200, 0.0], [False, True]),
        ([2e-8, 2e-8, 2.1e-12], [True] * 3),
        ([2e-8, 2e-8, 1.9e-12], [True, True, False]),
        (
            [1e4, 2e-8, 2e-8, 1.9e-12],
            [False, True, True, False],
        ),  # one that is refused moves no median
        ([2e-8, 2e-8, 1.0], [True] * 3),
    ],
)
def test_sigmas_that_a_reading_can_have(sigma, good):
    assert good_sigmas(np.array(sigma)).tolist() == good


EDGES = [
    ("offset_x", 100.0),
    ("offset_x", 100.1),
    ("offset_y", -1e9),
    ("sigma", 1e4),
    ("sigma", 1000.0),
    ("sigma", 1e-12),
    ("sigma", 2e-12),
    ("sigma", 1e-200),
    ("offset_theta", 3.0),
    ("offset_theta", 101.0),
]


@pytest.mark.parametrize("alike", [False, True], ids=["one", "all"])
@pytest.mark.parametrize("declared", [0.0, 2e-8])
@pytest.mark.parametrize(("field", "value"), EDGES)
def test_what_the_collector_takes_of_a_detection_the_solver_can_use(
    field, value, declared, alike
):
    cell = scene(
        "0, 90, tx", line=True, repeats=2, sigma_xy_m=2e-8, sigma_theta_rad=2e-5
    )
    for index, seen in enumerate(cell.detections):
        spoilt = alike or index in (cell.grid(3), cell.angular(3))
        cell.spoil(index, **{"sigma": declared} | ({field: value} if spoilt else {}))
        if alike and field.startswith("offset"):  # a plate that lies there
            cell.spoil(index, **{field: value + getattr(seen, field)})
    measurements, progress = collect(cell.events)
    messages = [
        message(
            "ViewMeasurement",
            from_model.view_measurement(view, measurements, 10, "stage"),
        )
        for view in progress.values()
    ]
    session = SolvingSession(settings_of("solver"), Hands().ports)
    for item in messages:
        session.take_measurement(item)
    outcome = solve(session.next_job())
    lost = sum(measurements.all_rejected().values())
    assert lost + sum(view.used for view in measurements.views) == len(cell.detections)
    assert alike or (outcome.problem is None and lost <= 2)
    assert outcome.problem is None or isinstance(outcome.problem, SelfcalError)
