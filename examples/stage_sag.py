# SPDX-License-Identifier: Apache-2.0
"""A block of one's own: a stage whose error changes linearly with the position of its load.

The guide of each axis bends under a plate that lies off the centre: with the plate's centre at t on
the stage, the error at X has c (t_x (x^3 - x), t_y (y^3 - y)), x and y in half widths of the plate.
The coefficient c is a length over a length.
"""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.blocks import Block, Pattern


def patterns(inputs, term) -> Iterator[Pattern]:
    """Yield what c = 1 does to the readings of each mark in each view, plate frame, m."""
    values = {}
    for view, pose in enumerate(inputs.poses):
        place = inputs.on_stage(view) / inputs.half_width_m
        x, y = place.real, place.imag
        load_x, load_y = pose.shift_m
        error = load_x * (x**3 - x) + 1j * load_y * (y**3 - y)
        read = inputs.weight[view].reshape(-1) > 0
        values[view] = np.where(read, error / pose.phase, 0.0)
    yield Pattern((("sag", 1),), values)


def sentence(cause) -> str:
    """Return what the readings show."""
    return (
        f"a stage that sags under a plate off its centre, by {abs(cause.size) * 1e6:.2f} ± "
        f"{cause.u * 1e6:.2f} µm a metre"
    )


BLOCK = Block(
    "stage_sag",
    "m/m",
    patterns,
    undetected=1e-9,
    nominal=1e-6,
    of_map=True,
    shared=True,
    cure="add views shifted both ways along both axes",
    sentence=sentence,
    action="stiffen the guides, or keep the plate at the centre",
)
