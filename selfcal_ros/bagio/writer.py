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

from mcap.writer import CompressionType, Writer

from selfcal_ros.bagio.build import build
from selfcal_ros.bagio.metadata import FileEntry, Metadata, Topic, qos_profile
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.errors import InputError
from selfcal_ros.messages.from_model import Fields

__all__ = ["BagWriter", "qos_profile"]
CHUNK_SIZE = 256 * 1024


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
    _channels: dict[str, int] = field(default_factory=dict)
    _schemas: dict[str, int] = field(default_factory=dict)

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
        self._entry = FileEntry(f"{self.path.name}_0.mcap")
        self._metadata = Metadata(files=[self._entry])
        with self._said():
            self._file = (self.path / self._entry.name).open("wb")
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

    def add_topic(self, topic: str, typename: str, qos: list[dict], heard_on: str = "") -> None:
        """Declare a topic of a type known here, before its first message.

        Parameters
        ----------
        topic, typename : str
            Its name in the bag and its type.
        qos : list of dict
            What is offered.
        heard_on : str, optional
            Its name in the graph, where that is another one.

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
        self._metadata.topics[topic] = declared = Topic(typename, qos, heard_on=heard_on)
        self._channels[topic] = self._mcap.register_channel(
            topic, "cdr", self._schemas[typename], declared.channel_metadata())

    def write(self, topic: str, fields: Fields, log_time_ns: int) -> None:
        """Write one message given by its fields."""
        typename = self._metadata.topics[topic].type
        message = build(typestore(), typename, fields)
        self.write_raw(topic, bytes(typestore().serialize_cdr(message, typename)), log_time_ns)

    def write_raw(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Write one message given by its CDR bytes."""
        self._metadata.topics[topic].count += 1
        self._entry.add(log_time_ns)
        with self._said():
            self._mcap.add_message(self._channels[topic], log_time_ns, data, log_time_ns)

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, topic -> count."""
        return {name: topic.count for name, topic in self._metadata.topics.items()}

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
        self._metadata.write(self.path)

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the bag, also after an error: what was measured is kept."""
        self.close()
