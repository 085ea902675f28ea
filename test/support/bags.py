# SPDX-License-Identifier: Apache-2.0
"""Bags that somebody else wrote from the contract: by the mcap library or by rosbags alone.

Nothing of the package's own message files or of its bag writer is used: the definitions below are
the contract's fields and no more, so that a bag of them is the least that must be read.
"""

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from selfcal_ros.collection.inputs import Command, Detection
from selfcal_ros.model.view import View
from selfcal_ros.simulation.cell import Event

DETECTION = """uint8 GRID=0
uint8 ANGULAR=1
std_msgs/Header header
uint8 kind
bool has_id
int32 m
int32 n
uint32 k
float64 offset_x
float64 offset_y
float64 offset_theta
float64 sigma
float32 score
"""
COMMAND = """uint8 PLACE=0
uint8 MEASURE=1
uint8 DONE=2
uint8 ABORT=3
std_msgs/Header header
uint8 phase
string plan_id
uint32 view_index
string view_name
float64 rotation
float64 translation_x
float64 translation_y
bool grid
bool angular
uint32 repeats
uint32 grid_size
float64 grid_pitch
uint32 angular_count
"""
ENCODER_TYPE = "sensor_msgs/msg/JointState"
DETECTION_TYPE = "selfcal_msgs/msg/MarkDetection"
COMMAND_TYPE = "selfcal_msgs/msg/ViewCommand"
TOPICS = {
    "stage/joint_states": ENCODER_TYPE,
    "stage/mark_detections": DETECTION_TYPE,
    "selfcal/view_command": COMMAND_TYPE,
}
UNKNOWN_TYPE = "somebody_msgs/msg/Thing"


@cache
def contract_types(
    more: str = "", detection: str = DETECTION, command: str = COMMAND
) -> Typestore:
    """Return Jazzy's types and the contract's, `more` fields at the end of our two."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types: dict = {}
    types.update(get_types_from_msg(detection + more, DETECTION_TYPE))
    types.update(get_types_from_msg(command + more, COMMAND_TYPE))
    types.update(get_types_from_msg("float64[] values\nstring text\n", UNKNOWN_TYPE))
    store.register(types)
    return store


def _stamp(store: Typestore, stamp_ns: int) -> object:
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    return store.types["std_msgs/msg/Header"](stamp=time, frame_id="somewhere")


def contract_message(store: Typestore, event: Event) -> tuple[str, str, object]:
    """Return topic, type and rosbags message of an event, from the contract's fields."""
    header = _stamp(store, event.stamp_ns)
    if isinstance(event, Detection):
        values = {
            name: getattr(event, name)
            for name in (
                "kind",
                "has_id",
                "m",
                "n",
                "k",
                "offset_x",
                "offset_y",
                "offset_theta",
                "sigma",
                "score",
            )
        }
        topic, typename = "stage/mark_detections", DETECTION_TYPE
    elif isinstance(event, Command):
        view, plate = (
            event.view or View("", grid=False, angular=False, repeats=0),
            event.artifact,
        )
        values = {
            "phase": int(event.phase),
            "plan_id": event.plan_id,
            "view_index": event.view_index,
            "view_name": view.name,
            "rotation": view.rotation_rad,
            "translation_x": view.translation_m[0],
            "translation_y": view.translation_m[1],
            "grid": view.grid,
            "angular": view.angular,
            "repeats": view.repeats,
            "grid_size": plate.grid_size if plate else 0,
            "grid_pitch": plate.grid_pitch_m if plate else 0.0,
            "angular_count": plate.angular_count if plate else 0,
        }
        topic, typename = "selfcal/view_command", COMMAND_TYPE
    else:
        values = {
            "name": list(event.names),
            "position": np.array(event.positions),
            "velocity": np.array(event.velocities),
            "effort": np.array([]),
        }
        topic, typename = "stage/joint_states", ENCODER_TYPE
    names = [name for name, _ in store.fielddefs[typename][1]]
    extra = {
        "temperature": 20.5,
        "operator": "somebody",
        "grid_size_y": 0,
        "views_planned": 3,
    }
    values |= {name: extra[name] for name in names if name in extra}
    kept = {name: value for name, value in values.items() if name in names}
    return topic, typename, store.types[typename](header=header, **kept)


