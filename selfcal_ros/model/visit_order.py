# SPDX-License-Identifier: Apache-2.0
"""Sequence of the visits of a view's grid marks, and the direction of approach."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense
from selfcal_ros.model.view import DEFAULT_ORDER, View, VisitOrder, parse_order

SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
"""Directions of the stage from the mark in check stops, along x and y, in their order."""


@dataclass(frozen=True, eq=False)
class VisitSequence:
    """The visits of the grid marks of one view in their order.

    A visit is one or more successive exposures of a mark: if one pass ends on the mark on which the
    next begins, that is one visit.

    Attributes
    ----------
    m, n : int array (V,)
        The mark visited, plate frame.
    i, j : int or float array (V,)
        Its site, stage frame, pitches.
    count : int array (V,)
        Exposures of the visit.
    pass_number : int array (V,)
        Pass over the plate in which the visit begins, from 0; each side of check stops is one.
    time : float array (V,)
        Mean index of its exposures, counted from 0 over the whole view.
    aside_m : float array (2, V)
        Distance of the stage from the mark along x and y at check stops; else 0.
    """

    m: np.ndarray
    n: np.ndarray
    i: np.ndarray
    j: np.ndarray
    count: np.ndarray
    pass_number: np.ndarray
    time: np.ndarray
    aside_m: np.ndarray

    def __len__(self) -> int:
        """Return the number of visits."""
        return len(self.m)


def visit_sequence(
    artifact: Artifact,
    view: View,
    *,
    order: str = "",
    consecutive: bool = False,
    rng: np.random.Generator | None = None,
) -> VisitSequence:
    """Return the order in which the grid marks of a view are visited.

    Parameters
    ----------
    artifact, view
        The plate, its pose, and the repeats.
    order : str
        See `selfcal_ros.model.view`; empty = that of the view, or else `DEFAULT_ORDER`.
    consecutive : bool
        One pass in which all repeats of a mark are exposed consecutively. If false, every
        repeat is a pass; the passes of the order follow each other cyclically, and the last
        cycle is incomplete if the repeats are not a multiple of their number.
    rng : numpy.random.Generator, optional
        Required by the order ``random``.

    Returns
    -------
    VisitSequence
        Only marks whose sites are in the field; no visits in views without grid marks.

    Raises
    ------
    InputError
        For an unknown order, or an impossible pose.
    ValueError
        For a random order without `rng`.
    """
    chosen = parse_order(order or view.visit_order or DEFAULT_ORDER)
    if not view.grid:
        m, n, i, j, count, index = np.zeros((6, 0), dtype=int)
        return VisitSequence(
            m=m,
            n=n,
            i=i,
            j=j,
            count=count,
            pass_number=index,
            time=np.zeros(0),
            aside_m=np.zeros((2, 0)),
        )
    marks, sites = view.on_stage(artifact).marks_in_field(artifact)
    n_passes = 1 if consecutive else view.repeats
    # no lines of sites off the lattice
    of_plate = chosen.of_plate or artifact.map_grid is not None
    places = np.stack(artifact.places(*marks)) if of_plate else sites
    lines = np.rint(places) if artifact.marks else places  # of a list: one pitch wide
    passes = _passes(chosen, places, lines, n_passes=n_passes, rng=rng)
    return _visits(
        marks, sites, passes, together=view.repeats if consecutive else 1, view=view
    )


def stage_targets(
    artifact: Artifact, view: View, visits: VisitSequence, sense: Sense
) -> np.ndarray:
    """Return the stage position at which the mark of each visit is on the axis, (2, V), m.

    Without `VisitSequence.aside_m`, if plate and stage were perfect.
    """
    if not len(visits):  # also a view of lines alone, at any turn
        return np.zeros((2, 0))
    places = artifact.places(visits.m, visits.n)
    site = np.stack(view.on_stage(artifact).site_of(*places)) * artifact.grid_pitch_m
    return sense.sign * site


def line_targets(
    artifact: Artifact, view: View, sense: Sense, *, consecutive: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Return line and angle of the stage of each exposure of the angular lines of a view.

    Parameters
    ----------
    artifact, view
        The plate, its pose, and the repeats.
    sense : Sense
        What moves.
    consecutive : bool
        All repeats of a line one after another; if false, one pass per repeat.

    Returns
    -------
    k : int array (E,)
        The line.
    theta : float array (E,)
        Angle of the stage, within one turn, rad.
    """
    count = artifact.angular_count
    line = np.arange(count)
    turn = (line + view.on_stage(artifact).s) % count if count else np.zeros(0)
    nominal = turn * (2 * np.pi / count) if count else turn
    centre = sense.sign * nominal
    k = np.repeat(line, view.repeats) if consecutive else np.tile(line, view.repeats)
    return k, centre[k]


