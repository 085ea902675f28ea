# SPDX-License-Identifier: Apache-2.0
"""Files: digests, and JSON and YAML with errors that name file and line."""

import contextlib
import csv
import errno
import hashlib
import json
import math
import os
import re
import stat
from collections.abc import Collection, Iterable
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from functools import cache
from numbers import Integral
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Literal, cast, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.resolver import Resolver

from selfcal_ros.errors import InputError, first_line, known_are, mend_of
from selfcal_ros.outputs import write_text
from selfcal_ros.portable import AT_ONCE

MAX_YAML_BYTES = 4 << 20
MAX_YAML_NODES = 50_000
"""Largest number of values in a YAML file, aliases expanded; a plan of 1,000 views
has 17,000, which take 0.2 s."""
MAX_JSON_VALUES = 1_000_000
"""Largest number of values in a JSON file read for a request: they take 0.8 s."""
EXPLAINED = 1 << 16
"""Characters of a faulty document that are read again for a better message."""
WHOLE_LIMIT = 1 << 63
"""Whole numbers in files must fit into 64 bits."""


class _Strict(Composer, SafeConstructor, Resolver):
    """Construct values from YAML events; floats as in YAML 1.2 and rcl: 5e-4, 1.0e3, -.5.

    Refuses a duplicate key, a whole number beyond 64 bits, a number that YAML 1.1
    and 1.2 read differently, and a document of more than `MAX_YAML_NODES` values,
    aliases expanded.
    """

    _n_nodes = 0
    peek_event: Any

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node and those below it, up to the limit of their number."""
        self._n_nodes += 1
        if self._n_nodes > MAX_YAML_NODES:
            raise yaml.composer.ComposerError(
                None,
                None,
                f"more than {MAX_YAML_NODES} values",
                self.peek_event().start_mark,
            )
        return super().compose_node(parent, index)

    def get_single_node(self) -> yaml.Node | None:
        """Compose the document, and check its size with aliases expanded."""
        node = super().get_single_node()
        if node is not None and _yaml_size(node, {}) > MAX_YAML_NODES:
            raise yaml.composer.ComposerError(
                None,
                None,
                f"its aliases expand to more than {MAX_YAML_NODES} values",
                node.start_mark,
            )
        return node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the value of a node whose text is valid for its tag: `!!int ''` is not."""
        try:
            return super().construct_object(node, deep)
        except ValueError as error:  # an invalid date, a number too long
            raise yaml.constructor.ConstructorError(
                None, None, first_line(error), node.start_mark
            ) from error
        except (LookupError, AttributeError) as error:
            raise yaml.constructor.ConstructorError(
                None,
                None,
                f"not a value of the type {node.tag.rpartition(':')[2]}",
                node.start_mark,
            ) from error

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        """Return the mapping of a node; refuse duplicate keys."""
        keys = set()
        for key, _ in node.value:
            if (
                isinstance(key, yaml.ScalarNode)
                and key.tag != "tag:yaml.org,2002:merge"
            ):
                if (key.tag, key.value) in keys:
                    raise yaml.constructor.ConstructorError(
                        None,
                        None,
                        f"the key '{key.value}' is given twice",
                        key.start_mark,
                    )
                keys.add((key.tag, key.value))
        return super().construct_mapping(node, deep)

    def whole_number(self, node: yaml.ScalarNode) -> int:
        """Return a whole number that fits into 64 bits."""
        _refuse_two_readings(node)
        return _whole_number(
            self.construct_yaml_int(node) if len(node.value) < 70 else node.value
        )

    def real_number(self, node: yaml.ScalarNode) -> float:
        """Return a number that YAML 1.1 and 1.2 read alike."""
        _refuse_two_readings(node)
        return self.construct_yaml_float(node)

    yaml_constructors: ClassVar = SafeConstructor.yaml_constructors | {
        "tag:yaml.org,2002:int": whole_number,
        "tag:yaml.org,2002:float": real_number,
    }


class YamlLoader(_Strict, yaml.SafeLoader):
    """Pure Python loader, with the messages for the user."""


LOADERS: list[type[yaml.SafeLoader] | type[yaml.CSafeLoader]] = [YamlLoader]
"""Loaders: the first is the fastest, the last has the best messages."""

