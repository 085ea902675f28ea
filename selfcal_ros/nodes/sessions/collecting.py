# SPDX-License-Identifier: Apache-2.0
"""The session of measurement_collector: publication of the readings."""

import math
import statistics
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.bagio.offline import FROM_THE_FUTURE
from selfcal_ros.collection.clock_steps import ClockStep, future_lines, step_lines
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, EncoderBlock, Phase, Reason, advice
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.readings import (
    Measurements,
    placing_digest,
    session_digest,
    view_digest,
)
from selfcal_ros.nodes.sessions.clocks import ClockWatch, RunWatch
from selfcal_ros.nodes.sessions.health import (
    CellChecks,
    Diagnosis,
    Level,
    Ports,
    Rate,
    merged,
)
from selfcal_ros.nodes.sessions.progress import counted_reasons, progress_line
from selfcal_ros.nodes.sessions.rejections import RejectionWatch
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import DETECTION_TOPIC, ENCODER_TOPIC
from selfcal_ros.units import MS_PER_S, NS_PER_S, S_PER_NS, UM_PER_M

HEARD_S = 1.0
"""Time without an encoder sample after which the encoder counts as silent."""
STUCK_S = 5.0
"""Time without a new reading after which a view is stuck: its missing marks are named."""
PROGRESS_S = 0.5
"""Shortest time between two lines of progress."""
Age = int | np.ndarray
"""Time since the reception of messages, ns: of the newest, or int64 array of each, newest last."""


