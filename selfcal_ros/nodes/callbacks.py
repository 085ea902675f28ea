# SPDX-License-Identifier: Apache-2.0
"""Guarded callbacks of rclpy: none of them ends a node."""

import inspect
from collections.abc import Callable, Iterator
from functools import wraps
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.exceptions import InvalidHandle
from rclpy.node import Node
from rclpy.service import Service
from rclpy.subscription import Subscription
from rclpy.waitable import Waitable

from selfcal_ros.errors import as_answer
from selfcal_ros.nodes.sessions.health import Refusals

TASKS = ("execute", "_execute_goal", "_send_result_response")
"""Methods of events and actions of rclpy run as tasks by an executor."""


class WithInfo:
    """A callback that takes a message and its info, whatever its own signature.

    Parameters
    ----------
    call : callable
        Takes the message and its info.
    """

    __signature__ = inspect.signature(lambda message, info: None)

    def __init__(self, call: Callable[..., None]) -> None:
        self._call = call

    def __call__(self, *received: Any) -> None:
        """Take a message and its info."""
        self._call(*received)


class Numbered(WithInfo):
    """A callback that counts what the numbers of its publisher say is missing.

    The numbers of several publishers interleave: those of an only one are compared.

    Parameters
    ----------
    call : callable
        Takes the message, and its info if it is a `WithInfo`.
    lost : callable
        Takes the number of messages that are missing before this one.
    """

    def __init__(self, call: Callable[..., None], lost: Callable[[int], None]) -> None:
        super().__init__(call)
        self._lost = lost
        self._last: int | None = None
        self._publishers = 0  # at the last message: one that ended since is counted
        self.subscription: Subscription | None = None

    def __call__(self, *received: Any) -> None:
        """Take a message and its info."""
        # the events executor of rclpy 7.1 passes both as one pair
        message, info = received[0] if len(received) == 1 else received
        number = info["publication_sequence_number"]
        publishers = self._count()
        is_only_one = max(publishers, self._publishers) == 1
        self._publishers = publishers
        if is_only_one and self._last is not None and number > self._last + 1:
            self._lost(number - self._last - 1)
        # smaller: of another one, which may be gone
        is_next = self._last is None or number > self._last
        self._last = number if is_only_one and is_next else None
        if isinstance(self._call, WithInfo):
            self._call(message, info)
        else:
            self._call(message)

    def _count(self) -> int:
        """Return the number of publishers; 0 of a subscription that begins or has ended."""
        try:
            return self.subscription.get_publisher_count() if self.subscription else 0
        except InvalidHandle:
            return 0


class Guarded(Node):
    """A node that no callback ends: exceptions are counted in `refusals` and logged.

    The node's own callbacks are guarded where they are registered. The services of rclpy
    (parameters, lifecycle, types), its subscription to ``/clock`` and its tasks of actions and
    events are guarded when an executor asks for them. `running.spin` catches the rest.
    """

    refusals: Refusals

    def guarded(
        self, callback: Callable[..., Any], place: str = ""
    ) -> Callable[..., Any]:
        """Return `callback` with exceptions counted and logged instead of raised."""
        place = place or getattr(callback, "__name__", "callback").strip("_")
        if inspect.iscoroutinefunction(callback):

            @wraps(callback)
            async def task(*args: Any) -> Any:
                try:
                    return await callback(*args)
                except Exception as error:
                    self.refusals.add(place, error)
                    return None

            return task

        @wraps(callback)
        def call(*args: Any) -> Any:
            try:
                return callback(*args)
            except Exception as error:
                self.refusals.add(place, error)
                return None

        return call

    @property
    def services(self) -> Iterator[Service]:
        """The services, answering with a failure if their callback raises."""
        for service in super().services:
            if not hasattr(service.callback, "__wrapped__"):
                self._guard(service)
            yield service

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """The subscriptions, with those of rclpy guarded."""
        for item in super().subscriptions:
            if not any(
                hasattr(item.callback, name)
                for name in ("__wrapped__", "__signature__")
            ):
                item.callback = self.guarded(item.callback, item.topic)
            yield item

    @property
    def waitables(self) -> Iterator[Waitable]:
        """The actions and events; a task that raises ends the process with the events executor."""
        for item in super().waitables:
            for name in TASKS:
                task = getattr(item, name, None)
                if task is not None and not hasattr(task, "__wrapped__"):
                    setattr(item, name, self.guarded(task, type(item).__name__))
            yield item

    def _guard(self, service: Any) -> None:
        answer = service.callback
        place = service.srv_name.rpartition("/")[2]

        @wraps(answer)
        def call(request: Any, response: Any) -> Any:
            try:
                return answer(request, response)
            except Exception as error:
                self.refusals.add(place, error)
                return failed(request, response, error)

        service.callback = call
        service.send_response = self.guarded(service.send_response, place)


def failed(request: Any, response: Any, error: Exception) -> Any:
    """Return `response` with `error` as the reason, if its type has a field for it."""
    result = SetParametersResult(successful=False, reason=as_answer(error)[1])
    if isinstance(response, SetParameters.Response):
        response.results += [result] * (len(request.parameters) - len(response.results))
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = result
    return response
