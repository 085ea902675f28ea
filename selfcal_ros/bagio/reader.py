# SPDX-License-Identifier: Apache-2.0
"""Bags of any origin: topics of this package from an MCAP file or a rosbag2 folder."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.records import Channel

from selfcal_ros.bagio.mcap_chunk import MessageBlock
from selfcal_ros.bagio.mcap_stream import CONVERT, McapStream, streams
from selfcal_ros.bagio.messages.to_model import first_stamps_ns
from selfcal_ros.bagio.schemas import (
    ChannelDecoder,
    Input,
    Waiting,
    other_field,
    shorter_stores,
    store_of_schema,
)
from selfcal_ros.collection.clock_steps import ClockStep, StepWatch, future_lines
from selfcal_ros.collection.inputs import MAX_AHEAD_NS
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
)
from selfcal_ros.units import NS_PER_S

LAST_FIELDS = {
    ENCODER_TOPIC: "position",
    DETECTION_TOPIC: "score",
    COMMAND_TOPIC: "angular_count",
}
"""Last field required by the contract; later ones may be missing."""
SUFFIXES = (".mcap", ".mcap.zstd")
CLOCK_LIMIT_S = CollectorSettings().clock_limit
LOOKED_AT = 500
"""Number of stamps of a topic per chunk that are compared with the log times."""
NEVER_NS = np.iinfo(np.int64).max


def step_watches(limit_s: float) -> dict[str, StepWatch]:
    """Return a watch of the clock of each topic whose steps are told."""
    return {role: StepWatch(limit_s) for role in (ENCODER_TOPIC, DETECTION_TOPIC)}


@dataclass
class BagReader:
    """Read one bag.

    Parameters
    ----------
    path : Path
        MCAP file or rosbag2 folder, with or without metadata.yaml.
    namespace : str or None
        Namespace of the topics, for bags with several cells; empty = the root, None = the
        only one.
    clock_limit_s : float
        Larger clock steps are recorded.
    leave_ahead : bool
        Omit messages stamped ahead of their log time.
    watches : dict, optional
        Topic -> watch of its clock, that has seen the file before this one.

    Attributes
    ----------
    lost : list of str
        Unreadable parts, one line each, after reading.
    steps : dict
        Topic -> steps of the clock that stamps it, after reading.
    ahead : Counter
        Topic -> number of messages stamped ahead of their log time, after reading, omitted or not.
    cells : set of str
        Namespaces of the input topics found, without slashes.
    topics : dict of str
        All topics of the bag and their types, after reading.
    """

    path: Path
    namespace: str | None = None
    clock_limit_s: float = CLOCK_LIMIT_S
    leave_ahead: bool = False
    watches: dict[str, StepWatch] | None = None
    lost: list[str] = field(default_factory=list)
    steps: dict[str, list[ClockStep]] = field(default_factory=dict)
    ahead: Counter = field(default_factory=Counter)
    cells: set[str] = field(default_factory=set)
    topics: dict[str, str] = field(default_factory=dict)
    _n_commands: int = 0

    def __post_init__(self) -> None:
        """Find the MCAP files; refuse anything that is not a bag."""
        self.path = Path(self.path)
        try:
            self.path.stat()
            self.files = self._files()
        except (FileNotFoundError, NotADirectoryError) as error:
            raise InputError(
                str(self.path), "no such file or folder", "check the path"
            ) from error
        except OSError as error:
            raise InputError(
                str(self.path),
                f"cannot be read ({error.strerror})",
                "name a readable file or folder",
            ) from error

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        if not self.path.is_dir():
            raise InputError(
                str(self.path),
                "neither a file nor a folder",
                "give an MCAP file or a rosbag2 folder",
            )
        present = {
            p.name
            for p in self.path.iterdir()
            if p.name.endswith(SUFFIXES) and p.is_file()
        }
        recordings = sorted(
            (
                name
                for name in present
                if name.removesuffix(".zstd") not in present - {name}
            ),
            key=_natural,
        )
        listed = self._files_of_metadata()
        # the files may have been renamed
        names = listed if present.intersection(listed) else recordings
        instead = [name for name in names if name not in listed]
        were = "were" if len(instead) > 1 else "was"
        note = f"; {', '.join(instead)} {were} read" if instead else ""
        for name in listed:
            if name not in present:
                self.lost.append(
                    f"the file {name}, which metadata.yaml lists, is missing{note}"
                )
        plain = {name.removesuffix(".zstd") for name in names}
        for name in recordings:
            if name.removesuffix(".zstd") not in plain:
                self.lost.append(
                    f"the file {name}, which metadata.yaml does not list, was not used"
                )
        files = [self.path / name for name in names if name in present]
        if not files and any(p.suffix == ".db3" for p in self.path.iterdir()):
            raise InputError(str(self.path), "a bag with sqlite3 storage", CONVERT)
        if not files:
            missing = f"; {', '.join(listed)}, which metadata.yaml lists, is missing"
            raise InputError(
                str(self.path),
                "no .mcap file in this folder" + missing * bool(listed),
                "give an MCAP file or a rosbag2 folder with MCAP storage",
            )
        return files

    def _files_of_metadata(self) -> list[str]:
        metadata = self.path / "metadata.yaml"
        if not metadata.is_file():
            return []
        try:
            info = read_yaml(metadata)["rosbag2_bagfile_information"]
            names = [Path(name).name for name in info["relative_file_paths"]]
        except (InputError, KeyError, TypeError, ValueError):
            self.lost.append("metadata.yaml is damaged and was not used")
            return []
        others = [
            path for path in info["relative_file_paths"] if not path.endswith(SUFFIXES)
        ]
        if others:
            shown = ", ".join(map(repr, others))[:200]
            self.lost.append(
                f"metadata.yaml lists {shown}, not an .mcap file: it was not read"
            )
        elif not names:
            self.lost.append("metadata.yaml lists no file and was not used")
        return [name for name in dict.fromkeys(names) if name.endswith(SUFFIXES)]

    @property
    def mixes_clocks(self) -> bool:
        """Whether messages are stamped ahead of their log time, and some commands are not.

        A live collector refuses such messages, as they would hide later ones stamped by a correct
        clock. If all commands are like that, the log times are useless.
        """
        return bool(self.ahead.total()) and self._n_commands > self.ahead[COMMAND_TOPIC]

    def future_lines(self) -> list[str]:
        """Return a line, after reading, if messages were stamped ahead of their log time."""
        if self.leave_ahead or not self.ahead:
            return future_lines(self.ahead)
        return [
            f"{COMMAND_TOPIC}: stamped more than {MAX_AHEAD_NS // NS_PER_S} s ahead of its "
            "log time: a live collector refuses it; set the clock that stamps, or the "
            "recorder's"
        ]

    def cdr_messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield (topic, log time in ns, CDR bytes) of the three input topics.

        The bytes are of the types known here, whatever the fields in the bag. Undecodable
        messages are omitted and counted.

        Raises
        ------
        InputError
            If a topic has another type, encoding or message version than the contract's, or the
            bag holds several namespaces.
        """
        bad: Counter = Counter()
        for block, parts in self._blocks(bad):
            numbered = [
                (number, decoder.role, data)
                for decoder, index in parts
                for number, data in decoder.own_bytes(block.payloads[index], index)
            ]
            stamps = block.fronts["log_time"].tolist()
            for number, role, data in sorted(numbered, key=lambda item: item[0]):
                yield role, stamps[number], data
        self._say(bad)

    def columns(self) -> Iterator[tuple[str, Input]]:
        """Yield topic and a block of decoded messages; commands singly.

        The order of messages is not kept. Raises as `cdr_messages`.
        """
        bad: Counter = Counter()
        waiting: dict[int, Waiting] = {}
        for block, parts in self._blocks(bad):
            for decoder, index in parts:
                queue = waiting.setdefault(id(decoder), Waiting(decoder))
                for item in queue.add(block.payloads[index]):
                    yield decoder.role, item
        for queue in waiting.values():
            for item in queue.rest():
                yield queue.decoder.role, item
        self._say(bad)

    def _streams(self) -> Iterator[tuple[McapStream, MessageBlock]]:
        """Yield the blocks of all files; an unreadable file is skipped if another is readable."""
        refused: list[InputError] = []
        for file in self.files:
            lost: list[str] = []
            for stream in streams([file], lost, lambda topic: bool(_roles(topic))):
                try:
                    for block in stream.blocks():
                        yield stream, block
                except InputError as error:
                    refused.append(error)
                    self.lost.append(f"the file {file.name} was not read: {error.what}")
                for channel in stream.channels.values():
                    schema = stream.schemas.get(channel.schema_id)
                    self.topics[channel.topic] = schema.name if schema else ""
            name = f"{file.name}: " if len(self.files) > 1 else ""
            self.lost += [name + line for line in lost]
        if len(refused) == len(self.files):
            raise refused[0]

    def _blocks(
        self, bad: Counter
    ) -> Iterator[tuple[MessageBlock, list[tuple[ChannelDecoder, np.ndarray]]]]:
        """Yield each block with the indices of its messages on our topics, by channel."""
        watches = (
            step_watches(self.clock_limit_s) if self.watches is None else self.watches
        )
        decoders: dict[tuple[Path, int, int], ChannelDecoder | None] = {}
        latest_ns, part = 0, None
        for stream, block in self._streams():
            parts = []
            for number in block.channels():
                key = (stream.path, stream.begin, number)
                if key not in decoders:
                    decoders[key] = self._decoder(stream, stream.channels[number], bad)
                decoder = decoders[key]
                if decoder is not None:
                    parts.append(
                        (
                            decoder,
                            self._in_time(
                                decoder.role,
                                block,
                                np.flatnonzero(block.fronts["channel"] == number),
                            ),
                        )
                    )
            used = [index for _, index in parts if len(index)]
            if used:
                logged_ns = block.fronts["log_time"][np.concatenate(used)]
                by_ns = latest_ns - int(logged_ns.min())
                if (
                    stream.path,
                    stream.begin,
                ) != part and by_ns > self.clock_limit_s * NS_PER_S:
                    self.lost.append(
                        f"{overlap(stream, by_ns)}; each reading counts once"
                    )
                    watches.update(step_watches(self.clock_limit_s))
                part = (stream.path, stream.begin)
                latest_ns = max(latest_ns, int(logged_ns.max()))
            for decoder, index in parts:
                if decoder.role in watches:
                    self._note_steps(
                        watches[decoder.role],
                        decoder.role,
                        block[index[:: _stride(index)]],
                    )
            yield block, parts

    def _in_time(self, role: str, block: MessageBlock, index: np.ndarray) -> np.ndarray:
        """Count messages stamped ahead of their log time; return the indices to be read."""
        self._n_commands += len(index) * (role == COMMAND_TOPIC)
        if role == ENCODER_TOPIC and not _ahead(block, index[:: _stride(index)]).any():
            return index
        ahead = _ahead(block, index)
        if not ahead.any():
            return index
        self.ahead[role] += int(ahead.sum())
        return index[~ahead] if self.leave_ahead else index

    def _note_steps(self, watch: StepWatch, role: str, block: MessageBlock) -> None:
        stamps, has_header = first_stamps_ns(block.payloads)
        steps = watch.add(stamps, block.fronts["log_time"][has_header].astype(np.int64))
        self.steps.setdefault(role, []).extend(steps)

    def _say(self, bad: Counter) -> None:
        self.lost += [
            f"{count} messages on {role} could not be decoded{why}"
            for (role, why), count in bad.items()
        ]

    def _decoder(
        self, stream: McapStream, channel: Channel, bad: Counter
    ) -> ChannelDecoder | None:
        """Return the decoder of a channel, None for another topic."""
        role = self._role(channel.topic)
        if role is None:
            return None
        where = f"{self.path}: topic {channel.topic}"
        schema = stream.schemas.get(channel.schema_id)
        name = schema.name if schema else INPUT_TOPICS[role]
        if channel.message_encoding != "cdr":
            raise InputError(
                where,
                f"message encoding '{channel.message_encoding}' instead of cdr",
                "convert the bag to ROS 2, e.g. with rosbags-convert",
            )
        if name != INPUT_TOPICS[role]:
            raise InputError(
                where,
                f"type {name} instead of {INPUT_TOPICS[role]}",
                "remap the topic or record the right one",
            )
        text = schema.data.decode(errors="replace") if schema else ""
        store = store_of_schema(
            name, schema.encoding if schema else "ros2msg", text, where
        )
        if not text.strip():
            return ChannelDecoder(
                role,
                name,
                (store, *shorter_stores(name, LAST_FIELDS[role])),
                bad,
                told=False,
            )
        difference = other_field(store, name, LAST_FIELDS[role])
        if difference:
            raise InputError(
                where,
                f"another version of {name}: {difference}",
                "record the bag with the messages of this version",
            )
        return ChannelDecoder(role, name, (store,), bad, told=True)

    def _role(self, topic: str) -> str | None:
        for role in _roles(topic):
            space = topic.removesuffix(role).strip("/")
            self.cells.add(space)
            if self.namespace is not None:
                return role if space == self.namespace.strip("/") else None
            if len(self.cells) > 1:
                raise InputError(
                    str(self.path),
                    "topics of two cells, "
                    + " and ".join(f"'/{name}'" for name in sorted(self.cells)),
                    "choose one with --namespace",
                )
            return role
        return None


