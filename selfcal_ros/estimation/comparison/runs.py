# SPDX-License-Identifier: Apache-2.0
"""The runs of a mean: whether they are of one stage, what sets their scale, when they were."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.error_map import ErrorMap, remove_modes, rms
from selfcal_ros.model.result import CalibrationResult

NO_SPREAD = 1e-30
FEWEST = 7
"""Values that are needed to be sure of a sign."""
SURE = 5.0
"""Errors over their u, rms, from which the sign of a map is beyond doubt."""
MIRRORED = -0.8
"""Correlation of two maps below which the negative of one agrees with the other."""
SAME = 1e-3
"""Difference of two maps, rms over u, below which they are of the same readings: two recordings
repeat each other no better than their noise."""
OTHER_UNIT = 300.0
"""How many times larger the errors in a table are that is not in m or rad."""


@dataclass(frozen=True, eq=False)
class Part:
    """A map to be combined: its file, and its calibration; None for a map of other origin."""

    name: str
    error_map: ErrorMap
    result: CalibrationResult | None = None


def require_own_readings(parts: Sequence[Part], known: np.ndarray, modes: np.ndarray) -> None:
    """Refuse a map that equals another but for its datum, or has another unit or sign."""
    emaps = [part.error_map for part in parts]
    u = [np.stack([emap.u_gx, emap.u_gy]) for emap in emaps]
    maps = [remove_modes(np.where(known, np.stack([emap.gx, emap.gy]), np.nan), modes)
            for emap in emaps]
    lines = [np.diff(emap.g_theta) for emap in emaps]
    first = next(index for index, part in enumerate(parts) if part.result is not None)
    for index, part in enumerate(parts):
        for values, unit, own in ((maps, "µm", u[first]),
                                  (lines, "µrad", emaps[first].u_g_theta)):
            ratio = rms(values[index]) / max(rms(values[first]), rms(own))
            if part.result is None and ratio > OTHER_UNIT:
                raise InputError(part.name, f"its errors are {ratio:.2g} times those of "
                                 f"{parts[first].name}: is it in {unit}?", "give m and rad")
        for signed, spread in ((maps, u), (lines, [np.sqrt(2) * emap.u_g_theta[1:]
                                                   for emap in emaps])):
            if part.result is None and _is_opposite(*(signed[n] / np.maximum(spread[n], NO_SPREAD)
                                                 for n in (index, first))):
                raise InputError(part.name, f"of the opposite sign to {parts[first].name}: its "
                                 "negative agrees, and it does not",
                                 "give G = indicated - true")
        for other in range(index):
            if rms((maps[index] - maps[other]) / np.minimum(u[index], u[other])) < SAME:
                raise InputError(part.name, f"of the same readings as {parts[other].name}: their "
                                 "maps are equal", "leave one of them out")


def _is_opposite(one: np.ndarray, other: np.ndarray) -> bool:
    """Return whether two maps, over their u, are each other's negative beyond doubt.

    The ratio of their likelihoods with one sign and the other is exp(2 one . other).
    """
    known = np.isfinite(one + other)
    a, b = one[known], other[known]
    if len(a) < FEWEST or min(rms(a), rms(b)) < SURE:
        return False
    return bool(a @ b < MIRRORED * np.sqrt((a @ a) * (b @ b)))


def shared_reference(results: Sequence[CalibrationResult | None],
                     weights: np.ndarray) -> dict[str, Any] | None:
    """Return what sets the scale of a mean that keeps it: the reference lengths of its runs.

    Parameters
    ----------
    results : sequence of CalibrationResult or None
        The runs; None for a map of other origin, whose reference is not known, so that the mean is
        not certified.
    weights : float array (runs,)
        Their weights in the mean.

    Returns
    -------
    dict or None
        None if a run has no reference length; that of all runs if it is the same; otherwise
        the weighted mean, with the reference of each under ``runs``.
    """
    own = [result for result in results if result is not None]
    found = [result.reference for result in own if result.reference]
    if len(found) < len(own):
        return None
    if len(own) < len(results):
        found = [_uncertified(each) for each in found]
    if all(each == found[0] for each in found):
        return found[0]
    share = np.array([weight for result, weight in zip(results, weights, strict=True) if result])
    errors = np.array([each["relative_error"] for each in found])
    names = dict.fromkeys(each.get("certificate") or "none" for each in found)
    return {**_uncertified(found[0]), "relative_error": float(share @ errors / share.sum()),
            "u_relative": max(each["u_relative"] for each in found),
            "certificate": "; ".join(names), "runs": found}


def _uncertified(reference: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in reference.items() if key != "certified"}


def exposures(results: Sequence[CalibrationResult | None]) -> dict[str, str]:
    """Return the first and the last exposure of all runs, where they are known."""
    times = [[str(result.provenance.extra.get(f"{end}_exposure", "")) for result in results
              if result] for end in ("first", "last")]
    if not all(map(all, times)):
        return {}
    return {"first_exposure": min(times[0]), "last_exposure": max(times[1])}
