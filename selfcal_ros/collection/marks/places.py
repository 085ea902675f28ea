# SPDX-License-Identifier: Apache-2.0
"""Where the stage stood when grid detections were rejected: a hint at dirt, or at a bad region."""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

from selfcal_ros.model.readings import RejectedPlaces, ViewReadings
from selfcal_ros.model.result import CalibrationResult


class PlaceList:
    """Gathers the rejected detections of a view with the indicated position at each."""

    def __init__(self, before: RejectedPlaces | None = None) -> None:
        before = before or RejectedPlaces()
        self._reason = [np.array(before.reason, dtype=object)]
        self._at = [np.stack([before.x, before.y])]

    def add(self, reasons: np.ndarray, at_m: np.ndarray) -> None:
        """Take rejected detections: their reasons (D,) and positions (2, D) in m."""
        self._reason.append(reasons)
        self._at.append(at_m)

    def places(self) -> RejectedPlaces:
        """Return the places; of more than `RejectedPlaces.MOST` an even choice."""
        reason, at = np.concatenate(self._reason), np.concatenate(self._at, axis=1)
        if len(reason) > RejectedPlaces.MOST:
            chosen = np.linspace(0, len(reason) - 1, RejectedPlaces.MOST).round().astype(int)
            reason, at = reason[chosen], at[:, chosen]
        return RejectedPlaces(tuple(map(str, reason)), *at)


def with_places(result: CalibrationResult, views: Iterable[ViewReadings]) -> CalibrationResult:
    """Return the result with the places of rejected detections, where there are any."""
    places = places_json(views)
    return replace(result, extra={**result.extra, "rejected_at": places}) if places else result


def places_json(views: Iterable[ViewReadings]) -> list[dict[str, Any]]:
    """Return the places for ``extra["rejected_at"]`` of a result: a row a view, m."""
    return [{"view": view.view.name, "reason": list(view.places.reason),
             "x": view.places.x.round(6), "y": view.places.y.round(6)}
            for view in views if view.places.reason]
