# SPDX-License-Identifier: Apache-2.0
"""The comparison of two trees: what counts as a difference, and what a session draws."""

from copy import deepcopy

import pytest

from tools.same import compare, leaves, session


def test_numbers_and_names_are_recorded_and_sentences_left_out():
    result = {
        "verdict": {"grade": "good", "sentence": "Good"},
        "causes": [{"size": 1.5}],
        "map": [[1.0, 2.0], [3.0, 4.0]],
    }
    found = dict(leaves(result))
    assert found.keys() == {"/verdict/grade", "/causes/0/size", "/map"}
    assert (
        found["/map"]
        != dict(leaves({"map": [[1.0, 2.0], [3.0, 4.000000000000001]]}))["/map"]
    )


@pytest.mark.parametrize(
    ("after", "differing"),
    [
        ({"case": {"/a": 1.0}}, 0),
        ({"case": {"/a": 1.0000000000000002}}, 1),
        ({"case": {"/a": 1.0, "/new": 2}}, 0),
        ({"case": {"/a": None}}, 1),
    ],
)
def test_a_case_differs_where_one_value_of_both_trees_does(after, differing, capsys):
    assert compare({"case": {"/a": 1.0}}, after) == differing
    assert f"1 cases, {differing} differ" in capsys.readouterr().out


def test_a_session_is_drawn_from_its_number_alone():
    assert session(7) == session(7)
    assert session(7) != session(8)


@pytest.mark.parametrize(
    ("g", "p", "differing"),
    [
        (1.00001e-7, 0.5, 0),
        (1.00009e-7, 0.5, 0),
        (1.0002e-7, 0.5, 1),
        (1e-7, 0.5004, 0),
        (1e-7, 0.51, 1),
    ],
)
def test_a_map_may_differ_by_a_part_of_its_u_and_a_number_by_that_of_itself(
    g, p, differing
):
    before, after = (
        {"case": {"/error_map/u_gx": [[1e-8]], "/error_map/gx": [[one]], "/p": two}}
        for one, two in ((1e-7, 0.5), (g, p))
    )
    assert compare(before, after, 1e-3) == differing
    assert compare(before, after) == ((g, p) != (1e-7, 0.5))


FACTORS = "/covariance_terms/factors"
PLATE = "/covariance_terms/beside/plate"
FACTORED = {
    FACTORS: [[[3.0, 1.0]], [[0.5, 2.0]], [[0.0, 0.1]]],
    PLATE: [[[7.0]], [[1.0]], [[4.0]]],
    "/covariance_terms/beside/with_map": 2,
}
"""Two factors of a term, one of an effect, and what a term makes of the plate alone."""


def with_sign(row, *, of_plate):
    case = deepcopy(FACTORED)
    case[FACTORS][row] = [[-value for value in case[FACTORS][row][0]]]
    if of_plate:
        case[PLATE][row] = [[-value for value in case[PLATE][row][0]]]
    return case


@pytest.mark.parametrize(
    ("after", "differing"),
    [
        (with_sign(0, of_plate=True), 0),
        (with_sign(0, of_plate=False), 1),
        (with_sign(2, of_plate=False), 0),
        (
            FACTORED | {FACTORS: FACTORED[FACTORS][::-1], PLATE: FACTORED[PLATE][::-1]},
            1,
        ),
        (FACTORED | {FACTORS: [[[3.0, 1.0]], [[0.5, 2.0]], [[0.0, 0.2]]]}, 1),
    ],
)
def test_factors_differ_where_their_covariance_does(after, differing):
    assert compare({"case": FACTORED}, {"case": after}, 1e-3) == differing
