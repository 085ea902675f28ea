# SPDX-License-Identifier: Apache-2.0
"""Decoding of the messages of one channel of a bag: many at once, or one by one.

Messages that the columns cannot decode are decoded by rosbags, one by one; failures are
counted. Both give the same.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from selfcal_ros.bagio.schemas import OWN, fields_of, own_message, same_layout, typestore
from selfcal_ros.collection.inputs import DETECTION
from selfcal_ros.messages import to_model
from selfcal_ros.messages.cdr import LITTLE, MAX_LENGTH, ColumnDecoder, Columns, Payloads, layout_of
from selfcal_ros.topics import DETECTION_TOPIC, ENCODER_TOPIC, INPUT_TOPICS

Input = to_model.EncoderBlock | np.ndarray | object
"""Encoder samples, a table of detections, or a command as rosbags has it."""
BLOCKS: dict[str, Callable[[Columns], Input]] = {ENCODER_TOPIC: to_model.encoder_block,
                                                 DETECTION_TOPIC: to_model.detection_table}
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
        self._why = "" if self.told else (
            f": the bag holds no definition of {self.name}, and they do not fit the one known here")
        self._columns = ColumnDecoder(self._fields, None if self._any_tail else PADDING) if (
            self._fields is not None and self.role in BLOCKS) else None

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
        return None if layout is None or layout.end == len(data) else data[:layout.end]

    def many(self, messages: Payloads) -> Iterator[Input]:
        """Yield the decoded messages; failures are counted."""
        rest = np.arange(len(messages))
        if self._columns is not None:
            groups, rest = self._columns.decode(messages)
            yield from map(BLOCKS[self.role], groups)
        for data in messages[rest]:
            message = self.one(data)
            if message is not None:
                yield _block(self.role, message)

    def own_bytes(self, messages: Payloads, index: np.ndarray) -> Iterator[tuple[int, bytes]]:
        """Yield the CDR bytes of the messages in the type known here, with their `index`.

        Failures are omitted and counted.
        """
        rest = np.ones(len(messages), dtype=bool)
        if self._columns is not None and self._own:
            rest[:] = False
            rest[self._columns.decode(messages)[1]] = True
        for number, data, doubtful in zip(index.tolist(), messages, rest.tolist(), strict=True):
            little = data[:len(LITTLE)] == LITTLE
            if little and not doubtful:
                yield number, data
                continue
            message = self.one(data)
            if message is not None:
                name = INPUT_TOPICS[self.role]
                yield number, data if self._own and little else bytes(
                    typestore().serialize_cdr(own_message(message, name), name))


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
        sample = to_model.encoder_sample(message)
        velocities = np.array([sample.velocities], dtype=float) if sample.velocities else None
        return to_model.EncoderBlock(np.array([sample.stamp_ns]), sample.names,
                                     np.array([sample.positions], dtype=float), velocities)
    if role == DETECTION_TOPIC:
        d = to_model.detection(message)
        return np.array([(d.stamp_ns, d.kind, d.has_id, d.m, d.n, d.k, d.offset_x, d.offset_y,
                          d.offset_theta, d.sigma, d.score)], dtype=DETECTION)
    return message
