# SPDX-License-Identifier: Apache-2.0
"""The messages of a bag in the order in which they are played."""

from array import array
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.topics import INPUT_TOPICS

TOPICS = list(INPUT_TOPICS)


class Playlist:
    """The input topics of a bag as CDR bytes, by time of logging or shuffled.

    A bag that lies in the order of its times, as recorders write it, is read again while it is
    played; any other one is kept in memory.

    Parameters
    ----------
    bag : Path
        MCAP file or rosbag2 folder.
    namespace : str or None
        Of the cell in the bag, None = the only one.
    seed : int
        Shuffles the order of arrival, not the times; negative = as recorded.

    Attributes
    ----------
    lost : list of str
        What could not be read, one line each.
    counts : dict
        Topic -> number of messages, topics with none left out.
    """

    def __init__(self, bag: Path, namespace: str | None = None, seed: int = -1) -> None:
        self._bag, self._namespace = bag, namespace
        reader = BagReader(bag, namespace)
        times, topics = _times_and_topics(reader)
        self._leave_ahead = reader.mixes_clocks
        if self._leave_ahead:
            reader = self._reader()
            times, topics = _times_and_topics(reader)
        self.lost = [*reader.lost, *reader.future_lines()]
        self._times = np.array(times, dtype=np.uint64)
        numbers, counts = np.unique(np.array(topics, dtype=np.uint8), return_counts=True)
        self.counts = {TOPICS[number]: int(count)
                       for number, count in zip(numbers, counts, strict=True)}
        sorted_already = bool((self._times[1:] >= self._times[:-1]).all())
        order = None if sorted_already else np.argsort(self._times, kind="stable")
        self._times = self._times if order is None else self._times[order]
        if seed >= 0:
            mixed = np.random.default_rng(seed).permutation(len(self))
            order = mixed if order is None else order[mixed]
        self._order = order

    def _reader(self) -> BagReader:
        return BagReader(self._bag, self._namespace, leave_ahead=self._leave_ahead)

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self._times)

    def __iter__(self) -> Iterator[tuple[str, int, bytes]]:
        """Yield topic, time of logging in ns, and CDR bytes."""
        messages = self._reader().cdr_messages()
        if self._order is None:
            yield from messages
            return
        kept = [(topic, data) for topic, _, data in messages]
        for number, stamp in zip(self._order.tolist(), self._times.tolist(), strict=True):
            topic, data = kept[number]
            yield topic, stamp, data


def _times_and_topics(reader: BagReader) -> tuple[array, array]:
    """Return the time of logging of each message, and the number of its topic."""
    times, topics = array("Q"), array("B")
    for topic, stamp, _ in reader.cdr_messages():
        times.append(stamp)
        topics.append(TOPICS.index(topic))
    return times, topics
