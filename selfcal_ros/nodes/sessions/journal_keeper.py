# SPDX-License-Identifier: Apache-2.0
"""The journal of a collector: started or resumed, tolerant of a full disk, with health.

Failure to write a journal stops nothing: missing messages are counted and reported.
"""

import errno
from collections import Counter
from concurrent.futures import CancelledError, Executor, Future
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from selfcal_ros.bagio import journal as journals
from selfcal_ros.bagio.offline import take_all
from selfcal_ros.bagio.reader import BagReader, step_watches
from selfcal_ros.collection.clock_steps import ClockStep
from selfcal_ros.collection.collector import Collector
from selfcal_ros.errors import InputError
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, Ports
from selfcal_ros.outputs import FULL
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import INPUT_TOPICS
from selfcal_ros.units import S_PER_H

RETRY_S = 10.0
"""Time after which opening a journal is retried, and time without failure after which a failure
is over."""
NO_ROOM = (*FULL, errno.EIO, errno.EROFS)
"""Errors of the disk that may pass; others are due to the parameter."""


@dataclass(frozen=True)
class ResumedRun:
    """Content of a resumed journal: a collector with its messages, and losses.

    `steps` are clock steps, by topic.
    """

    collector: Collector
    lost: tuple[str, ...]
    steps: dict[str, list[ClockStep]] = field(default_factory=dict)


