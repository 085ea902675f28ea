# SPDX-License-Identifier: Apache-2.0
"""Truth of a machine, of a plate, and of each view of the plate on it."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, half_axis_slopes, remove_modes
from selfcal_ros.model.view import View

WALK_STEPS = 256
"""Steps of a random walk from the first grid exposure of a view to the last."""
AXES = {
    "xy": (1, 0, 0, 1),
    "-x-y": (-1, 0, 0, -1),
    "-xy": (-1, 0, 0, 1),
    "x-y": (1, 0, 0, -1),
    "yx": (0, 1, 1, 0),
    "-y-x": (0, -1, -1, 0),
    "y-x": (0, 1, -1, 0),
    "-yx": (0, -1, 1, 0),
}
"""Published x and y of an offset from its true x and y: rows of a matrix, consecutively."""
DRIFT_POWERS = (1, 2, 3)
"""Powers of time behind the columns of `Truth.drift_m`: linear, quadratic, cubic."""


@dataclass(frozen=True)
class Spread:
    """Parameters of a random truth; Hu's simulation by default. SI units.

    Attributes
    ----------
    g_m, a_m, g_theta_rad, a_theta_rad : float
        Standard deviations of stage and plate error.
    phi_rad, t_m : float
        Standard deviations of each view's misalignment.
    correlation_pitches : float
        Correlation length L of the stage error, and of that of the rotary encoder in lines:
        exp(-d^2 / 2 L^2) at the distance d; pitches of the map for a list of marks. 0:
        independent errors at sites and lines, bilinear in between.
    encoder : str
        ``independent``: the rotary encoder is independent of the axes, only its mean is 0.
        ``xy_axes``: it agrees with the slopes of the half axes (Hu eq. 9).
    rotation : str
        ``finite``: true rotations; ``linear``: linearised, as in the papers.
    microscope_scale, microscope_stretch, microscope_rotation_rad, microscope_shear : float
        The microscope: true over measured length, minus 1; the same, positive for x and negative
        for y; its rotation relative to the stage, counter-clockwise; the symmetric shear.
    microscope_axes, microscope_pixels, line_factor : str, float, float
        Published offset: axes and signs (`AXES`), factor of its length; factor of the true offset
        of a line (-1: wrong sign).
    microscope_distortion, microscope_field_m : float
        Relative amount by which the measured offset is too long at this distance from the axis;
        grows with the square of the distance.
    optical_tilt_x_rad, optical_tilt_y_rad : float
        Direction of the optical axis relative to the normal of the stage: a mark appears shifted
        by this times its height.
    backlash_x_m, backlash_y_m : float
        Indicated - true position after a motion in + direction; the negative after one in -
        direction.
    backlash_growth_m : float
        Growth of both up to the last grid exposure of a view, proportional to time.
    settling_m, settling_time_s : float
        Distance by which an axis is short of its indicated position at the first exposure after a
        motion, and the time in which this falls to 1/e at rest.
    stage_bend_m : float
        Standard deviation of the change of the stage error in each view: coefficients of u^2, uv
        and v^2, where u and v are the indicated position over half the size of the field.
    stage_yaw_rad : float
        Standard deviation of the rotation of the stage from site to site, as smooth as its error.
    plate_scale, plate_shape_m, plate_strain : float
        Standard deviations of growth (relative), bending at mid-edge and strain (symmetric matrix,
        relative) of the plate in each view after the first.
    plate_tilt_rad, plate_bow_m : float
        Standard deviation of the tilt of the plate about stage x and y in each view; height of the
        plate's centre above the middles of its edges.
    line_eccentricity_rad : float
        Standard deviation, along x and y, of the eccentricity of the circle of lines in each view,
        over its radius.
    phi_common_rad, t_common_m : float
        Standard deviations of a misalignment shared by all views: a plate placed against pins.
    pitch_error : float
        True pitch of the plate over the declared one, minus 1.
    drift_linear_m, drift_quadratic_m, drift_cubic_m, drift_walk_m : float
        Standard deviations of the drift in each view, in x and in y, at its last grid exposure.
    """

    g_m: float = 0.2e-6
    a_m: float = 0.3e-6
    g_theta_rad: float = np.deg2rad(0.01)
    a_theta_rad: float = np.deg2rad(0.01)
    phi_rad: float = np.deg2rad(0.3)
    t_m: float = 30e-6
    correlation_pitches: float = 0.0
    encoder: str = "independent"
    rotation: str = "finite"
    microscope_scale: float = 0.0
    microscope_stretch: float = 0.0
    microscope_rotation_rad: float = 0.0
    microscope_shear: float = 0.0
    microscope_axes: str = "xy"
    microscope_pixels: float = 1.0
    line_factor: float = 1.0
    microscope_distortion: float = 0.0
    microscope_field_m: float = 250e-6
    optical_tilt_x_rad: float = 0.0
    optical_tilt_y_rad: float = 0.0
    backlash_x_m: float = 0.0
    backlash_y_m: float = 0.0
    backlash_growth_m: float = 0.0
    settling_m: float = 0.0
    settling_time_s: float = 0.01
    stage_bend_m: float = 0.0
    stage_yaw_rad: float = 0.0
    plate_scale: float = 0.0
    plate_shape_m: float = 0.0
    plate_strain: float = 0.0
    plate_tilt_rad: float = 0.0
    plate_bow_m: float = 0.0
    line_eccentricity_rad: float = 0.0
    phi_common_rad: float = 0.0
    t_common_m: float = 0.0
    pitch_error: float = 0.0
    drift_linear_m: float = 0.0
    drift_quadratic_m: float = 0.0
    drift_cubic_m: float = 0.0
    drift_walk_m: float = 0.0

    @property
    def microscope(self) -> np.ndarray:
        """The matrix E: true offset = (1 + E) measured offset, (2, 2)."""
        scale, stretch = self.microscope_scale, self.microscope_stretch
        turn, shear = self.microscope_rotation_rad, self.microscope_shear
        return np.array(
            [[scale + stretch, shear - turn], [shear + turn, scale - stretch]]
        )

    @property
    def wiring(self) -> np.ndarray:
        """The matrix from the measured to the published offset, (2, 2)."""
        return self.microscope_pixels * np.reshape(
            AXES[self.microscope_axes], (2, 2)
        ).astype(float)


def _zeros(*shape: int) -> Any:
    return field(default_factory=lambda: np.zeros(shape))


@dataclass(frozen=True, eq=False)
class Waves:
    """Waves whose sum is a smooth error, of a stage along x and y, or of an encoder.

    Attributes
    ----------
    number : float array (n, d)
        Phase of each wave per unit of each coordinate.
    size : complex array (n, components)
        Amplitude and phase of each, m or rad.
    """

    number: np.ndarray
    size: np.ndarray

    def at(self, place: np.ndarray) -> np.ndarray:
        """Return the sum of the waves at positions (d, E), (components, E)."""
        parts = np.array_split(place, 1 + place.shape[1] // MOST_PLACES, axis=1)
        return np.concatenate(
            [
                np.real(self.size.T @ np.exp(1j * (self.number @ part)))
                for part in parts
            ],
            axis=1,
        )


NO_WAVES = Waves(np.zeros((0, 2)), np.zeros((0, 2), dtype=complex))
N_WAVES = 300
"""Number of waves of random direction in a smooth stage error."""
MOST_PLACES = 4096
"""Positions at which waves are summed at once, 20 MB."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Stage error, plate error, the misalignment of each view, and further effects.

    Attributes
    ----------
    artifact : Artifact
        The lattice.
    g, a : float array (2, nx, ny)
        Stage error at the sites (stage frame) and plate error of the marks (plate frame), m.
        Between sites the stage error minus `waves` is bilinear.
    g_theta, a_theta : float array (K,)
        The same for the angular lines, rad; between lines the stage error minus `waves_theta` is
        linear.
    phi_rad : float array (views,)
        Rotation of each view, counter-clockwise, about the plate's centre.
    t_m : float array (views, 2)
        Offset of each view, stage frame.
    linear : bool
        Whether the rotation is linearised, as in the papers: phi J R^q m, without the plate's
        error; if false, a finite rotation.
    microscope : float array (2, 2)
        E: true offset = (1 + E) measured offset, stage axes.
    wiring : float array (2, 2)
        Published offset = wiring times measured offset.
    line_factor : float
        Published offset of a line = this times the true one.
    distortion : float
        Relative excess length of the measured offset, over the square of its length, 1/m^2.
    optical_tilt_rad : float array (2,)
        Apparent shift of a mark along stage x and y, over its height.
    backlash_m : float array (2,)
        Indicated - true position of each axis after a motion in + direction, in addition to g.
    backlash_growth_m : float
        Growth of both up to the last grid exposure of a view.
    settling_m, settling_time_s : float
        Indicated - true position of an axis at the first exposure after a motion in + direction,
        in addition to g and backlash, and the time in which it falls to 1/e.
    yaw : float array (nx, ny) or (0, 0)
        Rotation of what the stage carries about the optical axis at the sites, counter-clockwise,
        rad; bilinear in between.
    stage_bend_m : float array (views, 2, 3) or (0, 2, 3)
        Addition to g in a view: as `plate_shape_m`, as a function of the indicated position.
    plate_scale : float array (views,) or (0,)
        Relative growth of the plate.
    plate_shape_m : float array (views, 2, 3) or (0, 2, 3)
        Displacement of the marks along plate x and y: coefficients of u^2, uv and v^2, where u and
        v are the nominal position over half the size of the field.
    plate_strain : float array (views, 2, 2) or (0, 2, 2)
        Displacement of the marks over their nominal position, plate axes.
    plate_tilt_rad : float array (views, 2) or (0, 2)
        Rotation vector of the plate along stage x and y, about its centre.
    plate_bow_m : float
        Height of the plate's centre above the middles of its edges.
    line_eccentricity_rad : float array (views, 2) or (0, 2)
        Centre of the circle of lines relative to the rotation axis, stage axes, over its radius.
    placed : tuple of View or None
        Actual poses that differ from the commanded ones, view by view.
    drift_m : float array (views, 2, 3) or (0, 2, 3)
        Motion of the plate at the last grid exposure, stage x and y, that grew with the first,
        second and third power of time.
    walk_m : float array (views, 2, steps + 1) or (0, 2, 1)
        Motion of the plate at equal steps of time from the first grid exposure to the last.
    waves, waves_theta : Waves
        Waves of the stage error between sites (positions in pitches), and between lines (in lines).
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
    wiring: np.ndarray = field(default_factory=lambda: np.eye(2))
    line_factor: float = 1.0
    distortion: float = 0.0
    optical_tilt_rad: np.ndarray = _zeros(2)
    backlash_m: np.ndarray = _zeros(2)
    backlash_growth_m: float = 0.0
    settling_m: float = 0.0
    settling_time_s: float = 0.01
    stage_bend_m: np.ndarray = _zeros(0, 2, 3)
    yaw: np.ndarray = _zeros(0, 0)
    plate_scale: np.ndarray = _zeros(0)
    plate_shape_m: np.ndarray = _zeros(0, 2, 3)
    plate_strain: np.ndarray = _zeros(0, 2, 2)
    plate_tilt_rad: np.ndarray = _zeros(0, 2)
    plate_bow_m: float = 0.0
    line_eccentricity_rad: np.ndarray = _zeros(0, 2)
    placed: tuple[View | None, ...] = ()
    drift_m: np.ndarray = _zeros(0, 2, 3)
    walk_m: np.ndarray = _zeros(0, 2, 1)
    waves: Waves = NO_WAVES
    waves_theta: Waves = NO_WAVES

    @cached_property
    def bilinear(self) -> np.ndarray:
        """The part of the stage error at the sites that is bilinear in between, (2, nx, ny), m."""
        lattice = self.artifact.lattice
        if not len(self.waves.number):
            return self.g
        sites = np.stack(lattice.places(lattice.m.ravel(), lattice.n.ravel()))
        return self.g - self.waves.at(sites).reshape(self.g.shape)

    def placed_as(self, index: int, commanded: View) -> View:
        """Return the pose of the plate in view `index`."""
        return (self.placed[index] if index < len(self.placed) else None) or commanded


