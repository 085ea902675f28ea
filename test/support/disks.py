# SPDX-License-Identifier: Apache-2.0
"""Disks that are full."""

import contextlib
import resource
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def files_no_larger_than(size: int) -> Iterator[None]:
    """Let the files of this process grow no larger than `size` bytes, as if the disk were full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    writes_none = sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # Python keeps a module's file that was cut
    try:
        yield
    finally:
        sys.dont_write_bytecode = writes_none
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
