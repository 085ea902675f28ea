# SPDX-License-Identifier: Apache-2.0
"""The session of compensator: files of maps, selection of a map, correction of samples."""

import math
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, cast, get_args

import numpy as np

from selfcal_ros import results
from selfcal_ros.bagio.messages import to_model
from selfcal_ros.bagio.messages.to_model import PositionEditor
from selfcal_ros.compensation.compensator import Compensator, Interpolation
from selfcal_ros.compensation.plausible import require_plausible
from selfcal_ros.errors import InputError, printable
from selfcal_ros.model.error_map import ErrorMap, first_order
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.nodes.sessions.health import Diagnosis, Level, Ports, merged
from selfcal_ros.reporting.summary.numbers import summary_figures
from selfcal_ros.settings.nodes import CompensatorSettings
from selfcal_ros.units import MS_PER_S, S_PER_NS

KEEPS_UP = 20
"""Largest number of waiting samples that are all corrected: a millisecond of work. If
more wait, only the newest is corrected."""
FARTHEST = 1e12
"""Largest valid position of a stage, m or rad."""
LEAST_RADIUS_M = 0.02
"""Distance from the axis at which an angular error counts at least: the map of a tiny plate may
turn the stage by any angle otherwise."""
MOST_ASKED = 100_000
"""Largest number of positions of a request, for which samples and commands wait: 0.1 to 0.5 s."""
SAME_FIGURE = 1e-6
"""Largest relative difference of a figure of a map and the same figure stated with it."""


@dataclass
class _SinceStatus:
    """What happened since the last status.

    Attributes
    ----------
    ages_s : list of float
        Ages of corrected samples when they were published.
    skipped, commands_refused, outside : int
        Numbers of samples, of commands, and of positions outside the field.
    strange_joints : tuple of str
        Joints of the last sample without one of the stage.
    other_frame : str
        Frame of the last command that names another than the stage's.
    """

    ages_s: list[float] = field(default_factory=list)
    skipped: int = 0
    commands_refused: int = 0
    outside: int = 0
    strange_joints: tuple[str, ...] = ()
    other_frame: str = ""


