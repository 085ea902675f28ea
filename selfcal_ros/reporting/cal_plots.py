# SPDX-License-Identifier: Apache-2.0
"""Plot of ``selfcal cal verify``: what a stage's error is before and after its tables."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from selfcal_ros.aerotech.verify import Residual, Verification
from selfcal_ros.errors import InputError
from selfcal_ros.files import write_bytes
from selfcal_ros.reporting.picture import picture
from selfcal_ros.units import MM_PER_M, RAD_PER_ARCSEC, UM_PER_M

FORMATS = ("png", "svg", "pdf")
MAX_ARROWS = 41
"""Arrows along a side; a larger field shows every second, third, ... site."""
_TITLES = {"sites": "at the sites", "between": "at the cell centres (cubic stage)",
           "lines": "at the angular lines"}


def plot_verification(found: Verification, path: str | os.PathLike) -> None:
    """Draw the residuals true - commanded, before on the left and after on the right.

    Arrows of the two sides have scales of their own, written beside them: after a good table
    they would not be seen otherwise.

    Raises
    ------
    InputError
        If the name of the file ends in no known format.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise InputError(str(path), "the format of a plot is not known by this name",
                         "end it in " + ", ".join(f".{name}" for name in FORMATS))
    rows = found.residuals
    figure = Figure(figsize=(10, 4.6 * len(rows)), layout="constrained")
    for axes, residual in zip(figure.subplots(len(rows), 2, squeeze=False), rows, strict=True):
        for ax, which in zip(axes, ("before", "after"), strict=True):
            if residual.place == "lines":
                _lines(ax, residual, which)
            else:
                _arrows(ax, residual, which)
    figure.suptitle("Residual true − commanded of the simulated controller, "
                    "without its constant shift")
    write_bytes(path, picture(figure, kind, dpi=120))


def _arrows(ax: Axes, residual: Residual, which: str) -> None:
    x, y = residual.position * MM_PER_M
    u, v = getattr(residual, which) * UM_PER_M
    sides = [len(np.unique(side)) for side in (x, y)]
    step = max(1, -(-max(sides) // MAX_ARROWS))
    take = np.ones(len(x), dtype=bool)
    for side in (x, y):
        take &= np.unique(side, return_inverse=True)[1].ravel() % step == 0
    scale = max(residual.largest(which) * UM_PER_M, np.finfo(float).tiny)
    room = (np.ptp(x) + np.ptp(y)) / max(sum(sides) - 2, 1) * step
    quiver = ax.quiver(x[take], y[take], u[take], v[take], np.hypot(u, v)[take], angles="xy",
                       scale_units="xy", scale=scale / (1.2 * room), cmap="viridis", width=0.004)
    ax.figure.colorbar(quiver, ax=ax, label="length / µm")
    ax.set(title=f"{which} {_TITLES[residual.place]}\nrms {residual.rms(which) * UM_PER_M:.3g} µm, "
                 f"max {residual.largest(which) * UM_PER_M:.3g} µm",
           xlabel="x / mm", ylabel="y / mm", aspect="equal")
    ax.margins(0.1)


def _lines(ax: Axes, residual: Residual, which: str) -> None:
    ax.plot(np.rad2deg(residual.position[0]), getattr(residual, which)[0] / RAD_PER_ARCSEC, ".-")
    ax.set(title=f"{which} {_TITLES['lines']}\nrms {residual.rms(which) / RAD_PER_ARCSEC:.3g}″, "
                 f"max {residual.largest(which) / RAD_PER_ARCSEC:.3g}″",
           xlabel="θ / °", ylabel="residual / ″")
    ax.grid(alpha=0.3)
