# SPDX-License-Identifier: Apache-2.0
"""A machine cell with known truth: the messages that it publishes while it measures a view.

The stage moves from mark to mark, dwells, and the microscope exposes in the middle of the
dwell. What is seen follows the measurement model of `truth` to the last bit of rounding.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.messages import Command, Detection, EncoderSample, Kind, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import Plan
from selfcal_ros.simulation.truth import Truth, angular_deviation, grid_deviation

DWELL = 0.6
"""Part of an exposure period in which the stage rests."""
JOINTS = ("x", "y", "theta")

Event = EncoderSample | Detection | Command


@dataclass(frozen=True)
class CellSettings:
    """How the cell measures: SI units, rates in Hz, periods in s."""

    sense: Sense = Sense.MICROSCOPE_MOVES
    sigma_xy_m: float = 0.0
    sigma_theta_rad: float = 0.0
    encoder_rate_hz: float = 500.0
    exposure_period_s: float = 0.01
    with_ids: bool = True
    declare_sigma: bool = False
    servo_sigma_m: float = 20e-9
    servo_sigma_rad: float = 1e-7

    def __post_init__(self) -> None:
        """Refuse a dwell too short for encoder samples on both sides of the exposure."""
        if DWELL * self.exposure_period_s * self.encoder_rate_hz < 2.5:
            raise InputError("simulated cell", f"{self.encoder_rate_hz:g} Hz gives fewer than "
                             f"2.5 encoder samples in a dwell of "
                             f"{DWELL * self.exposure_period_s:g} s",
                             "raise encoder_rate or exposure_period")


def view_events(truth: Truth, plan: Plan, index: int, *, settings: CellSettings,
                rng: np.random.Generator, start_ns: int) -> Iterator[EncoderSample | Detection]:
    """Yield encoder samples and detections of view `index` in the order of their stamps.

    Every mark is visited `repeats` times, in passes over the plate, grid first. The first stamp
    is `start_ns`.
    """
    targets, offsets, marks = _exposures(truth, plan, index, settings, rng)
    period_ns = round(settings.exposure_period_s * 1e9)
    step_ns = round(1e9 / settings.encoder_rate_hz)
    dwell_ns = round(DWELL * period_ns)
    end_ns = start_ns + period_ns * len(targets)
    exposed = 0
    for stamp in range(start_ns, end_ns + 1, step_ns):
        while exposed < len(targets):
            at = start_ns + exposed * period_ns + dwell_ns // 2 + 1  # between two samples
            if at > stamp:
                break
            yield _detection(at, offsets[exposed], marks[exposed], settings)
            exposed += 1
        yield EncoderSample(stamp, JOINTS, _position(targets, stamp - start_ns, period_ns,
                                                     dwell_ns))


def plan_events(truth: Truth, plan: Plan, *, settings: CellSettings, rng: np.random.Generator,
                start_ns: int) -> Iterator[Event]:
    """Yield all messages of a plan, commands included, in the order of their stamps."""
    now = start_ns
    pause_ns = 20_000_000
    for index, view in enumerate(plan.views):
        for phase in (Phase.PLACE, Phase.MEASURE):
            yield Command(now, phase, plan.plan_id, index, view, plan.artifact, len(plan.views))
            now += pause_ns
        for event in view_events(truth, plan, index, settings=settings, rng=rng, start_ns=now):
            yield event
            now = max(now, event.stamp_ns)
        now += pause_ns
    yield Command(now, Phase.DONE, plan.plan_id, len(plan.views), views_planned=len(plan.views))


def _exposures(truth: Truth, plan: Plan, index: int, settings: CellSettings,
               rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
    """Return stage positions (E, 3), offsets seen (E, 3) and marks (kind, m, n, k) in order."""
    view = plan.views[index]
    targets, offsets, marks = [np.zeros((0, 3))], [np.zeros((0, 3))], []
    for _ in range(view.repeats if view.grid else 0):
        t, o, found = _grid_pass(truth, plan, index, settings, rng)
        targets, offsets, marks = [*targets, t], [*offsets, o], marks + found
    for _ in range(view.repeats if view.angular else 0):
        t, o, found = _angular_pass(truth, plan, index, settings, rng)
        targets, offsets, marks = [*targets, t], [*offsets, o], marks + found
    return np.concatenate(targets), np.concatenate(offsets), marks


def _grid_pass(truth: Truth, plan: Plan, index: int, settings: CellSettings,
               rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
    artifact, view = plan.artifact, plan.views[index]
    deviation = grid_deviation(truth, index, view, sense=settings.sense)
    deviation = deviation + rng.normal(0, settings.sigma_xy_m, deviation.shape)
    seen = np.argwhere(np.isfinite(deviation).all(axis=0))
    seen = seen[np.lexsort((np.where(seen[:, 0] % 2, -seen[:, 1], seen[:, 1]), seen[:, 0]))]
    i, j = seen.T
    m, n = artifact.m[i, j], artifact.n[i, j]
    site = np.stack(view.lattice_pose(artifact).site_of(m, n)) * artifact.grid_pitch_m
    sign = -1 if settings.sense is Sense.PLATE_MOVES else 1
    position = sign * site + rng.normal(0, settings.servo_sigma_m, site.shape)
    offset = (site + deviation[:, i, j]) - sign * position
    zero = np.zeros(len(m))
    marks = [(Kind.GRID, int(a), int(b), 0) for a, b in zip(m, n, strict=True)]
    return np.stack([*position, zero], axis=1), np.stack([*offset, zero], axis=1), marks


def _angular_pass(truth: Truth, plan: Plan, index: int, settings: CellSettings,
                  rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, list[tuple]]:
    count = plan.artifact.angular_count
    deviation = angular_deviation(truth, index, plan.views[index], sense=settings.sense)
    deviation = deviation + rng.normal(0, settings.sigma_theta_rad, count)
    line = np.arange(count)
    turn = (line + plan.views[index].lattice_pose(plan.artifact).turn_lines) % count
    nominal = turn * (2 * np.pi / count)
    sign = -1 if settings.sense is Sense.PLATE_MOVES else 1
    position = sign * nominal + rng.normal(0, settings.servo_sigma_rad, count)
    offset = (nominal + deviation) - sign * position
    zero = np.zeros(count)
    return (np.stack([zero, zero, position], axis=1), np.stack([zero, zero, offset], axis=1),
            [(Kind.ANGULAR, 0, 0, int(k)) for k in line])


def _position(targets: np.ndarray, elapsed_ns: int, period_ns: int,
              dwell_ns: int) -> tuple[float, ...]:
    number, within = divmod(elapsed_ns, period_ns)
    here = targets[min(number, len(targets) - 1)]
    if within > dwell_ns and number + 1 < len(targets):
        part = (within - dwell_ns) / (period_ns - dwell_ns)
        here = here + (targets[number + 1] - here) * part
    return tuple(here.tolist())


def _detection(stamp_ns: int, offset: np.ndarray, mark: tuple, settings: CellSettings) -> Detection:
    kind, m, n, k = mark
    sigma = settings.sigma_xy_m if kind == Kind.GRID else settings.sigma_theta_rad
    ids = (m, n, k) if settings.with_ids else (0, 0, 0)
    return Detection(stamp_ns, int(kind), settings.with_ids, *ids, *offset.tolist(),
                     sigma if settings.declare_sigma else 0.0, 0.95)
