# SPDX-License-Identifier: Apache-2.0
"""Waiting for what another process does, without taking its processor."""

import threading
import time
from collections.abc import Callable
from typing import Any

PATIENCE_S = 300.0
_NEVER = threading.Event()


def wait_until(condition: Callable[[], Any], what: str) -> None:
    """Look every 20 ms whether `condition` holds; fail when patience ends."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        _NEVER.wait(0.02)
