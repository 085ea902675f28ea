# SPDX-License-Identifier: Apache-2.0
"""Atomic file output, and text in ASCII."""

import contextlib
import errno
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, TextIO

import numpy as np

from selfcal_ros import portable
from selfcal_ros.errors import InputError, first_line

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of a disk that has no room for a file."""
TEMPORARY = re.compile(r"\.selfcal\.[0-9a-f]{16}")
"""Names of unfinished files and folders, locked by their writer."""
_ASCII = {
    "µ": "u",
    "θ": "theta",
    "φ": "phi",
    "°": " deg",
    "±": "+/-",
    "–": "-",
    "×": "x",
    "σ": "sigma",
    "²": "^2",
    "−": "-",
    "∞": "inf",
}


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Yield a binary file that becomes `path` only if the block ends without an error.

    An existing file keeps its permissions, a link stays a link, and a target that is not a file
    (a pipe, /dev/null) is written directly.

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
        raise InputError(
            str(target),
            f"cannot be written ({error.strerror or first_line(error)})",
            "free some space or name another folder"
            if error.errno in FULL
            else "name an existing, writable folder",
        ) from error


@contextlib.contextmanager
def _replacement(target: Path) -> Iterator[BinaryIO]:
    """Yield a temporary file next to `target` that replaces it atomically, or is removed."""
    temporary, fd = _temporary(target.parent)
    try:
        with os.fdopen(fd, "wb") as file:
            yield file
            file.flush()
            os.fsync(fd)
            temporary.chmod(_mode(target))
            if portable.LOCKS:  # else it cannot be renamed while it is open
                _put(temporary, target)
        if not portable.LOCKS:
            _put(temporary, target)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


_NEW: set[str] = set()
"""Outputs that were not there when the command began, and must not replace a file."""


def has_content(path: str | os.PathLike) -> bool:
    """Return whether `path` is a file with content: an empty one has nothing to lose."""
    return os.path.isfile(path) and os.path.getsize(path) > 0


def refuse_existing(paths: Iterable[str | os.PathLike], *, force: bool) -> None:
    """Raise InputError if one of `paths` is a file with content, unless `force` allows it.

    Nor does this process then replace one that another writes in the meantime.
    """
    for path in paths:
        if not force and has_content(path):
            raise InputError(
                str(path),
                "the file exists",
                "name another file, or replace it with --force",
            )
        place = os.path.realpath(path)
        (_NEW.discard if force or os.path.exists(path) else _NEW.add)(place)


def _put(temporary: Path, target: Path) -> None:
    """Give a file its name; InputError if `target` is new, and was written meanwhile."""
    if str(target) in _NEW:
        _NEW.discard(str(target))
        try:
            os.link(temporary, target)
        except FileExistsError as error:
            raise InputError(
                str(target),
                "was written by another command meanwhile",
                "name another file, or replace it with --force",
            ) from error
        except OSError:  # a file system without links
            temporary.replace(target)
        else:
            temporary.unlink()
    else:
        temporary.replace(target)


@contextlib.contextmanager
def temporary_folder(parent: Path) -> Iterator[Path]:
    """Yield a hidden folder in `parent` that is removed when the block ends."""
    if not portable.LOCKS:  # then a folder cannot be opened, either
        with TemporaryDirectory(
            dir=parent, prefix=".selfcal.", ignore_cleanup_errors=True
        ) as name:
            yield Path(name)
        return
    temporary, fd = _temporary(parent, folder=True)
    try:
        yield temporary
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
        os.close(fd)


@contextlib.contextmanager
def creating(folder: Path) -> Iterator[None]:
    """Convert the errors of creating a folder to an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            str(folder),
            f"cannot be created ({error.strerror})",
            "name a writable folder",
        ) from error


def _temporary(parent: Path, *, folder: bool = False) -> tuple[Path, int]:
    """Create a temporary file or folder; return it and the descriptor of its lock."""
    sweep(parent)
    new = os.O_RDWR | os.O_CREAT | os.O_EXCL | portable.AT_ONCE
    while True:
        path = parent / f".selfcal.{secrets.token_hex(8)}"
        if folder:
            path.mkdir(0o700)
        fd = os.open(path, os.O_RDONLY if folder else new, 0o600)
        with contextlib.suppress(OSError):  # a file system without locks
            portable.lock(fd, wait=True)
        if path.exists():  # it was not removed before it was locked
            return path, fd
        os.close(fd)


@cache
def sweep(folder: Path) -> None:
    """Remove unfinished files of killed processes in a folder; once per process."""
    if not portable.LOCKS:  # nothing tells whether a writer still runs
        return
    with contextlib.suppress(OSError):
        for path in list(folder.iterdir()):
            if TEMPORARY.fullmatch(path.name) and (path.is_file() or path.is_dir()):
                with contextlib.suppress(OSError):
                    _remove_abandoned(path)


