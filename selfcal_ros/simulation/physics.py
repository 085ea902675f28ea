# SPDX-License-Identifier: Apache-2.0
"""Positions of marks on the plate, the plate on the stage, the stage under its encoders.

Everything is a position in the stage frame. The estimator's equations are not used here: it must
recover the truth from these positions.
"""

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import View
from selfcal_ros.simulation.machine import DRIFT_POWERS, Truth

NO_MOTION_M = 1e-6
"""Largest change of an axis between stops that does not take up its backlash."""


def rotate(q: int, vector: np.ndarray) -> np.ndarray:
    """Return `vector` (2, ...) turned counter-clockwise by `q` quarter turns, exactly."""
    x, y = vector
    return np.stack(((x, y), (-y, x), (-x, -y), (y, -x))[q % 4])


def plate_displacement(
    truth: Truth, index: int, m: np.ndarray, n: np.ndarray
) -> np.ndarray:
    """Return true minus nominal position of marks on the plate in a view, (2, V), m.

    Parameters
    ----------
    truth, index
        The truth, and the index of the view.
    m, n : int array (V,)
        The marks.
    """
    (hx, hy), pitch = truth.artifact.reach, truth.artifact.grid_pitch_m
    x, y = truth.artifact.places(m, n)
    displacement = truth.a[:, *truth.artifact.index(m, n)]
    if len(truth.plate_scale):
        displacement = (
            displacement + truth.plate_scale[index] * np.stack([x, y]) * pitch
        )
    if len(truth.plate_shape_m):
        u, v = x / hx, y / hy
        displacement = displacement + truth.plate_shape_m[index] @ np.stack(
            [u * u, u * v, v * v]
        )
    if len(truth.plate_strain):
        displacement = (
            displacement + truth.plate_strain[index] @ np.stack([x, y]) * pitch
        )
    return displacement


