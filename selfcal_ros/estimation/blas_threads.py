# SPDX-License-Identifier: Apache-2.0
"""One BLAS thread while a solution is computed: the same bits on any number of cores.

The dense blocks of the solver are small, so that threads of the linear algebra library cost more
than they bring, and their number changes the order of sums.
"""

import ctypes
import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import RLock

import numpy as np
import scipy

_NAMES = ("scipy_openblas_set_num_threads64_", "scipy_openblas_set_num_threads",
          "openblas_set_num_threads64_", "openblas_set_num_threads")
_lock = RLock()
_depth = 0


@functools.cache
def _controls() -> tuple[tuple[Callable, Callable], ...]:
    """Return (set, get) functions of the OpenBLAS libraries that numpy and scipy bring along."""
    found = []
    for package in (np, scipy):
        folder = Path(package.__file__).parents[1] / f"{package.__name__}.libs"
        for path in sorted(folder.glob("*openblas*")):
            library = ctypes.CDLL(str(path))
            for name in _NAMES:
                if hasattr(library, name):
                    found.append((getattr(library, name),
                                  getattr(library, name.replace("_set_", "_get_"))))
                    break
    return tuple(found)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run the block with one BLAS thread; other libraries than OpenBLAS keep their setting."""
    global _depth
    with _lock:
        _depth += 1
        before = [get() for _, get in _controls()] if _depth == 1 else []
        for set_threads, _ in _controls() if _depth == 1 else ():
            set_threads(1)
    try:
        yield
    finally:
        with _lock:
            _depth -= 1
            # the count goes back when the outermost block of any thread has ended
            _restore.extend(before)
            if _depth == 0:
                for (set_threads, _), number in zip(_controls(), _restore, strict=True):
                    set_threads(number)
                _restore.clear()


_restore: list[int] = []
