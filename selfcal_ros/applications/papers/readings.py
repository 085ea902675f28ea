# SPDX-License-Identifier: Apache-2.0
"""Readings of a machine with known truth and white noise, as the papers simulate them.

Method eqs. 2.2, 2.3.
"""

from dataclasses import replace

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation import physics
from selfcal_ros.simulation.machine import Truth


def grid_deviation(
    truth: Truth, index: int, view: View, *, sense: Sense = Sense.MICROSCOPE_MOVES
) -> np.ndarray:
    """Return the deviation of every mark in a view, (2, nx, ny), m; NaN off the field.

    For a stage that stops at the nominal position, at the beginning of the view, without
    noise, with a perfect microscope.
    """
    artifact = truth.artifact
    place, site = physics.mark_places(truth, index, view, physics.all_marks(artifact))
    pose = view.on_stage(artifact)
    sign = sense.sign
    sites = np.stack(pose.site_of(*artifact.places(*physics.all_marks(artifact))))
    inside = ~pose.beyond_field(sites, artifact)
    out = np.full_like(site, np.nan)
    stop = sign * site[:, inside]
    if artifact.map_grid is None:  # at a node, without the rounding of `stage_error`
        i, j = np.rint(
            stop / artifact.grid_pitch_m + np.array(artifact.half)[:, None]
        ).astype(int)
        error = truth.g[:, i, j] + physics.stage_bending(truth, stop, index)
    else:
        error = physics.stage_error(truth, stop, index)
    out[:, inside] = (place - site)[:, inside] + sign * error
    return out.reshape(2, *artifact.shape)


def angular_deviation(
    truth: Truth, index: int, view: View, *, sense: Sense = Sense.MICROSCOPE_MOVES
) -> np.ndarray:
    """Return the noise-free deviation of every angular line in a view, (K,), rad."""
    direction, nominal, _ = physics.line_directions(truth, index, view)
    sign = sense.sign
    return direction - nominal + sign * physics.encoder_error(truth, sign * nominal)


def simulate_measurements(
    truth: Truth,
    plan: Plan,
    rng: np.random.Generator,
    *,
    sigma_m: float = 0.0,
    sigma_theta_rad: float = 0.0,
    sense: Sense = Sense.MICROSCOPE_MOVES,
    missing: float = 0.0,
) -> Measurements:
    """Return the readings of all views, with noise and missing marks.

    Parameters
    ----------
    truth, plan, rng
        Truth, plan, and the source of noise.
    sigma_m, sigma_theta_rad : float
        Standard deviation of one reading; each mark is the mean of the view's repeats.
    sense : Sense
        What moves.
    missing : float
        Fraction of marks lost, independently in each view.
    """
    views = tuple(
        _simulate_view(
            truth,
            (index, view),
            rng,
            sigma=(sigma_m, sigma_theta_rad),
            sense=sense,
            missing=missing,
        )
        for index, view in enumerate(plan.views)
    )
    return Measurements(plan.plan_id, plan.artifact, views, sense)


def _simulate_view(
    truth: Truth,
    item: tuple[int, View],
    rng: np.random.Generator,
    *,
    sigma: tuple[float, float],
    sense: Sense,
    missing: float,
) -> ViewReadings:
    index, view = item
    artifact, repeats = truth.artifact, view.repeats
    readings = ViewReadings(
        view,
        sigma_xy=_repeatability(sigma[0], repeats),
        sigma_theta=_repeatability(sigma[1], repeats),
    )
    if view.grid:
        v = grid_deviation(truth, index, view, sense=sense)
        v = v + rng.normal(0, 1, v.shape) * (sigma[0] / np.sqrt(repeats))
        read = np.isfinite(v).all(axis=0) & (rng.random(artifact.shape) >= missing)
        readings = replace(
            readings,
            m=artifact.m[read],
            n=artifact.n[read],
            dx=v[0][read],
            dy=v[1][read],
            count=np.full(read.sum(), repeats),
            dof_xy=2 * int(read.sum()) * (repeats - 1),
        )
    if view.angular:
        v = angular_deviation(truth, index, view, sense=sense)
        v = v + rng.normal(0, 1, v.shape) * (sigma[1] / np.sqrt(repeats))
        read = rng.random(len(v)) >= missing
        k = np.arange(len(v))[read]
        readings = replace(
            readings,
            k=k,
            dtheta=v[read],
            count_theta=np.full(len(k), repeats),
            dof_theta=len(k) * (repeats - 1),
        )
    used = int(readings.count.sum() + readings.count_theta.sum())
    return replace(readings, used=used)


def _repeatability(sigma: float, repeats: int) -> float:
    return sigma if repeats > 1 else float("nan")


def hu_plan(artifact: Artifact, repeats: int = 1) -> Plan:
    """Return Hu's four views: identity, 90°, one line (angular only), one pitch along +X."""
    angular = artifact.angular_count > 0
    view = View("identity", angular=angular, repeats=repeats)
    views = [
        view,
        replace(view, name="rot90", rotation_rad=np.pi / 2),
        replace(view, name="shift_x", translation_m=(artifact.grid_pitch_m, 0.0)),
    ]
    if angular:
        line = 2 * np.pi / artifact.angular_count
        views.insert(2, replace(view, name="line", rotation_rad=line, grid=False))
    return Plan("hu", artifact, tuple(views))
