# SPDX-License-Identifier: Apache-2.0
"""The journal of a collector: opened or taken up, kept in spite of a full disk, told in the health.

A journal that cannot be written ends nothing: what is not in it is counted and said.
"""

import errno
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from selfcal_ros.bagio.journal import Journal, resume, start, unfinished, written_ago_s
from selfcal_ros.bagio.offline import block_handlers
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.clock.steps import Step
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.errors import InputError
from selfcal_ros.messages.topics import INPUT_TOPICS
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports
from selfcal_ros.units import S_PER_H

RETRY_S = 10.0
"""Time after which a journal that could not be opened is tried again, and without failure a failure
is over."""
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
"""Errors that a disk may get over; others are those of the parameter."""


@dataclass(frozen=True)
class TakenUp:
    """What a journal that is taken up gave: a collector that has it, and what was lost of it.

    `steps` are those of clocks, by topic.
    """

    collector: Collector
    lost: tuple[str, ...]
    steps: dict[str, list[Step]] = field(default_factory=dict)


def take_up(files: list[Path], settings: CollectorSettings) -> TakenUp:
    """Return a collector with what the files of a journal hold; a file that cannot be read is lost.

    Parameters
    ----------
    files : list of Path
        Its MCAP files.
    settings : CollectorSettings
        Values of the collector's parameters.

    Raises
    ------
    InputError
        If none of them can be read.
    """
    collector = Collector(settings)
    lost: list[str] = []
    refused: list[InputError] = []
    steps: dict[str, list[Step]] = {}
    feed = block_handlers(collector, lost)
    for file in files:
        try:
            reader = BagReader(file, clock_limit_s=settings.clock_limit)
            for topic, item in reader.columns():
                feed[topic](item)
            lost += reader.lost
            for topic, found in reader.steps.items():
                steps.setdefault(topic, []).extend(found)
        except InputError as error:
            refused.append(error)
            lost.append(f"the file {file.name} was not read: {error.what}")
    if len(refused) == len(files):
        raise refused[0]
    return TakenUp(collector, tuple(lost), steps)


class KeptTopic(NamedTuple):
    """A topic of the contract in a journal: its name with the namespace, the QoS offered.

    `heard_on` is its name in the graph, where it is remapped.
    """

    name: str
    qos: dict
    heard_on: str = ""


