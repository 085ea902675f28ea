# SPDX-License-Identifier: Apache-2.0
"""Terms of the model: names as text, what is refused."""

import math

import pytest

from selfcal_ros.blocks import BUILT_IN
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.terms import ModelTerm, microscope_term, parse_terms


def test_a_name_given_as_text_is_the_term():
    term = ModelTerm("microscope")
    assert term.name == "microscope"
    assert term == ModelTerm("microscope") == parse_terms(["microscope"], "here")[0]
    assert (term.size, str(ModelTerm("drift", 5e-9))) == (math.inf, "drift:5e-09")


def test_a_name_that_nobody_knows():
    with pytest.raises(InputError) as caught:
        ModelTerm("creep")
    assert str(caught.value) == (
        f"model: the term 'creep' is unknown; known are {', '.join(BUILT_IN)}"
    )


def test_a_microscope_has_three_sizes():
    (term,) = parse_terms(["microscope:0.02:0.003:0.0004"], "here")
    assert [term.size_of(part) for part in ("scale", "turn", "stretch", "shear")] == [
        0.02,
        0.003,
        0.0004,
        0.0004,
    ]
    assert (term.size, term.free, str(term)) == (
        0.02,
        False,
        "microscope:0.02:0.003:0.0004",
    )
    assert parse_terms([str(term)], "here") == (term,)
    assert str(term.scaled(10)) == "microscope:0.2:0.03:0.004"
    assert microscope_term(0.001, 0.05, 0.01).size == 0.05
    (one,) = parse_terms(["microscope:0.02"], "here")
    assert {one.size_of(part) for part in ("scale", "turn", "stretch", "shear")} == {
        0.02
    }


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("drift:1e-8:1e-8:1e-8", "--model: drift: 3 sizes are given; give one"),
        ("microscope:0.1:0.1", "--model: microscope: 2 sizes are given; give one, or"),
        ("drift:1_0e-9", "--model: drift: the size '1_0e-9' is not a positive number"),
        (
            "microscope:0.1:x:0.1",
            "--model: microscope: the size 'x' is not a positive number",
        ),
        (
            "microscope:0.1:0.1:2",
            "--model: microscope: the size 2 is outside 1e-18 to 1",
        ),
    ],
)
def test_sizes_that_no_term_has(text, said):
    with pytest.raises(InputError) as caught:
        parse_terms([text], "--model")
    assert str(caught.value).startswith(said)


def test_a_size_of_0_says_that_there_is_no_such_term():
    terms = parse_terms(["plate_strain:0", "drift:1e-9"], "here")
    assert [(term.name, term.size, term.free) for term in terms] == [
        ("drift", 1e-9, False),
        ("plate_strain", 0.0, False),
    ]
    names = [term.name for term in Options(terms=terms).model_terms(visits=True)]
    assert names == [
        "drift",
        "microscope",
        "plate_shape",
        "line_eccentricity",
        "line_scale",
        "rotation",
        "yaw",
    ]
    assert [term.name for term in Options(terms=terms).model_terms(visits=False)] == [
        "drift",
        "plate_shape",
        "line_eccentricity",
        "line_scale",
        "rotation",
        "yaw",
    ]
    assert Options(terms=terms, assumed=()).model_terms(visits=True) == terms[:1]


@pytest.mark.parametrize(
    ("size", "up"),
    [(2.31e-7, 2.4e-7), (9.91e-7, 1.0e-6), (1.01e-3, 1.1e-3), (4.5, 4.5), (12.3, 13.0)],
)
def test_a_size_is_rounded_up_to_two_figures(size, up):
    assert ModelTerm("drift", size).rounded_up == ModelTerm("drift", up)
