# SPDX-License-Identifier: Apache-2.0
"""Yaw: the stage turns, by another angle at each site; only marks off the optical axis show it.

It has a coefficient at each node of a grid over the field, bilinear between them: a mark at d from
the optical axis is read at d - i yaw d (eq. 4.17).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np

from selfcal_ros.blocks import Block, Located, Pattern, by_coefficient
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the yaw at each node: the same at all visits of a mark."""
    if inputs.yaw is None:
        return
    phases = [nominal if view is None else view.phase
              for view, nominal in zip(inputs.visits, inputs.yaw.phases, strict=True)]
    here = inputs.weight.reshape(len(phases), -1) > 0
    for node, means in enumerate(inputs.yaw.columns(phases, _beside_cells(inputs))):
        yield Pattern(((f"node {node}", 1),),
                      {view: values * here[view] for view, values in means.items()})


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
                0, visits.mark]
    for members in inputs.members.values():
        axis = [row for row in members if inputs.yaw is not None and not inputs.yaw.arms[row]]
        out[members] += np.where(out[members], (mean[axis[0]] if axis else 0) - mean[
            members, None], 0)
    return out


def located(found: Any, names: tuple[str, ...]) -> Located:
    """Yield the size of every node's."""
    return (({}, weights * np.sign(found.values))
            for _, weights in by_coefficient(found, names))


BLOCK = Block(
    "yaw", "rad", patterns, undetected=1e-9,
    sizes=(1e-4,),  # 20", more than the yaw of almost any stage, so that images determine it
    of_images=True, shared=True, located=located,
    cure="let images show more marks, along x and along y")
