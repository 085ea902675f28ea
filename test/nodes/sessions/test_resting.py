# SPDX-License-Identifier: Apache-2.0
"""The journal of an encoder at rest: a burst a minute, and all around what is measured."""

from dataclasses import replace

import pytest

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.model.readings import readings_digest
from selfcal_ros.nodes.sessions.reception import REACH_NS, Resting
from selfcal_ros.topics import ENCODER_TOPIC
from selfcal_ros.units import S_PER_NS
from test.nodes.sessions.test_reception import Desk, desk_path
from test.support.ports import START_NS, settings_of
from test.support.sessions import cdr_of, events_of, small_plan

STEP_NS = 100_000_000
NEAR = REACH_NS // STEP_NS


def times(samples):
    return [received_ns // STEP_NS for _, received_ns in samples]


def run(resting, first, last, *, measuring=False):
    """Return which of the samples from `first` to before `last`, ten a second, are kept."""
    return [
        time
        for number in range(first, last)
        for time in times(resting.sample(b"", number * STEP_NS, measuring=measuring))
    ]


def bursts(*begins):
    return [time for begin in begins for time in range(begin, begin + 50)]


def test_at_rest_a_burst_a_minute_is_kept_once_it_is_of_no_more_use():
    assert run(Resting(), 0, 2000) == bursts(0, 600, 1200)
    assert run(Resting(), 0, NEAR + 1) == []
    assert run(Resting(), 0, NEAR + 2) == [0]


def test_all_is_kept_around_a_command_or_a_detection():
    resting = Resting()
    assert run(resting, 0, 1400) == bursts(0, 600)
    assert times(resting.wake(1399 * STEP_NS + 1)) == [*range(1399 - NEAR, 1400)]
    assert times(resting.wake(1399 * STEP_NS + 1)) == []
    after = run(resting, 1400, 4000)
    assert after == [
        *range(1400, 1400 + NEAR),
        *bursts(*range(1400 + NEAR, 4000 - NEAR, 600)),
    ]


def test_all_is_kept_while_a_view_is_measured():
    resting = Resting()
    run(resting, 0, 1000)
    assert run(resting, 1000, 9000, measuring=True) == [*range(1000 - NEAR - 1, 9000)]
    assert run(resting, 9000, 9000 + NEAR) == []


def test_a_clock_that_was_set_back_stops_nothing():
    resting = Resting()
    run(resting, 10_000, 11_000)
    assert len(resting._held) == NEAR + 1
    kept = run(resting, 100, 2100)
    assert kept[kept.index(100) :] == bursts(100, 700, 1300)
    assert len(resting._held) == NEAR + 1


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


def live(desk, events, idle_s):
    """Receive events in their time, with rests between them.

    There is one of `idle_s` before each MEASURE and behind the end; the encoder goes on in it, ten
    samples a second. Half a minute before its end the stage moves to the first mark of the view,
    and stays there until it has been exposed.
    """
    late_ns, last, there, exposed_ns = 0, events[0].stamp_ns, None, 0
    for number, event in enumerate([*events, None]):
        if event is None or getattr(event, "phase", None) == Phase.MEASURE:
            there, exposed_ns = first_exposure(events[number:]) or (there, 0)
            away = tuple(p + 1e-3 for p in there.positions)
            for step in range(idle_s * 10):
                late_ns += STEP_NS
                desk.hands.seconds = 100.0 + (last + late_ns - START_NS) * S_PER_NS
                where = there.positions if step > (idle_s - 30) * 10 else away
                sample = replace(there, stamp_ns=last + late_ns, positions=where)
                desk.reception.encoder(cdr_of(sample), last + late_ns)
                if step % 10 == 9:
                    desk.reception.drain()
        if event is None:
            break
        last = event.stamp_ns
        moved = replace(event, stamp_ns=last + late_ns)
        if isinstance(event, Command):
            desk.reception.command(cdr_of(moved), False, last + late_ns)
        elif isinstance(event, Detection):
            desk.reception.detection(cdr_of(moved), last + late_ns)
        else:
            if last <= exposed_ns:
                moved = replace(moved, positions=there.positions)
            desk.reception.encoder(cdr_of(moved), last + late_ns)
    desk.reception.drain()


def first_exposure(events):
    """Return the first sample behind the first exposure, and the stamp of that; None without."""
    first = next(
        (event.stamp_ns for event in events if isinstance(event, Detection)), None
    )
    return first and (
        next(
            event
            for event in events
            if isinstance(event, EncoderSample) and event.stamp_ns > first
        ),
        first,
    )


def test_a_journal_with_rests_gives_what_the_session_gave(tmp_path, events):
    # at rest the encoder is heard as well
    gap = {"max_encoder_gap": 1.5 * STEP_NS * S_PER_NS}
    desk = Desk(tmp_path, **gap)
    live(desk, events, idle_s=300)
    measurements, progress = desk.session.collector.collect()
    expected = {
        index: readings_digest(item.readings, measurements.rejected)
        for index, item in progress.items()
    }
    assert all(view.complete for view in progress.values())
    desk.reception.close()
    offline = collect_bag(
        desk_path(tmp_path), settings_of("measurement_collector", **gap)
    )
    assert {
        index: readings_digest(item.readings, offline.measurements.rejected)
        for index, item in offline.views.items()
    } == expected
    kept = sum(
        len(item)
        for topic, item in BagReader(desk_path(tmp_path)).columns()
        if topic == ENCODER_TOPIC
    )
    samples = sum(isinstance(event, EncoderSample) for event in events)
    rests = 1 + sum(getattr(event, "phase", None) == Phase.MEASURE for event in events)
    # of each rest the two ends, and three bursts between them
    assert abs(kept - samples - rests * (2 * NEAR + 3 * 50)) < 5 * rests
    assert desk.session.collector.received["encoder"] == samples + rests * 3000


def count(path):
    return sum(
        len(item) if hasattr(item, "__len__") else 1
        for _, item in BagReader(path).columns()
    )


def test_a_run_that_is_taken_up_is_kept_whole_before_a_command_comes_again(
    tmp_path, events
):
    cut = next(
        number for number, event in enumerate(events) if isinstance(event, Detection)
    )
    first = Desk(tmp_path).receive(events[:cut])
    first.reception.drain()
    first.keeper.close()
    second = Desk(tmp_path)
    samples = [event for event in events[cut:] if isinstance(event, EncoderSample)][:20]
    for sample in samples:
        second.reception.encoder(cdr_of(sample), sample.stamp_ns + 100 * REACH_NS)
        second.reception.drain()
    assert count(desk_path(tmp_path)) == cut + len(samples)


def test_what_is_held_back_is_written_when_the_collector_ends(tmp_path, events):
    desk = Desk(tmp_path)
    for sample in [event for event in events if isinstance(event, EncoderSample)][:20]:
        desk.reception.encoder(cdr_of(sample), sample.stamp_ns)
    desk.reception.drain()
    assert count(desk_path(tmp_path)) == 0
    desk.reception.close()
    assert count(desk_path(tmp_path)) == 20


def test_nothing_is_held_back_where_no_journal_is_kept(events):
    desk = Desk()
    for sample in [event for event in events if isinstance(event, EncoderSample)][:20]:
        desk.reception.encoder(cdr_of(sample), sample.stamp_ns)
    desk.reception.drain()
    assert not desk.reception._resting.end()
    assert desk.session.collector.received["encoder"] == 20
