# SPDX-License-Identifier: Apache-2.0
"""The angular part of the picture: the error of every line around the circle."""

from collections.abc import Mapping

import numpy as np
from matplotlib.projections.polar import PolarAxes
from matplotlib.ticker import MaxNLocator

from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.reporting.maps.style import BAND, GRID, INK, TRUTH
from selfcal_ros.units import ARCSEC_PER_RAD

MARKED_LINES = 120
"""Up to so many lines each gets a dot."""

LABEL_ANGLE = np.deg2rad(22.5)
"""Where the radial scale is labelled, clear of the labels of the angles."""


def draw_theta(axes: PolarAxes, emap: ErrorMap, *,
               truth: Mapping[str, np.ndarray] | None = None) -> None:
    """Draw the angular error as distance from a zero circle (after Hu, figure 5).

    Parameters
    ----------
    axes : matplotlib.projections.polar.PolarAxes
        Where to draw.
    emap : ErrorMap
        The map; unknown lines leave a gap.
    truth : mapping, optional
        ``g_theta`` (K,), rad.
    """
    around = np.append(emap.artifact.theta_rad, 2 * np.pi)
    error, u = _closed(emap.g_theta), _closed(emap.u_g_theta)
    banded = bool(np.isfinite(u).any() and np.nanmax(u) > 0)
    curves = [error, error + 2 * np.nan_to_num(u), error - 2 * np.nan_to_num(u)]
    if banded:
        axes.fill_between(around, error - 2 * u, error + 2 * u, color=BAND, alpha=0.55,
                          linewidth=0, zorder=2, label="U (k=2)")
    if truth is not None and truth.get("g_theta") is not None:
        curves.append(_closed(np.asarray(truth["g_theta"], dtype=float)))
        axes.plot(around, curves[-1], color=TRUTH, linewidth=2.4, zorder=3, label="known truth")
    few = emap.artifact.angular_count <= MARKED_LINES
    axes.plot(around, error, color=INK, linewidth=1.1 if few else 0.7, zorder=4, label="measured",
              marker="o" if few else "", markersize=3)
    _finish(axes, np.concatenate(curves))


def _closed(values_rad: np.ndarray) -> np.ndarray:
    """Return the values in arcsec with the first one repeated at 360° (circle closure)."""
    return np.append(values_rad, values_rad[:1]) * ARCSEC_PER_RAD


def _finish(axes: PolarAxes, values: np.ndarray) -> None:
    finite = values[np.isfinite(values)]
    span = 1.08 * float(np.abs(finite).max()) if finite.size and np.abs(finite).max() > 0 else 1.0
    axes.set_rlim(-span, span)
    axes.set_rorigin(-2.2 * span)
    axes.plot(np.linspace(0, 2 * np.pi, 361), np.zeros(361), color=INK, linewidth=0.8,
              linestyle=(0, (4, 3)), zorder=1.5, label="no error")
    ticks = np.asarray(MaxNLocator(4, symmetric=True, steps=[1, 2, 5, 10]).tick_values(
        -span, span))
    ticks = ticks[np.abs(ticks) <= span]
    axes.set_yticks(ticks, [""] * len(ticks))
    for tick in ticks:
        axes.text(LABEL_ANGLE, tick, f"{tick:+.4g}" if tick else "0", fontsize=8, ha="center",
                  va="center", zorder=6,
                  bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85})
    axes.spines["inner"].set_color(GRID)
    axes.spines["polar"].set_color("#8a949e")
    axes.grid(color=GRID, linewidth=0.5)
    axes.set_title("θ error (indicated − true) in arcsec, outwards = counter-clockwise", pad=18)