def _passes(
    order: VisitOrder,
    places: np.ndarray,
    lines: np.ndarray,
    *,
    n_passes: int,
    rng: np.random.Generator | None,
) -> np.ndarray:
    """Return the indices of `places` (2, n) in the order of their visits, (passes, n).

    `lines` (2, n): their row and column.
    """
    if order.name == "random":
        if rng is None:
            raise ValueError("a random visiting order needs a source of chance")
        return np.stack([rng.permutation(places.shape[1]) for _ in range(n_passes)])
    (x, y), (row, column) = places, lines
    # line by line along x: each line runs along y
    along_x, along_y = np.lexsort((y, row)), np.lexsort((x, column))
    cycle = {
        "raster": (along_x,),
        "serpentine": (np.lexsort((np.where((row - row.min()) % 2, -y, y), row)),),
        "there_and_back": (along_x, along_x[::-1]),
        "x_then_y": (along_x, along_y),
        "x_back_y_back": (along_x, along_x[::-1], along_y, along_y[::-1]),
    }[order.name]
    return np.stack([cycle[number % len(cycle)] for number in range(n_passes)])


def _visits(
    marks: np.ndarray,
    sites: np.ndarray,
    passes: np.ndarray,
    *,
    together: int,
    view: View,
) -> VisitSequence:
    """Return the visits of passes (P, n) in which each mark is exposed `together` times.

    Check stops come half way, one exposure each. All marks are measured from +x, then all in the
    same order from -x, +y and -y: each stop of a mark is reached from the same side, so that
    backlash does not look like a scale of the microscope.
    """
    half = (len(passes) + 1) // 2
    stops = SIDES if view.check_marks else ()
    rows = [
        *passes[:half],
        *[check_marks(sites, view.check_marks)] * len(stops),
        *passes[half:],
    ]
    sides = [(0, 0)] * half + list(stops) + [(0, 0)] * (len(passes) - half)
    index = np.concatenate(rows)
    number = np.repeat(np.arange(len(rows)), [*map(len, rows)])
    aside = view.check_offset_m * np.array(sides).T[:, number]
    exposures = np.where(aside.any(axis=0), 1, together)
    new_stop = (np.diff(index, prepend=-1) != 0) | np.diff(aside, prepend=0.0).any(
        axis=0
    )
    first = np.flatnonzero(new_stop)
    count = np.add.reduceat(exposures, first)
    time = np.cumsum(count) - (count + 1) / 2
    (m, n), (i, j) = marks[:, index[first]], sites[:, index[first]]
    return VisitSequence(
        m=m,
        n=n,
        i=i,
        j=j,
        count=count,
        pass_number=number[first],
        time=time,
        aside_m=aside[:, first],
    )


def check_marks(sites: np.ndarray, number: int) -> np.ndarray:
    """Return the sites among (2, V) that are checked by default.

    The one in the middle and others evenly around it half way out, the first towards
    (+x, +y), counter-clockwise; if a site is already taken, the nearest free one.
    """
    number = min(number, sites.shape[1])
    middle = (sites.min(axis=1) + sites.max(axis=1)) / 2
    angle = np.pi / 4 + 2 * np.pi * np.arange(number - 1) / max(number - 1, 1)
    # half way to the corners
    out = np.sqrt(0.5) * np.stack([np.cos(angle), np.sin(angle)])
    targets = middle[:, None] + np.ptp(sites, axis=1)[:, None] / 2 * np.hstack(
        [np.zeros((2, 1)), out]
    )
    chosen: list[int] = []
    for target in targets.T:
        away = np.round(np.hypot(*(sites - target[:, None])), 6)  # the first of equals
        away[chosen] = np.inf
        chosen.append(int(np.argmin(away)))
    return np.array(chosen)


def approach_signs(position: np.ndarray, threshold: float = 0.0) -> np.ndarray:
    """Return the direction from which each position of an axis was reached.

    Parameters
    ----------
    position : float array (V,)
        Positions of the stops, visit by visit.
    threshold : float
        Largest difference that does not count as a motion, in the unit of the positions.

    Returns
    -------
    int8 array (V,)
        Sign of the last motion before each stop; 0 until the axis has moved.
    """
    step = np.diff(position, prepend=position[:1])
    has_moved = np.abs(step) > threshold
    last = np.maximum.accumulate(np.where(has_moved, np.arange(len(step)), 0))
    return np.where(has_moved[last], np.sign(step[last]), 0).astype(np.int8)
