# SPDX-License-Identifier: Apache-2.0
"""The session of compensator: which map is used, and what is done with a sample."""

import math
from typing import Any

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.messages import to_model
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import result_from_dict
from selfcal_ros.sessions.ports import Diagnosis, Level


class CompensatingSession:
    """Corrects samples by the newest map; counts what it cannot correct.

    Parameters
    ----------
    values : dict
        Values of the compensator's parameters.
    """

    def __init__(self, values: dict[str, Any]) -> None:
        self._values = values
        self.compensator: Compensator | None = None
        self.counts = {"corrected": 0, "without_map": 0, "refused": 0}
        if values["map"]:
            path = values["map"]
            self._load(result_from_dict(read_json(path), path).error_map)

    def take_map(self, message: Any) -> None:
        """Use the map of a selfcal_msgs/ErrorMap from now on."""
        self._load(to_model.error_map(message))

    def _load(self, error_map: ErrorMap) -> None:
        self.compensator = Compensator(error_map, method=self._values["interpolation"],
                                       outside=self._values["outside"])

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
        x, y, theta = (place.get(self._values[f"joint_{axis}"]) for axis in ("x", "y", "theta"))
        corrected = {}
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
        if self.compensator is None:
            return Diagnosis(Level.WARN, "no error map yet", self.counts)
        return Diagnosis(Level.OK, "correcting", self.counts)
