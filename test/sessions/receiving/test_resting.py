# SPDX-License-Identifier: Apache-2.0
"""The journal of an encoder at rest: a sample a second, and all around what is measured."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.digest import readings_digest
from selfcal_ros.collection.messages import Command, Detection, EncoderSample, Phase
from selfcal_ros.messages.topics import ENCODER_TOPIC
from selfcal_ros.sessions.receiving.resting import REACH_NS, Resting
from test.sessions.receiving.test_reception import Desk, desk_path
from test.support.ports import settings_of
from test.support.sessions import cdr_of, events_of, small_plan

STEP_NS = 100_000_000
NEAR = REACH_NS // STEP_NS


def times(samples):
    return [received_ns // STEP_NS for _, received_ns in samples]


def run(resting, first, last, *, measuring=False):
    """Return which of the samples from `first` to before `last`, ten a second, are kept."""
    return [time for number in range(first, last) for time in times(
        resting.sample(b"", number * STEP_NS, measuring=measuring))]


def test_at_rest_one_sample_a_second_is_kept_once_it_is_of_no_more_use():
    assert run(Resting(), 0, 200) == [*range(0, 200 - NEAR - 1, 10)]


def test_all_is_kept_around_a_command_or_a_detection():
    resting = Resting()
    before = run(resting, 0, 305)
    assert before[-1] == 200
    assert times(resting.wake(304 * STEP_NS + 1)) == [*range(205 - 1, 305)]
    assert times(resting.wake(304 * STEP_NS + 1)) == []
    after = run(resting, 305, 700)
    assert after[:NEAR] == [*range(305, 305 + NEAR)]
    assert set(np.diff(after[NEAR:])) == {10}
    assert after[-1] <= 699 - NEAR


def test_all_is_kept_while_a_view_is_measured():
    resting = Resting()
    run(resting, 0, 120)
    assert run(resting, 120, 5000, measuring=True) == [*range(20 - 1, 5000)]
    assert run(resting, 5000, 5000 + NEAR) == []


def test_a_clock_that_was_set_back_stops_nothing():
    resting = Resting()
    run(resting, 10_000, 10_400)
    assert len(resting._held) == NEAR + 1
    kept = run(resting, 100, 500)
    assert kept[:11] == [*range(10_300, 10_400, 10), 100]
    assert [*np.diff(kept[10:])] == [10] * 29
    assert len(resting._held) == NEAR + 1


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


def live(desk, events, idle_s):
    """Receive events in their time, with rests between them.

    There is one of `idle_s` before each MEASURE and behind the end; the encoder goes on in it, ten
    samples a second.
    """
    late_ns, last = 0, events[0].stamp_ns
    at_rest = next(event for event in events if isinstance(event, EncoderSample))
    for event in [*events, None]:
        if event is None or getattr(event, "phase", None) == Phase.MEASURE:
            for number in range(idle_s * 10):
                late_ns += STEP_NS
                desk.reception.encoder(cdr_of(replace(at_rest, stamp_ns=last + late_ns)),
                                       last + late_ns)
                if number % 10 == 9:
                    desk.reception.drain()
        if event is not None:
            last = event.stamp_ns
            moved = replace(event, stamp_ns=last + late_ns)
            take = (partial(desk.reception.command, is_older=False) if isinstance(event, Command)
                    else desk.reception.detection if isinstance(event, Detection)
                    else desk.reception.encoder)
            take(cdr_of(moved), received_ns=last + late_ns)
    desk.reception.drain()


def test_a_journal_with_rests_gives_what_the_session_gave(tmp_path, events):
    desk = Desk(tmp_path)
    live(desk, events, idle_s=60)
    measurements, progress = desk.session.collector.collect()
    expected = {index: readings_digest(item.readings, measurements.rejected)
                for index, item in progress.items()}
    assert all(view.complete for view in progress.values())
    desk.reception.close()
    offline = collect_bag(desk_path(tmp_path), settings_of("measurement_collector"))
    assert {index: readings_digest(item.readings, offline.measurements.rejected)
            for index, item in offline.views.items()} == expected
    kept = sum(len(item) for topic, item in BagReader(desk_path(tmp_path)).columns()
               if topic == ENCODER_TOPIC)
    samples = sum(isinstance(event, EncoderSample) for event in events)
    rests = 1 + sum(getattr(event, "phase", None) == Phase.MEASURE for event in events)
    # of each rest 10 s at both ends and a sample a second
    assert abs(kept - samples - rests * (2 * NEAR + 40)) < 5 * rests
    assert desk.session.collector.received["encoder"] == samples + rests * 600


def test_a_run_that_is_taken_up_is_kept_whole_before_a_command_comes_again(tmp_path, events):
    cut = next(number for number, event in enumerate(events) if isinstance(event, Detection))
    first = Desk(tmp_path)
    live(first, events[:cut], idle_s=0)
    first.keeper.close()
    second = Desk(tmp_path)
    rest = events[cut:cut + 20]
    for event in rest:
        take = second.reception.detection if isinstance(event, Detection) else (
            second.reception.encoder)
        take(cdr_of(event), event.stamp_ns + 100 * REACH_NS)
        second.reception.drain()
    second.reception.close()
    assert sum(len(item) if hasattr(item, "__len__") else 1 for _, item in BagReader(
        desk_path(tmp_path)).columns()) == cut + len(rest)


def test_nothing_is_held_back_where_no_journal_is_kept(events):
    desk = Desk()
    live(desk, events[:9], idle_s=20)
    assert not desk.reception._resting._held
