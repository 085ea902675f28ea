# SPDX-License-Identifier: Apache-2.0
"""Which view an instant belongs to: half-open intervals between the stamps of commands."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from selfcal_ros.collection.inputs import Command, Phase, Reason
from selfcal_ros.collection.timeline import NO_END, build_timeline
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.plans import plan_of

PLAN = plan_of("0, 90, tx")
PLACE, MEASURE, DONE, ABORT = Phase


def command(stamp, phase, index=0, **fields):
    view = (
        (PLAN.views[index], PLAN.artifact, 3)
        if phase in (PLACE, MEASURE)
        else (None, None, 3)
    )
    return replace(Command(stamp, phase, PLAN.plan_id, index, *view), **fields)


def owners(commands, *stamps):
    """Return, for each stamp, the view or the reason why it is in none."""
    timeline = build_timeline(commands)
    out = []
    for number in timeline.assign(np.array(stamps, dtype=np.int64)).tolist():
        interval = timeline.intervals[number] if number >= 0 else None
        out.append(
            "before"
            if interval is None
            else interval.reason
            if interval.view_index is None
            else interval.view_index
        )
    return out


WHOLE = [
    command(10, PLACE),
    command(20, MEASURE),
    command(30, PLACE, 1),
    command(40, MEASURE, 1),
    command(50, DONE, 3),
]
OUT, OLD, OTHER = Reason.OUTSIDE_VIEWS, Reason.SUPERSEDED, Reason.OTHER_PLAN
RUN = Reason.OTHER_RUN


def of_run(commands, run_id):
    return [replace(c, run_id=run_id) for c in commands]


def test_a_view_lasts_from_its_stamp_to_just_before_the_next():
    assert owners(WHOLE, 9, 10, 19, 20, 29, 30, 40, 49, 50, 10**18) == [
        "before",
        OUT,
        OUT,
        0,
        0,
        OUT,
        1,
        1,
        OUT,
        OUT,
    ]


def test_what_the_timeline_says_of_itself():
    timeline = build_timeline(WHOLE)
    assert (timeline.plan_id, timeline.artifact) == (PLAN.plan_id, PLAN.artifact)
    assert timeline.views == {0: PLAN.views[0], 1: PLAN.views[1]}
    assert (timeline.views_planned, timeline.finished, timeline.last_stamp_ns) == (
        3,
        True,
        50,
    )
    assert [(i.start_ns, i.end_ns) for i in timeline.of_view(1)] == [(40, 50)]
    unended = build_timeline(WHOLE[:-1])
    assert not unended.finished
    assert unended.of_view(1)[0].end_ns == NO_END
    assert build_timeline([*WHOLE[:-1], command(50, ABORT)]).finished


@given(st.permutations(WHOLE + WHOLE[1:3]))
def test_the_order_of_arrival_and_repeated_commands_change_nothing(commands):
    assert build_timeline(commands) == build_timeline(WHOLE)


def test_no_command_and_no_measure():
    empty = build_timeline([])
    assert (empty.artifact, empty.views, empty.intervals) == (None, {}, ())
    assert owners([], 5) == ["before"]
    placed = build_timeline(WHOLE[:1])
    assert placed.artifact is None
    assert placed.last_stamp_ns == 10
    assert owners(WHOLE[:1], 5, 15) == ["before", OUT]


def test_a_view_without_its_place_is_measured():
    assert owners([command(20, MEASURE)], 19, 20) == ["before", 0]


def test_place_and_measure_of_one_stamp_are_taken_in_their_order():
    assert owners([command(10, MEASURE), command(10, PLACE)], 10) == [0]


def test_a_redo_supersedes_only_its_own_view():
    redo = [*WHOLE[:-1], command(50, PLACE), command(60, MEASURE), command(70, DONE)]
    assert owners(of_run(redo, "7"), 20, 40, 55, 60, 70) == [OLD, 1, OUT, 0, OUT]
    assert build_timeline(of_run(redo, "7")).run_id == "7"


def test_only_the_last_of_many_redos_counts():
    redo = [command(10 * k, phase) for k, phase in enumerate([PLACE, MEASURE] * 3, 1)]
    assert owners(redo, 20, 40, 60) == [OLD, OLD, 0]


def test_a_view_measured_again_without_place_has_two_intervals():
    commands = [
        command(10, PLACE),
        command(20, MEASURE),
        command(30, PLACE, 1),
        command(40, MEASURE, 1),
        command(50, MEASURE),
    ]
    assert owners(commands, 20, 40, 50) == [0, 1, 0]
    assert len(build_timeline(commands).of_view(0)) == 2


def test_another_pose_stays_superseded_when_its_view_goes_on():
    shifted = replace(PLAN.views[0], translation_m=(0.01, 0.0))
    commands = [
        command(10, PLACE),
        command(20, MEASURE),
        command(30, MEASURE, view=shifted),
        command(40, MEASURE, view=shifted),
    ]
    assert owners(commands, 20, 30, 40) == [OLD, 0, 0]


def test_a_place_that_no_measure_follows_supersedes_nothing():
    assert owners([*WHOLE[:2], command(30, PLACE)], 20, 30) == [0, OUT]


def test_the_plan_of_the_last_measure_is_used():
    other = [command(1, PLACE, plan_id="b"), command(2, MEASURE, plan_id="b")]
    assert owners([*other, *WHOLE], 1, 2, 20) == [OUT, OTHER, 0]
    late = [replace(c, stamp_ns=c.stamp_ns + 100) for c in other]
    assert owners([*WHOLE, *late], 20, 40, 102) == [OTHER, OTHER, 0]
    assert build_timeline([*WHOLE, *late]).plan_id == "b"


def test_views_planned_is_at_least_what_was_seen():
    unsaid = [replace(c, views_planned=0) for c in WHOLE]
    assert build_timeline(unsaid).views_planned == 2


def test_two_plates_in_one_plan_are_refused():
    odd = command(40, MEASURE, 1, artifact=Artifact(7, 0.01))
    with pytest.raises(
        InputError,
        match=r"^view command of '0': describes a different plate from "
        r"the rest of plan '0, 90, tx'; use one plate in one plan$",
    ):
        build_timeline([*WHOLE[:2], odd])


@pytest.mark.parametrize("end", [[command(50, DONE, 3)], [command(50, ABORT, 2)], []])
def test_a_plan_that_is_started_again_is_another_run(end):
    again = [command(60, PLACE), command(70, MEASURE)]
    commands = [*WHOLE[:-1], *end, *again]
    assert owners(commands, 20, 40, 65, 70) == [RUN, RUN, OUT, 0]
    timeline = build_timeline(commands)
    assert timeline.run_id == "60"
    assert list(timeline.views) == [0]
    further = [command(80, PLACE, 1), command(90, MEASURE, 1)]
    assert owners([*commands, *further], 20, 40, 70, 90) == [RUN, RUN, 0, 1]
    assert build_timeline(WHOLE).run_id == "10"


def test_a_run_counts_from_its_first_measure_on():
    assert owners([*WHOLE, command(60, PLACE)], 20, 40, 60) == [0, 1, OUT]


def test_a_view_that_is_redone_within_a_run_is_no_other_run():
    later = [command(60, PLACE, 1), command(70, MEASURE, 1), command(80, DONE, 3)]
    assert owners([*WHOLE[:-1], *later], 20, 40, 70) == [0, OLD, 1]
    assert owners([*WHOLE, *later], 20, 40, 70) == [0, OLD, 1]  # after DONE, too


def test_without_any_place_a_second_measure_of_view_0_after_others_is_another_run():
    commands = [command(10, MEASURE), command(20, MEASURE, 1), command(30, MEASURE)]
    assert owners(commands, 10, 20, 30) == [RUN, RUN, 0]
    assert owners([commands[0], replace(commands[2], stamp_ns=15)], 10, 15) == [0, 0]


def test_runs_that_are_named_are_kept_apart_by_their_names():
    first, second = (
        of_run(WHOLE, "a"),
        [replace(c, stamp_ns=c.stamp_ns + 100, run_id="b") for c in WHOLE[2:4]],
    )
    assert owners([*first, *second], 20, 40, 135, 140) == [RUN, RUN, OUT, 1]
    assert build_timeline([*first, *second]).run_id == "b"
    going_on = [replace(c, stamp_ns=c.stamp_ns + 100, run_id="a") for c in WHOLE[2:4]]
    assert owners([*first, *going_on], 20, 40, 140) == [0, OLD, 1]


def test_two_runs_may_have_two_plates_and_two_numbers_of_views():
    other = Artifact(7, 0.01)
    again = [
        command(60, PLACE, artifact=other),
        command(70, MEASURE, artifact=other),
        command(80, DONE, 1, views_planned=1),
    ]
    again = [replace(c, views_planned=1) for c in again]
    timeline = build_timeline([*WHOLE, *again])
    assert (timeline.artifact, timeline.views_planned) == (other, 1)


@given(
    st.permutations(
        [*WHOLE, command(60, PLACE), command(70, MEASURE), command(80, DONE, 3)]
    )
)
def test_the_order_of_arrival_changes_no_run(commands):
    timeline = build_timeline(commands)
    assert timeline.run_id == "60"
    assert timeline == build_timeline(sorted(commands, key=lambda c: c.stamp_ns))


@pytest.mark.parametrize(
    "heard", [slice(1, None), slice(2, None), slice(3, 4), slice(0, 2), slice(0, None)]
)
def test_a_run_is_named_by_its_first_command_and_not_before_that_can_have_come(heard):
    """Commands arrive in any order: what is called an earlier run would be left aside for good."""
    known = heard.start == 0
    assert build_timeline(WHOLE[heard]).run_id == ("10" if known else "")
    named = build_timeline(of_run(WHOLE[heard], "7"))
    assert named.run_id == "7"


def test_a_later_run_is_named_though_the_one_before_is_known_in_part_only():
    again = [replace(c, stamp_ns=c.stamp_ns + 100) for c in WHOLE]
    assert build_timeline([*WHOLE[2:], *again]).run_id == "110"
    assert build_timeline([*WHOLE[2:], *again[1:]]).run_id == "120"


RUN_10 = of_run(WHOLE, "10")


def stray(stamp, phase, run_id="", index=0, **fields):
    return command(stamp, phase, index, run_id=run_id, **fields)


@pytest.mark.parametrize(
    "odd",
    [
        stray(25, MEASURE, index=2),
        stray(25, PLACE),
        stray(25, ABORT),
        stray(25, DONE),
        stray(25, MEASURE, "7"),
        stray(25, MEASURE, "24"),
        stray(25, MEASURE, "x"),
        stray(25, MEASURE, plan_id="other"),
        stray(25, MEASURE, "10", plan_id="other"),
    ],
)
def test_a_command_of_no_run_that_has_begun_changes_nothing_within_one_that_has(odd):
    clean, timeline = build_timeline(RUN_10), build_timeline([odd, *RUN_10])
    assert timeline == replace(clean, strays=(odd,))
    assert clean.strays == ()
    open_run = build_timeline([*RUN_10[:2], odd])  # it came last
    assert open_run == replace(build_timeline(RUN_10[:2]), strays=(odd,))


@pytest.mark.parametrize(
    ("events", "run_id"),
    [
        ([*RUN_10[:2], stray(25, MEASURE, "25", index=2)], "25"),  # another one begins
        ([*RUN_10, stray(60, PLACE), stray(70, MEASURE)], "60"),  # behind the end
        (
            [*of_run(WHOLE[1:-1], "10"), stray(45, MEASURE, "7")],
            "7",
        ),  # no begin is there
        ([*of_run(WHOLE[:2], "5"), stray(25, MEASURE, "7")], "7"),
        (
            [
                *RUN_10[:2],
                *of_run([command(25, PLACE), command(26, MEASURE)], "25"),
                stray(28, MEASURE, "10", index=1),
            ],
            "10",
        ),
    ],
)  # two that have begun take turns
def test_a_command_is_no_stray_where_it_may_be_meant(events, run_id):
    timeline = build_timeline(events)
    assert (timeline.run_id, timeline.strays) == (run_id, ())
