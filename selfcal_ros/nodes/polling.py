# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that a node empties by the clock: a third of the cost of a callback a message."""

import inspect
import time
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.subscription import Subscription

from selfcal_ros.nodes.managed import ManagedNode

MOST = 2000
"""Messages of a subscription that are taken at once; the others wait for the next time."""


class ByTheClock:
    """Takes the bytes of a message and the instant of its reception, ns; marks a subscription."""

    __signature__ = inspect.signature(lambda message: None)

    def __init__(self, take: Callable[[bytes, int], None]) -> None:
        self.take = take

    def __call__(self, message: bytes) -> None:
        """Take a message from an executor."""
        self.take(message, time.time_ns())


class PollingNode(ManagedNode):
    """A managed node whose subscriptions with `ByTheClock` are left to `poll` by executors."""

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor looks after."""
        return (item for item in super().subscriptions
                if not isinstance(item.callback, ByTheClock))

    def poll(self) -> None:
        """Take what has come on the other subscriptions."""
        for item in [*super().subscriptions]:
            if isinstance(item.callback, ByTheClock):
                with item.handle:
                    _empty(item.handle, item.msg_type, item.callback.take)


def _empty(handle: Any, kind: type, take: Callable[[bytes, int], None]) -> None:
    for _ in range(MOST):
        taken = handle.take_message(kind, True)
        if taken is None:
            return
        data, info = taken
        take(data, info["received_timestamp"] or time.time_ns())