class CollectingSession:
    """Feed a `Collector`; publish ``status``, ``progress``, and ``measurement`` of complete views.

    Parameters
    ----------
    settings : CollectorSettings
        Values of the collector's parameters.
    ports : Ports
        Publishes ``status``, ``measurement`` and ``progress``.
    """

    def __init__(self, settings: CollectorSettings, ports: Ports) -> None:
        self.settings, self._ports = settings, ports
        self.collector = Collector(settings)
        self._dirty, self._next_status, self._rested = False, 0.0, 0.0
        self._needed = 0  # readings needed to complete the open view
        self._moved = (-1, 0, 0.0)  # the open view, its readings needed, and since when
        self._named = False  # as stuck, since then
        self._line, self._told_line, self._told_s = "", "", float("-inf")
        self._unseen: list[
            np.ndarray
        ] = []  # its detections since the last status, by their stamps
        self._since_ns = 0  # its beginning
        # time, and CPU time
        self._costs: deque[tuple[float, float]] = deque(maxlen=1000)
        self._published: dict[int, str] = {}
        self._run = ("", "")
        self._rejections = RejectionWatch(ports.say, ports.now_s)
        self._stepped: list[str] = []
        self._checks = CellChecks(ports.say)
        self._noted: list[str] = []  # notes on clocks in the readings sent last
        self._clock = ClockWatch(settings.clock_limit)
        self._runs, self._run_lines = RunWatch(), dict[str, str]()
        self._encoder_rate = Rate(ports.now_s)
        self._encoder_s = float("-inf")
        self._noise: tuple[float, float] = (math.nan, math.nan)
        self.missed: dict[
            tuple[str, int], str
        ] = {}  # views that began before this node
        self._placed: set[tuple[str, int]] = set()
        self._gap, self._gap_stamp_ns = "", 0  # reported until the next command
        self._problem = ""
        self._state = "waiting for a MEASURE command"
        self._rejected: Counter = Counter()

    @property
    def now_ns(self) -> int:
        """The time of this node, ns."""
        return self._ports.now_ns()

    def take_encoder(self, block: EncoderBlock, age_ns: Age = 0) -> None:
        """Take encoder samples, received `age_ns` ago: each of them, or the newest."""
        if not len(block):
            return
        self._encoder_s = (
            self._ports.now_s() - int(np.atleast_1d(age_ns)[-1]) * S_PER_NS
        )
        self.collector.add_encoder_block(block)
        self._encoder_rate.add(block.stamps_ns)
        self._note_clock(ENCODER_TOPIC, block.stamps_ns, age_ns)
        self._dirty = True

    def take_detections(self, table: np.ndarray, age_ns: Age = 0) -> None:
        """Take detections (`collection.inputs.DETECTION`), received as in `take_encoder`."""
        if not len(table):
            return
        self.collector.add_detection_block(table)
        self._note_clock(DETECTION_TOPIC, table["stamp"], age_ns)
        self._unseen.append(table["stamp"][table["stamp"] >= self._since_ns])
        self._dirty = True

    def _note_clock(self, topic: str, stamps_ns: np.ndarray, age_ns: Age) -> None:
        """Compare stamps with their reception."""
        ages = np.atleast_1d(age_ns)
        # for another number of messages: that of the newest
        if len(ages) != len(stamps_ns):
            ages = ages[-1:]
            stamps_ns = stamps_ns.max(keepdims=True)
        self._clock.data(
            topic,
            stamps_ns,
            self._ports.now_ns() - ages,
            round(self._ports.now_s() * NS_PER_S) - ages,
        )

    def adopt(
        self,
        collector: Collector,
        journal: str,
        steps: Mapping[str, list[ClockStep]] | None = None,
        away_s: float = 0.0,
    ) -> None:
        """Continue with a collector that has taken the run from a journal.

        Parameters
        ----------
        collector : Collector
            Has the content of the journal.
        journal : str
            Its name.
        steps : dict, optional
            Topic -> clock steps in the journal.
        away_s : float
            Time since the journal was written last.
        """
        self.collector, self._dirty, self._next_status = collector, True, 0.0
        last = collector.newest_command
        if last is not None:
            self._clock.adopt(last.run_id, steps or {})
        where = "between views"
        if last is not None and last.phase == Phase.MEASURE:
            self._gap_stamp_ns, view = last.stamp_ns, last.placed().name
            self._gap = (
                f"view '{view}': detections of {away_s:.1f} s without a collector are "
                "lost, those of complete marks included"
            )
            where = (
                f"in view '{view}'; {self._gap}; missing marks have to be measured again, by "
                "the cell or with redo_view"
            )
        messages = sum(collector.received.values())
        self._ports.say(
            Level.OK, f"resumed {journal} with {messages} messages, {where}"
        )

    def take_command(self, message: Any, is_older: bool) -> None:
        """Take a selfcal_msgs/ViewCommand; `is_older`: published before this node listened."""
        try:
            command = to_model.command(message)
            repeated = self.collector.knows(command)
            self.collector.add_command(command)
            self._clock.command(
                command.stamp_ns,
                self._ports.now_ns(),
                is_older=is_older,
                run_id=command.run_id,
            )
            if not repeated:
                self._runs.command(command, self.collector.newest_command, self.now_ns)
                self._note_missed(command, is_older=is_older)
        except InputError:
            self.collector.refuse("command", Reason.COMMAND_BAD)
            raise
        finally:
            self._next_status = 0.0
            self._dirty = True

    def _note_missed(self, command: Command, *, is_older: bool) -> None:
        """Report views that began before this node: their earlier detections are missing."""
        view = (command.plan_id, command.view_index)
        if command.phase == Phase.PLACE and not is_older:
            self._placed.add(view)
        elif command.phase == Phase.MEASURE and view in self._placed:
            self.missed.pop(view, None)
        elif command.phase == Phase.MEASURE and is_older:
            self.missed[view] = name = command.placed().name
            self._ports.say(
                Level.WARN,
                f"view '{name}' began before this node: earlier detections are "
                "missing here; redo_view measures it again",
            )

    def tick(self) -> None:
        """Publish the progress of the views, if there are new messages and it is due."""
        now, worked = self._ports.now_s(), self._ports.cpu_s()
        self._tell_progress(now)
        if not self._dirty and not (self._is_stuck(now) and not self._named):
            self._rejections.tell()
            return
        early = now < self._next_status
        if early and not (now >= self._rested and self._may_complete()):
            return
        self._dirty, self._unseen = False, []
        try:
            measurements, progress = self.collector.collect()
        except NoDataError:
            self._rejected = Counter(self.collector.unusable)
            self._note_progress({}, now)
            return
        except InputError as error:  # valid for this run: report once
            if self._problem != str(error):
                self._problem = str(error)
                self._ports.say(Level.ERROR, f"{error}; then start a new run")
            return
        self._problem = ""
        self._note_progress(progress, now)
        self._publish(measurements, progress, final=False)
        self._describe(measurements, progress)
        spent = self._ports.now_s() - now
        self._costs.append((spent, self._ports.cpu_s() - worked))
        if early and self._needed:  # in vain: some detections were not readings
            self._rested = now + 5 * spent
        self._next_status = now + max(self.settings.status_period, 5 * spent)

    def _note_progress(self, progress: dict[int, ViewProgress], now_s: float) -> None:
        """Note when the open view had its last reading, and make its line."""
        command = self.collector.newest_command
        if command is None:
            return
        view = (
            progress.get(command.view_index) if command.phase == Phase.MEASURE else None
        )
        state = (command.view_index, 0 if view is None else view.needed)
        if state != self._moved[:2]:
            self._moved, self._named = (*state, now_s), False
        self._line = progress_line(command, view)
        self._tell_progress(now_s)

    def _is_stuck(self, now_s: float) -> bool:
        """Return whether readings are missing in the open view and none has come for long."""
        _, needed, since_s = self._moved
        return needed > 0 and now_s - since_s >= STUCK_S

    def _tell_progress(self, now_s: float) -> None:
        """Publish the line of progress, if it has changed and the last one is old enough."""
        if self._line != self._told_line and now_s - self._told_s >= PROGRESS_S:
            self._told_line, self._told_s = self._line, now_s
            self._ports.publish("progress", {"data": self._line})

    def expects_end(self, more: int = 0) -> bool:
        """Return whether the detections received and `more` may complete the view."""
        return 0 < self._needed <= sum(map(len, self._unseen)) + more

    def _may_complete(self) -> bool:
        """Return whether enough has been received, including later samples, to complete the view.

        A detection stamped in the future waits for its samples without delaying others.
        """
        until_ns = self.collector.encoder_until_ns
        return self.expects_end() and self._needed <= sum(
            int((stamps < until_ns).sum()) for stamps in self._unseen
        )

    def finish(self) -> str:
        """Publish every view as it is and return the digest of all readings."""
        measurements, progress = self.collector.collect()
        self._note_progress(progress, self._ports.now_s())
        self._publish(measurements, progress, final=True)
        return session_digest(self._published)

    def _publish(
        self,
        measurements: Measurements,
        progress: dict[int, ViewProgress],
        *,
        final: bool,
    ) -> None:
        timeline, frame_id = self.collector.timeline, self.settings.frame_id
        stuck = self._is_stuck(self._ports.now_s())
        self._named |= stuck
        if (timeline.plan_id, timeline.run_id) != self._run:
            self._run, self._published = (timeline.plan_id, timeline.run_id), {}
            self._noted = []
            self._rejections.restart()
        self._tell_runs()
        self._tell_steps()
        self._checks.take(measurements)
        ended = [
            index
            for index, view in progress.items()
            if final or view.end_ns <= timeline.last_stamp_ns
        ]
        self._rejections.take(
            self.collector.findings(measurements, progress),
            progress,
            ended,
            partial(self.collector.finding_of_last, progress),
            final=final,
        )
        for index, view in progress.items():
            stamp_ns = from_model.session_stamp_ns(timeline, view)
            if self._is_due(index, view, measurements, has_ended=index in ended):
                self._publish_readings(view, measurements, stamp_ns)
            # after the readings: a complete view can be solved
            current = index == timeline.intervals[-1].view_index or not view.complete
            if current or index == max(progress) or final:
                fields = from_model.view_status(
                    view,
                    timeline.plan_id,
                    stamp_ns,
                    frame_id,
                    run_id=timeline.run_id,
                    name_all=stuck or index in ended,
                )
                fields["complete"] &= not self._clock.ahead  # may be of another view
                self._ports.publish("status", fields)

    def _is_due(
        self,
        index: int,
        view: ViewProgress,
        measurements: Measurements,
        *,
        has_ended: bool,
    ) -> bool:
        """Return whether the readings of a view are to be published, which is then noted.

        That is: once the view has ended or is complete, and after every change.
        """
        timeline = self.collector.timeline
        # empty, unless a previous collector may have sent its readings
        is_worth = (
            view.readings.used
            or view.readings.rejected
            or index in self._published
            or (has_ended and (timeline.plan_id, index) not in self.missed)
        )
        key = view_digest(view.readings.parts, measurements.rejected)
        is_new = self._published.get(index) != key or self._noted != self._stepped
        if not (is_worth and is_new and (has_ended or view.complete)):
            return False
        self._published[index], self._noted = key, self._stepped
        return True

    def _publish_readings(
        self, view: ViewProgress, measurements: Measurements, stamp_ns: int
    ) -> None:
        """Publish the readings of a view, of each cell of its images by itself."""
        for part in view.readings.parts:
            of_part = replace(view, readings=part)
            fields = from_model.view_measurement(
                of_part, measurements, stamp_ns, self.settings.frame_id, self._stepped
            )
            self._ports.publish("measurement", fields)

    def _tell_steps(self) -> None:
        """Log once that a clock has stepped or is ahead; in the health until the run ends."""
        refused = self.collector.unusable
        lines = [
            *step_lines(self._clock.steps, self.collector.timeline),
            *future_lines(
                [
                    topic
                    for topic, (_, reason) in FROM_THE_FUTURE.items()
                    if refused.get(reason)
                ]
            ),
        ]
        for line in lines:
            if line not in self._stepped:
                self._ports.say(Level.WARN, line)
        self._stepped = lines

    def _tell_runs(self) -> None:
        """Log once why a run is not shown; in the health while it applies."""
        lines = self._runs.lines(
            self.collector.newest_command, self.collector.timeline.strays, self.now_ns
        )
        for fault, line in lines.items():
            if fault not in self._run_lines:  # durations change
                self._ports.say(Level.WARN, line)
        self._run_lines = lines

    def _describe(
        self, measurements: Measurements, progress: dict[int, ViewProgress]
    ) -> None:
        """Keep progress and rejections of the view for the diagnostics."""
        self._rejected = Counter(measurements.rejected)
        for view in progress.values():
            self._rejected.update(view.readings.rejected)
        index = self.collector.timeline.intervals[-1].view_index
        for number in sorted(progress):  # of the last view with one
            readings = progress[number].readings
            xy, theta = (
                new if math.isfinite(new) else old
                for new, old in zip(
                    (readings.sigma_xy, readings.sigma_theta), self._noise, strict=True
                )
            )
            self._noise = xy, theta
        self._needed = progress[index].needed if index is not None else 0
        self._since_ns = self.collector.timeline.intervals[-1].start_ns
        self._state = (
            "between views"
            if index is None
            else (
                f"view '{progress[index].view.name}': "
                f"{100 * progress[index].coverage:.0f} % of the readings taken"
            )
        )

    def diagnosis(self, *, detections_matched: bool) -> Diagnosis:
        """Return the diagnosis of the node.

        Parameters
        ----------
        detections_matched : bool
            Whether a publisher of detections has been found.
        """
        return merged(
            self._received(detections_matched=detections_matched),
            [
                Diagnosis.of(self._run_lines.values()),
                self._checks.diagnosis(),
                Diagnosis.of(self._rejections.findings or advice(self._rejected)),
                self._clock.diagnosis(),
                Diagnosis.of(self._stepped),
                self._encoder(),
                self._repeatability(),
            ],
        )

    def _received(self, *, detections_matched: bool) -> Diagnosis:
        """Return what has been received, WARN if some of it is missing or unusable."""
        missed = ", ".join(self.missed.values())
        last = self.collector.newest_command
        gap_lasts = last is not None and last.stamp_ns == self._gap_stamp_ns
        unusable = counted_reasons(self.collector.unusable.items())
        missing = [
            f"began before this node: {missed}" if missed else "",
            self.collector.storage_problem,
            self._gap if gap_lasts else "",
            f"messages not used: {unusable}" if unusable else "",
        ]
        lines = [self._problem or self._state, *filter(None, missing)]
        return Diagnosis(
            Level.WARN if self._problem or any(missing) else Level.OK,
            "; ".join(lines),
            {
                **{
                    f"{kind}_received": n for kind, n in self.collector.received.items()
                },
                "views": len(self._published),
                **self._newest(),
                **self._cost(),
                "detections_matched": "yes" if detections_matched else "no",
                **{
                    f"rejected {reason}": n
                    for reason, n in sorted(self._rejected.items())
                },
            },
        )

    def _cost(self) -> dict[str, str]:
        """Return the time of the last statuses, with and without waiting for a processor."""
        costs, worked = zip(*(self._costs or [(0.0, 0.0)]), strict=True)
        return {
            "status_ms": f"{MS_PER_S * statistics.median(costs):.1f}",
            "status_ms_max": f"{MS_PER_S * max(costs):.1f}",
            "status_cpu_ms_max": f"{MS_PER_S * max(worked):.1f}",
        }

    def _newest(self) -> dict[str, Any]:
        """Return the state of the run, from which a restarted sequencer resumes."""
        command = self.collector.newest_command
        if command is None:
            return {}
        return {
            "plan_id": command.plan_id,
            "run_id": command.run_id,
            "phase": command.phase.name,
            "view": command.view_index,
            "view_name": command.view.name if command.view else "",
            "command_stamp": command.stamp_ns,
            "placing": placing_digest(command.plate(), command.view)
            if command.view
            else "",
        }

    def _encoder(self) -> Diagnosis:
        """Return rate, largest gap and jitter of the encoder, WARN beyond the limits."""
        heard = self._ports.now_s() - self._encoder_s <= HEARD_S
        gap = self._encoder_rate.take_gap_ns() * S_PER_NS
        rate, least = self._encoder_rate.per_second, self.settings.encoder_rate_min
        values = {
            "encoder_heard": "yes" if heard else "no",
            "encoder_rate": f"{rate:.0f}",
            "encoder_gap_s": f"{gap:.4f}",
        }
        jitter = self._encoder_rate.take_jitter_s()
        limit = self.settings.encoder_jitter_limit
        if math.isfinite(jitter):
            values["encoder_jitter_s"] = f"{jitter:.6f}"
        last = self.collector.newest_command
        measuring = last is not None and last.phase == Phase.MEASURE
        problems = []
        if measuring and not heard:
            problems.append("no encoder samples are received")
        elif measuring and gap > self.settings.max_encoder_gap:
            problems.append(
                f"a gap of {gap:.3g} s between encoder samples: exposures in it are rejected"
            )
        elif measuring and rate < least:
            problems.append(
                f"{rate:.0f} encoder samples per second, {least:g} are wanted"
            )
        elif measuring and 0 < limit < jitter:
            problems.append(
                f"the intervals between encoder samples vary by {jitter:.3g} s, the "
                f"limit is {limit:g} s"
            )
        return Diagnosis.of(problems, values)

    def _repeatability(self) -> Diagnosis:
        """Return the repeatability of the newest view, WARN beyond the limits."""
        values = {}
        problems = []
        for value, limit, name, scale, unit in (
            (
                self._noise[0],
                self.settings.repeatability_xy_limit,
                "repeatability_xy",
                UM_PER_M,
                "um",
            ),
            (
                self._noise[1],
                self.settings.repeatability_theta_limit,
                "repeatability_theta",
                1.0,
                "rad",
            ),
        ):
            if math.isfinite(value):
                values[f"{name}_{unit}"] = f"{value * scale:.4g}"
            if 0 < limit < value:
                symbol = "µm" if unit == "um" else unit
                problems.append(
                    f"{name.replace('_', ' ')} is {value * scale:.3g} {symbol}, the "
                    f"limit {limit * scale:.3g} {symbol}"
                )
        return Diagnosis.of(problems, values)
