# SPDX-License-Identifier: Apache-2.0
"""Bag folders like those of rosbag2 (Jazzy): MCAP with profile ros2, and metadata.yaml.

Flushed messages survive a crash: chunks are written when full, at the latest at every
`flush`, and metadata.yaml, a mere summary, is written last.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import yaml
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from selfcal_ros.bagio.messages.from_model import Fields
from selfcal_ros.bagio.schemas import definition_of, hash_of, store_with
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import creating, temporary_folder, write_text

CHUNK_SIZE = 256 * 1024
UNKNOWN_HASH = "unknown"
"""Hash of the type of a topic recorded without one."""


@contextmanager
def new_bag(path: str | Path) -> Iterator[Path]:
    """Yield a folder to write a bag to, renamed to `path` at the end; removed after an error.

    Raises
    ------
    InputError
        If `path` exists, or cannot be created.
    """
    target = Path(path)
    with _creating_new(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        with temporary_folder(target.parent) as unfinished:
            try:
                yield Path(unfinished, target.name)
            except InputError as error:
                if str(unfinished) not in error.where:
                    raise
                # as asked for
                where = error.where.replace(str(unfinished), str(target.parent))
                raise InputError(where, error.what, error.remedy) from error
            Path(unfinished, target.name).rename(target)


@contextmanager
def _creating_new(folder: Path) -> Iterator[None]:
    """Refuse a folder that exists; convert the errors of creating it to an InputError."""
    with creating(folder):
        if folder.exists():
            raise InputError(
                str(folder), "exists already", "remove it or name another folder"
            )
        yield


def _profiles(metadata: dict[str, str]) -> list[dict]:
    """Return the offered QoS profiles in the metadata of a channel; empty if unreadable."""
    try:
        profiles = yaml.safe_load(metadata.get("offered_qos_profiles", "")) or []
    except yaml.YAMLError:
        return []
    return profiles if isinstance(profiles, list) else []


@contextmanager
def writing(path: Path, what: str = "cannot be written") -> Iterator[None]:
    """Convert a full disk or a missing folder to an InputError."""
    try:
        yield
    except OSError as error:
        raise InputError(
            str(path),
            f"{what} ({error.strerror})",
            "free some space or name another folder",
        ) from error


class Closing(ABC):
    """Context manager closed at the end, also after an error, so that measurements are kept."""

    @abstractmethod
    def close(self) -> None:
        """Complete the output."""

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()


@dataclass
class BagTopic:
    """One topic of a bag: type, offered QoS, and number of messages.

    `heard_on` is the name that it was remapped to; empty = its own. `hash` is the hash of its type,
    which must be known if it is empty.
    """

    type: str
    qos: list[dict]
    count: int = 0
    heard_on: str = ""
    hash: str = ""

    def __post_init__(self) -> None:
        """Look up the hash of a known type."""
        self.hash = self.hash or hash_of(self.type)

    def channel_metadata(self) -> dict[str, str]:
        """Return the metadata of its channel in rosbag2's format, with `heard_on`."""
        about = {
            "offered_qos_profiles": yaml.safe_dump(self.qos, sort_keys=False)
            if self.qos
            else "",
            "topic_type_hash": self.hash,
        }
        return about | ({"heard_on": self.heard_on} if self.heard_on else {})


@dataclass
class FileEntry:
    """One file of a bag: number of messages, first and last log time, ns."""

    name: str
    count: int = 0
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        """Count one message."""
        self.count += 1
        self.first_ns = (
            log_time_ns if self.first_ns is None else min(self.first_ns, log_time_ns)
        )
        self.last_ns = max(self.last_ns, log_time_ns)

    def about(self) -> dict[str, Any]:
        """Return start, duration and count in the format of metadata.yaml."""
        start = self.first_ns or 0
        return {
            "duration": {"nanoseconds": max(self.last_ns - start, 0)},
            "starting_time": {"nanoseconds_since_epoch": start},
            "message_count": self.count,
        }


