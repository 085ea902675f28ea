# SPDX-License-Identifier: Apache-2.0
"""Populations of machines and plans: each run draws its own."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.terms import parse_terms
from selfcal_ros.model.view import Plan, View
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import Spread
from tools.reality.cases import SIGMA_RAD, Case, checked

POSES = {
    "hu": "0 90 +x",
    "five": "0 90 +x -x +y",
    "six": "0 90 180 270 +x +y",
    "seven": "0 90 180 +x -x +y -y",
}
"""Grid views of the plans that are drawn: turns in degrees, shifts by a pitch."""
ORDERS = (
    "raster",
    "serpentine",
    "there_and_back",
    "x_then_y",
    "x_back_y_back",
    "random",
    "serpentine@plate",
)


def populations() -> list[Case]:
    """Return a population a case."""
    return [
        Case("population clean", draw=_clean),
        Case(
            "population clean, microscope as its default uncertainty says",
            draw=_microscope,
        ),
        Case("population mixture of twelve effects, half size", draw=_mixture),
        Case(
            "population mixture of twelve effects, half size; model plate_shape:5e-9",
            draw=_mixture,
            options=_bent(),
        ),
    ]


def _bent() -> Options:
    """Return options that declare the bending of a good machine's plate and stage."""
    return Options(terms=parse_terms(["plate_shape:5e-9"], "reality"))


def _clean(rng: np.random.Generator, case: Case) -> Case:
    """Draw a plan and a machine that does nothing beside the model.

    A stage that does not scatter checks its stops: else nothing shows the sign of the offsets.
    """
    count = int(rng.choice([0, 8, 24, 36]))
    artifact = Artifact(int(rng.choice([5, 7, 9, 11, 13])), 0.01, count)
    repeats = int(rng.integers(2, 7))
    sense = Sense.PLATE_MOVES if rng.random() < 0.5 else Sense.MICROSCOPE_MOVES
    settings = CellSettings(
        sense,
        float(10 ** rng.uniform(-8.3, -7.3)),
        SIGMA_RAD,
        servo_sigma_m=float(rng.choice([0.0, 50e-9, 200e-9])),
        visit_order=str(rng.choice(ORDERS)),
        consecutive=bool(rng.random() < 0.3),
    )
    spread = Spread(phi_rad=float(np.deg2rad(10 ** rng.uniform(-2.5, -0.5))))
    plan = _plan(artifact, str(rng.choice(list(POSES))), repeats)
    missing = float(rng.choice([0.0, rng.uniform(0, 0.2)]))
    return replace(
        case,
        spread=spread,
        settings=settings,
        missing=missing,
        plan=checked(plan)
        if not settings.servo_sigma_m or rng.random() < 0.3
        else plan,
    )


def _plan(artifact: Artifact, name: str, repeats: int) -> Plan:
    pitch, angular = artifact.grid_pitch_m, artifact.angular_count > 0
    views = []
    for pose in POSES[name].split():
        turn = (
            0.0 if pose[1:] in "xy" and pose != "0" else float(np.deg2rad(float(pose)))
        )
        shift = {
            "+x": (pitch, 0.0),
            "-x": (-pitch, 0.0),
            "+y": (0.0, pitch),
            "-y": (0.0, -pitch),
        }.get(pose, (0.0, 0.0))
        views.append(View(pose, turn, shift, True, angular, repeats))
    if angular:
        views.append(
            View(
                "line",
                2 * np.pi / artifact.angular_count,
                (0.0, 0.0),
                False,
                True,
                repeats,
            )
        )
    return Plan(name, artifact, tuple(views))


def _microscope(rng: np.random.Generator, case: Case) -> Case:
    clean = _clean(rng, case)
    return replace(
        clean,
        spread=replace(
            clean.spread,
            microscope_scale=rng.normal(0, 0.01),
            microscope_rotation_rad=rng.normal(0, 0.01),
            microscope_shear=rng.normal(0, 0.002),
        ),
    )


TYPICAL = {
    "microscope_scale": 5e-3,
    "microscope_rotation_rad": 2e-3,
    "microscope_shear": 1e-3,
    "backlash_x_m": 10e-9,
    "settling_m": 6e-9,
    "plate_scale": 0.2e-6,
    "plate_strain": 0.2e-6,
    "plate_shape_m": 5e-9,
    "stage_bend_m": 4e-9,
    "drift_linear_m": 20e-9,
    "line_eccentricity_rad": 2e-6,
}
"""Typical sizes of effects of a good machine; with them goes 1/f noise of 8 nm."""


def _mixture(rng: np.random.Generator, case: Case) -> Case:
    """Draw twelve effects at once, each half its typical size, those of the machine of any sign."""
    sizes = {name: size / 2 for name, size in TYPICAL.items()}
    for name in (
        "microscope_scale",
        "microscope_rotation_rad",
        "microscope_shear",
        "backlash_x_m",
        "settling_m",
    ):
        sizes[name] *= float(rng.choice([-1, 1]))
    spread = Spread(
        phi_rad=float(np.deg2rad(0.03)), backlash_y_m=sizes["backlash_x_m"], **sizes
    )
    artifact = Artifact(11, 0.01, 24)
    settings = CellSettings(
        sigma_xy_m=20e-9, sigma_theta_rad=SIGMA_RAD, flicker_xy_m=4e-9
    )
    return replace(
        case,
        spread=spread,
        settings=settings,
        plan=_plan(artifact, str(rng.choice(["hu", "five"])), 5),
    )