def overlap(stream: McapStream, by_ns: int) -> str:
    """Say that a recording begins before the end of those that were read before it."""
    where = f" from byte {stream.begin} on" if stream.begin else ""
    return (
        f"{stream.path.name}{where} begins {by_ns / NS_PER_S:.3g} s before the end of what was "
        "read before it: a copy, files in another order than they were recorded in, or a clock "
        "that stepped back"
    )


def _stride(index: np.ndarray) -> int:
    """Return the step of the messages of a topic in a chunk that are examined."""
    return max(1, len(index) // LOOKED_AT)


def _ahead(block: MessageBlock, index: np.ndarray) -> np.ndarray:
    """Return which messages are stamped ahead of their log time."""
    stamps, has_header = first_stamps_ns(block.payloads[index])
    ahead = np.zeros(len(index), dtype=bool)
    logged = np.minimum(block.fronts["log_time"][index[has_header]], NEVER_NS).astype(
        np.int64
    )
    ahead[has_header] = (stamps - logged > MAX_AHEAD_NS) & (logged > 0)  # 0: unknown
    return ahead


def _roles(topic: str) -> list[str]:
    """Return the input topics matching a topic after its namespace."""
    return [
        role for role in INPUT_TOPICS if topic == role or topic.endswith("/" + role)
    ]


def _natural(name: str) -> list:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]
