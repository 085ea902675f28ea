# SPDX-License-Identifier: Apache-2.0
"""Bags of any origin: an MCAP file or a rosbag2 folder, read for the topics of this package."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from mcap.records import Channel

from selfcal_ros.bagio.mcap_stream import McapStream
from selfcal_ros.bagio.schemas import store_of_schema
from selfcal_ros.errors import InputError

COMMAND_TOPIC = "selfcal/view_command"
DETECTION_TOPIC = "stage/mark_detections"
ENCODER_TOPIC = "stage/joint_states"
INPUT_TOPICS = {
    ENCODER_TOPIC: "sensor_msgs/msg/JointState",
    DETECTION_TOPIC: "selfcal_msgs/msg/MarkDetection",
    COMMAND_TOPIC: "selfcal_msgs/msg/ViewCommand",
}
REQUIRED_FIELDS = {
    ENCODER_TOPIC: {"header", "name", "position"},
    DETECTION_TOPIC: {"header", "kind", "has_id", "m", "n", "k", "offset_x", "offset_y",
                      "offset_theta", "sigma", "score"},
    COMMAND_TOPIC: {"header", "phase", "plan_id", "view_index", "view_name", "rotation",
                    "translation_x", "translation_y", "grid", "angular", "repeats", "grid_size",
                    "grid_pitch", "angular_count"},
}


@dataclass(frozen=True, slots=True)
class RawMessage:
    """One message as the bag has it: topic, type, time of logging in ns, CDR bytes, QoS text."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes
    qos: str


@dataclass
class BagReader:
    """Reads one bag.

    Parameters
    ----------
    path : Path
        MCAP file or rosbag2 folder, with or without metadata.yaml.
    namespace : str
        Namespace of the topics, for bags that hold several cells; empty = the only one.

    Attributes
    ----------
    lost : list of str
        What could not be read, one line each, after reading.
    cells : set of str
        Namespaces of the input topics that were met, without slashes.
    """

    path: Path
    namespace: str = ""
    lost: list[str] = field(default_factory=list)
    cells: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Find the MCAP files, refuse what is no bag."""
        self.path = Path(self.path)
        if not self.path.exists():
            raise InputError(str(self.path), "no such file or folder", "check the path")
        self.files = self._files()

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        names = self._listed() or sorted((p.name for p in self.path.glob("*.mcap")), key=_natural)
        files = []
        for name in names:
            if (self.path / name).is_file():
                files.append(self.path / name)
            else:
                self.lost.append(f"the file {name}, which metadata.yaml lists, is missing")
        if not files:
            raise InputError(str(self.path), "no .mcap file in this folder",
                             "give an MCAP file or a rosbag2 folder with MCAP storage")
        return files

    def _listed(self) -> list[str]:
        metadata = self.path / "metadata.yaml"
        if not metadata.is_file():
            return []
        try:
            info = yaml.safe_load(metadata.read_text())["rosbag2_bagfile_information"]
            names = [Path(name).name for name in info["relative_file_paths"]]
        except (yaml.YAMLError, KeyError, TypeError, ValueError):
            self.lost.append("metadata.yaml is damaged and was not used")
            return []
        return [name for name in names if name.endswith(".mcap")]

    def raw_messages(self) -> Iterator[RawMessage]:
        """Yield every message of the bag, of all topics, in the order of the file."""
        for stream, channel, message in self._all():
            schema = stream.schemas.get(channel.schema_id)
            yield RawMessage(channel.topic, schema.name if schema else "", message.log_time,
                             message.data, channel.metadata.get("offered_qos_profiles", ""))

    def _all(self) -> Iterator[tuple[McapStream, Channel, object]]:
        for file in self.files:
            stream = McapStream(file, lost=self.lost)
            for channel, message in stream.messages():
                yield stream, channel, message

    def messages(self) -> Iterator[tuple[str, object]]:
        """Yield (topic, decoded message) of the three input topics, names without namespace.

        Raises as `stamped_messages`.
        """
        for topic, _, message in self.stamped_messages():
            yield topic, message

    def stamped_messages(self) -> Iterator[tuple[str, int, object]]:
        """Yield (topic, time of logging in ns, decoded message) of the three input topics.

        Raises
        ------
        InputError
            If a topic has another type, encoding or message version than the contract's, or the
            bag holds several namespaces.
        """
        decoders: dict[tuple[Path, int], tuple[str, Callable] | None] = {}
        bad: Counter = Counter()
        for stream, channel, message in self._all():
            key = (stream.path, channel.id)
            if key not in decoders:
                decoders[key] = self._decoder(stream, channel)
            entry = decoders[key]
            if entry is None:
                continue
            try:
                decoded = entry[1](message.data)
            except Exception:  # a damaged payload may fail anywhere in the decoder
                bad[entry[0]] += 1
                continue
            yield entry[0], message.log_time, decoded
        self.lost += [f"{count} messages on {topic} could not be decoded"
                      for topic, count in bad.items()]

    def _decoder(self, stream: McapStream, channel: Channel) -> tuple[str, Callable] | None:
        role = self._role(channel.topic)
        if role is None:
            return None
        where = f"{self.path}: topic {channel.topic}"
        schema = stream.schemas.get(channel.schema_id)
        name = schema.name if schema else INPUT_TOPICS[role]
        if channel.message_encoding != "cdr":
            raise InputError(where, f"message encoding '{channel.message_encoding}' instead of "
                             "cdr", "convert the bag to ROS 2, e.g. with rosbags-convert")
        if name != INPUT_TOPICS[role]:
            raise InputError(where, f"type {name} instead of {INPUT_TOPICS[role]}",
                             "remap the topic or record the right one")
        text = schema.data.decode(errors="replace") if schema else ""
        store = store_of_schema(name, schema.encoding if schema else "ros2msg", text, where)
        fields = {item[0] for item in store.fielddefs[name][1]}
        missing = sorted(REQUIRED_FIELDS[role] - fields)
        if missing:
            raise InputError(where, f"another version of {name}: no field '{missing[0]}'",
                             "record the bag with the messages of this version")
        return role, lambda data: store.deserialize_cdr(data, name)

    def _role(self, topic: str) -> str | None:
        for role in INPUT_TOPICS:
            if topic != role and not topic.endswith("/" + role):
                continue
            space = topic.removesuffix(role).strip("/")
            self.cells.add(space)
            if self.namespace:
                return role if space == self.namespace.strip("/") else None
            if len(self.cells) > 1:
                raise InputError(str(self.path), "topics of two cells, "
                                 + " and ".join(f"'/{name}'" for name in sorted(self.cells)),
                                 "choose one with --namespace")
            return role
        return None


def _natural(name: str) -> list:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
