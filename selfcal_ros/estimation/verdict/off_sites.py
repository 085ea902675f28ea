# SPDX-License-Identifier: Apache-2.0
"""Test whether the stage stopped so far from the sites that its error there is unknown.

A reading contains the stage error at the position of the stage (method eq. 7.10), and the map gives
it between its sites by a spline. Two splines through the sites differ if the stage is rough from
site to site, and the maps with them; a solution that takes the sites for the positions misses the
whole difference. If all views are displaced alike, residuals show neither.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.blocks import AXES
from selfcal_ros.estimation.joint.fit import fit
from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.terms.columns import Column, ColumnBuilder
from selfcal_ros.estimation.terms.visits import ViewVisits
from selfcal_ros.model.error_map import ErrorMap, rms
from selfcal_ros.model.verdict import Cause

READING = "reading"

MOST = 6
"""Number of readings that are tested: those with the largest residuals."""


@dataclass(frozen=True, eq=False)
class PlacedSlip:
    """A slip known beforehand: its grid view, marks read after it, bool (nx, ny), places tried."""

    view: int
    after: np.ndarray
    places: int


def reading_columns(made: ColumnBuilder, residuals: np.ndarray,
                    phases: np.ndarray) -> Iterator[tuple[range, int, tuple[int, int]]]:
    """Add the columns of the readings with the largest residuals.

    Two for each reading: its errors along x and y, stage axes, m. Yield their indices, the view,
    and the place of the mark.

    Parameters
    ----------
    made : ColumnBuilder
        The columns.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    phases : complex array (views,)
        From the stage frame to the plate frame in each view.
    """
    weight = made.ground.weight
    squares = np.where(weight > 0, weight * abs(residuals) ** 2, -1.0)
    largest = np.argsort(squares, axis=None, kind="stable")[::-1][:MOST]
    for view, i, j in np.transpose(np.unravel_index(largest, squares.shape)).tolist():
        if squares[view, i, j] >= 0:
            mean = np.zeros(squares.shape[1:], dtype=complex)
            mean[i, j] = phases[view]
            shape = made.add({view: mean.reshape(-1)})
            for axis, unit in AXES:
                made.column(Column(READING, view, axis, np.inf), shape, unit)
            yield range(len(made.columns) - 2, len(made.columns)), view, (i, j)


SLIP = "slip"

PLACES = 12
"""Number of instants in each view at which a slip is tested."""


def slip_columns(made: ColumnBuilder) -> Iterator[tuple[range, int, float]]:
    """Add the columns of slips at some instants of the visits; yield indices, view and instant.

    Views whose visits are unknown have none. An instant is a part of the view's visits, 0..1.
    """
    for view, visits in enumerate(made.ground.visits):
        if visits is None:
            continue
        rank = np.argsort(np.argsort(visits.time, kind="stable"), kind="stable")
        for part in (np.arange(1, PLACES + 1) / (PLACES + 1)).tolist():
            after = rank >= round(part * len(rank))
            if 3 <= after.sum() <= len(after) - 3:
                at = made.ground.z.reshape(-1)[visits.mark]
                yield add_slip(made, view, (after * visits.phase, after * at), visits), view, part


def add_slip(made: ColumnBuilder, view: int, values: tuple[np.ndarray, np.ndarray],
             visits: ViewVisits | None = None) -> range:
    """Add the columns of a slip, and return their indices.

    Offset along x and y, stage axes, m, and rotation, m at the half width.

    Parameters
    ----------
    made : ColumnBuilder
        The columns.
    view : int
        The grid view.
    values : tuple of complex array
        A motion along x, and the places that a rotation moves, plate frame, 0 before the slip: at
        the visits, (V,), or at the marks, (marks,).
    visits : ViewVisits, optional
        The visits.
    """
    for one, parts in zip(values, (AXES, (("phi", 1j),)), strict=True):
        shape = made.add({view: one}) if visits is None else made.add(
            {view: visits.means(one[None], made.ground.z.size)[0]}, {view: one})
        for text, unit in parts:
            made.column(Column(SLIP, view, text, np.inf), shape, unit)
    return range(len(made.columns) - 3, len(made.columns))


OFF_SITES = "off_sites"

ROUNDING_M = 1e-15
"""Noise that replaces a noise of 0."""

SMALL = 0.02
"""Change of the readings, in standard uncertainties of the map (rms), that is ignored."""

LEAST_U_M = 1e-10
"""Smallest standard uncertainty of the map in these tests: finite rotations of a stage that is
rotated relative to its datum leave as much."""

ROUGH = 2.5
"""Ratio of the error of the spline to its difference from a spline with slopes from neighbours,
for a stage whose errors at neighbouring sites are independent; smaller for smoother stages."""

SHOWN = 0.9
"""Ratio of residuals without the change to those with it below which residuals show it as well."""

RMS_MATTERS = 0.5
"""Effect on the map, in standard uncertainties (rms), above which it is a cause."""

NODE_MATTERS = 2.0
"""Effect on a coordinate of a node, in its standard uncertainty, above which it is a cause."""


DRAWS = 16
"""Draws of noise from which the effect of the map's noise is computed."""


