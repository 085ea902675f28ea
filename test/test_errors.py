# SPDX-License-Identifier: Apache-2.0
"""What a message shows of other people's texts."""

import pickle

import pytest

from selfcal_ros.errors import InputError, NoDataError, printable
from selfcal_ros.machine.interface import MachineError


@pytest.mark.parametrize(
    "text, shown",
    [
        ("a b", "a b"),
        ("a\n\x1b[2J\u202e", r"a\n\x1b[2J\u202e"),
        ("\ud800", r"\ud800"),
        ("x" * 4000, "x" * 4000),
        (
            "a" * 3000 + "b" + "c" * 1000,
            f"{'a' * 3000} ... (4001 characters) ... {'c' * 1000}",
        ),
    ],
)
def test_a_text_is_one_line_of_bearable_length(text, shown):
    assert printable(text) == shown


def test_a_name_of_a_megabyte_leaves_the_remedy_readable():
    line = str(InputError("x" * 10**6, "is too long", "shorten it"))
    assert line.endswith("x: is too long; shorten it")
    assert len(line) < 4100


@pytest.mark.parametrize(
    "error",
    [
        InputError("a", "b", "c"),
        NoDataError("a", "b"),
        MachineError("it stands", "axis x", "go"),
    ],
)
def test_an_error_of_a_worker_reaches_its_parent(error):
    seen = pickle.loads(pickle.dumps(error))
    assert type(seen) is type(error) and str(seen) == str(error)
    assert (seen.where, seen.what, seen.remedy) == (
        error.where,
        error.what,
        error.remedy,
    )
