# SPDX-License-Identifier: Apache-2.0
"""Message definitions without ROS, of the contract and of a bag, and their messages."""

from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from selfcal_ros.errors import InputError, first_line
from selfcal_ros.messages.cdr import SEQUENCE, TEXT, Field
from selfcal_ros.messages.from_model import Fields

OWN = "selfcal_msgs"

COMMON = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
                                  "float64[] velocity\nfloat64[] effort\n",
}
"""The common types required by the contract, as in ROS 2 Jazzy. Loading all 180 of rosbags
would take 0.1 s of CPU in every command and node that reads or writes a bag."""

KEPT = 64
"""Number of schemas with cached typestores; a folder of foreign bags has a handful."""
NUMBERS = {"bool": "u1", "byte": "u1", "char": "u1", "uint8": "u1", "int8": "i1", "int16": "i2",
           "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8",
           "float32": "f4", "float64": "f8"}
"""Numpy codes of the basic types."""


def _message_folder() -> Path:
    """Return the folder of the .msg files: installed with the code, or in the source tree."""
    source = Path(__file__).parents[2] / "msg_defs" / "msg"
    return source if source.is_dir() else Path(__file__).parents[1] / "msg_text"


@cache
def typestore() -> Typestore:
    """Return this package's messages, and the common types required by the contract."""
    types: dict = {}
    for name, text in COMMON.items():
        types.update(get_types_from_msg(text, name))
    for file in sorted(_message_folder().iterdir(), key=lambda item: item.name):
        if file.name.endswith(".msg"):
            name = file.name.removesuffix(".msg")
            types.update(get_types_from_msg(file.read_text(), f"{OWN}/msg/{name}"))
    return _store(types)


def _store(types: dict) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    store.register(types)
    return store


@cache
def _jazzy() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def store_with(typename: str) -> Typestore:
    """Return `typestore`, or that of all types of ROS 2 Jazzy for another type."""
    return typestore() if typename in typestore().fielddefs else _jazzy()


def hash_of(typename: str) -> str:
    """Return the hash of a known type, by which ROS 2 distinguishes definitions (REP-2011)."""
    return store_with(typename).hash_rihs01(typename)


def definition_of(topic: str, typename: str) -> str:
    """Return the definition of a known type as a ros2msg schema.

    Raises
    ------
    InputError
        If the type of the topic is not known here.
    """
    store = store_with(typename)
    if typename not in store.fielddefs:
        raise InputError(f"topic {topic}", f"no definition of {typename}",
                         "record only topics of known types")
    return store.generate_msgdef(typename, ros_version=2)[0]


def store_of_schema(name: str, encoding: str, text: str, where: str) -> Typestore:
    """Return a typestore for decoding by the bag's own schema.

    Parameters
    ----------
    name : str
        Type, like ``selfcal_msgs/msg/ViewCommand``.
    encoding : str
        ``ros2msg`` or ``ros2idl``.
    text : str
        The schema; empty = the bag has none, and the known type is used.
    where : str
        Bag and topic, for messages.

    Raises
    ------
    InputError
        If the schema cannot be parsed, or is missing and the type is unknown.
    """
    if not text.strip():
        store = store_with(name)
        if name not in store.fielddefs:
            raise InputError(where, f"the bag holds no definition of {name}",
                             "record it with message definitions")
        return store
    try:
        return _store_of_text(name, encoding, text)
    except Exception as error:
        raise InputError(where, f"the definition of {name} cannot be read ({first_line(error)})",
                         "record the bag anew") from error


@lru_cache(maxsize=KEPT)
def _store_of_text(name: str, encoding: str, text: str) -> Typestore:
    """Return the cached typestore of a schema: rosbags generates code for each."""
    types = get_types_from_idl(text) if encoding == "ros2idl" else get_types_from_msg(text, name)
    for known in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"):
        types.setdefault(known, typestore().fielddefs[known])
    return _store(types)


