# SPDX-License-Identifier: Apache-2.0
"""compensator: true positions from indicated ones, by the calibrated error map."""

import math
import sys
from typing import Any

from selfcal_ros.bagio import convert_in
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.result import result_from_dict
from selfcal_ros.nodes import names
from selfcal_ros.nodes.base import SelfcalNode, run


class CompensatorNode(SelfcalNode):
    """Publishes stage/corrected_joint_states: each sample with the stage's error taken off."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("compensator", **kwargs)
        self._compensator: Compensator | None = None
        self._counts = {"corrected": 0, "without_map": 0, "refused": 0}
        if self.values["map"]:
            path = self.values["map"]
            self._load(result_from_dict(read_json(path), path).error_map)
        self._corrected = self.publisher(names.CORRECTED)
        self.subscribe(names.ERROR_MAP, lambda message: self._load(convert_in.error_map(message)))
        self.subscribe(names.ENCODER_BEST_EFFORT, self._on_sample)
        self.create_timer(1.0, lambda: self.diagnose(
            "correcting" if self._compensator else "no error map yet", self._counts,
            ok=self._compensator is not None))

    def _load(self, error_map: ErrorMap) -> None:
        self._compensator = Compensator(error_map, method=self.values["interpolation"],
                                        outside=self.values["outside"])

    def _on_sample(self, message: Any) -> None:
        if self._compensator is None:
            self._counts["without_map"] += 1
            return
        place = {name: index for index, name in enumerate(message.name)}
        x, y, theta = (place.get(self.values[f"joint_{axis}"]) for axis in ("x", "y", "theta"))
        position = list(message.position)
        if len(position) != len(message.name):
            self._counts["refused"] += 1
            return
        corrected = []
        try:
            if x is not None and y is not None:
                corrected += zip((x, y), self._compensator.correct(position[x], position[y]),
                                 strict=True)
            if theta is not None and self._compensator.has_theta:
                corrected.append((theta, self._compensator.correct_theta(position[theta])))
        except InputError:
            corrected.append((0, math.nan))
        if not all(math.isfinite(value) for _, value in corrected):
            # Outside of the field with outside=refuse, beside an unknown site or line, or no
            # position at all.
            self._counts["refused"] += 1
            return
        for index, value in corrected:
            position[index] = float(value)
        message.position = position
        self._counts["corrected"] += 1
        self._corrected.publish(message)


def main() -> None:
    """Run the node."""
    sys.exit(run(CompensatorNode))


if __name__ == "__main__":
    main()
