# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all."""

import contextlib
import os
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from selfcal_ros.errors import InputError, first_line


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Yield a binary file that becomes `path` only if the block ends without an error.

    A file that exists keeps its permissions, a link stays a link, and what is no file (a pipe,
    /dev/null) is written into as it is.

    Raises
    ------
    InputError
        If the folder does not exist, or the file or folder cannot be written.
    """
    target = Path(path)
    try:
        if target.exists() and not target.is_file() and not target.is_dir():
            with target.open("wb") as file:
                yield file
        else:
            with _replacement(Path(os.path.realpath(target))) as file:
                yield file
    except OSError as error:
        raise InputError(str(target), f"cannot be written ({error.strerror or first_line(error)})",
                         "name a folder that exists and that you may write") from error


@contextlib.contextmanager
def _replacement(target: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file beside `target` that takes its place in one step, or vanishes."""
    fd, name = tempfile.mkstemp(prefix=".selfcal.", dir=target.parent)
    try:
        with os.fdopen(fd, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, _mode(target))
        os.replace(name, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        raise


def _mode(target: Path) -> int:
    """Return the permissions of a file that exists, or those that a new one gets."""
    if target.is_file():
        return stat.S_IMODE(target.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask
