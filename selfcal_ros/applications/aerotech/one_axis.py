# SPDX-License-Identifier: Apache-2.0
"""What 1D tables of x and y leave of the part of a map that depends on one position alone.

A 1D table corrects an axis from the position of one axis. Of a map it can correct the mean over
the other axis. Tables along the middle line are usual as well. Either is the part that a table is
judged against; what varies with both positions no 1D table corrects.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal

import numpy as np
from scipy.interpolate import CubicSpline

from selfcal_ros.applications.aerotech.evaluate import (
    BoundTable1D,
    CalEvaluator,
    MachineSetup,
    bound_1d,
)
from selfcal_ros.applications.aerotech.export import map_line
from selfcal_ros.applications.aerotech.model import Table1D
from selfcal_ros.compensation.export import fill_unknown
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.model.error_map import ErrorMap, rms

LEFT_OF_A_MAP = 0.05
"""Part of the error that a table of the same map may leave: far more than the rounding of its
digits, and than the error of a stage changes over the shift by the zero bias."""
ROUNDED_M = 1e-10
"""Largest error that is taken for rounding of a table's digits."""
NONE_OF_IT = 1e-2
"""A table has no slope, or no shape, if that is a smaller part of the other."""
SPLINE_NODES = 4
"""Least number of nodes for a cubic spline."""

Axis = Literal["x", "y"]
Pair = tuple[Axis, Axis]
"""Axis whose position selects an entry, and axis that is corrected."""


def leaves_too_much(
    residual: tuple[float, float],
    before: tuple[float, float],
    u: float,
    *,
    rounding: float = 0.0,
) -> bool:
    """Tell whether more is left of an error than U, or 5 % of it.

    Parameters
    ----------
    residual, before : (float, float)
        What a table leaves of the error, and the error, m or rad: rms and largest.
    u : float
        Standard uncertainty of the error, rms. U is 2 u, and 4 u at one node.
    rounding : float
        What the digits of a table leave.
    """
    return any(
        remaining > max(LEFT_OF_A_MAP * size, limit * u, rounding)
        for remaining, size, limit in zip(residual, before, (2, 4), strict=True)
    )


def known_rms(*u: np.ndarray) -> float:
    """Return the root mean square of the vectors of u where it is known, else 0."""
    squares = np.sum(np.square(u), axis=0)
    finite = squares[np.isfinite(squares)]
    return float(np.sqrt(finite.mean())) if finite.size else 0.0


@dataclass(frozen=True)
class OneAxisPart:
    """A part of a map that 1D tables can correct, and what is left of it.

    Attributes
    ----------
    name : str
        The part: "x from the position of x", "squareness".
    rms, largest : float
        Its size at the nodes, m, without its constant.
    rms_left, largest_left : float
        What the tables leave of it, m.
    u : float
        Standard uncertainty of the map, rms over its nodes, m.
    """

    name: str
    rms: float
    largest: float
    rms_left: float
    largest_left: float
    u: float

    @property
    def unfit(self) -> bool:
        """Whether more is left than U (k = 2, rms; twice U at one node) and 5 % of the part."""
        return leaves_too_much(
            (self.rms_left, self.largest_left),
            (self.rms, self.largest),
            self.u,
            rounding=ROUNDED_M,
        )


@dataclass(frozen=True)
class OneAxisFit:
    """What 1D tables leave of a map.

    Attributes
    ----------
    parts : tuple of OneAxisPart
        What they can correct.
    beyond : float
        What no 1D table of the same axes corrects, rms of the vectors, m.
    squareness_left : float
        Squareness that tables of straightness leave, rad; 0 if a table corrects it.
    """

    parts: tuple[OneAxisPart, ...]
    beyond: float
    squareness_left: float = 0.0


