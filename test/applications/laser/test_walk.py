# SPDX-License-Identifier: Apache-2.0
"""Both formulations against a simulator of its own: a mirror that is walked point by point.

The reflector's plane goes through the machine's position; its distance along the beam is read
after every step. Nothing of the package is used but the containers.
"""

import numpy as np
import pytest

from selfcal_ros.applications.laser.data import StepDiagonal
from selfcal_ros.applications.laser.identify import identify_ibaraki, identify_wang

NAMES = {2: ("pp", "np"), 3: ("ppp", "npp", "pnp", "ppn")}


def walk(steps_m, errors_m, name, beam):
    """Return the readings (axis, block) of one diagonal; beam = (laser, mirror normal)."""
    laser, normal = beam
    dim, n = len(steps_m), errors_m.shape[1]
    place, before, readings = np.zeros(dim), 0.0, np.zeros((dim, n))
    for turn in range(n):
        for axis in range(dim):
            forth = name[axis] == "p"
            block = turn if forth else n - 1 - turn
            step = errors_m[axis, block].copy()
            step[axis] += steps_m[axis]
            place = place + step if forth else place - step
            distance = place @ normal / (laser @ normal)
            readings[axis, block] = distance - before
            before = distance
    return readings


def along(steps_m, errors_m, name):
    """Return the direction from the first to the last point of a diagonal."""
    total = np.zeros(len(steps_m))
    for axis, sign in enumerate(name):
        run = errors_m[axis].sum(axis=0)
        run[axis] += steps_m[axis] * errors_m.shape[1]
        total += run if sign == "p" else -run
    return total / np.linalg.norm(total)


def tilted(direction, angle_rad, rng):
    """Return `direction` turned by an angle towards a random side."""
    side = rng.normal(size=len(direction))
    side -= (side @ direction) * direction
    return np.cos(angle_rad) * direction + np.sin(angle_rad) * side / np.linalg.norm(
        side
    )


def machine(dim, n, rng):
    """Return unequal steps, and errors of 1 um a block in the datum of the first steps."""
    errors = rng.normal(0, 1e-6, (dim, n, dim))
    errors[0, 0, 1:] = 0.0
    errors[1, 0, 2:] = 0.0
    return tuple(rng.uniform(0.003, 0.04, dim)), errors


def linear(errors_m):
    return np.stack([errors_m[axis, :, axis] for axis in range(len(errors_m))])


CASES = [(2, 2), (2, 7), (2, 50), (3, 2), (3, 5), (3, 12)]


@pytest.mark.parametrize(("dim", "n"), CASES)
def test_new_finds_all_errors_whatever_the_mirrors(dim, n):
    rng = np.random.default_rng(dim * 100 + n)
    steps, errors = machine(dim, n, rng)
    readings = []
    for name in NAMES[dim]:
        laser = along(steps, errors, name)
        readings.append(walk(steps, errors, name, (laser, tilted(laser, 5e-3, rng))))
    data = StepDiagonal(steps, NAMES[dim], np.array([readings]), linear(errors)[None])
    np.testing.assert_allclose(
        identify_ibaraki(data).errors_m, errors, rtol=0, atol=1e-14
    )
    for name in NAMES[2] if dim == 2 else ():
        np.testing.assert_allclose(
            identify_ibaraki(data.pick([name])).errors_m, errors, rtol=0, atol=1e-14
        )


@pytest.mark.parametrize(("dim", "n"), CASES)
def test_conventional_finds_all_errors_where_laser_and_mirror_are_nominal(dim, n):
    rng = np.random.default_rng(dim * 100 + n)
    steps, errors = machine(dim, n, rng)
    readings = []
    for name in NAMES[dim]:
        laser = along(steps, np.zeros_like(errors), name)
        readings.append(walk(steps, errors, name, (laser, laser)))
    data = StepDiagonal(steps, NAMES[dim], np.array([readings]))
    np.testing.assert_allclose(identify_wang(data).errors_m, errors, rtol=0, atol=1e-14)
