# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from selfcal_ros.applications.laser.data import DIAGONALS
from selfcal_ros.applications.laser.identify import identify_ibaraki
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    SetUp,
    StepMachine,
    random_machine,
    simulate_step_diagonal,
    trace,
)
from test.support.laser import linear_of, planar, random_errors


def simulate(machine, setups=None, noise=None, seed=0):
    return simulate_step_diagonal(
        machine,
        Measurement(setups or {}, noise or LaserNoise()),
        np.random.default_rng(seed),
    )


def test_the_traced_beam_agrees_with_the_formula_of_the_method():
    errors = random_errors(6, np.random.default_rng(1))
    setups = {
        "pp": SetUp(laser_rad=(7e-4,), mirror_rad=(-9e-4,)),
        "np": SetUp(laser_rad=(-3e-4,), mirror_rad=(5e-4,)),
    }
    data = simulate(StepMachine((0.01, 0.007), errors), setups)
    expected = planar(
        (0.01, 0.007), errors, laser_rad=(7e-4, -3e-4), mirror_rad=(-9e-4, 5e-4)
    )
    np.testing.assert_allclose(data.readings_m, expected.readings_m, atol=1e-15)
    np.testing.assert_array_equal(data.linear_mean_m, linear_of(errors))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_perfect_machine_gives_nominal_readings_on_every_diagonal(dim):
    steps = (0.01, 0.02, 0.005)[:dim]
    data = simulate(StepMachine(steps, np.zeros((dim, 3, dim))))
    nominal = np.square(steps) / np.linalg.norm(steps)
    np.testing.assert_allclose(
        data.readings_m,
        np.broadcast_to(nominal[:, None], data.readings_m.shape),
        rtol=1e-13,
    )


def test_a_laser_along_the_nominal_diagonal_does_not_follow_the_machine():
    errors = np.zeros((2, 2, 2))
    errors[1, :, 0] = 1e-4
    machine = StepMachine((0.01, 0.01), errors)
    nominal = {name: SetUp(to_machine=False) for name in DIAGONALS[2]}
    reading = simulate(machine, nominal).readings_m[0, 1, 0]
    assert reading == pytest.approx((1e-4 + 0.01) / np.sqrt(2), rel=1e-12)
    assert simulate(machine).readings_m[0, 1, 0] != pytest.approx(reading, rel=1e-6)


def test_a_turn_of_the_mirror_acts_through_the_abbe_offset():
    turns = np.zeros((2, 1, 3))
    turns[0, 0, 2] = 1e-5
    machine = StepMachine((0.01, 0.01), np.zeros((2, 1, 2)), turns)
    # Spot 5 mm from the functional point, square to the laser, to the left of it.
    side = 0.005 * np.array([-1, 1, 0]) / np.sqrt(2)
    with_offset = simulate(machine, {"pp": SetUp(abbe_m=tuple(side))}).readings_m[
        0, 0, 0
    ]
    without = simulate(machine).readings_m[0, 0, 0]
    # A turn to the left takes a spot on the left backwards.
    assert with_offset - without == pytest.approx(-0.005 * 1e-5, rel=1e-4)


def test_a_turned_mirror_reads_the_beams_place_on_it():
    turns = np.zeros((2, 1, 3))
    turns[0, 0, 2] = 1e-5
    flat = StepMachine((0.01, 0.01), np.zeros((2, 1, 2)))
    turned = StepMachine((0.01, 0.01), np.zeros((2, 1, 2)), turns)
    # After the X step the beam lies 10 mm/sqrt(2) to the left of the functional point, where a
    # mirror turned to the left stands back by turn x distance.
    difference = simulate(turned).readings_m - simulate(flat).readings_m
    assert difference[0, 0, 0] == pytest.approx(-1e-5 * 0.01 / np.sqrt(2), rel=1e-4)
    assert difference[0].sum() == pytest.approx(0, abs=1e-11), (
        "the beam is back at the point"
    )


def test_stacked_axes_turn_the_steps_of_what_they_carry():
    turns = np.zeros((2, 1, 3))
    turns[0, 0, 2] = 1e-5
    along = {"pp": SetUp(to_machine=False)}
    riding = StepMachine((0.01, 0.01), np.zeros((2, 1, 2)), turns, stacked=True)
    apart = StepMachine((0.01, 0.01), np.zeros((2, 1, 2)), turns)
    end = [trace(machine, "pp", along["pp"])[1][-1] for machine in (riding, apart)]
    # Y leans to -X by the turn: the end moves by -turn * step in X, seen along the diagonal.
    assert end[0] - end[1] == pytest.approx(-1e-5 * 0.01 / np.sqrt(2), rel=1e-3)


def test_noise_and_repeats_come_from_the_generator_given():
    machine = random_machine((0.01, 0.01), 4, np.random.default_rng(0))
    noise = LaserNoise(1e-8, 1e-8, 1e-8, repeats=3)
    one, same = (
        simulate(machine, noise=noise, seed=1),
        simulate(machine, noise=noise, seed=1),
    )
    other = simulate(machine, noise=noise, seed=2)
    np.testing.assert_array_equal(one.samples_m, same.samples_m)
    assert (
        one.samples_m.shape == (3, 2, 2, 4) and np.ptp(one.linear_m, axis=0).min() > 0
    )
    assert (one.samples_m != other.samples_m).all()


def test_the_unit_of_the_laser_scales_every_reading():
    machine = random_machine((0.01, 0.01), 4, np.random.default_rng(0))
    longer = simulate(machine, {"pp": SetUp(scale=1e-6)}).readings_m
    np.testing.assert_allclose(
        longer[0], simulate(machine).readings_m[0] * (1 + 1e-6), rtol=1e-14
    )


def test_a_random_machine_is_in_the_datum_of_the_results():
    machine = random_machine((0.01, 0.02, 0.03), 4, np.random.default_rng(0))
    np.testing.assert_allclose(machine.truth_m(), machine.errors_m, atol=1e-18)
    assert (
        machine.errors_m[0, 0, 1]
        == machine.errors_m[0, 0, 2]
        == machine.errors_m[1, 0, 2]
        == 0
    )
    np.testing.assert_allclose(
        identify_ibaraki(simulate(machine)).errors_m, machine.errors_m, atol=1e-13
    )
