# SPDX-License-Identifier: Apache-2.0
"""When and how the readings behind a result were measured."""

from datetime import UTC, datetime
from typing import Any

from selfcal_ros import __version__
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.verdict import Provenance
from selfcal_ros.units import NS_PER_S


def provenance_of(measurements: Measurements, options: Options) -> Provenance:
    """Return what the readings tell of their origin: first and last exposure, visiting order.

    Where terms were estimated, who asked for them: ``options`` or ``plan``.

    The time of creation is left open: the same readings give the same result.
    """
    stamps = [stamp for view in measurements.views
              if view.visits is not None and len(view.visits.stamp_ns)
              for stamp in (int(view.visits.stamp_ns.min()), int(view.visits.stamp_ns.max()))]
    extra: dict[str, Any] = {"visit_order": {
        view.view.name: view.view.visit_order for view in measurements.views
        if view.view.visit_order}}
    if options.terms_from:
        extra["model_terms_from"] = options.terms_from
    duration = float("nan")
    if stamps:
        extra |= {"first_exposure": _iso(min(stamps)), "last_exposure": _iso(max(stamps))}
        duration = (max(stamps) - min(stamps)) / NS_PER_S
    return Provenance("", duration, __version__, extra)


def _iso(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601 in UTC; unchanged where it is not a date."""
    try:
        return datetime.fromtimestamp(stamp_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds")
    except (OverflowError, ValueError, OSError):
        return f"{stamp_ns} ns"
