# SPDX-License-Identifier: Apache-2.0
"""The journal: what a collector received, on the disk before it acts on it.

A journal is a bag folder that grows. Killed at any instant, it holds every message that was
flushed; `resume` gives the file an end and goes on in a new one of the same bag.
"""

import fcntl
import os
import re
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path

import yaml
from mcap.records import Channel, Schema

from selfcal_ros.bagio.channels import ChannelDecoder
from selfcal_ros.bagio.journal_file import (
    Content,
    JournalFile,
    finish_file,
    message_record,
    records,
    scan_file,
)
from selfcal_ros.bagio.schemas import definition_of, store_of_schema
from selfcal_ros.bagio.writer import Closing, Metadata, Topic, writing
from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Phase
from selfcal_ros.errors import InputError, SelfcalError
from selfcal_ros.messages.to_model import stamp_ns
from selfcal_ros.topics import COMMAND_TOPIC
from selfcal_ros.units import NS_PER_S, S_PER_NS

SYNC_PERIOD_S = 0.5
"""Time between two synchronisations with the disk, where there is something to synchronise."""
OVER = (Phase.DONE, Phase.ABORT)


def resume(folder: str | os.PathLike) -> "Journal | None":
    """Return the journal of the plan that is running, ready to go on; None if there is none.

    That is the journal in `folder` that was written last, unless its last command, by stamp, is
    DONE or ABORT or lies in the future. Read it first (`BagReader(path).columns()`), then write.

    Parameters
    ----------
    folder : path
        Where journals lie, each a bag folder; need not exist.

    Raises
    ------
    InputError
        If another process writes this journal, or it cannot be read or written.
    """
    found = claim(folder)
    return found.resume() if found else None