class CompensatingSession:
    """Correct samples by the newest usable map; count samples that cannot be corrected.

    With ``require_qualified`` a map is used once the summary of the same run and stamp says that
    it is qualified and based on all planned views. Maps change between two
    samples, atomically.

    Parameters
    ----------
    settings : CompensatorSettings
        Values of the compensator's parameters.
    ports : Ports
        Log and clocks.
    """

    def __init__(self, settings: CompensatorSettings, ports: Ports) -> None:
        self._settings, self._ports = settings, ports
        self.compensator: Compensator | None = None
        self.counts = {
            "corrected": 0,
            "without_map": 0,
            "refused": 0,
            "skipped": 0,
            "commands": 0,
            "commands_refused": 0,
            "outside": 0,
        }
        self._waiting: list[tuple[bytes, int]] = []
        self._editor = PositionEditor()
        self._since_status = _SinceStatus()
        self._map: Any = None  # newest message of each, until evaluated together
        self._summary: Any = None
        self._waits = self._contradicted = ""
        self._used, self._since_s, self._map_ns = "", 0.0, 0
        if settings.map:
            self._load_file(settings.map)

    def _load_file(self, path: str) -> None:
        result = results.read_result(path)
        if result.verification is not None:
            raise InputError(
                path,
                "was measured with the correction on, so it is not a map to correct with",
                f"name {result.verification.of}",
            )
        if self._settings.require_qualified and not is_qualified(result):
            raise InputError(
                path,
                "the map is not qualified",
                "measure again, or set require_qualified to false",
            )
        read_from = Path(result.read_from[0] if result.read_from else path).resolve()
        self._use(
            result.error_map,
            f"{read_from}, plan {result.plan_id}",
            0,
            result.interpolation,
            reads_between_nodes=result.reads_between_nodes,
        )

    def take_map(self, message: Any) -> None:
        """Take a selfcal_msgs/ErrorMap: use it, now or once its summary confirms it."""
        self._map = message
        self._judge()

    def take_summary(self, message: Any) -> None:
        """Take the selfcal_msgs/CalibrationSummary of a map."""
        self._summary = message
        self._judge()

    def _judge(self) -> None:
        if self._map is None:
            return
        doubt = self._doubt() if self._settings.require_qualified else ""
        self._contradicted = contradicted = self._contradiction()
        waits = contradicted or doubt
        if waits != self._waits and waits:
            self._ports.say(
                Level.WARN if contradicted else Level.OK,
                f"the newest map is not used: {waits}",
            )
        self._waits = waits
        if not waits:
            message = self._map
            self._map = None
            try:
                self._refuse_other_frame(message)
                error_map = to_model.error_map(message)
                _refuse_other_axes(error_map, _source(message))
                require_plausible(
                    error_map,
                    f"the map of {_source(message)}",
                    "name its file in the parameter map",
                )
                self._use(
                    error_map,
                    _source(message),
                    to_model.stamp_ns(message),
                    str(getattr(message, "interpolation", "")),
                )
            except InputError as error:
                self._waits = str(error)
                raise

    def _refuse_other_frame(self, message: Any) -> None:
        """Refuse a map of another frame than the positions'; an empty one is not stated."""
        frame, stage_frame = message.header.frame_id, self._settings.frame_id
        if frame not in ("", stage_frame):
            raise InputError(
                f"the map of {_source(message)}",
                f"it is in the frame {printable(frame)!r}, the positions to correct are "
                f"in {stage_frame!r}",
                "use a map of this stage, or set frame_id of the compensator and of "
                "the solver alike",
            )

    def _doubt(self) -> str:
        """Return why the newest map must not be used, or ""."""
        message, summary = self._map, self._summary
        if not message.qualified:
            return f"{_source(message)} is not qualified"
        if not message.identifiable:
            return f"{_source(message)} is said to be qualified and not identified"
        if summary is None or not self._is_of_one_result():
            return f"no selfcal/summary says yet whether {_source(message)} is complete"
        if not summary.qualified:
            return f"{_source(message)} is not qualified: {summary.state}"
        if summary.views_done < summary.views_planned:
            return (
                f"{_source(message)} contains {summary.views_done} of "
                f"{summary.views_planned} views"
            )
        return ""

    def _is_of_one_result(self) -> bool:
        """Whether newest map and newest summary are of the same run and stamp."""
        message, summary = self._map, self._summary
        return (
            summary is not None
            and summary.run_id == message.run_id
            and to_model.stamp_ns(summary) == to_model.stamp_ns(message)
        )

    def _contradiction(self) -> str:
        """Return which figure of its own summary contradicts the newest map, or "".

        A figure that is 0 or not finite is not stated.
        """
        if not self._is_of_one_result():
            return ""
        try:
            figures = summary_figures(to_model.error_map(self._map))
        except InputError:
            return ""  # refused with its reason when it is used
        for name, value in figures.items():
            summary_value = float(getattr(self._summary, name))
            if (
                summary_value
                and math.isfinite(summary_value)
                and not math.isclose(summary_value, value, rel_tol=SAME_FIGURE)
            ):
                return (
                    f"selfcal/summary states {name} {summary_value:.6g}, and the map of "
                    f"{_source(self._map)} has {value:.6g}: it is not the map that was solved"
                )
        return ""

    def _use(
        self,
        error_map: ErrorMap,
        source: str,
        stamp_ns: int,
        interpolation: str,
        *,
        reads_between_nodes: bool = False,
    ) -> None:
        """Use a map with the interpolation stated with it, or that of the parameter.

        With unknown nodes there is no spline: such a map is interpolated bilinearly. Messages do
        not state whether anything was read between the nodes.
        """
        self._refuse_large(
            error_map, [error_map.gx, error_map.gy], error_map.g_theta, source
        )
        method = self._settings.interpolation
        fitted = None
        if interpolation and interpolation not in get_args(Interpolation):
            raise InputError(
                f"the map of {source}",
                f"its interpolation {interpolation!r} is not known",
                f"known are {' and '.join(get_args(Interpolation))}",
            )
        if interpolation:
            stated = cast(Interpolation, interpolation)
            method = stated if error_map.valid.all() else "bilinear"
            fitted = stated if reads_between_nodes else None
        use = Compensator(
            error_map, method=method, fitted=fitted, outside=self._settings.outside
        )
        self._refuse_large(error_map, *use.between(), source)
        if stamp_ns < self._map_ns:
            self._ports.say(
                Level.WARN,
                f"the map of {source} is older than the one that it replaces, of {self._used}",
            )
        self.compensator = use
        self._used, self._since_s, self._map_ns = source, self._ports.now_s(), stamp_ns
        self._ports.say(Level.OK, f"correcting by the map of {source} from now on")

    def _refuse_large(
        self,
        error_map: ErrorMap,
        errors: Sequence[np.ndarray],
        errors_theta: np.ndarray,
        source: str,
    ) -> None:
        """Refuse errors that move a position by more than `max_correction`.

        An angular error moves the farthest site, or what is as far as `LEAST_RADIUS_M`, by its
        angle times the radius.
        """
        artifact = error_map.artifact
        limit_m = self._settings.max_correction
        radius_m = max(
            math.hypot(*artifact.half) * artifact.grid_pitch_m, LEAST_RADIUS_M
        )
        largest_m = max(
            np.abs(part[~np.isnan(part)]).max(initial=0.0)
            for part in (*errors, errors_theta * radius_m)
        )
        if largest_m > limit_m:
            raise InputError(
                f"the map of {source}",
                f"it corrects by up to {largest_m:.3g} m, max_correction is {limit_m:.3g} m",
                "check its units (m, rad), or set max_correction",
            )

    def receive(self, data: bytes, received_ns: int) -> None:
        """Take a sensor_msgs/JointState as received; it waits for `correct_waiting`."""
        self._waiting.append((data, received_ns))

    def correct_waiting(self, lost: int, publish: Callable[[bytes], None]) -> None:
        """Correct waiting samples in the order of arrival, or only the newest if many wait.

        Parameters
        ----------
        lost : int
            Number of samples displaced in the queue by newer ones, or missing.
        publish : callable (data)
            Takes each corrected sample.
        """
        waiting = self._waiting
        self._waiting = []
        samples = waiting if lost + len(waiting) <= KEEPS_UP else waiting[-1:]
        skipped = lost + len(waiting) - len(samples)
        self._since_status.skipped += skipped
        self.counts["skipped"] += skipped
        for data, received_ns in samples:
            sample = self._editor.read(data)
            if sample is None:
                self.counts["refused"] += 1
                continue
            corrected = self.correct(*sample)
            if corrected is not None:
                publish(self._editor.replaced(data, corrected))
                age_s = (self._ports.wall_ns() - received_ns) * S_PER_NS
                self._since_status.ages_s.append(age_s)

    def correct(
        self, names: Sequence[str], positions: Sequence[float]
    ) -> list[float] | None:
        """Return the positions of all joints, stage joints corrected; None if unknown.

        Parameters
        ----------
        names : sequence of str
            Joints of the sample.
        positions : sequence of float
            Their indicated positions, m and rad.
        """
        if self.compensator is None:
            self.counts["without_map"] += 1
            return None
        use = self.compensator
        corrected = self._corrected(
            names, positions, (use.correct_point, use.correct_angle)
        )
        if corrected is None:
            self.counts["refused"] += 1
            return None
        self.counts["corrected"] += 1
        return corrected

    def command(self, data: bytes) -> bytes | None:
        """Return a commanded sensor_msgs/JointState with x, y and theta corrected.

        None if it must not be passed on: without a map, damaged, or as `_corrected`.
        """
        sample = self._editor.read(data)
        use = self.compensator
        corrected = None
        if sample is not None and use is not None:
            corrected = self._corrected(*sample, (use.command, use.command_theta))
        if corrected is None:
            self.counts["commands_refused"] += 1
            self._since_status.commands_refused += 1
            return None
        if self._editor.frame_id not in ("", self._settings.frame_id):
            self._since_status.other_frame = self._editor.frame_id
        self.counts["commands"] += 1
        return self._editor.replaced(data, corrected)

    def _corrected(
        self,
        names: Sequence[str],
        positions: Sequence[float],
        corrections: tuple[Callable[[float, float], tuple], Callable[[float], Any]],
    ) -> list[float] | None:
        """Return the positions of all joints with the stage's corrected; None if unknown.

        That is: outside the field with outside=refuse, next to an unknown site or line, no
        position at all, a joint named twice, none of the stage, or x or y alone, whose correction
        depends on the other.

        Parameters
        ----------
        names, positions : sequence
            Joints and their positions.
        by : tuple of callable
            Correction of (x, y) and of theta.
        """
        stage = self._stage_joints(names, positions)
        if stage is None or self.compensator is None:
            return None
        x, y, theta = stage
        corrected = list(positions)
        try:
            if x is not None and y is not None:
                corrected[x], corrected[y] = map(
                    float, corrections[0](positions[x], positions[y])
                )
                if not self.compensator.is_inside(positions[x], positions[y]):
                    self.counts["outside"] += 1
                    self._since_status.outside += 1
            if theta is not None and self.compensator.has_theta:
                corrected[theta] = float(corrections[1](positions[theta]))
        except InputError:
            return None
        known = all(math.isfinite(corrected[i]) for i in stage if i is not None)
        return corrected if known else None

    def _stage_joints(
        self, names: Sequence[str], positions: Sequence[float]
    ) -> tuple[int | None, int | None, int | None] | None:
        """Return the places of x, y and theta among the joints; None for no position of a stage."""
        place = {name: index for index, name in enumerate(names)}
        if not len(positions) == len(names) == len(place):
            return None
        x, y, theta = map(place.get, self._joints)
        stage = [index for index in (x, y, theta) if index is not None]
        if not stage:
            self._since_status.strange_joints = tuple(names)
        if not stage or (x is None) != (y is None):
            return None
        # nor NaN
        is_position = all(abs(positions[index]) <= FARTHEST for index in stage)
        return (x, y, theta) if is_position else None

    def answer(
        self,
        x: Sequence[float],
        y: Sequence[float],
        theta: Sequence[float],
        *,
        inverse: bool,
    ) -> dict[str, np.ndarray]:
        """Return the fields of the answer to a selfcal_msgs/Correct request.

        Raises
        ------
        InputError
            If there is no map, the request is not as many positions of each axis, or the map does
            not know one of them.
        """
        use = self.compensator
        if use is None:
            raise InputError(
                "compensator",
                f"no error map yet{self._waits and ': '}{self._waits}",
                "calibrate, or name one with the parameter map",
            )
        points = [np.asarray(axis, dtype=float) for axis in (x, y, theta)]
        if len(points[0]) != len(points[1]) or len(points[2]) not in (
            0,
            len(points[0]),
        ):
            raise InputError(
                "request",
                f"{len(x)} x, {len(y)} y and {len(theta)} theta",
                "give equally many of each; theta may be empty",
            )
        if len(x) > MOST_ASKED:
            raise InputError(
                "request",
                f"{len(x)} positions, for which samples and commands would wait",
                f"ask for {MOST_ASKED} at a time, or use selfcal apply",
            )
        if not all((np.abs(axis) <= FARTHEST).all() for axis in points):
            raise InputError("request", "a position is not a number", "give m and rad")
        corrected = [*(use.correct if inverse else use.command)(*points[:2]), points[2]]
        u = [
            *(use.uncertainty_indicated if inverse else use.uncertainty)(*points[:2]),
            points[2],
        ]
        if len(theta):
            corrected[2] = (use.correct_theta if inverse else use.command_theta)(
                points[2]
            )
            u[2] = use.uncertainty_theta(corrected[2] if inverse else points[2])
        if not all(np.isfinite(axis).all() for axis in corrected):
            raise InputError(
                "request",
                "a position lies next to an unknown site or line",
                "leave it out, or measure the site",
            )
        return dict(
            zip(
                ("x", "y", "theta", "u_x", "u_y", "u_theta"),
                [*corrected, *u],
                strict=True,
            )
        )

    def remark(self, answer: dict[str, np.ndarray]) -> str:
        """Return the line of an answer: the map that was used, and whether u is missing."""
        unknown = int(np.isnan([answer["u_x"], answer["u_y"]]).any(axis=0).sum())
        missing = (
            f"; u is not known at {unknown} positions: is one outside the field, or has "
            "the map no uncertainties?"
            if unknown
            else ""
        )
        return f"corrected by the map of {self._used}{missing}"

    def diagnosis(self) -> Diagnosis:
        """Return the diagnosis of the node, and of its timing since the last call."""
        return merged(self._state(), [self._pace()])

    @property
    def _joints(self) -> tuple[str, str, str]:
        """Names of the stage's joints."""
        settings = self._settings
        return settings.joint_x, settings.joint_y, settings.joint_theta

    def _pace(self) -> Diagnosis:
        seen = self._since_status
        self._since_status = _SinceStatus()
        lines = []
        if seen.skipped:
            lines.append(
                f"{seen.skipped} samples skipped since the last status: newer ones arrived "
                "before they could be corrected, or they were lost in transport"
            )
        if seen.commands_refused:
            lines.append(
                f"{seen.commands_refused} commands refused since the last status and not "
                "passed on: no map, no complete position, a joint named twice, or a position "
                "where the map is unknown"
            )
        # beside samples of the stage they may be others
        if seen.strange_joints and (seen.commands_refused or not seen.ages_s):
            lines.append(
                f"joints {printable(', '.join(seen.strange_joints))} are not of the stage "
                f"({', '.join(self._joints)}): correct joint_x, joint_y and joint_theta, or "
                "the publisher"
            )
        if seen.other_frame:
            lines.append(
                f"commands name the frame {printable(seen.other_frame)!r}, but are corrected "
                f"as positions in {self._settings.frame_id!r}: transform them first, or set "
                "frame_id if it is the stage's"
            )
        if seen.outside:
            lines.append(
                f"{seen.outside} positions outside the field since the last status, corrected "
                "as at its edge: how well is not known"
            )
        if not seen.ages_s:
            return Diagnosis.of(lines)
        oldest_s = max(seen.ages_s)
        limit_s = self._settings.max_age
        if oldest_s > limit_s:
            lines.append(
                f"a corrected position was {oldest_s * MS_PER_S:.1f} ms old when it was "
                f"published, max_age is {limit_s * MS_PER_S:g} ms"
            )
        return Diagnosis.of(
            lines,
            {
                "age_ms": f"{median(seen.ages_s) * MS_PER_S:.2f}",
                "age_ms_max": f"{oldest_s * MS_PER_S:.2f}",
            },
        )

    def _state(self) -> Diagnosis:
        waits = f"; not used: {self._waits}" if self._waits else ""
        if self.compensator is None:
            return Diagnosis(Level.WARN, f"no error map yet{waits}", self.counts)
        age = (
            (self._ports.now_ns() - self._map_ns) * S_PER_NS
            if self._map_ns
            else math.nan
        )
        values = self.counts | {
            "map": self._used,
            "since_s": f"{self._ports.now_s() - self._since_s:.0f}",
            **({"map_age_s": f"{age:.0f}"} if math.isfinite(age) else {}),
        }
        if 0 < self._settings.max_map_age < age:
            return Diagnosis(
                Level.WARN, f"the map is {age:.0f} s old: calibrate again", values
            )
        return Diagnosis(
            Level.WARN if self._contradicted else Level.OK,
            f"correcting by the map of {self._used}{waits}",
            values,
        )


