# SPDX-License-Identifier: Apache-2.0
"""Health put together: levels, refusals and losses without a flood, presence, rates."""

import math

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.nodes.sessions.health import (
    MOST_STEPS,
    Diagnosis,
    Level,
    Losses,
    Presence,
    Rate,
    Refusals,
    merged,
)
from test.support.ports import Hands


@pytest.fixture
def hands():
    return Hands()


def test_the_worst_comes_first_and_nothing_twice():
    assert merged(
        Diagnosis(Level.OK, "main", {"a": 1}),
        [
            Diagnosis(Level.OK, "fine", {"b": 2}),
            Diagnosis(Level.ERROR, "bad"),
            Diagnosis(Level.WARN, "main"),
        ],
    ) == Diagnosis(Level.ERROR, "bad; main", {"a": 1, "b": 2})


def test_a_flood_of_refusals_is_counted_and_logged_at_powers_of_ten(hands):
    refusals = Refusals(hands.ports.say, hands.ports.now_s)
    for _ in range(1234):
        refusals.add("topic", InputError("topic", "bad", "correct it"))
    assert hands.lines(Level.ERROR) == ["topic: bad; correct it"] + [
        f"topic: bad; correct it (refused {n} times)"
        for n in (2, 3, 4, 5, 10, 100, 1000)
    ]
    assert refusals.diagnosis() == Diagnosis(
        Level.WARN, "topic: bad; correct it", {"refused topic": 1234}
    )


@pytest.mark.parametrize("seconds, level", [(9.9, Level.WARN), (10.0, Level.OK)])
def test_a_refusal_and_a_loss_are_warnings_for_a_while(hands, seconds, level):
    refusals = Refusals(hands.ports.say, hands.ports.now_s)
    losses = Losses(hands.ports.say, hands.ports.now_s)
    refusals.add("topic", ZeroDivisionError("\x1b[2Jdivision"))
    losses.add("topic", 3)
    losses.add("topic", 4)
    assert hands.lines(Level.ERROR) == [
        "topic: cannot be used (ZeroDivisionError: \\x1b[2Jdivision)"
    ]
    assert len(hands.lines(Level.WARN)) == 1
    hands.pass_time(seconds)
    assert refusals.diagnosis().level == losses.diagnosis().level == level
    assert losses.diagnosis().values == {"lost topic": 7}
    assert (losses.diagnosis().message == "topic: 7 messages lost") is (
        level == Level.WARN
    )


@pytest.mark.parametrize(
    "told",
    [
        [(5, "events"), (5, "numbers")],
        [(5, "numbers"), (5, "events")],
        [(2, "numbers"), (5, "events"), (3, "numbers")],
    ],
)
def test_what_two_sources_tell_of_one_loss_counts_once(hands, told):
    losses = Losses(hands.ports.say, hands.ports.now_s)
    for number, source in told:
        losses.add("topic", number, told_by=source)
    assert losses.counts == {"topic": 5}
    assert losses.diagnosis().message == "topic: 5 messages lost"
    losses.add("topic", 8, told_by="numbers")
    losses.add("other", 1)
    assert losses.counts == {"topic": 13, "other": 1}
    assert [line.partition(" messages")[0] for line in hands.lines(Level.WARN)] == [
        f"topic: {told[0][0]}",
        "other: 1",
    ]


def test_a_loss_that_the_other_source_reports_later_is_no_new_one(hands):
    losses = Losses(hands.ports.say, hands.ports.now_s)
    losses.add("topic", 5)
    hands.pass_time(1000.0)
    losses.add("topic", 5, told_by="numbers")
    assert len(hands.lines(Level.WARN)) == 1
    assert losses.diagnosis().level == Level.OK


def test_what_was_published_while_nobody_listened_is_told_apart(hands):
    losses = Losses(hands.ports.say, hands.ports.now_s)
    losses.add("topic", 2)
    losses.add_unheard("topic", 7)
    losses.add_unheard("topic", 4)
    assert losses.diagnosis().values == {
        "lost topic": 2,
        "lost topic, not listening": 11,
    }
    assert hands.lines(Level.WARN)[1:] == [
        "topic: 7 messages were published while this node was not listening"
    ]