def one_axis_fit(
    error_map: ErrorMap,
    tables: Sequence[Table1D],
    frame: MachineFrame,
    setup: MachineSetup,
) -> OneAxisFit:
    """Return what 1D tables of x and y leave of a map.

    Parameters
    ----------
    error_map : ErrorMap
        The error to correct. Unknown nodes are filled from their neighbours.
    tables : sequence of Table1D
        Tables of x and y that are loaded together.
    frame : MachineFrame
        Wiring of the axes.
    setup : MachineSetup
        Settings of the controller.
    """
    filled_map, _ = fill_unknown(error_map)
    names: dict[int, Axis] = {frame.x_axis: "x", frame.y_axis: "y"}
    loaded: dict[Pair, list[Table1D]] = defaultdict(list)
    for table in tables:
        loaded[names[table.reference], names[table.axis]].append(table)

    along_own: list[_PairOfAxes] = []
    across: list[_PairOfAxes] = []
    for pair, of_pair in loaded.items():
        pair_tables = _PairOfAxes(filled_map, of_pair, pair, frame=frame, setup=setup)
        (along_own if pair[0] == pair[1] else across).append(pair_tables)

    parts = [
        pair_tables.judged(pair_tables.targets, pair_tables.correction)
        for pair_tables in along_own
    ]
    parts += [
        pair_tables.judged(pair_tables.shapes, pair_tables.shape, ", without its slope")
        for pair_tables in across
    ]
    turning = [pair_tables for pair_tables in across if pair_tables.has_slope]
    squareness_left = 0.0
    if turning:
        parts.append(_squareness(filled_map, turning, across))
    elif across:
        squareness_left = _squareness_of(filled_map)
    return OneAxisFit(tuple(parts), _beyond(filled_map, tuple(loaded)), squareness_left)


class _PairOfAxes:
    """The tables that correct one axis from the position of one axis, at the nodes of a map.

    Parameters
    ----------
    whole : ErrorMap
        Without unknown nodes.
    tables : list of Table1D
        The tables.
    pair : Pair
        Their axes.
    frame, setup : MachineFrame, MachineSetup
        The controller.
    """

    def __init__(
        self,
        filled_map: ErrorMap,
        tables: list[Table1D],
        pair: Pair,
        *,
        frame: MachineFrame,
        setup: MachineSetup,
    ) -> None:
        self.pair = pair
        self.u = known_rms(filled_map.u_gx if pair[1] == "x" else filled_map.u_gy)
        bound = [bound_1d(table, setup) for table in tables]
        slopes, shapes = zip(*(_makes(table) for table in bound), strict=True)
        self.has_slope, self.has_shape = any(slopes), any(shapes)

        self.nodes = (
            filled_map.artifact.x_m[:, 0]
            if pair[0] == "x"
            else filled_map.artifact.y_m[0]
        )
        places = [_stage_positions(table, pair[0], frame) for table in bound]
        inside = [p[(p > self.nodes[0]) & (p < self.nodes[-1])] for p in places]
        self.places = np.unique(np.concatenate([self.nodes, *inside]))
        self.at_nodes = np.searchsorted(self.places, self.nodes)

        machine = frame.to_machine(self.places, self.places)["xy".index(pair[0])]
        axes = {"x": frame.x_axis, "y": frame.y_axis}
        sign = {"x": frame.sign_x, "y": frame.sign_y}[pair[1]]
        added = CalEvaluator(tables, setup).corrections({axes[pair[0]]: machine})[
            axes[pair[1]]
        ]
        self.correction = sign * frame.unit_m * added
        self.targets = [
            _mean_line(filled_map, pair),
            map_line(filled_map, *pair).corrections_m,
        ]

    @property
    def shape(self) -> np.ndarray:
        """The correction without its slope over the nodes, m."""
        return (
            self.correction - self.slope(self.correction[self.at_nodes]) * self.places
        )

    @property
    def shapes(self) -> list[np.ndarray]:
        """What it may be at the nodes, m: of tables of squareness alone, nothing."""
        target_shapes = [
            target - self.slope(target) * self.nodes for target in self.targets
        ]
        return (
            target_shapes
            if self.has_shape
            else [*target_shapes, np.zeros(len(self.nodes))]
        )

    def slope(self, values: np.ndarray) -> float:
        """Return the least-squares slope of values at the nodes."""
        return _slope(self.nodes, values)

    def judged(
        self, targets: list[np.ndarray], correction: np.ndarray, without: str = ""
    ) -> OneAxisPart:
        """Return what a correction (places,) leaves of that target (nodes,) which it suits best.

        Between the nodes the error of the stage is known to the difference of the straight line
        and the cubic spline.
        """
        candidates = []
        for target in targets:
            line = np.interp(self.places, self.nodes, target)
            residual_m = correction - line
            residual_m = residual_m - residual_m[self.at_nodes].mean()
            residual_m = np.maximum(
                np.abs(residual_m) - np.abs(self._spline(target) - line), 0.0
            )
            candidates.append((rms(residual_m[self.at_nodes]), float(residual_m.max())))
        rms_left, largest_left = min(candidates)
        centred = targets[0] - targets[0].mean()
        along, corrected = self.pair
        return OneAxisPart(
            name=f"{corrected} from the position of {along}{without}",
            rms=rms(centred),
            largest=float(np.abs(centred).max()),
            rms_left=rms_left,
            largest_left=largest_left,
            u=self.u,
        )

    def _spline(self, target: np.ndarray) -> np.ndarray:
        if len(self.nodes) < SPLINE_NODES:
            return np.interp(self.places, self.nodes, target)
        return CubicSpline(self.nodes, target)(self.places)


