# SPDX-License-Identifier: Apache-2.0
"""Where results are read from: a RESULT.json, or a bag in which `selfcal embed` has put one.

`BAG/NAME` names one of several results in a bag. Attachments are found by the index at the end of
an MCAP file (https://mcap.dev/spec), without reading its messages.
"""

import hashlib
import itertools
import json
import os
import struct
import zlib
from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from selfcal_ros.errors import InputError
from selfcal_ros.files import parse_json, read_bytes
from selfcal_ros.model.result import SCHEMA, CalibrationResult, result_from_dict

MAGIC = b"\x89MCAP0\r\n"
ATTACHMENT, INDEX, FOOTER = 0x09, 0x0A, 0x02
TAIL = 9 + 20 + len(MAGIC)
"""Bytes of the footer, after which only the magic follows."""
LARGEST_SUMMARY, LARGEST_ATTACHMENT = 1 << 28, 1 << 32
"""Bytes."""
REMEDY = "record it again, or give an .mcap file that was closed, without file compression"


def read_result(path: str | os.PathLike, limit: int | None = None) -> CalibrationResult:
    """Return the result in a file or a bag, with its name and SHA-256 in `read_from`.

    Parameters
    ----------
    path : str or Path
        RESULT.json, BAG with one embedded result, or BAG/NAME.
    limit : int, optional
        Largest number of bytes, as for `selfcal_ros.files.read_bytes`.

    Raises
    ------
    InputError
        If there is no result.
    """
    name, raw = result_bytes(path, limit)
    result = result_from_dict(parse_json(raw, name, limit), name)
    return replace(result, read_from=(name, hashlib.sha256(raw).hexdigest()))


def result_bytes(path: str | os.PathLike, limit: int | None = None) -> tuple[str, bytes]:
    """Return name and content of a result; those of any other file that is no bag as they are."""
    found, name = bag_files(Path(path)), ""
    if not found and not os.path.exists(path):  # False too for a name that no file can have
        found, name = bag_files(Path(path).parent), Path(path).name
    if not found:
        return str(path), read_bytes(path, limit)
    bag = Path(path).parent if name else path
    files = attachments(found)
    kept = {key: raw for key, raw in files.items() if key == name or (not name and _is_result(raw))}
    if len(kept) != 1:
        names = ", ".join(sorted(kept or files)) or "nothing"
        raise InputError(str(path), f"{len(kept) or 'no'} results are embedded", (
            f"name one as {bag}/NAME: {names}" if kept else
            f"embed one with `selfcal embed`; embedded is {names}"))
    [(key, raw)] = kept.items()
    if limit is not None and len(raw) > limit:
        raise InputError(str(path), f"has {len(raw)} bytes, more than {limit}",
                         "name a smaller one")
    return f"{bag}/{key}", raw


def _is_result(raw: bytes) -> bool:
    try:
        data = json.loads(raw)
    except (ValueError, RecursionError):
        return False
    return isinstance(data, dict) and data.get("schema") == SCHEMA


def bag_files(path: Path) -> list[Path]:
    """Return the MCAP files of a bag; none if it is something else. Opens regular files only."""
    try:
        if path.is_dir():
            return sorted(file for file in path.glob("*.mcap") if file.is_file())
        if path.is_file():
            with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as file:
                return [path] * (file.read(len(MAGIC)) == MAGIC)  # None: it would have to wait
    except (OSError, ValueError):
        pass  # whoever reads it says why not
    return []


def attachments(files: list[Path]) -> dict[str, bytes]:
    """Return the attachments of MCAP files by name; further ones of a name as "NAME (2)".

    Raises
    ------
    InputError
        If a file has no index, or an attachment is damaged.
    """
    out: dict[str, bytes] = {}
    for path in files:
        with path.open("rb") as file:
            text = summary_of(file, path)[1]
            try:
                for body in (body for opcode, body in records_in(text, path) if opcode == INDEX):
                    raw = _attachment(file, *struct.unpack_from("<QQ", body))
                    out[unused(_text(raw, 16)[0], out)] = _content(raw)
            except (struct.error, ValueError) as error:
                raise InputError(str(path), "an attachment is damaged", "embed the file again into "
                                 "a copy of the recording") from error
    return out


def unused(name: str, taken: Container[str]) -> str:
    """Return a name, with a number behind it if it is taken."""
    numbered = (f"{name} ({number})" for number in itertools.count(2))
    return next(one for one in itertools.chain([name], numbered) if one not in taken)


def _attachment(file: BinaryIO, place: int, count: int) -> bytes:
    """Return the body of an attachment; ValueError unless its checksum is correct."""
    file.seek(min(place, file.seek(0, os.SEEK_END)))
    raw = file.read(min(count, LARGEST_ATTACHMENT))
    if len(raw) < max(count, 10) or raw[0] != ATTACHMENT or int.from_bytes(
            raw[-4:], "little") not in (0, zlib.crc32(raw[9:-4])):  # 0 = not computed
        raise ValueError("damaged")
    return raw[9:]


def summary_of(file: BinaryIO, path: Path) -> tuple[int, bytes]:
    """Return beginning and content of the summary of an MCAP file.

    Raises
    ------
    InputError
        If it has none, or a damaged one.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - TAIL, 0))
    tail = file.read()
    whole = len(tail) == TAIL and tail[0] == FOOTER and tail.endswith(MAGIC)
    start, _, crc = struct.unpack_from("<QQI", tail, 9) if whole else (0, 0, 0)
    if not 0 < start <= size - TAIL <= start + LARGEST_SUMMARY:
        raise InputError(str(path), "not an MCAP file with a summary", REMEDY)
    file.seek(start)
    text = file.read(size - TAIL - start)
    if crc not in (0, zlib.crc32(tail[:25], zlib.crc32(text))):  # 0 = not computed
        raise InputError(str(path), "its summary is damaged", REMEDY)
    return start, text


def records_in(text: bytes, path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and body of the records of a summary; InputError if one is not complete."""
    at = 0
    while at + 9 <= len(text):
        opcode, length = struct.unpack_from("<BQ", text, at)
        body = text[at + 9:at + 9 + length]
        if len(body) < length:
            raise InputError(str(path), "its summary is damaged", REMEDY)
        yield opcode, body
        at += 9 + length


def _text(raw: bytes, at: int) -> tuple[str, int]:
    """Return the text at a place of a record, and the place after it."""
    [length] = struct.unpack_from("<I", raw, at)
    return raw[at + 4:at + 4 + length].decode(), at + 4 + length


def _content(raw: bytes) -> bytes:
    """Return the content of an attachment: after two times, name and media type."""
    at = _text(raw, _text(raw, 16)[1])[1]
    [length] = struct.unpack_from("<Q", raw, at)
    return raw[at + 8:at + 8 + length]
