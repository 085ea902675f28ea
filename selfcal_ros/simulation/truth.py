# SPDX-License-Identifier: Apache-2.0
"""A stage and a plate with known errors, and the readings that they give (method, section 2)."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.datum.modes import axis_slopes, datum_modes, remove_modes
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.view import Plan, View


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a random truth; Hu's simulation by default. SI units."""

    g_m: float = 0.2e-6
    a_m: float = 0.3e-6
    g_theta_rad: float = np.deg2rad(0.01)
    a_theta_rad: float = np.deg2rad(0.01)
    phi_rad: float = np.deg2rad(0.3)
    t_m: float = 30e-6


@dataclass(frozen=True, eq=False)
class Truth:
    """Stage error, plate error and the misalignment of each view.

    Attributes
    ----------
    artifact : Artifact
        The lattice.
    g, a : float array (2, nx, ny)
        Stage error at the sites (stage frame) and plate error of the marks (plate frame), m.
    g_theta, a_theta : float array (K,)
        The same for the angular lines, rad.
    phi_rad : float array (views,)
        Rotation of each view.
    t_m : float array (views, 2)
        Offset of each view.
    """

    artifact: Artifact
    g: np.ndarray
    a: np.ndarray
    g_theta: np.ndarray
    a_theta: np.ndarray
    phi_rad: np.ndarray
    t_m: np.ndarray


