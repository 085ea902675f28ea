# SPDX-License-Identifier: Apache-2.0
"""A clock that steps is named with its amount and place; what only looks like it is not."""

import numpy as np
import pytest

from selfcal_ros.collection.clock_steps import (
    MOST_ALIKE,
    ClockStep,
    StepWatch,
    step_lines,
)
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.collection.timeline import build_timeline
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

MS, S = 1_000_000, 1_000_000_000
TRUE = 1_700_000_000 * S + np.arange(3000) * 5 * MS
"""Instants of a stream of 200 messages a second."""


def found(stamps, received, limit_s=0.1, pieces=1):
    watch = StepWatch(limit_s)
    parts = zip(
        np.array_split(stamps, pieces), np.array_split(received, pieces), strict=True
    )
    return [step for part in parts for step in watch.add(*part)]


def stepped(at, by_ns):
    stamps = TRUE.copy()
    stamps[at:] += by_ns
    return stamps


@pytest.mark.parametrize("pieces", [1, 7, 600])
@pytest.mark.parametrize("by_ns", [-37 * S, -S, -200 * MS, 200 * MS, S, 37 * S])
@pytest.mark.parametrize("at", [100, 1502, 2980])
def test_a_step_is_found_with_its_amount_and_place(at, by_ns, pieces):
    delay = np.random.default_rng(at).exponential(10 * MS, len(TRUE)).astype(int)
    (step,) = found(stepped(at, by_ns), TRUE + delay, pieces=pieces)
    assert [step] == found(stepped(at, by_ns), TRUE + delay)
    assert abs(step.by_ns - by_ns) < 30 * MS
    assert 0 < TRUE[at] - step.before_ns <= 11 * 5 * MS


@pytest.mark.parametrize("by_ns", [-S, 200 * MS])
def test_steps_are_found_in_messages_that_come_one_by_one(by_ns):
    stamps = stepped(1502, by_ns)
    stamps[2200:] += 3 * S
    delay = np.random.default_rng(1).exponential(10 * MS, len(TRUE)).astype(int)
    steps = found(stamps, TRUE + delay, pieces=len(TRUE))
    for step, by, at in zip(steps, (by_ns, 3 * S), (1502, 2200), strict=True):
        assert abs(step.by_ns - by) < 30 * MS
        assert 0 < stamps[at - 1] + 5 * MS - step.before_ns <= 11 * 5 * MS


@pytest.mark.parametrize(
    "by_ns, number", [(101 * MS, 1), (99 * MS, 0), (-101 * MS, 1), (-99 * MS, 0)]
)
def test_the_limit(by_ns, number):
    assert len(found(stepped(1500, by_ns), TRUE)) == number


