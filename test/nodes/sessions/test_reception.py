# SPDX-License-Identifier: Apache-2.0
"""Bytes on their way to the session: written first, decoded as a bag's, held back, refused."""

import errno
import os
import re
import struct
import time
from collections import Counter
from concurrent.futures import Future
from dataclasses import replace

import pytest

from selfcal_ros.bagio import journal, journal_file
from selfcal_ros.bagio.journal import resume
from selfcal_ros.bagio.messages import cdr
from selfcal_ros.bagio.messages.to_model import frame_id
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import readings_digest
from selfcal_ros.nodes.sessions import reception
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.journal_keeper import JournalKeeper, KeptTopic
from selfcal_ros.nodes.sessions.reception import Reception
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
)
from test.support.bags import Foreign
from test.support.ports import START_NS, Hands, settings_of
from test.support.sessions import cdr_of, collected, events_of, small_plan

QOS = {"reliability": "reliable"}
TOPICS = {topic: KeptTopic(f"/cell/{topic}", QOS) for topic in INPUT_TOPICS}


class Desk:
    """A reception with its session and journal, the hands around it, and what was refused."""

    def __init__(self, folder="", worker=None, **parameters):
        self.hands, self.refused = Hands(), Counter()
        settings = settings_of(
            "measurement_collector", journal=str(folder), **parameters
        )
        self.session = CollectingSession(settings, self.hands.ports)
        self.keeper = JournalKeeper(
            settings.journal, TOPICS, settings, self.hands.ports
        )
        self.reception = Reception(
            self.session,
            self.keeper,
            say=self.hands.ports.say,
            refuse=lambda place, error: self.refused.update([f"{place}: {error}"]),
        )
        self.reception.open(worker or AtOnce())

    def receive(self, events, *, is_older=False):
        for event in events:
            data = cdr_of(event)
            if isinstance(event, Command):
                self.reception.command(data, is_older)
            else:
                (
                    self.reception.detection
                    if isinstance(event, Detection)
                    else self.reception.encoder
                )(data, 0)
        return self

    def read(self):
        """Return a digest of each view, as the session has it now."""
        self.reception.drain()
        measurements, progress = self.session.collector.collect()
        return {
            index: readings_digest(item.readings, measurements.rejected)
            for index, item in progress.items()
        }


class AtOnce:
    """A worker that has done its work when it is asked."""

    def submit(self, work, *arguments):
        future = Future()
        try:
            future.set_result(work(*arguments))
        except InputError as error:
            future.set_exception(error)
        return future


class Later:
    """A worker that works when it is told to."""

    def submit(self, work, *arguments):
        self.future, self._work = Future(), lambda: work(*arguments)
        return self.future

    def finish(self):
        self.future.set_result(self._work())


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


@pytest.fixture(scope="module")
def expected(events):
    _, measurements, progress = collected(events)
    return {
        index: readings_digest(item.readings, measurements.rejected)
        for index, item in progress.items()
    }


def test_bytes_give_the_readings_of_the_messages(events, expected):
    desk = Desk().receive(events)
    assert desk.session.collector.received == {
        "encoder": 0,
        "detection": 0,
        "command": 0,
    }
    assert desk.read() == expected
    assert sum(desk.session.collector.received.values()) == len(events)
    assert not desk.refused


def test_messages_that_are_too_long_are_counted_with_the_reason(events, expected):
    desk = Desk()
    sample = next(event for event in events if isinstance(event, EncoderSample))
    wide = replace(sample, names=tuple(f"joint_{i}" for i in range(100_000)))
    for event in (wide, replace(wide, names=wide.names[:999])):
        desk.receive([event])
    desk.receive(events)
    assert desk.read() == expected
    assert desk.refused == {
        f"decoding: 2 messages on {ENCODER_TOPIC}: they are longer than 8192 "
        "bytes: cannot be decoded; correct their publisher": 1
    }


def test_what_cannot_be_decoded_is_counted_by_topic_and_the_rest_is_used(
    events, expected
):
    desk = Desk()
    for _ in range(2):
        desk.reception.encoder(b"\0\1\0\0\xff\xff", 0)
    desk.reception.detection(b"", 0)
    desk.reception.command(b"\0\1\0\0" + b"\xff" * 40, False)
    assert desk.receive(events).read() == expected
    assert desk.refused == {
        f"decoding: 1 messages on {COMMAND_TOPIC}; 2 messages on {ENCODER_TOPIC}; 1 "
        f"messages on {DETECTION_TOPIC}: cannot be "
        "decoded; correct their publisher": 1
    }


