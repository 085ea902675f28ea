# SPDX-License-Identifier: Apache-2.0
"""The journal of a collector: opened or taken up, kept in spite of a full disk, told in the health.

A journal that cannot be written ends nothing: what is not in it is counted and said.
"""

import errno
from collections import Counter
from concurrent.futures import CancelledError, Executor, Future
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from selfcal_ros.bagio.journal import (
    Claim,
    Journal,
    claim,
    newest,
    resume,
    start,
    unfinished,
)
from selfcal_ros.bagio.offline import block_handlers
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.clock_steps import Step
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.settings.nodes import CollectorSettings
from selfcal_ros.errors import InputError
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports
from selfcal_ros.topics import INPUT_TOPICS
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


@dataclass(frozen=True)
class Looked:
    """What going through the newest journal gave.

    Attributes
    ----------
    journal : Journal or None
        The journal of the run that is not over, to be gone on with.
    files : list of Path
        Files of such a run: of the journal, or of one that cannot be written or is too old.
    error : InputError or None
        Why it cannot be written.
    problem : InputError or None
        Why it cannot be read either.
    """

    journal: Journal | None = None
    files: list[Path] = field(default_factory=list)
    error: InputError | None = None
    problem: InputError | None = None


def look_through(found: Claim | None, folder: str, left: Path | None = None) -> Looked:
    """Go through the newest journal of `folder`, which takes its time.

    Parameters
    ----------
    found : Claim or None
        That journal, to go on with it where its run is not over; None only looks.
    folder : str
        Where journals lie.
    left : Path, optional
        The journal that is only looked at, where it is no longer the newest.
    """
    error = None
    try:
        journal = found.resume() if found else None
        if found:
            return Looked(journal, journal.earlier if journal else [])
    except InputError as reason:
        error = reason
    try:
        return Looked(None, unfinished(folder, left), error)
    except InputError as problem:
        return Looked(None, [], error, problem)


class JournalKeeper:
    """Keeps a journal in a folder; a `Journal` may come, fail and come back.

    Until the newest journal has been gone through, what is to be written is held.

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
        self._looking: Future[Looked] | None = None
        self._claim: Claim | None = None
        self.looked_at = ""  # what is gone through
        self.away_s = 0.0  # since that was written last
        self._left_ago_s: float | None = None  # of a run that is too old to be taken up
        self._early: list[tuple[str, bytes, int]] = []  # came while the journal is gone through
        self._goes_on: list[Path] = []  # files that were taken up and could not be gone on with
        self._unwritten = 0  # while there was no journal
        self._n_taken = 0  # since the last flush
        self._problem, self._tried_s, self._failed_s = "", 0.0, 0.0

    @property
    def path(self) -> Path | None:
        """The bag folder that is written, None without one."""
        return self._journal.path if self._journal else None

    @property
    def is_wanted(self) -> bool:
        """Whether a journal is to be kept, be it that it cannot be written just now."""
        return bool(self._folder)

    @property
    def lost(self) -> int:
        """Messages that are not in the journal and should be."""
        return self._unwritten + (self._journal.n_lost if self._journal else 0)

    def open(self, worker: Executor) -> None:
        """Begin a journal, or have `worker` go through the one of a run that may not be over.

        Raises
        ------
        InputError
            If the folder cannot be used, or another process writes the journal; not if the disk
            is full.
        """
        if not self._folder:
            return
        self._claim, left = None, None
        try:
            known = newest(self._folder)
            self.away_s = known[1] if known is not None else 0.0
            if known is not None and known[1] > self._max_age_s:
                left, self._left_ago_s = known
            else:
                self._claim = claim(self._folder)
            if self._claim is None:
                self._open(None)
            if self._claim is None and left is None:
                return
        except InputError as error:
            if getattr(error.__cause__, "errno", None) not in NO_ROOM:
                raise
            self._fail(error)
        self.looked_at = str(self._claim.path if self._claim else self._folder)
        self._looking = worker.submit(look_through, self._claim, self._folder, left)

    @property
    def holds(self) -> bool:
        """Whether what comes is held until it is known if a run is to be gone on with."""
        return self._looking is not None and self._left_ago_s is None

    def earlier(self) -> list[Path]:
        """Return once the files of the run that is not over, as soon as they are known; else []."""
        if self._looking is None or not self._looking.done():
            return []
        looking, self._looking = self._looking, None
        try:
            looked = looking.result()
            return self._take_up(looked) if self._left_ago_s is None else self._tell_left(looked)
        finally:
            early, self._early = self._early, []
            for item in early:
                self.write(*item)

    def _take_up(self, looked: Looked) -> list[Path]:
        """Go on with what was found, or begin a journal; return the files of the run."""
        self._tell_problem(looked)
        try:
            if looked.error is not None:
                raise looked.error
            if not self._problem:
                self._open(looked.journal)
        except InputError as error:
            self._fail(error)
        if self._journal is None:
            self._goes_on = looked.files
        return looked.files

    def _tell_left(self, looked: Looked) -> list[Path]:
        """Say that a run was left too long ago to be taken up; return none of its files."""
        self._tell_problem(looked)
        for file in looked.files[:1]:
            self._ports.say(Level.WARN, f"{file.parent}: its run was left "
                            f"{(self._left_ago_s or 0.0) / S_PER_H:.0f} h ago and is not taken up; "
                            "'selfcal solve' reads it, a greater journal_max_age goes on with it")
        return []

    def _tell_problem(self, looked: Looked) -> None:
        if looked.problem is not None:
            self._ports.say(Level.WARN, f"{looked.problem}; the run is not taken up")

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
        if self.holds:
            self._early.append((topic, data, received_ns))
        elif self._journal is not None:
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
        if (self._folder and not self.holds
                and self._ports.now_s() >= self._tried_s + RETRY_S):
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
        """Give the journal its end; one that is still gone through first gets what has come."""
        if self._looking is not None:
            try:
                self._looking.result()
                self.earlier()
            except CancelledError:  # it was not begun
                self._unwritten += len(self._early)
                if self._claim is not None:
                    self._claim.close()
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
    line = "; ".join(f"{count} messages on {topic}{why}" for (topic, why), count in bad.items())
    bad.clear()
    return InputError(line, "cannot be decoded", "correct their publisher")
