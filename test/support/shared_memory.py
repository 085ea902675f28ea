# SPDX-License-Identifier: Apache-2.0
"""Shared memory that killed nodes leave.

Fast DDS keeps a file for each participant and each port of a domain, locked by its process. Domains
are used again, and a node that finds the port of one that was killed while it wrote waits for the
mutex in it.
"""

import contextlib
import fcntl
from pathlib import Path

SHARED = Path("/dev/shm")
OLD_S = 60.0
"""Age from which a lock that nobody holds is not one that is being made."""


def remove_stale(folder: Path, before_s: float) -> None:
    """Remove segments made before an instant whose lock nobody holds.

    A younger lock is not even tried: its owner, who takes it now, would find it taken.
    """
    for lock in folder.glob("fastrtps_*_el"):
        with contextlib.suppress(OSError):
            if lock.stat().st_mtime >= before_s:
                continue
            with lock.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                segment = lock.name.removesuffix("_el")
                for name in (segment, f"sem.{segment}_mutex", lock.name):
                    (folder / name).unlink(missing_ok=True)