def test_a_command_that_cannot_be_used_is_refused_and_the_others_are_used(
    events, expected
):
    bad = Command(events[0].stamp_ns, Phase.ABORT, "plan", view_index=10_001)
    desk = Desk().receive([bad, *events])
    desk.read()
    [line] = desk.refused
    assert line.startswith(f"{COMMAND_TOPIC}: view command 10001: a plan has at most")
    assert desk.session.collector.unusable == {"command_unusable": 1}


def test_what_is_received_is_in_the_journal_before_it_is_used(
    tmp_path, events, expected
):
    desk = Desk(tmp_path)
    used = []
    collector = desk.session.collector
    collector.add_detection_block = lambda table: used.append(
        (
            len(table),
            desk.keeper.path.stat()
            and sum(
                file.read_bytes().count(cdr_of(found))
                for file in desk.keeper.path.glob("*.mcap")
            ),
        )
    )
    found = next(event for event in events if isinstance(event, Detection))
    desk.receive([found]).reception.drain()
    assert used == [(1, 1)]


def test_the_journal_is_a_bag_that_gives_what_the_session_gave(
    tmp_path, events, expected
):
    desk = Desk(tmp_path).receive(events)
    assert desk.read() == expected
    desk.reception.close()
    values = settings_of("measurement_collector")
    offline = collect_bag(desk_path(tmp_path), values)
    bag = collect_bag(Foreign().write(tmp_path / "x.mcap", events), values)
    for session in (offline, bag):
        assert {
            index: readings_digest(item.readings, session.measurements.rejected)
            for index, item in session.views.items()
        } == expected
    assert resume(tmp_path) is None  # the run is over


def desk_path(folder):
    [path] = (path for path in folder.iterdir() if path.is_dir())
    return path


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_a_session_that_takes_up_a_journal_goes_on_as_if_nothing_had_been(
    tmp_path, events, expected, share
):
    cut = round(share * len(events))
    first = Desk(tmp_path).receive(events[:cut])
    first.reception.drain()
    first.keeper.close()
    second = Desk(tmp_path)
    assert second.reception.restoring
    # latched
    second.receive(
        [
            event
            for event in events
            if isinstance(event, Command) and event.stamp_ns <= events[cut - 1].stamp_ns
        ],
        is_older=True,
    )
    second.receive(events[cut:])
    assert second.read() == expected
    assert not second.session.missed
    assert second.session.diagnosis(detections_matched=True).values["phase"] == "DONE"
    [line] = [
        line for line in second.hands.lines(Level.OK) if line.startswith("resumed")
    ]
    assert f"with {cut} messages" in line


@pytest.mark.parametrize("away_s", [0.5, 90.0])
def test_the_time_without_a_collector_is_told_in_the_view_that_it_tore(
    tmp_path, events, away_s
):
    """Where the marks that were lost had been read often enough before, nothing else tells it."""
    commands = [event for event in events if isinstance(event, Command)]
    cut = next(number for number, event in enumerate(events) if event is commands[2])
    first = Desk(tmp_path).receive(events[:cut])
    first.reception.drain()
    first.keeper.close()
    [file] = tmp_path.glob("journal_*/*.mcap")
    for path in (file, file.parent / "metadata.yaml", file.parent):
        written_ns = time.time_ns() - round(away_s * 1e9)
        os.utime(path, ns=(written_ns, written_ns))
    second = Desk(tmp_path)
    second.reception.drain()
    line = re.compile(
        r"view '0': detections of (\d+\.\d) s without a collector are lost, those of "
        "complete marks included"
    )
    told = second.session.diagnosis(detections_matched=True)
    assert told.level == Level.WARN
    assert away_s <= float(line.search(told.message)[1]) < away_s + 60
    assert [line.search(text)[0] for text in second.hands.lines(Level.OK)] == [
        line.search(told.message)[0]
    ]
    second.receive([commands[2]]).reception.drain()
    assert not line.search(second.session.diagnosis(detections_matched=True).message)


