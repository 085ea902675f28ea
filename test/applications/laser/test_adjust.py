# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.laser.adjust import Geometry, adjust
from selfcal_ros.applications.laser.data import DIAGONALS, StepDiagonal
from selfcal_ros.applications.laser.identify import jacobian
from selfcal_ros.applications.laser.simulation import (
    Measurement,
    SetUp,
    random_machine,
    simulate_step_diagonal,
)


def measurement(steps):
    machine = random_machine(steps, 3, np.random.default_rng(1), sigma_m=2e-5)
    setups = {
        name: SetUp(mirror_rad=(2e-3 * (k + 1), -1e-3 * k))
        for k, name in enumerate(DIAGONALS[len(steps)])
    }
    return simulate_step_diagonal(
        machine, Measurement(setups), np.random.default_rng(2)
    )


@pytest.mark.parametrize("steps", [(0.01, 0.006), (0.01, 0.008, 0.006)])
def test_model_derivatives_are_those_of_the_model(steps):
    data = measurement(steps)
    geometry, found = Geometry(data), adjust(data)
    by_errors, by_tilt = geometry.derivatives(found.errors_m, found.tilt)
    np.testing.assert_allclose(
        by_errors,
        jacobian(lambda e: geometry.readings(e, found.tilt), found.errors_m),
        atol=1e-8,
    )
    np.testing.assert_allclose(
        by_tilt,
        jacobian(lambda t: geometry.readings(found.errors_m, t), found.tilt),
        atol=1e-10,
    )


@pytest.mark.parametrize("steps", [(0.01, 0.006), (0.01, 0.008, 0.006)])
def test_beams_tilt_square_to_their_diagonals(steps):
    """Diagonal, level side and the third: a right-handed frame of unit vectors."""
    geometry = Geometry(measurement(steps))
    assert len(geometry.sideways) == 2 ** (len(steps) - 1)
    for signs, sides in zip(geometry.signs, geometry.sideways, strict=True):
        frame = np.vstack([signs * np.array(steps) / np.linalg.norm(steps), sides])
        np.testing.assert_allclose(frame @ frame.T, np.eye(len(steps)), atol=1e-15)
        assert np.linalg.det(frame) == pytest.approx(1)
        assert len(steps) == 2 or frame[1, 2] == 0


@pytest.mark.parametrize("steps", [(0.01, 0.006), (0.01, 0.008, 0.006)])
@pytest.mark.parametrize("pick", [None, ["pp"]])
def test_solution_derivatives_are_those_of_the_solution(steps, pick):
    data = measurement(steps)
    if pick and len(steps) == 2:
        data = data.pick(pick)
    found = adjust(data)

    def solve(readings, linear):
        return adjust(
            StepDiagonal(data.steps_m, data.diagonals, readings[None], linear[None])
        ).errors_m

    readings, linear = data.readings_m, data.linear_mean_m
    expected = jacobian(lambda r: solve(r, linear), readings)
    np.testing.assert_allclose(found.by_readings, expected, atol=2e-5)
    expected = jacobian(lambda e: solve(readings, e), linear)
    np.testing.assert_allclose(found.by_linear, expected, atol=2e-5)
    assert np.abs(expected).max() > 0.5
