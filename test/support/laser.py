# SPDX-License-Identifier: Apache-2.0
"""Step-diagonal readings from the formula of the method, and tables with a fault."""

from dataclasses import replace

import numpy as np

from selfcal_ros.applications.laser.data import (
    DIAGONALS,
    StepDiagonal,
    signs_of,
    step_vectors,
)
from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    SetUp,
    simulate_step_diagonal,
    trace,
)
from selfcal_ros.applications.laser.zigzag import Recording

MM = 1e-3


def linear_of(errors_m):
    """Return E_j(j) of every block, (D, n)."""
    return np.array([errors_m[j, :, j] for j in range(len(errors_m))])


def planar(steps_m, errors_m, *, laser_rad=(0.0, 0.0), mirror_rad=(0.0, 0.0)):
    """Return the 2D readings d . n/(l . n), laser off the machine's own diagonals by an angle."""
    vectors, signs = step_vectors(steps_m, errors_m), signs_of(DIAGONALS[2])
    readings = np.empty((2, 2, errors_m.shape[1]))
    for k in range(2):
        diagonal = np.einsum("j,jic->c", signs[k], vectors)
        laser = np.arctan2(diagonal[1], diagonal[0]) + laser_rad[k]
        mirror = laser + mirror_rad[k]
        normal = np.array([np.cos(mirror), np.sin(mirror)])
        w = normal / (np.cos(laser) * normal[0] + np.sin(laser) * normal[1])
        readings[k] = signs[k][:, None] * np.einsum("c,jic->ji", w, vectors)
    return StepDiagonal(
        tuple(steps_m), DIAGONALS[2], readings[None], linear_of(errors_m)[None]
    )


def one_block(ex_x, ey_x, ex_y, ey_y):
    """Return the errors of one block, arguments in mm, as (2, 1, 2) in m."""
    return np.array([[[ex_x, ey_x]], [[ex_y, ey_y]]]) * MM


def random_errors(n, rng, sigma_m=1e-7):
    """Return 2D errors (2, n, 2) in the datum: no transverse error of the first X step."""
    errors = rng.normal(0, sigma_m, (2, n, 2))
    errors[0, 0, 1] = 0.0
    return errors


def scatter_of(machine, values_of):
    """Return a function from a `LaserNoise` to the standard deviations of values that are found.

    `values_of` finds them from a measurement; they follow every mean reading moved in turn. A
    reading is the difference of two distances, one after the other in time.
    """
    exact, size = (
        simulate_step_diagonal(machine, Measurement(), np.random.default_rng(0)),
        1e-8,
    )
    base, answers = values_of(exact), {}
    for name in ("samples_m", "linear_m"):
        whole = getattr(exact, name)
        moves = size * np.eye(whole.size).reshape(-1, *whole.shape)
        answers[name] = np.array(
            [
                (values_of(replace(exact, **{name: whole + move})) - base) / size
                for move in moves
            ]
        )

    def scatter(noise: LaserNoise):
        n = machine.n_blocks
        variance = np.zeros(len(base))
        for k, name in enumerate(exact.diagonals):
            order, _ = trace(machine, name, SetUp())
            of_run = answers["samples_m"].reshape(-1, machine.dim * n, len(base))[k]
            distances = np.diff(of_run[order], axis=0, prepend=0.0, append=0.0)
            variance += noise.distance_m**2 * (distances**2).sum(axis=0)
            variance += noise.reading_m**2 * (of_run**2).sum(axis=0)
        for of_axis in answers["linear_m"].reshape(machine.dim, n, len(base)):
            places = np.diff(of_axis, axis=0, prepend=0.0, append=0.0)
            variance += noise.linear_m**2 * (places**2).sum(axis=0)
        return np.sqrt(variance / noise.repeats)

    return scatter


def recorded(machine, setups, *, rng, noise_m=0.0, extra=None):
    """Return a recording (`Recording`) of the diagonals and single axes of a simulated machine.

    Rests of 1 s at 50 Hz with moves of 0.2 s between; `extra` maps a rest's index to a function
    that spoils its positions.
    """
    steps = np.array(machine.steps_m)
    dim, n = machine.dim, machine.n_blocks
    places, distances = [], []
    for name in (*DIAGONALS[dim], *"xyz"[:dim]):
        if len(name) > 1:
            order, along = trace(machine, name, setups.get(name, SetUp()))
            signs = signs_of([name])[0]
            moves = [
                np.eye(dim)[index // n] * signs[index // n] * steps for index in order
            ]
            start = np.where(signs < 0, n * steps, 0.0)
        else:
            axis = "xyz".index(name)
            moves = [np.eye(dim)[axis] * steps] * n
            along = np.concatenate(
                [[0], np.cumsum(steps[axis] + machine.errors_m[axis, :, axis])]
            )
            start = np.zeros(dim)
        places += [start + np.sum(moves[:k], axis=0) for k in range(len(moves) + 1)]
        distances += list(along + rng.normal(0, 1e-3))
    stamps, positions, laser = [], [], []
    for index, (place, distance) in enumerate(zip(places, distances, strict=True)):
        t = index * 1_200_000_000 + np.arange(60) * 20_000_000
        share = np.clip((np.arange(60) - 49) / 11, 0, 1)[:, None]
        ahead = places[min(index + 1, len(places) - 1)]
        here = place + (ahead - place) * share + np.array([0.3, -0.2, 0.1])[:dim]
        if extra and index in extra:
            here = extra[index](here)
        stamps.append(t)
        positions.append(here)
        leaving = share[:, 0] * 1e-3 * (ahead is not place)
        laser.append(distance + leaving + rng.normal(0, noise_m, 60))
    stamps = np.concatenate(stamps)
    return Recording(
        stamps + 3_000_000, np.concatenate(laser), stamps, np.concatenate(positions)
    )
