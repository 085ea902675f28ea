# SPDX-License-Identifier: Apache-2.0
"""A simulated step-diagonal measurement as a YAML file; see config/step_diagonal."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError, known_are
from selfcal_ros.laser.data import DIAGONALS, MAX_BLOCKS, Closure, StepDiagonalResult
from selfcal_ros.laser.profiles import ReferenceLine, name_of
from selfcal_ros.laser.report import geometry
from selfcal_ros.laser.simulation import measure
from selfcal_ros.units import M_PER_MM, M_PER_NM, M_PER_UM, ONE_PER_PPM, RAD_PER_MRAD, RAD_PER_URAD

MAX_REPEATS = 1000
LARGEST = 1e9
"""Largest length, angle or ratio of a set-up, in the units of the file."""


@dataclass(frozen=True, eq=False)
class LaserSimulation:
    """Content of a file: machine, measurement, and the generator after drawing the machine."""

    machine: measure.StepMachine
    measurement: measure.Measurement
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
    top = _mapping(data, where, ("seed", "machine", "setups", "noise"))
    seed = top.get("seed", 0)
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise InputError(f"{where}: seed", f"{seed!r} is not a whole number from 0", "give one")
    rng = np.random.default_rng(seed)
    machine = _machine(top.get("machine", "case_study"), f"{where}: machine", rng)
    names = DIAGONALS[machine.dim]
    setups = _mapping(top.get("setups", {}), f"{where}: setups", names)
    noise = _mapping(top.get("noise", {}), f"{where}: noise",
                     ("distance_nm", "reading_nm", "linear_nm", "repeats"))
    repeats = _count(noise.get("repeats", 1), f"{where}: noise: repeats", MAX_REPEATS)
    distance_m, reading_m, linear_m = (
        _number(noise.get(key, 0), f"{where}: noise: {key}", positive=True) * M_PER_NM
        for key in ("distance_nm", "reading_nm", "linear_nm"))
    return LaserSimulation(machine, measure.Measurement(
        {name: _setup(raw, f"{where}: setups: {name}", machine.dim)
         for name, raw in setups.items()},
        measure.LaserNoise(distance_m, reading_m, linear_m, repeats)), rng)


def _machine(raw: object, where: str, rng: np.random.Generator) -> measure.StepMachine:
    if raw == "case_study":
        return measure.case_study_machine()
    kinds = [name_of(j, c) for j in range(3) for c in range(3)]
    raw = _mapping(raw, where, ("steps_mm", "blocks", "sigma_um", "stacked", "turns_urad", *kinds))
    steps = tuple(np.array(_numbers(raw.get("steps_mm"), f"{where}: steps_mm", (2, 3))) * M_PER_MM)
    if min(steps) <= 0:
        raise InputError(f"{where}: steps_mm", "a step is not positive", "give lengths in mm")
    dim = len(steps)
    given = [kind for kind in kinds if kind in raw]
    if given and ("blocks" in raw or "sigma_um" in raw):
        raise InputError(where, "errors are both listed and drawn", "give one of them")
    if given:
        errors = _errors(raw, where, dim)
    else:
        blocks = _count(raw.get("blocks", 6), f"{where}: blocks", MAX_BLOCKS)
        sigma = _number(raw.get("sigma_um", 0.1), f"{where}: sigma_um", positive=True) * M_PER_UM
        errors = measure.random_machine(steps, blocks, rng, sigma_m=sigma).errors_m
    stacked = raw.get("stacked", False)
    if not isinstance(stacked, bool):
        raise InputError(f"{where}: stacked", f"{stacked!r} is neither true nor false", "give one")
    turns = _turns(raw.get("turns_urad", {}), f"{where}: turns_urad", errors.shape)
    return measure.StepMachine(steps, errors, turns, stacked)


def _errors(raw: Mapping, where: str, dim: int) -> np.ndarray:
    kinds = {name_of(j, c): (j, c) for j in range(dim) for c in range(dim)}
    lists = {}
    for name in (key for key in raw if key[:1] == "e"):
        if name not in kinds:
            raise InputError(f"{where}: {name}", f"the machine has {dim} steps only",
                             "leave it out")
        lists[name] = _numbers(raw[name], f"{where}: {name}", range(1, MAX_BLOCKS + 1))
    counts = {len(values) for values in lists.values()}
    if len(counts) > 1:
        raise InputError(where, f"lists of errors of different lengths {sorted(counts)}",
                         "give one value a block")
    errors = np.zeros((dim, counts.pop(), dim))
    for name, values in lists.items():
        j, c = kinds[name]
        errors[j, :, c] = np.array(values) * M_PER_UM
    return errors


def _turns(raw: object, where: str, shape: tuple[int, int, int]) -> np.ndarray | None:
    axes = "xyz"[:shape[0]]
    raw = _mapping(raw, where, tuple(axes))
    if not raw:
        return None
    turns = np.zeros((shape[0], shape[1], 3))
    for axis, rows in raw.items():
        if not isinstance(rows, list) or len(rows) != shape[1]:
            raise InputError(f"{where}: {axis}", f"not {shape[1]} rotation vectors",
                             "give [rx, ry, rz] for every block")
        turns[axes.index(axis)] = [_numbers(row, f"{where}: {axis}", (3,)) for row in rows]
    return turns * RAD_PER_URAD


def _setup(raw: object, where: str, dim: int) -> measure.SetUp:
    raw = _mapping(raw, where, ("laser_mrad", "mirror_mrad", "to_machine", "abbe_mm", "scale_ppm"))
    laser_rad, mirror_rad = (
        tuple(np.array(_numbers(raw.get(key, [0.0] * (dim - 1)), f"{where}: {key}", (dim - 1,)))
              * RAD_PER_MRAD) for key in ("laser_mrad", "mirror_mrad"))
    to_machine = raw.get("to_machine", True)
    if not isinstance(to_machine, bool):
        raise InputError(f"{where}: to_machine", f"{to_machine!r} is neither true nor false",
                         "give one")
    abbe_mm = _numbers(raw.get("abbe_mm", [0, 0, 0]), f"{where}: abbe_mm", (3,))
    x, y, z = np.array(abbe_mm) * M_PER_MM
    scale = _number(raw.get("scale_ppm", 0.0), f"{where}: scale_ppm") * ONE_PER_PPM
    return measure.SetUp(laser_rad, mirror_rad, to_machine, (x, y, z), scale)


def _mapping(data: object, where: str, known: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(data, dict):
        raise InputError(where, "not a mapping of keys to values",
                         "see config/step_diagonal for an example")
    for key in data:
        if key not in known:
            raise InputError(f"{where}: {key}", "unknown key", known_are(str(key), known))
    return data


def _number(value: object, where: str, *, positive: bool = False) -> float:
    if (not isinstance(value, int | float) or isinstance(value, bool)
            or not abs(value) <= LARGEST or (positive and value < 0)):
        raise InputError(where, f"{value!r} is not a number" + " from 0" * positive,
                         f"give one within +-{LARGEST:g}")
    return float(value)


def _numbers(value: object, where: str, lengths: tuple[int, ...] | range) -> list[float]:
    if not isinstance(value, list) or len(value) not in lengths:
        wanted = " or ".join(map(str, lengths)) if len(lengths) < 4 else f"1 to {lengths[-1]}"
        raise InputError(where, f"{value!r} is not a list of {wanted} numbers", "give one")
    return [_number(item, where) for item in value]


def _count(value: object, where: str, most: int) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
        raise InputError(where, f"{value!r} is not a whole number from 1 to {most}", "give one")
    return value


def truth_of(machine: measure.StepMachine) -> dict[str, Any]:
    """Return the result of a perfect identification of a machine, mm, in the datum of results."""
    truth = StepDiagonalResult(machine.steps_m, machine.truth_m(), None, "", "", {}, Closure())
    errors = {name_of(j, c): (truth.errors_m[j, :, c] / M_PER_MM).tolist()
              for j in range(machine.dim) for c in range(machine.dim)}
    found = geometry(truth, ReferenceLine.LEAST_SQUARES)
    return {"unit": "mm", **errors,
            **{key: value for key, value in found.items() if not key.startswith("u_")}}
