# SPDX-License-Identifier: Apache-2.0
"""When a message of a bag is due, by a clock that the test holds; no middleware."""

from collections import Counter
from types import SimpleNamespace

import pytest

from selfcal_ros.nodes import player
from selfcal_ros.nodes.player import KINDS, Player

T0 = 1_700_000_000_000_000_000


@pytest.mark.parametrize(("rate", "counts"), [
    (1.0, [1, 1, 2, 3, 5]), (2.0, [1, 2, 3, 5, 5]), (0.5, [1, 1, 1, 2, 4]), (0.0, [5] * 5)])
def test_messages_are_due_at_their_own_distances_over_the_rate(monkeypatch, rate, counts):
    """Five messages, a second apart; looked at after 0, 0.5, 1, 2 and 6 s."""
    now, sent, topic = [70.0], [], next(iter(KINDS))
    monkeypatch.setattr(player.time, "monotonic", lambda: now[0])
    played = Player.__new__(Player)
    messages = iter([(topic, T0 + number * 10**9, number) for number in range(5)])
    for name, value in {"playlist": range(5), "_at": 0, "_began": None, "rate": rate,
                        "_messages": messages, "_next": next(messages), "_first_ns": T0,
                        "heard": None, "sent": Counter(),
                        "_publishers": {topic: SimpleNamespace(publish=sent.append)}}.items():
        setattr(played, name, value)
    for after_s, count in zip((0.0, 0.5, 1.0, 2.0, 6.0), counts, strict=True):
        now[0] = 70.0 + after_s
        played.step()
        assert sent == list(range(count))
    assert played.done == (counts[-1] == 5)
