# SPDX-License-Identifier: Apache-2.0
"""A step-diagonal measurement of a machine with known errors and a misaligned set-up.

The geometry is traced, independently of the formulas of `selfcal_ros.laser`: a beam along a line
fixed in space hits the plane of the mirror carried by the machine.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from selfcal_ros.laser import data

_Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class StepMachine:
    """A machine with known steps.

    Attributes
    ----------
    steps_m : tuple of float (D,)
        Nominal steps, D = 2 or 3.
    errors_m : float array (D, n, D)
        E[j, i, c]: error in direction c of the i-th step of axis j at the functional point, m.
    turns_rad : float array (D, n, 3) or None
        Rotation vector by which the mirror's carrier turns in that step, rad.
    stacked : bool
        Whether Y is mounted on X (and Z on both), so that their steps turn with it.
    """

    steps_m: tuple[float, ...]
    errors_m: np.ndarray
    turns_rad: np.ndarray | None = None
    stacked: bool = False

    @property
    def dim(self) -> int:
        """Number of axes."""
        return len(self.steps_m)

    @property
    def n_blocks(self) -> int:
        """Number of blocks."""
        return self.errors_m.shape[1]

    def truth_m(self) -> np.ndarray:
        """Return the errors rotated so that the first X step has no transverse error, m."""
        turned = data.turn_to_first_step(data.step_vectors(self.steps_m, self.errors_m))
        return turned - np.diag(self.steps_m)[:, None, :]


@dataclass(frozen=True)
class SetUp:
    """Alignment of laser and mirror for one diagonal.

    Attributes
    ----------
    laser_rad, mirror_rad : tuple of float
        Angles of the laser from its reference direction and of the mirror's normal from the
        laser: counter-clockwise in XY, and in 3D a second one upwards.
    to_machine : bool
        Whether the laser's reference is the machine's own diagonal, as with the spot kept
        on a quad-detector; if false, the nominal one.
    abbe_m : tuple of float
        Point where the beam hits the mirror at the start, relative to the functional point, m.
    scale : float
        Relative error of the laser's unit of length.
    """

    laser_rad: tuple[float, ...] = (0.0, 0.0)
    mirror_rad: tuple[float, ...] = (0.0, 0.0)
    to_machine: bool = True
    abbe_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 0.0


@dataclass(frozen=True)
class LaserNoise:
    """Noise and repeats.

    Attributes
    ----------
    distance_m : float
        Standard deviation of one laser distance; a reading is the difference of two.
    reading_m : float
        Standard deviation added to every reading independently.
    linear_m : float
        Standard deviation of one distance of the direct measurement of the linear errors.
    repeats : int
        Number of times that everything is measured.
    """

    distance_m: float = 0.0
    reading_m: float = 0.0
    linear_m: float = 0.0
    repeats: int = 1


@dataclass(frozen=True)
class Measurement:
    """Simulated measurement: set-up of every diagonal (default: perfect) and noise."""

    setups: Mapping[str, SetUp] = field(default_factory=dict)
    noise: LaserNoise = field(default_factory=LaserNoise)


def simulate_step_diagonal(machine: StepMachine, measurement: Measurement,
                           rng: np.random.Generator) -> data.StepDiagonal:
    """Return the readings and linear errors of the measurement.

    Parameters
    ----------
    machine : StepMachine
        The truth.
    measurement : Measurement
        Set-up and noise.
    rng : numpy.random.Generator
        Source of the noise.
    """
    names, noise = data.DIAGONALS[machine.dim], measurement.noise
    n = machine.n_blocks
    samples = np.empty((noise.repeats, len(names), machine.dim, n))
    for k, name in enumerate(names):
        order, distances = trace(machine, name, measurement.setups.get(name, SetUp()))
        for repeat in range(noise.repeats):
            noisy = distances + rng.normal(0, noise.distance_m, distances.shape)
            readings = np.diff(noisy) + rng.normal(0, noise.reading_m, len(order))
            samples[repeat, k].ravel()[order] = readings
    linear = np.array([machine.errors_m[j, :, j] for j in range(machine.dim)])
    shape = (noise.repeats, machine.dim, n + 1)
    linear = linear + np.diff(rng.normal(0, noise.linear_m, shape), axis=-1)
    return data.StepDiagonal(machine.steps_m, names, samples, linear)


def trace(machine: StepMachine, name: str, setup: SetUp) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of the steps in time and the laser distances, noise-free.

    Returns
    -------
    order : int array (D*n,)
        Flat index j*n + i of every step.
    distances : float array (D*n + 1,)
        Laser distance before the first and after every step, m; growing along the diagonal.
    """
    signs = data.signs_of([name])[0]
    vectors = np.zeros((machine.dim, machine.n_blocks, 3))
    vectors[:, :, :machine.dim] = data.step_vectors(machine.steps_m, machine.errors_m)
    turns = (np.zeros(vectors.shape) if machine.turns_rad is None else machine.turns_rad)
    order, centres, angles = [], [np.zeros(3)], [np.zeros(3)]
    carried = np.zeros((machine.dim + 1, 3))  # turn of the axes before axis j
    for block in range(machine.n_blocks):
        for j, sign in enumerate(signs):
            i = block if sign > 0 else machine.n_blocks - 1 - block
            step = sign * vectors[j, i]
            if machine.stacked:
                step = rotation(carried[:j].sum(axis=0)) @ step
            carried[j] += sign * turns[j, i]
            order.append(j * machine.n_blocks + i)
            centres.append(centres[-1] + step)
            angles.append(angles[-1] + sign * turns[j, i])
    beam, normal = _directions(machine, signs, setup, centres[-1])
    spot = np.array(setup.abbe_m)
    distances = []
    for centre, angle in zip(centres, angles, strict=True):
        turn = rotation(angle)
        facing = turn @ normal
        distances.append((centre + turn @ spot - spot) @ facing / (beam @ facing))
    return np.array(order), np.array(distances) * (1.0 + setup.scale)


