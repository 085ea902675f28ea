# SPDX-License-Identifier: Apache-2.0
"""The session of compensator: which map is used, and what is done with a sample."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.collection.settings.nodes import CompensatorSettings
from selfcal_ros.compensation.cells import cubic_spline
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.messages import to_model
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import result_from_dict
from selfcal_ros.sessions.ports import Diagnosis, Level, Ports
from selfcal_ros.sessions.verdicts import is_qualified
from selfcal_ros.units import S_PER_NS

FARTHEST = 1e12
"""Position, m or rad, beyond which a sample is none of a stage."""


class CompensatingSession:
    """Corrects samples by the newest map that may be used; counts what it cannot correct.

    With ``require_qualified`` a map counts once the summary of the same run and stamp says that
    it is qualified and that all planned views are behind it. A map takes over between two
    samples, as a whole.

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
        self.counts = {"corrected": 0, "without_map": 0, "refused": 0}
        self._map: Any = None  # newest message of each, until they are judged together
        self._summary: Any = None
        self._waits = ""
        self._used, self._since_s, self._map_ns = "", 0.0, 0
        if settings.interpolation == "bicubic":
            cubic_spline(np.arange(4.0), np.zeros(4))  # loaded now, lest the first map wait for it
        if settings.map:
            self._load_file(settings.map)

    def _load_file(self, path: str) -> None:
        result = result_from_dict(read_json(path), path)
        if self._settings.require_qualified and not is_qualified(result):
            raise InputError(path, "the map is not qualified", "measure again, or set "
                             "require_qualified to false")
        self._use(result.error_map, f"{Path(path).resolve()}, plan {result.plan_id}", 0)

    def take_map(self, message: Any) -> None:
        """Take a selfcal_msgs/ErrorMap: use it, now or once its summary says that it is good."""
        self._map = message
        self._judge()

    def take_summary(self, message: Any) -> None:
        """Take the selfcal_msgs/CalibrationSummary that belongs to a map."""
        self._summary = message
        self._judge()

    def _judge(self) -> None:
        if self._map is None:
            return
        waits = self._doubt() if self._settings.require_qualified else ""
        if waits != self._waits and waits:
            self._ports.say(Level.OK, f"the newest map is not used: {waits}")
        self._waits = waits
        if not waits:
            message, self._map = self._map, None
            self._use(to_model.error_map(message), _source(message),
                      to_model.stamp_ns(message))

    def _doubt(self) -> str:
        """Return why the newest map must not be used; "" if it may."""
        message, summary = self._map, self._summary
        if not message.qualified:
            return f"{_source(message)} is not qualified"
        if summary is None or summary.run_id != message.run_id or (
                to_model.stamp_ns(summary) != to_model.stamp_ns(message)):
            return f"no selfcal/summary says yet whether {_source(message)} is complete"
        if not summary.qualified:
            return f"{_source(message)} is not qualified: {summary.state}"
        if summary.views_done < summary.views_planned:
            return (f"{_source(message)} is of {summary.views_done} of {summary.views_planned} "
                    "views")
        return ""

    def _use(self, error_map: ErrorMap, source: str, stamp_ns: int) -> None:
        self.compensator = Compensator(error_map, method=self._settings.interpolation,
                                       outside=self._settings.outside)
        self._used, self._since_s, self._map_ns = source, self._ports.now_s(), stamp_ns
        self._ports.say(Level.OK, f"correcting by the map of {source} from now on")

    def correct(self, names: list[str], positions: list[float]) -> list[float] | None:
        """Return the positions of all joints, stage joints corrected; None if it cannot be told.

        Parameters
        ----------
        names : list of str
            Joints of the sample.
        positions : list of float
            Their indicated positions, m and rad.
        """
        if self.compensator is None:
            self.counts["without_map"] += 1
            return None
        corrected = self._corrected(names, positions)
        if corrected is None or not all(map(math.isfinite, corrected.values())):
            # Outside of the field with outside=refuse, beside an unknown site or line, or no
            # position at all.
            self.counts["refused"] += 1
            return None
        self.counts["corrected"] += 1
        return [corrected.get(index, position) for index, position in enumerate(positions)]

    def _corrected(self, names: list[str], positions: list[float]) -> dict[int, float] | None:
        """Return the corrected positions by index of the joint."""
        if len(positions) != len(names):
            return None
        place = {name: index for index, name in enumerate(names)}
        joints = (self._settings.joint_x, self._settings.joint_y, self._settings.joint_theta)
        x, y, theta = map(place.get, joints)
        if any(index is not None and abs(positions[index]) > FARTHEST for index in (x, y, theta)):
            return None
        corrected: dict[int, float] = {}
        if self.compensator is None:
            return None
        try:
            if x is not None and y is not None:
                corrected |= zip((x, y), map(float, self.compensator.correct(
                    positions[x], positions[y])), strict=True)
            if theta is not None and self.compensator.has_theta:
                corrected[theta] = float(self.compensator.correct_theta(positions[theta]))
        except InputError:
            return None
        return corrected

    def diagnosis(self) -> Diagnosis:
        """Return what the node says of itself."""
        waits = f"; not used: {self._waits}" if self._waits else ""
        if self.compensator is None:
            return Diagnosis(Level.WARN, f"no error map yet{waits}", self.counts)
        age = (self._ports.now_ns() - self._map_ns) * S_PER_NS if self._map_ns else math.nan
        values = self.counts | {
            "map": self._used, "since_s": f"{self._ports.now_s() - self._since_s:.0f}",
            **({"map_age_s": f"{age:.0f}"} if math.isfinite(age) else {})}
        if 0 < self._settings.max_map_age < age:
            return Diagnosis(Level.WARN, f"the map is {age:.0f} s old: calibrate again", values)
        return Diagnosis(Level.OK, f"correcting by the map of {self._used}{waits}", values)


def _source(message: Any) -> str:
    """Return plan and run of a map, for people."""
    return f"plan {message.plan_id}" + (f", run {message.run_id}" if message.run_id else "")
