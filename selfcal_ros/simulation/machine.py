# SPDX-License-Identifier: Apache-2.0
"""What is true of a machine, of a plate, and of each view in which the plate lies on it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from selfcal_ros.estimation.datum.modes import datum_modes, half_axis_slopes, remove_modes
from selfcal_ros.model.artifact import Artifact

WALK_STEPS = 256
"""Steps of a random walk from the first grid exposure of a view to the last."""
ENCODERS = ("independent", "xy_axes")
ROTATIONS = ("finite", "linear")
DRIFT_POWERS = (1, 2, 3)
"""Powers of time behind the columns of `Truth.drift_m`: linear, quadratic, cubic."""


@dataclass(frozen=True)
class Spread:
    """What a random truth is drawn from; Hu's simulation by default. SI units.

    Attributes
    ----------
    g_m, a_m, g_theta_rad, a_theta_rad : float
        Standard deviations of stage and plate error.
    phi_rad, t_m : float
        Standard deviations of each view's misalignment.
    encoder : str
        ``independent``: the rotary encoder owes nothing to the axes, only its mean is 0.
        ``xy_axes``: it is true to the slopes of the half axes (Hu eq. 9).
    rotation : str
        ``finite``, as a plate turns; ``linear``, as the papers write it.
    microscope_scale, microscope_stretch, microscope_rotation_rad, microscope_shear : float
        The microscope itself: a true length over the seen one, less 1; the same for x more and
        for y less; its turn against the stage, counter-clockwise; the symmetric shear.
    backlash_x_m, backlash_y_m : float
        What the indicated position has too much after a motion towards plus, and too little
        after one towards minus.
    plate_scale, plate_shape_m : float
        Standard deviations by which the plate grows (relative), and bends at mid-edge, in each
        view after the first.
    drift_linear_m, drift_quadratic_m, drift_cubic_m, drift_walk_m : float
        Standard deviations of the drift in each view, in x and in y, at its last grid exposure.
    """

    g_m: float = 0.2e-6
    a_m: float = 0.3e-6
    g_theta_rad: float = np.deg2rad(0.01)
    a_theta_rad: float = np.deg2rad(0.01)
    phi_rad: float = np.deg2rad(0.3)
    t_m: float = 30e-6
    encoder: str = "independent"
    rotation: str = "finite"
    microscope_scale: float = 0.0
    microscope_stretch: float = 0.0
    microscope_rotation_rad: float = 0.0
    microscope_shear: float = 0.0
    backlash_x_m: float = 0.0
    backlash_y_m: float = 0.0
    plate_scale: float = 0.0
    plate_shape_m: float = 0.0
    drift_linear_m: float = 0.0
    drift_quadratic_m: float = 0.0
    drift_cubic_m: float = 0.0
    drift_walk_m: float = 0.0

    @property
    def microscope(self) -> np.ndarray:
        """The matrix E: true offset = (1 + E) seen offset, (2, 2)."""
        scale, stretch = self.microscope_scale, self.microscope_stretch
        turn, shear = self.microscope_rotation_rad, self.microscope_shear
        return np.array([[scale + stretch, shear - turn], [shear + turn, scale - stretch]])


def _zeros(*shape: int) -> Any:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class Truth:
    """Stage error, plate error, the misalignment of each view, and what else is true.

    Attributes
    ----------
    artifact : Artifact
        The lattice.
    g, a : float array (2, nx, ny)
        Stage error at the sites (stage frame) and plate error of the marks (plate frame), m.
        Between sites the stage error is bilinear.
    g_theta, a_theta : float array (K,)
        The same for the angular lines, rad; between lines the stage error is linear.
    phi_rad : float array (views,)
        Rotation of each view, counter-clockwise, about the plate's centre.
    t_m : float array (views, 2)
        Offset of each view, stage frame.
    linear : bool
        Whether the plate turns as the papers write it: phi J R^q m, and the plate's error not
        at all; otherwise by a rotation.
    microscope : float array (2, 2)
        E: true offset = (1 + E) seen offset, stage axes.
    backlash_m : float array (2,)
        Indicated - true position of each axis after a motion towards plus, beside g.
    plate_scale : float array (views,) or (0,)
        Relative growth of the plate.
    plate_shape_m : float array (views, 2, 3) or (0, 2, 3)
        Displacement of the marks along plate x and y: coefficients of u^2, uv and v^2, where u and
        v are the nominal place over half the size of the field.
    drift_m : float array (views, 2, 3) or (0, 2, 3)
        Motion of the plate at the last grid exposure, stage x and y, that grew with the first,
        second and third power of time.
    walk_m : float array (views, 2, steps + 1) or (0, 2, 1)
        Motion of the plate at equal steps of time from the first grid exposure to the last.
    """

    artifact: Artifact
    g: np.ndarray
    a: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    phi_rad: np.ndarray
    t_m: np.ndarray
    linear: bool = False
    microscope: np.ndarray = _zeros(2, 2)
    backlash_m: np.ndarray = _zeros(2)
    plate_scale: np.ndarray = _zeros(0)
    plate_shape_m: np.ndarray = _zeros(0, 2, 3)
    drift_m: np.ndarray = _zeros(0, 2, 3)
    walk_m: np.ndarray = _zeros(0, 2, 1)

    @property
    def by_visit(self) -> bool:
        """Whether visits of a mark differ by more than noise."""
        return any(values.any() for values in (self.microscope, self.backlash_m, self.drift_m,
                                               self.walk_m))


def random_truth(artifact: Artifact, n_views: int, rng: np.random.Generator,
                 spread: Spread | None = None) -> Truth:
    """Draw a truth that satisfies Hu's datum (eqs. 5, 11) exactly.

    Parameters
    ----------
    artifact : Artifact
        The lattice.
    n_views : int
        Number of views to draw for.
    rng : numpy.random.Generator
        Source of the draw.
    spread : Spread, optional
        What is drawn, before the datum is removed.
    """
    spread = spread or Spread()
    g = remove_modes(rng.normal(0, spread.g_m, (2, *artifact.shape)),
                     datum_modes(artifact, scale=True))
    a = remove_modes(rng.normal(0, spread.a_m, (2, *artifact.shape)),
                     datum_modes(artifact, scale=False))
    g_theta = _encoder(artifact, g, rng.normal(0, spread.g_theta_rad, artifact.angular_count),
                       spread.encoder)
    a_theta = rng.normal(0, spread.a_theta_rad, artifact.angular_count)
    phi, t = rng.normal(0, spread.phi_rad, n_views), rng.normal(0, spread.t_m, (n_views, 2))
    return Truth(artifact, g, a, g_theta, a_theta, phi, t, spread.rotation == "linear",
                 spread.microscope, np.array([spread.backlash_x_m, spread.backlash_y_m]),
                 **_of_views(spread, n_views, rng))


def _encoder(artifact: Artifact, g: np.ndarray, drawn: np.ndarray, encoder: str) -> np.ndarray:
    """Return the error of the rotary encoder, (K,), rad."""
    if not artifact.angular_count:
        return drawn
    if encoder == "independent":
        return drawn - drawn.mean()
    slopes = half_axis_slopes(artifact, g)  # a half axis of one site has none
    quarter = drawn[:: artifact.angular_count // 4]
    quarter[:] = np.where(np.isfinite(slopes), slopes, quarter)
    return drawn


def _of_views(spread: Spread, n_views: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Return what is drawn for each view; nothing of what has no size."""
    drawn: dict[str, np.ndarray] = {}
    if spread.plate_scale:
        drawn["plate_scale"] = rng.normal(0, spread.plate_scale, n_views)
    if spread.plate_shape_m:
        drawn["plate_shape_m"] = rng.normal(0, spread.plate_shape_m, (n_views, 2, 3))
    for values in drawn.values():
        values[:1] = 0  # the plate is what it is in the first view
    sizes = np.array([spread.drift_linear_m, spread.drift_quadratic_m, spread.drift_cubic_m])
    if sizes.any():
        drawn["drift_m"] = rng.normal(0, 1, (n_views, 2, 3)) * sizes
    if spread.drift_walk_m:
        steps = rng.normal(0, spread.drift_walk_m / np.sqrt(WALK_STEPS), (n_views, 2, WALK_STEPS))
        drawn["walk_m"] = np.insert(steps.cumsum(axis=2), 0, 0.0, axis=2)
    return drawn
