# SPDX-License-Identifier: Apache-2.0
"""A bag into the collector without middleware, and in the order of replay."""

import hashlib
import heapq
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator
from operator import itemgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.messages import to_model
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.clock_steps import step_lines
from selfcal_ros.collection.collector import Collector, keep_freed_memory
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Reason
from selfcal_ros.errors import InputError, NoDataError, did_you_mean
from selfcal_ros.files import add_file, read_json
from selfcal_ros.model.readings import Measurements
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    IMAGE_TOPICS,
    INPUT_TOPICS,
)

FROM_THE_FUTURE = {
    ENCODER_TOPIC: ("encoder", Reason.ENCODER_FUTURE),
    DETECTION_TOPIC: ("detection", Reason.FUTURE),
    COMMAND_TOPIC: ("command", Reason.COMMAND_FUTURE),
}
"""Reasons of messages stamped ahead of their reception."""
MAX_SAID = 3
"""Number of lines on losses repeated in an error."""
TRUTH_FILE = "truth.json"
TOPICS = [*INPUT_TOPICS, *IMAGE_TOPICS.values()]


class BagSession(NamedTuple):
    """Content of a bag.

    Attributes
    ----------
    measurements : Measurements
        The readings.
    views : dict
        view_index -> progress of the view.
    lost : list of str
        Unreadable parts, and clock steps, one line each.
    findings : list of str
        Clock steps, lost commands, and why most detections of the bag, or of views, were
        rejected, one line each.
    """

    measurements: Measurements
    views: dict[int, ViewProgress]
    lost: list[str]
    findings: list[str]


def collect_bag(
    path: str | Path,
    settings: CollectorSettings,
    *,
    namespace: str | None = None,
    progress: Callable[[int], None] = lambda count: None,
) -> BagSession:
    """Return the readings in a bag, the progress of each view, and its problems.

    Parameters
    ----------
    path : path
        MCAP file or rosbag2 folder.
    settings : CollectorSettings
        Values of the measurement_collector's parameters.
    namespace : str or None
        Namespace of the cell's topics; empty = the root, None = the only one.
    progress : callable
        Called periodically with the number of messages read.

    Raises
    ------
    InputError
        If the path is not a bag of this contract.
    NoDataError
        If it has no commands or no detections, or no detection became a reading.
    """
    keep_freed_memory()
    reader = BagReader(Path(path), namespace, settings.clock_limit)
    reader, collector = _fed(reader, settings, INPUT_TOPICS, progress)
    received = collector.received
    cell = None if namespace is None else namespace.strip("/")
    if cell is not None and reader.cells and cell not in reader.cells:
        raise NoDataError(
            str(path),
            f"no topics of the cell '/{cell}'",
            "choose one of " + ", ".join(f"/{name}" for name in sorted(reader.cells)),
        )
    lost = "; ".join(dict.fromkeys(reader.lost[-MAX_SAID:]))
    tail = f" ({lost})" if lost else ""
    for kind, topic in (
        ("command", COMMAND_TOPIC),
        ("detection", DETECTION_TOPIC),
        ("encoder", ENCODER_TOPIC),
    ):
        if not received[kind]:
            raise NoDataError(
                str(path),
                f"no message on {topic}{tail}",
                _how_to_record(topic, reader.topics, path),
            )
    if collector.timeline.artifact is None:
        unusable = f" that can be used{tail}"
        raise NoDataError(
            str(path),
            "no MEASURE command"
            + (unusable if collector.unusable.get(Reason.COMMAND_BAD) else ""),
            "readings cannot be assigned to views without one",
        )
    measurements, views = collector.collect()
    clock = [*step_lines(reader.steps, collector.timeline), *reader.future_lines()]
    findings = [
        (f"view '{views[index].view.name}': " if index is not None else "")
        + str(finding)
        for index, finding in collector.findings(measurements, views).items()
    ]
    findings = [*collector.missing_commands(), *findings]
    if not any(view.used for view in measurements.views):
        commonest = Counter(measurements.all_rejected()).most_common(4)
        reasons = ", ".join(f"{reason} {count}" for reason, count in commonest)
        raise NoDataError(
            str(path),
            f"none of {received['detection']} detections became a reading (rejected: "
            f"{reasons}){tail}",
            [*clock, *findings, "correct the first cause named"][0],
        )
    return BagSession(measurements, views, [*reader.lost, *clock], [*clock, *findings])


