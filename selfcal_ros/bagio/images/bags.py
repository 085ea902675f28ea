# SPDX-License-Identifier: Apache-2.0
"""Bags with images: every message with its channel, and the images decoded."""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Channel, Message, Schema

from selfcal_ros.bagio.mcap_stream import McapStream
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.schemas import store_with
from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection.inputs import Detection
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.messages import from_model
from selfcal_ros.messages.to_model import EncoderBlock
from selfcal_ros.topics import (
    DETECTION_TOPIC,
    IMAGE_TOPICS,
    IMAGE_TYPES,
    INPUT_TOPICS,
    qos_profile,
)


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
        If the path is no bag, or several namespaces have images.
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
        found: dict[str, str] = {}
        for file in self._files:
            stream = McapStream(file, wanted=lambda topic: False)
            for _ in stream.blocks():
                pass  # blocks of a file without an index
            found |= {channel.topic: transport for channel in stream.channels.values()
                      if (transport := self._transport(channel.topic))}
        raw = [topic for topic, transport in found.items() if transport == "raw"]
        names = raw or list(found)
        if not names:
            raise NoDataError(str(self.path), f"no topic {' or '.join(IMAGE_TOPICS.values())}",
                              "record it, or remap the topic of your camera")
        if len(names) > 1:
            raise InputError(str(self.path), f"images of several cells: {', '.join(names)}",
                             "choose one with --namespace")
        self.topic, self._kind = names[0], IMAGE_TYPES[found[names[0]]]

    def _transport(self, topic: str) -> str:
        """Return the transport of a topic of images, else ""."""
        for transport, role in IMAGE_TOPICS.items():
            space = topic.removesuffix(role)
            if (topic.endswith(role) and space in ("", "/")) or topic.endswith(f"/{role}"):
                known = self.namespace
                return transport if known is None or space.strip("/") == known.strip("/") else ""
        return ""

    @property
    def space(self) -> str:
        """What stands before the names of the contract, with its slashes."""
        role = next(role for role in IMAGE_TOPICS.values() if self.topic.endswith(role))
        return self.topic.removesuffix(role)

    def items(self) -> Iterator[Item]:
        """Yield all messages in the order of the files.

        Raises
        ------
        InputError
            If the topic of the images has another type.
        """
        for file in self._files:
            lines: list[str] = []
            stream = McapStream(file, lost=lines)
            for channel, message in stream.messages():
                schema = stream.schemas.get(channel.schema_id)
                item = Item(channel, schema, message, bool(self._transport(channel.topic)))
                if channel.topic == self.topic:
                    item.image = self._decoded(channel, schema, message)
                yield item
            self.lost.update(lines)

    def _decoded(self, channel: Channel, schema: Schema | None, message: Message) -> Any:
        name = schema.name if schema else self._kind
        if name != self._kind:
            raise InputError(f"{self.path}: topic {channel.topic}", f"type {name} instead of "
                             f"{self._kind}", "remap the topic or record the right one")
        try:
            return store_with(name).deserialize_cdr(message.data, name)
        except Exception:  # a damaged payload may fail anywhere in the decoder
            self.lost[f"messages on {channel.topic} could not be decoded"] += 1
            return None

    def write_detected(self, output: str | Path, detect: Callable[[Any], Iterable[Detection]],
                       frame_id: str) -> Counter[str]:
        """Write a bag of all messages other than images, and the detections in the images.

        Parameters
        ----------
        output : str or Path
            Folder to create.
        detect : callable (message)
            Returns the detections in an image; may raise InputError.
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
        with new_bag(output) as beside, BagWriter(beside) as writer:
            writer.add_topic(topic, INPUT_TOPICS[DETECTION_TOPIC], [
                qos_profile(reliable=True, transient_local=False, depth=5000)])
            for item in self.items():
                if not item.is_image:
                    writer.copy(_number(writer, item, numbers), item.channel.topic, item.message)
                    continue
                try:
                    found = detect(item.image) if item.image is not None else ()
                except InputError as error:
                    problems[str(error)] += 1
                    continue
                for detection in found:
                    writer.write(topic, from_model.detection(detection, frame_id),
                                 item.message.log_time)
        return problems + self.lost


def _number(writer: BagWriter, item: Item, numbers: dict[tuple, int]) -> int:
    """Return the number of the copy of a channel, declared once."""
    schema = item.schema and (item.schema.name, item.schema.data)
    key = (item.channel.topic, item.channel.message_encoding, schema)
    if key not in numbers:
        numbers[key] = writer.add_copy(item.channel, item.schema)
    return numbers[key]


def encoder_track(path: str | Path, joints: tuple[str, str] = ("x", "y"),
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Return the stamps (n,), ns, and the indicated positions (n, 2) of two joints, by stamp.

    Samples without these joints are left out.
    """
    stamps, places = [np.zeros(0, np.int64)], [np.zeros((0, 2))]
    for _, block in BagReader(Path(path)).columns():
        if isinstance(block, EncoderBlock) and set(joints) <= set(block.names):
            stamps.append(block.stamps_ns)
            places.append(block.positions[:, [block.names.index(name) for name in joints]])
    stamp, place = np.concatenate(stamps), np.concatenate(places)
    order = np.argsort(stamp, kind="stable")
    return stamp[order], place[order]
