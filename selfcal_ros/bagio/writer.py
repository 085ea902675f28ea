# SPDX-License-Identifier: Apache-2.0
"""Bags as rosbag2 writes them: MCAP, profile ros2, cdr, ros2msg schemas, metadata.yaml.

A crash keeps what was flushed: chunks go to the disk as they fill, at the latest at every
`flush`, and metadata.yaml, which only sums up, is written last.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

import yaml
from mcap.writer import CompressionType, Writer

from selfcal_ros.bagio.build import build
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.errors import InputError
from selfcal_ros.files import write_text
from selfcal_ros.messages.from_model import Fields

CHUNK_SIZE = 256 * 1024
INFINITE = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(*, reliable: bool, transient_local: bool, depth: int) -> dict:
    """Return one offered QoS profile as rosbag2 (Jazzy) writes it."""
    return {"history": "keep_last", "depth": depth,
            "reliability": "reliable" if reliable else "best_effort",
            "durability": "transient_local" if transient_local else "volatile",
            "deadline": INFINITE, "lifespan": INFINITE, "liveliness": "automatic",
            "liveliness_lease_duration": INFINITE, "avoid_ros_namespace_conventions": False}


@dataclass
class _Topic:
    type: str
    qos: list[dict]
    channel: int
    count: int = 0


@dataclass
class BagWriter:
    """Writes one bag folder; use as a context manager.

    Parameters
    ----------
    path : Path
        Folder to create; it must not exist.
    compression : str
        ``zstd``, ``lz4`` or ``none``.

    Raises
    ------
    InputError
        If the folder exists or cannot be made; from every method, if it cannot be written.
    """

    path: Path
    compression: str = "zstd"
    _topics: dict[str, _Topic] = field(default_factory=dict)
    _schemas: dict[str, int] = field(default_factory=dict)
    _first_ns: int | None = None
    _last_ns: int = 0

    def __post_init__(self) -> None:
        """Create the folder and start the file."""
        self.path = Path(self.path)
        try:
            self.path.mkdir(parents=True)
        except FileExistsError as error:
            raise InputError(str(self.path), "exists already",
                             "remove it or name another folder") from error
        except OSError as error:
            raise InputError(str(self.path), f"cannot be made ({error.strerror})",
                             "name a folder that you may write") from error
        with self._said():
            self._file = (self.path / f"{self.path.name}_0.mcap").open("wb")
            self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE,
                                compression=CompressionType[self.compression.upper()])
            self._mcap.start(profile="ros2", library="selfcal_ros")

    @contextmanager
    def _said(self) -> Iterator[None]:
        """Turn a full disk or a vanished folder into the package's own error."""
        try:
            yield
        except OSError as error:
            raise InputError(str(self.path), f"cannot be written ({error.strerror})",
                             "make room or name another folder") from error

    def add_topic(self, topic: str, typename: str, qos: list[dict]) -> None:
        """Declare a topic of a type known here, before its first message.

        Raises
        ------
        InputError
            If the type is not known here.
        """
        store = typestore()
        if typename not in store.fielddefs:
            raise InputError(f"topic {topic}", f"no definition of {typename}",
                             "record only topics of known types")
        if typename not in self._schemas:
            text = store.generate_msgdef(typename, ros_version=2)[0]
            self._schemas[typename] = self._mcap.register_schema(typename, "ros2msg",
                                                                 text.encode())
        profile = yaml.safe_dump(qos, sort_keys=False) if qos else ""
        channel = self._mcap.register_channel(
            topic, "cdr", self._schemas[typename],
            {"offered_qos_profiles": profile, "topic_type_hash": store.hash_rihs01(typename)})
        self._topics[topic] = _Topic(typename, qos, channel)

    def write(self, topic: str, fields: Fields, log_time_ns: int) -> None:
        """Write one message given by its fields."""
        typename = self._topics[topic].type
        message = build(typestore(), typename, fields)
        self.write_raw(topic, bytes(typestore().serialize_cdr(message, typename)), log_time_ns)

    def write_raw(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Write one message given by its CDR bytes."""
        entry = self._topics[topic]
        entry.count += 1
        self._first_ns = log_time_ns if self._first_ns is None else min(self._first_ns,
                                                                        log_time_ns)
        self._last_ns = max(self._last_ns, log_time_ns)
        with self._said():
            self._mcap.add_message(entry.channel, log_time_ns, data, log_time_ns)

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, topic -> count."""
        return {topic: entry.count for topic, entry in self._topics.items()}

    def flush(self) -> None:
        """Write everything so far to the disk."""
        with self._said():
            self._mcap.flush()

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        if self._file.closed:
            return
        with self._said(), self._file:
            self._mcap.finish()
        write_text(self.path / "metadata.yaml", yaml.safe_dump(self._metadata(), sort_keys=False))

    def _metadata(self) -> dict:
        total = sum(entry.count for entry in self._topics.values())
        start = {"nanoseconds_since_epoch": self._first_ns or 0}
        duration = {"nanoseconds": self._last_ns - (self._first_ns or 0)}
        name = f"{self.path.name}_0.mcap"
        topics = [{"topic_metadata": {
            "name": topic, "type": entry.type, "serialization_format": "cdr",
            "offered_qos_profiles": entry.qos,
            "type_description_hash": typestore().hash_rihs01(entry.type)},
            "message_count": entry.count} for topic, entry in self._topics.items()]
        return {"rosbag2_bagfile_information": {
            "version": 9, "storage_identifier": "mcap", "duration": duration,
            "starting_time": start, "message_count": total,
            "topics_with_message_count": topics, "compression_format": "", "compression_mode": "",
            "relative_file_paths": [name],
            "files": [{"path": name, "starting_time": start, "duration": duration,
                       "message_count": total}],
            "custom_data": None, "ros_distro": "jazzy"}}

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the bag, also after an error: what was measured is kept."""
        self.close()
