# SPDX-License-Identifier: Apache-2.0
"""From a recorded zig-zag to blocks: laser distances and axis positions to readings.

The axes rest between their moves. Each rest gives a position and a mean laser distance; two rests
that differ by one step of one axis make a reading. A chain of single-axis moves that run X, Y(, Z),
X, Y(, Z), ... with constant directions is one run along a diagonal; a chain of moves of one axis
alone, with the laser along that axis, is a direct measurement of its linear error. Any other move
(the return to the start, a move of two axes) separates runs. Blocks are numbered by the position of
a move on its axis.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from selfcal_ros.applications.laser.data import (
    AXES,
    DIAGONALS,
    MAX_BLOCKS,
    StepDiagonal,
    is_near,
)
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.units import MM_PER_M, NS_PER_S

OUTLIER = 10.0
"""Laser samples of a rest farther than this from its median are ignored, in median distances: for
Gaussian noise 6.7 standard deviations."""


@dataclass(frozen=True)
class CutRule:
    """Rules for cutting a recording.

    Attributes
    ----------
    steps_m : tuple of float (D,)
        Nominal steps.
    rest_tolerance_m : float
        Largest motion at rest, peak to valley.
    min_rest_s : float
        Shortest rest that counts.
    settle_s : float
        Beginning and end of a rest whose laser distances are ignored: within the tolerance
        the axis may still creep, or already move.
    step_tolerance : float
        Largest deviation of a move from its nominal step, relative to the step.
    laser_sign : int
        -1 if the distance decreases while the machine moves along the diagonal.
    """

    steps_m: tuple[float, ...]
    rest_tolerance_m: float = 2e-6
    min_rest_s: float = 0.5
    settle_s: float = 0.1
    step_tolerance: float = 0.02
    laser_sign: int = 1


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording: stamps in ns, ascending; values in m.

    Attributes
    ----------
    laser_ns, laser_m : arrays (L,)
        Laser distance.
    position_ns : int array (P,)
        Stamps of the positions.
    position_m : float array (P, D)
        Indicated position of every axis.
    """

    laser_ns: np.ndarray
    laser_m: np.ndarray
    position_ns: np.ndarray
    position_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Rest:
    """Axes at rest: mean position (D,) and mean laser distance, m; number of ignored samples."""

    position_m: np.ndarray
    laser_m: float
    start_ns: int
    outliers: int = 0


@dataclass(frozen=True, eq=False)
class Move:
    """A move of one axis by one step: direction, position on the axis, laser reading."""

    axis: int
    sense: int
    low_m: float
    reading_m: float


@dataclass(frozen=True, eq=False)
class Cut:
    """Content of a recording.

    Attributes
    ----------
    data : StepDiagonal
        Readings of all measured diagonals; linear errors if all axes were measured alone.
    runs : dict
        Name of a diagonal or axis -> number of complete runs.
    notes : tuple of str
        What was ignored, and why.
    """

    data: StepDiagonal
    runs: dict[str, int]
    notes: tuple[str, ...] = field(default=())


def cut_zigzag(series: Recording, rule: CutRule) -> Cut:
    """Cut a recording into blocks.

    Raises
    ------
    NoDataError
        If it contains no complete run along a diagonal.
    InputError
        If a value is not finite, runs have different numbers of blocks, or a reading is impossible.
    """
    _check(series)
    rests = find_rests(series, rule)
    moves = _moves(rests, rule)
    chains = _chains(moves)
    notes = []
    outliers = sum(rest.outliers for rest in rests)
    if outliers:
        notes.append(f"{outliers} outlying laser sample(s) within a rest are left out")
    if None in moves:
        notes.append(f"{moves.count(None)} move(s) that are not one step of one axis")
    dim = len(rule.steps_m)
    named: dict[str, list[list[Move]]] = {}
    for chain in chains:
        name = _name_of_run(chain, dim)
        if name is None:
            notes.append(
                f"{len(chain)} move(s) that are not a run along a diagonal or an axis"
            )
        else:
            named.setdefault(name, []).append(chain)
    _same_length(named, dim)
    origin = _origin(named)
    runs = {
        name: [_readings(chain, name, origin, rule) for chain in chains_of_run]
        for name, chains_of_run in named.items()
    }
    diagonals = tuple(name for name in DIAGONALS[dim] if name in runs)
    if not diagonals:
        raise NoDataError(
            "recording",
            "no run along a diagonal",
            "check topics, joints, steps and the tolerances of rest and step",
        )
    samples = _stack([np.array(runs[name]) for name in diagonals])
    axes = [runs.get(AXES[j], []) for j in range(dim)]
    linear = None
    if any(axes) and not all(axes):
        notes.append("linear errors of some axes only: not used")
    if all(axes):
        steps = np.array(rule.steps_m)[:, None]
        linear = _stack([np.array(axis) for axis in axes]) - steps
    return Cut(
        StepDiagonal(rule.steps_m, diagonals, samples, linear),
        {name: len(runs[name]) for name in sorted(runs)},
        tuple(notes),
    )


