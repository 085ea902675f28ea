# SPDX-License-Identifier: Apache-2.0
"""From the exposures of a view to its readings, without messages: means, and visits."""

from dataclasses import replace

import numpy as np

from selfcal_ros.collection.marks.check_stops import without_aside
from selfcal_ros.collection.marks.visits import repeat_motion
from selfcal_ros.model.readings import GridVisits, Sense, ViewReadings
from selfcal_ros.model.view import View
from selfcal_ros.simulation.exposures import (
    AngularExposures,
    GridExposures,
    angular_exposures,
    grid_exposures,
)
from selfcal_ros.simulation.machine import Truth
from selfcal_ros.simulation.settings import CellSettings


def measured_view(truth: Truth, item: tuple[int, View], rng: np.random.Generator, *,
                  settings: CellSettings, missing: float, start_ns: int) -> ViewReadings:
    """Return the readings of a view, with its visits, as the collector would from its messages.

    Marks are those that the view expects, as for detections without ids.

    Parameters
    ----------
    truth : Truth
        What is measured.
    item : tuple
        Number of the view, and the view.
    rng : numpy.random.Generator
        Source of noise.
    settings : CellSettings
        How it is measured.
    missing : float
        Fraction of marks lost.
    start_ns : int
        When the view begins.
    """
    index, view = item
    readings = ViewReadings(view)
    if view.grid:
        exposures = grid_exposures(truth, index, view, settings=settings, rng=rng)
        readings = _grid(readings, truth, exposures, settings=settings,
                         lost=_lost(rng, missing, truth.artifact.shape), start_ns=start_ns)
    if view.angular and truth.artifact.angular_count:
        found = angular_exposures(truth, index, view, settings=settings, rng=rng)
        readings = _angular(readings, truth, found, sense=settings.sense,
                            lost=_lost(rng, missing, truth.artifact.angular_count))
    return replace(readings, used=int(readings.count.sum() + readings.count_theta.sum()))


def _lost(rng: np.random.Generator, missing: float, shape: tuple[int, ...] | int) -> np.ndarray:
    return rng.random(shape) < missing if missing else np.zeros(shape, dtype=bool)


def _read(sense: Sense, found: GridExposures | AngularExposures) -> np.ndarray:
    """Return where marks lie by what encoder and microscope say."""
    if sense is Sense.PLATE_MOVES:
        return found.offset - found.position
    return found.position + found.offset


def _grid(readings: ViewReadings, truth: Truth, found: GridExposures, *, settings: CellSettings,
          lost: np.ndarray, start_ns: int) -> ViewReadings:
    visits, (hx, hy) = found.visits, truth.artifact.half
    kept = ~lost[visits.m + hx, visits.n + hy] & found.there
    key = (visits.m + hx) * (2 * hy + 1) + visits.n + hy
    marks, mark = np.unique(key[kept], return_inverse=True)
    number = np.cumsum(kept) - 1  # of a visit among those kept
    here = kept[found.visit]
    visit = number[found.visit[here]]
    deviation = (_read(settings.sense, found) - found.site[:, found.visit])[:, here]
    count, of_mark = visits.count[kept], mark[visit]
    by_visit, sigma_visit, dof_visit = _means(deviation, visit, count)
    readings_of = np.bincount(mark, count).astype(int)
    by_mark, _, _ = _means(deviation, of_mark, readings_of)
    steady, fitted = without_aside(of_mark, deviation, found.offset[:, here],
                                   readings.view.check_offset_m)
    _, sigma, dof = _means(steady, of_mark, readings_of, fitted)
    offset, _, _ = _means(found.offset[:, here], visit, count)
    motion = repeat_motion(of_mark, (_read(settings.sense, found) - found.offset)[:, here],
                           found.offset[:, here], np.zeros(len(of_mark), dtype=bool))
    # the stage leaves for the first mark one period after the view begins
    first = start_ns + settings.period_ns + settings.exposure_ns
    stamp = first + np.rint(visits.time[kept] * settings.period_ns).astype(np.int64)
    order = np.lexsort((stamp, mark))
    dx, dy, ox, oy = (row[order] for row in (*by_visit, *offset))
    approach = found.approach[:, kept][:, order]
    return replace(
        readings, m=marks // (2 * hy + 1) - hx, n=marks % (2 * hy + 1) - hy, dx=by_mark[0],
        dy=by_mark[1], count=readings_of, sigma_xy=sigma, dof_xy=dof,
        motion=motion,
        visits=GridVisits(mark[order], dx, dy, count[order], stamp[order], ox, oy, approach[0],
                          approach[1], sigma_m=sigma_visit, dof=dof_visit))


def _angular(readings: ViewReadings, truth: Truth, found: AngularExposures, *, sense: Sense,
             lost: np.ndarray) -> ViewReadings:
    count = truth.artifact.angular_count
    turn = readings.view.lattice_pose(truth.artifact).s
    nominal = (found.k + turn) % count * (2 * np.pi / count)
    kept = ~lost[found.k]
    lines, line = np.unique(found.k[kept], return_inverse=True)
    repeats = np.bincount(line, minlength=len(lines))
    deviation, offset = (_read(sense, found) - nominal)[None, kept], found.offset[None, kept]
    (mean,), sigma, dof = _means(deviation, line, repeats)
    motion = repeat_motion(line, deviation - offset, offset, np.zeros(len(line), dtype=bool))
    return replace(readings, k=lines, dtheta=mean, count_theta=repeats, sigma_theta=sigma,
                   dof_theta=dof, motion_theta=motion)


def _means(values: np.ndarray, group: np.ndarray, count: np.ndarray, fitted: int = 0,
           ) -> tuple[np.ndarray, float, int]:
    """Return means (c, groups), the pooled standard deviation of one value, its freedom.

    Parameters
    ----------
    values : float array (c, n)
        In any unit.
    group : int array (n,)
        Group of each value.
    count : int array (groups,)
        Values in each group.
    fitted : int
        Numbers that were fitted to the values before.
    """
    mean = np.stack([np.bincount(group, row, len(count)) / count for row in values])
    dof = len(values) * int((count - 1).sum()) - fitted
    if dof <= 0:
        return mean, float("nan"), 0
    return mean, float(np.sqrt(((values - mean[:, group]) ** 2).sum() / dof)), dof
