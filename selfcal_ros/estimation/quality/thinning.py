# SPDX-License-Identifier: Apache-2.0
"""Readings without some marks or lines, with what belongs to them: visits, counts, reasons."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from selfcal_ros.model.readings import Measurements, ViewReadings

REASON = "outlier_among_views"

Key = tuple[int, str, tuple[int, ...]]
"""A reading: position of its view, ``grid`` or ``angular``, and (m, n) or (k,)."""


def subset(view: ViewReadings, grid: np.ndarray, lines: np.ndarray) -> ViewReadings:
    """Return the readings of a view where the masks over its marks and lines are true."""
    return replace(
        view, **{name: getattr(view, name)[grid] for name in ("m", "n", "dx", "dy", "count")},
        **{name: getattr(view, name)[lines] for name in ("k", "dtheta", "count_theta")},
        u=view.u[grid] if len(view.u) else view.u,
        u_theta=view.u_theta[lines] if len(view.u_theta) else view.u_theta,
        visits=None if view.visits is None else view.visits.of_marks(grid))


def left_out(measurements: Measurements, index: int) -> Measurements:
    """Return the measurement without the readings of one view, counted as rejected."""
    view = measurements.views[index]
    lost = int(view.count.sum() + view.count_theta.sum())
    empty = subset(view, np.zeros(len(view.m), dtype=bool), np.zeros(len(view.k), dtype=bool))
    views = (*measurements.views[:index], _rejecting(empty, lost), *measurements.views[index + 1:])
    return replace(measurements, views=views)


def without(measurements: Measurements, gone: Iterable[Key], *,
            mark: bool = False) -> Measurements:
    """Return the measurement without some readings; `mark` counts them as rejected."""
    views, keys = [], set(gone)
    for index, view in enumerate(measurements.views):
        marks = {key[2] for key in keys if key[0] == index and key[1] == "grid"}
        lines = {key[2][0] for key in keys if key[0] == index and key[1] == "angular"}
        views.append(_thinned(view, marks, lines, mark=mark) if marks or lines else view)
    return replace(measurements, views=tuple(views))


def _thinned(view: ViewReadings, marks: set[tuple[int, ...]], lines: set[int], *,
             mark: bool) -> ViewReadings:
    keep = np.array([(int(m), int(n)) not in marks for m, n in zip(view.m, view.n, strict=True)],
                    dtype=bool)
    stay = np.array([int(k) not in lines for k in view.k], dtype=bool)
    lost = int(view.count[~keep].sum() + view.count_theta[~stay].sum())
    thinned = subset(view, keep, stay)
    return _rejecting(thinned, lost) if mark else thinned


def _rejecting(view: ViewReadings, lost: int) -> ViewReadings:
    rejected = {**view.rejected, REASON: view.rejected.get(REASON, 0) + lost}
    return replace(view, rejected=rejected, used=view.used - lost)
