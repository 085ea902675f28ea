# SPDX-License-Identifier: Apache-2.0
"""How services answer: success or the error in the response, at once or once it is known."""

import inspect
from collections.abc import Callable
from typing import Any

from selfcal_ros.errors import SelfcalError, as_answer, printable
from selfcal_ros.nodes.callbacks import Guarded


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


class Answering(Guarded):
    """A node whose services answer with success and message, whatever happens.

    `own` notes how to take a service down.
    """

    own: Callable[[Any, Callable[[Any], Any]], Any]

    def service(self, kind: type, name: str, answer: Callable[..., str]) -> Any:
        """Offer a service whose response is filled from `answer` (request), or from its error.

        `answer` may take the response as well, for fields beside success and message.
        """
        parameters = inspect.signature(answer).parameters.values()
        arguments = sum(parameter.default is parameter.empty for parameter in parameters)

        def call(request: Any, response: Any) -> Any:
            return answered(response, lambda: answer(*(request, response)[:arguments]),
                            self.refusals.add)
        return self.own(self.create_service(kind, name, call), self.destroy_service)

    def service_later(self, kind: type, name: str, answer: Callable[[Any, Any], str],
                      when: Callable[[Callable[[], None]], None]) -> Any:
        """Offer a service that answers as `service` does, but not before its time.

        `when` takes what gives the answer, and calls it once, at once or later, in the thread of
        the executor.
        """
        def call(request: Any, response: Any) -> Later:
            later = Later()
            when(self.guarded(lambda: later.give(answered(
                response, lambda: answer(request, response), self.refusals.add)), name))
            return later
        return self.own(answering_later(self.create_service(kind, name, call)),
                        self.destroy_service)