def _makes(table: BoundTable1D) -> tuple[bool, bool]:
    """Return whether a table has a slope, and a shape; one without either should have both."""
    position = table.track.step * np.arange(table.track.count)
    slope = _slope(position, table.values) * (position - position.mean())
    shape = table.values - table.values.mean() - slope
    if not np.ptp(table.values):
        return True, True
    return rms(slope) > NONE_OF_IT * rms(shape), rms(shape) > NONE_OF_IT * rms(slope)


def _stage_positions(
    table: BoundTable1D, axis: Axis, frame: MachineFrame
) -> np.ndarray:
    """Return the positions of a table's entries in the stage frame, m."""
    positions = table.track.first + table.track.step * np.arange(table.track.count)
    return frame.from_machine(positions, positions)["xy".index(axis)]


def _squareness(
    filled_map: ErrorMap, turning: list[_PairOfAxes], across: list[_PairOfAxes]
) -> OneAxisPart:
    """Return what tables with slopes leave of the squareness of a map.

    A turn of both axes alike is the choice of the frame: only the sum of the slopes counts. In the
    frame of the map each slope may be that of the map, too.
    """
    added = [
        pair_tables.slope(pair_tables.correction[pair_tables.at_nodes])
        for pair_tables in across
    ]
    map_slope = _squareness_of(filled_map)
    slope_misfits = [
        max(
            abs(slope - pair_tables.slope(target))
            for slope, pair_tables, target in zip(added, across, targets, strict=True)
            if pair_tables.has_slope
        )
        for targets in product(*(pair_tables.targets for pair_tables in across))
    ]
    residual_slope = min(abs(sum(added) - map_slope), *slope_misfits)
    nodes, u = turning[0].nodes, turning[0].u
    far = float(np.abs(nodes).max())
    return OneAxisPart(
        name="squareness",
        rms=abs(map_slope) * rms(nodes),
        largest=abs(map_slope) * far,
        rms_left=residual_slope * rms(nodes),
        largest_left=residual_slope * far,
        u=u,
    )


def _beyond(filled_map: ErrorMap, pairs: Sequence[Pair]) -> float:
    """Return what is left of a map by the best 1D tables of these axes, rms of the vectors, m."""
    residual_m = np.stack([filled_map.gx, filled_map.gy])
    for along, corrected in pairs:
        line = _mean_line(filled_map, (along, corrected))
        residual_m["xy".index(corrected)] -= (
            line[:, None] if along == "x" else line[None, :]
        )
    if any(along != corrected for along, corrected in pairs):  # square, and in any turn
        x, y = filled_map.artifact.x_m, filled_map.artifact.y_m
        residual_m -= np.stack(
            [
                y * _slope(y.ravel(), residual_m[0].ravel()),
                x * _slope(x.ravel(), residual_m[1].ravel()),
            ]
        )
    residual_m -= residual_m.mean(axis=(1, 2), keepdims=True)
    return float(np.sqrt((residual_m**2).sum(axis=0).mean()))


def _mean_line(filled_map: ErrorMap, pair: Pair) -> np.ndarray:
    """Return the error of an axis against the position of one axis, mean over the other, m."""
    field = filled_map.gx if pair[1] == "x" else filled_map.gy
    return field.mean(axis=1 if pair[0] == "x" else 0)


def _squareness_of(filled_map: ErrorMap) -> float:
    """Return the sum of the slopes of y along x and of x along y, rad; a turn cancels in it."""
    artifact = filled_map.artifact
    return _slope(artifact.x_m[:, 0], _mean_line(filled_map, ("x", "y"))) + _slope(
        artifact.y_m[0], _mean_line(filled_map, ("y", "x"))
    )


def _slope(position: np.ndarray, values: np.ndarray) -> float:
    """Return the least-squares slope of values."""
    from_middle = position - position.mean()
    square = from_middle @ from_middle
    return float(from_middle @ values / square) if square else 0.0
