# SPDX-License-Identifier: Apache-2.0
"""A step-diagonal measurement of a machine with known errors and a misaligned set-up.

The geometry is traced, independently of the formulas of `selfcal_ros.applications.laser`: a beam
along a line fixed in space hits the plane of the mirror carried by the machine. Machine, set-up and
noise come from a YAML file (config/step_diagonal).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import cast

import numpy as np
from scipy.spatial.transform import Rotation

from selfcal_ros.applications.laser.data import (
    DIAGONALS,
    MAX_BLOCKS,
    StepDiagonal,
    signs_of,
    step_vectors,
    turn_to_first_step,
)
from selfcal_ros.applications.laser.profiles import name_of
from selfcal_ros.errors import InputError
from selfcal_ros.files import checked_fields
from selfcal_ros.units import (
    M_PER_MM,
    M_PER_NM,
    M_PER_UM,
    ONE_PER_PPM,
    RAD_PER_MRAD,
    RAD_PER_URAD,
)

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
        turned = turn_to_first_step(step_vectors(self.steps_m, self.errors_m))
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


def simulate_step_diagonal(
    machine: StepMachine, measurement: Measurement, rng: np.random.Generator
) -> StepDiagonal:
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
    names = DIAGONALS[machine.dim]
    noise = measurement.noise
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
    return StepDiagonal(machine.steps_m, names, samples, linear)


def trace(
    machine: StepMachine, name: str, setup: SetUp
) -> tuple[np.ndarray, np.ndarray]:
    """Return the order of the steps in time and the laser distances, noise-free.

    Returns
    -------
    order : int array (D*n,)
        Flat index j*n + i of every step.
    distances : float array (D*n + 1,)
        Laser distance before the first and after every step, m; growing along the diagonal.
    """
    signs = signs_of([name])[0]
    vectors = np.zeros((machine.dim, machine.n_blocks, 3))
    vectors[:, :, : machine.dim] = step_vectors(machine.steps_m, machine.errors_m)
    turns = np.zeros(vectors.shape) if machine.turns_rad is None else machine.turns_rad
    order = []
    centres = [np.zeros(3)]
    angles = [np.zeros(3)]
    carried = np.zeros((machine.dim + 1, 3))  # turn of the axes before axis j
    for block in range(machine.n_blocks):
        for j, sign in enumerate(signs):
            i = block if sign > 0 else machine.n_blocks - 1 - block
            step = sign * vectors[j, i]
            if machine.stacked:
                step = Rotation.from_rotvec(carried[:j].sum(axis=0)).apply(step)
            carried[j] += sign * turns[j, i]
            order.append(j * machine.n_blocks + i)
            centres.append(centres[-1] + step)
            angles.append(angles[-1] + sign * turns[j, i])
    beam, normal = _directions(machine, signs, setup, centres[-1])
    spot = np.array(setup.abbe_m)
    turn = Rotation.from_rotvec(angles)
    facing = turn.apply(normal)
    travel = centres + turn.apply(spot) - spot
    distances = np.sum(travel * facing, axis=1) / (facing @ beam)
    return np.array(order), distances * (1.0 + setup.scale)


def _directions(
    machine: StepMachine, signs: np.ndarray, setup: SetUp, end: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the beam's direction and the mirror's normal, unit vectors (3,)."""
    nominal = np.zeros(3)
    nominal[: machine.dim] = signs * np.array(machine.steps_m)
    reference = end if setup.to_machine else nominal
    reference = reference / np.linalg.norm(reference)
    level = np.cross(_Z, nominal)
    level /= np.linalg.norm(level)
    upward = np.cross(nominal / np.linalg.norm(nominal), level)
    beam = _tilted(reference, (level, upward), setup.laser_rad)
    return beam, _tilted(beam, (level, upward), setup.mirror_rad)


def _tilted(
    direction: np.ndarray,
    sideways: tuple[np.ndarray, np.ndarray],
    angles_rad: tuple[float, ...],
) -> np.ndarray:
    for side, angle in zip(sideways, angles_rad, strict=False):
        turn = Rotation.from_rotvec(angle * np.cross(direction, side))
        direction = turn.apply(direction)
    return direction