@pytest.mark.parametrize(
    ("hours", "limit_s", "goes_on"),
    [(23, 86400.0, True), (25, 86400.0, False), (25, 1e6, True), (1, 60.0, False)],
)
def test_a_run_that_was_left_long_ago_is_not_taken_up(
    tmp_path, events, hours, limit_s, goes_on
):
    first = Desk(tmp_path).receive(events[:200])
    first.reception.drain()
    first.keeper.close()
    written = time.time() - 3600 * hours
    for file in first_path(tmp_path).glob("*.mcap"):
        os.utime(file, (written, written))
    second = Desk(tmp_path, journal_max_age=limit_s)
    assert second.reception.restoring == goes_on
    second.reception.drain()
    assert (sum(second.session.collector.received.values()) > 0) == goes_on
    assert second.hands.lines(Level.WARN) == (
        []
        if goes_on
        else [
            f"{first_path(tmp_path)}: its run was left {hours} h ago and is not resumed; 'selfcal "
            "solve' reads it, a larger journal_max_age resumes it"
        ]
    )
    assert (second.keeper.path == first_path(tmp_path)) == goes_on


def test_of_a_run_that_is_over_nothing_is_said_however_old(tmp_path, events):
    Desk(tmp_path).receive(events).reception.close()
    for file in first_path(tmp_path).glob("*.mcap"):
        os.utime(file, (1, 1))
    second = Desk(tmp_path)
    assert not second.reception.restoring
    assert not second.hands.lines(Level.WARN)


def test_what_comes_while_the_journal_is_read_is_written_and_held_back(
    tmp_path, events, expected
):
    cut = len(events) // 2
    first = Desk(tmp_path).receive(events[:cut])
    first.reception.drain()
    first.keeper.close()
    worker = Later()
    second = Desk(tmp_path, worker).receive(events[cut:-6])
    # gone through, then read
    for path in (None, first.keeper.path or first_path(tmp_path)):
        assert not second.reception.drain()
        told = second.reception.diagnosis()
        assert (told.level, told.message) == (
            Level.WARN,
            f"reading the journal {first_path(tmp_path)}",
        )
        assert second.keeper.path == path
        second.receive(events[-6:-3] if path is None else events[-3:])
        assert not second.session.collector.received["encoder"]
        worker.finish()
    assert second.reception.drain()
    assert second.reception.diagnosis().level == Level.OK
    assert second.read() == expected
    second.reception.close()
    offline = collect_bag(desk_path(tmp_path), settings_of("measurement_collector"))
    assert sum(view.used for view in offline.measurements.views) == sum(
        view.used for view in second.session.collector.collect()[0].views
    )


def test_what_comes_while_a_journal_whose_run_is_over_is_gone_through_is_in_the_next_one(
    tmp_path, events, expected
):
    Desk(tmp_path).receive(events).reception.close()
    worker = Later()
    second = Desk(tmp_path, worker).receive(events[:100])
    assert not second.reception.drain()
    worker.finish()
    second.receive(events[100:])
    assert second.read() == expected
    path = second.keeper.path
    second.reception.close()
    assert path != first_path(tmp_path)
    assert sum(
        len(item) if hasattr(item, "__len__") else 1
        for _, item in BagReader(path).columns()
    ) == len(events)


def test_what_comes_while_a_run_that_was_left_is_looked_for_is_used_and_written(
    tmp_path, events, expected
):
    first = Desk(tmp_path).receive(events[:200])
    first.reception.drain()
    first.keeper.close()
    for file in first_path(tmp_path).glob("*.mcap"):
        os.utime(file, (1, 1))
    worker = Later()
    second = Desk(tmp_path, worker).receive(events)
    assert second.read() == expected
    assert not second.hands.lines(Level.WARN)
    worker.finish()
    second.reception.drain()
    [line] = second.hands.lines(Level.WARN)
    assert line.startswith(f"{first_path(tmp_path)}: its run was left ")


def test_a_collector_that_ends_while_a_journal_is_gone_through_writes_what_has_come(
    tmp_path, events
):
    first = Desk(tmp_path).receive(events[:200])
    first.reception.drain()
    first.keeper.close()
    worker = Later()
    second = Desk(tmp_path, worker).receive(events[200:260])
    second.reception.drain()
    worker.finish()
    second.receive(events[260:270]).reception.close()
    assert (
        sum(
            len(item) if hasattr(item, "__len__") else 1
            for _, item in BagReader(first_path(tmp_path)).columns()
        )
        == 270
    )


