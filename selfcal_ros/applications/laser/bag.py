# SPDX-License-Identifier: Apache-2.0
"""Laser distances and axis positions from a bag, for the step-diagonal measurement.

Messages are decoded by the definitions in the bag. A message with a header is used at its stamp,
one without at its log time. Samples are sorted by time, whatever their order in the file; of
duplicate times the first is kept.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from selfcal_ros.applications.laser.zigzag import Recording
from selfcal_ros.bagio.mcap_stream import McapStream, streams
from selfcal_ros.bagio.messages.to_model import stamp_ns
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.schemas import store_of_schema
from selfcal_ros.errors import InputError, NoDataError

FIELDS = {
    "std_msgs/msg/Float64": "data",
    "std_msgs/msg/Float32": "data",
    "sensor_msgs/msg/Range": "range",
}
"""Default field of the distance by type."""
POINTS = {
    "geometry_msgs/msg/PointStamped": "point",
    "geometry_msgs/msg/PoseStamped": "pose.position",
    "geometry_msgs/msg/Point": "",
}
"""Fields of x, y, z by type, other than JointState."""
JOINT_STATE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True)
class SeriesTopics:
    """Topics and fields of laser and positions.

    Attributes
    ----------
    laser, position : str
        Topics.
    joints : tuple of str
        Names of the axes in a JointState, in the order of the steps.
    laser_field : str
        Field of the distance (``a.b`` for nested ones), or the joint's name in a JointState; empty
        = default of the type.
    laser_unit_m : float
        Metres in a unit of the values.
    """

    laser: str
    position: str
    joints: tuple[str, ...] = ("x", "y")
    laser_field: str = ""
    laser_unit_m: float = 1.0


def read_series(path: Path, topics: SeriesTopics) -> tuple[Recording, list[str]]:
    """Return the recording in a bag, and notes about it.

    Raises
    ------
    InputError
        If the bag cannot be read, a type has no such field, or a joint is missing.
    NoDataError
        If a topic is missing or empty.
    """
    reader = BagReader(Path(path))
    value_of_topic = {
        topics.laser: _laser_value(topics),
        topics.position: _position_value(topics),
    }
    if len(value_of_topic) < 2:
        raise InputError(
            "--position-topic", "it is the laser's topic", "name two topics"
        )
    samples_of_topic: dict[str, list[tuple[int, Any]]] = {
        topic: [] for topic in value_of_topic
    }
    other_topics: set[str] = set()
    unstamped: set[str] = set()
    for stream in streams(reader.files, reader.lost):
        decoders: dict[int, Callable] = {}
        for channel, message in stream.messages():
            topic = _match(channel.topic, value_of_topic)
            if topic is None:
                other_topics.add(channel.topic)
                continue
            if channel.id not in decoders:
                decoders[channel.id] = _decoder(
                    stream, channel, f"{path}: topic {topic}"
                )
            name, decoded = decoders[channel.id](message.data)
            if not hasattr(decoded, "header"):
                unstamped.add(topic)
            stamp = (
                stamp_ns(decoded) if hasattr(decoded, "header") else message.log_time
            )
            if stamp > np.iinfo(np.int64).max:
                raise InputError(
                    f"{path}: topic {topic}",
                    f"{stamp} ns is not a log time",
                    "record the bag again",
                )
            samples_of_topic[topic].append(
                (stamp, value_of_topic[topic](name, decoded, f"{path}: topic {topic}"))
            )
    for topic, samples in samples_of_topic.items():
        if not samples:
            raise NoDataError(
                f"{path}: topic {topic}",
                "no message of it in the bag",
                "the bag has " + (", ".join(sorted(other_topics)) or "no other topic"),
            )
    notes = [f"{path}: {line}" for line in reader.lost]
    if len(unstamped) == 1:
        notes.append(
            f"{path}: {unstamped.pop()} has no stamps and is used at its log time, the "
            "other topic at its stamps: both clocks must agree"
        )
    laser_ns, laser = _sorted(samples_of_topic[topics.laser])
    position_ns, positions = _sorted(samples_of_topic[topics.position])
    return Recording(
        laser_ns, laser * topics.laser_unit_m, position_ns, positions
    ), notes


def _match(topic: str, value_of_topic: dict[str, Callable]) -> str | None:
    return next(
        (name for name in value_of_topic if name.strip("/") == topic.strip("/")), None
    )


def _decoder(stream: McapStream, channel: Any, where: str) -> Callable:
    schema = stream.schemas.get(channel.schema_id)
    if channel.message_encoding != "cdr" or schema is None:
        raise InputError(
            where,
            f"message encoding '{channel.message_encoding}' instead of cdr with a definition",
            "convert the bag to ROS 2, e.g. with rosbags-convert",
        )
    store = store_of_schema(
        schema.name, schema.encoding, schema.data.decode(errors="replace"), where
    )

    def decode(data: bytes) -> tuple[str, Any]:
        try:
            return schema.name, store.deserialize_cdr(data, schema.name)
        except Exception as error:  # a damaged payload may fail anywhere in the decoder
            raise InputError(
                where, "a message cannot be decoded", "record the bag again"
            ) from error

    return decode


def _laser_value(topics: SeriesTopics) -> Callable:
    def value(name: str, message: Any, where: str) -> float:
        if name == JOINT_STATE:
            return _joints(message, (topics.laser_field or "laser",), where)[0]
        field = topics.laser_field or FIELDS.get(name)
        if field is None:
            raise InputError(
                where,
                f"the type {name} has no known distance field",
                "name its field with --laser-field",
            )
        return _number(message, field, where)

    return value


def _position_value(topics: SeriesTopics) -> Callable:
    def value(name: str, message: Any, where: str) -> list[float]:
        if name == JOINT_STATE:
            return _joints(message, topics.joints, where)
        if name not in POINTS:
            raise InputError(
                where,
                f"the type {name} holds no axis positions",
                "record a JointState, or one of " + ", ".join(sorted(POINTS)),
            )
        prefix = f"{POINTS[name]}." if POINTS[name] else ""
        return [
            _number(message, f"{prefix}{axis}", where)
            for axis in ("x", "y", "z")[: len(topics.joints)]
        ]

    return value


def _joints(message: Any, joints: Sequence[str], where: str) -> list[float]:
    named = dict(zip(message.name, message.position, strict=False))
    missing = [joint for joint in joints if joint not in named]
    if missing:
        raise InputError(
            where,
            f"no joint '{missing[0]}', only {', '.join(named)}",
            "name the joints with --joints, the laser's with --laser-field",
        )
    return [float(named[joint]) for joint in joints]


def _number(message: Any, field: str, where: str) -> float:
    for name in field.split("."):
        if not hasattr(message, name):
            raise InputError(
                where,
                f"the message has no field '{field}'",
                "name the field with --laser-field, a.b for a nested one",
            )
        message = getattr(message, name)
    try:
        return float(message)
    except (TypeError, ValueError) as error:
        raise InputError(
            where, f"the field '{field}' is not a number", "name a numeric field"
        ) from error


def _sorted(samples: list[tuple[int, Any]]) -> tuple[np.ndarray, np.ndarray]:
    stamps = np.array([stamp for stamp, _ in samples], dtype=np.int64)
    values = np.array([value for _, value in samples], dtype=float)
    stamps, first = np.unique(stamps, return_index=True)
    return stamps, values[first]
