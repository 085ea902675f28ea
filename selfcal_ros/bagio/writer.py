# SPDX-License-Identifier: Apache-2.0
"""Bags as rosbag2 writes them: MCAP, profile ros2, cdr, ros2msg schemas, metadata.yaml.

A crash keeps what was flushed: chunks go to the disk as they fill, at the latest at every
`flush`, and metadata.yaml, which only sums up, is written last.
"""

from dataclasses import dataclass, field
from pathlib import Path

from mcap.writer import CompressionType, Writer

from selfcal_ros.bagio.build import build
from selfcal_ros.bagio.metadata import (
    Closing,
    FileEntry,
    Metadata,
    Topic,
    writing,
)
from selfcal_ros.bagio.schemas import definition_of, store_with
from selfcal_ros.errors import InputError
from selfcal_ros.messages.from_model import Fields

CHUNK_SIZE = 256 * 1024


@dataclass
class BagWriter(Closing):
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
        with writing(self.path):
            self._file = (self.path / self._entry.name).open("wb")
            self._mcap = Writer(self._file, chunk_size=CHUNK_SIZE,
                                compression=CompressionType[self.compression.upper()])
            self._mcap.start(profile="ros2", library="selfcal_ros")

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
        definition = definition_of(topic, typename)
        if typename not in self._schemas:
            self._schemas[typename] = self._mcap.register_schema(typename, "ros2msg",
                                                                 definition.encode())
        self._metadata.topics[topic] = declared = Topic(typename, qos, heard_on=heard_on)
        self._channels[topic] = self._mcap.register_channel(
            topic, "cdr", self._schemas[typename], declared.channel_metadata())

    def write(self, topic: str, fields: Fields, log_time_ns: int) -> None:
        """Write one message given by its fields."""
        typename = self._metadata.topics[topic].type
        store = store_with(typename)
        message = build(store, typename, fields)
        self.write_raw(topic, bytes(store.serialize_cdr(message, typename)), log_time_ns)

    def write_raw(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Write one message given by its CDR bytes."""
        self._metadata.topics[topic].count += 1
        self._entry.add(log_time_ns)
        with writing(self.path):
            self._mcap.add_message(self._channels[topic], log_time_ns, data, log_time_ns)

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, topic -> count."""
        return {name: topic.count for name, topic in self._metadata.topics.items()}

    def flush(self) -> None:
        """Write everything so far to the disk."""
        with writing(self.path):
            self._mcap.flush()

    def close(self) -> None:
        """Finish the file and write metadata.yaml."""
        if self._file.closed:
            return
        with writing(self.path), self._file:
            self._mcap.finish()
        self._metadata.write(self.path)
