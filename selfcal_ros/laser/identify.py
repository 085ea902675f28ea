# SPDX-License-Identifier: Apache-2.0
"""One entry to both formulations."""

from dataclasses import dataclass

from selfcal_ros.errors import InputError
from selfcal_ros.laser.conventional import identify_conventional, refuse_equal_readings
from selfcal_ros.laser.data import Form, Identified, Method, StepDiagonal
from selfcal_ros.laser.new import identify_new


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
        Whether readings that are equal on all axes are accepted.
    """

    method: Method
    form: Form = Form.EXACT
    allow_equal: bool = False


def identify(data: StepDiagonal, choice: Choice) -> Identified:
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
        return identify_conventional(data, allow_equal=choice.allow_equal)
    if not choice.allow_equal:
        refuse_equal_readings(data)
    return identify_new(data, form=choice.form)
