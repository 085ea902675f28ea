# SPDX-License-Identifier: Apache-2.0
"""Plots of the step-diagonal measurement: profiles, and sensitivity to the set-up."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from selfcal_ros.errors import InputError
from selfcal_ros.files import write_bytes
from selfcal_ros.laser.data import AXES, StepDiagonalResult
from selfcal_ros.laser.profiles import positions_m, profile_m, u_profile_m
from selfcal_ros.reporting.picture import picture
from selfcal_ros.units import MM_PER_M, UM_PER_M

FORMATS = ("png", "svg", "pdf")
COVERAGE = 2
_STYLE = {"conventional": "--", "new": "-"}
_COLOR = {"conventional": "0.6", "new": "C0"}


def plot_profiles(found: StepDiagonalResult, path: str | os.PathLike) -> None:
    """Draw every accumulated error over its axis, with its expanded uncertainty (k=2).

    Raises
    ------
    InputError
        If the name of the file ends in no known format.
    """
    figure = Figure(figsize=(4.2 * found.dim, 2.9 * found.dim), layout="constrained")
    axes = figure.subplots(found.dim, found.dim, squeeze=False)
    for j in range(found.dim):
        for c in range(found.dim):
            ax, along, across = axes[j, c], AXES[j].upper(), AXES[c].upper()
            x, y = positions_m(found, j) * MM_PER_M, profile_m(found, j, c) * UM_PER_M
            u = u_profile_m(found, j, c)
            ax.errorbar(x, y, None if u is None else COVERAGE * u * UM_PER_M, marker="o", ms=3,
                        capsize=2)
            kind = "linear" if j == c else "transverse"
            ax.set(title=f"P{AXES[c]}({AXES[j]}), {kind}", xlabel=f"{along} / mm",
                   ylabel=f"error in {across} / µm")
            ax.grid(alpha=0.3)
    bars = "" if found.covariance is None else f"; bars: U, k = {COVERAGE}"
    figure.suptitle(f"Step diagonal, {found.method} formulation{bars}")
    _save(figure, path)


def plot_sensitivity(rows: list[dict], curves: list[dict], path: str | os.PathLike) -> None:
    """Draw the errors of both formulations: over the size of laser and mirror angles, and as bars.

    Parameters
    ----------
    rows, curves : list of dict
        What `sensitivity` and `sweep` of `selfcal_ros.laser.simulation.sensitivity` give.
    path : str or path
        Picture to write.
    """
    figure = Figure(figsize=(15, 11), layout="constrained")
    panels = (("linear_m", "linear error of a block"),
              ("transverse_m", "transverse error of a block"),
              ("squareness_m", "squareness over the range"))
    axes = figure.subplots(2, len(panels))
    for (upper, lower), (column, title) in zip(axes.T, panels, strict=True):
        _draw_curves(upper, curves, column)
        _draw_bars(lower, rows, column, with_names=lower is axes[1, 0])
        upper.set(title=title, xlabel="angle / rad", ylabel="error / µm")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=7)
    _save(figure, path)


def _shown_um(values_m: list[float]) -> np.ndarray:
    """Return errors in um for a logarithmic scale, on which 1 pm stands for zero."""
    return np.maximum(values_m, 1e-12) * UM_PER_M


def _draw_curves(ax: Axes, curves: list[dict], column: str) -> None:
    for number, curve in enumerate(curves):
        for method, style in _STYLE.items():
            ax.loglog(curve["size"], _shown_um([effect[column] for effect in curve[method]]),
                      style, color=f"C{number}", marker=".",
                      label=f"{curve['fault']} ({method})")
    ax.grid(alpha=0.3, which="both")


def _draw_bars(ax: Axes, rows: list[dict], column: str, *, with_names: bool) -> None:
    places = np.arange(len(rows))
    for shift, (method, color) in zip((-0.2, 0.2), _COLOR.items(), strict=True):
        ax.barh(places + shift, _shown_um([row[method][column] for row in rows]), 0.4,
                color=color, label=method)
    names = [f"{row['fault']} ({row['size']:g} {row['unit']})" if row["unit"] else row["fault"]
             for row in rows]
    ax.set_yticks(places, names if with_names else [""] * len(rows), fontsize=7)
    ax.set(xscale="log", xlabel="error / µm")
    ax.invert_yaxis()
    ax.legend(fontsize=7)
    ax.grid(alpha=0.3, axis="x")


def _save(figure: Figure, path: str | os.PathLike) -> None:
    suffix = Path(path).suffix.lstrip(".").lower()
    if suffix not in FORMATS:
        raise InputError(str(path), f"'{suffix}' is not a picture format",
                         "name a file that ends in ." + ", .".join(FORMATS))
    write_bytes(path, picture(figure, suffix, dpi=120))