def marks_below(
    truth: Truth, index: int, view: View, marks: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the marks found where `marks` would be if the plate were placed as commanded.

    If it is placed off its lattice, those are the nearest ones.

    Returns
    -------
    m, n : int arrays (V,)
        The marks found there.
    there : bool array (V,)
        Whether the plate has a mark there; `m` and `n` are any if not.
    """
    artifact = truth.artifact
    lies = truth.placed_as(index, view).on_stage(artifact)
    x, y = view.on_stage(artifact).site_of(*artifact.places(*marks))
    place = lies.turned_back(x - lies.shift[0], y - lies.shift[1])
    if artifact.marks:
        away, near = artifact.marks.tree.query(
            np.stack(place, axis=1) * artifact.grid_pitch_m
        )
        return (
            artifact.marks.id_array[near],
            np.zeros(len(near), dtype=int),
            away < artifact.grid_pitch_m / 2,
        )
    m, n = np.stack(artifact.nearest(*place)).astype(int)
    on_plate = artifact.has(m, n)
    return m * on_plate, n * on_plate, on_plate


def marks_beside(
    truth: Truth,
    index: int,
    view: View,
    marks: tuple[np.ndarray, np.ndarray],
    sub_view: View,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the marks that a cell of an image shows if `marks` are on the optical axis.

    As `marks_below`; the nearest ones.
    """
    lies = truth.placed_as(index, view)
    step = np.conj(lies.pose.phase) * sub_view.cell_m / truth.artifact.grid_pitch_m
    m, n = (
        centre + np.rint(part).astype(int)
        for centre, part in zip(marks, (step.real, step.imag), strict=True)
    )
    on_plate = truth.artifact.has(m, n)
    return m * on_plate, n * on_plate, on_plate


def mark_places(
    truth: Truth, index: int, view: View, marks: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return true and nominal positions of marks in the stage frame at the beginning of a view.

    The plate is rotated about its centre, by the view's turn, by its misalignment and by its tilt,
    and its centre is placed at the view's translation plus the offset. If the optical axis is not
    normal to the stage a mark appears shifted according to its height.

    Returns
    -------
    place, site : float arrays (2, V)
        True and nominal position, m.
    """
    m, n = marks
    pose = view.on_stage(truth.artifact)
    pitch = truth.artifact.grid_pitch_m
    x, y = truth.artifact.places(m, n)
    site = np.stack(pose.site_of(x, y)) * pitch
    arm = np.stack(pose.turned(*np.stack([x, y]) * pitch))
    error = np.stack(pose.turned(*plate_displacement(truth, index, m, n)))
    phi = truth.phi_rad[index]
    if truth.linear:
        away = phi * rotate(1, arm) + error
    else:  # R(phi) (arm + error) - arm, without cancellation
        away = (
            np.sin(phi) * rotate(1, arm + error)
            - 2 * np.sin(phi / 2) ** 2 * (arm + error)
            + error
        )
    height = _bow(truth, m, n)
    if len(truth.plate_tilt_rad):
        sunk, risen = _tilted(truth.plate_tilt_rad[index], arm + away, height)
        away, height = away + sunk, height + risen
    away = away + truth.optical_tilt_rad[:, None] * height
    return site + (away + truth.t_m[index][:, None]), site


def _bow(truth: Truth, m: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the height of marks on the plate, (V,), m; the plate is part of a sphere."""
    hx, hy = truth.artifact.reach
    x, y = truth.artifact.places(m, n)
    return truth.plate_bow_m * (1 - (x / hx) ** 2 - (y / hy) ** 2)


def _tilted(
    tilt: np.ndarray, arm: np.ndarray, height: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the displacement of points (2, V) at heights (V,) along stage x, y, and upwards.

    They rotate about the horizontal axis `tilt` (2,) by its length (Rodrigues).
    """
    angle = np.hypot(*tilt)
    if not angle:
        return np.zeros_like(arm), np.zeros_like(height)
    kx, ky = tilt / angle
    along = kx * arm[1] - ky * arm[0]  # axis x arm, upwards
    sine = np.sin(angle)
    one_less_cosine = 2 * np.sin(angle / 2) ** 2
    aside = np.array([[ky], [-kx]])
    return aside * (
        sine * height + one_less_cosine * along
    ), sine * along - one_less_cosine * height


def drift(truth: Truth, index: int, tau: np.ndarray) -> np.ndarray:
    """Return the displacement of the plate at times `tau` (E,), 0..1 of a view, (2, E), m."""
    displacement = np.zeros((2, len(tau)))
    if len(truth.drift_m):
        displacement += truth.drift_m[index] @ np.stack(
            [tau**power for power in DRIFT_POWERS]
        )
    if truth.walk_m.any():
        steps = np.linspace(0, 1, truth.walk_m.shape[2])
        displacement += np.stack(
            [np.interp(tau, steps, row) for row in truth.walk_m[index]]
        )
    return displacement


def motion_sign(step: np.ndarray) -> np.ndarray:
    """Return the sign of steps of the axes, m; 0 for one that takes up no backlash."""
    return np.where(np.abs(step) > NO_MOTION_M, np.sign(step), 0)


def true_position(
    truth: Truth,
    index: int,
    position: np.ndarray,
    *,
    tau: np.ndarray,
    approach: np.ndarray,
    sign: np.ndarray,
    rested_s: np.ndarray,
) -> np.ndarray:
    """Return the true position of the stage at exposures, (2, E), m.

    Parameters
    ----------
    truth, index
        The truth, and the index of the view.
    position : float array (2, E)
        Indicated position, m.
    tau : float array (E,)
        Time, 0..1 of the view.
    approach, sign : float arrays (2, E)
        Sign of the last motion of each axis, and of its step to this visit, 0 without one.
    rested_s : float array (E,)
        Time since the first exposure of the visit.
    """
    settling: np.ndarray | float = 0.0
    if truth.settling_m:
        settling = truth.settling_m * sign * np.exp(-rested_s / truth.settling_time_s)
    lag = (
        truth.backlash_m[:, None] + truth.backlash_growth_m * tau
    ) * approach + settling
    return position - stage_error(truth, position, index) - lag


def stage_error(truth: Truth, position: np.ndarray, index: int = 0) -> np.ndarray:
    """Return indicated minus true position at indicated positions (2, E) in a view, m.

    Bilinear between the sites, plus waves and the bending of the stage in that view.
    """
    artifact = truth.artifact.lattice
    place = position / artifact.grid_pitch_m
    error = between_sites(artifact, truth.bilinear, position) + stage_bending(
        truth, position, index
    )
    return error + truth.waves.at(place) if len(truth.waves.number) else error


def between_sites(
    artifact: Artifact, values: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return values at the sites (..., nx, ny) at positions (2, E), m, bilinear, (..., E)."""
    (hx, hy), (nx, ny) = artifact.half, artifact.shape
    u, v = position / artifact.grid_pitch_m + np.array([[hx], [hy]])
    i, j = (
        np.clip(np.floor(w), 0, size - 2).astype(int) for w, size in ((u, nx), (v, ny))
    )
    u, v = u - i, v - j
    return (1 - u) * ((1 - v) * values[..., i, j] + v * values[..., i, j + 1]) + u * (
        (1 - v) * values[..., i + 1, j] + v * values[..., i + 1, j + 1]
    )


def stage_bending(truth: Truth, position: np.ndarray, index: int) -> np.ndarray | float:
    """Return the bending of the stage at indicated positions (2, E) in a view, m."""
    if not len(truth.stage_bend_m):
        return 0.0
    lattice = truth.artifact.lattice
    u, v = position / (lattice.grid_pitch_m * np.array(lattice.half)[:, None])
    return truth.stage_bend_m[index] @ np.stack([u * u, u * v, v * v])


def encoder_error(truth: Truth, position: np.ndarray) -> np.ndarray:
    """Return indicated minus true angle at indicated angles (E,), rad.

    Linear between lines, plus waves.
    """
    count = truth.artifact.angular_count
    g = truth.g_theta
    place = position * (count / (2 * np.pi))
    if len(truth.waves_theta.number):
        g = g - truth.waves_theta.at(np.arange(count)[None])[0]
    k = np.floor(place).astype(int)
    u = place - k
    error = (1 - u) * g[k % count] + u * g[(k + 1) % count]
    return (
        error + truth.waves_theta.at(place[None])[0]
        if len(truth.waves_theta.number)
        else error
    )


def true_offset(sense: Sense, place: np.ndarray, stage: np.ndarray) -> np.ndarray:
    """Return the position of a mark relative to the optical axis.

    Parameters
    ----------
    sense : Sense
        With ``microscope_moves`` the axis is at the stage position. With ``plate_moves`` it is at
        the origin, and the stage carries the plate.
    place : float array
        Position of the mark with the stage at 0, m or rad.
    stage : float array
        True position of the stage, of the same shape.
    """
    return place + stage if sense is Sense.PLATE_MOVES else place - stage


def offset_seen(
    truth: Truth,
    sense: Sense,
    position: np.ndarray,
    stage: np.ndarray,
    place: np.ndarray,
) -> np.ndarray:
    """Return the published offsets of marks, (2, E), m, without noise.

    The stage, whatever it carries, is rotated about the optical axis where it is: its error is that
    of the mark there.

    Parameters
    ----------
    truth, sense
        The truth; what the stage carries.
    position, stage : float arrays (2, E)
        Indicated and true position of the stage, m.
    place : float array (2, E)
        Positions of the marks with the stage at 0, m.
    """
    return seen_offset(
        truth, with_yaw(truth, sense, position, true_offset(sense, place, stage))
    )


def line_offset(
    truth: Truth, sense: Sense, direction: np.ndarray, position: np.ndarray
) -> np.ndarray:
    """Return the true offsets of lines at `direction` with the stage at indicated angles, rad."""
    return true_offset(sense, direction, position - encoder_error(truth, position))


def with_yaw(
    truth: Truth, sense: Sense, position: np.ndarray, offset: np.ndarray
) -> np.ndarray:
    """Return offsets (2, E) as the stage's yaw at positions (2, E) turns them."""
    if not truth.yaw.size:
        return offset
    turn = between_sites(truth.artifact, truth.yaw, position)
    turn = turn if sense is Sense.PLATE_MOVES else -turn  # the microscope instead
    cosine, sine = np.cos(turn), np.sin(turn)
    return np.stack(
        [cosine * offset[0] - sine * offset[1], sine * offset[0] + cosine * offset[1]]
    )


def seen_offset(truth: Truth, offset: np.ndarray) -> np.ndarray:
    """Return published offsets from true ones (2, E): (1 + E)^-1 offset, distorted, then wired."""
    if truth.microscope.any():
        offset = np.linalg.solve(np.eye(2) + truth.microscope, offset)
    if truth.distortion:
        offset = offset * (1 + truth.distortion * (offset**2).sum(axis=0))
    return offset if np.array_equal(truth.wiring, np.eye(2)) else truth.wiring @ offset


def line_directions(
    truth: Truth, index: int, view: View
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the true and the nominal direction in the stage frame of every line expected, rad.

    The nominal direction is within one turn, 0 included. The true one is relative to the rotation
    axis, to which the circle of lines may be eccentric. Also returns the index of the line found
    there; all (K,).
    """
    count = truth.artifact.angular_count
    if not count:
        return np.zeros(0), np.zeros(0), np.zeros(0, dtype=int)
    turn = (np.arange(count) + view.on_stage(truth.artifact).s) % count
    nominal = turn * (2 * np.pi / count)
    lies = truth.placed_as(index, view).on_stage(truth.artifact).s
    nearest = np.rint(turn - lies)
    line = nearest.astype(int) % count
    deviation = (nearest - (turn - lies)) * (2 * np.pi / count)
    direction = nominal + (truth.a_theta[line] + truth.phi_rad[index] + deviation)
    if len(truth.line_eccentricity_rad):
        x, y = truth.line_eccentricity_rad[index]
        cos, sin = np.cos(direction), np.sin(direction)
        direction = direction + np.arctan2(cos * y - sin * x, 1 + cos * x + sin * y)
    return direction, nominal, line


def all_marks(artifact: Artifact) -> tuple[np.ndarray, np.ndarray]:
    """Return m and n of all marks of a plate, (V,) each."""
    return artifact.m.ravel(), artifact.n.ravel()
