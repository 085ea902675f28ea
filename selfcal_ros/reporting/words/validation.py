# SPDX-License-Identifier: Apache-2.0
"""A held-out validation in words."""

import numpy as np

from selfcal_ros.estimation.quality.validation import HeldOut
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M


def validation_text(found: list[HeldOut]) -> list[str]:
    """Return one line a held-out set, um and arcsec."""
    lines = []
    for item in found:
        if not item.n_grid and not item.n_angular:
            lines.append(f"{item.name}: {item.note}")
            continue
        parts = []
        if item.n_grid:
            parts.append(f"{item.n_grid} marks predicted within {item.rms_m * UM_PER_M:.4g} um "
                         f"rms, {item.max_m * UM_PER_M:.4g} um at most "
                         f"({item.ratio:.2f} times the noise{_limit_text(item)})")
        if item.n_angular:
            parts.append(f"{item.n_angular} lines within "
                         f"{item.rms_rad * ARCSEC_PER_RAD:.4g} arcsec rms")
        lines.append(f"{item.name}: " + ", ".join(parts))
    return lines


def _limit_text(item: HeldOut) -> str:
    if item.note:
        return f"; {item.note}"
    if not np.isfinite(item.limit):
        return ""
    return f", {'EXCEEDS' if item.exceeds else 'within'} the limit of {item.limit:.2f}"
