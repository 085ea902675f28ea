# SPDX-License-Identifier: Apache-2.0
"""Did the plate slip, or does something else explain what looks like it: scored side by side.

A microscope that is turned, a drift or a plate that grew leave residuals that a second
misalignment takes off in part. Before a view is split its slip competes with every term that the
model does not hold, by what each takes off the residuals for its degrees of freedom.
"""

import numpy as np

from selfcal_ros.estimation.joint.solve import fit_joint
from selfcal_ros.estimation.lattice.maps import PHASES
from selfcal_ros.estimation.options import Options
from selfcal_ros.estimation.quality.slip import MAX_PLACES, Slip
from selfcal_ros.estimation.terms.columns import Column, TermColumns, WithinMarks
from selfcal_ros.estimation.terms.ground import Ground
from selfcal_ros.estimation.terms.shapes import shapes_of
from selfcal_ros.estimation.verdict.cause_sizes import cause_of
from selfcal_ros.estimation.verdict.causes import PlacedSlip, find_explanations
from selfcal_ros.estimation.verdict.fault_columns import SLIP
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.verdict import Cause


def likelier_term(measurements: Measurements, options: Options, slip: Slip) -> Cause | None:
    """Return the term that explains the residuals better than a slip; None if the slip does.

    Raises
    ------
    NotIdentifiableError, InputError
        As `selfcal_ros.estimation.api.calibrate`.
    """
    model = fit_joint(measurements, options)
    problem = model.problem
    row = problem.grid.index.index(slip.index)
    ground = problem.ground
    placed = PlacedSlip(slip_at_line(ground, row, slip, PHASES[-problem.grid.poses[row].q % 4]),
                        row, 2 * MAX_PLACES)
    found = find_explanations(model, slips=True, readings=False, placed=placed)
    if not found or found[0].name == SLIP:
        return None
    return cause_of(found[0], ground.names, problem.half_width_m)


def slip_at_line(ground: Ground, row: int, slip: Slip, phase: complex) -> TermColumns:
    """Return the columns of a slip before a line of marks: offset along x and y, rotation.

    Parameters
    ----------
    ground : Ground
        What the columns stand on.
    row : int
        The grid view.
    slip : Slip
        Where.
    phase : complex
        From the stage frame to the plate frame in that view.
    """
    half = ((ground.z.shape[0] - 1) // 2, (ground.z.shape[1] - 1) // 2)
    axis = "mn".index(slip.axis)
    line = np.indices(ground.z.shape)[axis] - half[axis]
    after = (line >= slip.first) & (ground.weight[row] > 0)
    shapes = shapes_of([{row: (after * shape).reshape(-1)} for shape in (phase, ground.z)],
                       (0, 0, 1), (1, 1j, 1j), ground.weight)
    columns = tuple(Column(SLIP, row, part, np.inf) for part in ("x", "y", "phi"))
    nothing = WithinMarks(np.zeros((3, 3)), np.zeros(3), 0.0, 0)
    return TermColumns(columns, shapes, nothing, [[None] * len(ground.names)] * 2)
