# SPDX-License-Identifier: Apache-2.0
"""Message definitions without ROS, of the contract and of a bag, and decoding by them.

Many messages of a channel are decoded at once. Those that the columns cannot decode are decoded by
rosbags, one by one; failures are counted. Both give the same.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.bagio.messages.cdr import (
    LITTLE,
    MAX_LENGTH,
    SEQUENCE,
    TEXT,
    ColumnDecoder,
    Columns,
    Field,
    Payloads,
    layout_of,
)
from selfcal_ros.collection.inputs import EncoderBlock
from selfcal_ros.errors import InputError, first_line
from selfcal_ros.topics import (
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
    message_texts,
)

OWN = "selfcal_msgs"

COMMON = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "sensor_msgs/msg/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort\n",
}
"""The common types required by the contract, as in ROS 2 Jazzy. Loading all 180 of rosbags
would take 0.1 s of CPU in every command and node that reads or writes a bag."""

IDL_FILE = re.compile(r"^=+\nIDL: .*$", re.MULTILINE)
INCLUDE = re.compile(r"^#include .*$", re.MULTILINE)

KEPT = 64
"""Number of schemas with cached typestores; a folder of foreign bags has a handful."""
NUMBERS = {
    "bool": "u1",
    "byte": "u1",
    "char": "u1",
    "uint8": "u1",
    "int8": "i1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""Numpy codes of the basic types."""


@cache
def typestore() -> Typestore:
    """Return this package's messages, and the common types required by the contract."""
    types: dict = {}
    for name, text in COMMON.items():
        types.update(get_types_from_msg(text, name))
    for name, text in message_texts().items():
        types.update(get_types_from_msg(text, f"{OWN}/msg/{name}"))
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
        raise InputError(
            f"topic {topic}",
            f"no definition of {typename}",
            "record only topics of known types",
        )
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
            raise InputError(
                where,
                f"the bag has no definition of {name}",
                "record it with message definitions",
            )
        return store
    try:
        return _store_of_text(name, encoding, text)
    except Exception as error:
        raise InputError(
            where,
            f"the definition of {name} cannot be read ({first_line(error)})",
            "record the bag again",
        ) from error


@lru_cache(maxsize=KEPT)
def _store_of_text(name: str, encoding: str, text: str) -> Typestore:
    """Return the cached typestore of a schema: rosbags generates code for each."""
    types = (
        _types_of_idl(text) if encoding == "ros2idl" else get_types_from_msg(text, name)
    )
    for type_name in ("std_msgs/msg/Header", "builtin_interfaces/msg/Time"):
        types.setdefault(type_name, typestore().fielddefs[type_name])
    return _store(types)


def _types_of_idl(text: str) -> dict[str, Any]:
    """Return the types of IDL files as rosbag2 joins them; rosbags reads one, without includes."""
    types: dict[str, Any] = {}
    for one in IDL_FILE.split(text):
        if one.strip():
            types.update(get_types_from_idl(INCLUDE.sub("", one)))
    return types


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
    common = {type_name: typestore().fielddefs[type_name] for type_name in COMMON}
    return tuple(
        _store({**common, name: (constants, fields[:count])})
        for count in range(len(names) - 1, names.index(last), -1)
    )


def fields_of(store: Typestore, name: str) -> tuple[Field, ...] | None:
    """Return the fields of a type for `messages.cdr`; None if unsupported."""
    try:
        return tuple(
            _field(store, field, kind) for field, kind in store.fielddefs[name][1]
        )
    except KeyError:
        return None


def _field(store: Typestore, name: str, kind: Any) -> Field:
    """Return one field; KeyError for a basic type without a numpy code, or an unknown type."""
    node, inner = kind
    count = None
    if node == Nodetype.SEQUENCE:
        node, inner = inner[0]
        count = SEQUENCE
    elif node == Nodetype.ARRAY:
        (node, inner), count = inner
    if node == Nodetype.NAME:
        members = tuple(
            _field(store, field, kind) for field, kind in store.fielddefs[inner][1]
        )
        return Field(name, members, count)
    return Field(name, TEXT if inner[0] == "string" else NUMBERS[inner[0]], count)


def same_layout(store: Typestore, name: str) -> bool:
    """Return whether a type has exactly the fields of the known one, in their order."""
    known_fields = typestore().fielddefs[name][1]
    return store.fielddefs[name][1] == known_fields and all(
        same_layout(store, inner)
        for _, (_, inner) in known_fields
        if isinstance(inner, str)
    )


def own_message(message: Any, name: str) -> object:
    """Return a message of the known type with the fields of `message`.

    Missing fields are 0 or empty.
    """
    values: dict[str, Any] = {}
    for part, (kind, inner) in typestore().fielddefs[name][1]:
        if isinstance(inner, str):  # a type of its own
            values[part] = own_message(getattr(message, part), inner)
        else:
            missing = (
                np.zeros(0)
                if kind != Nodetype.BASE
                else ""
                if inner[0] == "string"
                else 0
            )
            values[part] = getattr(message, part, missing)
    return typestore().types[name](**values)


def other_field(store: Typestore, name: str, last: str) -> str:
    """Return the difference of a type from the known one, or ''.

    Every field up to `last` must be present, and common fields must have the same type. Unknown
    fields, and bounds on the length of a string or array, are ignored.
    """
    type_of_field = dict(store.fielddefs[name][1])
    required = True
    for part, known_type in typestore().fielddefs[name][1]:
        if part not in type_of_field and required:
            return f"no field '{part}'"
        if part in type_of_field and _free_of_bounds(
            type_of_field[part]
        ) != _free_of_bounds(known_type):
            return f"the field '{part}' has another type"
        inner = known_type[1]
        if isinstance(inner, str) and part in type_of_field:  # a type of its own
            difference = other_field(
                store, inner, typestore().fielddefs[inner][1][-1][0]
            )
            if difference:
                return f"in '{part}', {difference}"
        required = required and part != last
    return ""


