# SPDX-License-Identifier: Apache-2.0
"""The progress of the measurement in one line for a person."""

import math
from collections.abc import Iterable

from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.errors import printable
from selfcal_ros.reporting.summary.numbers import arcsec, um


def progress_line(command: Command, view: ViewProgress | None) -> str:
    """Return the line of the newest command, and of its view where that is measured."""
    if command.phase in (Phase.DONE, Phase.ABORT):
        state = "done" if command.phase == Phase.DONE else "aborted"
        return f"plan '{printable(command.plan_id)}' {state}"
    of_all = f" of {command.views_planned}" if command.views_planned else ""
    head = f"view {command.view_index + 1}{of_all} '{printable(command.placed().name)}'"
    if command.phase == Phase.PLACE or view is None:
        return (
            f"{head}: the plate is to be placed"
            if command.phase == Phase.PLACE
            else head
        )
    return f"{head}: {', '.join(_phrases(view))}"


def _phrases(view: ViewProgress) -> list[str]:
    """Return what is done, what was rejected, and the noise of a view."""
    parts = [
        f"{done} of {expected} {what}"
        for done, expected, what in (
            (view.grid_done, view.grid_expected, "marks"),
            (view.angular_done, view.angular_expected, "lines"),
            (
                min(view.check_done, view.check_expected),
                view.check_expected,
                "check stops",
            ),
        )
        if expected
    ]
    # no mark is complete until the last pass
    if view.view.repeats > 1 and not view.complete:
        parts.append(
            f"{math.floor(100 * view.coverage)} % of {view.view.repeats} repeats"
        )

    readings = view.readings
    rejected = sorted(readings.rejected.items(), key=lambda item: (-item[1], item[0]))
    if rejected:
        parts.append(
            f"{sum(readings.rejected.values())} rejected ({counted_reasons(rejected)})"
        )

    if math.isfinite(readings.sigma_xy):
        parts.append(f"σ {um(readings.sigma_xy)}")
    elif math.isfinite(readings.sigma_theta):
        parts.append(f"σ {arcsec(readings.sigma_theta)}")
    return parts


def counted_reasons(counts: Iterable[tuple[str, int]]) -> str:
    """Return reasons with their counts, in the order given."""
    return ", ".join(f"{printable(reason)} {count}" for reason, count in counts)
