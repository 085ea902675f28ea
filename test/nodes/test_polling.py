# SPDX-License-Identifier: Apache-2.0
"""Messages taken by the clock: which are missing, by the numbers that publishers give."""

import pytest

from selfcal_ros.nodes.polling import ByTheClock


class Queue:
    """A subscription with numbered messages that wait, and its publishers."""

    msg_type = None

    def __init__(self, n_publishers=1):
        self.handle, self.waiting, self.n_publishers = self, [], n_publishers

    def take_message(self, kind, raw):
        return (
            (
                b"",
                {
                    "publication_sequence_number": self.waiting.pop(0),
                    "received_timestamp": 1,
                },
            )
            if self.waiting
            else None
        )

    def get_publisher_count(self):
        return self.n_publishers


def missing(callback, queue, *numbers, most=2000):
    queue.waiting += numbers
    return tuple(callback.empty(queue, most))


@pytest.fixture
def taken():
    return []


@pytest.fixture
def callback(taken):
    return ByTheClock("topic", lambda data, received_ns: taken.append(received_ns))


def test_what_lies_between_two_numbers_is_lost(callback, taken):
    queue = Queue()
    assert missing(callback, queue, 7, 8, 13) == (4, 0)
    assert missing(callback, queue) == (0, 0)
    assert missing(callback, queue, 15, 16) == (1, 0)
    assert missing(callback, queue, 1, 2) == (0, 0)  # started anew
    assert missing(callback, queue, 5) == (2, 0)
    assert len(taken) == 8


def test_numbers_of_several_publishers_tell_nothing_until_the_last_of_them_is_taken(
    callback,
):
    queue = Queue(2)
    assert missing(callback, queue, 100_000, 3, 100_001, 4) == (0, 0)
    queue.n_publishers = 1
    # what came before the other left
    assert missing(callback, queue, 5, 100_005) == (0, 0)
    assert missing(callback, queue, 6, 9) == (2, 0)
    queue.n_publishers = 2
    assert missing(callback, queue, 10, 1, 11) == (0, 0)
    queue.n_publishers = 1
    assert missing(callback, queue, 12, 2, 13, 14, most=2) == (0, 0)
    assert missing(callback, queue, most=3) == (0, 0)  # the queue was not empty yet
    assert missing(callback, queue, 20, 22) == (1, 0)


def test_a_publisher_that_follows_another_begins_with_its_own_numbers(callback):
    queue = Queue()
    assert missing(callback, queue, 1, 2) == (0, 0)
    queue.n_publishers = 0
    assert missing(callback, queue, 3) == (0, 0)
    queue.n_publishers = 1
    assert missing(callback, queue, 900, 902) == (1, 0)


def test_what_was_published_between_two_subscriptions_is_told_apart(callback):
    assert missing(callback, Queue(), 1, 2) == (0, 0)
    callback.pause()
    callback.pause()  # a subscription that heard nothing
    queue = Queue(0)
    assert missing(callback, queue) == (0, 0)
    queue.n_publishers = 1
    assert missing(callback, queue, 10, 11, 13) == (1, 7)
    assert missing(callback, queue, 14) == (0, 0)


def test_what_a_publisher_left_behind_that_is_gone_is_not_held_against_what_was_heard(
    callback,
):
    assert missing(callback, Queue(), 1, 2) == (0, 0)
    callback.pause()
    queue = Queue(0)
    assert missing(callback, queue, 9) == (0, 0)
    queue.n_publishers = 1
    assert missing(callback, queue, 12, 15) == (2, 9)


def test_a_middleware_without_numbers_tells_nothing(callback):
    assert missing(callback, Queue(), None, None) == (0, 0)