def _free_of_bounds(kind: Any) -> Any:
    """Return a field's type without bounds of strings and sequences."""
    node, inner = kind
    if node == Nodetype.BASE:
        return node, inner[0]
    if node in (Nodetype.SEQUENCE, Nodetype.ARRAY):
        return node, _free_of_bounds(inner[0])
    return node, inner


Input = EncoderBlock | np.ndarray | object
"""Encoder samples, a table of detections, or a command as rosbags has it."""
BLOCKS: dict[str, Callable[[Columns], Input]] = {
    ENCODER_TOPIC: to_model.encoder_block,
    DETECTION_TOPIC: to_model.detection_table,
}
"""What many messages of a topic become at once."""
PADDING = 3
"""Bytes after the last field that belong to it where lengths identify the definition."""
ENOUGH, MAX_BYTES = 2000, 4 << 20
"""Messages and bytes collected before they are decoded together."""


@dataclass
class ChannelDecoder:
    """Decode the messages of one channel.

    Attributes
    ----------
    role : str
        Its topic without a namespace.
    name : str
        Its type.
    stores : sequence of rosbags typestores
        Definitions of the type; the first that fits is used.
    bad : Counter
        Messages that could not be decoded, by topic and problem.
    told : bool
        Whether the bag contains the definition.
    """

    role: str
    name: str
    stores: Sequence[Typestore]
    bad: Counter
    told: bool

    def __post_init__(self) -> None:
        """Determine which messages can be decoded as columns, and which passed unchanged."""
        fields = [fields_of(store, self.name) for store in self.stores]
        self._fields = fields[0] if len(fields) == 1 else None
        # without a definition the length identifies it, if a type has grown
        self._any_tail = self.told or not self.name.startswith(OWN)
        self._own = same_layout(self.stores[0], self.name) if self.told else False
        self._why = (
            ""
            if self.told
            else (
                f": the bag has no definition of {self.name}, and they do not fit the "
                "one known here"
            )
        )
        self._columns = (
            ColumnDecoder(self._fields, None if self._any_tail else PADDING)
            if (self._fields is not None and self.role in BLOCKS)
            else None
        )

    def one(self, data: bytes) -> Any:
        """Return a message decoded by rosbags; None if it cannot be decoded, which is counted.

        A message that is too long is not decoded.
        """
        if len(data) > MAX_LENGTH:
            self.bad[self.role, f": they are longer than {MAX_LENGTH} bytes"] += 1
            return None
        for store in self.stores:
            try:
                return store.deserialize_cdr(data, self.name)
            except SerdeError:
                continue
            except Exception:  # a damaged payload may fail anywhere in the decoder
                break
        shorter = self._without_tail(data)
        if shorter is not None:
            return self.one(shorter)
        self.bad[self.role, self._why] += 1
        return None

    def _without_tail(self, data: bytes) -> bytes | None:
        """Return a message without trailing bytes; None if there are none.

        ``rclpy.serialization.serialize_message`` leaves some bytes there.
        """
        if self._fields is None or not self._any_tail:
            return None
        layout = layout_of(self._fields, data)
        return None if layout is None or layout.end == len(data) else data[: layout.end]

    def many(self, messages: Payloads) -> Iterator[Input]:
        """Yield the decoded messages; failures are counted."""
        undecoded = np.arange(len(messages))
        if self._columns is not None:
            groups, undecoded = self._columns.decode(messages)
            yield from map(BLOCKS[self.role], groups)
        for data in messages[undecoded]:
            message = self.one(data)
            if message is not None:
                yield _block(self.role, message)

    def own_bytes(
        self, messages: Payloads, index: np.ndarray
    ) -> Iterator[tuple[int, bytes]]:
        """Yield the CDR bytes of the messages in the type known here, with their `index`.

        Failures are omitted and counted.
        """
        is_doubtful = np.ones(len(messages), dtype=bool)
        if self._columns is not None and self._own:
            is_doubtful[:] = False
            is_doubtful[self._columns.decode(messages)[1]] = True
        for number, data, doubtful in zip(
            index.tolist(), messages, is_doubtful.tolist(), strict=True
        ):
            little = data[: len(LITTLE)] == LITTLE
            if little and not doubtful:
                yield number, data
                continue
            message = self.one(data)
            if message is not None:
                name = INPUT_TOPICS[self.role]
                yield (
                    number,
                    data
                    if self._own and little
                    else bytes(
                        typestore().serialize_cdr(own_message(message, name), name)
                    ),
                )


@dataclass
class Waiting:
    """Messages of a channel waiting to be decoded together."""

    decoder: ChannelDecoder
    _data: list[bytes] = field(default_factory=list)
    _size: int = 0

    def add(self, messages: Payloads) -> Iterator[Input]:
        """Take messages and yield batches that are large enough."""
        if len(messages) >= ENOUGH:
            yield from self.decoder.many(messages)
            return
        self._data += messages
        self._size += int(messages.length.sum())
        if len(self._data) >= ENOUGH or self._size >= MAX_BYTES:
            yield from self.rest()

    def rest(self) -> Iterator[Input]:
        """Yield the waiting messages."""
        data, self._data, self._size = self._data, [], 0
        yield from self.decoder.many(Payloads.joined(data))


def _block(role: str, message: Any) -> Input:
    """Return a single decoded message as a block of one; a command unchanged."""
    if role == ENCODER_TOPIC:
        return EncoderBlock.of([to_model.encoder_sample(message)])
    if role == DETECTION_TOPIC:
        return to_model.detection(message).as_table()
    return message