def _how_to_record(topic: str, types: dict[str, str], path: str | Path) -> str:
    """Return the remedy for a topic that a bag with topics of these types does not have."""
    images = any(
        name.endswith(("/Image", "/CompressedImage")) for name in types.values()
    )
    if topic == DETECTION_TOPIC and images:
        return (
            f"it has images: find the marks in them with `selfcal detect {path} -o "
            "MARKS`, then solve MARKS"
        )
    return f"{topics_like(topic, types)}record this topic too, see the README"


def _fed(
    reader: BagReader,
    settings: CollectorSettings,
    roles: Collection[str],
    progress: Callable[[int], None] = lambda count: None,
) -> tuple[BagReader, Collector]:
    """Return the reader of a bag, and a collector that has taken these topics from it."""
    collector = Collector(settings)
    take = block_handlers(collector, reader.lost)
    for topic, item in reader.columns():
        if topic in roles:
            take[topic](item)
        progress(sum(collector.received.values()))
    if reader.mixes_clocks and not reader.leave_ahead:
        honest = BagReader(
            reader.path, reader.namespace, reader.clock_limit_s, leave_ahead=True
        )
        return _fed(honest, settings, roles, progress)
    for topic, count in reader.ahead.items() if reader.leave_ahead else ():
        collector.refuse(*FROM_THE_FUTURE[topic], count)
    return reader, collector


class BagLines(NamedTuple):
    """What the nodes that a bag is played into cannot see of it, as in `BagSession`.

    Attributes
    ----------
    lost : list of str
        Unreadable parts and unusable commands, one line each.
    clock : list of str
        Clock steps, one line each.
    missing : list of str
        Lost commands, one line each.
    refused : dict
        Reason -> number of refused messages.
    """

    lost: list[str]
    clock: list[str]
    missing: list[str]
    refused: dict[str, int]

    @property
    def faults(self) -> list[str]:
        """All lines."""
        return [*self.lost, *self.clock, *self.missing]


def bag_lines(
    path: str | Path, settings: CollectorSettings, namespace: str | None = None
) -> BagLines:
    """Return the problems of a bag, like `collect_bag`."""
    reader = BagReader(Path(path), namespace, settings.clock_limit)
    reader, collector = _fed(reader, settings, [COMMAND_TOPIC, DETECTION_TOPIC])
    clock = [*step_lines(reader.steps, collector.timeline), *reader.future_lines()]
    return BagLines(
        reader.lost, clock, collector.missing_commands(), collector.unusable
    )


def topics_like(topic: str, topics: dict[str, str]) -> str:
    """Return the topics of a bag (name -> type) that were probably intended, by type, then name.

    The text can be followed by another remedy; it is empty if there is no such topic.
    """
    type_of_topic = {
        name: kind
        for name, kind in topics.items()
        if not any(f"/{name}".endswith(f"/{role}") for role in INPUT_TOPICS)
    }
    same = sorted(
        name for name, kind in type_of_topic.items() if kind == INPUT_TOPICS[topic]
    )
    if same:
        return f"is it {' or '.join(same[:MAX_SAID])}? then remap it to {topic}, or "
    hint = did_you_mean(f"/{topic}", type_of_topic)
    return f"{hint} then remap it, or " if hint else ""


def block_handlers(
    collector: Collector, complaints: list[str]
) -> dict[str, Callable[[Any], None]]:
    """Return topic -> handler that passes the output of `BagReader.columns` to the collector.

    An unusable command is not fatal: it is counted, and reported in `complaints`.
    """

    def take_command(message: Any) -> None:
        try:
            collector.add_command(to_model.command(message))
        except InputError as error:
            collector.refuse("command", Reason.COMMAND_BAD)
            complaints.append(f"a view command was not used: {error}")

    return {
        ENCODER_TOPIC: collector.add_encoder_block,
        DETECTION_TOPIC: collector.add_detection_block,
        COMMAND_TOPIC: take_command,
    }


def take_all(reader: BagReader, collector: Collector, complaints: list[str]) -> None:
    """Pass all that a bag has to a collector; `complaints` as of `block_handlers`."""
    take = block_handlers(collector, complaints)
    for topic, item in reader.columns():
        take[topic](item)


def bag_input(path: str | Path) -> dict[str, str]:
    """Return the result's ``input`` entry: file name and SHA-256 of the bag's MCAP files."""
    digest = hashlib.sha256()
    for file in BagReader(Path(path)).files:
        add_file(digest, file)
    return {"file": Path(path).name, "sha256": digest.hexdigest()}