class Claim:
    """The newest journal of a folder, locked: nobody else writes it. It is gone through once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _said(path):
            self._lock = _locked(path)

    def resume(self) -> "Journal | None":
        """Return the journal as `resume` does: all of it is read, a GB in some seconds."""
        with _said(self.path):
            try:
                metadata, commands = _taken_up(self.path)
                if not _is_over(commands):
                    return Journal(self.path, self._lock, metadata)
            except BaseException:
                os.close(self._lock)
                raise
            os.close(self._lock)
        return None

    def close(self) -> None:
        """Let go of a journal that is not resumed."""
        os.close(self._lock)


def claim(folder: str | os.PathLike) -> Claim | None:
    """Return the newest journal in `folder` before it is gone through; None without one.

    Raises
    ------
    InputError
        If another process writes this journal, or the folder cannot be read.
    """
    found = newest(folder)
    return Claim(found[0]) if found else None


def unfinished(folder: str | os.PathLike, journal: Path | None = None) -> list[Path]:
    """Return the files of the journal that `resume` would take up, in their order; [] = none.

    Nothing is written: where there is no room, what the journal holds can be used all the same.

    Parameters
    ----------
    folder : path
        Where journals lie, each a bag folder; need not exist.
    journal : Path, optional
        The one to look at; None = the newest.

    Raises
    ------
    InputError
        If the journal cannot be read.
    """
    bag = Path(folder)
    try:
        found = journal or _newest(bag)[1]
        if found is None:
            return []
        bag, files = found, sorted(found.glob("*.mcap"), key=_number)
        commands = [command for file in files
                    for command in _commands(scan_file(file, COMMAND_TOPIC), str(file))]
    except OSError as error:
        raise InputError(str(bag), f"the journal cannot be read ({error.strerror})",
                         "correct that, then restart the collector") from error
    return [] if _is_over(sorted(commands)) else files


def newest(folder: str | os.PathLike) -> tuple[Path, float] | None:
    """Return the journal in `folder` that was written last, and the time since, s.

    Raises
    ------
    InputError
        If the folder cannot be read.
    """
    with _said(Path(folder)):
        written_ns, bag = _newest(Path(folder))
    return (bag, max(time.time_ns() - written_ns, 0) * S_PER_NS) if bag else None


def start(folder: str | os.PathLike, now_ns: int) -> "Journal":
    """Begin a new journal in `folder`, which is made if need be; its name tells the time.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    name = time.strftime("journal_%Y%m%dT%H%M%SZ", time.gmtime(now_ns // NS_PER_S))
    for suffix in ("", *(f"_{number}" for number in range(2, 1000))):
        bag = Path(folder) / (name + suffix)
        try:
            bag.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(str(bag), f"cannot be created ({error.strerror})",
                             "name a writable folder") from error
        with _said(bag):
            lock = _locked(bag)
            try:
                return Journal(bag, lock, Metadata())
            except BaseException:
                os.close(lock)
                with suppress(OSError):
                    bag.rmdir()
                raise
    raise InputError(str(folder), f"holds a thousand journals of {name}", "remove some")


class Journal(Closing):
    """Writes raw messages to a bag folder; made by `start` or `resume`, to be closed.

    Parameters
    ----------
    path : Path
        The bag folder.
    lock : int
        The open lock on it, which the journal closes.
    metadata : Metadata
        Files and topics that are there already.

    Attributes
    ----------
    earlier : list of Path
        Files that were there already, in their order.
    """

    def __init__(self, path: Path, lock: int, metadata: Metadata) -> None:
        self.path = path
        self._n_unwritten = self._n_unsynced = 0
        self._n_appended = self._n_synced = 0
        self.earlier = [path / file.name for file in metadata.files]
        self._lock, self._metadata = lock, metadata
        self._channels: dict[str, int] = {}
        self._waiting: list[tuple[str, bytes, int]] = []
        self._sequence: Counter = Counter()
        self._failed: OSError | None = None
        self._file = JournalFile(path / f"{path.name}_{len(metadata.files)}.mcap")
        metadata.files.append(self._file.content.entry)
        for topic, known in metadata.topics.items():
            self._declare(topic, known)
        metadata.write(path)
        self._stop = threading.Event()
        self._unsynced_s: float | None = None  # since when there is something to synchronise
        self._syncing_s: float | None = None  # the same of what is being synchronised
        self._syncer = threading.Thread(target=self._sync_on, name="journal", daemon=True)
        self._syncer.start()

    def add_topic(self, topic: str, typename: str, qos: Sequence[dict] = (),
                  heard_on: str = "") -> None:
        """Declare a topic, with its namespace, before its first message; again does nothing.

        A topic of the contract is found by its name: one that was remapped is declared with its
        own name all the same, and as `heard_on` the other one.

        Raises
        ------
        InputError
            If the type is not known, or the journal cannot be written.
        """
        if topic in self._channels:
            return
        definition_of(topic, typename)  # refuses a type that is not known
        known = self._metadata.topics.setdefault(
            topic, Topic(typename, list(qos), heard_on=heard_on))
        self._declare(topic, known)

    def _declare(self, topic: str, known: Topic) -> None:
        number, definition = len(self._channels) + 1, definition_of(topic, known.type)
        schema = Schema(id=number, name=known.type, encoding="ros2msg", data=definition.encode())
        channel = Channel(
            id=number, topic=topic, message_encoding="cdr", schema_id=number,
            metadata=known.channel_metadata())
        self.flush()
        with _said(self.path):
            self._file.append(records(schema, channel))
        self._file.content.declare(schema)
        self._file.content.declare(channel)
        self._channels[topic] = number

    def write(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Take one message, as received; it is safe once `flush` has returned."""
        self._waiting.append((topic, data, log_time_ns))

    def flush(self) -> None:
        """Hand what was taken to the system, all at once; the disk has it within a second.

        Call it before acting on what was taken.

        Raises
        ------
        InputError
            If the disk is full or fails: what was taken since the last flush is not in the
            journal and counts in `n_lost`.
        """
        waiting, self._waiting = self._waiting, []
        with _said(self.path):
            if waiting:
                self._append(waiting)
                self._n_appended += len(waiting)
                self._unsynced_s = self._unsynced_s or time.monotonic()
            failed, self._failed = self._failed, None
            if failed is not None:
                raise failed

    def _append(self, waiting: list[tuple[str, bytes, int]]) -> None:
        records: list[bytes] = []
        times: dict[str, list[int]] = {topic: [] for topic in {item[0] for item in waiting}}
        for topic, data, log_time_ns in waiting:
            records.append(message_record(
                self._channels[topic], self._sequence[topic], log_time_ns, data))
            self._sequence[topic] += 1
            times[topic].append(log_time_ns)
        try:
            self._file.append(b"".join(records))
        except OSError:
            self._n_unwritten += len(waiting)
            raise
        for topic, logged in times.items():
            self._file.content.add(self._channels[topic], logged)
            self._metadata.topics[topic].count += len(logged)

    def _sync_on(self) -> None:
        """Synchronise with the disk, in a thread of its own: it may take its time."""
        while not self._stop.wait(SYNC_PERIOD_S):
            if self._unsynced_s is not None:
                since, n_appended = self._unsynced_s, self._n_appended
                self._syncing_s, self._unsynced_s = since, None
                try:
                    self._file.sync()
                except OSError as error:  # the system may have dropped it: a later sync tells not
                    self._failed, self._unsynced_s = error, since
                    self._n_unsynced += n_appended - self._n_synced
                self._n_synced = n_appended
                self._syncing_s = None

    @property
    def n_lost(self) -> int:
        """Messages that could not be written, or that the disk failed to take."""
        return self._n_unwritten + self._n_unsynced

    @property
    def lag_s(self) -> float:
        """Age of the oldest message that was flushed and is not on the disk, s; 0 = none is."""
        since = [when for when in (self._syncing_s, self._unsynced_s) if when is not None]
        return time.monotonic() - min(since) if since else 0.0

    def close(self) -> None:
        """Give the file its end and write metadata.yaml; again does nothing."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._syncer.join()
        try:
            self.flush()
        finally:
            with _said(self.path):
                try:
                    self._file.close()
                finally:
                    os.close(self._lock)
            self._metadata.write(self.path)


def _said(path: Path) -> AbstractContextManager[None]:
    """Turn a full disk or a vanished folder into the package's own error."""
    return writing(path, "the journal cannot be written")


def _taken_up(bag: Path) -> tuple[Metadata, list[tuple[int, Phase]]]:
    """Finish the files that are there; return what they hold, and their commands by stamp."""
    metadata = Metadata()
    commands: list[tuple[int, Phase]] = []
    for file in sorted(bag.glob("*.mcap"), key=_number):
        content = finish_file(file, COMMAND_TOPIC)
        metadata.files.append(content.entry)
        for channel in content.channels.values():
            schema = content.schemas.get(channel.schema_id)
            if schema is not None:
                qos = yaml.safe_load(channel.metadata.get("offered_qos_profiles", "")) or []
                topic = metadata.topics.setdefault(channel.topic, Topic(
                    schema.name, qos, heard_on=channel.metadata.get("heard_on", "")))
                topic.count += content.counts.get(channel.id, 0)
        commands += _commands(content, str(file))
    return metadata, sorted(commands)


def _is_over(commands: list[tuple[int, Phase]]) -> bool:
    """Return whether the last command, by stamp, ends a run, or would hide every later one."""
    latest_ns = time.time_ns() + MAX_AHEAD_NS
    return bool(commands) and (commands[-1][1] in OVER or commands[-1][0] > latest_ns)


def _locked(path: Path) -> int:
    """Return an open lock on a folder; the system opens it when the process ends."""
    lock = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(lock)
        raise InputError(str(path), "another process writes this journal",
                         "end it or name another folder") from error
    return lock


def _newest(folder: Path) -> tuple[int, Path | None]:
    """Return when a file of a bag folder in `folder` was written last, ns, and that bag folder."""
    found: list[tuple[int, Path]] = []
    with suppress(FileNotFoundError, NotADirectoryError):
        for bag in folder.iterdir():
            with suppress(NotADirectoryError):
                found += [(file.stat().st_mtime_ns, bag) for file in bag.iterdir()
                          if file.suffix == ".mcap"]
    return max(found, default=(0, None))


def _number(file: Path) -> tuple[int, str]:
    number = re.search(r"_(\d+)\.mcap$", file.name)
    return int(number.group(1)) if number else -1, file.name


def _commands(content: Content, where: str) -> list[tuple[int, Phase]]:
    """Return stamps and phases of the commands that were kept; what is damaged is left out."""
    found: list[tuple[int, Phase]] = []
    bad: Counter = Counter()
    for number, data in content.kept:
        schema = content.schemas.get(content.channels[number].schema_id)
        if schema is None:
            continue
        with suppress(SelfcalError, ValueError):
            store = store_of_schema(schema.name, schema.encoding, schema.data.decode(), where)
            message = ChannelDecoder(COMMAND_TOPIC, schema.name, (store,), bad, told=True).one(data)
            if message is not None:
                found.append((stamp_ns(message), Phase(int(message.phase))))
    return found
