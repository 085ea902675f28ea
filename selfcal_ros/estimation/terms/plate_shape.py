# SPDX-License-Identifier: Apache-2.0
"""Plate shape: the plate is bent in a view (clamping, gravity).

V has complex multiples of z^2, |z|^2 and z*^2, z over the half width: a saddle (x^2 - y^2, -2xy) is
z*^2. A coefficient, and its size, is the displacement at the middle of each edge.
"""

from collections.abc import Iterator

from selfcal_ros.blocks import AXES, Block, Pattern
from selfcal_ros.estimation.terms.of_plate import against_first, of_each_placing
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm

FORMS = ("z^2", "|z|^2", "z*^2")

COEFFICIENTS = [
    (f"{form} {axis}", number, unit)
    for number, form in enumerate(FORMS)
    for axis, unit in AXES
]


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield the bending of each placing."""
    z = inputs.z.reshape(-1)
    forms = [z**2, z * z.conj(), z.conj() ** 2]
    return of_each_placing(inputs, term, forms, COEFFICIENTS)


BLOCK = Block(
    "plate_shape",
    "m",
    patterns,
    undetected=1e-12,
    nominal=10e-9,
    sizes=(5e-9,),  # what handling does to fused silica 6 mm thick
    families=tuple((f"{form} x", f"{form} y") for form in FORMS),
    of_plate=True,
    located=against_first,
    cure="add views shifted both ways along both axes, and one along a diagonal",
)