@dataclass
class Metadata:
    """Content of metadata.yaml."""

    topics: dict[str, BagTopic] = field(default_factory=dict)
    files: list[FileEntry] = field(default_factory=list)

    def write(self, folder: Path) -> None:
        """Write metadata.yaml into the bag's folder, atomically."""
        write_text(
            folder / "metadata.yaml",
            yaml.safe_dump(
                {"rosbag2_bagfile_information": self._information()}, sort_keys=False
            ),
        )

    def _information(self) -> dict[str, Any]:
        firsts = [file.first_ns for file in self.files if file.first_ns is not None]
        bag_entry = FileEntry(
            "",
            sum(file.count for file in self.files),
            min(firsts, default=None),
            max((file.last_ns for file in self.files), default=0),
        )
        about = bag_entry.about()
        topics = [
            {
                "topic_metadata": {
                    "name": name,
                    "type": topic.type,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topic.qos,
                    "type_description_hash": topic.hash,
                },
                "message_count": topic.count,
            }
            for name, topic in self.topics.items()
        ]
        return {
            "version": 9,
            "storage_identifier": "mcap",
            "duration": about["duration"],
            "starting_time": about["starting_time"],
            "message_count": about["message_count"],
            "topics_with_message_count": topics,
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [file.name for file in self.files],
            "files": [
                {
                    "path": file.name,
                    "starting_time": file.about()["starting_time"],
                    "duration": file.about()["duration"],
                    "message_count": file.count,
                }
                for file in self.files
            ],
            "custom_data": None,
            "ros_distro": "jazzy",
        }


@dataclass
class BagWriter(Closing):
    """Write one bag folder; use as a context manager.

    Parameters
    ----------
    path : Path
        Folder to create; it must not exist.
    compression : str
        ``zstd``, ``lz4`` or ``none``.

    Raises
    ------
    InputError
        If the folder exists or cannot be created; from every method, if writing fails.
    """

    path: Path
    compression: str = "zstd"
    _channels: dict[str, int] = field(default_factory=dict)
    _schemas: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Create the folder and start the file."""
        self.path = Path(self.path)
        with _creating_new(self.path):
            self.path.mkdir(parents=True)
        self._entry = FileEntry(f"{self.path.name}_0.mcap")
        self._metadata = Metadata(files=[self._entry])
        with writing(self.path):
            self._file = (self.path / self._entry.name).open("wb")
            self._mcap = Writer(
                self._file,
                chunk_size=CHUNK_SIZE,
                compression=CompressionType[self.compression.upper()],
            )
            self._mcap.start(profile="ros2", library="selfcal_ros")

    def add_topic(
        self, topic: str, typename: str, qos: list[dict], heard_on: str = ""
    ) -> None:
        """Declare a topic of a known type, before its first message.

        Parameters
        ----------
        topic, typename : str
            Its name in the bag and its type.
        qos : list of dict
            Offered profiles.
        heard_on : str, optional
            Its name in the graph, if different.

        Raises
        ------
        InputError
            If the type is not known here.
        """
        definition = definition_of(topic, typename)
        if typename not in self._schemas:
            self._schemas[typename] = self._mcap.register_schema(
                typename, "ros2msg", definition.encode()
            )
        self._metadata.topics[topic] = declared = BagTopic(
            typename, qos, heard_on=heard_on
        )
        self._channels[topic] = self._mcap.register_channel(
            topic, "cdr", self._schemas[typename], declared.channel_metadata()
        )

    def add_copy(self, channel: Channel, schema: Schema | None) -> int:
        """Declare a channel of another bag, of any type, as it is; return its number here."""
        name = schema.name if schema else ""
        number = (
            self._mcap.register_schema(name, schema.encoding, schema.data)
            if schema
            else 0
        )
        about = dict(channel.metadata)
        self._metadata.topics.setdefault(
            channel.topic,
            BagTopic(
                name, _profiles(about), hash=about.get("topic_type_hash", UNKNOWN_HASH)
            ),
        )
        return self._mcap.register_channel(
            channel.topic, channel.message_encoding, number, about
        )

    def copy(self, number: int, topic: str, message: Message) -> None:
        """Write a message of another bag on channel `number`."""
        self._metadata.topics[topic].count += 1
        self._entry.add(message.log_time)
        with writing(self.path):
            self._mcap.add_message(
                number,
                message.log_time,
                message.data,
                message.publish_time,
                message.sequence,
            )

    def write(self, topic: str, fields: Fields, log_time_ns: int) -> None:
        """Write one message given by its fields."""
        typename = self._metadata.topics[topic].type
        self.write_raw(topic, cdr_bytes(typename, fields), log_time_ns)

    def write_raw(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Write one message given by its CDR bytes."""
        self._metadata.topics[topic].count += 1
        self._entry.add(log_time_ns)
        with writing(self.path):
            self._mcap.add_message(
                self._channels[topic], log_time_ns, data, log_time_ns
            )

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, topic -> count."""
        return {name: topic.count for name, topic in self._metadata.topics.items()}

    def flush(self) -> None:
        """Write all messages so far to the disk."""
        with writing(self.path):
            self._mcap.flush()

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        if self._file.closed:
            return
        with writing(self.path), self._file:
            self._mcap.finish()
        self._metadata.write(self.path)


def cdr_bytes(typename: str, fields: Fields) -> bytes:
    """Return the CDR bytes of a message of a known type."""
    store = store_with(typename)
    return bytes(store.serialize_cdr(build(store, typename, fields), typename))


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
