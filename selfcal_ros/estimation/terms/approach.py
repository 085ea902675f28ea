# SPDX-License-Identifier: Apache-2.0
"""Approach: the indicated position depends on the direction from which an axis arrived.

V has +-(h_x s_x + i h_y s_y), s the signs of approach; minus where the plate moves.
"""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.blocks import (
    AXES,
    Block,
    Estimates,
    Located,
    Pattern,
    Where,
    by_coefficient,
)
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the signs along x and along y."""
    # in the nominal frame, as the map: an approach that every visit has is the map's
    signs = inputs.at_visits(
        lambda visits: (
            inputs.sense.sign
            * np.stack([visits.approach_x, visits.approach_y]).astype(complex)
        ),
        nominal=True,
    )
    for coefficient, (marks, visits) in zip(AXES, signs, strict=False):
        yield Pattern((coefficient,), marks, visits)


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield each axis."""
    for where, weights in by_coefficient(estimates, names):
        yield Where(axis=where.part), weights


BLOCK = Block(
    "approach",
    "m",
    patterns,
    undetected=1e-12,
    nominal=10e-9,
    needs_visits=True,
    of_map=True,
    shared=True,
    located=located,
    change="order",
    cure="visit the marks from both sides, e.g. visit_order: x_back_y_back",
)
