# SPDX-License-Identifier: Apache-2.0
"""Answers of services: success or the error, at once or later."""

import inspect
from collections.abc import Callable
from typing import Any

from selfcal_ros.errors import SelfcalError, as_answer, printable
from selfcal_ros.nodes.callbacks import Guarded


def answered(
    response: Any, answer: Callable[[], str], refuse: Callable[[str, Exception], None]
) -> Any:
    """Return `response` with the result of `answer` as its message, or with its error.

    A foreign error is passed to `refuse` as well.
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
    """Placeholder for a response that is not known yet."""

    def __init__(self) -> None:
        self._response: Any = None
        self._send: Callable[[Any], None] | None = None

    def give(self, response: Any) -> None:
        """Take the response; it is sent as soon as possible."""
        self._response = response
        self._meet()

    def ask(self, send: Callable[[Any], None]) -> None:
        """Take the function that sends the response."""
        self._send = send
        self._meet()

    def _meet(self) -> None:
        if self._response is not None and self._send is not None:
            self._send(self._response)


def answering_later(service: Any) -> Any:
    """Return a service of rclpy whose callback may return a `Later`.

    The executors of rclpy 7.1 pass the return value of a callback to `send_response` of the
    service, with the header of the request.
    """
    send = service.send_response

    def send_response(response: Any, header: Any) -> None:
        if isinstance(response, Later):
            response.ask(lambda answer: send(answer, header))
        else:
            send(response, header)

    service.send_response = send_response
    return service


class Answering(Guarded):
    """A node whose services always answer with success and message.

    `own` registers a service for destruction.
    """

    own: Callable[[Any, Callable[[Any], Any]], Any]

    def service(self, kind: type, name: str, answer: Callable[..., str]) -> Any:
        """Offer a service whose response is filled from `answer` (request), or from its error.

        `answer` may take the response as well, for fields other than success and message.
        """
        parameters = inspect.signature(answer).parameters.values()
        arguments = sum(
            parameter.default is parameter.empty for parameter in parameters
        )

        def call(request: Any, response: Any) -> Any:
            return answered(
                response,
                lambda: answer(*(request, response)[:arguments]),
                self.refusals.add,
            )

        return self.own(self.create_service(kind, name, call), self.destroy_service)

    def service_later(
        self,
        kind: type,
        name: str,
        answer: Callable[[Any, Any], str],
        when: Callable[[Callable[[], None]], None],
    ) -> Any:
        """Offer a service that answers like `service`, possibly later.

        `when` takes the function that gives the answer, and calls it once, at once or later, in the
        thread of the executor.
        """

        def call(request: Any, response: Any) -> Later:
            later = Later()
            when(
                self.guarded(
                    lambda: later.give(
                        answered(
                            response,
                            lambda: answer(request, response),
                            self.refusals.add,
                        )
                    ),
                    name,
                )
            )
            return later

        return self.own(
            answering_later(self.create_service(kind, name, call)), self.destroy_service
        )
