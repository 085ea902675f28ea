# SPDX-License-Identifier: Apache-2.0
"""What a service answers, and which errors are reported as faults of the node itself."""

from types import SimpleNamespace

import pytest

from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.nodes.services import answered


@pytest.mark.parametrize("coded", [True, False])
@pytest.mark.parametrize(
    ("error", "code", "is_fault"),
    [
        (InputError("map.json", "no such file", "name one"), ExitCode.BAD_INPUT, False),
        (RuntimeError("a fault of our own"), ExitCode.INTERNAL, True),
    ],
)
def test_an_error_is_the_answer_and_only_faults_are_reported(
    error, code, is_fault, coded
):
    def answer():
        raise error

    reported = []
    response = answered(
        SimpleNamespace(**({"error_code": 77} if coded else {})),
        answer,
        lambda where, what: reported.append((where, what)),
    )
    assert response.success is False and str(error) in response.message
    assert reported == ([("service", error)] if is_fault else [])
    assert getattr(response, "error_code", None) == (int(code) if coded else None)


def test_an_answer_is_the_message():
    response = answered(
        SimpleNamespace(), lambda: "saved", lambda *_: pytest.fail("no fault")
    )
    assert (response.success, response.message) == (True, "saved")
