# SPDX-License-Identifier: Apache-2.0
"""A bag folder: its metadata.yaml, as rosbag2 (Jazzy) writes it, and what its writers share."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import yaml

from selfcal_ros.bagio.schemas import hash_of
from selfcal_ros.errors import InputError
from selfcal_ros.files import write_text


@contextmanager
def writing(path: Path, what: str = "cannot be written") -> Iterator[None]:
    """Turn a full disk or a vanished folder into the package's own error."""
    try:
        yield
    except OSError as error:
        raise InputError(str(path), f"{what} ({error.strerror})",
                         "make room or name another folder") from error


class Closing(ABC):
    """What is closed at the end of a ``with``, also after an error: what was measured is kept."""

    @abstractmethod
    def close(self) -> None:
        """Finish what was written."""

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close it."""
        self.close()


@dataclass
class Topic:
    """One topic of a bag: its type, the QoS offered, and how many messages it has.

    `heard_on` is the name that it was remapped to; empty = its own.
    """

    type: str
    qos: list[dict]
    count: int = 0
    heard_on: str = ""

    def channel_metadata(self) -> dict[str, str]:
        """Return the metadata of its channel as rosbag2 writes it, and where it was heard."""
        about = {"offered_qos_profiles": yaml.safe_dump(self.qos, sort_keys=False)
                 if self.qos else "", "topic_type_hash": hash_of(self.type)}
        return about | ({"heard_on": self.heard_on} if self.heard_on else {})


@dataclass
class FileEntry:
    """One file of a bag: its messages, and when the first and the last were logged, ns."""

    name: str
    count: int = 0
    first_ns: int | None = None
    last_ns: int = 0

    def add(self, log_time_ns: int) -> None:
        """Count one message."""
        self.count += 1
        self.first_ns = log_time_ns if self.first_ns is None else min(self.first_ns, log_time_ns)
        self.last_ns = max(self.last_ns, log_time_ns)

    def about(self) -> dict[str, Any]:
        """Return start, duration and count as metadata.yaml has them."""
        start = self.first_ns or 0
        return {"duration": {"nanoseconds": max(self.last_ns - start, 0)},
                "starting_time": {"nanoseconds_since_epoch": start},
                "message_count": self.count}


@dataclass
class Metadata:
    """What metadata.yaml says of a bag."""

    topics: dict[str, Topic] = field(default_factory=dict)
    files: list[FileEntry] = field(default_factory=list)

    def write(self, folder: Path) -> None:
        """Write metadata.yaml into the bag's folder, atomically."""
        write_text(folder / "metadata.yaml", yaml.safe_dump(
            {"rosbag2_bagfile_information": self._information()}, sort_keys=False))

    def _information(self) -> dict[str, Any]:
        firsts = [file.first_ns for file in self.files if file.first_ns is not None]
        whole = FileEntry("", sum(file.count for file in self.files), min(firsts, default=None),
                          max((file.last_ns for file in self.files), default=0))
        about = whole.about()
        topics = [{"topic_metadata": {
            "name": name, "type": topic.type, "serialization_format": "cdr",
            "offered_qos_profiles": topic.qos,
            "type_description_hash": hash_of(topic.type)},
            "message_count": topic.count} for name, topic in self.topics.items()]
        return {
            "version": 9, "storage_identifier": "mcap", "duration": about["duration"],
            "starting_time": about["starting_time"], "message_count": about["message_count"],
            "topics_with_message_count": topics, "compression_format": "", "compression_mode": "",
            "relative_file_paths": [file.name for file in self.files],
            "files": [{"path": file.name, "starting_time": file.about()["starting_time"],
                       "duration": file.about()["duration"], "message_count": file.count}
                      for file in self.files],
            "custom_data": None, "ros_distro": "jazzy"}
