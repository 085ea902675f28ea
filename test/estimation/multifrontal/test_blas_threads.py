# SPDX-License-Identifier: Apache-2.0
"""One thread of linear algebra inside the blocks, the former number after the last of them."""

import re
from threading import Event, Thread

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from selfcal_ros.estimation.multifrontal.factor import one_thread


def threads() -> set[int]:
    """Threads of the BLAS of numpy and of scipy; others (OpenCV's) came in with other tests."""
    return {
        row["num_threads"]
        for row in threadpool_info()
        if row["user_api"] == "blas" and re.search("numpy|scipy", row["filepath"])
    }


@pytest.fixture(autouse=True)
def three_threads():
    with threadpool_limits(3, user_api="blas"):
        yield


def test_one_thread_inside_and_the_former_number_after():
    with one_thread():
        assert threads() == {1}
        with one_thread():
            assert threads() == {1}
        assert threads() == {1}  # the inner block has not set it back
    assert threads() == {3}


def test_the_number_goes_back_after_an_error():
    with pytest.raises(ZeroDivisionError, match="division by zero"), one_thread():
        raise ZeroDivisionError("division by zero")
    assert threads() == {3}


def test_blocks_of_two_threads_overlap():
    entered, leave = Event(), Event()

    def other() -> None:
        with one_thread():
            entered.set()
            leave.wait(60)

    worker = Thread(target=other)
    with one_thread():
        worker.start()
        assert entered.wait(60)
    assert threads() == {1}  # the other block goes on
    leave.set()
    worker.join(60)
    assert threads() == {3}


def test_a_function_can_be_wrapped():
    assert one_thread()(lambda: threads())() == {1}
    assert np.isfinite(np.linalg.inv(np.eye(3))).all()
