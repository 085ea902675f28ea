# SPDX-License-Identifier: Apache-2.0
"""The solution with all terms of the model beside the one without, on the same five views."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

import numpy as np
from timing import median_time

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.normal.equations import system_of
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread, random_truth
from test.support.truth import simulate_measurements

TERMS = "microscope,drift,plate_scale,plate_shape:30e-9,approach"
VIEWS = (
    ("as it is", 0, 0.0, 0.0),
    ("90", 1, 0.0, 0.0),
    ("+x", 0, 0.01, 0.0),
    ("-x", 0, -0.01, 0.0),
    ("+y", 0, 0.0, 0.01),
)


def readings(size: int) -> Measurements:
    """Return five views, each visited there and back, with offsets, times and approaches."""
    views = tuple(
        View(name, turns * np.pi / 2, (x, y), True, False, 4, "x_back_y_back")
        for name, turns, x, y in VIEWS
    )
    plan = Plan("terms", Artifact(size, 0.01, 0), views)
    rng = np.random.default_rng(size)
    truth = random_truth(
        plan.artifact, len(views), rng, Spread(encoder="independent", rotation="finite")
    )
    cell = CellSettings(
        sigma_xy_m=20e-9, stop_sigma_m=20e-6, servo_sigma_m=0, servo_sigma_theta_rad=0
    )
    return simulate_measurements(truth, plan, rng, settings=cell, visits=True)


def solved(size: int, terms: bool) -> tuple[float, None]:
    """Return seconds of a cold solution; readings hold noise, so that no error is exact."""
    data = readings(size)
    options = Options(
        terms=parse_terms([TERMS], "--terms") if terms else (), causes=False
    )

    def cold():
        system_of.cache_clear()
        return calibrate(data, options)

    calibrate(readings(5), Options(causes=False))
    return median_time(cold, once=False)[0], None
