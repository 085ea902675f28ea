# SPDX-License-Identifier: Apache-2.0
"""What ROS time follows, said once at each change."""

from selfcal_ros.sessions.clocks import RosTime
from selfcal_ros.sessions.ports import Level

NOTHING = ("use_sim_time is set and nothing is heard on /clock: what this node stamps is stamped "
           "0; play the bag with --clock, or set use_sim_time to false")


def looked(*instants_ns: int, simulated: bool = True):
    said: list = []
    clock = RosTime(lambda level, line: said.append((level, line)))
    return [clock.look(simulated=simulated, now_ns=now) for now in instants_ns], said


def test_the_clock_of_the_system_is_no_matter():
    found, said = looked(5_000_000_000, 5_000_000_000, simulated=False)
    assert [(item.level, item.message, item.values) for item in found] == [(0, "", {})] * 2
    assert said == []


def test_a_clock_that_nobody_publishes_is_a_warning_and_one_line():
    found, said = looked(0, 0, 0)
    assert {(item.level, item.message) for item in found} == {(Level.WARN, NOTHING)}
    assert said == [(Level.WARN, NOTHING)]


def test_a_clock_that_moves_and_stands_is_told_at_each_change():
    found, said = looked(0, 7_000_000_000, 8_500_000_000, 8_500_000_000, 8_500_000_000, 9)
    assert [item.values["/clock"] for item in found] == [
        "not heard", "moves", "moves", "stands", "stands", "moves"]
    assert [item.level for item in found] == [Level.WARN] + [Level.OK] * 5
    moves = (Level.OK, "stamps follow /clock (use_sim_time); work and health do not")
    assert said == [(Level.WARN, NOTHING), moves, (
        Level.OK, "/clock stands at 8.500 s; work and health go on, stamps do not"), moves]
