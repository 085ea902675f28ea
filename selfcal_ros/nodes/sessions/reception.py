# SPDX-License-Identifier: Apache-2.0
"""From the bytes received by a node to its session: to the journal first, then as columns.

Bytes are decoded like those of a bag, and passed to the collector in the same form, so a live
session and its journal cannot differ. The journal keeps every encoder sample around measurements
and a few per minute at rest: an encoder at 1 kHz would write 15 GB a day.
"""

import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages.cdr import Payloads
from selfcal_ros.bagio.messages.to_model import first_stamps_ns, frame_id
from selfcal_ros.bagio.offline import FROM_THE_FUTURE
from selfcal_ros.bagio.schemas import ChannelDecoder, typestore
from selfcal_ros.collection.encoder import LOOK_BACK_NS
from selfcal_ros.collection.inputs import MAX_AHEAD_NS, Phase
from selfcal_ros.errors import InputError, printable
from selfcal_ros.nodes.sessions.collecting import CollectingSession
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, merged
from selfcal_ros.nodes.sessions.journal_keeper import (
    JournalKeeper,
    ResumedRun,
    bad_input,
    take_up,
)
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
)
from selfcal_ros.units import NS_PER_S, S_PER_NS

REACH_NS = LOOK_BACK_NS + 10 * NS_PER_S
"""Time before and after a command or a detection, by reception, for which every sample is kept: the
range of the search for the direction of approach, plus the delay of messages."""
APART_NS, BURST = 60 * NS_PER_S, 50
"""Period of samples kept at rest, and number of consecutive ones: they
show the presence of the encoder, its rate, and steps of its clock."""
Sample = tuple[bytes, int]
"""Bytes, and the instant of reception, ns."""


