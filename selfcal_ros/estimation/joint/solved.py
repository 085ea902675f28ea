# SPDX-License-Identifier: Apache-2.0
"""A solution before the verdict: the result, and the inputs of the verdict."""

from dataclasses import dataclass

from selfcal_ros.estimation.joint.model_fit import ModelFit
from selfcal_ros.estimation.joint.noise import NoiseEstimate
from selfcal_ros.model.result import CalibrationResult, Noise


@dataclass(frozen=True, eq=False)
class Solved:
    """A solution before any test.

    Attributes
    ----------
    result : CalibrationResult
        Maps with their uncertainties.
    xy, theta : NoiseEstimate
        Noise of the grid and of the angular readings.
    model : ModelFit, optional
        The joint fit; None for Hu's law.
    axes : tuple of float
        Probability and size (rad) of the misclosure of the axis conditions; 1 and 0 if not
        used.
    converged : bool
        Whether the estimate converged with the assumed terms.
    """

    result: CalibrationResult
    xy: NoiseEstimate
    theta: NoiseEstimate
    model: ModelFit | None = None
    axes: tuple[float, float] = (1.0, 0.0)
    converged: bool = True


def noise_of(xy: NoiseEstimate, theta: NoiseEstimate) -> Noise:
    """Return the noises of a result."""
    return Noise(
        xy.sigma, theta.sigma, xy.repeats, theta.repeats, xy.residuals, theta.residuals,
        xy.dof_repeats, theta.dof_repeats, xy.dof_residuals, theta.dof_residuals, xy.declared,
        theta.declared, xy.dof, theta.dof, xy.k, theta.k, xy.p, theta.p)
