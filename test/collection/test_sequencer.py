# SPDX-License-Identifier: Apache-2.0
"""The sequencer's state machine: every request in every state."""

from dataclasses import replace

import pytest

from selfcal_ros.collection.inputs import Phase
from selfcal_ros.collection.sequencer import Sequencer, State
from selfcal_ros.errors import InputError
from test.support.plans import plan_of

PLAN = plan_of("0, 90, tx")
REQUESTS = {
    "start": lambda s: s.start(),
    "confirm": lambda s: s.confirm(),
    "complete": lambda s: s.status(PLAN.plan_id, s.index, True),
    "redo": lambda s: s.redo(),
    "skip": lambda s: s.skip(),
    "abort": lambda s: s.abort(),
}
PLACE, MEASURE, DONE, ABORT = Phase


def sequencer_in(state):
    sequencer = Sequencer(PLAN)
    if state is State.FOLLOWING:
        sequencer.foreign_command()
    if state in (State.PLACING, State.MEASURING, State.DONE, State.ABORTED):
        sequencer.start()
    if state is State.MEASURING:
        sequencer.confirm()
    if state is State.ABORTED:
        sequencer.abort()
    if state is State.DONE:
        for _ in PLAN.views:
            sequencer.skip()
    assert sequencer.state is state
    return sequencer


FITS = {  # (state, request) -> phase of the command, its view, state after
    **{
        (state, "start"): (PLACE, 0, State.PLACING)
        for state in (State.IDLE, State.DONE, State.ABORTED)
    },
    (State.PLACING, "confirm"): (MEASURE, 0, State.MEASURING),
    (State.PLACING, "redo"): (PLACE, 0, State.PLACING),
    (State.PLACING, "skip"): (PLACE, 1, State.PLACING),
    (State.PLACING, "abort"): (ABORT, 0, State.ABORTED),
    (State.MEASURING, "complete"): (PLACE, 1, State.PLACING),
    (State.MEASURING, "redo"): (PLACE, 0, State.PLACING),
    (State.MEASURING, "skip"): (PLACE, 1, State.PLACING),
    (State.MEASURING, "abort"): (ABORT, 0, State.ABORTED),
}
QUIET = {(State.FOLLOWING, "abort"): State.IDLE}  # fits, and commands nothing


@pytest.mark.parametrize("request_name", REQUESTS)
@pytest.mark.parametrize("state", State, ids=lambda s: s.name)
def test_every_request_in_every_state(state, request_name):
    sequencer = sequencer_in(state)
    index = sequencer.index
    if (state, request_name) in FITS:
        phase, view, after = FITS[state, request_name]
        (command,) = REQUESTS[request_name](sequencer)
        assert (command.phase, command.view_index, sequencer.state) == (
            phase,
            view,
            after,
        )
        assert command.plan_id == PLAN.plan_id
        assert command.views_planned == 3
        assert command.view == (PLAN.views[view] if phase in (PLACE, MEASURE) else None)
        assert command.artifact == (
            PLAN.artifact if phase in (PLACE, MEASURE) else None
        )
        return
    if (state, request_name) in QUIET:
        assert REQUESTS[request_name](sequencer) == []
        state = QUIET[state, request_name]
    elif request_name == "complete":
        assert REQUESTS[request_name](sequencer) == []
    else:
        with pytest.raises(InputError, match=f"^pose_sequencer: .*while {state}"):
            REQUESTS[request_name](sequencer)
    assert (sequencer.state, sequencer.index) == (state, index)


def test_a_whole_plan():
    sequencer = Sequencer(PLAN)
    commands = sequencer.start()
    for index in range(3):
        commands += sequencer.confirm()
        commands += sequencer.status(PLAN.plan_id, index, True)
    assert [(c.phase, c.view_index) for c in commands] == [
        (PLACE, 0),
        (MEASURE, 0),
        (PLACE, 1),
        (MEASURE, 1),
        (PLACE, 2),
        (MEASURE, 2),
        (DONE, 3),
    ]
    assert sequencer.state is State.DONE
    assert sequencer.skipped == []


@pytest.mark.parametrize(
    "status", [("other", 0, True), (PLAN.plan_id, 1, True), (PLAN.plan_id, 0, False)]
)
def test_a_status_that_is_not_of_the_current_view_or_incomplete_is_ignored(status):
    sequencer = sequencer_in(State.MEASURING)
    assert sequencer.status(*status) == []
    assert (sequencer.state, sequencer.index) == (State.MEASURING, 0)


def test_skipped_views_are_remembered_until_the_next_start():
    sequencer = sequencer_in(State.PLACING)
    sequencer.skip()
    sequencer.confirm()
    sequencer.skip()
    assert sequencer.skipped == ["0", "90"]
    sequencer.abort()
    sequencer.start()
    assert (sequencer.skipped, sequencer.index) == ([], 0)


def test_skipping_the_last_view_is_done():
    sequencer = sequencer_in(State.PLACING)
    assert [sequencer.skip()[0].phase for _ in range(3)] == [PLACE, PLACE, DONE]


def test_without_a_plan_nothing_starts():
    with pytest.raises(
        InputError, match=r"^pose_sequencer: there is no plan; set the parameter"
    ):
        Sequencer().start()


def test_commands_that_describe_a_view_carry_the_terms_of_the_plan():
    sequencer = Sequencer(replace(PLAN, model_terms=("drift:1e-8",)))
    commands = [*sequencer.start(), *sequencer.confirm(), *sequencer.abort()]
    assert [command.model_terms for command in commands] == [("drift:1e-8",)] * 2 + [()]


def test_commands_wait_for_the_caller_to_stamp_them():
    (command,) = Sequencer(PLAN).start()
    assert command.stamp_ns == 0
    assert replace(command, stamp_ns=5).stamp_ns == 5


def test_the_sequencer_yields_to_recorded_commands_in_any_state():
    for state in State:
        sequencer = sequencer_in(state)
        sequencer.foreign_command()
        assert sequencer.state is State.FOLLOWING


@pytest.mark.parametrize(
    ("state", "remedy"),
    [
        (State.IDLE, "start a plan first"),
        (State.DONE, "start a plan first"),
        (State.MEASURING, "redo_view has the plate placed again"),
    ],
)
def test_a_confirmation_out_of_place_says_what_to_do(state, remedy):
    with pytest.raises(
        InputError, match=f"confirm_view does not fit while {state}; {remedy}$"
    ):
        sequencer_in(state).confirm()
