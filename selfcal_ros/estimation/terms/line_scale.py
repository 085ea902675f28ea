# SPDX-License-Identifier: Apache-2.0
"""Line scale: the offsets of lines are seen smaller by E than they are, alike in all views.

A reading has o where it should have (1 + E) o, as with the microscope: Vtheta has -E o.
"""

from collections.abc import Iterator

from selfcal_ros.blocks import Block, Pattern
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, _: ModelTerm) -> Iterator[Pattern]:
    """Yield the offsets of the lines, if any were read."""
    if inputs.line_names:
        yield Pattern((("scale", 1),), lines=-inputs.line_offsets)


BLOCK = Block(
    "line_scale",
    "m/m",
    patterns,
    undetected=1e-6,
    sizes=(0.01,),  # as of the microscope for the marks
    plausible=0.1,
    of_lines=True,
    of_offsets=True,
    shared=True,
    cure="turn the plate differently in views in which marks and lines are read",
)
