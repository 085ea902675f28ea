# SPDX-License-Identifier: Apache-2.0
"""Messages from dicts: numbers of an array are those given, or refused."""

import numpy as np
import pytest
from std_msgs.msg import UInt8MultiArray, UInt64MultiArray

from selfcal_ros.nodes.filling import fill


@pytest.mark.parametrize(
    ("message", "dtype"),
    [
        (UInt64MultiArray, np.uint32),
        (UInt64MultiArray, np.int64),
        (UInt8MultiArray, np.int64),
    ],
)
def test_integers_of_another_type_are_kept(message, dtype):
    numbers = np.array([3, 0, 255], dtype=dtype)
    assert list(fill(message(), {"data": numbers}).data) == [3, 0, 255]


@pytest.mark.parametrize(
    ("message", "number"),
    [(UInt8MultiArray, 256), (UInt8MultiArray, -1), (UInt64MultiArray, -1)],
)
def test_an_integer_that_does_not_fit_is_refused_and_not_wrapped(message, number):
    with pytest.raises(OverflowError):
        fill(message(), {"data": np.array([1, number])})
