# SPDX-License-Identifier: Apache-2.0
"""Bags with messages stamped in the future of their logging: as a live collector refuses them."""

from collections import Counter
from dataclasses import replace

import pytest

from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.offline import Playlist, collect_bag
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.journal_keeper import JournalKeeper
from selfcal_ros.nodes.sessions.reception import Reception
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
)
from test.support.ports import START_NS, Hands, settings_of
from test.support.sessions import cdr_of, events_of, small_plan

DAY_NS = 86400 * 10**9
SETTINGS = settings_of("measurement_collector")
LINE = (
    f"{COMMAND_TOPIC}, {ENCODER_TOPIC}, {DETECTION_TOPIC}: what was stamped more than 60 s "
    "ahead of its reception was not used; set the clock that stamps it"
)


def run_of(seed, begin_ns):
    """Return the events of a run that begins then and names itself."""
    events = events_of(small_plan(), seed)
    by = begin_ns - events[0].stamp_ns
    return [
        replace(
            event,
            stamp_ns=event.stamp_ns + by,
            **({"run_id": str(begin_ns)} if isinstance(event, Command) else {}),
        )
        for event in events
    ]


AHEAD, HONEST = run_of(5, START_NS + DAY_NS), run_of(6, START_NS)


def recorded(folder, events, received_ns):
    """Return a bag of events that a recorder got, one a microsecond, from then on."""
    with BagWriter(folder / "bag") as writer:
        for topic, typename in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [])
        for number, event in enumerate(events):
            topic, fields = event_fields(event, "stage")
            writer.write(
                f"/{topic}", fields, received_ns and received_ns + 1000 * number
            )
    return folder / "bag"


def live(events):
    """Return a session that has received events five seconds after START_NS, and its hands."""
    hands = Hands()
    hands.pass_time(5.0)
    session = CollectingSession(SETTINGS, hands.ports)
    reception = Reception(
        session,
        JournalKeeper("", {}, SETTINGS, hands.ports),
        say=hands.ports.say,
        refuse=lambda place, error: None,
    )
    for event in events:
        if isinstance(event, Command):
            reception.command(cdr_of(event), False)
        elif isinstance(event, Detection):
            reception.detection(cdr_of(event), 0)
        else:
            reception.encoder(cdr_of(event), 0)
    reception.drain()
    session.finish()
    return session, hands


@pytest.mark.parametrize(
    "events", [[*AHEAD, *HONEST], [*HONEST, *AHEAD]], ids=["first", "last"]
)
def test_a_bag_with_a_run_ahead_is_what_the_live_collector_made_of_it(tmp_path, events):
    session, hands = live(events)
    found = collect_bag(recorded(tmp_path, events, START_NS), SETTINGS)
    measurements, _ = session.collector.collect()
    assert found.measurements.run_id == measurements.run_id == str(START_NS)
    assert (
        found.measurements.rejected
        == measurements.rejected
        == session.collector.unusable
    )
    assert Counter(found.measurements.rejected) == Counter(
        {
            "command_from_the_future": sum(isinstance(e, Command) for e in AHEAD),
            "from_the_future": sum(isinstance(e, Detection) for e in AHEAD),
            "encoder_sample_from_the_future": sum(
                isinstance(e, EncoderSample) for e in AHEAD
            ),
        }
    )
    for view, other in zip(found.measurements.views, measurements.views, strict=True):
        assert view.dx.tolist() == other.dx.tolist()
    assert found.lost == found.findings == [LINE]
    assert hands.lines(Level.WARN) == [LINE]
    assert hands.of("measurement")[-1]["session_notes"] == [LINE]


@pytest.mark.parametrize(
    "late_s, refused", [(-60.1, True), (-59.9, False), (5.0, False)]
)
def test_how_far_ahead_of_its_logging_a_stamp_may_lie(tmp_path, late_s, refused):
    stray = replace(
        next(e for e in HONEST if isinstance(e, Detection)), stamp_ns=START_NS + DAY_NS
    )
    bag = recorded(tmp_path, HONEST, 0)
    with BagWriter(tmp_path / "other") as writer:
        writer.add_topic(f"/{DETECTION_TOPIC}", INPUT_TOPICS[DETECTION_TOPIC], [])
        writer.write(
            f"/{DETECTION_TOPIC}",
            event_fields(stray, "stage")[1],
            stray.stamp_ns + round(late_s * 1e9),
        )
    (tmp_path / "other" / "other_0.mcap").rename(bag / "bag_1.mcap")
    (bag / "metadata.yaml").unlink()
    rejected = collect_bag(bag, SETTINGS).measurements.all_rejected()
    assert rejected == {"from_the_future" if refused else "outside_every_view": 1}


@pytest.mark.parametrize(
    "received_ns, lines",
    [
        (
            START_NS,
            [
                f"{COMMAND_TOPIC}: stamped more than 60 s ahead of its log time: a live collector "
                "refuses it; set the clock that stamps, or the recorder's"
            ],
        ),
        (0, []),
    ],
)
def test_a_bag_whose_times_of_logging_are_of_another_clock_is_read_by_its_stamps(
    tmp_path, received_ns, lines
):
    found = collect_bag(recorded(tmp_path, AHEAD, received_ns), SETTINGS)
    assert found.measurements.run_id == str(START_NS + DAY_NS)
    assert found.measurements.all_rejected() == {}
    assert found.lost == lines


def test_what_is_ahead_is_not_played(tmp_path):
    playlist = Playlist(recorded(tmp_path, [*AHEAD, *HONEST], START_NS))
    assert len(playlist) == len([*playlist]) == len(HONEST)
    assert playlist.lost == [LINE]