def _check(series: Recording) -> None:
    for name, values in (("laser", series.laser_m), ("positions", series.position_m)):
        if len(values) == 0:
            raise NoDataError(name, "no samples", "check the topic")
        bad = ~np.isfinite(values).reshape(len(values), -1).all(axis=1)
        if bad.any():
            raise InputError(
                name,
                f"sample {int(np.argmax(bad))} is not finite",
                "leave lost samples out",
            )


def find_rests(series: Recording, rule: CutRule) -> list[Rest]:
    """Return the rests of a recording in their order, each with its mean laser distance.

    A rest is a longest interval of samples within the tolerance. Rests
    without a laser sample after settling are ignored.
    """
    stamps, positions = series.position_ns, series.position_m
    rests = []
    start = 0
    end = 1
    while start < len(stamps):
        end = _end_of_rest(positions, (start, end), rule.rest_tolerance_m)
        first = stamps[start]
        last = stamps[end - 1]
        if last - first >= rule.min_rest_s * NS_PER_S:
            laser = _mean_laser(series, (first, last), rule)
            if laser is not None:
                rests.append(
                    Rest(
                        positions[start:end].mean(axis=0),
                        laser[0],
                        int(first),
                        laser[1],
                    )
                )
            start = end
            end = end + 1
        elif end == len(stamps):
            break
        else:
            # No rest contains both the sample at `end` and the last one too far from it.
            far = (
                np.abs(positions[start:end] - positions[end]).max(axis=1)
                > rule.rest_tolerance_m
            )
            start += int(np.flatnonzero(far)[-1]) + 1
            end += 1
    return rests


def _end_of_rest(
    positions: np.ndarray, interval: tuple[int, int], tolerance_m: float
) -> int:
    """Return the end of the interval from interval[0] within the tolerance."""
    start, end = interval
    low, high = positions[start:end].min(axis=0), positions[start:end].max(axis=0)
    while end < len(positions):
        low, high = np.minimum(low, positions[end]), np.maximum(high, positions[end])
        if np.any(high - low > tolerance_m):
            break
        end += 1
    return end


def _mean_laser(
    series: Recording, between_ns: tuple[int, int], rule: CutRule
) -> tuple[float, int] | None:
    """Return the mean distance of a rest without its ends, and the number of ignored samples.

    A single outlier (an interrupted beam, a lost digit) would move the
    mean by far more than the noise of the laser. None without samples.
    """
    settle_ns = round(rule.settle_s * NS_PER_S)
    inside = slice(
        np.searchsorted(series.laser_ns, between_ns[0] + settle_ns),
        np.searchsorted(series.laser_ns, between_ns[1] - settle_ns, side="right"),
    )
    distances = series.laser_m[inside]
    if not len(distances):
        return None
    away = np.abs(distances - np.median(distances))
    # Half of the samples are within the median of `away`. If they are all equal, the laser's
    # resolution hides its noise, and only the motion of the axes is known.
    usual = float(np.median(away)) or rule.rest_tolerance_m / OUTLIER
    regular = away <= OUTLIER * usual
    return rule.laser_sign * float(distances[regular].mean()), int((~regular).sum())


def _moves(rests: Sequence[Rest], rule: CutRule) -> list[Move | None]:
    """Return the move between successive rests; None if it is not one step of one axis."""
    steps = np.array(rule.steps_m)
    out: list[Move | None] = []
    for before, after in pairwise(rests):
        change = after.position_m - before.position_m
        axes_moved = np.abs(change) > rule.step_tolerance * steps
        if not axes_moved.any():
            # A rest interrupted by a twitch of an axis: joining its parts would hide the
            # twitch. The run ends here.
            out.append(None)
            continue
        axis = int(np.argmax(axes_moved))
        fits = abs(abs(change[axis]) - steps[axis]) <= rule.step_tolerance * steps[axis]
        out.append(
            Move(
                axis,
                int(np.sign(change[axis])),
                min(before.position_m[axis], after.position_m[axis]),
                after.laser_m - before.laser_m,
            )
            if axes_moved.sum() == 1 and fits
            else None
        )
    return out


def _chains(moves: Sequence[Move | None]) -> list[list[Move]]:
    """Return the longest chains of moves that follow one pattern.

    A chain continues while each axis keeps its direction and the order of the axes repeats.
    """
    chains: list[list[Move]] = [[]]
    for move in moves:
        chain = chains[-1]
        if move is None:
            chains.append([])
        elif not chain or _continues(chain, move):
            chain.append(move)
        else:
            chains.append([move])
    return [chain for chain in chains if chain]


