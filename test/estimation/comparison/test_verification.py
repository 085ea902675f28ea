# SPDX-License-Identifier: Apache-2.0
"""What acts in machines that loaded the table rightly or wrongly, with noise and new plates."""

from dataclasses import replace

import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.estimation.comparison.verification import (
    TableFault,
    require_correctable,
    verify,
)
from selfcal_ros.model.reference import ReferenceLength
from selfcal_ros.model.result import Observability
from selfcal_ros.model.verdict import Grade
from selfcal_ros.reporting.words.verification import verification_sentence
from test.support.wired import WRONG, machine

EXPECTED = {
    "right": "the correction acts as the map says",
    "sign": "the wrong sign",
    "exchanged": "exchanged",
    "unit": "look for a wrong unit",
    "another": "that is not this map",
    "off": "does not act",
    "old": "an older table",
}


@pytest.mark.parametrize("wiring", EXPECTED)
def test_the_sentence_names_what_acts(wiring):
    """Three machines each; of 200 machines all but the odd map that resembles another."""
    first = 1 + 2 * WRONG.index(wiring) if wiring in WRONG else 0
    for seed in (first, first + 12, first + 24):
        before, after, factor = machine(seed, wiring)
        found = verify(before, after)
        assert EXPECTED[wiring] in verification_sentence(found), seed
        assert found.passed is (wiring in ("right", "old"))
        if wiring in ("right", "sign", "unit", "off"):
            for axis in found.axes.values():
                assert abs(axis.factor - factor) < 5 * axis.u_factor


def test_a_scale_that_one_map_has_alone_is_said_to_be_left_out():
    """A stage that is warmer with the correction on was as the map says, 24 µm/m off it."""
    before, after, _ = machine(0, "right")
    length = ReferenceLength("artifact", 1e-6, 2e-7, "PTB 1")
    scaled = replace(before, reference=length)
    left_out = "the scale of the map, by its reference length, is not compared"
    for first, second, said in (
        (before, after, False),
        (scaled, after, True),
        (scaled, replace(after, reference=length), False),
    ):
        sentence = verification_sentence(verify(first, second))
        assert (left_out in sentence) is said


@pytest.mark.parametrize("seed", [3, 5, 13])
def test_half_of_a_correction_is_named_though_what_remains_is_within_u(seed):
    """Of a small error half is hidden by noise, place by place; the factor is not."""
    before, after, _ = machine(seed, lambda table: 0.5 * table, size=0.1)
    found = verify(before, after)
    assert found.better and not found.remains and not found.passed
    assert found.fault is TableFault.FACTOR
    assert "look for a wrong unit" in verification_sentence(found)
    before, after, _ = machine(seed, "right", size=0.1)
    assert verify(before, after).passed


@pytest.mark.parametrize(
    ("fault", "loaded"),
    [
        (TableFault.COMPONENTS, lambda table: table[::-1]),
        (TableFault.PLACES, lambda table: table.transpose(0, 2, 1)),
        (TableFault.TRANSPOSED, lambda table: table.transpose(0, 2, 1)[::-1]),
        (TableFault.MIRRORED_X, lambda table: table[:, ::-1]),
        (TableFault.MIRRORED_Y, lambda table: table[:, :, ::-1]),
        (TableFault.MIRRORED, lambda table: table[:, ::-1, ::-1]),
    ],
)
def test_each_arrangement_of_a_table_is_named(fault, loaded):
    before, after, _ = machine(101, loaded)
    found = verify(before, after)
    assert found.fault is fault and not found.passed


@pytest.mark.parametrize("missing", ["a known stage", "a good grade"])
def test_a_map_that_is_not_known_or_not_good_is_not_one_to_correct_with(missing):
    before, _, _ = machine(1, "right")
    require_correctable(before, "MAP.json")
    if missing == "a known stage":
        before = replace(before, observability=Observability(8, 6, 2, False))
    else:
        verdict = replace(before.verdict, grade=Grade.NOT_QUALIFIED)
        before = replace(before, verdict=verdict)
    with pytest.raises(InputError, match=r"MAP\.json: is not qualified, so it is not"):
        require_correctable(before, "MAP.json")
