# SPDX-License-Identifier: Apache-2.0
"""Journals: whatever becomes of the writer, what was flushed is read, and the next one goes on."""

import errno
import os
import signal
import struct
import subprocess
import sys
import threading
import time
from itertools import islice
from pathlib import Path

import pytest
import yaml
from mcap.opcode import Opcode
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader

from selfcal_ros.bagio import journal, journal_file
from selfcal_ros.bagio.journal import resume, start, unfinished
from selfcal_ros.bagio.mcap_stream import McapStream
from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.bagio.writer import BagWriter, build
from selfcal_ros.collection.inputs import Command, EncoderSample, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import Options, calibrate
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import ENCODER_TOPIC, INPUT_TOPICS, qos_profile
from test.support.bags import Foreign
from test.support.sessions import events_of, small_plan

VALUES = CollectorSettings.checked({}, "test")
NOW = 1_700_000_000_000_000_000
QOS = qos_profile(reliable=True, transient_local=False, depth=1000)


def raw(event, tail=b"\x81\x9f\x93\x01"):
    """Return topic and bytes of an event, as a raw subscription hands them over."""
    topic, fields = event_fields(event, "stage")
    name = INPUT_TOPICS[topic]
    return f"/{topic}", bytes(
        typestore().serialize_cdr(build(typestore(), name, fields), name)
    ) + tail


def declared(writer):
    for topic, name in INPUT_TOPICS.items():
        writer.add_topic(f"/{topic}", name, [QOS])
    return writer


def record(writer, events):
    for event in events:
        topic, data = raw(event)
        writer.write(topic, data, event.stamp_ns + 5)
    writer.flush()


def samples(n, first=0):
    return [
        EncoderSample(NOW + i, ("x", "y", "theta"), (i * 1e-3, 0.0, 0.0))
        for i in range(first, first + n)
    ]


def stamps(path):
    """Return the stamps of the encoder samples in a journal, and what was lost."""
    reader = BagReader(path)
    found = [
        stamp - NOW
        for _, block in reader.columns()
        if hasattr(block, "stamps_ns")
        for stamp in block.stamps_ns.tolist()
    ]
    return sorted(found), reader.lost


def command(phase, stamp_ns):
    plan = small_plan()
    if phase in (Phase.DONE, Phase.ABORT):
        return Command(stamp_ns, phase, "plan")
    return Command(stamp_ns, phase, "plan", 0, plan.views[0], plan.artifact)


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


def solved(path):
    measurements, _, lost, _ = collect_bag(path, VALUES)
    return result_to_dict(calibrate(measurements, Options())), lost


def test_a_journal_is_a_bag_like_any_other(tmp_path, events):
    with declared(start(tmp_path / "journals", NOW)) as writer:
        record(writer, events)
    expected = solved(Foreign().write(tmp_path / "x.mcap", events))
    assert solved(writer.path) == expected and expected[1] == []
    assert writer.path.name == "journal_20231114T221320Z"
    with Reader(writer.path) as reader:
        assert reader.message_count == sum(1 for _ in reader.messages()) == len(events)
        assert {c.topic for c in reader.connections} == {
            f"/{topic}" for topic in INPUT_TOPICS
        }
    [file] = writer.path.glob("*.mcap")
    with file.open("rb") as stream:
        whole = make_reader(stream, validate_crcs=True)
        assert whole.get_summary().statistics.message_count == len(events)
        times = [message.log_time for _, _, message in whole.iter_messages()]
    assert times == sorted(event.stamp_ns + 5 for event in events)


def test_metadata_counts_what_every_file_holds(tmp_path, events):
    with declared(start(tmp_path, NOW)) as writer:
        assert information(writer.path)["message_count"] == 0
        record(writer, samples(7))
    with resume(tmp_path) as again:
        assert information(writer.path)["message_count"] == 7
        record(again, samples(5, 7))
    about = information(writer.path)
    assert about["message_count"] == 12
    assert about["starting_time"]["nanoseconds_since_epoch"] == NOW + 5
    assert about["duration"]["nanoseconds"] == 11
    assert [file["message_count"] for file in about["files"]] == [7, 5]
    by_topic = {
        t["topic_metadata"]["name"]: t for t in about["topics_with_message_count"]
    }
    assert {name: topic["message_count"] for name, topic in by_topic.items()} == {
        f"/{topic}": 12 * (topic == ENCODER_TOPIC) for topic in INPUT_TOPICS
    }
    assert by_topic["/stage/joint_states"]["topic_metadata"][
        "offered_qos_profiles"
    ] == [QOS]


