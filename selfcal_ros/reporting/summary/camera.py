# SPDX-License-Identifier: Apache-2.0
"""The camera of a result in words: errors of its scale and turn, distortion, noises; the yaw."""

import math
from typing import Any

import numpy as np

from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.reporting.summary.numbers import significant
from selfcal_ros.units import MM_PER_M, MRAD_PER_RAD, UM_PER_M, URAD_PER_RAD

COLUMNS = ("x", "y", "dx", "dy", "u_dx", "u_dy")
NUMBERS = ("scale", "rotation", "stretch", "shear", "u_scale", "u_rotation", "u_stretch", "u_shear",
           "degree", "noise_image", "noise_mark")
PERCENT = 100
YAW = ("x", "y", "yaw", "u_yaw")
TURNS = 1e-3
"""Probability of its readings below which a stage is said to turn."""


def cells_of(result: CalibrationResult) -> np.ndarray:
    """Return places, errors and their u at the cells of images, (6, cells), m; empty without."""
    camera: Any = result.extra.get("camera")
    try:
        cells = np.array([[float(cell[name]) for name in COLUMNS] for cell in camera["cells"]]).T
        known = all(isinstance(camera[name], int | float) for name in NUMBERS)
    except (KeyError, TypeError, ValueError):
        return np.zeros((len(COLUMNS), 0))
    good = known and cells.size and np.isfinite(cells).all()
    return cells if good else np.zeros((len(COLUMNS), 0))


def camera_facts(result: CalibrationResult) -> tuple[tuple[str, str], ...]:
    """Return what images tell of the camera, published minus true offset; empty without images."""
    cells, yaw = cells_of(result), yaw_facts(result)
    if not cells.size:
        return yaw
    camera: dict[str, Any] = result.extra["camera"]

    def told(name: str, scale: float, unit: str) -> str:
        value, u = (significant(camera[key] * scale) for key in (name, f"u_{name}"))
        return f"{value} ± {u} {unit} (k=1)"

    worst = int(np.argmax(np.hypot(*cells[2:4])))
    x, y = cells[:2, worst] * MM_PER_M
    size, u = math.hypot(*cells[2:4, worst]), math.hypot(*cells[4:6, worst]) / math.sqrt(2)
    parts = [name for name, power in (("quadratic", [2, 0]), ("radial (cubic)", [2, 1]))
             if power in [c.get("power") for c in camera.get("coefficients", [])]]
    return (("scale", told("scale", PERCENT, "%") + ", offsets published too long where positive"),
            ("rotation", told("rotation", MRAD_PER_RAD, "mrad")),
            ("stretch, shear", f"{told('stretch', PERCENT, '%')}, {told('shear', PERCENT, '%')}"),
            ("distortion", " and ".join(parts) or "none shown"),
            ("largest error", f"{significant(size * UM_PER_M)} ± {significant(u * UM_PER_M)} µm at "
                              f"x {x:.4g} mm, y {y:.4g} mm of the image"),
            ("noise", f"{significant(camera['noise_image'] * UM_PER_M)} µm of an image, "
                      f"{significant(camera['noise_mark'] * UM_PER_M)} µm of a mark in it"), *yaw)


def yaw_of(result: CalibrationResult) -> np.ndarray:
    """Return places, yaw and its u at the nodes of the stage's yaw, (4, nodes); empty without."""
    try:
        found: Any = result.extra["camera"]["yaw"]
        nodes = np.array([found[name] for name in YAW], dtype=float)
        good = nodes.ndim == 2 and np.isfinite(nodes).all() and isinstance(found["p"], int | float)
    except (KeyError, TypeError, ValueError):
        good = False
    return nodes if good else np.zeros((len(YAW), 0))


def yaw_facts(result: CalibrationResult) -> tuple[tuple[str, str], ...]:
    """Return what images tell of the rotation of the stage; empty without images."""
    _, _, yaw, u = yaw_of(result)
    if not yaw.size:
        return ()
    low, high, mean_u = (significant(value * URAD_PER_RAD) for value in (
        yaw.min(), yaw.max(), math.sqrt(np.mean(u**2))))
    p = result.extra["camera"]["yaw"]["p"]
    shown = f"p = {p:.1g}" if p < TURNS else f"not more than its noise, p = {p:.2g}"
    return (("yaw of the stage", f"{low} to {high} ± {mean_u} µrad (k=1) about its mean; {shown}"),)
