# SPDX-License-Identifier: Apache-2.0
"""Whether the cell's clock is this machine's; what ROS time follows, said once at each change."""

import numpy as np
import pytest

from selfcal_ros.nodes.sessions.clocks import ClockWatch, RosTime
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.topics import DETECTION_TOPIC, ENCODER_TOPIC

NOTHING = (
    "use_sim_time is set but nothing is received on /clock: this node stamps everything "
    "0; play the bag with --clock, or start the node without use_sim_time"
)


def looked(*instants_ns: int, simulated: bool = True):
    said: list = []
    clock = RosTime(lambda level, line: said.append((level, line)))
    return [clock.look(simulated=simulated, now_ns=now) for now in instants_ns], said


T0 = 1_700_000_000_000_000_000


def offset_after(*delays_s: float, every_s: float, live: bool = True) -> int | None:
    """Return the offset that messages tell which came so much later than they were stamped."""
    watch = ClockWatch(limit_s=0.05)
    watch.command(T0, T0 if live else T0 + 10**12, is_older=False)
    for number, delay in enumerate(delays_s):
        steady_ns = round((50.0 + number * every_s) * 1e9)
        now_ns = T0 + round(number * every_s * 1e9)
        watch.data(
            "joints", *np.array([[now_ns - round(delay * 1e9)], [now_ns], [steady_ns]])
        )
    return watch.offset_ns


@pytest.mark.parametrize(
    ("delays", "offset_s"),
    [
        ((0.003,), -0.003),
        ((0.004, 0.001, 0.002), -0.001),
        ((-37.0, -37.001), 37.001),
        ((0.2, 0.3, 0.25), -0.2),
    ],
)
def test_the_smallest_delay_is_the_offset_of_the_cells_clock(delays, offset_s):
    for every_s in (0.01, 0.5):  # in one tenth of a second, and in different ones
        assert offset_after(*delays, every_s=every_s) == round(offset_s * 1e9)
    assert offset_after(*delays, every_s=0.5, live=False) is None


@pytest.mark.parametrize(("later", "offset_s"), [(4, 37.0), (5, -0.001), (9, -0.001)])
def test_an_offset_is_forgotten_after_two_seconds(later, offset_s):
    """Every half second a message, the first from a clock 37 s ahead that has been set since."""
    assert offset_after(-37.0, *[0.001] * later, every_s=0.5) == round(offset_s * 1e9)


@pytest.mark.parametrize(
    ("offset_s", "message"),
    [
        (0.05, ""),
        (-0.05, ""),
        (0.051, "the cell's clock is 0.051 s ahead of this machine's: "),
        (-2.0, "the cell's clock is 2 s behind this machine's: "),
    ],
)
def test_an_offset_is_named_beyond_its_limit_in_either_direction(offset_s, message):
    watch = ClockWatch(limit_s=0.05)
    assert watch.diagnosis().values == {} and not watch.ahead
    watch.command(T0, T0, is_older=False)
    watch.data("joints", *np.array([[T0 + round(offset_s * 1e9)], [T0], [50 * 10**9]]))
    found = watch.diagnosis()
    assert found.message.partition("detections")[0] == message
    assert found.level == (Level.WARN if message else Level.OK)
    assert found.values == {"clock_offset_s": f"{offset_s:.3f}"}
    assert watch.ahead == (offset_s > 0.05)


@pytest.mark.parametrize("topic", [DETECTION_TOPIC, ENCODER_TOPIC])
def test_stamps_that_nobody_filled_in_are_no_clock_that_is_behind(topic):
    watch = ClockWatch(limit_s=0.1)
    watch.command(T0, T0, is_older=False)
    for number in range(100):
        stamp_ns = 0 if number >= 50 else T0 + number * 10**7
        received = T0 + number * 10**7, 50 * 10**9 + number * 10**7
        watch.data(topic, np.array([stamp_ns]), *np.array([received]).T)
    assert watch.steps == {topic: []}
    found = watch.diagnosis()
    assert found.level == Level.WARN
    assert found.message.startswith(f"{topic}: stamped 0: fill in header.stamp")
    watch.data(
        topic, np.array([T0 + 10**9]), np.array([T0 + 10**9]), np.array([10**11])
    )
    assert watch.diagnosis().message == ""


@pytest.mark.parametrize("lead_s, offset_s", [(-0.645, None), (0.645, 0.645)])
def test_a_slow_image_is_no_clock_that_is_behind(lead_s, offset_s):
    watch, now = ClockWatch(limit_s=0.1), [T0]
    watch.command(T0, T0, is_older=False)
    stamps = np.array([T0 + round(lead_s * 1e9)])
    watch.data(DETECTION_TOPIC, stamps, np.array(now), np.array([50 * 10**9]))
    assert watch.offset_ns == (offset_s and round(offset_s * 1e9))
    assert bool(watch.diagnosis().message) is (offset_s is not None)
    watch.data(
        ENCODER_TOPIC, np.array([T0 - 10**6]), np.array(now), np.array([50 * 10**9])
    )
    assert watch.offset_ns == max(-(10**6), round((offset_s or -1.0) * 1e9))


def test_the_clock_of_the_system_is_no_matter():
    found, said = looked(5_000_000_000, 5_000_000_000, simulated=False)
    assert [(item.level, item.message, item.values) for item in found] == [
        (0, "", {})
    ] * 2
    assert said == []


def test_a_clock_that_nobody_publishes_is_a_warning_and_one_line():
    found, said = looked(0, 0, 0)
    assert {(item.level, item.message) for item in found} == {(Level.WARN, NOTHING)}
    assert said == [(Level.WARN, NOTHING)]


def test_a_clock_that_moves_and_stands_is_told_at_each_change():
    found, said = looked(
        0, 7_000_000_000, 8_500_000_000, 8_500_000_000, 8_500_000_000, 9
    )
    assert [item.values["/clock"] for item in found] == [
        "not heard",
        "moves",
        "moves",
        "stands",
        "stands",
        "moves",
    ]
    assert [item.level for item in found] == [Level.WARN] + [Level.OK] * 5
    moves = (Level.OK, "stamps follow /clock (use_sim_time); work and health do not")
    assert said == [
        (Level.WARN, NOTHING),
        moves,
        (
            Level.OK,
            "/clock has stopped at 8.500 s; work and health continue, stamps do not",
        ),
        moves,
    ]