def random_machine(
    steps_m: tuple[float, ...],
    n_blocks: int,
    rng: np.random.Generator,
    *,
    sigma_m: float = 1e-7,
) -> StepMachine:
    """Return a machine with normally distributed step errors, in the datum of the results."""
    machine = StepMachine(
        steps_m, rng.normal(0, sigma_m, (len(steps_m), n_blocks, len(steps_m)))
    )
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


MAX_REPEATS = 1000
LARGEST = 1e9
"""Largest length, angle or ratio of a set-up, in the units of the file."""


@dataclass(frozen=True, eq=False)
class LaserSimulation:
    """Content of a file: machine, measurement, and the generator after drawing the machine."""

    machine: StepMachine
    measurement: Measurement
    rng: np.random.Generator


def simulation_from_dict(data: object, where: str) -> LaserSimulation:
    """Return the simulation in a parsed YAML file.

    Parameters
    ----------
    data : object
        ``seed``; ``machine``: ``case_study``, or a mapping of ``steps_mm`` and ``blocks`` and
        ``sigma_um`` (drawn errors), or of lists ``ex_x, ey_x, ...`` in um, with ``turns_urad``
        {axis: [[rx, ry, rz], ...]} and ``stacked``; ``setups``: diagonal -> {``laser_mrad``,
        ``mirror_mrad``, ``to_machine``, ``abbe_mm``, ``scale_ppm``}; ``noise``: {``distance_nm``,
        ``reading_nm``, ``linear_nm``, ``repeats``}.
    where : str
        File name, for messages.

    Raises
    ------
    InputError
        For an unknown or missing key, or a wrong type.
    """
    top = checked_fields(
        data,
        where,
        {},
        {
            "seed": (int, 0),
            "machine": (object, "case_study"),
            "setups": (dict, {}),
            "noise": (dict, {}),
        },
    )
    if top["seed"] < 0:
        raise InputError(
            f"{where}: seed", f"{top['seed']} is negative", "give 0 or more"
        )
    rng = np.random.default_rng(top["seed"])
    machine = _machine(top["machine"], f"{where}: machine", rng)
    setups = checked_fields(
        top["setups"],
        f"{where}: setups",
        {},
        dict.fromkeys(DIAGONALS[machine.dim], (dict, None)),
    )
    lengths = ("distance_nm", "reading_nm", "linear_nm")
    noise = checked_fields(
        top["noise"],
        f"{where}: noise",
        {},
        {"repeats": (int, 1), **dict.fromkeys(lengths, (float, 0.0))},
    )
    repeats = _count(noise["repeats"], f"{where}: noise: repeats", MAX_REPEATS)
    distance_m, reading_m, linear_m = (
        _number(noise[key], f"{where}: noise: {key}", positive=True) * M_PER_NM
        for key in lengths
    )
    return LaserSimulation(
        machine,
        Measurement(
            {
                name: _setup(raw, f"{where}: setups: {name}", machine.dim)
                for name, raw in setups.items()
                if raw is not None
            },
            LaserNoise(distance_m, reading_m, linear_m, repeats),
        ),
        rng,
    )


def _machine(raw: object, where: str, rng: np.random.Generator) -> StepMachine:
    if raw == "case_study":
        return case_study_machine()
    kinds = [name_of(j, c) for j in range(3) for c in range(3)]
    fields = checked_fields(
        raw,
        where,
        {"steps_mm": list},
        {
            "blocks": (int, 6),
            "sigma_um": (float, 0.1),
            "stacked": (bool, False),
            "turns_urad": (dict, {}),
            **dict.fromkeys(kinds, (list, None)),
        },
    )
    steps = tuple(
        np.array(_numbers(fields["steps_mm"], f"{where}: steps_mm", (2, 3))) * M_PER_MM
    )
    if min(steps) <= 0:
        raise InputError(
            f"{where}: steps_mm", "a step is not positive", "give lengths in mm"
        )
    dim = len(steps)
    listed = {kind: fields[kind] for kind in kinds if fields[kind] is not None}
    if listed and {"blocks", "sigma_um"} & cast(dict, raw).keys():
        raise InputError(where, "errors are both listed and drawn", "give one of them")
    if listed:
        errors = _errors(listed, where, dim)
    else:
        blocks = _count(fields["blocks"], f"{where}: blocks", MAX_BLOCKS)
        sigma = (
            _number(fields["sigma_um"], f"{where}: sigma_um", positive=True) * M_PER_UM
        )
        errors = random_machine(steps, blocks, rng, sigma_m=sigma).errors_m
    turns = _turns(fields["turns_urad"], f"{where}: turns_urad", errors.shape)
    return StepMachine(steps, errors, turns, fields["stacked"])


