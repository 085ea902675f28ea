# SPDX-License-Identifier: Apache-2.0
"""The journal: messages received by a collector, on disk before they are used.

A journal is a growing bag folder. If the writer is killed, it contains every message that was
flushed; `resume` completes the file and continues in a new one of the same bag.
"""

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

from selfcal_ros import portable
from selfcal_ros.bagio.journal_file import (
    UNFINISHED,
    Content,
    JournalFile,
    finish_file,
    is_of_another_recorder,
    message_record,
    records,
    scan_file,
)
from selfcal_ros.bagio.messages.to_model import stamp_ns
from selfcal_ros.bagio.schemas import ChannelDecoder, definition_of, store_of_schema
from selfcal_ros.bagio.writer import BagTopic, Closing, Metadata, writing
from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Phase
from selfcal_ros.errors import InputError, SelfcalError
from selfcal_ros.topics import COMMAND_TOPIC
from selfcal_ros.units import NS_PER_S, S_PER_NS

JOURNAL = re.compile(r"journal_\d{8}T\d{6}Z(_\d+)?")
"""Name of a journal's folder. Others in the same place are recordings of somebody else."""
SYNC_PERIOD_S = 0.5
"""Period of synchronisation with the disk, if there is anything to synchronise."""
OVER = (Phase.DONE, Phase.ABORT)


def resume(folder: str | os.PathLike) -> "Journal | None":
    """Return the journal of the running plan, ready to continue; None if there is none.

    It is the journal in `folder` that was written last, unless its last command, by stamp, is
    DONE or ABORT or is in the future. Read it first (`BagReader(path).columns()`), then write.

    Parameters
    ----------
    folder : path
        Folder of the journals, each a bag folder; need not exist.

    Raises
    ------
    InputError
        If another process writes this journal, it is another recorder's, or it cannot be read or
        written.
    """
    journal = claim(folder)
    return journal.resume() if journal else None