def information(path):
    return yaml.safe_load((path / "metadata.yaml").read_text())[
        "rosbag2_bagfile_information"
    ]


WRITER = """
import sys
sys.path.insert(0, sys.argv[3])
from selfcal_ros.bagio import journal
folder, first = sys.argv[1], int(sys.argv[2])
writer = journal.resume(folder) or journal.start(folder, 1_700_000_000_000_000_000)
writer.add_topic("/stage/joint_states", "sensor_msgs/msg/JointState")
from selfcal_ros.bagio.schemas import typestore
store = typestore()
time = store.types["builtin_interfaces/msg/Time"]
header = store.types["std_msgs/msg/Header"]
state = store.types["sensor_msgs/msg/JointState"]
import numpy as np
number = first
while True:
    for _ in range(number % 50 + 1):
        stamp = 1_700_000_000_000_000_000 + number
        message = state(header(time(*divmod(stamp, 10**9)), "stage"), ["x"], np.array([1.0]),
                        np.array([]), np.array([]))
        writer.write("/stage/joint_states",
                     bytes(store.serialize_cdr(message, "sensor_msgs/msg/JointState")), stamp)
        number += 1
    writer.flush()
    print(number, flush=True)
"""


def test_killed_at_any_instant_what_was_flushed_is_there_and_the_next_one_goes_on(
    tmp_path,
):
    first = 0
    for n_lines in (1, 40, 7):
        child = subprocess.Popen(
            [
                sys.executable,
                "-c",
                WRITER,
                str(tmp_path),
                str(first),
                str(Path(__file__).parents[2]),
            ],
            text=True,
            stdout=subprocess.PIPE,
        )
        told = [int(child.stdout.readline()) for _ in range(n_lines)]
        child.send_signal(signal.SIGKILL)
        told += [int(line) for line in child.stdout.read().split("\n")[:-1]]
        child.stdout.close()
        assert child.wait() == -signal.SIGKILL
        [path] = tmp_path.iterdir()
        found, _ = stamps(path)
        assert found == list(range(len(found))) and len(found) >= told[-1]
        first = len(found)
    writer = resume(tmp_path)
    assert writer.path == path
    writer.close()
    found, lost = stamps(path)
    assert found == list(range(first)) and lost == []
    assert information(path)["message_count"] == first
    with Reader(path) as reader:
        assert sum(1 for _ in reader.messages()) == first


def test_a_file_cut_anywhere_is_finished_and_holds_what_is_whole(tmp_path):
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, samples(3))
    [file] = writer.path.glob("*.mcap")
    data = file.read_bytes()
    places = [
        place
        for place in range(len(data))
        if data[place] == Opcode.MESSAGE
        and data[place + 1 : place + 9]
        == struct.pack("<Q", 22 + len(raw(samples(1)[0])[1]))
    ]
    assert len(places) == 3
    ends = [*places[1:], data.index(bytes([Opcode.DATA_END]) + struct.pack("<Q", 4))]
    for cut in (
        *range(places[0], ends[-1] + 30),
        *range(ends[-1] + 30, len(data), 199),
        *range(len(data) - 3, len(data) + 1),
    ):
        file.write_bytes(data[:cut])
        content = journal_file.finish_file(file, "selfcal/view_command")
        n_whole = sum(end <= cut for end in ends)
        assert content.entry.count == n_whole and not content.damaged
        assert stamps(file) == (list(range(n_whole)), [])
        assert cut < len(data) or file.read_bytes() == data