def _refuse_other_axes(error_map: ErrorMap, source: str) -> None:
    """Refuse a map whose O and R are not those that it states, as after an exchange of axes.

    An exchange changes the sign of R, a mirror that of O. A map that states neither is not
    compared.
    """
    stated = error_map.nonorthogonality, error_map.scale_difference
    if not all(map(math.isfinite, stated)) or not any(stated):
        return
    fits = first_order(error_map.artifact, np.stack([error_map.gx, error_map.gy]))
    half_m = max(error_map.artifact.half) * error_map.artifact.grid_pitch_m
    largest_m = float(np.nanmax(np.hypot(error_map.gx, error_map.gy)))
    if max(abs(a - b) for a, b in zip(fits, stated, strict=True)) * half_m > (
        SAME_FIGURE * largest_m
    ):
        raise InputError(
            f"the map of {source}",
            f"its non-orthogonality and scale difference are {fits[0]:.4g} and "
            f"{fits[1]:.4g}, it states {stated[0]:.4g} and {stated[1]:.4g}: axes were "
            "exchanged or reversed, or numbers changed, after it was solved",
            "publish the map as the solver does",
        )


def _source(message: Any) -> str:
    """Return plan and run of a map as text."""
    return f"plan {message.plan_id}" + (
        f", run {message.run_id}" if message.run_id else ""
    )


