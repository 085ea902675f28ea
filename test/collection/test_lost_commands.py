# SPDX-License-Identifier: Apache-2.0
"""What is said of commands that were lost between the sequencer and the recording."""

import pytest

from selfcal_ros.collection.inputs import Command, Detection, Phase
from test.support.sessions import events_of, gathered, small_plan

MEASURED = len([e for e in events_of(small_plan()) if isinstance(e, Detection)])


def without(*lost):
    """Return what is said of a recording of four views without commands (view, phase)."""
    return gathered(
        [
            event
            for event in events_of(small_plan())
            if not isinstance(event, Command)
            or (event.view_index, event.phase) not in lost
        ]
    ).missing_commands()


def test_a_whole_recording_misses_none():
    assert without() == []


def test_the_end_of_a_run_and_where_the_plate_lies_may_be_missing():
    assert without((4, Phase.DONE), *((view, Phase.PLACE) for view in range(4))) == []


@pytest.mark.parametrize("view", range(4))
def test_a_view_whose_measure_is_lost_is_named_with_what_was_read_in_it(view):
    plan = small_plan()
    (line,) = without((view, Phase.MEASURE))
    read = line.removeprefix(
        f"view '{plan.views[view].name}' was placed, and "
    ).split()[0]
    counts = [
        int(without((other, Phase.MEASURE))[0].split("placed, and ")[1].split()[0])
        for other in range(4)
    ]
    assert int(read) == counts[view] and sum(counts) == MEASURED
    assert "its MEASURE command is missing" in line


def test_a_view_without_any_command_is_named_by_its_number():
    (line,) = without((1, Phase.PLACE), (1, Phase.MEASURE))
    assert line.startswith("no command of view 1 of the plan (from 0) is there")


def test_a_view_that_was_left_out_is_not_a_loss():
    """The sequencer's `skip` places the next view: nothing was detected in this one."""
    events = events_of(small_plan())
    begin, end = (
        next(
            e.stamp_ns
            for e in events
            if isinstance(e, Command) and (e.view_index, e.phase) == (view, Phase.PLACE)
        )
        for view in (1, 2)
    )
    left_out = [e for e in events if not (begin < e.stamp_ns < end)]
    assert gathered(left_out).missing_commands() == []
