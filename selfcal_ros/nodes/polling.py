# SPDX-License-Identifier: Apache-2.0
"""Subscriptions that a node empties by the clock: a third of the cost of a callback a message."""

import inspect
import time
from collections.abc import Callable, Iterator

from rclpy.subscription import Subscription

from selfcal_ros.collection.settings.parameter import ManagedSettings
from selfcal_ros.nodes.managed import ManagedNode

MOST = 2000
"""Messages of a subscription that are taken at once; the others wait for the next time."""


class ByTheClock:
    """Takes the bytes of messages and the instants of their reception, ns; marks a subscription.

    Parameters
    ----------
    topic : str
        Name under which losses are counted.
    take : callable (data, received_ns)
        Takes a message.

    Attributes
    ----------
    n_missing : int
        Messages that were published between two that came, by the numbers that publishers give.
    """

    __signature__ = inspect.signature(lambda message: None)

    def __init__(self, topic: str, take: Callable[[bytes, int], None]) -> None:
        self.topic, self.take, self.n_missing = topic, take, 0
        self._last: int | None = None

    def __call__(self, message: bytes) -> None:
        """Take a message from an executor."""
        self.take(message, time.time_ns())

    def empty(self, subscription: Subscription, most: int) -> int:
        """Take what waits, up to `most`; return how many numbers of publication were left out."""
        gap = 0
        for _ in range(most):
            taken = subscription.handle.take_message(subscription.msg_type, True)
            if taken is None:
                break
            data, info = taken
            number = info["publication_sequence_number"]
            if number is not None and self._last is not None and number > self._last:
                gap += number - self._last - 1
            self._last = number
            self.take(data, info["received_timestamp"] or time.time_ns())
        return gap


class PollingNode[S: ManagedSettings](ManagedNode[S]):
    """A managed node whose subscriptions with `ByTheClock` are left to `poll` by executors."""

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions that an executor looks after."""
        return (item for item in super().subscriptions
                if not isinstance(item.callback, ByTheClock))

    def poll(self) -> None:
        """Take what has come on the other subscriptions, and count what was lost on the way."""
        for item in [*super().subscriptions]:
            if isinstance(item.callback, ByTheClock):
                self._empty(item, item.callback, MOST)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription; what waits on one that is polled is taken first.

        Its publishers have it acknowledged: nobody would send it again.
        """
        callback = subscription.callback
        if isinstance(callback, ByTheClock) and subscription in [*super().subscriptions]:
            self.guarded(self._empty, callback.topic)(
                subscription, callback, subscription.qos_profile.depth)
        return super().destroy_subscription(subscription)

    def _empty(self, item: Subscription, callback: ByTheClock, most: int) -> None:
        """Take what waits on a subscription.

        The middleware tells nothing of messages that were overwritten before they were taken.
        """
        with item.handle:
            gap = callback.empty(item, most)
        if gap and item.get_publisher_count() == 1:  # of several, numbers interleave
            callback.n_missing += gap
            untold = callback.n_missing - self.losses.counts[callback.topic]
            if untold > 0:
                self.losses.add(callback.topic, untold)