LARGEST_FILE = 32 << 20
"""Largest result read for a request, bytes."""


def result_file(path: str, folder: str) -> Path:
    """Return the absolute path of a result to be written.

    Parameters
    ----------
    path : str
        Path in the request; a relative one is relative to `folder`.
    folder : str
        Folder in which results may be written; empty = the working directory.

    Raises
    ------
    InputError
        If `path` is empty, outside the folder, or exists and is not a regular file.
    """
    if not path or "\0" in path:
        raise InputError(
            "path", "is not a file name" if path else "is empty", "name a file"
        )
    root = Path(os.path.realpath(folder or os.curdir))
    target = Path(os.path.realpath(root / path))
    if not target.is_relative_to(root):
        raise InputError(
            path,
            f"lies outside of {root}",
            "name a file in it, or set the parameter result_folder of the solver",
        )
    if os.path.exists(target) and not os.path.isfile(target):  # a pipe would block
        raise InputError(path, "is not a regular file", "name another file")
    return target


def plan_file_name(plan_id: str) -> str:
    """Return PLAN_ID.json; all but letters, digits, ``.``, ``-`` and ``_`` become ``_``."""
    return f"{_word(plan_id) or 'plan'}.json"


def run_file(path: str, run_id: str) -> Path:
    """Return the absolute path of the map of a run; ``{run_id}`` in `path` is replaced."""
    return Path(os.path.abspath(path.replace("{run_id}", _word(run_id) or "run")))


def _word(text: str) -> str:
    return re.sub(r"[^\w.-]", "_", text).lstrip(".")[:200]


def read_result(path: str) -> CalibrationResult:
    """Return the result in a file named by another process.

    Raises
    ------
    InputError
        If it is not a regular file of at most `LARGEST_FILE`, or not a result.
    """
    if not path:
        raise InputError("path", "is empty", "name a file")
    return results.read_result(path, LARGEST_FILE)


def is_qualified(result: CalibrationResult) -> bool:
    """Return whether the stage error is identified and the readings do not contradict the model.

    Of a verification: whether the correction passed it.
    """
    if result.verification is not None:
        return result.verification.passed
    return result.observability.identifiable and result.verdict.qualified