def _continues(chain: list[Move], move: Move) -> bool:
    same_axis = [earlier for earlier in chain if earlier.axis == move.axis]
    if same_axis and same_axis[-1].sense != move.sense:
        return False
    period = next(
        (index for index in range(1, len(chain)) if chain[index].axis == chain[0].axis),
        None,
    )
    if period is None:
        # The first cycle is not closed: X may follow X (a run of one axis) or close the cycle.
        return not same_axis or move.axis == chain[0].axis
    return chain[len(chain) - period].axis == move.axis


def _name_of_run(chain: list[Move], dim: int) -> str | None:
    """Return the diagonal or axis of a chain of moves, or None."""
    if len({move.axis for move in chain}) == 1:
        # A single move is not a run: it may be half a block.
        return AXES[chain[0].axis] if len(chain) > 1 and chain[0].sense > 0 else None
    order = [move.axis for move in chain]
    if len(chain) % dim or order != list(range(dim)) * (len(chain) // dim):
        return None
    name = "".join("p" if move.sense > 0 else "n" for move in chain[:dim])
    return name if name in DIAGONALS[dim] else None


def _blocks_of(chain: list[Move], name: str, dim: int) -> int:
    return len(chain) if len(name) == 1 else len(chain) // dim


def _origin(named: dict[str, list[list[Move]]]) -> dict[int, float]:
    """Return the lowest position of a move on every axis, m."""
    origin: dict[int, float] = {}
    for move in (
        move
        for chains_of_run in named.values()
        for chain in chains_of_run
        for move in chain
    ):
        origin[move.axis] = min(origin.get(move.axis, np.inf), move.low_m)
    return origin


def _readings(
    chain: list[Move], name: str, origin: dict[int, float], rule: CutRule
) -> np.ndarray:
    """Return the readings of a run, (D, n), or (n,) for a run of one axis; by position."""
    dim = len(rule.steps_m)
    steps = np.array(rule.steps_m)
    single_axis = len(name) == 1
    n = _blocks_of(chain, name, dim)
    if n > MAX_BLOCKS:
        raise InputError(
            "recording", f"{n} blocks", f"at most {MAX_BLOCKS} are handled"
        )
    out = np.full((dim, n), np.nan)
    for move in chain:
        block = round((move.low_m - origin[move.axis]) / steps[move.axis])
        where = f"run {name}, {AXES[move.axis]} move, block {block + 1}"
        if not 0 <= block < n:
            raise InputError(
                where,
                f"the run has {n} blocks only and starts elsewhere on the axis",
                "run all diagonals and axes over the same range",
            )
        nominal = (
            steps[move.axis]
            if single_axis
            else (steps**2 / np.linalg.norm(steps))[move.axis]
        )
        _check_distance(move.reading_m, nominal, where)
        out[move.axis, block] = move.reading_m
    return out[chain[0].axis] if single_axis else out


def _check_distance(value_m: float, nominal_m: float, where: str) -> None:
    """Refuse a distance that no move of this step can have; the remedy is an option of the bag."""
    ratio = value_m / nominal_m
    if is_near(ratio):
        return
    values = f"{value_m * MM_PER_M:.6g} where {nominal_m * MM_PER_M:.6g} mm is nominal"
    if is_near(-ratio):
        raise InputError(
            where,
            f"{values}: the sign is wrong",
            "give --laser-sign -1 if the distance decreases along the diagonals, else leave it out",
        )
    raise InputError(
        where,
        f"{values}, {ratio:.4g} times as much",
        "check --laser-unit and --step-x, --step-y",
    )


def _same_length(named: dict[str, list[list[Move]]], dim: int) -> None:
    lengths = {
        name: {_blocks_of(chain, name, dim) for chain in chains}
        for name, chains in named.items()
    }
    if len({length for of_run in lengths.values() for length in of_run}) > 1:
        counts = ", ".join(
            f"{name} {sorted(of_run)}" for name, of_run in sorted(lengths.items())
        )
        raise InputError(
            "recording",
            f"runs of different numbers of blocks: {counts}",
            "record complete runs over the same range only",
        )


def _stack(arrays: list[np.ndarray]) -> np.ndarray:
    """Return arrays (repeats, ...) side by side, (most repeats, number, ...), NaN where fewer."""
    most = max(map(len, arrays))
    out = np.full((most, len(arrays), *arrays[0].shape[1:]), np.nan)
    for index, array in enumerate(arrays):
        out[: len(array), index] = array
    return out
