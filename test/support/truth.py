# SPDX-License-Identifier: Apache-2.0
"""Readings of a machine with known truth, visit by visit, without messages."""

from dataclasses import replace

import numpy as np

from selfcal_ros.applications.papers import readings as white
from selfcal_ros.applications.papers.readings import (
    angular_deviation,
    grid_deviation,
    hu_plan,
)
from selfcal_ros.collection.marks.repeats import repeat_motion
from selfcal_ros.collection.marks.stops import without_aside
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import GridVisits, Measurements, Sense, ViewReadings
from selfcal_ros.model.view import Plan, View
from selfcal_ros.model.visit_order import stage_targets
from selfcal_ros.simulation import cell
from selfcal_ros.simulation.machine import Spread, Truth, random_truth
from selfcal_ros.simulation.physics import rotate

__all__ = [
    "Spread",
    "Truth",
    "angular_deviation",
    "grid_deviation",
    "hu_plan",
    "random_truth",
    "rotate",
    "simulate_measurements",
]

FIRST_STAMP_NS = 1_700_000_000_000_000_000
BETWEEN_VIEWS_NS = 60_000_000_000
"""Time to place the plate again."""


def simulate_measurements(
    truth: Truth,
    plan: Plan,
    rng: np.random.Generator,
    *,
    sigma_m: float = 0.0,
    sigma_theta_rad: float = 0.0,
    sense: Sense = Sense.MICROSCOPE_MOVES,
    missing: float = 0.0,
    linear: bool | None = None,
    visits: bool = False,
    settings: cell.CellSettings | None = None,
) -> Measurements:
    """Return the readings of all views, with noise and missing marks.

    Parameters
    ----------
    truth, plan, rng
        Truth, plan, and the source of noise.
    sigma_m, sigma_theta_rad : float
        Standard deviation of one reading; each mark is the mean of the view's repeats.
    sense : Sense
        What moves.
    missing : float
        Fraction of marks lost, independently in each view.
    linear : bool, optional
        Whether rotations are linearised, as in the papers; default as in the truth.
    visits : bool
        Whether to include the visits of marks; always if visits differ by more than white noise.
    settings : CellSettings, optional
        Settings of the cell; replaces `sigma_m`, `sigma_theta_rad` and `sense`.
    """
    truth = truth if linear is None else replace(truth, linear=linear)
    if (
        visits
        or settings
        or differs_by_visit(truth)
        or any(view.image for view in plan.views)
    ):
        settings = settings or cell.CellSettings(
            sense,
            sigma_m,
            sigma_theta_rad,
            servo_sigma_m=0.0,
            servo_sigma_theta_rad=0.0,
        )
        return _by_visit(truth, plan, rng, settings=settings, missing=missing)
    return white.simulate_measurements(
        truth,
        plan,
        rng,
        sigma_m=sigma_m,
        sense=sense,
        sigma_theta_rad=sigma_theta_rad,
        missing=missing,
    )


def differs_by_visit(truth: Truth) -> bool:
    """Return whether visits of a mark differ by more than noise."""
    return bool(truth.placed) or any(
        np.any(values)
        for values in (
            truth.microscope,
            truth.wiring - np.eye(2),
            truth.line_factor - 1,
            truth.distortion,
            truth.backlash_m,
            truth.backlash_growth_m,
            truth.settling_m,
            truth.drift_m,
            truth.walk_m,
        )
    )


def _of_cell(
    exposures: cell.GridExposures, artifact: Artifact, sub_view: View
) -> cell.GridExposures:
    """Return the exposures as those of the marks in a cell, offsets from its place."""
    if sub_view.cell is None:
        return exposures
    visits = exposures.visits
    seen = next(
        (one for one in exposures.others if one.cell == sub_view.cell), None
    ) or cell.Seen(
        (0, 0), exposures.offset, np.stack([visits.m, visits.n]), exposures.there
    )
    m, n = seen.mark
    place = np.array([[sub_view.cell_m.real], [sub_view.cell_m.imag]])
    return replace(
        exposures,
        visits=replace(visits, m=m, n=n),
        offset=seen.offset - place,
        mark=seen.mark,
        there=seen.there,
        others=(),
    )


def _by_visit(
    truth: Truth,
    plan: Plan,
    rng: np.random.Generator,
    *,
    settings: cell.CellSettings,
    missing: float,
) -> Measurements:
    views: list[ViewReadings] = []
    start_ns = FIRST_STAMP_NS
    for item in enumerate(plan.views):
        made = measured_view(
            truth, item, rng, settings=settings, missing=missing, start_ns=start_ns
        ).parts
        views += made
        start_ns += (
            sum(part.used for part in made) + 1
        ) * settings.period_ns + BETWEEN_VIEWS_NS
    return Measurements(plan.plan_id, plan.artifact, tuple(views), settings.sense)


def measured_view(
    truth: Truth,
    item: tuple[int, View],
    rng: np.random.Generator,
    *,
    settings: cell.CellSettings,
    missing: float,
    start_ns: int,
) -> ViewReadings:
    """Return the readings of a view, with its visits, as from the collector.

    Marks are those that the view expects, as for detections without ids.

    Parameters
    ----------
    truth : Truth
        The truth.
    item : tuple
        Index of the view, and the view.
    rng : numpy.random.Generator
        Source of noise.
    settings : CellSettings
        Settings of the cell.
    missing : float
        Fraction of marks lost.
    start_ns : int
        Beginning of the view.
    """
    index, view = item
    parts = [ViewReadings(sub) for sub in view.sub_views]
    if view.grid:
        exposures = cell.grid_exposures(truth, index, view, settings=settings, rng=rng)
        lost = _lost(rng, missing, truth.artifact.shape)
        parts = [
            _grid(
                part,
                truth,
                _of_cell(exposures, truth.artifact, part.view),
                settings=settings,
                lost=lost,
                start_ns=start_ns,
            )
            for part in parts
        ]
    if view.angular and truth.artifact.angular_count:
        found = cell.angular_exposures(truth, index, view, settings=settings, rng=rng)
        lines = _lost(rng, missing, truth.artifact.angular_count)
        parts = [
            _angular(part, truth, found, sense=settings.sense, lost=lines)
            if part.view.angular
            else part
            for part in parts
        ]
    parts = [
        replace(part, used=int(part.count.sum() + part.count_theta.sum()))
        for part in parts
    ]
    return (
        parts[0] if len(parts) == 1 else replace(ViewReadings(view), cells=tuple(parts))
    )