if yaml.__with_libyaml__:

    class FastYamlLoader(_Strict, yaml.CSafeLoader):
        """Loader with libyaml's events; values are constructed in Python.

        Parameters
        ----------
        text : str
            One document.
        """

        def __init__(self, text: str) -> None:
            yaml.CSafeLoader.__init__(self, text)
            Composer.__init__(self)

    LOADERS.insert(0, FastYamlLoader)


def _yaml_size(node: yaml.Node, size_of_node: dict[int, int]) -> int:
    """Return the number of values below a node; infinite for a node that contains itself."""
    if id(node) not in size_of_node:
        size_of_node[id(node)] = MAX_YAML_NODES + 1  # until known
        children = (
            [item for pair in node.value for item in pair]
            if isinstance(node, yaml.MappingNode)
            else node.value
            if isinstance(node, yaml.SequenceNode)
            else ()
        )
        size_of_node[id(node)] = 1 + sum(
            _yaml_size(child, size_of_node) for child in children
        )
    return size_of_node[id(node)]


TWO_READINGS = re.compile(r"[-+]?0[0-9]+|.*[_:].*")
"""Numbers of YAML 1.1 alone: 045 is 37, 45:30 is 2730, 1_000 is 1000."""


def _refuse_two_readings(node: yaml.ScalarNode) -> None:
    """Raise ConstructorError for a number that YAML 1.1 and 1.2 read differently."""
    if TWO_READINGS.fullmatch(node.value):
        raise yaml.constructor.ConstructorError(
            None,
            None,
            f"programs differ on what number {node.value[:20]} is: write it without"
            " leading 0, _ and :, or a text in quotes",
            node.start_mark,
        )


def _whole_number(value: int | str) -> int:
    """Return a whole number; ValueError, without its digits, beyond 64 bits."""
    if isinstance(value, str) and len(value) < 25:
        value = int(value)
    if isinstance(value, str) or not -WHOLE_LIMIT <= value < WHOLE_LIMIT:
        raise ValueError("a whole number beyond 64 bits")
    return value


class YamlDumper(yaml.SafeDumper):
    """Dumper for `read_yaml`: a string that looks like such a float is quoted."""


FLOATS = re.compile(
    r"^[-+]?(?:(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)[eE][-+]?[0-9]+|\.[0-9]+)$"
)
"""Floats that YAML 1.1 reads as strings, lacking a dot or the sign of the exponent."""

for _class in (*LOADERS, YamlDumper):
    _class.add_implicit_resolver(
        "tag:yaml.org,2002:float", FLOATS, list("-+.0123456789")
    )


class AsWritten(YamlLoader):
    """Loader that keeps scalars as the text in the file: 01067 is not octal, NO not false."""


AsWritten.yaml_implicit_resolvers = {
    first: [
        (tag, pattern)
        for tag, pattern in found
        if tag.rpartition(":")[2] not in ("bool", "int", "float", "timestamp")
    ]
    for first, found in YamlLoader.yaml_implicit_resolvers.items()
}


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or first_line(error)


def read_bytes(path: str | os.PathLike, limit: int | None = None) -> bytes:
    """Return the content of `path`; with `limit`, of a regular file of at most that many bytes.

    With a limit nothing can block: no pipe, no device, no file of the kernel.

    Raises
    ------
    InputError
        If the file is missing or cannot be read.
    """
    try:
        if limit is not None:
            return _regular(path, limit)
        if Path(path).is_char_device():
            raise InputError(str(path), "is a device", "name a file")
        return Path(path).read_bytes()
    except FileNotFoundError as error:
        raise InputError(str(path), "no such file", "check the path") from error
    except (OSError, ValueError) as error:
        raise InputError(
            str(path), f"cannot be read ({_reason(error)})", "name a readable file"
        ) from error


