# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.aerotech.evaluate import CalEvaluator
from selfcal_ros.applications.aerotech.verify import setup_of
from selfcal_ros.applications.laser.identify import identify_ibaraki, identify_wang
from selfcal_ros.applications.laser.profiles import (
    axis_corrections,
    map_equivalent,
    squareness,
    squareness_rad,
    u_slope,
)
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    StepMachine,
    case_study_machine,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.cli.step_diagonal import correction_tables
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from test.support.laser import scatter_of
from test.support.maps import first_order


def measured(machine, noise=None):
    return simulate_step_diagonal(
        machine, Measurement({}, noise or LaserNoise()), np.random.default_rng(7)
    )


@pytest.mark.parametrize(
    "frame",
    [
        MachineFrame(1, 2),
        MachineFrame(3, 5, unit="um", home_x_m=0.02, home_y_m=-0.01),
        MachineFrame(2, 1, reverse_x=True, home_x_m=0.06),
        MachineFrame(1, 2, reverse_y=True),
    ],
)
def test_a_corrected_machine_is_straight_square_and_true(frame):
    machine = case_study_machine()
    found = identify_ibaraki(measured(machine))
    tables = CalEvaluator(correction_tables(found, frame), setup_of(frame))
    place = np.arange(7) * 0.01
    x, y = (grid.ravel() for grid in np.meshgrid(place, place, indexing="ij"))
    # E = Px(x) + Px(y), Py(x) + Py(y): what the steps of the machine add up to.
    sums = np.concatenate(
        [np.zeros((2, 1, 2)), np.cumsum(machine.errors_m, axis=1)], axis=1
    )
    error = (sums[0][:, None] + sums[1][None]).reshape(-1, 2)
    px, py = frame.to_machine(x, y)
    add = tables.corrections({frame.x_axis: px, frame.y_axis: py})
    cx = frame.sign_x * add[frame.x_axis] * frame.unit_m
    cy = frame.sign_y * add[frame.y_axis] * frame.unit_m
    residual = error + np.stack([cx, cy], axis=1)
    # Left is what no table of straightness knows: a shift, and the turn of the X axis' line.
    turned = np.stack(
        [
            np.concatenate([np.ones(49), np.zeros(49)]),
            np.concatenate([np.zeros(49), np.ones(49)]),
            np.concatenate([-y, x]),
        ],
        axis=1,
    )
    values = residual.T.ravel()
    left = values - turned @ np.linalg.lstsq(turned, values, rcond=None)[0]
    assert np.abs(left).max() < 0.02e-9
    assert np.abs(error - error.mean(axis=0)).max() > 0.5e-6


def test_the_correction_of_y_along_x_has_no_slope():
    line = axis_corrections(identify_ibaraki(measured(case_study_machine())))[
        ("x", "y")
    ]
    assert np.polyfit(*line, 1)[0] == pytest.approx(0, abs=1e-15)


def test_the_conventional_formulation_corrects_no_linear_errors():
    found = identify_wang(measured(case_study_machine()))
    assert sorted(axis_corrections(found)) == [("x", "y"), ("y", "x")]


def test_o_and_r_are_those_of_an_error_map_of_the_same_machine():
    # First-order errors: both axes lean, both scales differ.
    errors = np.zeros((2, 6, 2))
    errors[0] = [3e-7, 0.0]
    errors[1] = [-2e-7, 1e-7]
    found = identify_ibaraki(measured(StepMachine((0.01, 0.01), errors)))
    artifact = Artifact(7, 0.01)
    sums = np.concatenate([np.zeros((2, 1, 2)), np.cumsum(errors, axis=1)], axis=1)
    g = -(sums[0][:, None] + sums[1][None])
    o, r = first_order(artifact, g[..., 0], g[..., 1])
    equivalent = map_equivalent(found)
    assert equivalent.nonorthogonality == pytest.approx(o, rel=1e-9)
    assert equivalent.scale_difference == pytest.approx(r, rel=1e-9)
    assert squareness_rad(found) == pytest.approx(-2 * o, rel=1e-9)
    assert (
        equivalent.u_nonorthogonality is None and equivalent.u_scale_difference is None
    )


def test_uncertainties_follow():
    found = identify_ibaraki(
        measured(case_study_machine(), LaserNoise(1e-8, 0, 1e-8, 3))
    )
    equivalent = map_equivalent(found)
    assert equivalent.u_nonorthogonality == pytest.approx(
        squareness(found).u / 0.06 / 2
    )
    expected = np.hypot(*(u_slope(found, axis, axis) for axis in (0, 1))) / 2
    assert equivalent.u_scale_difference == pytest.approx(expected)


@pytest.mark.parametrize("steps_m", [(0.01, 0.016), (0.016, 0.01)])
def test_the_uncertainty_of_o_is_the_spread_of_measurements_with_unequal_steps(steps_m):
    machine, noise = (
        StepMachine(steps_m, np.zeros((2, 4, 2))),
        LaserNoise(1e-8, 0, 1e-8, 400),
    )
    spread = scatter_of(
        machine,
        lambda data: np.array(
            [map_equivalent(identify_ibaraki(data)).nonorthogonality]
        ),
    )(noise)
    found = map_equivalent(identify_ibaraki(measured(machine, noise)))
    assert found.u_nonorthogonality == pytest.approx(spread[0], rel=0.05)


def test_the_conventional_formulation_tells_no_scale():
    found = identify_wang(measured(case_study_machine()))
    assert map_equivalent(found).scale_difference is None


def test_body_diagonals_have_no_table():
    machine = random_machine((0.01, 0.01, 0.01), 3, np.random.default_rng(0))
    with pytest.raises(InputError, match="body diagonals measure three axes"):
        axis_corrections(identify_ibaraki(measured(machine)))
