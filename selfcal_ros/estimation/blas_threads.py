# SPDX-License-Identifier: Apache-2.0
"""One BLAS thread while a solution is computed: the same bits on any number of cores.

The dense blocks of the solver are small: threads of the linear algebra library cost more than
they gain, and their number changes the order of sums.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from threading import RLock
from typing import Any

import numpy  # noqa: F401  (its library must be loaded before it can be found)
import scipy.linalg  # noqa: F401  (so must scipy's own)
from threadpoolctl import ThreadpoolController

_lock = RLock()
_limits: list[Any] = []
_depth = 0


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one BLAS thread.

    The number is restored when the outermost block of any thread of this process has ended.
    """
    global _depth
    with _lock:
        _depth += 1
        if _depth == 1:
            _limits.append(_controller().limit(limits=1, user_api="blas"))
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            if _depth == 0:
                _limits.pop().restore_original_limits()