def read_truth(bag: str | Path) -> dict | None:
    """Return the truth in a bag folder, or None."""
    path = Path(bag) / TRUTH_FILE
    return read_json(path) if path.is_file() else None


class Playlist:
    """The input topics of a bag, or images for detections, as CDR bytes, by log time or shuffled.

    A bag in the order of its log times, as written by recorders, is read again while it is
    played; any other one is kept in memory.

    Parameters
    ----------
    bag : Path
        MCAP file or rosbag2 folder.
    namespace : str or None
        Namespace of the cell in the bag, None = the only one.
    seed : int
        Shuffles the order of arrival, not the times; negative = as recorded.

    Attributes
    ----------
    lost : list of str
        What could not be read, one line each.
    counts : dict
        Topic -> number of messages, without topics that have none.
    """

    def __init__(self, bag: Path, namespace: str | None = None, seed: int = -1) -> None:
        self._bag, self._namespace = bag, namespace
        reader = BagReader(bag, namespace)
        times, topics = _times_and_topics(reader.cdr_messages())
        self._leave_ahead = reader.mixes_clocks
        if self._leave_ahead:
            reader = self._reader()
            times, topics = _times_and_topics(reader.cdr_messages())
        self.lost = [*reader.lost, *reader.future_lines()]
        self._has_images = self._shows_images(
            reader, DETECTION_TOPIC in {TOPICS[number] for number in set(topics)}
        )
        if self._has_images:
            images = ImageBag(bag, namespace)
            times, topics = _times_and_topics(self._messages(images))
            self.lost += [
                f"{count} {line}"
                for line, count in images.lost.items()
                if line not in reader.lost
            ]
        self._times = np.array(times, dtype=np.uint64)
        numbers, counts = np.unique(
            np.array(topics, dtype=np.uint8), return_counts=True
        )
        self.counts = {
            TOPICS[number]: int(count)
            for number, count in zip(numbers, counts, strict=True)
        }
        sorted_already = bool((self._times[1:] >= self._times[:-1]).all())
        order = None if sorted_already else np.argsort(self._times, kind="stable")
        self._times = self._times if order is None else self._times[order]
        if seed >= 0:
            mixed = np.random.default_rng(seed).permutation(len(self))
            order = mixed if order is None else order[mixed]
        self._order = order

    @property
    def transport(self) -> str:
        """The transport of the images that take the place of detections, "" without."""
        return next(
            (
                transport
                for transport, topic in IMAGE_TOPICS.items()
                if topic in self.counts
            ),
            "",
        )

    def _shows_images(self, reader: BagReader, has_detections: bool) -> bool:
        """Return whether images are played; say of others that they are not."""
        images = [
            topic
            for topic in reader.topics
            if f"/{topic}".endswith(tuple(f"/{role}" for role in IMAGE_TOPICS.values()))
        ]
        if not images or not has_detections:
            return bool(images)
        self.lost.append(
            f"images on {', '.join(images)} are not played: selfcal detect {self._bag} "
            "-o FOUND_BAG makes detections of them"
        )
        return False

    def _messages(
        self, images: ImageBag | None = None
    ) -> Iterable[tuple[str, int, bytes]]:
        """Return all messages, in the order of their times if the bag is."""
        messages = self._reader().cdr_messages()
        if not self._has_images:
            return messages
        images = images or ImageBag(self._bag, self._namespace)
        return heapq.merge(messages, images.cdr_images(), key=itemgetter(1))

    def _reader(self) -> BagReader:
        return BagReader(self._bag, self._namespace, leave_ahead=self._leave_ahead)

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._times)

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, log time in ns, and CDR bytes."""
        messages = self._messages()
        if self._order is None:
            yield from messages
            return
        of_topics = [(topic, data) for topic, _, data in messages]
        for number, stamp in zip(
            self._order.tolist(), self._times.tolist(), strict=True
        ):
            topic, data = of_topics[number]
            yield topic, stamp, data


def _times_and_topics(
    messages: Iterable[tuple[str, int, bytes]],
) -> tuple[array, array]:
    """Return the log time of each message, and the index of its topic."""
    times, topics = array("Q"), array("B")
    for topic, stamp, _ in messages:
        times.append(stamp)
        topics.append(TOPICS.index(topic))
    return times, topics
