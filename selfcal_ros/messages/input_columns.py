# SPDX-License-Identifier: Apache-2.0
"""The inputs of a calibration as columns: encoder samples and detections of many messages."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct
from typing import NamedTuple

import numpy as np

from selfcal_ros.collection.inputs import DETECTION
from selfcal_ros.messages.cdr_columns import MAX_KNOWN, MAX_LENGTH, ColumnDecoder, Columns, Payloads
from selfcal_ros.messages.cdr_layout import SEQUENCE, TEXT, Field, layout_of
from selfcal_ros.units import NS_PER_S

TIME = (Field("sec", "i4"), Field("nanosec", "u4"))
HEADER = (Field("stamp", TIME), Field("frame_id", TEXT))
JOINT_STATE = (
    Field("header", HEADER), Field("name", TEXT, SEQUENCE), Field("position", "f8", SEQUENCE),
    Field("velocity", "f8", SEQUENCE), Field("effort", "f8", SEQUENCE))
"""Fields of sensor_msgs/msg/JointState."""
MARK_DETECTION = (
    Field("header", HEADER), Field("kind", "u1"), Field("has_id", "u1"), Field("m", "i4"),
    Field("n", "i4"), Field("k", "u4"), Field("offset_x", "f8"), Field("offset_y", "f8"),
    Field("offset_theta", "f8"), Field("sigma", "f8"), Field("score", "f4"))
"""Fields of selfcal_msgs/msg/MarkDetection."""
STAMP_END = 12
"""Bytes of the encapsulation, and of the stamp behind it."""
_OFFSETS = {"ox": "offset_x", "oy": "offset_y", "ot": "offset_theta"}


@dataclass(frozen=True)
class EncoderBlock:
    """Encoder samples of the same joints.

    Attributes
    ----------
    stamps_ns : int64 array (n,)
        Stamps of the headers.
    names : tuple of str
        Joints, as the messages name them.
    positions : float array (n, j)
        Indicated positions, m or rad; j differs from the number of names in malformed messages.
    velocities : float array (n, i) or None
        m/s or rad/s; None where the messages tell none.
    """

    stamps_ns: np.ndarray
    names: tuple[str, ...]
    positions: np.ndarray
    velocities: np.ndarray | None

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.stamps_ns)


class EncoderColumns:
    """Decodes sensor_msgs/JointState; parameters as `ColumnDecoder`."""

    def __init__(self, fields: Sequence[Field] = JOINT_STATE, tail: int | None = None) -> None:
        self._decoder = ColumnDecoder(fields, tail)

    def decode(self, messages: Payloads) -> tuple[list[EncoderBlock], np.ndarray]:
        """Return blocks of samples, and the indices of the messages that remain."""
        groups, rest = self._decoder.decode(messages)
        return [_encoder_block(group) for group in groups], rest


class PositionEditor:
    """Reads and replaces the positions of sensor_msgs/JointState one by one, within their bytes.

    A message of a layout that is known takes 2 us, where the columns of one take 90.
    """

    def __init__(self) -> None:
        self._known: deque[_Positions] = deque(maxlen=MAX_KNOWN)

    def read(self, data: bytes) -> tuple[tuple[str, ...], tuple[float, ...]] | None:
        """Return names and positions; None for a message that is damaged or too long."""
        if not self._find(data):
            return None
        found = self._known[0]
        return found.names, found.form.unpack_from(data, found.at)

    def replaced(self, data: bytes, positions: Sequence[float]) -> bytes:
        """Return the message that was read last with other positions."""
        found = self._known[0]
        end = found.at + found.form.size
        return data[:found.at] + found.form.pack(*positions) + data[end:]

    def _find(self, data: bytes) -> bool:
        """Bring the layout of a message to the front; tell if it has one."""
        for number, known in enumerate(self._known):
            if len(data) == known.length and int.from_bytes(data) & known.mask == known.value:
                self._known.rotate(-number)
                return True
        layout = layout_of(JOINT_STATE, data) if len(data) <= MAX_LENGTH else None
        if layout is None:
            return False
        code, at, count = layout.values["position"]
        mask = int.from_bytes(layout.fixed)
        self._known.appendleft(_Positions(
            len(data), mask, int.from_bytes(data) & mask, layout.texts["name"],
            Struct(f"{code[0]}{count}d"), at))
        return True


class _Positions(NamedTuple):
    """Where the positions lie in messages of one layout, and the bits that tell the layout."""

    length: int
    mask: int
    value: int
    names: tuple[str, ...]
    form: Struct
    at: int


class DetectionColumns:
    """Decodes selfcal_msgs/MarkDetection; parameters as `ColumnDecoder`."""

    def __init__(self, fields: Sequence[Field] = MARK_DETECTION, tail: int | None = None) -> None:
        self._decoder = ColumnDecoder(fields, tail)

    def decode(self, messages: Payloads) -> tuple[list[np.ndarray], np.ndarray]:
        """Return tables of `collection.inputs.DETECTION`, and the indices of what remains."""
        groups, rest = self._decoder.decode(messages)
        return [_detection_table(group) for group in groups], rest


def stamps_ns(group: Columns) -> np.ndarray:
    """Return the stamps in the headers of messages, integer ns."""
    seconds = group["header.stamp.sec"].astype(np.int64)
    return seconds * NS_PER_S + group["header.stamp.nanosec"]


def first_stamps_ns(messages: Payloads) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps of messages that begin with a header, and which are long enough for one.

    Returns
    -------
    stamps_ns : int64 array (k,)
        Stamps, ns.
    there : bool array (n,)
        Which of the messages have one.
    """
    there = messages.length >= STAMP_END
    octets = np.frombuffer(messages.data, np.uint8)[
        messages.start[there][:, None] + np.arange(STAMP_END)]
    words = octets[:, 4:].copy()
    little, big = (words.view(np.dtype([("sec", f"{order}i4"), ("nanosec", f"{order}u4")]))[:, 0]
                   for order in "<>")
    is_little = octets[:, 1] & 1 == 1
    second = np.where(is_little, little["sec"], big["sec"]).astype(np.int64)
    return second * NS_PER_S + np.where(is_little, little["nanosec"], big["nanosec"]), there


def _encoder_block(group: Columns) -> EncoderBlock:
    velocities = group["velocity"] if "velocity" in group else np.zeros((len(group), 0))
    return EncoderBlock(stamps_ns(group), group.layout.texts["name"], group["position"],
                        velocities if velocities.shape[1] else None)


def _detection_table(group: Columns) -> np.ndarray:
    table = np.empty(len(group), dtype=DETECTION)
    table["stamp"] = stamps_ns(group)
    table["has_id"] = group["has_id"] != 0
    for name in ("kind", "m", "n", "k", "sigma", "score"):
        table[name] = group[name]
    for name, field in _OFFSETS.items():
        table[name] = group[field]
    return table