@cache
def shorter_stores(name: str, last: str) -> tuple[Typestore, ...]:
    """Return typestores of a type without one, two, ... of the fields after `last`.

    A message recorded without its definition is of one of these, longest first: the contract's
    fields, and as many of those that this package added at the end as its publisher knew. A type
    of another package has one length only.
    """
    if not name.startswith(OWN):
        return ()
    constants, fields = typestore().fielddefs[name]
    names = [field for field, _ in fields]
    common = {known: typestore().fielddefs[known] for known in COMMON}
    return tuple(_store({**common, name: (constants, fields[:count])})
                 for count in range(len(names) - 1, names.index(last), -1))


def fields_of(store: Typestore, name: str) -> tuple[Field, ...] | None:
    """Return the fields of a type for `messages.cdr`; None if unsupported."""
    try:
        return tuple(_field(store, field, kind) for field, kind in store.fielddefs[name][1])
    except KeyError:
        return None


def _field(store: Typestore, name: str, kind: Any) -> Field:
    """Return one field; KeyError for a basic type without a numpy code, or an unknown type."""
    node, inner = kind
    count = None
    if node == Nodetype.SEQUENCE:
        (node, inner), count = inner[0], SEQUENCE
    elif node == Nodetype.ARRAY:
        (node, inner), count = inner
    if node == Nodetype.NAME:
        members = tuple(_field(store, field, kind) for field, kind in store.fielddefs[inner][1])
        return Field(name, members, count)
    return Field(name, TEXT if inner[0] == "string" else NUMBERS[inner[0]], count)


def same_layout(store: Typestore, name: str) -> bool:
    """Return whether a type has exactly the fields of the known one, in their order."""
    wanted = typestore().fielddefs[name][1]
    return store.fielddefs[name][1] == wanted and all(
        same_layout(store, inner) for _, (_, inner) in wanted if isinstance(inner, str))


def own_message(message: Any, name: str) -> object:
    """Return a message of the known type with the fields of `message`.

    Missing fields are 0 or empty.
    """
    values: dict[str, Any] = {}
    for field, (kind, inner) in typestore().fielddefs[name][1]:
        if isinstance(inner, str):  # a type of its own
            values[field] = own_message(getattr(message, field), inner)
        else:
            missing = np.zeros(0) if kind != Nodetype.BASE else "" if inner[0] == "string" else 0
            values[field] = getattr(message, field, missing)
    return typestore().types[name](**values)


def other_field(store: Typestore, name: str, last: str) -> str:
    """Return the difference of a type from the known one, or ''.

    Every field up to `last` must be present, and common fields must have the same type. Unknown
    fields, and bounds on the length of a string or array, are ignored.
    """
    found, required = dict(store.fielddefs[name][1]), True
    for field, wanted in typestore().fielddefs[name][1]:
        if field not in found and required:
            return f"no field '{field}'"
        if field in found and _free_of_bounds(found[field]) != _free_of_bounds(wanted):
            return f"the field '{field}' has another type"
        inner = wanted[1]
        if isinstance(inner, str) and field in found:  # a type of its own
            other = other_field(store, inner, typestore().fielddefs[inner][1][-1][0])
            if other:
                return f"in '{field}', {other}"
        required = required and field != last
    return ""


def _free_of_bounds(kind: Any) -> Any:
    """Return a field's type without bounds of strings and sequences."""
    node, inner = kind
    if node == Nodetype.BASE:
        return node, inner[0]
    if node in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        return node, _free_of_bounds(inner[0])
    return node, inner


def build(store: Typestore, typename: str, fields: Fields) -> object:
    """Return a rosbags message of type `typename` with these fields.

    Raises
    ------
    KeyError
        If a field of the type is missing.
    """
    values: dict[str, Any] = {}
    for name, (kind, argument) in store.fielddefs[typename][1]:
        value = fields[name]
        if isinstance(argument, str):  # a type of its own
            values[name] = build(store, argument, value)
        elif kind == Nodetype.BASE:
            values[name] = value
        else:
            element = argument[0]
            if element[0] == Nodetype.BASE and element[1][0] != "string":
                values[name] = np.array(value, dtype=element[1][0])
            else:
                values[name] = list(value)
    return store.types[typename](**values)