@pytest.mark.parametrize("at", [5, 30, 54])
@pytest.mark.parametrize(
    ("period_ns", "by_ns"),
    [
        (S // 10, -5 * S),
        (S // 10, -S // 2),
        (S // 10, S // 2),
        (S, -2 * S),
        (2 * S, -5 * S),
        (2 * S, S // 2),
        (2 * S, 5 * S),
    ],
)
def test_a_step_is_found_in_images_of_many_marks(period_ns, at, by_ns):
    """Sixty images of 25 marks each, which share a stamp; back by more than their period."""
    exposed = TRUE[0] + np.arange(60) * period_ns
    stamps = exposed + np.where(np.arange(60) >= at, by_ns, 0)
    late = np.random.default_rng(at).uniform(10 * MS, 30 * MS, 60).astype(int)
    (step,) = found(np.repeat(stamps, 25), np.repeat(exposed + late, 25))
    assert abs(step.by_ns - by_ns) < 30 * MS


@pytest.mark.parametrize("by_ns", [-S, -5 * S])
@pytest.mark.parametrize("bundle", [100, 300, 1000])
def test_a_step_back_beside_messages_that_come_at_once_is_found(by_ns, bundle):
    """They are not sent again: no stamp was seen before."""
    received = TRUE + MS
    received[1500 : 1500 + bundle] = received[1500 + bundle]
    assert found(stepped(1500, by_ns + MS), received)


@pytest.mark.parametrize("pieces", [1, 7, 600])
@pytest.mark.parametrize(("ago", "number"), [(5_000, 0), (15_000, 2)])
def test_what_is_sent_again_is_known_alike_in_any_pieces(ago, number, pieces):
    """Live as from the file; what is older than the last messages is not known again."""
    stamps = TRUE[0] + np.arange(20_000) * 5 * MS
    again = stamps[-ago:][:60]
    sent = np.r_[stamps, again, stamps[-1] + 5 * MS * np.arange(1, 61)]
    received = np.r_[stamps + MS, np.full(60, stamps[-1] + 2 * MS), sent[-60:] + MS]
    assert len(found(sent, received, pieces=pieces)) == number


@pytest.mark.parametrize("received", [0, TRUE[0]])
def test_a_reception_that_stands_still_tells_of_no_step(received):
    """A pause between two views is none."""
    stamps = stepped(1500, 4 * S)
    assert found(stamps, np.full_like(stamps, received)) == []


def test_two_steps_are_two():
    stamps = stepped(1000, S)
    stamps[2000:] -= 3 * S
    assert [step.by_ns for step in found(stamps, TRUE)] == [S, -3 * S]


def test_where_the_clock_of_reception_steps_back_too_it_is_found_by_the_order():
    stamps = stepped(1500, -2 * S)
    (step,) = found(stamps, stamps + MS)
    assert -2 * S <= step.by_ns < -1.9 * S
    assert 0 < TRUE[1500] - step.before_ns <= 11 * 5 * MS


def bundles():
    """Messages that are delivered together, up to 2 s late."""
    return TRUE, np.maximum(TRUE, TRUE[0] + ((TRUE - TRUE[0]) // (2 * S) + 1) * 2 * S)


def hole():
    """Two seconds of messages are lost."""
    kept = np.r_[TRUE[:1000], TRUE[1400:]]
    return kept, kept + MS


def stall():
    """Reception stalls for 3 s and then takes what waits at a tenth of the time."""
    late = TRUE[1000] + 3 * S + np.arange(700) * MS // 2
    return TRUE, np.maximum(TRUE, np.r_[TRUE[:1000], late, TRUE[1700:]])


def transport():
    """The way becomes longer by 1 s for good."""
    return TRUE, TRUE + MS + np.where(np.arange(len(TRUE)) >= 1000, S, 0)


def shuffled():
    """A file in any order, logged at its stamps."""
    order = np.random.default_rng(1).permutation(len(TRUE))
    return TRUE[order], TRUE[order] + MS


def mixed():
    """Messages that arrive in any order."""
    return np.random.default_rng(1).permutation(TRUE), TRUE


def late_then_dropped(late_s=0.425, start=400, stop=1000):
    """Messages wait 0.425 s in a queue, which is then emptied: those that wait are lost."""
    lost = round(late_s * 200)
    kept = np.r_[TRUE[:stop], TRUE[stop + lost :]]
    delay = np.where(
        (np.arange(len(kept)) >= start) & (np.arange(len(kept)) < stop),
        round(late_s * S),
        MS,
    )
    return kept, kept + delay


def late_for_long():
    """The same for 10 s; then a second time."""
    stamps, received = late_then_dropped(stop=2400)
    again = np.where(np.arange(len(stamps)) >= 2600, 425 * MS, 0)
    kept = np.r_[:2700, 2785 : len(stamps)]
    again[2700:] = 0
    return stamps[kept], (received + again)[kept]


def faster():
    """A recording that is played at eight times its speed."""
    return TRUE, TRUE[0] + (TRUE - TRUE[0]) // 8


def sent_again(number=60):
    """A connection is lost for a second; then the last messages are sent once more, at once."""
    again = slice(1000 - number, 1000)
    return (
        np.concatenate([TRUE[:1000], TRUE[again], TRUE[1000:]]),
        np.concatenate(
            [TRUE[:1000], TRUE[999] + S + np.arange(number), TRUE[1000:] + 2 * S]
        ),
    )


def backlog():
    """A detector that begins 0.18 s late and falls behind by 2 s rests for 3 s, and is warm."""
    number = np.arange(len(TRUE))
    stamps = TRUE + np.where(number >= 1000, 3 * S, 0)
    late = np.where(number < 1000, 180 * MS + number * 2 * MS, 100 * MS)
    return stamps, stamps + late


def cold():
    """Images of 25 marks every 2 s; the detector takes a second for the first one."""
    stamps = np.repeat(TRUE[0] + np.arange(60) * 2 * S, 25)
    return stamps, stamps + np.where(np.arange(len(stamps)) < 25, S, 20 * MS)


@pytest.mark.parametrize("marks", [1, 9, 100])
@pytest.mark.parametrize("workers", [1, 2, 4])
def test_images_that_take_a_detector_longer_or_shorter_show_no_step(workers, marks):
    """One a second, each given to the worker that is free first: they come out of order."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        takes_s = 0.3 * np.exp(0.6 * rng.standard_normal(120))
        exposed_s, free_s = np.arange(120.0), np.zeros(workers)
        found_s = np.empty(120)
        for image in range(120):
            worker = free_s.argmin()
            free_s[worker] = max(exposed_s[image], free_s[worker]) + takes_s[image]
            found_s[image] = free_s[worker]
        order = np.argsort(found_s)
        stamps, received = (
            TRUE[0] + (np.repeat(at_s[order], marks) * S).astype(int)
            for at_s in (exposed_s, found_s)
        )
        assert found(stamps, received) == []


def test_a_stamp_that_never_changes_shows_no_step_and_takes_no_memory():
    watch = StepWatch(0.1)
    for at in range(0, 20_000, 100):
        same = np.full(100, TRUE[0])
        assert watch.add(same, same + (at + np.arange(100)) * MS) == []
    assert watch._rest.shape[1] <= MOST_ALIKE


@pytest.mark.parametrize("phase", range(5))
@pytest.mark.parametrize("shortest_s", [0.0, 0.02])
def test_delays_that_change_and_scatter_are_no_step(phase, shortest_s):
    """Up to 0.3 s for 40 messages, up to 0.02 s for 40: what is late comes out of order."""
    rng, number = np.random.default_rng(phase), np.arange(len(TRUE))
    late_s = shortest_s + rng.uniform(
        0, np.where((number + phase) // 40 % 2, 0.3, 0.02)
    )
    received = TRUE + (late_s * S).astype(int)
    order = np.argsort(received)
    assert found(TRUE[order], received[order]) == []


@pytest.mark.parametrize(
    "case",
    [
        bundles,
        hole,
        stall,
        transport,
        shuffled,
        mixed,
        faster,
        sent_again,
        backlog,
        cold,
        late_then_dropped,
        late_for_long,
    ],
    ids=lambda case: case.__name__,
)
def test_what_only_looks_like_a_step_is_none(case):
    assert found(*case()) == []
    assert found(*case(), pieces=500) == []


def timeline():
    plate, view = Artifact(5, 0.01, 8), View("identity")
    return build_timeline(
        [
            Command(TRUE[0], Phase.PLACE, "plan", 0, view, plate),
            Command(TRUE[1000], Phase.MEASURE, "plan", 0, view, plate),
            Command(TRUE[2000], Phase.DONE, "plan", 1, None, None),
        ]
    )


@pytest.mark.parametrize(
    "at, by_ns, words",
    [
        (
            1500,
            -S,
            "stepped back by 1 s in view 'identity', at 1700000007.500 s: what was stamped "
            "since may be missing or counted in an earlier view; let clocks slew, not step,",
        ),
        (
            500,
            37 * S,
            "stepped ahead by 37 s between views, at 1700000002.500 s: what was stamped "
            "since may be missing or counted in a later view (unless messages were that late "
            "until then, and nothing is wrong);",
        ),
    ],
)
def test_the_line_says_whose_clock_how_much_and_where(at, by_ns, words):
    step = ClockStep(int(TRUE[at]), by_ns)
    later = ClockStep(step.before_ns + MS, by_ns + MS)
    (line,) = step_lines({"b": [step], "a": [later]}, timeline())
    assert line.startswith(f"the clock that stamps a and b {words}")


def test_steps_of_two_clocks_are_two_lines():
    ahead, back = (ClockStep(int(TRUE[9]), by_ns) for by_ns in (S, -S))
    lines = step_lines({"a": [ahead], "b": [back]}, timeline())
    assert [line.split(" by ")[0] for line in lines] == [
        "the clock that stamps a stepped ahead",
        "the clock that stamps b stepped back",
    ]
    assert step_lines({"a": []}, timeline()) == []


def test_a_step_ahead_while_messages_are_late_is_still_found():
    stamps, received = late_then_dropped()
    stamps[700:] += S
    steps = found(stamps, received)
    assert [step.by_ns for step in steps] == [S]


def test_a_step_ahead_after_one_back_is_found_though_stamps_were_nearer_before():
    stamps = stepped(1000, -3 * S)
    stamps[2000:] += S
    assert [step.by_ns for step in found(stamps, TRUE)] == [-3 * S, S]


def test_a_clock_that_runs_away_slowly_hides_no_later_step():
    """Behind by 500 us each second for 1,000 s: what was nearest at the begin tells no more."""
    true = TRUE[0] + np.arange(20_000) * 50 * MS
    stamps = true - (true - true[0]) // 2000
    stamps[19_000:] += 200 * MS
    assert [round(step.by_ns / MS, -1) for step in found(stamps, true)] == [200]


def test_a_quick_stream_that_overlaps_a_slow_one_is_no_step():
    """Both clocks seem to go back by 10 s, less than a few messages of the slow stream take."""
    slow = TRUE[0] + np.arange(300) * S
    both = np.concatenate([slow, slow[-1] - 10 * S + np.arange(300) * 5 * MS])
    assert found(both, both) == []
    (step,) = found(
        np.concatenate([TRUE[:300], TRUE[:300] - 10 * S]),
        np.concatenate([TRUE[:300], TRUE[:300] - 10 * S]),
    )
    assert abs(step.by_ns + 11.5 * S) < 60 * MS