@dataclass(frozen=True, eq=False)
class OffSites:
    """A stage off the sites as a cause, and its effect on the map.

    Attributes
    ----------
    cause : Cause
        The cause.
    moved : complex array (nx, ny)
        Effect on the map along x and y, frame of the equations, m.
    shown : bool
        Whether residuals show it as well.
    bounded : bool
        Whether the effect is smaller than the uncertainty that it enlarges.
    """

    cause: Cause
    moved: np.ndarray
    shown: bool
    bounded: bool


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
    problem, places = model.problem, model.problem.places
    if places is None:
        return None
    u = np.maximum(_uncertainty(model, error_map), LEAST_U_M)
    known = problem.system.known_sites
    there = places.errors(model.found.field)
    changed = places.changes(_missed(model, model.found.field, there), problem.turn_rad)
    if not rms(_parts(changed)) > SMALL * rms(u):
        return None
    before, other = model.found.xy.residuals, fit(problem, model.y - changed)
    if other.xy.residuals < before:  # part of the residual noise is this effect
        u = u * (other.xy.residuals / before)
    moved = np.where(known, model.found.field - other.field, 0.0)
    ratio = np.where(known, np.abs(_parts(moved)) / u, 0.0)
    if not (rms(ratio[:, known]) > RMS_MATTERS or ratio.max() > NODE_MATTERS):
        return None
    noise = np.maximum(_noise(model, there, u), ROUNDING_M)
    effect = np.abs(_parts(moved))
    p = effect.size * math.erfc(float((effect / noise).max()) / math.sqrt(2))
    if p >= level:
        return None
    worst = np.unravel_index(int(effect.argmax()), effect.shape)
    cause = Cause(OFF_SITES, float(effect[worst]), float(noise[worst]), "m", p,
                  details={"away": places.distance * places.pitch_m}, effect_rms=rms(effect),
                  effect_max=float(effect[worst]))
    return OffSites(cause, moved, bool(other.xy.residuals < SHOWN * before),
                 rms(ratio[:, known]) < model.found.xy.k)


def _missed(model: ModelFit, field: np.ndarray, there: np.ndarray) -> np.ndarray:
    """Return the part of a field at the positions of the stage that a solution omits, (P,), m.

    Parameters
    ----------
    model : ModelFit
        The solution.
    field : complex array (nx, ny)
        Stage error at the sites, m.
    there : complex array (P,)
        Stage error of the solution at the positions of the stage.
    """
    places: Any = model.problem.places
    smooth = places.moved(field, there)
    return ROUGH * (places.moved(field, there, local=True) - smooth) if model.problem.moves \
        else smooth


def _noise(model: ModelFit, there: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return the standard deviation of `_missed` at each site for noise u of the nodes, m.

    Both (2, nx, ny).
    """
    places: Any = model.problem.places
    rng, at = np.random.default_rng(0), places.site
    total, n_sites = np.zeros((2, u[0].size)), u[0].size
    for _ in range(DRAWS):
        drawn = rng.normal(0, u)
        missed = _missed(model, drawn[0] + 1j * drawn[1], there)
        total += [np.bincount(at, part**2, n_sites) for part in _parts(missed)]
    return np.sqrt(total / (DRAWS * np.maximum(np.bincount(at, minlength=n_sites), 1))
                   ).reshape(u.shape)


def _parts(field: np.ndarray) -> np.ndarray:
    return np.stack([field.real, field.imag])


def _uncertainty(model: ModelFit, error_map: ErrorMap) -> np.ndarray:
    """Return the standard uncertainty in the frame of the equations, (2, nx, ny), m.

    If it was not computed, that of a mean reading, which a map from three views comes close to.
    """
    u, grid = np.stack([error_map.u_gx, error_map.u_gy]), model.problem.system.grid
    if not np.isfinite(u).any():
        return np.full_like(u, model.found.xy.sigma / math.sqrt(grid.weight[grid.read].mean()))
    u = np.nan_to_num(u, nan=rms(u))
    return u if model.problem.ground.indicated > 0 else u[:, ::-1, ::-1]  # method eq. 1.6
