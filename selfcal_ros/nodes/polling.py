# SPDX-License-Identifier: Apache-2.0
"""Subscriptions polled by a node: a third of the cost of one callback per message."""

import inspect
import time
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rclpy.subscription import Subscription
from rclpy.timer import Timer

from selfcal_ros.nodes.managed import ManagedNode
from selfcal_ros.settings.parameter import ManagedSettings

MOST = 2000
"""Largest number of messages taken per poll; the others wait."""


def wake(timer: Timer) -> None:
    """Start a timer unless it is running."""
    if timer.is_canceled():
        timer.reset()


class LostMessages(NamedTuple):
    """Missing messages: lost in transport, or published while not subscribed."""

    lost: int
    unheard: int


class ByTheClock:
    """Take the bytes of messages and the instants of their reception, ns, from a subscription.

    It outlives its subscription: messages published between two subscriptions are known from the
    sequence numbers of a publisher. The numbers of several publishers interleave and are useless.

    Parameters
    ----------
    topic : str
        Name for the counts of losses.
    take : callable (data, received_ns)
        Takes a message.
    wake : callable, optional
        Called when a message has arrived; without it executors ignore the subscription.
    """

    __signature__ = inspect.signature(lambda message, info: None)  # rclpy counts them
    counts_losses = True

    def __init__(
        self,
        topic: str,
        take: Callable[[bytes, int], None],
        wake: Callable[[], None] | None = None,
    ) -> None:
        self.topic, self.take, self.wake = topic, take, wake
        self._numbers: list[
            int | None
        ] = []  # of messages taken since the last check for gaps
        self._last: int | None = None
        # the last number of the subscription before this one
        self._before: int | None = None
        self._n_publishers = 0

    def __call__(self, *received: Any) -> None:
        """Take a message from an executor."""
        # the events executor of rclpy 7.1 passes message and info as one pair
        self._take(*(received[0] if len(received) == 1 else received))
        if self.wake is not None:
            self.wake()

    def empty(self, subscription: Subscription, most: int) -> LostMessages:
        """Take waiting messages, up to `most`; return the number of skipped sequence numbers."""
        is_empty = False
        for _ in range(most):
            message_and_info = subscription.handle.take_message(
                subscription.msg_type, True
            )
            if message_and_info is None:
                is_empty = True
                break
            self._take(*message_and_info)
        numbers = self._numbers
        self._numbers = []
        return self._missing(numbers, subscription.get_publisher_count(), is_empty)

    def _take(self, data: bytes, info: dict[str, int]) -> None:
        self._numbers.append(info["publication_sequence_number"])
        self.take(data, info["received_timestamp"] or time.time_ns())

    def _missing(
        self, numbers: list[int | None], n_publishers: int, is_empty: bool
    ) -> LostMessages:
        """Return the gaps in the sequence numbers, if they are of one publisher.

        This is the case if there was one publisher now and at the previous check: messages of a
        second one that is gone have been taken by then, unless the queue was not emptied.
        """
        most = max(n_publishers, self._n_publishers)
        self._n_publishers = n_publishers if is_empty else most
        lost = unheard = 0
        for number in (n for n in numbers if n is not None and most == 1):
            if self._last is not None:
                lost += max(number - self._last - 1, 0)
            elif self._before is not None:
                unheard = max(number - self._before - 1, 0)
            self._last, self._before = number, None
        if most > 1 or n_publishers == 0:
            self._last = None
        return LostMessages(lost, unheard)

    def pause(self) -> None:
        """Record the end of the subscription."""
        self._before = self._before if self._last is None else self._last
        self._last, self._n_publishers = None, 0


class PollingNode[S: ManagedSettings](ManagedNode[S]):
    """A managed node whose subscriptions with `ByTheClock` are handled by `poll`, not by executors.

    Those that wake the node are handled by both.
    """

    def at_need(self, seconds: float, callback: Callable[[], None]) -> Timer:
        """Return a timer that is stopped until `wake`."""
        timer = self.every(seconds, callback)
        timer.cancel()
        return timer

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions handled by an executor."""
        return (
            item
            for item in super().subscriptions
            if not isinstance(item.callback, ByTheClock) or item.callback.wake
        )

    def poll(self) -> None:
        """Take the messages of these subscriptions, and count losses in transport."""
        for item in [*super().subscriptions]:
            if isinstance(item.callback, ByTheClock):
                self._empty(item, item.callback, MOST)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Destroy a subscription; waiting messages of a polled one are taken first.

        They have been acknowledged to their publishers and would not be sent again.
        """
        callback = subscription.callback
        if isinstance(callback, ByTheClock) and subscription in [
            *super().subscriptions
        ]:
            self.guarded(self._empty, callback.topic)(
                subscription, callback, subscription.qos_profile.depth
            )
            callback.pause()
        return super().destroy_subscription(subscription)

    def _empty(self, item: Subscription, callback: ByTheClock, most: int) -> None:
        """Take the waiting messages of a subscription.

        The middleware does not report messages that were overwritten before they were taken.
        """
        with item.handle:
            missing = callback.empty(item, most)
        if missing.lost:
            self.losses.add(callback.topic, missing.lost, told_by="numbers")
        if missing.unheard:
            self.losses.add_unheard(callback.topic, missing.unheard)
