# SPDX-License-Identifier: Apache-2.0
"""A machine cell with known truth: its messages during the measurement of a view.

The stage moves from mark to mark, dwells, and the microscope exposes in the middle of the dwell.
The stops and the measured offsets are computed in `exposures`.
"""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Kind, Phase
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.exposures import (
    CellSettings,
    angular_exposures,
    grid_exposures,
    lead_in,
)
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.units import NS_PER_S

__all__ = ["JOINTS", "CellSettings", "Event", "plan_events", "view_events"]

JOINTS = ("x", "y", "theta")

Event = EncoderSample | Detection | Command


def view_events(truth: Truth, plan: Plan, index: int, *, settings: CellSettings,
                rng: np.random.Generator, start_ns: int) -> Iterator[EncoderSample | Detection]:
    """Yield encoder samples and detections of view `index` in the order of their stamps.

    Every mark is visited `repeats` times, grid first. The first stamp is `start_ns`; the stage
    rests for a period, and approaches the first grid mark in + direction.
    """
    stops, offsets, marks = _exposures(truth, index, plan.views[index], settings, rng)
    period_ns, step_ns = settings.period_ns, round(NS_PER_S / settings.encoder_rate_hz)
    end_ns = start_ns + period_ns * len(stops)
    exposed = 0
    for stamp in range(start_ns, end_ns + 1, step_ns):
        while exposed < len(marks):
            at = start_ns + (exposed + 1) * period_ns + settings.exposure_ns
            if at > stamp:
                break
            if (mark := marks[exposed]) is not None:
                yield _detection(at, offsets[exposed], mark, settings)
            exposed += 1
        yield EncoderSample(stamp, JOINTS, _position(stops, stamp - start_ns, settings))


def plan_events(truth: Truth, plan: Plan, *, settings: CellSettings, rng: np.random.Generator,
                start_ns: int) -> Iterator[Event]:
    """Yield all messages of a plan, commands included, in the order of their stamps."""
    now = start_ns
    pause_ns = 20_000_000
    for index, view in enumerate(plan.views):
        for phase in (Phase.PLACE, Phase.MEASURE):
            yield Command(now, phase, plan.plan_id, index, view, plan.artifact, len(plan.views),
                          model_terms=plan.model_terms)
            now += pause_ns
        for event in view_events(truth, plan, index, settings=settings, rng=rng, start_ns=now):
            yield event
            now = max(now, event.stamp_ns)
        now += pause_ns
    yield Command(now, Phase.DONE, plan.plan_id, len(plan.views), views_planned=len(plan.views))


def _exposures(truth: Truth, index: int, view: View, settings: CellSettings,
               rng: np.random.Generator,
               ) -> tuple[np.ndarray, np.ndarray, list[tuple | None]]:
    """Return stops (E + 1, 3), the first before any exposure, offsets (E, 3) and marks.

    A mark is (kind, m, n, k), None if the plate has none there.
    """
    stops, offsets = [np.zeros((0, 3))], [np.zeros((0, 3))]
    marks: list[tuple | None] = []
    if view.grid:
        grid = grid_exposures(truth, index, view, settings=settings, rng=rng)
        zero = np.zeros(grid.position.shape[1])
        stops.append(np.stack([*grid.position, zero], axis=1))
        offsets.append(np.stack([*grid.offset, zero], axis=1))
        m, n, there = (row[grid.visit].tolist() for row in (*grid.mark, grid.there))
        marks += [(Kind.GRID, *ids, 0) if seen else None
                  for *ids, seen in zip(m, n, there, strict=True)]
    if view.angular:
        lines = angular_exposures(truth, index, view, settings=settings, rng=rng)
        zero = np.zeros(len(lines.k))
        stops.append(np.stack([zero, zero, lines.position], axis=1))
        offsets.append(np.stack([zero, zero, lines.offset], axis=1))
        marks += [(Kind.ANGULAR, 0, 0, k) for k in lines.line.tolist()]
    every = np.concatenate(stops)
    before = every[:1].copy()
    if view.grid:
        before[:, :2] = lead_in(truth, before[:, :2])
    return np.concatenate([before, every]), np.concatenate(offsets), marks


def _position(stops: np.ndarray, elapsed_ns: int, settings: CellSettings) -> tuple[float, ...]:
    number, within = divmod(elapsed_ns, settings.period_ns)
    here = stops[min(number, len(stops) - 1)]
    if within > settings.dwell_ns and number + 1 < len(stops):
        part = (within - settings.dwell_ns) / (settings.period_ns - settings.dwell_ns)
        here = here + (stops[number + 1] - here) * part
    return tuple(here.tolist())


def _detection(stamp_ns: int, offset: np.ndarray, mark: tuple, settings: CellSettings) -> Detection:
    kind, m, n, k = mark
    sigma = settings.sigma_xy_m if kind == Kind.GRID else settings.sigma_theta_rad
    m, n, k = (m, n, k) if settings.with_ids else (0, 0, 0)
    x, y, theta = offset.tolist()
    return Detection(stamp_ns, int(kind), settings.with_ids, m, n, k, x, y, theta,
                     sigma if settings.declare_sigma else 0.0, 0.95)
