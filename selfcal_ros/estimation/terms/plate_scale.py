# SPDX-License-Identifier: Apache-2.0
"""Plate scale: the plate is larger by a factor 1 + b in a view (temperature); V has b z."""

from collections.abc import Iterator

from selfcal_ros.blocks import Block, Pattern
from selfcal_ros.estimation.terms.of_plate import against_first, of_each_placing
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield the growth of each placing."""
    form = inputs.z.reshape(-1) * inputs.half_width_m
    return of_each_placing(inputs, term, [form], [("scale", 0, 1)])


BLOCK = Block(
    "plate_scale",
    "m/m",
    patterns,
    undetected=1e-10,
    nominal=1e-6,
    of_plate=True,
    part_of="plate_strain",
    located=against_first,
    cure="add views that are turned and shifted",
)
