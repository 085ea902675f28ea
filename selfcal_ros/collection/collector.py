# SPDX-License-Identifier: Apache-2.0
"""The collector: takes messages in any order, returns the readings of every view.

The result is a function of the set of messages alone, so that live nodes, a replay and
``selfcal solve`` cannot differ. Nothing is discarded without being counted.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from selfcal_ros.collection import inputs
from selfcal_ros.collection.diagnosis import RejectionFinding
from selfcal_ros.collection.encoder import NEVER, JointTrack, TrackLimits
from selfcal_ros.collection.evidence import DetectionsSeen, EncoderFacts
from selfcal_ros.collection.expected import ViewProgress, expected_marks, n_read_enough
from selfcal_ros.collection.exposures import Exposures, Tracks
from selfcal_ros.collection.marks.identify import IdentityRules
from selfcal_ros.collection.marks.stops import count_stops
from selfcal_ros.collection.reduce import Rules
from selfcal_ros.collection.samples import Limits
from selfcal_ros.collection.timeline import Timeline, build_timeline, without_strays
from selfcal_ros.collection.view_readings import ViewCache
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.view import plan_keys
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import COMMAND_TOPIC
from selfcal_ros.units import NS_PER_S

MOST_NAMES = 20
"""Largest number of unknown joint names remembered."""
SETTLE_EVERY, SPARE = 100_000, 8
"""Number of samples, or `SPARE` times as many detections, after which exposures are looked up even
if no readings are requested, while the samples around them are in memory."""


class Collector:
    """Collect encoder samples, detections and commands and reduce them to readings.

    Incremental: the stage position at an exposure is looked up once, and a view is
    reduced again only if it has changed.

    Parameters
    ----------
    settings : CollectorSettings
        Values of measurement_collector's parameters.
    store : Limits, optional
        Limits on the encoder samples kept in memory.

    Raises
    ------
    InputError
        If two joints have the same name.
    """

    def __init__(
        self, settings: CollectorSettings, store: Limits | None = None
    ) -> None:
        gap_ns = round(settings.max_encoder_gap * NS_PER_S)
        linear = TrackLimits(gap_ns, settings.max_speed, settings.encoder_agreement)
        turn = TrackLimits(
            gap_ns, settings.max_angular_speed, settings.encoder_agreement, True
        )
        self.sense = Sense(settings.measurement_sense)
        self._joints = {
            settings.joint_x: "x",
            settings.joint_y: "y",
            settings.joint_theta: "theta",
        }
        if len(self._joints) < 3:
            raise InputError(
                "measurement_collector: joint_x, joint_y, joint_theta",
                "two of them are the same joint",
                "give each its own name",
            )
        self.tracks = Tracks(
            JointTrack(linear, store),
            JointTrack(linear, store),
            JointTrack(turn, store),
        )
        self._rules = Rules(
            self.sense,
            IdentityRules(
                settings.max_deviation,
                settings.ambiguity_ratio,
                settings.max_rotation,
                settings.max_stage_distance,
            ),
            settings.min_score,
            settings.outlier_limit,
        )
        self._min_repeats = settings.min_repeats
        self._exposures = Exposures(
            self.tracks, approach_threshold_m=settings.approach_threshold
        )
        self._views = ViewCache(self._rules)
        self._unsettled = 0
        self._commands: dict[inputs.Command, None] = {}
        self._rejected_input: Counter = Counter()
        self._timeline: Timeline | None = None
        self._newest: inputs.Command | None = None
        self._foreign: dict[str, None] = {}  # unknown joint names
        self._seen: DetectionsSeen | None = None
        self.received = {"encoder": 0, "detection": 0, "command": 0}

    def add_encoder(self, sample: inputs.EncoderSample) -> None:
        """Take one encoder message; an unusable one is counted under its reason."""
        self.add_encoder_block(inputs.EncoderBlock.of([sample]))

    def add_encoder_block(self, block: inputs.EncoderBlock) -> None:
        """Take encoder messages; unusable ones are counted under their reason."""
        count = len(block)
        names, positions, speeds = block.names, block.positions, block.velocities
        self.received["encoder"] += count
        if positions.shape[1] != len(names) or (
            speeds is not None and speeds.shape[1] != len(names)
        ):
            self._rejected_input[inputs.Reason.ENCODER_MALFORMED] += count
            return
        finite = np.ones(count, dtype=bool)
        joint_known = False
        for column, name in enumerate(names):
            joint = self._joint(name)
            if joint is None:
                continue
            joint_known = True
            good = np.isfinite(positions[:, column])
            finite &= good
            joint.store.add_block(
                block.stamps_ns[good],
                positions[good, column],
                None if speeds is None else speeds[good, column],
            )
        if not finite.all():
            self._rejected_input[inputs.Reason.ENCODER_NOT_FINITE] += int(
                (~finite).sum()
            )
        if not joint_known and count:
            self._rejected_input[inputs.Reason.ENCODER_UNKNOWN_JOINT] += count
        self._grow(count)

    def _joint(self, name: str) -> JointTrack | None:
        axis = self._joints.get(name)
        if axis is not None:
            return getattr(self.tracks, axis)
        if len(self._foreign) < MOST_NAMES:
            self._foreign[name] = None
        return None

    def add_detection(self, d: inputs.Detection) -> None:
        """Take one detection."""
        self.add_detection_block(d.as_table())

    def add_detection_block(self, table: np.ndarray) -> None:
        """Take many detections: a structured array of `reduce.DETECTION`."""
        self.received["detection"] += len(table)
        self._views.append(table)
        self._grow(len(table) // SPARE)

    def _grow(self, count: int) -> None:
        """Look up exposures periodically, while the samples around them are in memory."""
        self._unsettled += count
        if self._unsettled >= SETTLE_EVERY:
            self._settle()

    def _settle(self) -> None:
        self._views.changed_at(self._exposures.update(self._views.new_stamps()))
        self._unsettled = 0

    def add_command(self, command: inputs.Command) -> None:
        """Take one view command; an unusable one raises InputError."""
        inputs.check_command(command)
        self.received["command"] += 1
        if command not in self._commands:
            self._commands[command] = None
            self._timeline = self._newest = None

    def refuse(self, kind: str, reason: inputs.Reason, count: int = 1) -> None:
        """Count unused messages: encoder, detection or command."""
        self.received[kind] += count
        self._rejected_input[reason] += count

    def knows(self, command: inputs.Command) -> bool:
        """Return whether a command has been received before."""
        return command in self._commands

    @property
    def newest_command(self) -> inputs.Command | None:
        """The command with the latest stamp, the last received of equal ones; no stray."""
        if self._newest is None and self._commands:
            regular = set(without_strays(self._commands))
            self._newest = max(
                (c for c in reversed(self._commands) if c in regular),
                key=lambda c: c.stamp_ns,
            )
        return self._newest

    @property
    def encoder_until_ns(self) -> int:
        """Stamp up to which all joints with samples have been received, as far as known."""
        return min(
            (track.store.newest_ns for track in self.tracks if len(track)),
            default=NEVER,
        )

    @property
    def storage_problem(self) -> str:
        """Why more encoder samples are in memory than intended; empty if all is well."""
        return next(
            (track.store.problem for track in self.tracks if track.store.problem), ""
        )

    @property
    def unusable(self) -> dict[str, int]:
        """Messages unusable as encoder samples or commands, by reason."""
        return {
            str(reason): count for reason, count in sorted(self._rejected_input.items())
        }

    @property
    def timeline(self) -> Timeline:
        """The commands so far, in the order of their stamps."""
        if self._timeline is None:
            self._timeline = build_timeline(self._commands)
        return self._timeline

    def collect(self) -> tuple[Measurements, dict[int, ViewProgress]]:
        """Return the readings of all views so far, and the progress of each view.

        Raises
        ------
        NoDataError
            If no view has been commanded.
        """
        timeline = self.timeline
        if timeline.artifact is None:
            raise NoDataError(
                COMMAND_TOPIC,
                "no MEASURE command",
                "readings cannot be assigned to views without one",
            )
        self._settle()
        readings, loose = self._views.readings(timeline, self._exposures)
        loose.update(
            {str(reason): count for reason, count in self._rejected_input.items()}
        )
        stamps = [command.stamp_ns for command in self._commands]
        self._seen = DetectionsSeen(
            self._views.table,
            self._views.view_of,
            self._exposures,
            encoder=self._facts,
            commands_ns=(min(stamps), max(stamps)),
            artifact=timeline.artifact,
            rules=self._rules.identity,
            sense=self.sense,
        )
        progress = {
            index: view_progress(timeline, index, view_readings, self._min_repeats)
            for index, view_readings in readings.items()
        }
        cells = tuple(cell for view in readings.values() for cell in view.parts)
        return Measurements(
            timeline.plan_id,
            timeline.artifact,
            cells,
            sense=self.sense,
            rejected=dict(sorted(loose.items())),
            run_id=timeline.run_id,
            model_terms=timeline.model_terms,
            artifact_from=timeline.artifact_from,
            **plan_keys(timeline),
        ), progress

    def findings(
        self, measurements: Measurements, progress: dict[int, ViewProgress]
    ) -> dict[int | None, RejectionFinding]:
        """Return why most detections of the session (key None), or of single views, were rejected.

        `measurements` and `progress` are the last result of `collect`.
        """
        if self._seen is None:
            return {}
        return self._seen.findings(
            {index: view.readings for index, view in progress.items()},
            measurements.rejected,
        )

    def missing_commands(self) -> list[str]:
        """Return which commands of the run were lost, as far as that is seen, one line each."""
        timeline = self.timeline
        stamps = self._views.table["stamp"]
        lines = [
            f"no command of view {index} of the plan (from 0) is there: what was measured in "
            f"it counts in no view, or in another; receive and record {COMMAND_TOPIC} whole"
            for index in timeline.absent
        ]
        for name, after in timeline.unmeasured.values():
            count = int(((stamps >= after.start_ns) & (stamps < after.end_ns)).sum())
            if count:
                lines.append(
                    f"view '{name}' was placed, and {count} detections followed, but its "
                    "MEASURE command is missing: they count in no view; measure the view "
                    f"again, and receive and record {COMMAND_TOPIC} whole"
                )
        return lines

    def finding_of_last(
        self,
        progress: Mapping[int, ViewProgress],
        index: int,
        rejected: Mapping[str, int],
    ) -> RejectionFinding | None:
        """Return why the last detections of a view were rejected, none of which was used."""
        if self._seen is None:
            return None
        return self._seen.of_last(index, progress[index].readings, rejected)

    def _facts(self) -> EncoderFacts:
        """Return a summary of the encoder messages."""
        tracks = {axis: getattr(self.tracks, axis) for axis in self._joints.values()}
        spans = [span for span in (track.store.span() for track in self.tracks) if span]
        return EncoderFacts(
            names={axis: name for name, axis in self._joints.items()},
            sampled={axis: len(track) > 0 for axis, track in tracks.items()},
            foreign=tuple(self._foreign),
            span_ns=(min(s[0] for s in spans), max(s[1] for s in spans))
            if spans
            else None,
            step_s=self.tracks.x.usual_step_s(),
            max_gap_s=self.tracks.x.limits.max_gap_ns / NS_PER_S,
        )


def view_progress(
    timeline: Timeline, index: int, readings: ViewReadings, min_repeats: int = 0
) -> ViewProgress:
    """Return the progress of a view."""
    artifact, view = timeline.planned_view(index)
    grid, angular = expected_marks(artifact, view)
    grid_done, angular_done = n_read_enough(artifact, view, readings, min_repeats)
    checked = min(
        max(count_stops(view, cell)[1] for cell in readings.parts), view.check_marks
    )
    return ViewProgress(
        index,
        view,
        grid,
        grid_done=grid_done,
        angular_expected=angular,
        angular_done=angular_done,
        readings=readings,
        end_ns=max(i.end_ns for i in timeline.of_view(index)),
        artifact=artifact,
        check_done=checked,
        min_repeats=min_repeats,
    )


LARGEST_KEPT = 31 * 2**20
"""Size of a freed block, just below the largest that has an effect (32 MB)."""


def keep_freed_memory() -> None:
    """Have the allocator keep freed memory, up to 64 MB, instead of returning it at once.

    A solution takes and frees some hundred arrays of 0.1 to 1 MB, a collector 1.5 MB for each
    65,536 samples of a joint. Each page from the system costs 2 to 5 us: a tenth of
    a solution, a fifth of a status of many samples. The allocator of glibc adapts its threshold to
    freed blocks (mallopt(3), M_MMAP_THRESHOLD: "adjusted dynamically"); nothing is
    written to the block, so it takes no memory. Other allocators are not affected.
    """
    np.empty(LARGEST_KEPT, dtype=np.uint8)