def test_damage_in_the_middle_is_not_cut_off(tmp_path):
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, samples(30))
    [file] = writer.path.glob("*.mcap")
    data = file.read_bytes()
    size = 31 + len(raw(samples(1)[0])[1])
    at = data.index(b"\x05" + struct.pack("<Q", size - 9)) + 10 * size
    damaged = data[:at] + b"\0" * 20 + data[at + 20 :]
    file.write_bytes(damaged)
    with resume(tmp_path) as again:
        assert file.read_bytes() == damaged
        record(again, samples(2, 30))
    found, lost = stamps(writer.path)
    assert found == [*range(10), *range(11, 32)]
    assert "damaged" in lost[0]


@pytest.mark.parametrize(
    ("phases", "goes_on"),
    [
        ((), True),
        ((Phase.PLACE,), True),
        ((Phase.PLACE, Phase.MEASURE), True),
        ((Phase.PLACE, Phase.MEASURE, Phase.DONE), False),
        ((Phase.MEASURE, Phase.ABORT), False),
        ((Phase.DONE, Phase.PLACE), True),
    ],
)
@pytest.mark.parametrize("reverse", [False, True])
def test_the_plan_that_is_running_is_taken_up(tmp_path, phases, goes_on, reverse):
    commands = [command(phase, NOW + i) for i, phase in enumerate(phases)]
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, commands[::-1] if reverse else commands)
    before = {file: file.read_bytes() for file in writer.path.iterdir()}
    assert unfinished(tmp_path) == (list(writer.path.glob("*.mcap")) if goes_on else [])
    assert {file: file.read_bytes() for file in writer.path.iterdir()} == before
    again = resume(tmp_path)
    assert (again is not None) == goes_on
    n_files = len(list(writer.path.glob("*.mcap")))
    assert n_files == (2 if goes_on else 1)
    if again is not None:
        assert again.path == writer.path
        again.close()


@pytest.mark.parametrize(
    ("ahead_s", "goes_on"), [(-3600, True), (30, True), (90, False)]
)
def test_a_run_that_would_hide_every_later_one_is_over(tmp_path, ahead_s, goes_on):
    """A collector uses commands stamped up to a minute ahead of their reception, no others."""
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, [command(Phase.PLACE, time.time_ns() + ahead_s * 10**9)])
    assert bool(unfinished(tmp_path)) == goes_on


def test_the_journal_written_last_counts(tmp_path):
    for look in (resume, unfinished):
        assert not look(tmp_path / "nothing")
        assert not look(tmp_path)
    (tmp_path / "a file").write_text("nothing")
    (tmp_path / "empty").mkdir()
    old, new = (declared(start(tmp_path, NOW)) for _ in range(2))
    assert new.path.name == old.path.name + "_2"
    record(old, [command(Phase.PLACE, NOW)])
    record(new, [command(Phase.DONE, NOW + 1)])
    for writer in (old, new):
        writer.close()
    for number, writer in enumerate((old, new)):
        [file] = writer.path.glob("*.mcap")
        os.utime(file, ns=(NOW + number, NOW + number))
    assert resume(tmp_path) is None
    os.utime(next(old.path.glob("*.mcap")), ns=(NOW + 5, NOW + 5))
    with resume(tmp_path) as again:
        assert again.path == old.path


@pytest.mark.parametrize(
    "name", ["session", "journal", "journal_of_mine", "journal_20261127T102030Z_copy"]
)
def test_a_recording_beside_the_journals_is_left_alone(tmp_path, name):
    """Written last and of an unfinished run, as by a recorder that runs."""
    with declared(BagWriter(tmp_path / name)) as recorder:
        topic, data = raw(command(Phase.PLACE, NOW))
        recorder.write_raw(topic, data, NOW + 5)
    before = {file: file.read_bytes() for file in (tmp_path / name).iterdir()}
    assert (resume(tmp_path), unfinished(tmp_path), journal.newest(tmp_path)) == (
        None,
        [],
        None,
    )
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, [command(Phase.PLACE, NOW)])
    os.utime(next((tmp_path / name).glob("*.mcap")))
    with resume(tmp_path) as again:
        assert again.path == writer.path
    assert {file: file.read_bytes() for file in (tmp_path / name).iterdir()} == before


