# SPDX-License-Identifier: Apache-2.0
"""The XY part of the picture: magnified error vectors at the sites, and maps of size."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Colormap
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.reporting.maps.style import (
    BAND,
    BAND_EDGE,
    GRID,
    INK,
    TRUTH,
    error_colours,
    round_down,
)
from selfcal_ros.reporting.summary.format import significant
from selfcal_ros.units import MM_PER_M, UM_PER_M

MAX_ARROWS = 27
"""Most arrows along one side; larger fields show every second, third, ... site."""


@dataclass(frozen=True, eq=False)
class Arrows:
    """What is drawn of a field: sites (mm), vectors (m), and how much they are magnified."""

    step: int
    sites: tuple[slice, ...]
    x_mm: np.ndarray
    y_mm: np.ndarray
    magnification: float


def choose_arrows(emap: ErrorMap) -> Arrows:
    """Return which sites carry an arrow and the round magnification that keeps arrows apart.

    The centre site always carries one. 95 % of the arrows stay within 1.3 of their spacing,
    and the longest within 2.6 spacings.
    """
    artifact = emap.artifact
    step = max(1, math.ceil(max(artifact.shape) / MAX_ARROWS))
    sites = tuple(slice(half % step, None, step) for half in artifact.half)
    lengths = np.hypot(emap.gx, emap.gy)[emap.valid]
    spacing = step * artifact.grid_pitch_m
    magnification = 1.0
    if lengths.size and lengths.max() > 0:
        typical = max(float(np.percentile(lengths, 95)), float(lengths.max()) / 2)
        magnification = round_down(1.3 * spacing / typical)
    return Arrows(step, sites, artifact.x_m[sites] * MM_PER_M, artifact.y_m[sites] * MM_PER_M,
                  magnification)


def draw_error_map(axes: Axes, emap: ErrorMap, *, truth: Mapping[str, np.ndarray] | None = None,
                   ) -> None:
    """Draw magnified error vectors over the map of their length (after Hu, figure 4).

    Parameters
    ----------
    axes : matplotlib.axes.Axes
        Where to draw.
    emap : ErrorMap
        The map; unknown sites stay grey and without an arrow.
    truth : mapping, optional
        ``gx``, ``gy`` (nx, ny), m: drawn as wider arrows beneath.
    """
    arrows = choose_arrows(emap)
    _draw_size(axes, emap.artifact, np.hypot(emap.gx, emap.gy), error_colours(),
               label="length of the error |G|")
    _draw_lattice(axes, emap.artifact, arrows)
    if not emap.valid.any():
        axes.set_title("XY error: not one site is known")
        _finish(axes, emap.artifact)
        return
    entries = [_entry("measured", color=INK, linewidth=1.5)]
    if truth is not None:
        truth_g = tuple(np.where(emap.valid, truth[key], np.nan) for key in ("gx", "gy"))
        _quiver(axes, arrows, truth_g, color=TRUTH, zorder=3, thicker=2.2, head=False)
        entries.append(_entry("known truth", color=TRUTH, linewidth=4))
    if _draw_circles(axes, emap, arrows):
        entries.append(_entry("U (k=2)", linestyle="", marker="o", markersize=9, alpha=0.6,
                              markerfacecolor=BAND, markeredgecolor=BAND_EDGE))
    quiver = _quiver(axes, arrows, (emap.gx, emap.gy), color=INK, zorder=4)
    every = "" if arrows.step == 1 else f" at every {_ordinal(arrows.step)} site"
    axes.set_title(f"XY error (indicated − true){every}, enlarged {arrows.magnification:,.10g} ×")
    _finish(axes, emap.artifact, reach_mm=_reach(emap, arrows), strip=0.09)
    _draw_key(axes, emap, quiver, arrows)
    axes.legend(handles=entries, loc="lower right", ncols=3, frameon=False, fontsize=9,
                borderaxespad=0.3, handlelength=1.6, columnspacing=1.4)


def _entry(label: str, **style: Any) -> Line2D:
    return Line2D([], [], label=label, **style)


def _reach(emap: ErrorMap, arrows: Arrows) -> tuple[float, float]:
    """Return how far arrow heads and circles reach from the centre along x and y, mm."""
    reach = []
    for at, part, u in ((arrows.x_mm, emap.gx, emap.u_gx), (arrows.y_mm, emap.gy, emap.u_gy)):
        enlarge = MM_PER_M * arrows.magnification
        tips = np.abs(at + part[arrows.sites] * enlarge)
        tips = tips + 2 * np.nan_to_num(u[arrows.sites]) * enlarge
        reach.append(float(np.nanmax(tips, initial=0.0)))
    return reach[0], reach[1]


def _draw_size(axes: Axes, artifact: Artifact, size_m: np.ndarray, colours: Colormap, *,
               label: str) -> None:
    half = [(h + 0.5) * artifact.grid_pitch_m * MM_PER_M for h in artifact.half]
    known = size_m[np.isfinite(size_m)] * UM_PER_M
    top = float(known.max()) if known.size and known.max() > 0 else 1.0
    image = axes.imshow(np.ma.masked_invalid(size_m.T * UM_PER_M), origin="lower", cmap=colours,
                        extent=(-half[0], half[0], -half[1], half[1]), vmin=0.0,
                        vmax=top, interpolation="nearest", zorder=0)
    bar = axes.figure.colorbar(image, cax=axes.inset_axes((1.03, 0, 0.035, 1)))
    bar.set_label(f"{label} in µm")
    bar.outline.set_linewidth(0.5)


def _draw_lattice(axes: Axes, artifact: Artifact, arrows: Arrows) -> None:
    """Draw the nominal grid through the sites that carry arrows."""
    hx, hy = (h * artifact.grid_pitch_m * MM_PER_M for h in artifact.half)
    axes.vlines(arrows.x_mm[:, 0], -hy, hy, color=GRID, linewidth=0.5, zorder=1)
    axes.hlines(arrows.y_mm[0], -hx, hx, color=GRID, linewidth=0.5, zorder=1)


def _quiver(axes: Axes, arrows: Arrows, g_m: tuple[np.ndarray, ...], *, color: str,
            zorder: float, thicker: float = 1.0, head: bool = True) -> Quiver:
    gx, gy = (part[arrows.sites] * (MM_PER_M * arrows.magnification) for part in g_m)
    known = np.isfinite(gx) & np.isfinite(gy)
    width = 0.012 / math.sqrt(max(gx.shape)) * thicker
    shape: dict[str, Any] = (
        {"headwidth": 3.4, "headlength": 4.2, "headaxislength": 3.8} if head else
        {"headwidth": 1, "headlength": 0, "headaxislength": 0})
    return axes.quiver(arrows.x_mm[known], arrows.y_mm[known], gx[known], gy[known], angles="xy",
                       scale_units="xy", scale=1, units="width", width=width, minlength=0.3,
                       color=color, zorder=zorder, **shape)


def _draw_circles(axes: Axes, emap: ErrorMap, arrows: Arrows) -> bool:
    """Draw U (k=2) around the arrow heads; return whether it is large enough to be seen."""
    enlarge = MM_PER_M * arrows.magnification
    gx, gy, ux, uy = (part[arrows.sites] * enlarge
                      for part in (emap.gx, emap.gy, emap.u_gx, emap.u_gy))
    known = np.isfinite(gx) & np.isfinite(gy) & np.isfinite(ux) & np.isfinite(uy)
    spacing = arrows.step * emap.artifact.grid_pitch_m * MM_PER_M
    if not known.any() or 4 * max(ux[known].max(), uy[known].max()) < 0.05 * spacing:
        return False
    tips = np.stack([(arrows.x_mm + gx)[known], (arrows.y_mm + gy)[known]], axis=1)
    axes.add_collection(EllipseCollection(
        4 * ux[known], 4 * uy[known], np.zeros(known.sum()), units="xy", offsets=tips,
        offset_transform=axes.transData, facecolor=BAND, edgecolor=BAND_EDGE, alpha=0.55,
        linewidth=0.6, zorder=2.5))
    return True


def _draw_key(axes: Axes, emap: ErrorMap, quiver: Quiver, arrows: Arrows) -> None:
    """State the scale with an arrow of a round length, about one and a half spacings."""
    field_um = (max(emap.artifact.shape) + 1) * emap.artifact.grid_pitch_m * UM_PER_M
    round_um = round_down(0.16 * field_um / arrows.magnification)
    key_mm = round_um / UM_PER_M * MM_PER_M * arrows.magnification
    left, right = axes.get_xlim()
    axes.quiverkey(quiver, 0.02 + key_mm / (right - left), 0.035, key_mm,
                   f"{significant(round_um, 1)} µm", labelpos="E", coordinates="axes",
                   labelsep=0.1)


def _ordinal(number: int) -> str:
    return {2: "2nd", 3: "3rd"}.get(number, f"{number}th")


def _finish(axes: Axes, artifact: Artifact, *, reach_mm: tuple[float, float] = (0.0, 0.0),
            strip: float = 0.0) -> None:
    """Set limits that hold the field and the arrows, and a free strip below for the key."""
    x, y = (max((h + 0.6) * artifact.grid_pitch_m * MM_PER_M, 1.03 * reach)
            for h, reach in zip(artifact.half, reach_mm, strict=True))
    axes.set(xlim=(-x, x), ylim=(-y - 2 * strip * max(x, y), y), xlabel="stage x in mm",
             ylabel="stage y in mm", aspect="equal")
