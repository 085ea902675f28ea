# SPDX-License-Identifier: Apache-2.0
"""Microscope: a 2x2 matrix E that all views share, mark = indicated + (1 + E) offset.

A reading has o where it should have (1 + E) o: V has -E o, E o = (s + ir) o + (a + ih) o*.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from selfcal_ros.blocks import Block, Estimates, Located, Pattern, by_coefficient
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm

PAIRS = ((("scale", 1), ("turn", 1j)), (("stretch", 1), ("shear", 1j)))


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the offsets, and their conjugates."""
    offsets = inputs.at_visits(
        lambda visits: -np.stack([visits.offset, visits.offset.conj()])
    )
    for pair, (marks, visits) in zip(PAIRS, offsets, strict=False):
        yield Pattern(pair, marks, visits)


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield every coefficient; of a rotation in rad."""
    for where, weights in by_coefficient(estimates, names):
        unit = "rad" if where.part in ("turn", "shear") else "m/m"
        yield replace(where, unit=unit), weights


BLOCK = Block(
    "microscope",
    "m/m",
    patterns,
    undetected=1e-6,
    nominal=1e-3,
    # the pixel size is known to 1 %, the rotation of the camera to 10 mrad
    sizes=(0.01, 0.01, 0.002),
    parts=(("scale", ("scale",)), ("turn", ("turn",)), ("shear", ("stretch", "shear"))),
    plausible=0.1,
    needs_visits=True,
    of_offsets=True,
    shared=True,
    located=located,
    change="check_stops",
    cure="ask for check_stops in the plan, or align the microscope and leave the term out",
)