class JournalKeeper:
    """Keeps a journal in a folder; a `Journal` may come, fail and come back.

    Parameters
    ----------
    folder : str
        Where journals lie; empty = keep none.
    topics : dict
        Topic of the contract -> what is kept of it.
    settings : CollectorSettings
        Values of the collector's parameters.
    ports : Ports
        Log and clocks.
    """

    def __init__(self, folder: str, topics: dict[str, KeptTopic],
                 settings: CollectorSettings, ports: Ports) -> None:
        self._folder, self._topics, self._ports = folder, topics, ports
        self._lag_limit_s = settings.journal_lag_limit
        self._max_age_s = settings.journal_max_age
        self._journal: Journal | None = None
        self._goes_on: list[Path] = []  # files that were taken up and could not be gone on with
        self._unwritten = 0  # while there was no journal
        self._n_taken = 0  # since the last flush
        self._problem, self._tried_s, self._failed_s = "", 0.0, 0.0

    @property
    def path(self) -> Path | None:
        """The bag folder that is written, None without one."""
        return self._journal.path if self._journal else None

    @property
    def lost(self) -> int:
        """Messages that are not in the journal and should be."""
        return self._unwritten + (self._journal.n_lost if self._journal else 0)

    def open(self) -> list[Path]:
        """Take up the journal of the run that is not over, or begin one; return its older files.

        Raises
        ------
        InputError
            If the folder cannot be used; not if the disk is full.
        """
        if not self._folder:
            return []
        is_old = False
        try:
            is_old = self._is_too_old()
            self._open(None if is_old else resume(self._folder))
        except InputError as error:
            if getattr(error.__cause__, "errno", None) not in NO_ROOM:
                raise
            self._fail(error)
            self._goes_on = [] if is_old else self._readable()
        return self._journal.earlier if self._journal else self._goes_on

    def _is_too_old(self) -> bool:
        """Tell if the newest journal was left so long ago that its run is not this one."""
        age_s = written_ago_s(self._folder)
        if age_s is None or age_s <= self._max_age_s:
            return False
        for file in self._readable()[:1]:
            self._ports.say(Level.WARN, f"{file.parent}: its run was left {age_s / S_PER_H:.0f} h "
                            "ago and is not taken up; 'selfcal solve' reads it, a greater "
                            "journal_max_age goes on with it")
        return True

    def _readable(self) -> list[Path]:
        """Return the files of the journal of the run that is not over, which needs no room."""
        try:
            return unfinished(self._folder)
        except InputError as error:
            self._ports.say(Level.WARN, f"{error}; the run is not taken up")
            return []

    def _open(self, journal: Journal | None) -> None:
        """Go on with a journal, or begin one."""
        journal = journal or start(self._folder, self._ports.now_ns())
        with ExitStack() as undo:
            undo.callback(_given_up, journal)
            for topic, typename in INPUT_TOPICS.items():
                kept = self._topics[topic]
                journal.add_topic(kept.name, typename, [kept.qos], kept.heard_on)
            undo.pop_all()
        self._journal = journal

    def write(self, topic: str, data: bytes, received_ns: int) -> None:
        """Take one message as received."""
        self._n_taken += 1
        if self._journal is not None:
            self._journal.write(self._topics[topic].name, data, received_ns)
        elif self._folder:
            self._unwritten += 1

    def flush(self) -> None:
        """Hand what was taken to the system; a failure is said once, and when it is over."""
        taken, self._n_taken = self._n_taken, 0
        try:
            if self._journal is None:
                self._try_again()
                return
            lost = self.lost
            self._journal.flush()
            if taken and self.lost == lost:
                self._is_written()
        except InputError as error:  # whatever it is: what was taken is to be used
            self._fail(error)

    def _try_again(self) -> None:
        if self._folder and self._ports.now_s() >= self._tried_s + RETRY_S:
            self._tried_s = self._ports.now_s()
            # into an older journal only what follows it: the session has what that one holds
            self._open(resume(self._folder) if self._goes_on else None)

    def _is_written(self) -> None:
        """Say that a failure is over, once nothing has failed for some time."""
        if self._problem and self._ports.now_s() >= self._failed_s + RETRY_S:
            self._problem = ""
            self._ports.say(Level.WARN, f"{self.path}: the journal is written again; "
                            f"{self.lost} messages are not in it")

    def _fail(self, error: InputError) -> None:
        self._tried_s = self._failed_s = self._ports.now_s()
        if not self._problem:
            self._ports.say(Level.WARN, f"{error}; collecting goes on without")
        self._problem = str(error)

    def close(self) -> None:
        """Give the journal its end."""
        if self._journal is not None:
            journal, self._journal = self._journal, None
            try:
                journal.close()
            except InputError as error:
                self._fail(error)
            self._unwritten += journal.n_lost

    def diagnosis(self) -> Diagnosis:
        """Return where the journal is, how far the disk lags, and what is not in it."""
        if not self._folder:
            return Diagnosis(Level.OK, "")
        lag_s = self._journal.lag_s if self._journal else 0.0
        wrong = [self._problem] if self._problem else []
        if self.lost:
            wrong.append(f"{self.lost} messages are not in the journal")
        if lag_s > self._lag_limit_s:
            wrong.append(f"the disk is {lag_s:.1f} s behind with the journal")
        return Diagnosis(Level.WARN if wrong else Level.OK, "; ".join(wrong), {
            "journal": str(self.path or ""), "journal_lag_s": f"{lag_s:.2f}",
            "journal_lost": self.lost})


def _given_up(journal: Journal) -> None:
    with suppress(InputError):
        journal.close()


def bad_input(bad: Counter) -> InputError | None:
    """Return an error that tells what could not be decoded and empties the count of it."""
    if not bad:
        return None
    line = "; ".join(f"{count} messages on {topic}" for (topic, _), count in bad.items())
    bad.clear()
    return InputError(line, "cannot be decoded", "correct their publisher")