def random_truth(
    artifact: Artifact,
    n_views: int,
    rng: np.random.Generator,
    spread: Spread | None = None,
    *,
    placing: np.random.Generator | None = None,
) -> Truth:
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
        Parameters of the draw, before the datum is removed.
    placing : numpy.random.Generator, optional
        Source of the values that differ between views, and so between measurements: pose of the
        plate, temperature, strain, drifts. Default `rng`.
    """
    spread = spread or Spread()
    drawn_g, waves = _stage(artifact.lattice, spread, rng)
    g = remove_modes(drawn_g, datum_modes(artifact.lattice, scale=True))
    a = remove_modes(
        rng.normal(0, spread.a_m, (2, *artifact.shape)),
        datum_modes(artifact, scale=False),
    )
    a += spread.pitch_error * np.stack([artifact.x_m, artifact.y_m])
    drawn_theta, waves_theta = _circle(artifact.angular_count, spread, rng)
    g_theta = _encoder(artifact.lattice, g, drawn_theta, spread.encoder)
    a_theta = rng.normal(0, spread.a_theta_rad, artifact.angular_count)
    yaw = np.zeros((0, 0))
    if spread.stage_yaw_rad:
        yaw = _stage(artifact, replace(spread, g_m=spread.stage_yaw_rad), rng)[0][0]
        yaw = yaw - yaw.mean()  # the rest turns the image as the camera's turn does
    rng = placing or rng
    phi = rng.normal(0, spread.phi_rad, n_views)
    t = rng.normal(0, spread.t_m, (n_views, 2))
    drawn = _of_views(spread, n_views, rng)
    if spread.phi_common_rad or spread.t_common_m:
        phi += rng.normal(0, spread.phi_common_rad)
        t += rng.normal(0, spread.t_common_m, 2)
    return Truth(
        artifact,
        g,
        a,
        g_theta=g_theta,
        a_theta=a_theta,
        phi_rad=phi,
        t_m=t,
        linear=spread.rotation == "linear",
        microscope=spread.microscope,
        wiring=spread.wiring,
        line_factor=spread.line_factor,
        distortion=spread.microscope_distortion / spread.microscope_field_m**2,
        optical_tilt_rad=np.array(
            [spread.optical_tilt_x_rad, spread.optical_tilt_y_rad]
        ),
        backlash_m=np.array([spread.backlash_x_m, spread.backlash_y_m]),
        backlash_growth_m=spread.backlash_growth_m,
        settling_m=spread.settling_m,
        settling_time_s=spread.settling_time_s,
        plate_bow_m=spread.plate_bow_m,
        waves=waves,
        waves_theta=waves_theta,
        yaw=yaw,
        **drawn,
    )


def _stage(
    artifact: Artifact, spread: Spread, rng: np.random.Generator
) -> tuple[np.ndarray, Waves]:
    """Return the stage error at the sites, (2, nx, ny), m, and its waves."""
    length = spread.correlation_pitches
    if not length:
        return rng.normal(0, spread.g_m, (2, *artifact.shape)), NO_WAVES
    # directions and lengths with the spectrum of exp(-d^2 / 2 L^2)
    number = rng.normal(0, 1 / length, (N_WAVES, 2))
    waves = Waves(
        number, _amplitudes(rng, np.full(N_WAVES, spread.g_m / np.sqrt(N_WAVES)), 2)
    )
    sites = np.stack(artifact.places(artifact.m.ravel(), artifact.n.ravel()))
    return waves.at(sites).reshape(2, *artifact.shape), waves


def _circle(
    count: int, spread: Spread, rng: np.random.Generator
) -> tuple[np.ndarray, Waves]:
    """Return the error of the rotary encoder at the lines, (K,), rad, and its waves."""
    if not (spread.correlation_pitches and count):
        return rng.normal(0, spread.g_theta_rad, count), NO_WAVES
    line = 2 * np.pi / count
    reach = spread.correlation_pitches * line
    harmonic = np.arange(1, 2 + int(6 / reach))
    power = np.exp((1 - harmonic**2) * reach**2 / 2)
    size = spread.g_theta_rad * np.sqrt(power / power.sum())
    waves = Waves(harmonic[:, None] * line, _amplitudes(rng, size, 1))
    return waves.at(np.arange(count)[None])[0], waves


def _amplitudes(
    rng: np.random.Generator, size: np.ndarray, components: int
) -> np.ndarray:
    """Return complex amplitudes of waves of standard deviation `size` (n,), (n, components)."""
    parts = rng.normal(0, 1, (2, len(size), components))
    return (parts[0] + 1j * parts[1]) * size[:, None]


def _encoder(
    artifact: Artifact, g: np.ndarray, drawn: np.ndarray, encoder: str
) -> np.ndarray:
    """Return the error of the rotary encoder, (K,), rad."""
    if not artifact.angular_count:
        return drawn
    if encoder == "independent":
        return drawn - drawn.mean()
    if artifact.angular_count % 4:
        raise InputError(
            "encoder xy_axes",
            f"of {artifact.angular_count} lines, none lies on the y axis",
            "use independent",
        )
    slopes = half_axis_slopes(artifact, g)  # a half axis of one site has no slope
    quarter = drawn[:: artifact.angular_count // 4]
    quarter[:] = np.where(np.isfinite(slopes), slopes, quarter)
    return drawn


def _of_views(spread: Spread, n_views: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the values drawn for each view; none for effects without a size."""
    drawn: dict[str, Any] = {}
    if spread.plate_scale:
        drawn["plate_scale"] = rng.normal(0, spread.plate_scale, n_views)
    if spread.plate_shape_m:
        drawn["plate_shape_m"] = rng.normal(0, spread.plate_shape_m, (n_views, 2, 3))
    if spread.plate_strain:
        xx, xy, yy = rng.normal(0, spread.plate_strain, (3, n_views))
        drawn["plate_strain"] = np.stack([xx, xy, xy, yy], axis=1).reshape(-1, 2, 2)
    for values in drawn.values():
        values[:1] = 0  # the plate is defined by the first view
    sizes = np.array(
        [spread.drift_linear_m, spread.drift_quadratic_m, spread.drift_cubic_m]
    )
    if sizes.any():
        drawn["drift_m"] = rng.normal(0, 1, (n_views, 2, 3)) * sizes
    if spread.drift_walk_m:
        steps = rng.normal(
            0, spread.drift_walk_m / np.sqrt(WALK_STEPS), (n_views, 2, WALK_STEPS)
        )
        drawn["walk_m"] = np.insert(steps.cumsum(axis=2), 0, 0.0, axis=2)
    for name, shape in (
        ("stage_bend_m", (2, 3)),
        ("plate_tilt_rad", (2,)),
        ("line_eccentricity_rad", (2,)),
    ):
        if getattr(spread, name):
            drawn[name] = rng.normal(0, getattr(spread, name), (n_views, *shape))
    return drawn
