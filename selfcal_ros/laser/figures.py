# SPDX-License-Identifier: Apache-2.0
"""Figures of the step-diagonal measurement: profiles, and sensitivity to the set-up."""

import numpy as np

from selfcal_ros.estimation.joint.noise import coverage_factor
from selfcal_ros.laser.data import AXES, StepDiagonal, StepDiagonalResult
from selfcal_ros.laser.noise import linear_noise, reading_noise
from selfcal_ros.laser.profiles import positions_m, profile_m, u_profile_m
from selfcal_ros.reporting.figures.drawing import SERIES, Drawing
from selfcal_ros.reporting.figures.parts import Curve, chart, legend, titled
from selfcal_ros.units import MM_PER_M, UM_PER_M

DASHES: dict[str, tuple[float, ...]] = {"conventional": (5, 3), "new": ()}
NOTHING_UM = 1e-6
"""What stands for zero on a logarithmic scale."""


def coverage(data: StepDiagonal) -> float:
    """Return k for 95.45 % at the fewer degrees of freedom: of readings or of linear errors."""
    known = [noise.dof for noise in (reading_noise(data), linear_noise(data)) if noise.dof]
    return coverage_factor(min(known)) if known else float("nan")


def profiles_figure(found: StepDiagonalResult, data: StepDiagonal) -> Drawing:
    """Return every accumulated error over its axis, with its expanded uncertainty."""
    k = coverage(data)
    bars = "" if found.covariance is None else f"; bars: U, k = {k:.3g}"
    drawing = titled("profiles", f"Step diagonal, {found.method} formulation{bars}")
    drawing.width, drawing.height = 240.0 * found.dim, 40.0 + 190 * found.dim
    for j in range(found.dim):
        for c in range(found.dim):
            u = u_profile_m(found, j, c)
            kind = "linear" if j == c else "transverse"
            chart(drawing, (56 + 240 * c, 56 + 190 * j, 176, 110), [
                Curve(positions_m(found, j) * MM_PER_M, profile_m(found, j, c) * UM_PER_M, "c0",
                      dots=2.0, U=None if u is None else k * u * UM_PER_M)],
                title=f"P{AXES[c]}({AXES[j]}), {kind}, µm", labels=(f"{AXES[j].upper()} in mm", ""))
    return drawing


def sensitivity_figure(curves: list[dict]) -> Drawing:
    """Return the errors of both formulations over the size of laser and mirror angles.

    `curves` is what `sweep` of `selfcal_ros.laser.simulation.sensitivity` gives.
    """
    drawing = titled("sensitivity", "Errors in µm over the angle by which laser or mirror are off")
    drawing.width = 900.0
    panels = (("linear_m", "linear error of a block"),
              ("transverse_m", "transverse error of a block"),
              ("squareness_m", "squareness over the range"))
    for number, (column, title) in enumerate(panels):
        chart(drawing, (50 + 295 * number, 56, 235, 240), [
            Curve(np.array(curve["size"]), np.maximum(np.array(
                [effect[column] for effect in curve[method]]) * UM_PER_M, NOTHING_UM),
                f"c{place % SERIES}", dash=dash, dots=1.5)
            for place, curve in enumerate(curves) for method, dash in DASHES.items()],
            title=title, labels=("angle in rad", ""), log=True)
    for place, curve in enumerate(curves):
        legend(drawing, [(f"c{place % SERIES}", curve["fault"])],
               (50 + 295 * (place % 3), 356 + 18 * (place // 3)))
    bottom = 356.0 + 18 * -(-len(curves) // 3)
    drawing.label(50, bottom, "dashed: conventional formulation, solid: new; the lowest value "
                  "stands for all below 1 pm", colour="soft")
    drawing.height = bottom + 14
    return drawing
