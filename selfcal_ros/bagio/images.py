# SPDX-License-Identifier: Apache-2.0
"""Bags with images."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema

from selfcal_ros.bagio.mcap_stream import streams
from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.bagio.reader import CLOCK_LIMIT_S, BagReader, overlap
from selfcal_ros.bagio.schemas import store_with
from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection.inputs import (
    Detection,
    EncoderBlock,
)
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    IMAGE_TOPICS,
    IMAGE_TYPES,
    INPUT_TOPICS,
    qos_profile,
)
from selfcal_ros.units import NS_PER_S


@dataclass
class Item:
    """A message of a bag.

    `image` is the decoded image if it is one to be used, `is_image` also if it cannot be decoded
    or is of the other transport.
    """

    channel: Channel
    schema: Schema | None
    message: Message
    is_image: bool
    image: Any = None


@dataclass
class ImageBag:
    """All messages of a bag with images of one camera.

    Parameters
    ----------
    path : Path
        MCAP file or rosbag2 folder.
    namespace : str or None
        Namespace of the camera; None = the only one.

    Attributes
    ----------
    topic : str
        The topic of the images: raw ones if there are any, else compressed ones.
    lost : Counter
        Line -> number of messages or places that could not be read, after reading.

    Raises
    ------
    InputError
        If the path is not a bag, or several namespaces have images.
    NoDataError
        If there are no images.
    """

    path: Path
    namespace: str | None = None
    lost: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        """Find the images."""
        reader = BagReader(self.path)
        self._files = reader.files
        self.lost.update(reader.lost)
        transport_of_topic: dict[str, str] = {}
        for stream in streams(self._files, [], lambda topic: False):
            for _ in stream.blocks():
                pass  # blocks of a file without an index
            transport_of_topic |= {
                channel.topic: transport
                for channel in stream.channels.values()
                if (transport := self._transport(channel.topic))
            }
        raw = [
            topic
            for topic, transport in transport_of_topic.items()
            if transport == "raw"
        ]
        names = raw or list(transport_of_topic)
        if not names:
            raise NoDataError(
                str(self.path),
                f"no topic {' or '.join(IMAGE_TOPICS.values())}",
                "record it, or remap the topic of your camera",
            )
        if len(names) > 1:
            raise InputError(
                str(self.path),
                f"images of several cells: {', '.join(names)}",
                "choose one with --namespace",
            )
        self.topic, self._kind = names[0], IMAGE_TYPES[transport_of_topic[names[0]]]

    def _transport(self, topic: str) -> str:
        """Return the transport of a topic of images, else ""."""
        for transport, role in IMAGE_TOPICS.items():
            space = topic.removesuffix(role)
            if (topic.endswith(role) and space in ("", "/")) or topic.endswith(
                f"/{role}"
            ):
                namespace = self.namespace
                return (
                    transport
                    if namespace is None or space.strip("/") == namespace.strip("/")
                    else ""
                )
        return ""

    @property
    def space(self) -> str:
        """What stands before the names of the contract, with its slashes."""
        role = next(role for role in IMAGE_TOPICS.values() if self.topic.endswith(role))
        return self.topic.removesuffix(role)

    def plates(self) -> Iterator[Artifact]:
        """Yield the plates of the view commands of this cell.

        An unusable command has none here: whoever solves the bag is told of it.

        Raises
        ------
        InputError
            If a topic of the cell has another type.
        """
        for role, item in BagReader(self.path, self.space).columns():
            if role != COMMAND_TOPIC:
                continue
            try:
                plate = to_model.command(item).artifact
            except InputError:
                continue
            if plate is not None:
                yield plate

    def items(self) -> Iterator[Item]:
        """Yield all messages in the order of the files.

        Raises
        ------
        InputError
            If the topic of the images has another type, or a recording begins before the end of
            those before it.
        """
        lines: list[str] = []
        latest_ns = 0
        for stream in streams(self._files, lines):
            before_ns = latest_ns
            for channel, message in stream.messages():
                schema = stream.schemas.get(channel.schema_id)
                item = Item(
                    channel, schema, message, bool(self._transport(channel.topic))
                )
                if channel.topic == self.topic:
                    by_ns = before_ns - message.log_time
                    if by_ns > CLOCK_LIMIT_S * NS_PER_S:
                        raise InputError(
                            str(self.path),
                            overlap(stream, by_ns),
                            "give each recording once, in the order in which they were made",
                        )
                    latest_ns = max(latest_ns, message.log_time)
                    item.image = self._decoded(channel, schema, message)
                yield item
        self.lost.update(lines)

    def cdr_images(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield the topic's name of the contract, log time in ns and CDR bytes of each image.

        Undecodable ones are omitted and counted.
        """
        role = self.topic.removeprefix(self.space)
        for item in self.items():
            if item.image is not None:
                yield role, item.message.log_time, item.message.data

    def _decoded(
        self, channel: Channel, schema: Schema | None, message: Message
    ) -> Any:
        name = schema.name if schema else self._kind
        if name != self._kind:
            raise InputError(
                f"{self.path}: topic {channel.topic}",
                f"type {name} instead of {self._kind}",
                "remap the topic or record the right one",
            )
        try:
            return store_with(name).deserialize_cdr(message.data, name)
        except Exception:  # a damaged payload may fail anywhere in the decoder
            self.lost[f"messages on {channel.topic} could not be decoded"] += 1
            return None

    def write_detected(
        self,
        output: str | Path,
        detect: Callable[[Any], Iterable[Detection]],
        *,
        check: Callable[[], None],
        frame_id: str,
    ) -> Counter[str]:
        """Write a bag of all messages other than images, and the detections in the images.

        Parameters
        ----------
        output : str or Path
            Folder to create.
        detect : callable (message)
            Returns the detections in an image; may raise InputError.
        check : callable
            Called before the bag is complete; what it raises leaves no bag.
        frame_id : str
            Frame of the detections.

        Returns
        -------
        Counter
            Problem -> number of messages that were not used, or places that could not be read.

        Raises
        ------
        InputError
            If the folder exists or cannot be written, or the topic of the images has another type.
        """
        problems: Counter[str] = Counter()
        numbers: dict[tuple, int] = {}
        topic = f"{self.space}{DETECTION_TOPIC}"
        with new_bag(output) as unfinished, BagWriter(unfinished) as writer:
            writer.add_topic(
                topic,
                INPUT_TOPICS[DETECTION_TOPIC],
                [qos_profile(reliable=True, transient_local=False, depth=5000)],
            )
            for item in self.items():
                if not item.is_image:
                    writer.copy(
                        _number(writer, item, numbers), item.channel.topic, item.message
                    )
                    continue
                try:
                    detections = detect(item.image) if item.image is not None else ()
                except InputError as error:
                    problems[str(error)] += 1
                    continue
                for detection in detections:
                    writer.write(
                        topic,
                        from_model.detection(detection, frame_id),
                        item.message.log_time,
                    )
            check()
        return problems + self.lost


def _number(writer: BagWriter, item: Item, numbers: dict[tuple, int]) -> int:
    """Return the number of the copy of a channel, declared once."""
    schema = item.schema and (item.schema.name, item.schema.data)
    key = (item.channel.topic, item.channel.message_encoding, schema)
    if key not in numbers:
        numbers[key] = writer.add_copy(item.channel, item.schema)
    return numbers[key]


def encoder_track(path: str | Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps (n,), ns, and the indicated positions (n, 2) of x and y, by stamp.

    Samples without these joints are left out.
    """
    stamps = [np.zeros(0, np.int64)]
    places = [np.zeros((0, 2))]
    for _, block in BagReader(Path(path)).columns():
        if isinstance(block, EncoderBlock) and {"x", "y"} <= set(block.names):
            stamps.append(block.stamps_ns)
            places.append(
                block.positions[:, [block.names.index(name) for name in "xy"]]
            )
    stamp, place = np.concatenate(stamps), np.concatenate(places)
    order = np.argsort(stamp, kind="stable")
    return stamp[order], place[order]
