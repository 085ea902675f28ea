# SPDX-License-Identifier: Apache-2.0
"""Callbacks as rclpy, which counts their parameters, has to see them."""

import inspect
from collections.abc import Callable
from typing import Any


class WithInfo:
    """A callback that takes a message and its info, whatever parameters it shows itself.

    Parameters
    ----------
    call : callable
        Takes what arrives.
    """

    __signature__ = inspect.signature(lambda message, info: None)

    def __init__(self, call: Callable[..., None]) -> None:
        self._call = call

    def __call__(self, *received: Any) -> None:
        """Take a message and its info."""
        self._call(*received)
