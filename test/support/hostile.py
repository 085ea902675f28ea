# SPDX-License-Identifier: Apache-2.0
"""What no well-behaved publisher sends: each field of a message at its worst, and torn bytes."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message, serialize_message

FLOATS = (math.nan, math.inf, -math.inf, -1.0, 0.0, 4.2e-3, 1e17, 1.7e308, 5e-324)
TEXTS = (
    "",
    "no such",
    "../../outside",
    "/dev/zero",
    "\x1b[2J\x1b]0;title\x07",
    "\u202e\n\t\0",
    "-1",
    "1e400",
    "\u00b2",
    "nan",
    "9" * 5000,
    "x" * 100_000,
)
WIDTHS = {
    "int8": 8,
    "uint8": 8,
    "octet": 8,
    "int32": 32,
    "uint32": 32,
    "int64": 64,
    "uint64": 64,
}
HEAD = 12
"""Bytes of the encapsulation and the stamp behind it."""
LONG = 11_000
"""Elements of an array that is too long: there are no more than 10,000 marks."""


def worst(message: Any) -> Iterator[tuple[str, Any]]:
    """Yield (what was done, message): copies of a message with one field at its worst."""
    data = serialize_message(message)
    for path, values in _fields(message, ()):
        for value in values:
            spoilt = deserialize_message(data, type(message))  # a tenth of a deepcopy
            _set(spoilt, path, value)
            yield ".".join(map(str, path)), spoilt


def _fields(message: Any, path: tuple) -> Iterator[tuple[tuple, list]]:
    """Yield where a field is, and what it may be at its worst."""
    for name, kind in message.get_fields_and_field_types().items():
        value, here = getattr(message, name), (*path, name)
        element = kind.removeprefix("sequence<").removesuffix(">")
        if hasattr(value, "get_fields_and_field_types"):
            yield from _fields(value, here)
        elif element == kind:
            yield here, _values(kind, value)
        elif "/" in element:
            yield here, [[]]
            for index, item in enumerate(value):
                yield from _fields(item, (*here, index))
        else:
            yield here, list(_arrays(element, list(value)))


def _values(kind: str, value: Any) -> list:
    if kind == "boolean":
        return [not value]
    if kind == "string":
        return list(TEXTS)
    if kind in ("double", "float"):
        return [
            v
            for v in FLOATS
            if kind == "double" or not math.isfinite(v) or abs(v) < 1e30
        ]
    bits = WIDTHS[kind]
    if kind == "octet":
        return [b"\0", b"\xff"]
    whole = (
        [0, 2**bits - 1]
        if kind[0] == "u"
        else [0, -1, -(2 ** (bits - 1)), 2 ** (bits - 1) - 1]
    )
    return [*whole, 2, 4001] if bits > 8 else whole


def _arrays(element: str, value: list) -> Iterator[list]:
    """Yield an array shorter, longer, empty, enormous, and with each of the worst elements."""
    first = value[0] if value else _values(element, False)[0]
    yield from ([], value[:-1], [*value, first], [first] * LONG)
    for spoilt in _values(element, first):
        yield [spoilt, *value[1:]]


def _set(message: Any, path: tuple, value: Any) -> None:
    *way, last = path
    for step in way:
        message = message[step] if isinstance(step, int) else getattr(message, step)
    setattr(message, last, value)


def torn(message: Any, seed: int, number: int = 30) -> Iterator[bytes]:
    """Yield the bytes of a message cut off, with lengths of 2^32 - 1, with bytes at random.

    The stamp is left, where it is not cut off: a later one would be right.
    """
    data = bytes(serialize_message(message))
    rng = np.random.default_rng(seed)
    cuts = {0, 1, 3, 4, 5, 8, 12, 16, 17, *map(int, rng.integers(0, len(data), number))}
    for cut in sorted(cuts):
        yield data[:cut]
    for at in range(HEAD, min(len(data) - 4, 4 * number), 4):
        yield data[:at] + b"\xff\xff\xff\xff" + data[at + 4 :]
    for _ in range(number):
        spoilt = bytearray(data)
        for at in rng.integers(HEAD, len(data), 3):
            spoilt[at] = rng.integers(256)
        yield bytes(spoilt)