@pytest.mark.parametrize("begun", ["whole", "header", "no magic", "empty"])
def test_a_recording_with_the_name_of_a_journal_is_refused_as_it_is(tmp_path, begun):
    """`begun` is what a running recorder has written so far."""
    folder = tmp_path / "journal_20261127T102030Z"
    with declared(BagWriter(folder)) as recorder:
        topic, data = raw(command(Phase.PLACE, NOW))
        recorder.write_raw(topic, data, NOW + 5)
    file = folder / f"{folder.name}_0.mcap"
    if begun != "whole":
        (folder / "metadata.yaml").unlink()
        os.truncate(
            file,
            {
                "header": file.read_bytes().index(b"selfcal_ros") + 11,
                "no magic": 7,
                "empty": 0,
            }[begun],
        )
    before = {path: path.read_bytes() for path in folder.iterdir()}
    with pytest.raises(
        InputError,
        match=f"^{file}: is not of a journal: another recorder writes it, or wrote it; ",
    ):
        resume(tmp_path)
    assert {path: path.read_bytes() for path in folder.iterdir()} == before


def test_a_pipe_is_no_file_of_a_journal(tmp_path):
    folder = tmp_path / "journal_20261127T102030Z"
    folder.mkdir()
    os.mkfifo(folder / f"{folder.name}_0.mcap")
    assert journal.newest(tmp_path) is None


def test_a_journal_has_one_writer(tmp_path):
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, samples(1))
        with pytest.raises(
            InputError,
            match=f"^{writer.path}: another process writes this "
            "journal; end it or name another folder$",
        ):
            resume(tmp_path)
    resume(tmp_path).close()


