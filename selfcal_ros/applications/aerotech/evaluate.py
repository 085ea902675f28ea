# SPDX-License-Identifier: Apache-2.0
"""Evaluate calibration tables as the controller does (Aerotech text; method eq. 10.1).

Positions and corrections are in primary units and follow the sign of the encoder. Each table
adds its own correction. A table's reference positions are n * distance - offset (NEGPOS: with
opposite sign), shifted by changes since the table was made: home offset, home
direction, absolute feedback offset.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from selfcal_ros.applications.aerotech.model import (
    Table,
    Table1D,
    Table2D,
    Unit,
    UnitWord,
)
from selfcal_ros.applications.aerotech.rules import EDGE
from selfcal_ros.compensation.cells import BLOCK
from selfcal_ros.errors import InputError


@dataclass(frozen=True)
class AxisSetup:
    """Settings of the controller for an axis.

    Attributes
    ----------
    counts_per_unit : float or None
        Encoder counts per primary unit.
    counts_per_secondary : float or None
        Encoder counts per secondary unit.
    home_direction : str or None
        Present "CW" or "CCW"; None: unchanged since the table was made.
    home_offset : float or None
        Present HomeOffset, primary units: home = marker + home offset. None: unchanged.
    absolute_feedback_offset : float or None
        Present PrimaryAbsoluteFeedbackOffset, counts, added to the position. None: unchanged.
    """

    counts_per_unit: float | None = None
    counts_per_secondary: float | None = None
    home_direction: str | None = None
    home_offset: float | None = None
    absolute_feedback_offset: float | None = None


@dataclass(frozen=True)
class MachineSetup:
    """Axes by their one-based index, and the temperature of the scales in degC if known."""

    axes: Mapping[int, AxisSetup] = field(default_factory=dict)
    temperature_c: float | None = None

    def per_count(self, axis: int, where: str) -> float:
        """Return primary units per count of an axis; InputError if unknown."""
        counts = self.of(axis).counts_per_unit
        if counts is None:
            raise InputError(
                f"axis {axis}",
                f"{where} is in counts, whose size is not known",
                f"give the counts per primary unit (--counts-per-unit {axis}=...)",
            )
        return 1.0 / counts

    def unit(self, axis: int, unit: Unit, where: str) -> float:
        """Return primary units per `unit` of an axis; InputError if unknown."""
        if unit.word is UnitWord.PRIMARY:
            return 1.0 / unit.divisor
        per_count = self.per_count(axis, where)
        if unit.word is UnitWord.COUNTS:
            return per_count / unit.divisor
        secondary = self.of(axis).counts_per_secondary
        if secondary is None:
            raise InputError(
                f"axis {axis}",
                f"{where} is in secondary units, whose size is not known",
                f"give the counts per secondary unit (--counts-per-secondary {axis}=...)",
            )
        return secondary * per_count / unit.divisor

    def of(self, axis: int) -> AxisSetup:
        """Return the setup of an axis."""
        return self.axes.get(axis, AxisSetup())


@dataclass(frozen=True)
class AxisSamples:
    """Reference positions along one input axis, ascending, primary units.

    Attributes
    ----------
    axis : int
        The input axis.
    first, step : float
        Position of the lowest entry and the distance between entries (> 0).
    count : int
        Number of entries.
    rollover : float or None
        Distance after which positions repeat.
    """

    axis: int
    first: float
    step: float
    count: int
    rollover: float | None = None

    def locate(self, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the entry below each position and the fraction to the next, clamped."""
        with np.errstate(invalid="ignore"):
            # A NaN position becomes some integer; its fraction stays NaN.
            if self.rollover is not None:
                position = self.first + np.mod(position - self.first, self.rollover)
            way = np.clip((position - self.first) / self.step, 0, self.count - 1)
            entry = np.clip(way.astype(np.int64), 0, max(self.count - 2, 0))
        return entry, way - entry

    def covers_zero(self) -> bool:
        """Return whether position 0 is between the first and the last entry."""
        zero = (
            0.0
            if self.rollover is None
            else self.first + np.mod(-self.first, self.rollover)
        )
        edge = EDGE * self.step
        return (
            self.first - edge
            <= zero
            <= self.first + (self.count - 1) * self.step + edge
        )


