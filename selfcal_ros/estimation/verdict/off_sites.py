# SPDX-License-Identifier: Apache-2.0
"""Whether the stage stood so far off the sites that the map describes other positions.

A reading contains the stage error where the stage stood, but counts for the site of the mark
(method eq. 7.10). If all views are displaced alike, residuals do not show it; but deviation and
offset of a visit, with the map, give the distance of the stage from the site.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from selfcal_ros.estimation.joint.fit import fit
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.terms.columns import (
    AXES,
    Column,
    TermColumns,
    WithinMarks,
    columns_from,
)
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.shapes import shapes_of
from selfcal_ros.estimation.terms.visits import ViewVisits
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.model.statistics import rms
from selfcal_ros.model.verdict import Cause

READING = "reading"

MOST = 6
"""Number of readings that are tested: those with the largest residuals."""


class Suspect(NamedTuple):
    """A reading that may be faulty: its grid view, its mark (m, n), and a mask of its columns."""

    view: int
    mark: tuple[int, int]
    rows: np.ndarray


def reading_columns(ground: Ground, residuals: np.ndarray,
                    phases: np.ndarray) -> tuple[TermColumns, list[Suspect]]:
    """Return the columns of the readings with the largest residuals, and these readings.

    Two for each reading: its errors along x and y, stage axes, m.

    Parameters
    ----------
    ground : Ground
        Inputs of the columns.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    phases : complex array (views,)
        From the stage frame to the plate frame in each view.
    """
    squares = np.where(ground.weight > 0, ground.weight * abs(residuals) ** 2, -1.0)
    largest = np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]
    at = [place for place in zip(*np.unravel_index(largest, squares.shape), strict=True)
          if squares[place] >= 0]
    half = ((squares.shape[1] - 1) // 2, (squares.shape[2] - 1) // 2)
    means, columns, found = [], [], []
    for number, (view, i, j) in enumerate(at):
        mean = np.zeros(squares.shape[1:], dtype=complex)
        mean[i, j] = phases[view]
        means.append({int(view): mean.reshape(-1)})
        columns += [Column(READING, int(view), axis, np.inf) for axis, _ in AXES]
        rows = np.arange(2 * len(at)) // 2 == number
        found.append(Suspect(int(view), (int(i) - half[0], int(j) - half[1]), rows))
    n, units = 2 * len(at), [unit for _, unit in AXES]
    shapes = shapes_of(means, [column // 2 for column in range(n)], units * len(at), ground.weight)
    nothing = WithinMarks(np.zeros((n, n)), np.zeros(n), 0.0, 0)
    return TermColumns(tuple(columns), shapes, nothing, [[None] * len(ground.names)] * len(at)
                       ), found


SLIP = "slip"

PLACES = 12
"""Number of instants in each view at which a slip is tested."""


def slip_columns(ground: Ground) -> tuple[TermColumns, dict[tuple[int, float], np.ndarray]]:
    """Return the columns of slips, and a mask of those of each view and instant.

    Three for each slip: offset along x and y (stage axes, m), and rotation (m at the half width).
    Views whose visits are unknown have none. An instant is a part of the view's visits, 0..1.
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
    """Return a mask of the visits after the first `part` of them in time, bool (V,)."""
    rank = np.argsort(np.argsort(visits.time, kind="stable"), kind="stable")
    return rank >= round(part * len(rank))


OFF_SITES = "off_sites"

ROUNDING_M = 1e-15
"""Noise that replaces a noise of 0."""

SMALL = 0.02
"""Change of the readings, in standard uncertainties of the map (rms), that is ignored."""

LEAST_U_M = 1e-10
"""Smallest standard uncertainty of the map in these tests: finite rotations of a stage that is
rotated relative to its datum leave as much."""

SHOWN = 0.9
"""Ratio of residuals without the change to those with it below which residuals show it as well."""

RMS_MATTERS = 0.5
"""Effect on the map, in standard uncertainties (rms), above which it is a cause."""

NODE_MATTERS = 2.0
"""Effect on a coordinate of a node, in its standard uncertainty, above which it is a cause."""


@dataclass(frozen=True, eq=False)
class OffSites:
    """A stage off the sites as a cause, and its effect on the map.

    Attributes
    ----------
    cause : Cause
        The cause.
    moved : complex array (nx, ny)
        Bound of the effect on the map along x and y, frame of the equations, m.
    shown : bool
        Whether residuals show it as well.
    """

    cause: Cause
    moved: np.ndarray
    shown: bool