def test_the_lag_is_the_age_of_what_the_disk_does_not_have(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(journal.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(journal, "SYNC_PERIOD_S", 3600.0)
    with declared(start(tmp_path, NOW)) as writer:
        assert writer.lag_s == 0.0
        record(writer, samples(1))
        now[0] = 107.5
        record(writer, samples(1, 1))
        assert writer.lag_s == 7.5
        now[0] = 109.0
        assert writer.lag_s == 9.0


def test_a_journal_may_be_read_by_whom_the_system_lets_read(tmp_path):
    mask = os.umask(0o027)
    try:
        with declared(start(tmp_path, NOW)) as writer:
            [file] = writer.path.glob("*.mcap")
            assert file.stat().st_mode & 0o7777 == 0o640
    finally:
        os.umask(mask)


@pytest.mark.parametrize("n_written", [0, 11, 200])
def test_a_full_disk_is_said_and_leaves_no_half_message(
    tmp_path, monkeypatch, n_written
):
    writer = declared(start(tmp_path, NOW))
    record(writer, samples(5))
    plain, room = os.write, [n_written]

    def full(fd, data):
        if not room[0]:
            raise OSError(errno.ENOSPC, "No space left on device")
        data, room[0] = data[: room[0]], room[0] - min(len(data), room[0])
        return plain(fd, data)

    monkeypatch.setattr(journal_file.os, "write", full)
    with pytest.raises(
        InputError,
        match=r"the journal cannot be written \(No space left on "
        r"device\); free some space or name another folder$",
    ):
        record(writer, samples(3, 100))
    assert writer.n_lost == 3
    monkeypatch.undo()
    record(writer, samples(2, 5))
    writer.close()
    assert stamps(writer.path) == (list(range(7)), [])
    assert information(writer.path)["message_count"] == 7


def test_the_disk_has_it_soon_and_its_failure_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(journal, "SYNC_PERIOD_S", 0.001)
    synced, failed = threading.Event(), threading.Event()
    plain = journal_file.JournalFile.sync

    def sync(file):
        synced.set()
        if failed.is_set():
            raise OSError(errno.EIO, "Input/output error")
        plain(file)

    monkeypatch.setattr(journal_file.JournalFile, "sync", sync)
    writer = declared(start(tmp_path, NOW))
    record(writer, samples(1))
    assert synced.wait(60)
    deadline = time.monotonic() + 60
    while writer._n_synced < 1 and time.monotonic() < deadline:
        pass
    failed.set()
    synced.clear()
    record(writer, samples(1, 1))
    assert synced.wait(60)
    with pytest.raises(InputError, match=r"cannot be written \(Input/output error\)"):
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            writer.flush()
    assert writer.n_lost == 1  # the first one had been synchronised
    synced.clear()
    failed.clear()
    assert synced.wait(60)  # without a further message
    writer.close()
    assert stamps(writer.path) == ([0, 1], [])


def test_what_cannot_be_a_journal(tmp_path):
    (tmp_path / "file").write_text("x")
    with pytest.raises(
        InputError, match=r"cannot be created \(Not a directory\); name a"
    ):
        start(tmp_path / "file" / "in it", NOW)
    with start(tmp_path, NOW) as writer:
        with pytest.raises(
            InputError, match="topic /a: no definition of b/msg/C; record only"
        ):
            writer.add_topic("/a", "b/msg/C")
        declared(declared(writer))
        record(writer, samples(1))
    writer.close()
    assert stamps(writer.path) == ([0], [])


def test_killed_while_a_file_is_made_nothing_is_left_to_stumble_over(tmp_path):
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, samples(1))
    (writer.path / f"{writer.path.name}_1.part").write_bytes(b"\x89MC")
    with resume(tmp_path) as again:
        record(again, samples(1, 1))
    assert stamps(writer.path) == ([0, 1], [])
    assert sorted(p.suffix for p in writer.path.iterdir()) == [
        ".mcap",
        ".mcap",
        ".yaml",
    ]


def test_a_message_longer_than_a_stretch_is_passed(tmp_path):
    with declared(start(tmp_path, NOW)) as writer:
        long = Foreign()._payload(EncoderSample(NOW, ("x",), (0.0,)))[1] + bytes(
            3 << 20
        )
        writer.write("/stage/joint_states", long, NOW)
        record(writer, samples(2, 1))
    with resume(tmp_path):
        assert information(writer.path)["message_count"] == 3
    assert stamps(writer.path) == (
        [1, 2],
        [
            "1 messages on stage/joint_states could not be decoded: they are longer than 8192 bytes"
        ],
    )


def test_nothing_follows_a_torn_record_that_cannot_be_taken_back(tmp_path, monkeypatch):
    writer = declared(start(tmp_path, NOW))
    record(writer, samples(3))
    plain, room, stuck = os.write, [40], [True]

    def full(fd, data):
        if not room[0]:
            raise OSError(errno.EIO, "Input/output error")
        data, room[0] = data[: room[0]], room[0] - min(len(data), room[0])
        return plain(fd, data)

    def truncate(fd, size):
        if stuck[0]:
            raise OSError(errno.EROFS, "Read-only file system")
        monkeypatch.undo()
        os.ftruncate(fd, size)

    monkeypatch.setattr(journal_file.os, "write", full)
    monkeypatch.setattr(journal_file.os, "ftruncate", truncate)
    with pytest.raises(InputError, match=r"cannot be written \(Input/output error\)"):
        record(writer, samples(2, 100))
    room[0] = 10**6
    with pytest.raises(
        InputError, match=r"cannot be written \(Read-only file system\)"
    ):
        record(writer, samples(2, 200))
    assert writer.n_lost == 4
    stuck[0] = False
    record(writer, samples(2, 3))
    writer.close()
    assert stamps(writer.path) == (list(range(5)), [])


@pytest.mark.parametrize("torn", [0, 1, 40])
def test_a_file_that_grows_as_fast_as_it_is_read_ends_where_it_was_opened(
    tmp_path, monkeypatch, torn
):
    monkeypatch.setattr("selfcal_ros.bagio.mcap_chunk.STRETCH", 2000)
    with declared(start(tmp_path, NOW)) as writer:
        record(writer, samples(200))
        [file] = writer.path.glob("*.mcap")
        data = file.read_bytes()
    grows = tmp_path / "grows.mcap"
    # of the last record a part may be missing
    grows.write_bytes(data[: len(data) - torn])
    stream, found = McapStream(grows), []
    for block in islice(stream.blocks(), 1000):
        found += block.fronts["log_time"].tolist()
        with grows.open("ab") as end:
            end.write(data[-2000:])
    assert found == [NOW + number + 5 for number in range(200 - (torn > 0))]
    assert stream.lost == [
        f"the file is still being written: the messages in its first "
        f"{len(data) - torn} bytes are read"
    ]
