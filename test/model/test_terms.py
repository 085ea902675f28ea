# SPDX-License-Identifier: Apache-2.0
"""Terms of the model: names as text, what is refused."""

import math

import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.terms import ModelTerm, TermName, parse_terms


def test_a_name_given_as_text_is_the_term():
    term = ModelTerm("microscope")
    assert term.name is TermName.MICROSCOPE
    assert term == ModelTerm(TermName.MICROSCOPE) == parse_terms(["microscope"], "here")[0]
    assert (term.size, str(ModelTerm("drift", 5e-9))) == (math.inf, "drift:5e-09")


def test_a_name_that_nobody_knows():
    with pytest.raises(InputError) as caught:
        ModelTerm("creep")
    assert str(caught.value) == ("ModelTerm: the term 'creep' is unknown; known are microscope, "
                                 "drift, plate_scale, plate_shape, approach")