def _directions(machine: StepMachine, signs: np.ndarray, setup: SetUp,
                end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the beam's direction and the mirror's normal, unit vectors (3,)."""
    nominal = np.zeros(3)
    nominal[:machine.dim] = signs * np.array(machine.steps_m)
    reference = end if setup.to_machine else nominal
    reference = reference / np.linalg.norm(reference)
    level = np.cross(_Z, nominal)
    level /= np.linalg.norm(level)
    upward = np.cross(nominal / np.linalg.norm(nominal), level)
    beam = _tilted(reference, (level, upward), setup.laser_rad)
    return beam, _tilted(beam, (level, upward), setup.mirror_rad)


def _tilted(direction: np.ndarray, sideways: tuple[np.ndarray, np.ndarray],
            angles_rad: tuple[float, ...]) -> np.ndarray:
    for side, angle in zip(sideways, angles_rad, strict=False):
        direction = rotation(angle * np.cross(direction, side)) @ direction
    return direction


def rotation(vector_rad: np.ndarray) -> np.ndarray:
    """Return the rotation matrix (3, 3) of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector_rad)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector_rad / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def random_machine(steps_m: tuple[float, ...], n_blocks: int, rng: np.random.Generator, *,
                   sigma_m: float = 1e-7) -> StepMachine:
    """Return a machine with normally distributed step errors, in the datum of the results."""
    machine = StepMachine(steps_m, rng.normal(0, sigma_m, (len(steps_m), n_blocks, len(steps_m))))
    return StepMachine(steps_m, machine.truth_m())


def case_study_machine() -> StepMachine:
    """Return a machine with the source's measured errors: 6 blocks of 10 mm x 10 mm.

    Over 60 mm: linear errors +1.14 um (X), +0.69 um (Y); straightness 0.05 um (X), 0.11 um (Y)
    about least-squares lines; squareness -1.22 um. The shapes of the profiles are invented.
    """
    n, step = 6, 0.010
    errors = np.zeros((2, n, 2))
    errors[0, :, 0] = 1.14e-6 / n * (1 + 0.3 * np.sin(np.arange(n)))
    errors[0, :, 0] += 1.14e-6 / n - errors[0, :, 0].mean()
    errors[1, :, 1] = 0.69e-6 / n * (1 + 0.4 * np.cos(np.arange(n)))
    errors[1, :, 1] += 0.69e-6 / n - errors[1, :, 1].mean()
    t = np.arange(n + 1) / n
    line = np.polynomial.Polynomial.fit
    shapes = np.array([np.sin(2.2 * np.pi * t), t * (1 - t) + 0.1 * np.cos(5 * t)])
    for j, peak_to_valley in enumerate((0.05e-6, 0.11e-6)):
        shape = shapes[j] - line(t, shapes[j], 1)(t)
        shape *= peak_to_valley / np.ptp(shape)
        errors[j, :, 1 - j] = np.diff(shape)
    errors[0, :, 1] -= errors[0, 0, 1]
    # Slopes over the range: of Y along x by the datum; of X along y for the squareness.
    along_x = np.concatenate([[0.0], np.cumsum(errors[0, :, 1])])
    errors[1, :, 0] += (-1.22e-6 - np.polyfit(t, along_x, 1)[0]) / n
    return StepMachine((step, step), errors)
