# SPDX-License-Identifier: Apache-2.0
"""A held-out validation in words: a line a set, and as the rows of a RESULT.json."""

from typing import Any

import numpy as np

from selfcal_ros.estimation.observability.plan_check import describe_view
from selfcal_ros.estimation.quality.validation import HeldOut
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.verdict import Finding
from selfcal_ros.model.view import View
from selfcal_ros.reporting.words.findings import held_out_text, sentence_of
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M


def why_text(why: Finding | None, artifact: Artifact) -> str:
    """Return why nothing could be predicted, or why it is not judged; empty for None."""
    if why is None or why.name != "rest_not_identified":
        return "" if why is None else sentence_of(why)
    more = "no single further view would change that"
    if add := (why.details or {}).get("add"):
        view = View("", add["rotation"], (add["translation_x"], add["translation_y"]),
                    add["grid"], add["angular"])
        more = f"with {describe_view(view, artifact)} measured as well it could be"
    return f"cannot be held out: the rest does not identify the stage; {more}"


def validation_json(found: list[HeldOut], artifact: Artifact) -> list[dict[str, Any]]:
    """Return the validation for ``extra["validation"]`` of a result: SI units."""
    return [{"name": held_out_text(item.view, item.tenth), "view": item.view,
             "n_grid": item.n_grid, "n_angular": item.n_angular, "rms_m": item.rms_m,
             "max_m": item.max_m, "rms_rad": item.rms_rad, "ratio": item.ratio,
             "note": why_text(item.why, artifact), "limit": item.limit,
             "exceeds": item.exceeds} for item in found]


def validation_text(found: list[HeldOut], artifact: Artifact) -> list[str]:
    """Return one line a held-out set, µm and arcsec."""
    lines = []
    for item in found:
        name, why = held_out_text(item.view, item.tenth), why_text(item.why, artifact)
        if not item.n_grid and not item.n_angular:
            lines.append(f"{name}: {why}")
            continue
        parts = []
        if item.n_grid:
            parts.append(f"{item.n_grid} marks predicted within {item.rms_m * UM_PER_M:.4g} µm "
                         f"rms, {item.max_m * UM_PER_M:.4g} µm at most "
                         f"({item.ratio:.2f} times the noise{_limit_text(item, why)})")
        if item.n_angular:
            parts.append(f"{item.n_angular} lines within "
                         f"{item.rms_rad * ARCSEC_PER_RAD:.4g} arcsec rms")
        lines.append(f"{name}: " + ", ".join(parts))
    return lines


def _limit_text(item: HeldOut, why: str) -> str:
    if why:
        return f"; {why}"
    if not np.isfinite(item.limit):
        return ""
    return f", {'EXCEEDS' if item.exceeds else 'within'} the limit of {item.limit:.2f}"