def take_up(files: list[Path], settings: CollectorSettings) -> ResumedRun:
    """Return a collector with the messages of a journal's files; unreadable files are lost.

    Parameters
    ----------
    files : list of Path
        The MCAP files.
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
    steps: dict[str, list[ClockStep]] = {}
    watches = step_watches(settings.clock_limit)
    for file in files:
        try:
            reader = BagReader(
                file, clock_limit_s=settings.clock_limit, watches=watches
            )
            take_all(reader, collector, lost)
            lost += reader.lost
            for topic, stamped_steps in reader.steps.items():
                steps.setdefault(topic, []).extend(stamped_steps)
        except InputError as error:
            refused.append(error)
            lost.append(f"the file {file.name} was not read: {error.what}")
    if len(refused) == len(files):
        raise refused[0]
    return ResumedRun(collector, tuple(lost), steps)


class KeptTopic(NamedTuple):
    """A topic of the contract in a journal: its name with the namespace, and offered QoS.

    `heard_on` is its name in the graph, if remapped.
    """

    name: str
    qos: dict
    heard_on: str = ""


@dataclass(frozen=True)
class JournalSearch:
    """Result of reading the newest journal.

    Attributes
    ----------
    journal : Journal or None
        The journal of an unfinished run, to be continued.
    files : list of Path
        Files of such a run: of the journal, or of one that cannot be written or is too old.
    error : InputError or None
        Why it cannot be written.
    problem : InputError or None
        Why it cannot even be read.
    """

    journal: journals.Journal | None = None
    files: list[Path] = field(default_factory=list)
    error: InputError | None = None
    problem: InputError | None = None


def search_journal(
    found: journals.Claim | None, folder: str, left: Path | None = None
) -> JournalSearch:
    """Read the newest journal of `folder`, which may take long.

    Parameters
    ----------
    found : Claim or None
        That journal, to be continued if its run is not over; None = only read.
    folder : str
        Folder of the journals.
    left : Path, optional
        The journal to be only read, if it is no longer the newest.
    """
    error = None
    try:
        journal = found.resume() if found else None
        if found:
            return JournalSearch(journal, journal.earlier if journal else [])
    except InputError as reason:
        error = reason
    try:
        return JournalSearch(None, journals.unfinished(folder, left), error)
    except InputError as problem:
        return JournalSearch(None, [], error, problem)


class JournalKeeper:
    """Keep a journal in a folder, tolerating failures of the `Journal`.

    Messages are held in memory until the newest journal has been read.

    Parameters
    ----------
    folder : str
        Folder of the journals; empty = none.
    topics : dict
        Topic of the contract -> its declaration in the journal.
    settings : CollectorSettings
        Values of the collector's parameters.
    ports : Ports
        Log and clocks.
    """

    def __init__(
        self,
        folder: str,
        topics: dict[str, KeptTopic],
        settings: CollectorSettings,
        ports: Ports,
    ) -> None:
        self._folder, self._topics, self._ports = folder, topics, ports
        self._lag_limit_s = settings.journal_lag_limit
        self._max_age_s = settings.journal_max_age
        self._journal: journals.Journal | None = None
        self._looking: Future[JournalSearch] | None = None
        self._claim: journals.Claim | None = None
        self.looked_at = ""  # being read
        self.away_s = 0.0  # since that was last written
        self._left_ago_s: float | None = None  # of a run too old to be resumed
        self._early: list[
            tuple[str, bytes, int]
        ] = []  # received while the journal is read
        self._goes_on: list[
            Path
        ] = []  # files that were read but could not be continued
        self._unwritten = 0  # while there was no journal
        self._n_taken = 0  # since the last flush
        self._problem, self._tried_s, self._failed_s = "", 0.0, 0.0

    @property
    def path(self) -> Path | None:
        """The bag folder being written, or None."""
        return self._journal.path if self._journal else None

    @property
    def is_wanted(self) -> bool:
        """Whether a journal is requested, even if it cannot be written now."""
        return bool(self._folder)

    @property
    def lost(self) -> int:
        """Messages missing in the journal."""
        return self._unwritten + (self._journal.n_lost if self._journal else 0)

    def open(self, worker: Executor) -> None:
        """Start a journal, or have `worker` read that of a run that may be unfinished.

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
            newest = journals.newest(self._folder)
            self.away_s = newest[1] if newest is not None else 0.0
            if newest is not None and newest[1] > self._max_age_s:
                left, self._left_ago_s = newest
            else:
                self._claim = journals.claim(self._folder)
            if self._claim is None:
                self._open(None)
            if self._claim is None and left is None:
                return
        except InputError as error:
            if getattr(error.__cause__, "errno", None) not in NO_ROOM:
                # else one would be started beside it, and be the newest
                self._folder = ""
                raise
            self._fail(error)
        self.looked_at = str(self._claim.path if self._claim else self._folder)
        self._looking = worker.submit(search_journal, self._claim, self._folder, left)

    @property
    def holds(self) -> bool:
        """Whether messages are held until it is known if a run is to be resumed."""
        return self._looking is not None and self._left_ago_s is None

    def earlier(self) -> list[Path]:
        """Return once the files of the unfinished run, as soon as they are known; else []."""
        if self._looking is None or not self._looking.done():
            return []
        looking = self._looking
        self._looking = None
        try:
            looked = looking.result()
            return (
                self._take_up(looked)
                if self._left_ago_s is None
                else self._tell_left(looked)
            )
        finally:
            early = self._early
            self._early = []
            for item in early:
                self.write(*item)

    def _take_up(self, looked: JournalSearch) -> list[Path]:
        """Continue the journal found, or start one; return the files of the run."""
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

    def _tell_left(self, looked: JournalSearch) -> list[Path]:
        """Report that a run is too old to be resumed; return none of its files."""
        self._tell_problem(looked)
        for file in looked.files[:1]:
            self._ports.say(
                Level.WARN,
                f"{file.parent}: its run was left "
                f"{(self._left_ago_s or 0.0) / S_PER_H:.0f} h ago and is not resumed; "
                "'selfcal solve' reads it, a larger journal_max_age resumes it",
            )
        return []

    def _tell_problem(self, looked: JournalSearch) -> None:
        if looked.problem is not None:
            self._ports.say(Level.WARN, f"{looked.problem}; the run is not resumed")

    def _open(self, journal: journals.Journal | None) -> None:
        """Continue a journal, or start one."""
        journal = journal or journals.start(self._folder, self._ports.now_ns())
        with ExitStack() as undo:
            undo.callback(_given_up, journal)
            for topic, typename in INPUT_TOPICS.items():
                topic_kept = self._topics[topic]
                journal.add_topic(
                    topic_kept.name, typename, [topic_kept.qos], topic_kept.heard_on
                )
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
        """Write the messages taken; a failure is reported once, and when it is over."""
        n_taken = self._n_taken
        self._n_taken = 0
        try:
            if self._journal is None:
                self._try_again()
                return
            lost = self.lost
            self._journal.flush()
            if n_taken and self.lost == lost:
                self._is_written()
        except InputError as error:  # in any case the messages taken are used
            self._fail(error)

    def _try_again(self) -> None:
        if (
            self._folder
            and not self.holds
            and self._ports.now_s() >= self._tried_s + RETRY_S
        ):
            self._tried_s = self._ports.now_s()
            # an older journal gets only later messages: the session has its content
            self._open(journals.resume(self._folder) if self._goes_on else None)

    def _is_written(self) -> None:
        """Report that a failure is over, after some time without one."""
        if self._problem and self._ports.now_s() >= self._failed_s + RETRY_S:
            self._problem = ""
            self._ports.say(
                Level.WARN,
                f"{self.path}: the journal is written again; {self.lost} messages are not in it",
            )

    def _fail(self, error: InputError) -> None:
        self._tried_s = self._failed_s = self._ports.now_s()
        if not self._problem:
            self._ports.say(Level.WARN, f"{error}; collecting continues without it")
        self._problem = str(error)

    def close(self) -> None:
        """Close the journal; one still being read first gets the held messages."""
        if self._looking is not None:
            try:
                self._looking.result()
                self.earlier()
            except CancelledError:  # it was not started
                self._unwritten += len(self._early)
                if self._claim is not None:
                    self._claim.close()
        if self._journal is not None:
            journal = self._journal
            self._journal = None
            try:
                journal.close()
            except InputError as error:
                self._fail(error)
            self._unwritten += journal.n_lost

    def diagnosis(self) -> Diagnosis:
        """Return path, lag of the disk, and missing messages of the journal."""
        if not self._folder:
            return Diagnosis(Level.OK, "")
        lag_s = self._journal.lag_s if self._journal else 0.0
        wrong = [self._problem] if self._problem else []
        if self.lost:
            wrong.append(f"{self.lost} messages are not in the journal")
        if lag_s > self._lag_limit_s:
            wrong.append(f"the disk is {lag_s:.1f} s behind with the journal")
        return Diagnosis.of(
            wrong,
            {
                "journal": str(self.path or ""),
                "journal_lag_s": f"{lag_s:.2f}",
                "journal_lost": self.lost,
            },
        )


def _given_up(journal: journals.Journal) -> None:
    with suppress(InputError):
        journal.close()


def bad_input(bad: Counter) -> InputError | None:
    """Return an error with the undecodable messages, and reset their count."""
    if not bad:
        return None
    line = "; ".join(
        f"{count} messages on {topic}{why}" for (topic, why), count in bad.items()
    )
    bad.clear()
    return InputError(line, "cannot be decoded", "correct their publisher")
