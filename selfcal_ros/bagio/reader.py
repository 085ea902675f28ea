# SPDX-License-Identifier: Apache-2.0
"""Bags of any origin: an MCAP file or a rosbag2 folder, read for the topics of this package."""

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.records import Channel, Message
from rosbags.serde import SerdeError
from rosbags.typesys.store import Typestore

from selfcal_ros.bagio.mcap_stream import McapStream
from selfcal_ros.bagio.schemas import (
    other_field,
    own_message,
    same_layout,
    shorter_stores,
    store_of_schema,
    typestore,
)
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.messages.topics import COMMAND_TOPIC, DETECTION_TOPIC, ENCODER_TOPIC, INPUT_TOPICS

LAST_FIELDS = {ENCODER_TOPIC: "position", DETECTION_TOPIC: "score", COMMAND_TOPIC: "angular_count"}
"""Last field that the contract asks for; what stands behind it may be missing."""
SUFFIXES = (".mcap", ".mcap.zstd")
LITTLE_ENDIAN = 1
"""Second byte of CDR."""


@dataclass(frozen=True)
class _Decoder:
    """How the messages of a channel are decoded.

    `own` tells that their type is the one known here, `why` what to say if they do not decode.
    """

    role: str
    decode: Callable[[bytes], object]
    own: bool
    why: str = ""


@dataclass
class BagReader:
    """Reads one bag.

    Parameters
    ----------
    path : Path
        MCAP file or rosbag2 folder, with or without metadata.yaml.
    namespace : str or None
        Namespace of the topics, for bags that hold several cells; empty = the root, None = the
        only one.

    Attributes
    ----------
    lost : list of str
        What could not be read, one line each, after reading.
    cells : set of str
        Namespaces of the input topics that were met, without slashes.
    """

    path: Path
    namespace: str | None = None
    lost: list[str] = field(default_factory=list)
    cells: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        """Find the MCAP files, refuse what is no bag."""
        self.path = Path(self.path)
        try:
            self.path.stat()
            self.files = self._files()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise InputError(str(self.path), "no such file or folder", "check the path") from error
        except OSError as error:
            raise InputError(str(self.path), f"cannot be read ({error.strerror})",
                             "name a readable file or folder") from error

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        if not self.path.is_dir():
            raise InputError(str(self.path), "neither a file nor a folder",
                             "give an MCAP file or a rosbag2 folder")
        there = {p.name for p in self.path.iterdir() if p.name.endswith(SUFFIXES) and p.is_file()}
        names = self._listed() or sorted(
            (name for name in there if name.removesuffix(".zstd") not in there - {name}),
            key=_natural)
        for name in names:
            if name not in there:
                self.lost.append(f"the file {name}, which metadata.yaml lists, is missing")
        files = [self.path / name for name in names if name in there]
        if not files:
            raise InputError(str(self.path), "no .mcap file in this folder",
                             "give an MCAP file or a rosbag2 folder with MCAP storage")
        return files

    def _listed(self) -> list[str]:
        metadata = self.path / "metadata.yaml"
        if not metadata.is_file():
            return []
        try:
            info = read_yaml(metadata)["rosbag2_bagfile_information"]
            names = [Path(name).name for name in info["relative_file_paths"]]
        except (InputError, KeyError, TypeError, ValueError):
            self.lost.append("metadata.yaml is damaged and was not used")
            return []
        return [name for name in dict.fromkeys(names) if name.endswith(SUFFIXES)]

    def _all(self) -> Iterator[tuple[McapStream, Channel, Message]]:
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
        for role, stamp, decoded, _ in self._decoded():
            yield role, stamp, decoded

    def cdr_messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, time of logging in ns, CDR bytes) of the three input topics.

        The bytes are of the types known here, whatever fields the bag's have. What cannot be
        decoded is left out as in `messages`, so that both say the same. Raises as they do.
        """
        for role, stamp, decoded, data in self._decoded():
            name = INPUT_TOPICS[role]
            yield role, stamp, data or bytes(
                typestore().serialize_cdr(own_message(decoded, name), name))

    def _decoded(self) -> Iterator[tuple[str, int, object, bytes]]:
        """Yield topic, time, message, and its bytes if they are of the type known here."""
        decoders: dict[tuple[Path, int], _Decoder | None] = {}
        bad: Counter = Counter()
        for stream, channel, message in self._all():
            key = (stream.path, channel.id)
            if key not in decoders:
                decoders[key] = self._decoder(stream, channel)
            decoder = decoders[key]
            if decoder is None:
                continue
            try:
                decoded = decoder.decode(message.data)
            except Exception:  # a damaged payload may fail anywhere in the decoder
                bad[decoder.role, decoder.why] += 1
                continue
            own = decoder.own and message.data[1] == LITTLE_ENDIAN
            yield decoder.role, message.log_time, decoded, message.data if own else b""
        self.lost += [f"{count} messages on {role} could not be decoded{why}"
                      for (role, why), count in bad.items()]

    def _decoder(self, stream: McapStream, channel: Channel) -> _Decoder | None:
        """Return how a channel is decoded, None for a topic that is not ours."""
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
        if not text.strip():
            stores = [store, *shorter_stores(name, LAST_FIELDS[role])]
            return _Decoder(role, lambda data: _first_that_fits(stores, name, data), False, (
                f": the bag holds no definition of {name}, and they do not fit the one known here"))
        other = other_field(store, name, LAST_FIELDS[role])
        if other:
            raise InputError(where, f"another version of {name}: {other}",
                             "record the bag with the messages of this version")
        return _Decoder(role, lambda data: store.deserialize_cdr(data, name),
                        same_layout(store, name))

    def _role(self, topic: str) -> str | None:
        for role in INPUT_TOPICS:
            if topic != role and not topic.endswith("/" + role):
                continue
            space = topic.removesuffix(role).strip("/")
            self.cells.add(space)
            if self.namespace is not None:
                return role if space == self.namespace.strip("/") else None
            if len(self.cells) > 1:
                raise InputError(str(self.path), "topics of two cells, "
                                 + " and ".join(f"'/{name}'" for name in sorted(self.cells)),
                                 "choose one with --namespace")
            return role
        return None


def _first_that_fits(stores: list[Typestore], name: str, data: bytes) -> object:
    """Decode by the first definition whose length is that of the payload."""
    for store in stores[:-1]:
        try:
            return store.deserialize_cdr(data, name)
        except SerdeError:
            continue
    return stores[-1].deserialize_cdr(data, name)


def _natural(name: str) -> list:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
