# SPDX-License-Identifier: Apache-2.0
"""Visiting orders worked out: which grid mark of a view is visited when, and from which side."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.orders import DEFAULT_ORDER, VisitOrder, parse_order
from selfcal_ros.model.view import View


@dataclass(frozen=True, eq=False)
class VisitSequence:
    """The visits of the grid marks of one view in their order.

    A visit is one or more exposures of a mark between which no other mark is exposed: where one
    pass ends on the mark on which the next begins, that is one visit.

    Attributes
    ----------
    m, n : int array (V,)
        The mark visited, plate frame.
    i, j : int array (V,)
        The site on which it lies, stage frame.
    count : int array (V,)
        Exposures of the visit.
    pass_number : int array (V,)
        Pass over the plate in which the visit begins, from 0.
    time : float array (V,)
        Mean number of its exposures, counted from 0 over the whole view.
    """

    m: np.ndarray
    n: np.ndarray
    i: np.ndarray
    j: np.ndarray
    count: np.ndarray
    pass_number: np.ndarray
    time: np.ndarray

    def __len__(self) -> int:
        """Return the number of visits."""
        return len(self.m)


def visit_sequence(artifact: Artifact, view: View, *, order: str = "", consecutive: bool = False,
                   rng: np.random.Generator | None = None) -> VisitSequence:
    """Return the order in which the grid marks of a view are visited.

    Parameters
    ----------
    artifact, view
        The plate, how it lies, and how often every mark is measured.
    order : str
        See `selfcal_ros.model.orders`; empty = that of the view, or else `DEFAULT_ORDER`.
    consecutive : bool
        One pass in which all repeats of a mark are exposed one after another. Otherwise every
        repeat is a pass of its own; the passes of the order follow each other in turn, and
        repeats that are no multiple of their number leave the last turn incomplete.
    rng : numpy.random.Generator, optional
        Source of the order ``random``, which cannot do without.

    Returns
    -------
    VisitSequence
        Only marks whose sites lie in the field; no visit where no grid marks are measured.

    Raises
    ------
    InputError
        For an order that is not known, or a view off the lattice.
    ValueError
        For a random order without a source of chance.
    """
    chosen = parse_order(order or view.visit_order or DEFAULT_ORDER)
    if not view.grid:
        m, n, i, j, count, index = np.zeros((6, 0), dtype=int)
        return VisitSequence(m, n, i, j, count, index, np.zeros(0))
    marks = np.stack([artifact.m.ravel(), artifact.n.ravel()])
    sites = np.stack(view.lattice_pose(artifact).site_of(*marks))
    inside = (np.abs(sites) <= np.array(artifact.half)[:, None]).all(axis=0)
    marks, sites = marks[:, inside], sites[:, inside]
    n_passes = 1 if consecutive else view.repeats
    passes = _passes(chosen, marks if chosen.of_plate else sites, n_passes, rng)
    return _visits(marks, sites, passes, view.repeats if consecutive else 1)


def _passes(order: VisitOrder, places: np.ndarray, n_passes: int,
            rng: np.random.Generator | None) -> np.ndarray:
    """Return the indices of `places` (2, n) in the order of their visits, (passes, n)."""
    if order.name == "random":
        if rng is None:
            raise ValueError("a random visiting order needs a source of chance")
        return np.stack([rng.permutation(places.shape[1]) for _ in range(n_passes)])
    x, y = places
    # line by line along x: the lines themselves run along y
    along_x, along_y = np.lexsort((y, x)), np.lexsort((x, y))
    cycle = {"raster": (along_x,),
             "serpentine": (np.lexsort((np.where((x - x.min()) % 2, -y, y), x)),),
             "there_and_back": (along_x, along_x[::-1]),
             "x_then_y": (along_x, along_y),
             "x_back_y_back": (along_x, along_x[::-1], along_y, along_y[::-1])}[order.name]
    return np.stack([cycle[number % len(cycle)] for number in range(n_passes)])


def _visits(marks: np.ndarray, sites: np.ndarray, passes: np.ndarray,
            together: int) -> VisitSequence:
    """Return the visits of passes (P, n) in which each mark is exposed `together` times."""
    index = passes.ravel()
    first = np.flatnonzero(np.diff(index, prepend=-1))
    count = np.diff(first, append=len(index)) * together
    time = first * together + (count - 1) / 2
    index = index[first]
    (m, n), (i, j) = marks[:, index], sites[:, index]
    return VisitSequence(m, n, i, j, count, first // passes.shape[1], time)


def approach_signs(position: np.ndarray, threshold: float = 0.0) -> np.ndarray:
    """Return from which side each position of an axis was reached.

    Parameters
    ----------
    position : float array (V,)
        Where the axis stops, visit by visit.
    threshold : float
        Largest difference that does not count as a motion, in the unit of the positions.

    Returns
    -------
    int8 array (V,)
        Sign of the last motion before each stop; 0 as long as the axis has not moved.
    """
    step = np.diff(position, prepend=position[:1])
    moved = np.abs(step) > threshold
    last = np.maximum.accumulate(np.where(moved, np.arange(len(step)), 0))
    return np.where(moved[last], np.sign(step[last]), 0).astype(np.int8)