def _regular(path: str | os.PathLike, limit: int) -> bytes:
    """Return the content of a regular file, up to its size when opened."""
    if stat.S_ISDIR(os.stat(path).st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if stat.S_ISREG(os.stat(path).st_mode):  # opening a device may have side effects
        with open(
            path, "rb", opener=lambda name, flags: os.open(name, flags | AT_ONCE)
        ) as file:
            status = os.fstat(file.fileno())
            if stat.S_ISREG(status.st_mode) and status.st_size <= limit:
                return file.read(status.st_size)
            if stat.S_ISREG(status.st_mode):
                raise InputError(
                    str(path),
                    f"has {status.st_size} bytes, more than {limit}",
                    "name a smaller file",
                )
    raise InputError(str(path), "is not a regular file", "name a file on a disk")


def read_text(path: str | os.PathLike, limit: int | None = None) -> str:
    """Return the UTF-8 text of `path`; InputError names the byte that is not UTF-8.

    A byte order mark, with which Excel and Windows begin a file, is left out.
    """
    return _decoded(read_bytes(path, limit), path)


def _decoded(raw: bytes, path: str | os.PathLike) -> str:
    try:
        return raw.decode().removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start}", "not UTF-8 text", "save the file as UTF-8"
        ) from error


DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


def csv_rows(text: str, where: str) -> list[tuple[str, list[str]]]:
    """Return the place and the cells of each row of a table, as `csv_cells`.

    Rows without content, and those that begin with ``#``, are left out.
    """
    places = (
        (f"{where}:{number}", line)
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip(", ") and not line.lstrip().startswith("#")
    )
    return [(place, csv_cells(line, place)) for place, line in places]