def off_sites_cause(model: ModelFit, error_map: ErrorMap, level: float) -> OffSites | None:
    """Return the effect of a stage off the sites as a cause; None if it is small.

    Parameters
    ----------
    model : ModelFit
        The fit; views whose visits are unknown count as measured at the sites.
    error_map : ErrorMap
        Its map.
    level : float
        Level of the test against the noise of the map.
    """
    u = np.maximum(_uncertainty(model, error_map), LEAST_U_M)
    known = model.problem.system.known_sites
    field = np.where(known, model.found.field, np.nan)
    away, changed = _at_visits(model, field)
    if not rms(_parts(changed)) > SMALL * rms(u):
        return None
    before, at_sites = model.found.xy.residuals, fit(model.problem, model.y - changed)
    if at_sites.xy.residuals < before:  # displacements cause part of the noise
        u = u * (at_sites.xy.residuals / before)
    moved = _parts(model.found.field - at_sites.field)
    ratio = np.where(known, np.abs(moved) / u, np.nan)
    if not (rms(ratio) > RMS_MATTERS or np.nanmax(ratio) > NODE_MATTERS):
        return None
    noise = np.maximum(_noise(u, _pitch_m(model), (rms(away.real), rms(away.imag))), ROUNDING_M)
    effect = np.where(np.isfinite(ratio), np.abs(moved), 0.0)
    most = float(np.nanmax(effect / noise, initial=0.0))
    p = effect.size * math.erfc(most / math.sqrt(2))
    if p >= level:
        return None
    worst = np.unravel_index(int(effect.argmax()), effect.shape)
    shown = bool(at_sites.xy.residuals < SHOWN * before)
    cause = Cause(OFF_SITES, float(effect[worst]), float(noise[worst]), "m", p,
                  details={"away": rms(np.abs(away))}, effect_rms=rms(effect),
                  effect_max=float(effect[worst]))
    bound = _between(np.where(known, model.found.field, np.nan), _pitch_m(model), away)
    return OffSites(cause, np.where(known, bound, 0.0), shown)


def _between(field: np.ndarray, pitch_m: float, away: np.ndarray) -> np.ndarray:
    """Return the largest change of the error at that distance from the sites, complex (nx, ny).

    The slopes on the two sides of a site may differ: the steeper one counts.
    """
    total = np.zeros((2, *field.shape))
    for axis, distance in ((0, rms(away.real)), (1, rms(away.imag))):
        step = np.abs(_parts(np.diff(field, axis=axis)))
        pad = [(0, 0)] * 3
        pad[axis + 1] = (1, 1)
        both = np.pad(np.nan_to_num(step), pad)
        sides = np.stack([np.take(both, range(field.shape[axis]), axis=axis + 1),
                          np.take(both, range(1, field.shape[axis] + 1), axis=axis + 1)])
        total += sides.max(axis=0) * distance / pitch_m
    return total[0] + 1j * total[1]


def _parts(field: np.ndarray) -> np.ndarray:
    return np.stack([field.real, field.imag])


def _pitch_m(model: ModelFit) -> float:
    return model.problem.half_width_m / model.problem.system.grid.views.unit


def _uncertainty(model: ModelFit, error_map: ErrorMap) -> np.ndarray:
    """Return the standard uncertainty in the frame of the equations, (2, nx, ny), m.

    If it was not computed, that of a mean reading, which a map from three views comes close to.
    """
    u, grid = np.stack([error_map.u_gx, error_map.u_gy]), model.problem.system.grid
    if not np.isfinite(u).any():
        return np.full_like(u, model.found.xy.sigma / math.sqrt(grid.weight[grid.read].mean()))
    return u if model.problem.ground.indicated > 0 else u[:, ::-1, ::-1]  # method eq. 1.6


def _slopes(field: np.ndarray, pitch_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the slopes of a field along x and y, 0 where a neighbour is unknown.

    Central differences inside, one-sided ones at the border.
    """
    along_x, along_y = np.gradient(field, pitch_m)
    return np.nan_to_num(along_x), np.nan_to_num(along_y)


def _noise(u: np.ndarray, pitch_m: float, away_m: tuple[float, float]) -> np.ndarray:
    """Return the noise of slopes times distances, (2, nx, ny), m."""
    total = np.zeros_like(u)
    for axis, away in zip((1, 2), away_m, strict=True):
        square = np.moveaxis(u**2, axis, 0)
        of_slope = np.empty_like(square)
        of_slope[1:-1] = (square[2:] + square[:-2]) / 4
        of_slope[0], of_slope[-1] = square[0] + square[1], square[-1] + square[-2]
        total += np.moveaxis(of_slope, 0, axis) * (away / pitch_m) ** 2
    return np.sqrt(total)


def _at_visits(model: ModelFit, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the stage from the sites, and their effect on the readings.

    Complex, m: distances of all visits, stage frame, and effects on the means of the marks, plate
    frame, (views, nx, ny).
    """
    grid = model.problem.system.grid
    along_x, along_y = (slope.reshape(-1) for slope in _slopes(field, _pitch_m(model)))
    error = np.nan_to_num(field).reshape(-1)
    changed, distances = np.zeros_like(model.y), [np.zeros(1, dtype=complex)]
    for view, visits in enumerate(model.problem.ground.visits):
        if visits is None:
            continue
        site = grid.views.site_index[view].reshape(-1)[visits.mark]
        # the deviation as it was read, without the rotation of the frame
        turn = model.problem.turn_rad[view]
        mark = grid.views.z.reshape(-1)[visits.mark] * model.problem.half_width_m
        read = visits.y / visits.phase + mark * -np.expm1(-1j * turn) / visits.phase
        away = read - visits.offset - error[site]  # indicated less true
        change = away.real * along_x[site] + away.imag * along_y[site]
        mean = visits.means((change * visits.phase)[None], grid.n_sites)[0]
        changed[view] = np.where(grid.read[view], mean.reshape(grid.views.shape), 0.0)
        distances.append(away)
    return np.concatenate(distances), changed
