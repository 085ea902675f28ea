# SPDX-License-Identifier: Apache-2.0
"""When a message of a bag is due, by a clock that the test holds; no middleware."""

from collections import Counter
from types import SimpleNamespace

import pytest

from selfcal_ros.nodes import player
from selfcal_ros.nodes.player import (
    IMAGES,
    KINDS,
    UNHEARD_RATE,
    WAITING_IMAGES,
    WINDOW,
    Player,
)

T0 = 1_700_000_000_000_000_000


def player_of(
    count: int, sent: list, rate: float, topic: str = next(iter(KINDS))
) -> Player:
    """Return a player of so many messages, a second apart; what it publishes goes to `sent`."""
    played = Player.__new__(Player)
    messages = iter([(topic, T0 + number * 10**9, number) for number in range(count)])
    for name, value in {
        "playlist": range(count),
        "_at": 0,
        "_began": None,
        "rate": rate,
        "_messages": messages,
        "_next": next(messages),
        "_first_ns": T0,
        "heard": None,
        "sent": Counter(dict.fromkeys(KINDS.values(), 0)),
        "_before": 0,
        "_published_s": 0.0,
        "_created_s": 0.0,
        "_looked_s": 0.0,
        "node": None,
        "alone_on": [],
        "_own": [],
        "_publishers": {topic: SimpleNamespace(publish=sent.append)},
    }.items():
        setattr(played, name, value)
    return played


def tell(played: Player, received: int) -> None:
    """Tell what the listener has received, as it does."""
    played._on_received(SimpleNamespace(data=[received, 0, 0]))


@pytest.mark.parametrize(
    ("rate", "counts"),
    [
        (1.0, [1, 1, 2, 3, 5]),
        (2.0, [1, 2, 3, 5, 5]),
        (0.5, [1, 1, 1, 2, 4]),
        (0.0, [5] * 5),
    ],
)
def test_messages_are_due_at_their_own_distances_over_the_rate(
    monkeypatch, rate, counts
):
    """Five messages, a second apart; looked at after 0, 0.5, 1, 2 and 6 s."""
    now, sent = [70.0], []
    monkeypatch.setattr(player.time, "monotonic", lambda: now[0])
    played = player_of(5, sent, rate=rate)
    for after_s, count in zip((0.0, 0.5, 1.0, 2.0, 6.0), counts, strict=True):
        now[0] = 70.0 + after_s
        played.step()
        assert sent == list(range(count))
    assert played.done == (counts[-1] == 5)


def test_a_listener_that_tells_nothing_is_sent_more_as_time_passes(monkeypatch):
    """Counted from the first message: not at once what the age of the clock would allow."""
    now, sent = [70.0], []
    monkeypatch.setattr(player.time, "monotonic", lambda: now[0])
    played = player_of(3 * WINDOW, sent, rate=0.0)
    played.step()
    assert len(sent) == WINDOW
    now[0] += 0.1
    played.step()
    assert WINDOW < len(sent) <= WINDOW + 0.1 * UNHEARD_RATE


def test_what_the_listener_had_received_before_does_not_widen_the_window(monkeypatch):
    """A second bag, or the same once more, into a collector that has heard one."""
    monkeypatch.setattr(player.time, "monotonic", lambda: 70.0)
    sent: list = []
    played = player_of(3 * WINDOW, sent, rate=0.0)
    tell(played, 10_000)
    played.step()
    assert len(sent) == WINDOW
    tell(played, 10_000 + WINDOW)
    played.step()
    assert len(sent) == 2 * WINDOW


def test_a_listener_that_is_restarted_is_sent_the_rest(monkeypatch):
    now, sent = [70.0], []
    monkeypatch.setattr(player.time, "monotonic", lambda: now[0])
    played = player_of(3 * WINDOW, sent, rate=0.0)
    tell(played, 20)
    played.step()
    tell(played, 20 + WINDOW // 2)
    played.step()
    assert (len(sent), played.stalled_s) == (3 * WINDOW // 2, 0.0)
    now[0] += 7.0
    played.step()
    assert (len(sent), played.stalled_s) == (3 * WINDOW // 2, 7.0)
    tell(played, 0)
    played.step()
    assert (len(sent), played.stalled_s) == (5 * WINDOW // 2, 0.0)
    tell(played, WINDOW)
    played.step()
    assert (len(sent), played.done, played.stalled_s) == (3 * WINDOW, True, 0.0)


def test_images_are_sent_as_the_detector_takes_them(monkeypatch):
    """One that has taken others before, and is restarted after two of these."""
    monkeypatch.setattr(player.time, "monotonic", lambda: 70.0)
    sent: list = []
    played = player_of(20, sent, rate=0.0, topic="stage/image")
    played.sent = {IMAGES: 0}
    for taken, total in (
        (30, WAITING_IMAGES),
        (30, WAITING_IMAGES),
        (32, WAITING_IMAGES + 2),
        (0, 2 * WAITING_IMAGES + 2),
        (3, 2 * WAITING_IMAGES + 5),
    ):
        played._on_taken(SimpleNamespace(data=[taken, 0, 1]))
        played.step()
        assert len(sent) == total == played.sent[IMAGES]


def test_all_has_arrived_once_the_detections_of_all_images_have():
    """Two images, with five marks: the detector tells of them, the collector of what it heard."""
    played = player_of(2, [], rate=0.0, topic="stage/image")
    played.sent = {"encoder": 4, "command": 1, IMAGES: 2}
    arrived = []
    for found, heard in (
        ([1, 3, 1], [4, 3, 1]),
        ([2, 5, 1], [4, 3, 1]),
        ([2, 5, 1], [4, 5, 0]),
        ([2, 5, 1], [3, 5, 1]),
        ([2], [4, 5, 1]),
        ([1, 5, 1], [4, 5, 1]),
    ):
        played._on_taken(SimpleNamespace(data=found))
        played._on_received(SimpleNamespace(data=heard))
        arrived.append(played.arrived)
    assert arrived == [False, False, False, False, True, False]