def _remove_abandoned(path: Path) -> None:
    """Remove a temporary file or folder; OSError if its writer still holds the lock."""
    fd = os.open(path, os.O_RDONLY | portable.NO_LINK)
    try:
        portable.lock(fd)
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    finally:
        os.close(fd)


def _mode(target: Path) -> int:
    """Return the permissions of an existing file, or those of a new one."""
    if target.is_file():
        return stat.S_IMODE(target.stat().st_mode)
    umask = os.umask(0)
    os.umask(umask)
    return 0o666 & ~umask


def sync_folder(folder: Path) -> None:
    """Synchronise a folder's entries to the disk."""
    fd = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def check_outputs(
    inputs: Iterable[str | os.PathLike | None],
    outputs: Iterable[str | os.PathLike | None],
) -> None:
    """Refuse outputs that cannot all be written, before writing the first.

    Raises
    ------
    InputError
        If an output is an input file (or in an input folder), two outputs are
        the same file, or an output is a folder or has no folder.
    """
    occupied = {os.path.realpath(name) for name in inputs if name}
    occupied |= {
        os.path.realpath(file)
        for folder in map(Path, list(occupied))
        if folder.is_dir()
        for file in folder.iterdir()
    }
    for name in outputs:
        if not name:
            continue
        target = Path(os.path.realpath(name))
        if target.exists() and not target.is_file() and not target.is_dir():
            continue  # a pipe or /dev/null accepts any number of outputs
        if target.is_dir():
            raise InputError(str(name), "it is a folder", "name a file")
        if str(target) in occupied:
            raise InputError(
                str(name), "would be overwritten", "name another output file"
            )
        if not target.parent.is_dir():
            raise InputError(
                str(name),
                "cannot be written (No such file or directory)",
                "name an existing, writable folder",
            )
        occupied.add(str(target))


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_file(path) as file:
        file.write(data)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write `text` as UTF-8 to `path` atomically."""
    write_bytes(path, utf8(text))


def utf8(text: str) -> bytes:
    """Return text as UTF-8; of a file name that is not, the bytes are escaped."""
    return text.encode(errors="backslashreplace")


def write_together(contents: Mapping[str | os.PathLike, bytes]) -> None:
    """Write several files atomically: all of them, or none where the disk holds only some.

    The last one is there first.

    Raises
    ------
    InputError
        As `atomic_file`, with the first file that cannot be written.
    """
    with contextlib.ExitStack() as replacements:
        for path, data in contents.items():
            file = replacements.enter_context(atomic_file(path))
            file.write(data)
            file.flush()
            if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                # a full disk is met before the first of them is replaced
                os.fsync(file.fileno())


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as strict JSON (no NaN) to `path` atomically."""
    write_text(path, json_text(value) + "\n")


def json_text(value: Any, depth: int = 0) -> str:
    """Return strict JSON (no NaN), a key or row on a line: lists of numbers are not broken."""
    inner = []
    ends = "[]"
    if isinstance(value, dict):
        ends = "{}"
        inner = [
            f"{json.dumps(str(key))}: {json_text(item, depth + 1)}"
            for key, item in value.items()
        ]
    elif isinstance(value, list | tuple) and any(
        isinstance(item, dict | list | tuple) for item in value
    ):
        inner = [json_text(item, depth + 1) for item in value]
    if not inner:
        return json.dumps(value, allow_nan=False)
    line = "\n" + " " * depth
    return f"{ends[0]}{line} {f',{line} '.join(inner)}{line}{ends[1]}"


def plain(value: Any) -> Any:
    """Return `value` as JSON types: arrays as lists, NaN and infinities as None."""
    if isinstance(value, np.generic):  # first, as a float64 is a float
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        finite_numbers = value.dtype.kind in "fiub" and bool(np.isfinite(value).all())
        return value.tolist() if finite_numbers else plain(value.tolist())
    return value


def filled_fields(record: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON types, those in it likewise.

    Without those whose default, None, they have: what is not there is left out.
    """
    return {
        field.name: _filled(value)
        for field in fields(record)
        if (value := getattr(record, field.name)) is not None
        or field.default is MISSING
    }


def _filled(value: Any) -> Any:
    if is_dataclass(value):
        return filled_fields(value)
    if isinstance(value, tuple):
        return [_filled(item) for item in value]
    return plain(value)


def to_ascii(text: str) -> str:
    """Return `text` in ASCII: known symbols spelled out, others replaced by a question mark."""
    return spelled_out(text).encode("ascii", "replace").decode()


def spelled_out(text: str) -> str:
    """Return `text` with µ, θ, ° and the like in ASCII; all else is left as it is."""
    return "".join(_ASCII.get(char, char) for char in text.replace(" °", "°"))


def can_print_symbols(stream: TextIO) -> bool:
    """Return whether the encoding of `stream` holds every symbol of a summary."""
    stream = getattr(stream, "rich_proxied_file", stream)  # while a bar is drawn
    try:
        "".join(_ASCII).encode(getattr(stream, "encoding", None) or "ascii")
    except (UnicodeEncodeError, LookupError):
        return False
    return True
