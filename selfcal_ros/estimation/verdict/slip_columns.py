# SPDX-License-Identifier: Apache-2.0
"""Columns of a plate that slips within a view: a second misalignment from some instant on."""

import numpy as np

from selfcal_ros.estimation.terms.columns import Column, TermColumns, columns_from
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.visits import ViewVisits

SLIP = "slip"

PLACES = 12
"""Instants in each view at which a slip is tried."""


def slip_columns(ground: Ground) -> tuple[TermColumns, dict[tuple[int, float], np.ndarray]]:
    """Return the columns of slips, and which of them belong to each view and instant.

    Three a slip: offset along x and y (stage axes, m), and rotation (m at the half width). Views
    whose visits are not known have none. An instant is a part of the view's visits, 0..1.
    """
    columns: list[Column] = []
    shapes: list[tuple[np.ndarray, tuple[complex, ...]]] = []
    groups: dict[tuple[int, float], list[int]] = {}
    for view, visits in enumerate(ground.visits):
        if visits is None:
            continue
        for part in np.arange(1, PLACES + 1) / (PLACES + 1):
            after = _after(visits, float(part))
            if not 3 <= after.sum() <= len(after) - 3:
                continue
            at = ground.z.reshape(-1)[visits.mark]
            groups[view, float(part)] = list(range(len(columns), len(columns) + 3))
            columns += [Column(SLIP, view, text, np.inf) for text in ("x", "y", "phi")]
            shapes += [(after * visits.phase, (1, 1j)), (after * at, (1j,))]
    made = columns_from(ground, columns, shapes)
    rows = {key: np.isin(np.arange(len(columns)), at) for key, at in groups.items()}
    return made, rows


def _after(visits: ViewVisits, part: float) -> np.ndarray:
    """Return which visits come after a part of them, in the order of their instants, bool (V,)."""
    rank = np.argsort(np.argsort(visits.time, kind="stable"), kind="stable")
    return rank >= round(part * len(rank))
