# SPDX-License-Identifier: Apache-2.0
"""The session of the sequencer, on both sides of every time and every guard."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Command, Phase
from selfcal_ros.collection.sequencer import State
from selfcal_ros.errors import InputError
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.nodes.sessions.sequencing import PATIENCE_S, SequencingSession
from test.support.ports import START_NS, Hands, message, settings_of
from test.support.sessions import plan_file, small_plan

PLAN = small_plan()
PLACE, MEASURE, DONE, ABORT = Phase
READY = {"encoder_heard": "yes", "detections_matched": "yes"}


class Desk:
    """A session with a plan, on a clock of its own."""

    def __init__(self, folder, **parameters) -> None:
        self.hands = Hands()
        self.session = SequencingSession(
            settings_of(
                "pose_sequencer",
                **(
                    {"plan": plan_file(folder, PLAN), "start_checks": False}
                    | parameters
                ),
            ),
            self.hands.ports,
        )

    @property
    def commands(self) -> list[tuple[Phase, int]]:
        return [(Phase(f["phase"]), f["view_index"]) for f in self.hands.of("command")]

    def hear(self, node: str, **values: str) -> None:
        self.session.presence.take(node, Diagnosis(Level.OK, "", values))

    def status(
        self,
        index: int = 0,
        *,
        done: int = 5,
        complete: bool = False,
        age_ns: int = 0,
        **fields,
    ) -> None:
        stamp = self.hands.of("command")[-1]["header"]["stamp"]
        stamp_ns = stamp["sec"] * 10**9 + stamp["nanosec"] - age_ns
        self.session.take_status(
            SimpleNamespace(
                **(
                    {
                        "header": SimpleNamespace(
                            stamp=SimpleNamespace(sec=0, nanosec=stamp_ns)
                        ),
                        "plan_id": PLAN.plan_id,
                        "view_index": index,
                        "complete": complete,
                        "grid_expected": 25,
                        "grid_done": done,
                        "angular_expected": 0,
                        "angular_done": 0,
                        "check_expected": 0,
                        "check_done": 0,
                        "detections_used": done,
                        "detections_rejected": 0,
                        "missing_m": [],
                        "missing_n": [],
                        "missing_k": [],
                        "run_id": self.session.run_id,
                    }
                    | fields
                )
            )
        )


@pytest.fixture
def desk(tmp_path):
    return Desk(tmp_path)


@pytest.fixture
def measuring(desk):
    desk.session.begin()
    desk.session.act(desk.session.machine.confirm)
    return desk


def test_a_run_is_named_by_the_stamp_of_its_first_command(measuring):
    measuring.hands.pass_time(1)
    measuring.session.act(measuring.session.machine.redo)
    commands = measuring.hands.of("command")
    assert [c["run_id"] for c in commands] == [str(START_NS)] * 3
    measuring.session.give_up()
    measuring.hands.pass_time(1)
    measuring.session.begin()
    assert measuring.hands.of("command")[-1]["run_id"] == str(START_NS + 2 * 10**9)


def test_each_command_starts_the_coverage_of_its_view_anew(measuring):
    assert measuring.session.diagnosis().values["coverage"] == "0.000"
    measuring.status(done=10)
    assert measuring.session.diagnosis().values["coverage"] == "0.400"
    measuring.session.act(measuring.session.machine.redo)
    assert (
        measuring.session.coverage,
        measuring.session.diagnosis().values["coverage"],
    ) == (0.0, "0.000")


def test_stamps_grow_where_the_clock_steps_back(measuring):
    measuring.hands.pass_time(-5)
    measuring.session.act(measuring.session.machine.redo)
    stamps = [
        c["header"]["stamp"]["sec"] * 10**9 + c["header"]["stamp"]["nanosec"]
        for c in measuring.hands.of("command")
    ]
    assert stamps == [START_NS, START_NS + 1, START_NS + 2]


@pytest.mark.parametrize("back_s, said", [(0.099, 0), (0.2, 1), (37.0, 1)])
def test_a_clock_that_was_set_back_is_told_until_it_has_caught_up(
    measuring, back_s, said
):
    measuring.hands.pass_time(-back_s)
    measuring.session.tick()
    measuring.session.tick()
    words = f"this machine's clock is {back_s:.3g} s behind its own last command: it was set back"
    assert [line[: len(words)] for line in measuring.hands.lines(Level.WARN)] == [
        words
    ] * said
    assert measuring.session.diagnosis().message.startswith(words) is bool(said)
    measuring.hands.pass_time(back_s)
    measuring.session.tick()
    assert measuring.session.diagnosis().level == Level.OK


@pytest.mark.parametrize("age_ns, moves", [(1, False), (0, True), (-1, True)])
def test_a_status_counts_from_the_stamp_of_the_newest_command(measuring, age_ns, moves):
    measuring.status(complete=True, age_ns=age_ns)
    assert (measuring.commands[-1] == (PLACE, 1)) is moves


@pytest.mark.parametrize(
    "fields, moves",
    [
        ({}, True),
        ({"run_id": "1"}, False),
        ({"run_id": ""}, False),
        ({"plan_id": "other"}, False),
        ({"view_index": 1}, False),
        ({"complete": False}, False),
    ],
)
def test_only_the_current_view_of_this_run_moves_it_on(measuring, fields, moves):
    measuring.status(**({"complete": True} | fields))
    assert (measuring.commands[-1] == (PLACE, 1)) is moves


@pytest.mark.parametrize("seconds, confirmed", [(0.49, False), (0.5, True)])
def test_settle_time(tmp_path, seconds, confirmed):
    desk = Desk(tmp_path, auto_confirm=True, settle_time=0.5)
    desk.session.begin()
    desk.hands.pass_time(seconds)
    desk.session.tick()
    assert desk.commands == [(PLACE, 0)] + [(MEASURE, 0)] * confirmed


@pytest.mark.parametrize(
    "timeout, seconds, last",
    [(10.0, 9.9, (MEASURE, 0)), (10.0, 10.0, (PLACE, 0)), (0.0, 1e6, (MEASURE, 0))],
)
def test_view_timeout(tmp_path, timeout, seconds, last):
    desk = Desk(tmp_path, view_timeout=timeout, max_redos=1)
    desk.session.begin()
    desk.session.act(desk.session.machine.confirm)
    desk.hands.pass_time(seconds)
    desk.session.tick()
    assert desk.commands[-1] == last


def test_redos_are_counted_by_view(tmp_path):
    desk = Desk(
        tmp_path, view_timeout=1.0, max_redos=1, auto_confirm=True, settle_time=0.0
    )
    desk.session.begin()
    for _ in range(10):
        desk.session.tick()  # confirms
        desk.hands.pass_time(1.0)
        if desk.commands[-1] == (MEASURE, 0) and desk.commands.count((MEASURE, 0)) == 2:
            desk.status(0, complete=True)  # the second view gets its redo all the same
        else:
            desk.session.tick()
    assert desk.commands[:12] == [
        (PLACE, 0),
        (MEASURE, 0),
        (PLACE, 0),
        (MEASURE, 0),
        (PLACE, 1),
        (MEASURE, 1),
        (PLACE, 1),
        (MEASURE, 1),  # and is skipped
        (PLACE, 2),
        (MEASURE, 2),
        (PLACE, 2),
        (MEASURE, 2),
    ]


@pytest.mark.parametrize(
    "values, missing",
    [
        (READY, []),
        (
            READY | {"encoder_heard": "no"},
            ["the encoder (measurement_collector hears no sample)"],
        ),
        (
            READY | {"detections_matched": "no"},
            ["a publisher of stage/mark_detections"],
        ),
        (
            {},
            [
                "the encoder (measurement_collector hears no sample)",
                "a publisher of stage/mark_detections",
            ],
        ),
    ],
)
def test_who_is_missing(tmp_path, values, missing):
    desk = Desk(tmp_path, start_checks=True)
    assert desk.session.missing() == [
        "measurement_collector (no sign of life)",
        "solver (no sign of life)",
    ]
    desk.hear("measurement_collector", **values)
    desk.hear("solver")
    assert desk.session.missing() == missing


@pytest.mark.parametrize(
    "seconds, missing",
    [
        (PATIENCE_S, []),
        (
            PATIENCE_S + 0.01,
            ["measurement_collector (no sign of life)", "solver (no sign of life)"],
        ),
    ],
)
def test_a_node_without_a_word_is_missing_after_a_while(tmp_path, seconds, missing):
    desk = Desk(tmp_path, start_checks=True)
    desk.hear("measurement_collector", **READY)
    desk.hear("solver")
    desk.hands.pass_time(seconds)
    assert desk.session.missing() == missing


TOLD = READY | {
    "plan_id": PLAN.plan_id,
    "run_id": "17",
    "phase": "MEASURE",
    "view": "1",
    "view_name": PLAN.views[1].name,
    "command_stamp": "1700",
}


@pytest.mark.parametrize(
    "values, parameters, command",
    [
        (TOLD, {}, (MEASURE, 1)),
        (TOLD | {"phase": "PLACE"}, {}, (PLACE, 1)),
        (TOLD, {"resume": False}, (PLACE, 0)),
        (TOLD | {"plan_id": "other"}, {}, (PLACE, 0)),
        (TOLD | {"run_id": ""}, {}, (PLACE, 0)),
        (TOLD | {"phase": "DONE"}, {}, (PLACE, 0)),
        (TOLD | {"phase": "ABORT"}, {}, (PLACE, 0)),
        (TOLD | {"view": "4"}, {}, (PLACE, 0)),
        (TOLD | {"view": "-1"}, {}, (PLACE, 0)),
        (TOLD | {"view": "\u0661"}, {}, (PLACE, 0)),
        (TOLD | {"view": "9" * 5000}, {}, (PLACE, 0)),
        (TOLD | {"command_stamp": str(START_NS + MAX_AHEAD_NS)}, {}, (MEASURE, 1)),
        (
            TOLD | {"command_stamp": str(START_NS + MAX_AHEAD_NS + 1)},
            {},
            (PLACE, 0),
        ),  # clock set back
        (TOLD | {"command_stamp": ""}, {}, (PLACE, 0)),
        (TOLD | {"command_stamp": "1e9"}, {}, (PLACE, 0)),
        (TOLD | {"view_name": "other"}, {}, (PLACE, 0)),
        (READY, {}, (PLACE, 0)),
    ],
)
def test_a_run_is_taken_up_if_the_collector_tells_an_unfinished_one(
    tmp_path, values, parameters, command
):
    desk = Desk(tmp_path, start_checks=True, **parameters)
    desk.hear("measurement_collector", **values)
    desk.hear("solver")
    desk.session.begin()
    assert desk.commands == [command]
    resumed = command[1] == 1
    assert desk.session.run_id == ("17" if resumed else str(START_NS))


@pytest.mark.parametrize(
    ("plate", "view", "goes_on"),
    [
        ({}, {}, True),
        ({}, {"visit_order": "x_back_y@plate"}, True),
        ({"grid_size": 7}, {}, False),
        ({"grid_pitch_m": 0.011}, {}, False),
        ({"angular_count": 12}, {}, False),
        ({}, {"rotation_rad": np.pi}, False),
        ({}, {"translation_m": (0.0, 0.01)}, False),
        ({}, {"repeats": 3}, False),
        ({}, {"grid": False}, False),
        ({}, {"angular": False}, False),
    ],
)
def test_a_plan_that_was_edited_begins_a_new_run(tmp_path, plate, view, goes_on):
    collector = CollectingSession(settings_of("measurement_collector"), Hands().ports)
    collector.take_command(
        message(
            "ViewCommand",
            from_model.command(
                Command(
                    START_NS,
                    MEASURE,
                    PLAN.plan_id,
                    1,
                    replace(PLAN.views[1], **view),
                    replace(PLAN.artifact, **plate),
                    len(PLAN.views),
                    run_id="17",
                ),
                "stage",
            ),
        ),
        False,
    )
    told = collector.diagnosis(detections_matched=True).values
    desk = Desk(tmp_path, start_checks=True)
    desk.hear("measurement_collector", **{key: str(told[key]) for key in told} | READY)
    desk.hear("solver")
    desk.session.begin()
    assert desk.commands == [(MEASURE, 1) if goes_on else (PLACE, 0)]
    assert desk.session.run_id == ("17" if goes_on else str(START_NS))


def test_only_a_sequencer_that_has_done_nothing_yet_takes_up_a_run(tmp_path):
    desk = Desk(tmp_path, start_checks=True)
    desk.hear("measurement_collector", **TOLD)
    desk.hear("solver")
    desk.session.begin()
    desk.session.give_up()
    desk.session.begin()
    assert desk.commands == [(MEASURE, 1), (ABORT, 1), (PLACE, 0)]


@pytest.mark.parametrize("short, known", [(0, "; already measured: 0"), (1, "")])
def test_a_view_that_was_aborted_is_not_measured_already(tmp_path, short, known):
    desk = Desk(tmp_path, start_checks=True)
    count = np.full(25, 2)
    count[:short] = 1
    view = from_model.command(
        Command(0, MEASURE, PLAN.plan_id, 0, PLAN.views[0], PLAN.artifact), "stage"
    )
    desk.session.take_measurement(
        SimpleNamespace(
            **(view | {"count": count, "count_theta": np.full(8, 2), "run_id": "17"})
        )
    )
    desk.hear("measurement_collector", **TOLD)
    desk.hear("solver")
    assert desk.session.begin() == (
        f"resumed run 17 in view '{PLAN.views[1].name}', MEASURE{known}"
    )


@pytest.mark.parametrize("seconds, said", [(4.99, False), (5.0, True)])
def test_a_view_that_stalls_names_its_missing_marks(measuring, seconds, said):
    measuring.status(done=23, missing_m=[-2, 1], missing_n=[0, 2])
    measuring.hands.pass_time(seconds)
    measuring.session.tick()
    line = (
        "view '0' stalls with 92.0 % of its marks complete: missing 2 marks: (-2, 0), (1, 2); "
        "measurement_collector gives no sign of life"
    )
    assert measuring.hands.lines(Level.WARN) == [line] * said
    assert measuring.session.diagnosis().level == (Level.WARN if said else Level.OK)
    measuring.session.tick()
    assert measuring.hands.lines(Level.WARN) == [line] * said  # once


def test_check_stops_that_are_missing_count_and_are_named(measuring):
    measuring.status(done=25, check_expected=5, check_done=3)
    assert measuring.session.coverage == 28 / 30
    measuring.hands.pass_time(5.0)
    measuring.session.tick()
    assert measuring.hands.lines(Level.WARN) == [
        "view '0' stalls with 93.3 % of its marks complete: missing check stops of 2 marks (see "
        "check_marks of the view command); measurement_collector gives no sign of life"
    ]


def test_a_view_without_any_detection_stalls_too_and_the_collector_is_quoted(measuring):
    measuring.hands.pass_time(5.0)
    measuring.session.presence.take(
        "measurement_collector", Diagnosis(Level.WARN, "clock")
    )
    measuring.session.tick()
    assert measuring.hands.lines(Level.WARN) == [
        "view '0' stalls: no detection has arrived since MEASURE; measurement_collector: clock"
    ]


def test_a_stall_ends_with_the_next_detection_and_a_slow_cell_gets_more_time(measuring):
    measuring.status(done=1)
    measuring.hands.pass_time(5.0)
    measuring.session.tick()
    measuring.status(done=2)
    measuring.session.tick()
    assert measuring.session.diagnosis().level == Level.OK
    measuring.hands.pass_time(14.9)
    measuring.session.tick()
    assert len(measuring.hands.lines(Level.WARN)) == 1
    measuring.hands.pass_time(0.1)
    measuring.session.tick()
    assert len(measuring.hands.lines(Level.WARN)) == 2


def test_a_foreign_command_ends_waiting_and_its_own_plan(desk, measuring):
    stamp = measuring.session._commanded_ns + 1
    foreign = Command(
        stamp, PLACE, "other", 0, PLAN.views[0], PLAN.artifact, run_id=str(stamp)
    )
    measuring.session.take_command(
        message("ViewCommand", from_model.command(foreign, "stage"))
    )
    assert measuring.session.machine.state is State.FOLLOWING
    with pytest.raises(
        InputError, match="cannot start while following recorded commands"
    ):
        measuring.session.begin()


@pytest.mark.parametrize("phase", Phase)
def test_an_abort_says_that_it_does_not_stop_the_run_of_another_sequencer(desk, phase):
    foreign = Command(
        START_NS, phase, "other", view=PLAN.views[0], artifact=PLAN.artifact
    )
    desk.session.take_command(
        message("ViewCommand", from_model.command(foreign, "stage"))
    )
    answer = desk.session.give_up()
    assert answer.startswith("idle")
    assert ("goes on: abort it there" in answer) == (phase in (PLACE, MEASURE))
    assert not desk.commands


def test_its_own_command_is_not_foreign(measuring):
    measuring.session.take_command(
        message("ViewCommand", measuring.hands.of("command")[0])
    )
    assert measuring.session.machine.state is State.MEASURING


@pytest.mark.parametrize("seconds, said", [(PATIENCE_S, 0), (PATIENCE_S + 0.1, 1)])
def test_a_companion_that_falls_silent_within_a_run_is_named_until_it_is_back(
    measuring, seconds, said
):
    measuring.hear("solver")
    measuring.hands.pass_time(seconds)
    for _ in range(2):
        measuring.session.tick()
    line = "no sign of life from solver for 3 s: it hangs or has ended"
    assert [text.startswith(line) for text in measuring.hands.lines(Level.WARN)] == [
        True
    ] * said
    assert measuring.session.diagnosis().message.startswith(line) is bool(said)
    measuring.hear("solver")
    measuring.session.tick()
    assert measuring.session.diagnosis().level == Level.OK
    measuring.session.give_up()
    measuring.hands.pass_time(60)
    measuring.session.tick()
    # no run, nobody is waited for
    assert len(measuring.hands.lines(Level.WARN)) == said


@pytest.mark.parametrize(
    ("later_ns", "run_id"),
    [(-1, None), (0, None), (-(10**18), ""), (1, ""), (1, "17"), (10**9, "no stamp")],
)
@pytest.mark.parametrize("phase", [PLACE, MEASURE, Phase.DONE, Phase.ABORT])
def test_a_forged_or_old_command_does_not_end_the_run_of_its_own_plan(
    measuring, later_ns, run_id, phase
):
    """`run_id` None: the stamp itself, as of a run that begins."""
    stamp = measuring.session._commanded_ns + later_ns
    placed = phase in (PLACE, MEASURE)
    foreign = Command(
        stamp,
        phase,
        "other",
        0,
        PLAN.views[0] if placed else None,
        PLAN.artifact if placed else None,
        run_id=str(stamp) if run_id is None else run_id,
    )
    published = len(measuring.hands.published)
    for _ in range(2):
        measuring.session.take_command(
            message("ViewCommand", from_model.command(foreign, "f"))
        )
    assert measuring.session.machine.state is State.MEASURING
    assert len(measuring.hands.published) == published
    assert measuring.hands.lines(Level.WARN) == [
        "another publisher sends view commands that begin no run later than this one: not "
        "followed; find who sends them"
    ]


def test_a_command_of_the_future_is_refused_by_an_idle_sequencer_too(desk):
    stamp = START_NS + 61 * 10**9
    foreign = Command(
        stamp, PLACE, "other", 0, PLAN.views[0], PLAN.artifact, run_id=str(stamp)
    )
    with pytest.raises(InputError, match="stamped in the future of this node's clock"):
        desk.session.take_command(
            message("ViewCommand", from_model.command(foreign, "f"))
        )
    assert desk.session.machine.state is State.IDLE


def test_a_run_that_begins_after_the_clock_was_set_back_has_the_time_of_the_clock(desk):
    desk.hands.seconds += 86400
    desk.session.begin()
    ahead = desk.session.run_id
    desk.session.give_up()
    desk.hands.seconds -= 86400
    desk.session.begin()
    assert desk.session.run_id == str(START_NS)
    assert int(ahead) == START_NS + 86400 * 10**9