@pytest.mark.parametrize("seconds, there", [(3.0, True), (3.1, False)])
def test_presence(hands, seconds, there):
    presence = Presence(hands.ports.now_s, 3.0)
    told = Diagnosis(Level.OK, "here")
    presence.take("node", told)
    hands.pass_time(seconds)
    assert presence.of("node") == (told if there else None)
    assert presence.of("other") is None


def test_the_rate_is_of_the_last_seconds_and_the_gap_since_it_was_asked(hands):
    rate = Rate(hands.ports.now_s)
    for index in range(400):
        hands.pass_time(0.01)
        rate.add(np.array([10_000_000 * (index + 1 + 30 * (index > 200))]))
    assert rate.per_second == pytest.approx(100, rel=0.06)
    assert rate.take_gap_ns() == 310_000_000
    assert rate.take_gap_ns() == 0
    hands.pass_time(5)
    assert rate.per_second == 0


@pytest.mark.parametrize("ahead_ns", [37_000_000_000, 10**18])
def test_a_stamp_of_the_future_does_not_hide_later_gaps(hands, ahead_ns):
    rate = Rate(hands.ports.now_s)
    for index in range(300):
        hands.pass_time(0.01)
        rate.add(np.array([10_000_000 * index + ahead_ns * (index == 50)]))
    rate.take_gap_ns()
    hands.pass_time(9.0)
    rate.add(np.array([10_000_000 * 299 + 9_000_000_000]))
    assert rate.take_gap_ns() == 9_000_000_000


@pytest.mark.parametrize(
    "stamps, gap",
    [
        ([5], 0),
        ([5, 9, 20], 11),
        ([20, 5, 9], 0),
        ([5, 20, 9, 26], 15),
        ([9, 5, 12], 3),
    ],
)
def test_a_gap_lies_between_a_stamp_and_the_newest_before(hands, stamps, gap):
    together, single = Rate(hands.ports.now_s), Rate(hands.ports.now_s)
    together.add(np.array(stamps))
    for stamp in stamps:
        single.add(np.array([stamp]))
    assert together.take_gap_ns() == single.take_gap_ns() == gap
    hands.pass_time(0.05)
    together.add(np.array([30]))
    assert together.take_gap_ns() == 30 - max(stamps)
    assert together.per_second == (len(stamps) + 1) / Rate.WINDOW_S


def test_the_jitter_is_that_of_most_intervals_since_it_was_asked(hands):
    rate = Rate(hands.ports.now_s)
    steps = np.tile([900_000, 1_000_000, 1_100_000], 40)
    steps[50] = 10**9  # a gap is none
    rate.add(np.cumsum(steps))
    assert rate.take_jitter_s() == pytest.approx(1e-4)
    assert math.isnan(rate.take_jitter_s())
    rate.add(np.cumsum(steps)[-1] + 1_000_000 * np.arange(1, 41))
    assert rate.take_jitter_s() == 0


def test_intervals_beyond_a_number_are_not_kept_until_the_jitter_is_asked(hands):
    rate = Rate(hands.ports.now_s)
    rate.add(1_000_000 * np.arange(MOST_STEPS + 1))
    rough = np.cumsum(np.tile([900_000, 1_100_000], 1000))  # a tenth of all
    rate.add(MOST_STEPS * 1_000_000 + rough)
    assert rate.take_jitter_s() == 0
    rate.add((MOST_STEPS + 2000) * 1_000_000 + rough)
    assert rate.take_jitter_s() == pytest.approx(1e-4)


@pytest.mark.parametrize("number, is_told", [(39, False), (40, True)])
def test_few_intervals_tell_no_jitter(hands, number, is_told):
    rate = Rate(hands.ports.now_s)
    for stamp in range(number + 1):
        rate.add(np.array([stamp * 1000]))
    assert math.isfinite(rate.take_jitter_s()) is is_told
