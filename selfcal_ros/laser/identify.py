# SPDX-License-Identifier: Apache-2.0
"""One entry to both formulations."""

from dataclasses import dataclass

from selfcal_ros.errors import InputError
from selfcal_ros.laser.data import Form, Method, StepDiagonal, StepDiagonalResult
from selfcal_ros.laser.ibaraki import identify_ibaraki
from selfcal_ros.laser.wang import EQUAL_READINGS, identify_wang, readings_are_equal


@dataclass(frozen=True)
class Choice:
    """How a measurement is to be identified.

    Attributes
    ----------
    method : Method
        Formulation.
    form : Form
        Form of the new formulation.
    allow_equal : bool
        Whether the new formulation accepts readings that are equal on all axes; the
        conventional one, a closed formula, always does.
    """

    method: Method
    form: Form = Form.EXACT
    allow_equal: bool = False


def identify(data: StepDiagonal, choice: Choice) -> StepDiagonalResult:
    """Identify the errors of a step-diagonal measurement by the chosen formulation.

    Raises
    ------
    InputError
        If the measurement lacks what the formulation needs, or holds only diagonal lengths.
    NotIdentifiableError
        If the diagonals do not determine the errors.
    """
    if choice.method is Method.CONVENTIONAL:
        if choice.form is not Form.EXACT:
            raise InputError("--form", "the conventional formulation has one form only",
                             "leave it out, or use --method new")
        return identify_wang(data)
    if readings_are_equal(data) and not choice.allow_equal:
        raise InputError("readings", EQUAL_READINGS, "turn the mirror square to the laser, or "
                         "allow equal readings if the linear errors truly are the same")
    return identify_ibaraki(data, form=choice.form)
