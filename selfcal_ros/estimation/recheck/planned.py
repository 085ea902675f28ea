# SPDX-License-Identifier: Apache-2.0
"""Predictions for views of a known plate, before any is measured."""

from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.estimation.multifrontal.factor import one_thread
from selfcal_ros.estimation.observability.prediction import Prediction
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.recheck.change import map_change
from selfcal_ros.estimation.recheck.plate import KnownPlate
from selfcal_ros.estimation.recheck.solve import Rechecked, recheck_of
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.readings import Measurements, ViewReadings
from selfcal_ros.model.view import Plan, View, with_sub_views


@dataclass(frozen=True, eq=False)
class PlannedRecheck:
    """Predicted uncertainties, in units of the noise of one averaged reading.

    Attributes
    ----------
    map : Prediction
        Of the new map.
    change : float
        Of the change of a coordinate, rms over the nodes.
    """

    map: Prediction
    change: float


@one_thread()
def predict_recheck(plan: Plan, plate: KnownPlate) -> PlannedRecheck:
    """Return the predictions for views of a known plate, with the noise of its calibration.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.recheck.solve.recheck`.
    """
    readings = Measurements(plan.plan_id, plan.artifact, tuple(
        _planned(view, plan) for view in with_sub_views(plan.views)))
    found: Rechecked = recheck_of(readings, Options(assumed=(), misalignment_model="linear"), plate)
    noise = plate.result.noise
    root = np.sqrt(min(view.repeats for view in plan.views))
    unit = noise.sigma_xy / root
    emap = found.error_map()
    u_theta = emap.u_g_theta[np.isfinite(emap.u_g_theta)] * root / noise.sigma_theta
    return PlannedRecheck(Prediction(emap.u_gx / unit, emap.u_gy / unit, u_theta),
                          rms(map_change(found.new, found.artifact, plate).u) / unit)


def _planned(view: View, plan: Plan) -> ViewReadings:
    """Return the readings of a view, all 0."""
    out, artifact = ViewReadings(view), plan.artifact
    if view.grid:
        read = view.pose.in_field(artifact)
        nothing = np.zeros(int(read.sum()))
        out = replace(out, m=artifact.m[read], n=artifact.n[read], dx=nothing, dy=nothing,
                      count=np.full(len(nothing), view.repeats))
    if view.angular and artifact.angular_count:
        lines = np.arange(artifact.angular_count)
        out = replace(out, k=lines, dtheta=np.zeros(len(lines)),
                      count_theta=np.full(len(lines), view.repeats))
    return out