@dataclass(frozen=True)
class Foreign:
    """How a foreign bag is written: the mcap writer's options, and what stands in the bag.

    Attributes
    ----------
    options : dict
        Of mcap.writer.Writer.
    types : rosbags typestore
        Definitions that the bag brings along.
    namespace : str
        Pushed in front of the topics.
    others : bool
        Whether topics of types that are not known here stand beside ours.
    footer : bool
        Whether the file is finished, or ends after the last full chunk.
    schemas, little, encoding, renamed :
        Whether definitions are written, the order of bytes, the encoding of messages, and other
        types of topics.
    """

    options: dict = field(default_factory=dict)
    types: Typestore = field(default_factory=contract_types)
    namespace: str = ""
    others: bool = False
    footer: bool = True
    schemas: bool = True
    little: bool = True
    encoding: str = "cdr"
    renamed: dict[str, str] = field(default_factory=dict)

    def write(
        self,
        path: Path,
        events: Iterable[Event],
        *,
        order: int = 0,
        spoil: bool = False,
    ) -> Path:
        """Write one MCAP file and return its path; `order` turns the order of the channels.

        `spoil` writes empty payloads, for types whose fields the events cannot fill.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("wb") as file:
            writer = Writer(file, **self.options)
            writer.start(profile="ros2", library="by somebody else")
            write = self._channels(writer, order)
            for number, event in enumerate(events):
                topic, data = _empty(event) if spoil else self._payload(event)
                write(topic, event.stamp_ns + 1000, data)
                if self.others and number % 7 == 0:
                    write(
                        "/camera/thing",
                        event.stamp_ns,
                        b"\x00\x01\x00\x00 no CDR at all",
                    )
            if self.footer:
                writer.finish()
            else:
                writer.flush()
        return path

    def _payload(self, event: Event) -> tuple[str, bytes]:
        return _cdr_of(self.types, event, self.little)

    def _channels(
        self, writer: Writer, order: int
    ) -> Callable[[str, int, bytes], None]:
        topics = dict(TOPICS)
        if self.others:
            topics["/camera/thing"] = UNKNOWN_TYPE
        names = [*list(topics)[order:], *list(topics)[:order]]
        ids = {}
        for topic in names:
            typename = self.renamed.get(topic, topics[topic])
            schema = 0
            if self.schemas:
                text = self.types.generate_msgdef(typename, ros_version=2)[0]
                schema = writer.register_schema(typename, "ros2msg", text.encode())
            name = topic if topic.startswith("/") else f"{self.namespace}/{topic}"
            ids[topic] = writer.register_channel(name, self.encoding, schema)
        return lambda topic, time_ns, data: writer.add_message(
            ids[topic], time_ns, data, time_ns
        )


@lru_cache(maxsize=20_000)
def _cdr_of(types: Typestore, event: Event, little: bool) -> tuple[str, bytes]:
    """Return topic and payload of an event; the tests of a module write the same ones."""
    topic, typename, message = contract_message(types, event)
    return topic, bytes(types.serialize_cdr(message, typename, little_endian=little))


def _empty(event: Event) -> tuple[str, bytes]:
    topic, _, _ = contract_message(contract_types(), event)
    return topic, b"\0\1\0\0" + bytes(300)


NO_SUMMARY = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}
COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}


def rosbags_bag(
    path: Path, events: Iterable[Event], mode: CompressionMode = CompressionMode.NONE
) -> Path:
    """Write a folder by the Writer of rosbags, compressed as rosbag2 does."""
    store = contract_types()
    writer = RosbagsWriter(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        links = {
            topic: writer.add_connection(f"/{topic}", typename, typestore=store)
            for topic, typename in TOPICS.items()
        }
        for event in events:
            topic, typename, message = contract_message(store, event)
            writer.write(
                links[topic], event.stamp_ns, store.serialize_cdr(message, typename)
            )
    return path


def split(events: list[Event], parts: int) -> list[list[Event]]:
    """Return the events in consecutive parts."""
    size = -(-len(events) // parts)
    return [events[at : at + size] for at in range(0, len(events), size)]


def shuffled(events: list[Event], seed: int = 1) -> list[Event]:
    """Return the events in another order."""
    out = list(events)
    random.Random(seed).shuffle(out)
    return out