def _lost(
    rng: np.random.Generator, missing: float, shape: tuple[int, ...] | int
) -> np.ndarray:
    return rng.random(shape) < missing if missing else np.zeros(shape, dtype=bool)


def _read(
    sense: Sense, found: cell.GridExposures | cell.AngularExposures
) -> np.ndarray:
    """Return the positions of marks as read by encoder and microscope."""
    if sense is Sense.PLATE_MOVES:
        return found.offset - found.position
    return found.position + found.offset


def _grid(
    readings: ViewReadings,
    truth: Truth,
    found: cell.GridExposures,
    *,
    settings: cell.CellSettings,
    lost: np.ndarray,
    start_ns: int,
) -> ViewReadings:
    visits, artifact = found.visits, truth.artifact
    kept = ~lost[artifact.index(visits.m, visits.n)] & found.there
    key = artifact.flat(visits.m, visits.n)
    marks, mark = np.unique(key[kept], return_inverse=True)
    number = np.cumsum(kept) - 1  # index of a visit among those kept
    here = kept[found.visit]
    visit = number[found.visit[here]]
    site = stage_targets(artifact, readings.view, visits, Sense.MICROSCOPE_MOVES)
    deviation = (_read(settings.sense, found) - site[:, found.visit])[:, here]
    count, of_mark = visits.count[kept], mark[visit]
    by_visit, sigma_visit, dof_visit = _means(deviation, visit, count)
    readings_of = np.bincount(mark, count).astype(int)
    by_mark, _, _ = _means(deviation, of_mark, readings_of)
    steady, fitted = without_aside(
        of_mark, deviation, found.offset[:, here], readings.view.check_offset_m
    )
    _, sigma, dof = _means(steady, of_mark, readings_of, fitted)
    offset, _, _ = _means(found.offset[:, here], visit, count)
    motion = repeat_motion(
        of_mark,
        (_read(settings.sense, found) - found.offset)[:, here],
        found.offset[:, here],
        np.zeros(len(of_mark), dtype=bool),
    )
    # the stage moves to the first mark one period after the view begins
    first = start_ns + settings.period_ns + settings.exposure_ns
    stamp = first + np.rint(visits.time[kept] * settings.period_ns).astype(np.int64)
    order, (m, n) = (
        np.lexsort((stamp, mark)),
        artifact.marks_at(*np.divmod(marks, artifact.shape[1])),
    )
    dx, dy, ox, oy = (row[order] for row in (*by_visit, *offset))
    approach = found.approach[:, kept][:, order]
    return replace(
        readings,
        m=m,
        n=n,
        dx=by_mark[0],
        dy=by_mark[1],
        count=readings_of,
        sigma_xy=sigma,
        dof_xy=dof,
        motion=motion,
        visits=GridVisits(
            mark[order],
            dx,
            dy,
            count[order],
            stamp[order],
            ox,
            oy,
            approach[0],
            approach[1],
            sigma_m=sigma_visit,
            dof=dof_visit,
        ),
    )


def _angular(
    readings: ViewReadings,
    truth: Truth,
    found: cell.AngularExposures,
    *,
    sense: Sense,
    lost: np.ndarray,
) -> ViewReadings:
    count = truth.artifact.angular_count
    turn = readings.view.on_stage(truth.artifact).s
    nominal = (found.k + turn) % count * (2 * np.pi / count)
    kept = ~lost[found.k]
    lines, line = np.unique(found.k[kept], return_inverse=True)
    repeats = np.bincount(line, minlength=len(lines))
    deviation, offset = (
        (_read(sense, found) - nominal)[None, kept],
        found.offset[None, kept],
    )
    (mean,), sigma, dof = _means(deviation, line, repeats)
    motion = repeat_motion(
        line, deviation - offset, offset, np.zeros(len(line), dtype=bool)
    )
    about = np.angle(np.exp(1j * (deviation - offset))).mean()
    return replace(
        readings,
        axis_theta=float(about),
        k=lines,
        dtheta=mean,
        count_theta=repeats,
        sigma_theta=sigma,
        dof_theta=dof,
        motion_theta=motion,
    )


def _means(
    values: np.ndarray, group: np.ndarray, count: np.ndarray, fitted: int = 0
) -> tuple[np.ndarray, float, int]:
    """Return means (c, groups), the pooled standard deviation of one value, and its dof.

    Parameters
    ----------
    values : float array (c, n)
        In any unit.
    group : int array (n,)
        Group of each value.
    count : int array (groups,)
        Number of values in each group.
    fitted : int
        Number of parameters fitted to the values before.
    """
    mean = np.stack([np.bincount(group, row, len(count)) / count for row in values])
    dof = len(values) * int((count - 1).sum()) - fitted
    if dof <= 0:
        return mean, float("nan"), 0
    return mean, float(np.sqrt(((values - mean[:, group]) ** 2).sum() / dof)), dof