def csv_cells(line: str, where: str) -> list[str]:
    """Return the cells of a line of a table.

    Raises
    ------
    InputError
        If the line is not one of a table, its columns are separated by semicolons or tabs, or a
        number has a decimal comma.
    """
    try:
        cells = [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:
        raise InputError(
            where, f"not a line of a table ({error})", "correct the line"
        ) from error
    remedy = "save the table with commas between columns and points in numbers"
    for sign, name in ((";", "semicolons"), ("\t", "tabs")):
        if len(cells) == 1 and sign in cells[0]:
            raise InputError(
                where,
                f"columns are separated by {name} (and the numbers have decimal commas?)",
                remedy,
            )
    for cell in cells:
        if DECIMAL_COMMA.fullmatch(cell):
            raise InputError(where, f"'{cell}' has a decimal comma", remedy)
    return cells


def read_json(path: str | os.PathLike, limit: int | None = None) -> Any:
    """Return the JSON value in `path`; InputError names line and column of a fault.

    `limit` as for `read_bytes`; with it, at most `MAX_JSON_VALUES` values.
    """
    return parse_json(read_bytes(path, limit), path, limit)


def parse_json(raw: bytes, path: str | os.PathLike, limit: int | None = None) -> Any:
    """Return the JSON value in the content of `path`, as `read_json`."""
    text = _decoded(raw, path)
    if limit is not None and text.count(",") >= MAX_JSON_VALUES:
        raise InputError(
            str(path), f"more than {MAX_JSON_VALUES} values", "name a smaller file"
        )
    try:
        return json.loads(text, parse_int=_whole_number)
    except json.JSONDecodeError as error:
        raise InputError(
            f"{path}:{error.lineno}:{error.colno}",
            f"not JSON ({error.msg})",
            "give a file that `selfcal` wrote",
        ) from error
    except (ValueError, RecursionError) as error:
        # a number too long, brackets too deep
        raise InputError(
            str(path),
            f"not usable JSON ({first_line(error)})",
            "give a file that `selfcal` wrote",
        ) from error


def read_yaml(path: str | os.PathLike, *, as_written: bool = False) -> Any:
    """Return the YAML value in `path`; InputError names line and column of a fault.

    Floats as in YAML 1.2 and ROS parameter files (`YamlLoader`); with `as_written`, all
    scalars but null as their text. The file is a regular one of at most `MAX_YAML_BYTES`.
    """
    text = read_text(path, MAX_YAML_BYTES)
    loaders = (
        [AsWritten]
        if as_written
        else (LOADERS if len(text) < EXPLAINED else LOADERS[:1])
    )
    try:
        for loader in loaders[:-1]:  # several times as fast
            with contextlib.suppress(yaml.YAMLError):
                return yaml.load(text, loader)
        return yaml.load(text, loaders[-1])
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f"{path}:{mark.line + 1}:{mark.column + 1}" if mark else str(path)
        raise InputError(
            place, f"not YAML ({error.problem})", "correct the line"
        ) from error
    except yaml.YAMLError as error:
        raise InputError(str(path), "not YAML", "give a YAML text file") from error
    except RecursionError as error:  # brackets too deep
        raise InputError(
            str(path), f"not usable YAML ({first_line(error)})", "correct the value"
        ) from error


def sha256_of(path: str | os.PathLike) -> str:
    """Return the SHA-256 of a file, or of a folder's files in the order of their names.

    Raises
    ------
    InputError
        If a file is missing or cannot be read.
    """
    root = Path(path)
    digest = hashlib.sha256()
    files = (
        sorted(p for p in root.rglob("*") if p.is_file()) if root.is_dir() else [root]
    )
    for file in files:
        add_file(digest, file)
    return digest.hexdigest()


def add_file(digest: Any, path: Path) -> None:
    """Add the content of a file to a digest of hashlib; InputError if it cannot be read."""
    try:
        with path.open("rb") as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise InputError(
            str(path), f"cannot be read ({_reason(error)})", "name a readable file"
        ) from error


def checked_fields(
    data: object, where: str, required: dict, optional: dict | None = None
) -> dict:
    """Return the fields of a mapping with their types checked and defaults filled in.

    Parameters
    ----------
    data : object
        Parsed YAML.
    where : str
        File and place, for messages.
    required, optional : dict
        Key -> type; key -> type and default.

    Raises
    ------
    InputError
        For a missing or unknown key, or a value of another type.
    """
    if not isinstance(data, dict):
        raise InputError(
            where, "not a mapping of keys to values", "see the examples in config"
        )
    optional = optional or {}
    refuse_unknown(data, [*required, *optional], where)
    out = {key: default for key, (_, default) in optional.items()}
    for key in required:
        if key not in data:
            raise InputError(where, f"the key '{key}' is missing", "add it")
    for key, value in data.items():
        kind = required[key] if key in required else optional[key][0]
        if kind is float and isinstance(value, int) and not isinstance(value, bool):
            value = float(value)
        if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
            raise InputError(
                f"{where}: {key}",
                f"{value!r} is not of type {kind.__name__}",
                mend_of(value, kind),
            )
        out[key] = value
    return out


def refuse_unknown(
    data: Iterable[Any], known_keys: Collection[str], where: str
) -> None:
    """Refuse a mapping with a key that is not known."""
    for key in data:
        if key not in known_keys:
            raise InputError(
                f"{where}: {key}", "unknown key", known_are(str(key), known_keys)
            )


_hints = cache(get_type_hints)


def read(kind: Any, value: Any) -> Any:
    """Return a value from JSON as `kind`: a dataclass, a tuple, an array, or a plain type.

    Null is NaN for a float. Keys that a dataclass has no field for are ignored.

    Raises
    ------
    ValueError, KeyError
        For a value of another type, and for a missing key whose field has no default.
    """
    inner = get_args(kind)
    if is_dataclass(kind):
        data, make = read(dict, value), cast(Any, kind)
        needed = [
            item.name
            for item in fields(kind)
            if item.name in data
            or (item.default is MISSING and item.default_factory is MISSING)
        ]
        return make(**{name: read(_hints(make)[name], data[name]) for name in needed})
    if get_origin(kind) is tuple:
        return tuple(read(inner[0], item) for item in read(list, value))
    if get_origin(kind) is dict and inner[1] is not Any:
        return {name: read(inner[1], item) for name, item in read(dict, value).items()}
    if get_origin(kind) is UnionType:  # of a kind and None
        return None if value is None else read(inner[0], value)
    if kind is np.ndarray:  # null is NaN here as well
        return np.array(read(list, value), dtype=float)
    if kind is float:
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, int | float)
        ):
            raise ValueError(f"{value!r} is not a number")
        return math.nan if value is None else float(value)
    kind = str if get_origin(kind) is Literal else get_origin(kind) or kind
    if issubclass(kind, StrEnum):
        return kind(value)
    python_type = Integral if kind is int else kind
    if not isinstance(value, python_type) or (kind is int and isinstance(value, bool)):
        raise ValueError(f"{value!r} is not of type {kind.__name__}")
    return value


def yaml_text(value: Any) -> str:
    """Return `value` as YAML, keys in their order."""
    return yaml.dump(value, Dumper=YamlDumper, sort_keys=False)


def write_yaml(path: str | os.PathLike, value: Any) -> None:
    """Write `value` as YAML, keys in their order, to `path` atomically."""
    write_text(path, yaml_text(value))
