# SPDX-License-Identifier: Apache-2.0
"""An error map as geometry for RViz: enlarged error vectors, sites coloured by u, a legend."""

import math
from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.reporting.figures.drawing import round_down
from selfcal_ros.units import UM_PER_M

MOST_SITES = 51
"""Sites shown along a side; larger fields show every second, third, ... site."""
CERTAIN, UNCERTAIN, UNKNOWN = (0.85, 0.93, 1.0), (0.0, 0.27, 0.61), (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class MapGeometry:
    """What to draw, stage frame, m.

    Attributes
    ----------
    factor : float
        Enlargement of the error vectors: 1, 2 or 5 times a power of ten, so that the longest one
        is no longer than the distance of the sites shown.
    ends : float array (2 n, 3)
        Nominal site and head of its vector, in turn; head = site + factor * G.
    sites : float array (n, 3)
        Nominal sites.
    colours : float array (n, 3)
        RGB 0..1: pale where u is 0, dark where it is largest, grey where it is not known.
    spacing_m : float
        Distance of the sites shown.
    legend : str
        What length and colour mean.
    legend_at : tuple of float
        Place of the legend, below the field.
    """

    factor: float
    ends: np.ndarray
    sites: np.ndarray
    colours: np.ndarray
    spacing_m: float
    legend: str
    legend_at: tuple[float, float, float]


def map_geometry(error_map: ErrorMap) -> MapGeometry:
    """Return the geometry of the sites of `error_map` whose error is known."""
    artifact = error_map.artifact
    step = math.ceil(max(artifact.shape) / MOST_SITES)
    spacing = step * artifact.grid_pitch_m
    m, n = (np.arange(-half, half + 1) for half in artifact.half)
    shown = error_map.valid & ((m % step == 0)[:, None] & (n % step == 0)[None, :])
    i, j = np.nonzero(shown)
    sites = np.column_stack((m[i], n[j], np.zeros(len(i)))) * artifact.grid_pitch_m
    errors = np.column_stack((error_map.gx[shown], error_map.gy[shown], np.zeros(len(i))))
    longest = float(np.linalg.norm(errors, axis=1).max(initial=0.0))
    factor = enlargement(spacing, longest)
    ends = np.stack((sites, sites + factor * errors), axis=1).reshape(-1, 3)
    u = np.hypot(error_map.u_gx[shown], error_map.u_gy[shown])
    largest = float(np.max(u, where=np.isfinite(u), initial=0.0))
    legend = (f"stage error (indicated - true), enlarged {factor:,.0f} x, longest "
              f"{longest * UM_PER_M:.3g} um; dark: u = {largest * UM_PER_M:.3g} um (k=1)")
    below = -(artifact.half[1] * artifact.grid_pitch_m + 1.5 * spacing)
    return MapGeometry(factor, ends, sites, _colours(u, largest), spacing, legend,
                       (0.0, below, 0.0))


def enlargement(spacing_m: float, longest_m: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... times that keeps `longest_m` within `spacing_m`."""
    if longest_m <= 0 or longest_m >= spacing_m:
        return 1.0
    return round_down(spacing_m / longest_m)


def _colours(u: np.ndarray, largest: float) -> np.ndarray:
    part = (u / largest if largest > 0 else np.zeros_like(u))[:, None]
    colours = (1 - part) * CERTAIN + part * UNCERTAIN
    colours[~np.isfinite(u)] = UNKNOWN
    return colours
