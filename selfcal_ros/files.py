# SPDX-License-Identifier: Apache-2.0
"""Files: atomic writing, digests, and JSON and YAML whose errors name file and place."""

import contextlib
import hashlib
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import yaml

from selfcal_ros.errors import InputError


@contextlib.contextmanager
def atomic_file(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Yield a binary file that becomes `path` only if the block ends without an error.

    Raises
    ------
    InputError
        If the folder does not exist or cannot be written.
    """
    target = Path(path)
    try:
        fd, name = tempfile.mkstemp(prefix=f".{target.name}.", dir=target.parent)
    except OSError as error:
        raise InputError(str(target), f"cannot be written ({error.strerror})",
                         "name a folder that exists and that you may write") from error
    try:
        with os.fdopen(fd, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, target)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name)
        raise


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Write `data` to `path` atomically."""
    with atomic_file(path) as file:
        file.write(data)


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write `text` as UTF-8 to `path` atomically."""
    write_bytes(path, text.encode())


def write_json(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as strict JSON (no NaN) to `path` atomically."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_bytes(path: str | os.PathLike) -> bytes:
    """Return the content of `path`.

    Raises
    ------
    InputError
        If the file is missing or cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(str(path), "no such file", "check the path") from error
    except OSError as error:
        raise InputError(str(path), f"cannot be read ({error.strerror})",
                         "name a readable file") from error


def read_text(path: str | os.PathLike) -> str:
    """Return the UTF-8 text of `path`; InputError names the byte that is not UTF-8."""
    try:
        return read_bytes(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start}", "not UTF-8 text",
                         "save the file as UTF-8") from error


def read_json(path: str | os.PathLike) -> Any:
    """Return the JSON value in `path`; InputError names line and column of a fault."""
    try:
        return json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}:{error.lineno}:{error.colno}", f"not JSON ({error.msg})",
                         "give a file that `selfcal` wrote") from error


def read_yaml(path: str | os.PathLike) -> Any:
    """Return the YAML value in `path`; InputError names line and column of a fault."""
    try:
        return yaml.safe_load(read_text(path))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise InputError(place, f"not YAML ({error.problem})", "mend the line") from error
    except yaml.YAMLError as error:
        raise InputError(str(path), "not YAML", "give a YAML text file") from error


def sha256_of(path: str | os.PathLike) -> str:
    """Return the SHA-256 of a file, or of a folder's files in the order of their names."""
    root = Path(path)
    digest = hashlib.sha256()
    files = sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
    for file in files:
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
