# SPDX-License-Identifier: Apache-2.0
"""How services answer: success or the error in the response, at once or once it is known."""

from collections.abc import Callable
from typing import Any

from selfcal_ros.errors import SelfcalError, as_answer, printable


def answered(response: Any, answer: Callable[[], str],
             refuse: Callable[[str, Exception], None]) -> Any:
    """Return `response` with what `answer` returns as its message, or with the error it raises.

    An error that is none of ours is given to `refuse` as well.
    """
    try:
        response.message = printable(answer())
        response.success = True
    except Exception as error:
        code, response.message = as_answer(error)
        response.success = False
        if not isinstance(error, SelfcalError):
            refuse("service", error)
        if hasattr(response, "error_code"):
            response.error_code = int(code)
    return response


class Later:
    """Stands for a response that is not known yet."""

    def __init__(self) -> None:
        self._response: Any = None
        self._send: Callable[[Any], None] | None = None

    def give(self, response: Any) -> None:
        """Take the response; it is sent as soon as it may be."""
        self._response = response
        self._meet()

    def ask(self, send: Callable[[Any], None]) -> None:
        """Take the way to whoever asked."""
        self._send = send
        self._meet()

    def _meet(self) -> None:
        if self._response is not None and self._send is not None:
            self._send(self._response)


def answering_later(service: Any) -> Any:
    """Return a service of rclpy whose callback may return a `Later`.

    The executors of rclpy 7.1 hand what a callback returns to `send_response` of the service, with
    the header of the request.
    """
    send = service.send_response

    def send_response(response: Any, header: Any) -> None:
        if isinstance(response, Later):
            response.ask(lambda known: send(known, header))
        else:
            send(response, header)
    service.send_response = send_response
    return service
