# SPDX-License-Identifier: Apache-2.0
"""Yaw: the stage turns, by another angle at each site; only marks off the optical axis show it.

It has a coefficient at each node of a grid over the field, bilinear between them: a mark at d from
the optical axis is read at d - i yaw d (eq. 4.17).
"""

from collections.abc import Iterator
from itertools import product

import numpy as np

from selfcal_ros.blocks import Block, Estimates, Located, Pattern, Where, by_coefficient
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the yaw at each node: the same at all visits of a mark; nothing without images."""
    if not inputs.cells_m.any():
        return
    views = range(len(inputs.names))
    places = np.array([inputs.on_stage(view) for view in views])
    along = [
        _hats(coordinate, axis)
        for coordinate, axis in zip(
            (places.real, places.imag), inputs.node_axes_m, strict=True
        )
    ]
    phases = np.array(
        [
            inputs.poses[view].phase.conjugate() if visits is None else visits.phase
            for view, visits in enumerate(inputs.visits)
        ]
    )
    unit = -1j * phases[:, None] * (inputs.weight.reshape(places.shape) > 0)
    beside_cells = unit * _beside_cells(inputs)
    turned = unit * inputs.cells_m[:, None] + beside_cells
    turned_views = [view for view in views if turned[view].any()]
    nodes = list(product(*along))
    for number, (of_x, of_y) in enumerate(nodes):
        # a constant yaw is a turn of the camera: it does not act beside the cells
        values = turned * of_x * of_y - beside_cells / len(nodes)
        yield Pattern(
            ((f"node {number}", 1),), {view: values[view] for view in turned_views}
        )


def _hats(places: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Return the weight of each node at places along an axis, m; linear between two of them."""
    at = np.interp(places, nodes, np.arange(len(nodes)))
    return np.array(
        [np.maximum(1 - np.abs(at - node), 0) for node in range(len(nodes))]
    )


def _beside_cells(inputs: TermInputs) -> np.ndarray:
    """Return the offsets of marks from the places of their cells, stage axes, (views, marks), m.

    Of a cell the mean is that on the optical axis: its own holds the camera's error there.
    """
    out = np.zeros((len(inputs.names), inputs.z.size), dtype=complex)
    mean = np.zeros(len(out), dtype=complex)
    for row, visits in enumerate(inputs.visits):
        if visits is not None:
            mean[row] = visits.offset.mean()
            out[row, visits.mark] = visits.means(visits.offset[None], inputs.z.size)[
                0, visits.mark
            ]
    for members in inputs.members.values():
        axis = [row for row in members if not inputs.cells_m[row]]
        out[members] += np.where(
            out[members], (mean[axis[0]] if axis else 0) - mean[members, None], 0
        )
    return out


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield the size of every node's."""
    return (
        (Where(), weights * np.sign(estimates.values))
        for _, weights in by_coefficient(estimates, names)
    )


BLOCK = Block(
    "yaw",
    "rad",
    patterns,
    undetected=1e-9,
    sizes=(
        1e-4,
    ),  # 20", more than the yaw of almost any stage, so that images determine it
    of_images=True,
    shared=True,
    located=located,
    cure="let images show more marks, along x and along y",
)