def test_a_journal_that_was_not_gone_through_is_let_go(tmp_path, events):
    first = Desk(tmp_path).receive(events[:200])
    first.reception.drain()
    first.keeper.close()
    worker = Later()
    second = Desk(tmp_path, worker).receive(events[200:260])
    worker.future.cancel()
    second.keeper.close()
    assert Desk(tmp_path).reception.restoring  # nobody holds it


def test_a_journal_that_cannot_be_read_is_refused_and_collecting_goes_on(
    tmp_path, events, expected
):
    first = Desk(tmp_path).receive(events[:50])
    first.reception.drain()
    first.keeper.close()
    worker = Later()
    second = Desk(tmp_path, worker)
    worker.finish()
    second.reception.drain()
    second.receive(events)
    worker.future.set_exception(InputError("journal", "is gone", "look for it"))
    assert second.read() == expected
    assert second.refused == {"journal: journal: is gone; look for it": 1}


class FullDisk:
    """A system on whose disk there is no room while it is told so."""

    def __init__(self, monkeypatch):
        self.full, write = False, journal_file.os.write

        def guarded(fd, data):
            if self.full:
                raise OSError(28, "No space left on device")
            return write(fd, data)

        monkeypatch.setattr(journal_file.os, "write", guarded)


def test_a_full_disk_is_said_counted_and_ends_nothing(
    tmp_path, events, expected, monkeypatch
):
    disk, desk = FullDisk(monkeypatch), Desk(tmp_path)
    desk.receive(events[:40]).reception.drain()
    disk.full = True
    for event in events[40:70]:
        desk.receive([event]).reception.drain()
    told = desk.reception.diagnosis()
    assert (told.level, told.values["journal_lost"]) == (Level.WARN, 30)
    assert told.message == (
        f"{desk.keeper.path}: the journal cannot be written (No space left on device); "
        "free some space or name another folder; 30 messages are not in the journal"
    )
    disk.full = False
    desk.hands.pass_time(10)
    desk.receive(events[70:])
    assert desk.read() == expected
    assert desk.hands.lines(Level.WARN) == [
        f"{desk.keeper.path}: the journal cannot be written (No space left on device); free some "
        "space or name another folder; collecting continues without it",
        f"{desk.keeper.path}: the journal is written again; 30 messages are not in it",
    ]
    told = desk.reception.diagnosis()
    assert (told.level, told.message) == (
        Level.WARN,
        "30 messages are not in the journal",
    )


def test_a_disk_that_is_full_from_the_beginning_is_tried_again(
    tmp_path, events, monkeypatch
):
    disk = FullDisk(monkeypatch)
    disk.full = True
    desk = Desk(tmp_path / "journals").receive(events[:5])
    desk.reception.drain()
    assert desk.keeper.path is None
    assert desk.reception.diagnosis().values["journal_lost"] == 5
    disk.full = False
    desk.receive(events[5:7]).reception.drain()
    assert desk.keeper.path is None  # not every time
    desk.hands.pass_time(10)
    desk.reception.drain()
    desk.receive(events[7:10]).reception.drain()
    assert desk.reception.diagnosis().values["journal_lost"] == 7
    assert desk.reception.diagnosis().message == "7 messages are not in the journal"
    assert [path.name for path in (tmp_path / "journals").iterdir()] == [
        desk.keeper.path.name
    ]
    assert desk.hands.lines(Level.WARN)[1:] == [
        f"{desk.keeper.path}: the journal is written again; 7 messages are not in it"
    ]