def _errors(listed: Mapping[str, list], where: str, dim: int) -> np.ndarray:
    kinds = {name_of(j, c): (j, c) for j in range(dim) for c in range(dim)}
    lists = {}
    for name, values in listed.items():
        if name not in kinds:
            raise InputError(
                f"{where}: {name}", f"the machine has {dim} steps only", "leave it out"
            )
        lists[name] = _numbers(values, f"{where}: {name}", range(1, MAX_BLOCKS + 1))
    counts = {len(values) for values in lists.values()}
    if len(counts) > 1:
        raise InputError(
            where,
            f"lists of errors of different lengths {sorted(counts)}",
            "give one value per block",
        )
    errors = np.zeros((dim, counts.pop(), dim))
    for name, values in lists.items():
        j, c = kinds[name]
        errors[j, :, c] = np.array(values) * M_PER_UM
    return errors


def _turns(raw: object, where: str, shape: tuple[int, int, int]) -> np.ndarray | None:
    axes = "xyz"[: shape[0]]
    fields = checked_fields(raw, where, {}, dict.fromkeys(axes, (list, None)))
    if not raw:
        return None
    turns = np.zeros((shape[0], shape[1], 3))
    for axis, rows in fields.items():
        if rows is None:
            continue
        if len(rows) != shape[1]:
            raise InputError(
                f"{where}: {axis}",
                f"not {shape[1]} rotation vectors",
                "give [rx, ry, rz] for every block",
            )
        turns[axes.index(axis)] = [
            _numbers(row, f"{where}: {axis}", (3,)) for row in rows
        ]
    return turns * RAD_PER_URAD


def _setup(raw: object, where: str, dim: int) -> SetUp:
    straight = (list, [0.0] * (dim - 1))
    fields = checked_fields(
        raw,
        where,
        {},
        {
            "laser_mrad": straight,
            "mirror_mrad": straight,
            "to_machine": (bool, True),
            "abbe_mm": (list, [0, 0, 0]),
            "scale_ppm": (float, 0.0),
        },
    )
    laser_rad, mirror_rad = (
        tuple(
            np.array(_numbers(fields[key], f"{where}: {key}", (dim - 1,)))
            * RAD_PER_MRAD
        )
        for key in ("laser_mrad", "mirror_mrad")
    )
    x, y, z = (
        np.array(_numbers(fields["abbe_mm"], f"{where}: abbe_mm", (3,))) * M_PER_MM
    )
    scale = _number(fields["scale_ppm"], f"{where}: scale_ppm") * ONE_PER_PPM
    return SetUp(laser_rad, mirror_rad, fields["to_machine"], (x, y, z), scale)


def _number(value: object, where: str, *, positive: bool = False) -> float:
    if (
        not isinstance(value, int | float)
        or isinstance(value, bool)
        or not abs(value) <= LARGEST
        or (positive and value < 0)
    ):
        raise InputError(
            where,
            f"{value!r} is not a number" + " from 0" * positive,
            f"give one within +-{LARGEST:g}",
        )
    return float(value)


def _numbers(value: list, where: str, lengths: tuple[int, ...] | range) -> list[float]:
    if len(value) not in lengths:
        length_text = (
            " or ".join(map(str, lengths))
            if len(lengths) < 4
            else f"1 to {lengths[-1]}"
        )
        raise InputError(
            where, f"{value!r} is not a list of {length_text} numbers", "give one"
        )
    return [_number(item, where) for item in value]


def _count(value: int, where: str, most: int) -> int:
    if not 1 <= value <= most:
        raise InputError(
            where, f"{value!r} is not a whole number from 1 to {most}", "give one"
        )
    return value