def random_truth(artifact: Artifact, n_views: int, rng: np.random.Generator,
                 spread: Spread | None = None) -> Truth:
    """Draw a truth that satisfies Hu's datum (eqs. 5, 9, 11) exactly.

    Parameters
    ----------
    artifact : Artifact
        The lattice.
    n_views : int
        Number of misalignments to draw.
    rng : numpy.random.Generator
        Source of the draw.
    spread : Spread, optional
        Standard deviations before the datum is removed.
    """
    spread = spread or Spread()
    g = remove_modes(rng.normal(0, spread.g_m, (2, *artifact.shape)),
                     datum_modes(artifact, scale=True))
    a = remove_modes(rng.normal(0, spread.a_m, (2, *artifact.shape)),
                     datum_modes(artifact, scale=False))
    g_theta = rng.normal(0, spread.g_theta_rad, artifact.angular_count)
    if artifact.angular_count:
        slopes = axis_slopes(artifact, *g)  # a half axis of one site has none
        quarter = g_theta[:: artifact.angular_count // 4]
        quarter[:] = np.where(np.isfinite(slopes), slopes, quarter)
    a_theta = rng.normal(0, spread.a_theta_rad, artifact.angular_count)
    return Truth(artifact, g, a, g_theta, a_theta, rng.normal(0, spread.phi_rad, n_views),
                 rng.normal(0, spread.t_m, (n_views, 2)))


def rotate(q: int, vector: np.ndarray) -> np.ndarray:
    """Return `vector` (2, ...) turned counter-clockwise by `q` quarter turns, exactly."""
    x, y = vector
    return np.stack(((x, y), (-y, x), (-x, -y), (y, -x))[q % 4])


def grid_deviation(truth: Truth, index: int, view: View, *,
                   sense: Sense = Sense.MICROSCOPE_MOVES) -> np.ndarray:
    """Return the noise-free deviation of every mark in a view, (2, nx, ny); NaN off the field."""
    artifact = truth.artifact
    pose = view.lattice_pose(artifact)
    i, j = pose.site_of(artifact.m, artifact.n)
    hx, hy = artifact.half
    inside = (abs(i) <= hx) & (abs(j) <= hy)
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    stage = np.full((2, *artifact.shape), np.nan)
    stage[:, inside] = sign * truth.g[:, sign * i[inside] + hx, sign * j[inside] + hy]
    x, y = rotate(pose.quarter_turns, np.stack([artifact.x_m, artifact.y_m]))
    return (stage + rotate(pose.quarter_turns, truth.a) + truth.phi_rad[index] * np.stack([-y, x])
            + truth.t_m[index][:, None, None])


def angular_deviation(truth: Truth, index: int, view: View, *,
                      sense: Sense = Sense.MICROSCOPE_MOVES) -> np.ndarray:
    """Return the noise-free deviation of every angular line in a view, (K,), rad."""
    k = np.arange(truth.artifact.angular_count)
    site = k + view.lattice_pose(truth.artifact).turn_lines
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    stage = sign * truth.g_theta[(sign * site) % len(k)]
    return stage + truth.a_theta + truth.phi_rad[index]


def simulate_measurements(truth: Truth, plan: Plan, rng: np.random.Generator, *,
                          sigma_m: float = 0.0, sigma_theta_rad: float = 0.0,
                          sense: Sense = Sense.MICROSCOPE_MOVES, missing: float = 0.0,
                          ) -> Measurements:
    """Return the averaged readings of all views, with Gaussian noise and missing marks.

    Parameters
    ----------
    truth, plan, rng
        What is measured, how, and the source of noise.
    sigma_m, sigma_theta_rad : float
        Standard deviation of one reading; each mark is the mean of the view's repeats.
    sense : Sense
        Who moves.
    missing : float
        Fraction of marks lost, independently in each view.
    """
    views = tuple(_simulate_view(truth, (index, view), rng, sigma=(sigma_m, sigma_theta_rad),
                                 sense=sense, missing=missing)
                  for index, view in enumerate(plan.views))
    return Measurements(plan.plan_id, plan.artifact, views, sense)


def _simulate_view(truth: Truth, item: tuple[int, View], rng: np.random.Generator, *,
                   sigma: tuple[float, float], sense: Sense, missing: float) -> ViewReadings:
    index, view = item
    artifact, repeats = truth.artifact, view.repeats
    readings = ViewReadings(view, sigma_xy=_repeatability(sigma[0], repeats),
                            sigma_theta=_repeatability(sigma[1], repeats))
    if view.grid:
        v = grid_deviation(truth, index, view, sense=sense)
        v = v + rng.normal(0, 1, v.shape) * (sigma[0] / np.sqrt(repeats))
        read = np.isfinite(v).all(axis=0) & (rng.random(artifact.shape) >= missing)
        readings = replace(readings, m=artifact.m[read], n=artifact.n[read], dx=v[0][read],
                           dy=v[1][read], count=np.full(read.sum(), repeats),
                           dof_xy=2 * int(read.sum()) * (repeats - 1))
    if view.angular:
        v = angular_deviation(truth, index, view, sense=sense)
        v = v + rng.normal(0, 1, v.shape) * (sigma[1] / np.sqrt(repeats))
        read = rng.random(len(v)) >= missing
        k = np.arange(len(v))[read]
        readings = replace(readings, k=k, dtheta=v[read], count_theta=np.full(len(k), repeats),
                           dof_theta=len(k) * (repeats - 1))
    used = int(readings.count.sum() + readings.count_theta.sum())
    return replace(readings, used=used)


def _repeatability(sigma: float, repeats: int) -> float:
    return sigma if repeats > 1 else float("nan")


def hu_plan(artifact: Artifact, repeats: int = 1, plan_id: str = "hu") -> Plan:
    """Return Hu's four views: as it is, 90 deg, one line (angular only), one pitch along +X."""
    line = 2 * np.pi / artifact.angular_count if artifact.angular_count else 0.0
    angular = artifact.angular_count > 0
    views = [View("identity", 0.0, (0.0, 0.0), True, angular, repeats),
             View("rot90", np.pi / 2, (0.0, 0.0), True, angular, repeats),
             View("line", line, (0.0, 0.0), False, True, repeats),
             View("shift_x", 0.0, (artifact.grid_pitch_m, 0.0), True, angular, repeats)]
    return Plan(plan_id, artifact, tuple(v for v in views if v.grid or angular))