class Reception:
    """Hold received messages until `drain`.

    Parameters
    ----------
    session : CollectingSession
        Gets blocks and commands.
    journal : JournalKeeper
        Gets the bytes beforehand.
    say : callable (level, line)
        Writes to the log.
    refuse : callable (place, error)
        Counts and reports unusable messages.
    """

    def __init__(
        self,
        session: CollectingSession,
        journal: JournalKeeper,
        *,
        say: Callable[[Level, str], None],
        refuse: Callable[[str, Exception], None],
    ) -> None:
        self.session, self.journal, self._say, self._refuse = (
            session,
            journal,
            say,
            refuse,
        )
        self._waiting: list[tuple[str, bytes, int, bool]] = []
        self._n_detections = 0  # waiting
        self._held: list[tuple[str, bytes, int, bool]] = []
        self._resting = Resting()
        self._worker: Executor | None = None
        self._restoring: Future[ResumedRun] | None = None
        self._source = ""  # the journal being resumed
        self._frame = ""  # of the newest detection
        self._bad: Counter = Counter()
        self._decoders = {
            topic: ChannelDecoder(topic, name, (typestore(),), self._bad, told=True)
            for topic, name in INPUT_TOPICS.items()
        }

    def open(self, worker: Executor) -> None:
        """Open the journal; an unfinished run in it is read by `worker`."""
        self._worker = worker
        self.journal.open(worker)
        self._source = self.journal.looked_at
        self._advance()

    def _advance(self) -> None:
        """Have the unfinished run read, once it is known that there is one."""
        try:
            files = self.journal.earlier()
        except Exception as error:
            # messages are used in any case, with or without journal
            self._refuse("journal", error)
            return
        if files and self._worker is not None:
            self._source = str(files[0].parent)
            self._restoring = self._worker.submit(take_up, files, self.session.settings)

    @property
    def restoring(self) -> bool:
        """Whether a journal is still being read."""
        return self.journal.holds or self._restoring is not None

    @property
    def may_end(self) -> bool:
        """Whether messages so far, including waiting ones, may complete the current view."""
        return not self.restoring and self.session.expects_end(self._n_detections)

    @property
    def n_waiting(self) -> int:
        """Messages received since the last `drain`."""
        return len(self._waiting)

    def encoder(self, data: bytes, received_ns: int) -> None:
        """Take a sensor_msgs/JointState as received."""
        self._waiting.append((ENCODER_TOPIC, data, received_ns, False))

    def detection(self, data: bytes, received_ns: int) -> None:
        """Take a selfcal_msgs/MarkDetection as received."""
        self._waiting.append((DETECTION_TOPIC, data, received_ns, False))
        self._n_detections += 1

    def command(
        self, data: bytes, is_older: bool, received_ns: int | None = None
    ) -> None:
        """Take a selfcal_msgs/ViewCommand as received, now unless another instant is given.

        `is_older`: published before this node subscribed.
        """
        when_ns = time.time_ns() if received_ns is None else received_ns
        self._waiting.append((COMMAND_TOPIC, data, when_ns, is_older))

    def drain(self) -> bool:
        """Write messages to the journal, then pass them to the session; return if counts changed.

        While a journal is being resumed, messages are written and held back.
        """
        adopted, came, self._waiting, self._n_detections = False, self._waiting, [], 0
        detections = [data for topic, data, _, _ in came if topic == DETECTION_TOPIC]
        if detections:
            self._frame = frame_id(detections[-1])
        waiting = self._believable(came)
        self._advance()
        self._write(waiting)
        try:
            self.journal.flush()
        except Exception as error:
            # messages are used in any case, with or without journal
            self._refuse("journal", error)
        if self.restoring:
            self._held += waiting
            if self._restoring is None or not self._restoring.done():
                return False
            waiting = []
            self._adopt(self._restoring)
            adopted = True
        waiting = [*self._held, *waiting]
        self._held = []
        self._feed(waiting)
        return adopted or bool(came)

    def _believable(
        self, waiting: list[tuple[str, bytes, int, bool]]
    ) -> list[tuple[str, bytes, int, bool]]:
        """Return messages not stamped in the future of this node; the rest is counted and reported.

        Nor are they in the journal: they would hide later messages stamped by a correct clock,
        even after a restart.
        """
        if not waiting:
            return []
        now_ns = self.session.now_ns
        stamps, stamped = first_stamps_ns(
            Payloads.joined([item[1] for item in waiting])
        )
        ahead = np.zeros(len(waiting), dtype=np.int64)
        ahead[stamped] = stamps - now_ns
        refused = (ahead > MAX_AHEAD_NS) & (now_ns > 0)
        if not refused.any():
            return waiting
        topics = np.array([item[0] for item in waiting])
        for topic in np.unique(topics[refused]).tolist():
            mine = refused & (topics == topic)
            kind, reason = FROM_THE_FUTURE[topic]
            self.session.collector.refuse(kind, reason, int(mine.sum()))
            self._refuse(
                topic,
                InputError(
                    topic,
                    f"stamped {ahead[mine].max() * S_PER_NS:.0f} s ahead of this node's clock: "
                    "not used",
                    "set the clock that stamps it; correctly stamped messages are used",
                ),
            )
        return [
            item
            for item, left_out in zip(waiting, refused, strict=True)
            if not left_out
        ]

    def _write(self, waiting: list[tuple[str, bytes, int, bool]]) -> None:
        """Pass messages to the journal; only a few samples of an encoder at rest."""
        if not self.journal.is_wanted:
            return
        newest = self.session.collector.newest_command
        measuring = self.restoring or (
            newest is not None and newest.phase == Phase.MEASURE
        )
        for topic, data, received_ns, _ in waiting:
            if topic == ENCODER_TOPIC:
                samples = self._resting.sample(data, received_ns, measuring=measuring)
            else:
                samples = self._resting.wake(received_ns)
            for sample in samples:
                self.journal.write(ENCODER_TOPIC, *sample)
            if topic != ENCODER_TOPIC:
                self.journal.write(topic, data, received_ns)

    def _adopt(self, reading: Future[ResumedRun]) -> None:
        """Continue from the content of the journal."""
        self._restoring = None
        try:
            run = reading.result()
        except Exception as error:  # an unreadable journal stops nothing
            self._refuse("journal", error)
            return
        self.session.adopt(run.collector, self._source, run.steps, self.journal.away_s)
        for line in run.lost:
            self._say(Level.WARN, f"{self._source}: {line}")

    def _feed(self, waiting: list[tuple[str, bytes, int, bool]]) -> None:
        for _, data, _, is_older in (
            item for item in waiting if item[0] == COMMAND_TOPIC
        ):
            message = self._decoders[COMMAND_TOPIC].one(data)
            if message is not None:
                self._guarded(
                    COMMAND_TOPIC, self.session.take_command, message, is_older
                )
        now_ns = time.time_ns()
        for topic, take in (
            (ENCODER_TOPIC, self.session.take_encoder),
            (DETECTION_TOPIC, self.session.take_detections),
        ):
            mine = [item for item in waiting if item[0] == topic]
            if mine:
                ages_ns = now_ns - np.array([item[2] for item in mine])
                for block in self._decoders[topic].many(
                    Payloads.joined([m[1] for m in mine])
                ):
                    self._guarded(topic, take, block, ages_ns)
        error = bad_input(self._bad)
        if error is not None:
            self._refuse("decoding", error)

    def _guarded(self, place: str, take: Callable[..., None], *what: Any) -> None:
        try:
            take(*what)
        except Exception as error:  # no message may end a node
            self._refuse(place, error)

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of the journal and of the frames."""
        diagnosis = self.journal.diagnosis()
        if self.restoring:
            diagnosis = Diagnosis(
                Level.WARN, f"reading the journal {self._source}", diagnosis.values
            )
        stage_frame = self.session.settings.frame_id
        if self._frame in ("", stage_frame):
            return diagnosis
        # joint states have none: broadcasters name there the base of their robot
        other_frame = (
            f"{DETECTION_TOPIC} names the frame '{printable(self._frame)}', but is used "
            f"in {stage_frame!r}: transform it first, or set frame_id if it is the stage's"
        )
        return merged(diagnosis, [Diagnosis(Level.WARN, other_frame)])

    def close(self) -> None:
        """Take waiting messages, and close the journal."""
        self.drain()
        for sample in self._resting.end():
            self.journal.write(ENCODER_TOPIC, *sample)
        self.journal.close()


class Resting:
    """Hold back the newest samples while nothing is measured."""

    def __init__(self) -> None:
        self._held: deque[Sample] = deque()
        self._until_ns: int | None = None  # all is kept up to here
        self._burst_ns: int | None = None  # begin of the newest burst kept at rest
        self._rest_of_burst = 0

    def wake(self, received_ns: int) -> list[Sample]:
        """Record a command or a detection; return the held samples, oldest first."""
        self._until_ns = received_ns + REACH_NS
        return self.end()

    def end(self) -> list[Sample]:
        """Return and release the held samples, oldest first."""
        samples = self._held
        self._held = deque()
        return [*samples]

    def sample(self, data: bytes, received_ns: int, *, measuring: bool) -> list[Sample]:
        """Take a sample; return those to be kept now, oldest first."""
        if measuring or (self._until_ns is not None and received_ns <= self._until_ns):
            return [*self.end(), (data, received_ns)]
        self._held.append((data, received_ns))
        samples = []
        while abs(received_ns - self._held[0][1]) > REACH_NS:  # a clock may be set back
            oldest = self._held.popleft()
            if self._is_kept(oldest[1]):
                samples.append(oldest)
        return samples

    def _is_kept(self, received_ns: int) -> bool:
        """Return whether to keep a sample that is too old to be needed."""
        if self._burst_ns is None or abs(received_ns - self._burst_ns) >= APART_NS:
            self._burst_ns, self._rest_of_burst = received_ns, BURST
        self._rest_of_burst -= 1
        return self._rest_of_burst >= 0
