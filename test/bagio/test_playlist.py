# SPDX-License-Identifier: Apache-2.0
"""What is played, and in which order: by time of logging, equal times as in the file."""

from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.offline import Playlist
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.collection.inputs import EncoderSample
from selfcal_ros.topics import IMAGE_TYPES, INPUT_TOPICS
from test.support import bags
from test.support.bags import Foreign
from test.support.sessions import events_of, small_plan


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan("0", repeats=1))


def by_time(path):
    return sorted(BagReader(path).cdr_messages(), key=lambda item: item[1])


@pytest.mark.parametrize("shuffle", [False, True])
def test_messages_are_played_by_their_times(tmp_path, events, shuffle):
    order = bags.shuffled(events) if shuffle else events
    path = Foreign({"chunk_size": 900}).write(tmp_path / "x.mcap", order)
    playlist = Playlist(path)
    assert list(playlist) == list(playlist) == by_time(path)
    assert len(playlist) == len(events)
    assert sum(playlist.counts.values()) == len(events)
    assert set(playlist.counts) == set(bags.TOPICS)
    assert (playlist._order is None) == (not shuffle), (
        "only what is out of order is kept"
    )


def test_equal_times_stay_in_the_order_of_the_file(tmp_path):
    samples = [
        EncoderSample(stamp, (name,), (0.5,)) for name in "zyx" for stamp in (7, 5, 5)
    ]
    path = Foreign().write(tmp_path / "x.mcap", samples)
    names = [data[data.index(b"somewhere") + 20 :] for _, _, data in Playlist(path)]
    stamps = [stamp for _, stamp, _ in Playlist(path)]
    assert stamps == [1005] * 6 + [1007] * 3
    assert [next(chr(c) for c in name if c in b"xyz") for name in names] == list(
        "zzyyxxzyx"
    )


@pytest.mark.parametrize("shuffle", [False, True])
def test_a_seed_shuffles_the_messages_but_not_the_times(tmp_path, events, shuffle):
    order = bags.shuffled(events) if shuffle else events
    path = Foreign().write(tmp_path / "x.mcap", order)
    found, plain = list(Playlist(path, seed=3)), by_time(path)
    assert found == list(Playlist(path, seed=3)) != plain
    assert found != list(Playlist(path, seed=4))
    assert list(Playlist(path, seed=0)) not in (plain, found), "0 is a seed, too"
    assert [stamp for _, stamp, _ in found] == [stamp for _, stamp, _ in plain]
    assert sorted((t, d) for t, _, d in found) == sorted((t, d) for t, _, d in plain)


def test_what_cannot_be_decoded_is_not_played_and_said_once(tmp_path, events):
    class Cut(Foreign):
        def _payload(self, event):
            topic, data = super()._payload(event)
            return topic, data[:-9] if topic == "selfcal/view_command" else data

    playlist = Playlist(Cut().write(tmp_path / "x.mcap", events))
    n_commands = sum(hasattr(event, "phase") for event in events)
    assert len(list(playlist)) == len(playlist) == len(events) - n_commands
    assert playlist.lost == [
        f"{n_commands} messages on selfcal/view_command could not be decoded"
    ]
    assert "selfcal/view_command" not in playlist.counts


def test_one_cell_of_two_is_played(tmp_path, events):
    for name in ("cell1", "cell2"):
        Foreign(namespace=f"/{name}").write(tmp_path / "bag" / f"{name}.mcap", events)
    assert len(Playlist(tmp_path / "bag", "cell2")) == len(events)


def test_nothing_to_play(tmp_path):
    playlist = Playlist(Foreign().write(tmp_path / "x.mcap", []))
    assert len(playlist) == 0 and playlist.counts == {} and list(playlist) == []


def test_of_a_bag_without_detections_images_are_played():
    playlist = Playlist(Path(__file__).parents[2] / "bags/camera")
    assert (playlist.transport, playlist.counts["stage/image"], playlist.lost) == (
        "raw",
        100,
        [],
    )


def test_images_beside_detections_are_said_not_to_be_played(tmp_path, events):
    with BagWriter(tmp_path / "bag") as writer:
        for event in events:
            topic, fields = event_fields(event, "stage")
            if topic not in writer.counts:
                writer.add_topic(topic, INPUT_TOPICS[topic], [])
            writer.write(topic, fields, event.stamp_ns)
        writer.add_topic("/stage/image", IMAGE_TYPES["raw"], [])
        writer.write(
            "/stage/image",
            from_model.image(np.zeros((2, 2), np.uint8), "mono8", 10**9, "camera"),
            10**9,
        )
    playlist = Playlist(tmp_path / "bag")
    assert len(playlist) == len(events) and playlist.transport == ""
    [line] = playlist.lost
    assert line.startswith("images on /stage/image are not played: selfcal detect ")
