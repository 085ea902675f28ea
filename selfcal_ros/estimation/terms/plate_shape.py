# SPDX-License-Identifier: Apache-2.0
"""Plate shape: the plate is bent in a view (clamping, gravity).

V has a quadratic form of z/H along each axis; a size is that at the middle of an edge.
"""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.blocks import AXES, Block, Pattern
from selfcal_ros.estimation.terms.of_plate import against_first, of_each_placing
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm

COEFFICIENTS = [(f"{axis} {form}", number, unit) for axis, unit in AXES
                for number, form in enumerate(("xx", "xy", "yy"))]


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield the bending of each placing."""
    x, y = inputs.z.reshape(-1).real, inputs.z.reshape(-1).imag
    # 2xy beside x^2 and y^2: a bending (x^2 - y^2, -2xy) then has coefficients of one size
    forms = np.stack([x * x, 2 * x * y, y * y]).astype(complex)
    return of_each_placing(inputs, term, list(forms), COEFFICIENTS)


BLOCK = Block(
    "plate_shape", "m", patterns, undetected=1e-12, nominal=10e-9,
    sizes=(5e-9,),  # what handling does to fused silica 6 mm thick
    of_plate=True,
    located=against_first,
    cure="add views shifted both ways along both axes, and one along a diagonal")