class Claim:
    """The newest journal of a folder, locked against other writers. It is read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _as_input_error(path):
            _refuse_other_recordings(path)
            self._lock = _locked(path)

    def resume(self) -> "Journal | None":
        """Return the journal like `resume`: all of it is read, some seconds per GB."""
        with _as_input_error(self.path):
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
        """Release a journal that is not resumed."""
        os.close(self._lock)


def claim(folder: str | os.PathLike) -> Claim | None:
    """Return the newest journal in `folder` before it is read; None if there is none.

    Raises
    ------
    InputError
        If another process writes this journal, it is another recorder's, or the folder cannot be
        read.
    """
    journals = newest(folder)
    return Claim(journals[0]) if journals else None


def unfinished(folder: str | os.PathLike, journal: Path | None = None) -> list[Path]:
    """Return the files of the journal that `resume` would continue, in their order; [] = none.

    Nothing is written: the journal can be used even on a full disk.

    Parameters
    ----------
    folder : path
        Folder of the journals, each a bag folder; need not exist.
    journal : Path, optional
        The journal; None = the newest.

    Raises
    ------
    InputError
        If the journal cannot be read.
    """
    bag = Path(folder)
    try:
        newest_journal = journal or _newest(bag)[1]
        if newest_journal is None:
            return []
        bag = newest_journal
        files = _files(newest_journal)
        commands = [
            command
            for file in files
            for command in _commands(scan_file(file, COMMAND_TOPIC), str(file))
        ]
    except OSError as error:
        raise InputError(
            str(bag),
            f"the journal cannot be read ({error.strerror})",
            "correct that, then restart the collector",
        ) from error
    return [] if _is_over(sorted(commands)) else files


def newest(folder: str | os.PathLike) -> tuple[Path, float] | None:
    """Return the journal in `folder` that was written last, and the time since, s.

    Raises
    ------
    InputError
        If the folder cannot be read.
    """
    with _as_input_error(Path(folder)):
        written_ns, bag = _newest(Path(folder))
    return (bag, max(time.time_ns() - written_ns, 0) * S_PER_NS) if bag else None


def start(folder: str | os.PathLike, now_ns: int) -> "Journal":
    """Start a new journal in `folder`, created if necessary, named by the time.

    Raises
    ------
    InputError
        If it cannot be created.
    """
    name = time.strftime("journal_%Y%m%dT%H%M%SZ", time.gmtime(now_ns // NS_PER_S))
    for suffix in ("", *(f"_{number}" for number in range(2, 1000))):
        with suppress(FileExistsError):
            return create(Path(folder) / (name + suffix))
    raise InputError(str(folder), f"holds a thousand journals of {name}", "remove some")


def create(bag: Path) -> "Journal":
    """Start a new journal that is the bag folder `bag`.

    Raises
    ------
    FileExistsError
        If it exists.
    InputError
        If it cannot be created.
    """
    try:
        bag.mkdir(parents=True)
    except FileExistsError:
        raise
    except OSError as error:
        raise InputError(
            str(bag), f"cannot be created ({error.strerror})", "name a writable folder"
        ) from error
    with _as_input_error(bag):
        lock = _locked(bag)
        try:
            return Journal(bag, lock, Metadata())
        except BaseException:
            os.close(lock)
            with suppress(OSError):
                bag.rmdir()
            raise


def remove_unbegun(bag: Path) -> None:
    """Remove a bag folder whose writer was killed before its first file was whole.

    Raises
    ------
    InputError
        If another process writes it.
    """
    lock = _locked(bag)
    try:
        files = list(bag.iterdir())
        if all(path.suffix == UNFINISHED for path in files):
            for path in files:
                path.unlink()
            bag.rmdir()
    finally:
        os.close(lock)


class Journal(Closing):
    """Write raw messages to a bag folder; created by `start` or `resume`, must be closed.

    Parameters
    ----------
    path : Path
        The bag folder.
    lock : int
        The open lock on it, which the journal closes.
    metadata : Metadata
        Existing files and topics.

    Attributes
    ----------
    earlier : list of Path
        Existing files, in their order.
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
        for topic, bag_topic in metadata.topics.items():
            self._declare(topic, bag_topic)
        metadata.write(path)
        self._stop = threading.Event()
        # time since which there is something to synchronise
        self._unsynced_s: float | None = None
        # the same for the synchronisation in progress
        self._syncing_s: float | None = None
        self._syncer = threading.Thread(
            target=self._sync_on, name="journal", daemon=True
        )
        self._syncer.start()

    def add_topic(
        self, topic: str, typename: str, qos: Sequence[dict] = (), heard_on: str = ""
    ) -> None:
        """Declare a topic, with its namespace, before its first message; repeated calls do nothing.

        A topic of the contract is identified by its name: a remapped one is declared with its
        original name, and the other one as `heard_on`.

        Raises
        ------
        InputError
            If the type is not known, or the journal cannot be written.
        """
        if topic in self._channels:
            return
        definition_of(topic, typename)  # refuses an unknown type
        bag_topic = self._metadata.topics.setdefault(
            topic, BagTopic(typename, list(qos), heard_on=heard_on)
        )
        self._declare(topic, bag_topic)

    def _declare(self, topic: str, bag_topic: BagTopic) -> None:
        number = len(self._channels) + 1
        definition = definition_of(topic, bag_topic.type)
        schema = Schema(
            id=number, name=bag_topic.type, encoding="ros2msg", data=definition.encode()
        )
        channel = Channel(
            id=number,
            topic=topic,
            message_encoding="cdr",
            schema_id=number,
            metadata=bag_topic.channel_metadata(),
        )
        self.flush()
        with _as_input_error(self.path):
            self._file.append(records(schema, channel))
        self._file.content.declare(schema)
        self._file.content.declare(channel)
        self._channels[topic] = number

    def write(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Take one message, as received; it is safe once `flush` has returned."""
        self._waiting.append((topic, data, log_time_ns))

    def flush(self) -> None:
        """Write the messages taken, all at once; they are on the disk within a second.

        Call it before using them.

        Raises
        ------
        InputError
            If the disk is full or fails: the messages since the last flush are not in the
            journal and are counted in `n_lost`.
        """
        waiting = self._waiting
        self._waiting = []
        with _as_input_error(self.path):
            if waiting:
                self._append(waiting)
                self._n_appended += len(waiting)
                self._unsynced_s = self._unsynced_s or time.monotonic()
            failed = self._failed
            self._failed = None
            if failed is not None:
                raise failed

    def _append(self, waiting: list[tuple[str, bytes, int]]) -> None:
        records: list[bytes] = []
        times: dict[str, list[int]] = {
            topic: [] for topic in {item[0] for item in waiting}
        }
        for topic, data, log_time_ns in waiting:
            records.append(
                message_record(
                    self._channels[topic], self._sequence[topic], log_time_ns, data
                )
            )
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
        """Synchronise with the disk, in a separate thread, as it may be slow."""
        while not self._stop.wait(SYNC_PERIOD_S):
            if self._unsynced_s is not None:
                since, n_appended = self._unsynced_s, self._n_appended
                self._syncing_s, self._unsynced_s = since, None
                try:
                    self._file.sync()
                except OSError as error:
                    # it may be dropped, and later syncs do not report it
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
        """Age of the oldest flushed message that is not on the disk, s; 0 = none."""
        since = [
            when for when in (self._syncing_s, self._unsynced_s) if when is not None
        ]
        return time.monotonic() - min(since) if since else 0.0

    def close(self) -> None:
        """Complete the file and write metadata.yaml; repeated calls do nothing."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._syncer.join()
        try:
            self.flush()
        finally:
            with _as_input_error(self.path):
                try:
                    self._file.close()
                finally:
                    os.close(self._lock)
            self._metadata.write(self.path)


def _as_input_error(path: Path) -> AbstractContextManager[None]:
    """Convert a full disk or a missing folder to an InputError."""
    return writing(path, "the journal cannot be written")


def _taken_up(bag: Path) -> tuple[Metadata, list[tuple[int, Phase]]]:
    """Complete the existing files; return their metadata, and their commands by stamp."""
    metadata = Metadata()
    commands: list[tuple[int, Phase]] = []
    for file in _files(bag):
        content = finish_file(file, COMMAND_TOPIC)
        metadata.files.append(content.entry)
        for channel in content.channels.values():
            schema = content.schemas.get(channel.schema_id)
            if schema is not None:
                qos = (
                    yaml.safe_load(channel.metadata.get("offered_qos_profiles", ""))
                    or []
                )
                topic = metadata.topics.setdefault(
                    channel.topic,
                    BagTopic(
                        schema.name, qos, heard_on=channel.metadata.get("heard_on", "")
                    ),
                )
                topic.count += content.counts.get(channel.id, 0)
        commands += _commands(content, str(file))
    return metadata, sorted(commands)


def _is_over(commands: list[tuple[int, Phase]]) -> bool:
    """Return whether the last command, by stamp, ends a run, or would hide every later run."""
    latest_ns = time.time_ns() + MAX_AHEAD_NS
    return bool(commands) and (commands[-1][1] in OVER or commands[-1][0] > latest_ns)


def _refuse_other_recordings(bag: Path) -> None:
    """Refuse the folder of another recorder, which may still write: it would be cut off."""
    for file in _files(bag):
        if is_of_another_recorder(file):
            raise InputError(
                str(file),
                "is not of a journal: another recorder writes it, or wrote it",
                "move its folder elsewhere, or name another folder for the journal",
            )


def _locked(path: Path) -> int:
    """Return a lock on a folder; the system releases it when the process ends."""
    lock = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        portable.lock(lock)
    except BlockingIOError as error:
        os.close(lock)
        raise InputError(
            str(path),
            "another process writes this journal",
            "end it or name another folder",
        ) from error
    return lock


def _newest(folder: Path) -> tuple[int, Path | None]:
    """Return the last time of writing, ns, of a journal in `folder`, and that journal."""
    written: list[tuple[int, Path]] = []
    with suppress(FileNotFoundError, NotADirectoryError):
        for bag in folder.iterdir():
            if JOURNAL.fullmatch(bag.name):
                written += [(file.stat().st_mtime_ns, bag) for file in _files(bag)]
    return max(written, default=(0, None))


def _files(bag: Path) -> list[Path]:
    """Return the files of a journal in their order; a pipe would be waited for."""
    files = bag.glob(f"{bag.name}_*.mcap")
    return sorted((file for file in files if file.is_file()), key=_number)


def _number(file: Path) -> tuple[int, str]:
    number = re.search(r"_(\d+)\.mcap$", file.name)
    return int(number.group(1)) if number else -1, file.name


def _commands(content: Content, where: str) -> list[tuple[int, Phase]]:
    """Return stamps and phases of the commands; damaged ones are omitted."""
    phases: list[tuple[int, Phase]] = []
    bad: Counter = Counter()
    for number, data in content.kept:
        schema = content.schemas.get(content.channels[number].schema_id)
        if schema is None:
            continue
        with suppress(SelfcalError, ValueError):
            store = store_of_schema(
                schema.name, schema.encoding, schema.data.decode(), where
            )
            message = ChannelDecoder(
                COMMAND_TOPIC, schema.name, (store,), bad, told=True
            ).one(data)
            if message is not None:
                phases.append((stamp_ns(message), Phase(int(message.phase))))
    return phases