def test_a_folder_that_may_not_be_written_is_a_mistake_of_the_parameter(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(
        InputError, match=r"cannot be created \(Not a directory\); name a"
    ):
        Desk(tmp_path / "file")


@pytest.mark.parametrize("lag_s, level", [(4.9, Level.OK), (5.1, Level.WARN)])
def test_a_disk_that_lags_is_told(tmp_path, monkeypatch, lag_s, level):
    desk = Desk(tmp_path)
    monkeypatch.setattr(type(desk.keeper._journal), "lag_s", lag_s)
    told = desk.reception.diagnosis()
    assert told.level == level
    assert ("the disk is 5.1 s behind with the journal" in told.message) is (
        level > Level.OK
    )
    assert told.values["journal_lag_s"] == f"{lag_s:.2f}"


def test_without_a_folder_there_is_no_journal(events, expected):
    desk = Desk().receive(events)
    assert desk.read() == expected
    assert desk.reception.diagnosis().values == {}


def test_a_journal_that_is_refused_gets_no_other_beside_it(tmp_path):
    """That would be the newest one, and be continued instead at the next start."""
    hands, settings = (
        Hands(),
        settings_of("measurement_collector", journal=str(tmp_path)),
    )
    with journal.start(tmp_path, START_NS) as other:
        keeper = JournalKeeper(settings.journal, TOPICS, settings, hands.ports)
        with pytest.raises(InputError, match="another process writes this journal"):
            keeper.open(AtOnce())
        hands.pass_time(60)
        keeper.flush()
        keeper.close()
    assert list(tmp_path.iterdir()) == [other.path]


class Locked:
    """A journal that cannot be taken up, for a reason that is not the disk's."""

    def __init__(self, monkeypatch, reason):
        self.asked = 0

        def refused(folder):
            self.asked += 1
            raise reason

        monkeypatch.setattr(journal, "resume", refused)


@pytest.mark.parametrize(
    ("reason", "in_health", "refused"),
    [
        (
            InputError("journal_1", "another process writes this journal", "end it"),
            "journal_1: another process writes this journal; end it; 90 messages are "
            "not in the journal",
            {},
        ),
        (
            ZeroDivisionError("within"),
            "no room; 90 messages are not in the journal",
            {"journal: within": 1},
        ),
    ],
)
def test_whatever_a_later_try_meets_what_has_come_is_used(
    tmp_path, events, expected, monkeypatch, reason, in_health, refused
):
    Desk(tmp_path).keeper.close()  # a journal to go on with
    disk = FullDisk(monkeypatch)
    disk.full = True
    desk = Desk(tmp_path)
    desk.keeper._problem = "no room"
    locked = Locked(monkeypatch, reason)
    desk.hands.pass_time(10)
    for start in range(0, 90, 10):
        desk.receive(events[start : start + 10]).reception.drain()
    assert sum(desk.session.collector.received.values()) == 90
    assert locked.asked == 1  # not at every tick
    assert desk.refused == refused
    told = desk.reception.diagnosis()
    assert (told.level, told.message) == (Level.WARN, in_health)
    desk.receive(events[90:])
    assert desk.read() == expected


def test_a_full_disk_and_a_slow_encoder_do_not_fill_the_log(
    tmp_path, events, monkeypatch
):
    disk, desk = FullDisk(monkeypatch), Desk(tmp_path)
    disk.full = True
    for tick in range(1000):  # 40 s, a message at every second look
        desk.receive(events[tick : tick + 1] if tick % 2 else []).reception.drain()
        desk.hands.pass_time(0.04)
    assert len(desk.hands.lines(Level.WARN)) == 1
    assert desk.reception.diagnosis().values["journal_lost"] == 500
    disk.full = False
    desk.receive(events[:1]).reception.drain()
    assert len(desk.hands.lines(Level.WARN)) == 1  # it may fail again
    desk.hands.pass_time(10)
    desk.reception.drain()
    assert len(desk.hands.lines(Level.WARN)) == 1  # nothing was written
    desk.receive(events[:1]).reception.drain()
    assert desk.hands.lines(Level.WARN)[1:] == [
        f"{desk.keeper.path}: the journal is written again; 500 messages are not in it"
    ]


def test_a_journal_is_taken_up_on_a_full_disk_and_gone_on_with_when_there_is_room(
    tmp_path, events, expected, monkeypatch
):
    first = Desk(tmp_path).receive(events[:200])
    first.reception.drain()
    first.keeper.close()
    disk = FullDisk(monkeypatch)
    disk.full = True
    second = Desk(tmp_path)
    assert second.keeper.path is None and second.reception.restoring
    second.receive(events[200:260]).reception.drain()
    assert sum(second.session.collector.received.values()) == 260
    [line] = second.hands.lines(Level.OK)
    assert line.startswith(f"resumed {first_path(tmp_path)} with 200 messages, in view")
    disk.full = False
    second.hands.pass_time(10)
    second.reception.drain()
    assert (second.keeper.path, second.reception.restoring) == (
        first_path(tmp_path),
        False,
    )
    second.receive(events[260:])
    assert second.read() == expected
    assert second.reception.diagnosis().message == "60 messages are not in the journal"
    second.reception.close()
    assert (
        sum(
            len(item) if hasattr(item, "__len__") else 1
            for _, item in BagReader(first_path(tmp_path)).columns()
        )
        == len(events) - 60
    )


def first_path(folder):
    return min(path for path in folder.iterdir() if path.is_dir())


def test_a_journal_that_could_not_be_read_is_not_written_to(
    tmp_path, events, monkeypatch
):
    first = Desk(tmp_path).receive(events[:50])
    first.reception.drain()
    first.keeper.close()
    bad = OSError(errno.EIO, "Input/output error")
    with monkeypatch.context() as patch:
        patch.setattr(journal, "_newest", lambda folder: (_ for _ in ()).throw(bad))
        second = Desk(tmp_path)
        second.receive(events[50:60]).reception.drain()
    assert second.hands.lines(Level.WARN) == [
        f"{tmp_path}: the journal cannot be written (Input/output error); free some space or "
        "name another folder; collecting continues without it",
        f"{tmp_path}: the journal cannot be read (Input/output error); correct that, then restart "
        "the collector; the run is not resumed",
    ]
    second.hands.pass_time(10)
    second.reception.drain()
    second.receive(events[60:70]).reception.drain()
    assert second.keeper.path not in (None, first.keeper.path)
    assert sum(second.session.collector.received.values()) == 20
    assert [len(list(path.glob("*.mcap"))) for path in sorted(tmp_path.iterdir())] == [
        1,
        1,
    ]


def two_files(folder, events, spoil):
    """Leave a journal of two files, one of which is spoiled at its head; return its folder."""
    for part in (events[:50], events[50:120]):
        desk = Desk(folder).receive(part)
        desk.reception.drain()
        desk.keeper.close()
    path = first_path(folder)
    file = sorted(path.glob("*.mcap"))[spoil]
    file.write_bytes(bytes(len(file.read_bytes())))  # as a power cut leaves it
    return path, file


@pytest.mark.parametrize(("spoil", "n_read"), [(0, 70), (1, 50)])
def test_a_file_of_a_journal_that_cannot_be_read_costs_itself(
    tmp_path, events, monkeypatch, spoil, n_read
):
    path, file = two_files(tmp_path, events, spoil)
    desk = Desk(tmp_path)
    desk.receive(events[120:130]).reception.drain()
    assert sum(desk.session.collector.received.values()) == n_read + 10
    assert not desk.refused
    assert desk.hands.lines(Level.WARN) == [
        f"{path}: the file {file.name} was not read: not an MCAP file"
    ]
    desk.keeper.close()
    assert [len(list(path.glob("*.mcap")))] == [3]


def test_a_journal_none_of_whose_files_can_be_read_is_refused(tmp_path, events):
    path, file = two_files(tmp_path, events, 0)
    for other in path.glob("*.mcap"):
        other.write_bytes(bytes(100))
    desk = Desk(tmp_path)
    desk.receive(events[120:130]).reception.drain()
    assert sum(desk.session.collector.received.values()) == 10
    assert desk.refused == {
        f"journal: {file}: not an MCAP file; give an .mcap file or a rosbag2 folder": 1
    }


DAY_NS = 86400 * 10**9


def run_of(events, begin_ns):
    """Return the events of a run that begins then and names itself."""
    by = begin_ns - events[0].stamp_ns
    return [
        replace(
            event,
            stamp_ns=event.stamp_ns + by,
            **({"run_id": str(begin_ns)} if isinstance(event, Command) else {}),
        )
        for event in events
    ]


def digests(measurements):
    return [readings_digest(view, {}) for view in measurements.views]


def test_a_run_stamped_a_day_ahead_hides_no_later_one_nor_does_its_journal(
    tmp_path, events
):
    ahead, honest = run_of(events, START_NS + DAY_NS), run_of(events, START_NS)
    _, expected, _ = collected(honest)
    desk = Desk(tmp_path).receive(ahead)
    desk.reception.drain()
    assert desk.session.collector.newest_command is None
    told = desk.session.diagnosis(detections_matched=True)
    counts = [
        sum(isinstance(event, kind) for event in events)
        for kind in (Command, Detection, EncoderSample)
    ]
    assert desk.session.collector.unusable == dict(
        zip(
            (
                "command_from_the_future",
                "from_the_future",
                "encoder_sample_from_the_future",
            ),
            counts,
            strict=True,
        )
    )
    assert told.level == Level.WARN
    assert f"messages not used: command_from_the_future {counts[0]}, " in told.message
    assert {line.partition(": ")[0] for line in desk.refused} == set(INPUT_TOPICS)
    assert all(
        re.search(
            r"stamped 864\d\d s ahead of this node's clock: not used; set the clock "
            "that stamps it; correctly stamped messages are used$",
            line,
        )
        for line in desk.refused
    )
    desk.receive(honest).reception.drain()
    measurements, _ = desk.session.collector.collect()
    assert measurements.run_id == str(START_NS)
    assert digests(measurements) == digests(expected)
    desk.keeper.close()
    again = collect_bag(
        desk_path(tmp_path), settings_of("measurement_collector")
    ).measurements
    assert digests(again) == digests(expected)
    assert Desk(tmp_path).receive(honest, is_older=True).reception.drain()


@pytest.mark.parametrize("by_s", [-5.0, 0.4])
def test_a_clock_that_steps_shortly_before_the_end_is_told_live_as_of_the_journal(
    tmp_path, monkeypatch, events, by_s
):
    """Most messages come in a single look of the collector."""
    desk = Desk(tmp_path)
    monkeypatch.setattr(reception.time, "time_ns", lambda: desk.hands.now_ns)
    step_ns = events[-1].stamp_ns - 300_000_000
    for number, event in enumerate(events):
        stepped = isinstance(event, Detection) and event.stamp_ns > step_ns
        data = cdr_of(
            replace(event, stamp_ns=event.stamp_ns + round(by_s * 1e9) * stepped)
        )
        if isinstance(event, Command):
            desk.reception.command(data, False, event.stamp_ns)
        else:
            (
                desk.reception.detection
                if isinstance(event, Detection)
                else desk.reception.encoder
            )(data, event.stamp_ns)
        if number == len(events) // 2 or event is events[-1]:
            desk.hands.seconds = 100.0 + (event.stamp_ns - START_NS) * 1e-9
            desk.reception.drain()
    desk.session.finish()
    [live] = desk.session._stepped
    desk.keeper.close()
    found = collect_bag(desk_path(tmp_path), settings_of("measurement_collector"))
    assert [live] == [line for line in found.lost if "stepped" in line]
    assert f"stepped {'back' if by_s < 0 else 'ahead'} by {abs(by_s):g} s" in live


@pytest.mark.parametrize("ahead_s, used", [(59.9, True), (60.1, False)])
@pytest.mark.parametrize("kind", [Command, Detection, EncoderSample])
def test_how_far_ahead_a_stamp_may_lie(events, ahead_s, used, kind):
    event = next(event for event in events if isinstance(event, kind))
    desk = Desk().receive([replace(event, stamp_ns=START_NS + round(ahead_s * 1e9))])
    # else the counts are not published, and a player waits for them
    assert desk.reception.drain()
    assert sum(desk.session.collector.received.values()) == 1
    assert not desk.reception.drain()
    assert (desk.session.collector.unusable == {}) is used is (not desk.refused)


def test_without_a_clock_nothing_is_from_the_future(monkeypatch, events):
    """use_sim_time, and nobody publishes /clock."""
    monkeypatch.setattr(Hands, "now_ns", 0)
    desk = Desk().receive(events)
    desk.reception.drain()
    assert desk.session.collector.unusable == {}


def test_a_clock_that_was_set_back_is_a_warning_and_a_restart_ends_it(
    tmp_path, monkeypatch, events
):
    first = Desk(tmp_path)
    first.hands.seconds += 86400
    first.receive(run_of(events, START_NS + DAY_NS)[:300]).reception.drain()
    first.session.tick()
    first.hands.seconds -= 86400
    honest = run_of(events, START_NS)
    first.receive(honest).reception.drain()
    first.hands.pass_time(1.0)
    first.session.tick()
    told = first.session.diagnosis(detections_matched=True)
    line = (
        "the newest view command is stamped 86399 s ahead of this machine's clock, which was "
        "set back: no later run is shown; restart measurement_collector, which ignores such "
        "a run, and start the plan again"
    )
    assert told.level == Level.WARN and line in told.message
    assert first.hands.lines(Level.WARN).count(line) == 1
    first.keeper.close()
    monkeypatch.setattr(journal.time, "time_ns", lambda: START_NS)
    second = Desk(tmp_path).receive(honest)
    second.reception.drain()
    measurements, _ = second.session.collector.collect()
    assert digests(measurements) == digests(collected(honest)[1])
    assert line not in second.session.diagnosis(detections_matched=True).message


@pytest.mark.parametrize("frame", ["stage", "", "camera\x1b"])
def test_detections_in_another_frame_are_a_warning_as_long_as_they_are(events, frame):
    """The readings are used all the same: a driver may know the stage by another name."""
    desk = Desk()
    detection = next(event for event in events if isinstance(event, Detection))
    desk.reception.detection(cdr_of(detection, frame), 0)
    desk.reception.drain()
    told = desk.reception.diagnosis()
    assert told.level == (Level.WARN if "camera" in frame else Level.OK)
    assert told.message == (
        r"stage/mark_detections names the frame 'camera\x1b', but is used in 'stage': "
        "transform it first, or set frame_id if it is the stage's"
        if "camera" in frame
        else ""
    )
    assert desk.session.collector.received["detection"] == 1
    desk.receive([detection]).reception.drain()
    assert desk.reception.diagnosis().level == Level.OK
    # as of a joint state broadcaster: it names the base of its robot
    sample = next(event for event in events if isinstance(event, EncoderSample))
    desk.reception.encoder(cdr_of(sample, "base_link"), 0)
    desk.reception.drain()
    assert desk.reception.diagnosis().level == Level.OK


@pytest.mark.parametrize("order", [cdr.LITTLE, cdr.BIG])
def test_the_frame_of_a_message_in_either_byte_order(order):
    ends = "<" if order == cdr.LITTLE else ">"
    message = order + bytes(2) + struct.pack(f"{ends}iII", 5, 6, 4) + b"cam\0more"
    assert frame_id(message) == "cam"
    assert [frame_id(message[:size]) for size in (0, 8, 14)] == ["", "", ""]


def test_a_newer_run_that_is_not_shown_is_a_warning_until_it_is(events):
    """The sequencer that began it has a clock that is behind that of the one before."""
    desk = Desk()
    commands = [event for event in events if isinstance(event, Command)]
    desk.receive(run_of(commands, START_NS + 30 * 10**9)[:2])
    desk.receive(run_of(commands, START_NS)[:2]).reception.drain()
    desk.session.tick()
    told = desk.session.diagnosis(detections_matched=True)
    assert told.level == Level.WARN
    assert (
        f"run {START_NS} is not shown: it began 30" in told.message
        and "abort it, synchronise the clocks, and start it again" in told.message
    )
    desk.receive(run_of(commands, START_NS + 50 * 10**9)[:2]).reception.drain()
    desk.hands.pass_time(1.0)
    desk.session.tick()
    assert "is not shown" not in desk.session.diagnosis(detections_matched=True).message


def test_a_recorded_run_of_long_ago_is_no_newer_one(events):
    desk = Desk()
    commands = [event for event in events if isinstance(event, Command)]
    desk.receive(run_of(commands, START_NS)[:2])
    desk.receive(run_of(commands, START_NS - DAY_NS)[:2]).reception.drain()
    desk.session.tick()
    assert "is not shown" not in desk.session.diagnosis(detections_matched=True).message


def test_a_forged_command_within_a_run_changes_nothing_and_is_a_warning(events):
    honest = run_of(events, START_NS)
    begin = next(
        e for e in honest if isinstance(e, Command) and e.phase == Phase.MEASURE
    )
    forged = replace(
        begin, stamp_ns=begin.stamp_ns + 10**8, run_id="", plan_id="forged"
    )
    desk = Desk().receive([*honest, forged])
    desk.reception.drain()
    desk.session.tick()
    measurements, _ = desk.session.collector.collect()
    assert digests(measurements) == digests(collected(honest)[1])
    assert measurements.all_rejected() == {}
    told = desk.session.diagnosis(detections_matched=True)
    assert told.level == Level.WARN
    assert (
        "1 view command of plan 'forged' arrived during a run, belonging to no run"
        in told.message
    )
