# SPDX-License-Identifier: Apache-2.0
"""What the runs of a mean have to say on it: their reference lengths, and when they were."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from selfcal_ros.model.result import CalibrationResult


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
