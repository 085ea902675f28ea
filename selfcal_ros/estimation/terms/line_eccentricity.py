# SPDX-License-Identifier: Apache-2.0
"""Line eccentricity: the circle of lines is eccentric to the axis of rotation in each view.

As a fraction of its radius: Vtheta has c cos theta_k + s sin theta_k.
"""

from collections.abc import Iterator

import numpy as np

from selfcal_ros.blocks import Block, Estimates, Located, Pattern, Where
from selfcal_ros.estimation.terms.visits import TermInputs
from selfcal_ros.model.terms import ModelTerm


def patterns(inputs: TermInputs, term: ModelTerm) -> Iterator[Pattern]:
    """Yield both waves of each view of lines; free ones are relative to the first."""
    angle = 2 * np.pi / max(inputs.n_lines, 1) * np.arange(inputs.n_lines)
    count = len(inputs.line_names)
    for view in range(count)[int(term.free) :]:
        for component, wave in (("cos", np.cos(angle)), ("sin", np.sin(angle))):
            values = np.zeros((count, inputs.n_lines))
            values[view] = wave
            yield Pattern(((component, 1),), view=view, lines=values)


def located(estimates: Estimates, names: tuple[str, ...]) -> Located:
    """Yield the size of each view's eccentricity."""
    for view in sorted({column.view for column in estimates.columns}):
        mine = np.array([column.view == view for column in estimates.columns])
        size = float(np.hypot.reduce(estimates.values[mine]))
        weights = np.where(mine, estimates.values, 0.0) / (size or 1.0)
        yield Where(view=names[view]), weights


BLOCK = Block(
    "line_eccentricity",
    "rad",
    patterns,
    undetected=1e-9,
    sizes=(2e-6,),  # centred to 0.1 um at a radius of 50 mm
    of_lines=True,
    located=located,
    cure="centre the circle of lines better",
)