def _track(
    axis: int, start: float, distance: float, count: int, rollover: float | None
) -> tuple[AxisSamples, bool]:
    """Return the track and whether the entries have to be reversed."""
    if distance < 0:
        return AxisSamples(
            axis, start + (count - 1) * distance, -distance, count, rollover
        ), True
    return AxisSamples(axis, start, distance, count, rollover), False


@dataclass(frozen=True, eq=False)
class BoundTable1D:
    """A 1D table in primary units, with its zero bias applied."""

    axis: int
    track: AxisSamples
    values: np.ndarray
    expansion: float = 0.0

    def add_to(
        self, out: dict[int, np.ndarray], positions: Mapping[int, np.ndarray]
    ) -> None:
        """Add this table's correction at `positions` to `out`."""
        position = positions[self.track.axis]
        out[self.axis] += _linear(self.values, *self.track.locate(position))
        if self.expansion:
            out[self.axis] -= self.expansion * position


def _linear(values: np.ndarray, entry: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    after = np.minimum(entry + 1, len(values) - 1)
    return (1 - fraction) * values[entry] + fraction * values[after]


@dataclass(frozen=True, eq=False)
class BoundTable2D:
    """A 2D or galvo table in primary units, with its zero bias applied: (outputs, rows, cols)."""

    outputs: tuple[int, ...]
    rows: AxisSamples
    columns: AxisSamples
    values: np.ndarray

    def at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Return the corrections of all outputs, (outputs, ...)."""
        (i, u), (j, v) = self.rows.locate(row), self.columns.locate(column)
        i1 = np.minimum(i + 1, self.rows.count - 1)
        j1 = np.minimum(j + 1, self.columns.count - 1)
        c = self.values
        return (1 - u) * ((1 - v) * c[:, i, j] + v * c[:, i, j1]) + u * (
            (1 - v) * c[:, i1, j] + v * c[:, i1, j1]
        )

    def add_to(
        self, out: dict[int, np.ndarray], positions: Mapping[int, np.ndarray]
    ) -> None:
        """Add this table's corrections at `positions` to `out`."""
        values = self.at(positions[self.rows.axis], positions[self.columns.axis])
        for axis, value in zip(self.outputs, values, strict=True):
            out[axis] += value


def bound_1d(table: Table1D, setup: MachineSetup) -> BoundTable1D:
    """Return a 1D table in primary units; its correction at position 0 is always 0."""
    place = f"the table of line {table.line}" if table.line else "the table"
    reference = table.reference
    unit = setup.unit(reference, table.position_unit, f"POSUNIT of {place}")
    sign = -1.0 if table.negpos else 1.0
    start = -(table.offset or 0.0) * unit * sign + _home_shift(table, setup)
    start += _feedback_shift((reference, table.absolute_feedback_offset), setup, place)
    rollover = (
        None
        if table.rollover is None
        else table.rollover * setup.per_count(reference, f"ROLLOVER of {place}")
    )
    track, reverse = _track(
        reference, start, table.sample_dist * unit * sign, len(table.values), rollover
    )
    scale = setup.unit(table.axis, table.correction_unit, f"CORUNIT of {place}")
    values = table.values * (-scale if table.negcor else scale)
    values = values[::-1] if reverse else values
    bias = _linear(values, *track.locate(np.zeros(())))
    return BoundTable1D(table.axis, track, values - bias, _expansion(table, setup))


def _home_shift(table: Table1D, setup: MachineSetup) -> float:
    """Return the shift of a fixed point of the stage in coordinates relative to home."""
    if table.home_direction is None:
        return 0.0
    now = setup.of(table.reference)
    then_offset = table.home_offset or 0.0
    now_offset = then_offset if now.home_offset is None else now.home_offset
    travel = {"CW": table.full_travel or 0.0, "CCW": 0.0}
    direction = now.home_direction or table.home_direction
    home_moved = (
        now_offset - then_offset + travel[direction] - travel[table.home_direction]
    )
    return -home_moved


def _feedback_shift(
    axis_then: tuple[int, float | None], setup: MachineSetup, place: str
) -> float:
    axis, then = axis_then
    now = setup.of(axis).absolute_feedback_offset
    if then is None or now is None or now == then:
        return 0.0
    return (now - then) * setup.per_count(axis, f"ABSOLUTEFEEDBACKOFFSET of {place}")


def _expansion(table: Table1D, setup: MachineSetup) -> float:
    """Return alpha * (T - MATERIALTEMP), by which the expanded scale indicates too little."""
    if (
        table.expand_coeff is None
        or table.material_temp is None
        or setup.temperature_c is None
    ):
        return 0.0
    return table.expand_coeff * (setup.temperature_c - table.material_temp)


def bound_2d(table: Table2D, setup: MachineSetup) -> BoundTable2D:
    """Return a 2D or galvo table in primary units, biased if position (0, 0) is inside."""
    place = f"the table of line {table.line}" if table.line else "the table"
    tracks = []
    values = np.moveaxis(table.values, 2, 0)
    for dim, (end, axis) in enumerate(
        (("row", table.row_axis), ("col", table.column_axis))
    ):
        unit = setup.unit(axis, table.position_unit, f"POSUNIT of {place}")
        distance = getattr(table, f"sample_{end}") * unit
        count = table.values.shape[dim]
        if table.galvo:
            start = -(count - 1) / 2 * distance
            rollover = None
        else:
            then = getattr(table, f"absolute_feedback_offset_{end}")
            start = -(getattr(table, f"offset_{end}") or 0.0) * unit + _feedback_shift(
                (axis, then), setup, place
            )
            rollover = getattr(table, f"rollover_{end}")
            if rollover is not None:
                rollover *= setup.per_count(axis, f"ROLLOVER{end.upper()} of {place}")
        track, reverse = _track(axis, start, distance, count, rollover)
        tracks.append(track)
        values = np.flip(values, 1 + dim) if reverse else values
    scale = [
        setup.unit(axis, table.correction_unit, f"CORUNIT of {place}")
        for axis in table.outputs
    ]
    sign = -1.0 if table.negcor else 1.0
    values = values * (sign * np.array(scale))[:, None, None]
    ready = BoundTable2D(table.outputs, tracks[0], tracks[1], values)
    if tracks[0].covers_zero() and tracks[1].covers_zero():
        bias = ready.at(np.zeros(()), np.zeros(()))
        ready = BoundTable2D(
            table.outputs, tracks[0], tracks[1], values - bias[:, None, None]
        )
    return ready


class CalEvaluator:
    """The corrections that a controller with these tables loaded adds to a command.

    Parameters
    ----------
    tables : sequence of Table
        Loaded tables, of one or several files.
    setup : MachineSetup, optional
        Settings of the controller for its axes.

    Raises
    ------
    InputError
        If a table uses counts or secondary units of unknown size.
    """

    def __init__(
        self, tables: Sequence[Table], setup: MachineSetup | None = None
    ) -> None:
        setup = setup or MachineSetup()
        self._bound = [
            bound_1d(t, setup) if isinstance(t, Table1D) else bound_2d(t, setup)
            for t in tables
        ]
        self.inputs = sorted({axis for t in tables for axis in t.inputs})
        self.outputs = sorted({axis for t in tables for axis in t.outputs})

    def corrections(self, positions: Mapping[int, ArrayLike]) -> dict[int, np.ndarray]:
        """Return axis -> correction, primary units, at broadcastable positions by axis.

        Raises
        ------
        InputError
            If the position of an input axis is missing.
        """
        for axis in self.inputs:
            if axis not in positions:
                raise InputError(
                    f"axis {axis}",
                    "its position is needed by a table",
                    f"give it (--position {axis}=...)",
                )
        arrays = np.broadcast_arrays(
            *(np.asarray(positions[axis], dtype=float) for axis in self.inputs)
        )
        shape = arrays[0].shape
        flat = [array.ravel() for array in arrays]
        total = {axis: np.zeros(flat[0].size) for axis in self.outputs}
        for start in range(0, flat[0].size, BLOCK):
            block = slice(start, start + BLOCK)
            block_positions = {
                axis: array[block]
                for axis, array in zip(self.inputs, flat, strict=True)
            }
            out = {axis: array[block] for axis, array in total.items()}
            for bound in self._bound:
                bound.add_to(out, block_positions)
        return {axis: array.reshape(shape) for axis, array in total.items()}
