# SPDX-License-Identifier: Apache-2.0
"""Plate strain: the plate is strained linearly in a view (clamping).

V has b z + (a + ih) z*: scale, stretch, shear.
"""

from collections.abc import Iterator

from selfcal_ros.blocks import Block, Pattern
from selfcal_ros.estimation.terms.of_plate import against_first, of_each_placing
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield the strain of each placing."""
    z = inputs.z.reshape(-1)
    return of_each_placing(
        inputs,
        term,
        [z * inputs.half_width_m, z.conj() * inputs.half_width_m],
        [("scale", 0, 1), ("stretch", 1, 1), ("shear", 1, 1j)],
    )


BLOCK = Block(
    "plate_strain",
    "m/m",
    patterns,
    undetected=1e-10,
    nominal=1e-6,
    # a plate of fused silica: 5e-8 by clamping, and as much again by 0.1 K
    sizes=(7e-8,),
    of_plate=True,
    located=against_first,
    cure="add views shifted both ways along both axes",
)
