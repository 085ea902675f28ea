# SPDX-License-Identifier: Apache-2.0
"""The same problem put in another way: what must come out the same, and what turns along."""

from dataclasses import replace

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.result import CalibrationResult
from test.support.truth import Truth


def maps_of(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the maps, uncertainties and first-order parts of a result by name."""
    emap = result.error_map
    return {
        "gx": emap.gx,
        "gy": emap.gy,
        "u_gx": emap.u_gx,
        "u_gy": emap.u_gy,
        "g_theta": emap.g_theta,
        "u_g_theta": emap.u_g_theta,
        "o": np.array(emap.nonorthogonality),
        "r": np.array(emap.scale_difference),
    }


def permuted(readings: Measurements, seed: int = 5) -> Measurements:
    """Return the readings of every view in another order."""
    rng = np.random.default_rng(seed)
    views = []
    for view in readings.views:
        grid, lines = rng.permutation(len(view.m)), rng.permutation(len(view.k))
        views.append(
            replace(
                view,
                **{
                    name: getattr(view, name)[grid]
                    for name in ("m", "n", "dx", "dy", "count")
                },
                **{
                    name: getattr(view, name)[lines]
                    for name in ("k", "dtheta", "count_theta")
                },
                u=view.u[grid] if len(view.u) else view.u,
                u_theta=view.u_theta[lines] if len(view.u_theta) else view.u_theta,
            )
        )
    return replace(readings, views=tuple(views))


def turned(readings: Measurements) -> Measurements:
    """Return the readings with stage, plate and plan turned by 90 deg together."""
    old = readings.artifact
    artifact = Artifact(
        old.shape[1],
        old.grid_pitch_m,
        old.angular_count,
        old.shape[0] if old.grid_size_y else 0,
    )
    return replace(
        readings,
        artifact=artifact,
        views=tuple(_turned(view, old.angular_count) for view in readings.views),
    )


def _turned(view: ViewReadings, lines: int) -> ViewReadings:
    x, y = view.view.translation_m
    return replace(
        view,
        view=replace(view.view, translation_m=(-y, x)),
        m=-view.n,
        n=view.m,
        dx=-view.dy,
        dy=view.dx,
        k=(view.k + lines // 4) % max(lines, 1),
    )


def turned_back(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the maps of turned readings in the frame before the turn (microscope_moves)."""
    emap = maps_of(result)
    quarter = result.artifact.angular_count // 4
    back = {
        "gx": emap["gy"],
        "gy": -emap["gx"],
        "u_gx": emap["u_gy"],
        "u_gy": emap["u_gx"],
    }
    out = {key: field[::-1].T for key, field in back.items()}
    out |= {key: np.roll(emap[key], -quarter) for key in ("g_theta", "u_g_theta")}
    return out | {"o": -emap["o"], "r": -emap["r"]}


def mirrored(readings: Measurements) -> Measurements:
    """Return the readings with stage, plate and plan mirrored at the x axis."""
    views = []
    for view in readings.views:
        x, y = view.view.translation_m
        pose = replace(
            view.view, rotation_rad=-view.view.rotation_rad, translation_m=(x, -y)
        )
        views.append(
            replace(
                view,
                view=pose,
                n=-view.n,
                dy=-view.dy,
                dtheta=-view.dtheta,
                k=-view.k % max(readings.artifact.angular_count, 1),
            )
        )
    return replace(readings, views=tuple(views))


def mirrored_back(result: CalibrationResult) -> dict[str, np.ndarray]:
    """Return the maps of mirrored readings in the frame before."""
    emap, lines = maps_of(result), result.artifact.angular_count
    back = -np.arange(lines) % max(lines, 1)
    sign = {"gy": -1, "g_theta": -1}
    out = {
        key: sign.get(key, 1) * emap[key][:, ::-1]
        for key in ("gx", "gy", "u_gx", "u_gy")
    }
    out |= {key: sign.get(key, 1) * emap[key][back] for key in ("g_theta", "u_g_theta")}
    return out | {"o": -emap["o"], "r": emap["r"]}


def scaled(readings: Measurements, factor: float) -> Measurements:
    """Return the readings of a stage that is `factor` times as large, errors and all."""
    old = readings.artifact
    views = tuple(
        replace(
            view,
            view=replace(
                view.view,
                translation_m=tuple(
                    value * factor for value in view.view.translation_m
                ),
            ),
            dx=view.dx * factor,
            dy=view.dy * factor,
            u=view.u * factor,
            sigma_xy=view.sigma_xy * factor,
        )
        for view in readings.views
    )
    return replace(
        readings,
        views=views,
        artifact=replace(old, grid_pitch_m=old.grid_pitch_m * factor),
    )


def with_finite_rotations(readings: Measurements, truth: Truth) -> Measurements:
    """Return linear readings with what a rotation R(phi) of marks and plate errors adds."""
    views = []
    for view, phi in zip(readings.views, truth.phi_rad, strict=True):
        if len(view.m):
            artifact = readings.artifact
            (hx, hy), pose = artifact.half, view.view.lattice_pose(artifact)
            marks = (view.m + 1j * view.n) * artifact.grid_pitch_m
            plate = (truth.a[0] + 1j * truth.a[1])[view.m + hx, view.n + hy]
            exact = np.exp(1j * phi) * (marks + plate) - marks
            more = 1j**pose.quarter_turns * (exact - 1j * phi * marks - plate)
            view = replace(view, dx=view.dx + more.real, dy=view.dy + more.imag)
        views.append(view)
    return replace(readings, views=tuple(views))
