# SPDX-License-Identifier: Apache-2.0
"""Controllers that take G-code: each dialect measures a plan; faults are named and stop it."""

import threading

import numpy as np
import pytest

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.machine import MachineError, gcode
from selfcal_ros.machine.gcode import GcodeMachine
from selfcal_ros.machine.measuring import Run
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import CollectorSettings
from test.machine.test_measuring import away_from
from test.support.cells import CELL, FEW, QUIET, Agreeing, WithPlate, write_cell
from test.support.firmware import (
    Duet,
    FaultyGrbl,
    Grbl,
    Klipper,
    LinuxCnc,
    Marlin,
    SlowGrbl,
    over_pty,
    over_tcp,
)
from test.support.waiting import wait_until

pytest.importorskip("serial")
pytestmark = pytest.mark.usefixtures("quick_controllers")
KINDS = {"grbl": Grbl, "marlin": Marlin, "klipper": Klipper, "linuxcnc": LinuxCnc}


@pytest.fixture
def quick_controllers(monkeypatch, jumping_clocks):
    """Wait for controllers that greet, move and stop at once."""
    for name in ("POLL_S", "GREETING_S", "HOLD_S"):
        monkeypatch.setattr(gcode, name, getattr(gcode, name) / 20)


@pytest.mark.parametrize(
    ("dialect", "over"),
    [
        ("grbl", over_pty),
        *((dialect, over_tcp) for dialect in KINDS if dialect != "grbl"),
    ],
)
def test_a_plan_is_measured_by_a_controller(tmp_path, dialect, over):
    cell, simulated = write_cell(
        tmp_path, camera=True, simulation=QUIET, plan=FEW, cell=CELL
    )
    firmware = KINDS[dialect]()
    with over(firmware) as port:
        machine = WithPlate(simulated, port=port, dialect=dialect)
        try:
            Run(
                read_plan(tmp_path / "plan.yaml"),
                cell,
                machine,
                tmp_path / "bag",
                Agreeing(),
            ).measure()
        finally:
            machine.close()
    away, _ = away_from(simulated.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8
    moves = [line for line in firmware.lines if "G1" in line.split()]
    assert all("F6000" in line for line in moves)


@pytest.mark.parametrize("dialect", KINDS)
def test_positions_are_mm_of_the_controller(dialect):
    firmware = KINDS[dialect]()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        machine.move_to((0.0125, -0.0025))
        assert (firmware.at["X"], firmware.at["Y"]) == (12.5, -2.5)
        assert machine.position() == pytest.approx((0.0125, -0.0025), abs=1e-12)
        machine.stop()
        machine.position()
        assert firmware.stopped
        machine.close()


def test_a_linuxcnc_stops_in_the_middle_of_a_move_and_moves_again_when_asked():
    """It does not read the connection that waits for the end of the move."""
    firmware = LinuxCnc()
    firmware.move_s = 3.0
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "linuxcnc", feed=6000.0)
        mover = threading.Thread(target=machine.move_to, args=[(0.01, 0.0)])
        mover.start()
        wait_until(lambda: firmware.at["X"] == 10.0, "the move")
        machine.stop()
        assert firmware.stopped
        mover.join(1.0)
        assert not mover.is_alive()
        firmware.move_s = 0.0
        assert machine.position() == pytest.approx((0.005, 0.0))
        machine.move_to((0.001, 0.0))
        assert machine.position() == pytest.approx((0.001, 0.0))
        machine.close()


def test_a_linuxcnc_in_emergency_stop_refuses_to_abort_and_stands():
    firmware = LinuxCnc()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "linuxcnc", feed=6000.0)
        firmware.alarm = "emergency stop"
        machine.stop()
        machine.close()


@pytest.mark.parametrize("dialect", KINDS)
def test_a_stop_that_the_connection_does_not_carry_is_an_error(dialect, monkeypatch):
    """Else nobody is told to use the emergency stop."""
    with over_tcp(KINDS[dialect]()) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)

        def lost(*_):
            raise OSError("no route to host")

        for lines in (machine._lines, getattr(machine._talk, "_for_stop", None)):
            if lines:
                monkeypatch.setattr(lines._serial, "write", lost)
        with pytest.raises(MachineError, match="the connection was lost"):
            machine.stop()
        machine.close()


def test_a_grbl_is_reset_when_it_stands():
    """A reset while it slows down loses the position."""
    firmware = SlowGrbl()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "grbl", feed=6000.0)
        machine.stop()
        assert machine.position() == (0.0, 0.0)
        machine.move_to((0.001, 0.0))
        machine.close()
    assert firmware.stopped == 2 and not firmware.alarm


@pytest.mark.parametrize("dialect", ["marlin", "klipper"])
def test_an_ok_too_many_is_named(dialect):
    """All answers after it are those of former commands: M400 is acknowledged in motion."""
    firmware = KINDS[dialect]()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        machine.move_to((0.001, 0.0))
        answer = firmware.answer
        firmware.answer = lambda line: answer(line) + b"ok\n" * (line == "G90")
        with pytest.raises(MachineError, match="'ok' alone: that of a former command"):
            machine.move_to((0.002, 0.0))
            machine.position()
        machine.close()


def test_answers_that_come_after_a_stop_are_not_taken_for_those_of_the_next_command():
    """Marlin acknowledges M410, and the move that it ends, when it has come to rest."""
    firmware = Marlin()
    firmware.halt_s = 0.05
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "marlin", feed=6000.0)
        machine.stop()
        assert machine.position() == (0.0, 0.0)
        machine.close()


def test_the_rotary_axis_is_a_in_degrees():
    firmware = LinuxCnc()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "linuxcnc", feed=6000.0, axes=["x", "y", "theta"])
        machine.move_to((0.0, 0.0, np.pi / 2))
        assert firmware.at["A"] == pytest.approx(90.0)
        assert machine.position()[2] == pytest.approx(np.pi / 2)
        machine.close()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"settings": b"$10=1\r\n$13=1\r\n"}, r"in inches \(\$13=1\).*set \$13=0"),
        ({"resting": "Run"}, "is in state 'run'.*let its program end"),
        ({"resting": "Check"}, "is in state 'check'.*leave the mode"),
        ({"resting": "Hold:0"}, "is in state 'hold'"),
    ],
)
def test_a_grbl_that_is_not_ready_is_refused_and_not_moved(changes, said):
    firmware = Grbl()
    vars(firmware).update(changes)
    with over_tcp(firmware) as port, pytest.raises(MachineError, match=said):
        GcodeMachine(port, "grbl", feed=6000.0)
    assert not [line for line in firmware.lines if line.startswith("G")]


@pytest.mark.parametrize("dialect", ["grbl", "linuxcnc"])
def test_a_feed_of_inverse_time_that_a_program_left_is_ended(dialect):
    """With G93 the first move would take a 6000th of a minute, however long it is."""
    firmware = KINDS[dialect]()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        machine.move_to((0.001, 0.0))
        machine.close()
    moves = [" G1 " in line for line in firmware.lines]
    assert firmware.lines[moves.index(True) - 1].endswith("G21 G90 G94")


@pytest.mark.parametrize(
    ("dialect", "mode"),
    [
        ("grbl", "G20"),
        ("linuxcnc", "G20"),
        ("marlin", "G20"),
        ("marlin", "G91"),
        ("klipper", "G91"),
    ],
)
def test_a_mode_that_another_sets_between_moves_changes_no_move(dialect, mode):
    """A pendant, a program, or a start-up line of GRBL ($N0=G20), which each reset runs again."""
    firmware = KINDS[dialect]()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        machine.move_to((0.002, 0.0))
        firmware.set_modes(mode)
        machine.move_to((0.003, 0.0))
        machine.close()
    assert firmware.at["X"] == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("dialect", "kind", "zero"),
    [
        ("marlin", Marlin, 100.0),
        ("marlin", Duet, 100.0),
        ("klipper", Klipper, 100.0),
        ("klipper", Klipper, 0.001),
    ],
)
def test_a_controller_whose_moves_count_from_another_zero_is_refused_and_not_moved(
    dialect, kind, zero
):
    """G92 X0 at 100 mm: a move to 100.05 by its steps would go to 200.05."""
    firmware = kind()
    firmware.at["X"], firmware.zero = 100.0, zero
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        said = f"it says X{100 - zero:g}, the machine stands at 100 mm: an offset is active"
        with pytest.raises(MachineError, match=said):
            machine.move_to((0.10005, 0.0))
        firmware.zero = 0.0
        machine.move_to((0.10005, 0.0))
        assert machine.position() == pytest.approx((0.10005, 0.0), abs=7e-6)
        machine.close()
    assert len([line for line in firmware.lines if line.startswith("G1")]) == 1


@pytest.mark.parametrize(("unit", "per_mm"), [("INCH", 1 / 25.4), ("CM", 0.1)])
def test_a_linuxcnc_in_another_unit_tells_where_it_is(unit, per_mm):
    """Its numbers are in the unit of its INI file; taken for mm the first small move is long."""
    firmware = LinuxCnc()
    firmware.unit, firmware.per_mm = unit, per_mm
    firmware.at |= {"X": 100.0, "A": 90.0}
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, "linuxcnc", feed=6000.0, axes=["x", "y", "theta"])
        assert machine.position() == pytest.approx((0.1, 0.0, np.pi / 2), abs=1e-7)
        machine.close()
        firmware.unit = "CUSTOM"
        with pytest.raises(MachineError, match="its unit is 'CUSTOM'"):
            GcodeMachine(port, "linuxcnc", feed=6000.0)


@pytest.mark.parametrize("dialect", KINDS)
def test_an_alarm_in_the_middle_stops_and_is_named(dialect):
    firmware = KINDS[dialect]()
    with over_tcp(firmware) as port:
        machine = GcodeMachine(port, dialect, feed=6000.0)
        firmware.alarm = "limit switch"
        with pytest.raises(MachineError, match=r"answered by|state 'alarm'"):
            machine.move_to((0.001, 0.0))
        machine.close()


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("garbage", "is not an answer; check baud"),
        ("digits lost", "is not a position; check baud"),
        ("line cut", "it reports 1 axes|no machine position|is not a position"),
        ("reset", "the controller was reset: it says 'Grbl 1.1h"),
        ("alarm", "in state 'alarm'"),
        ("never idle", "the move has not ended in"),
        ("silent", "no status report|no answer"),
    ],
)
def test_a_controller_that_fails_in_the_middle_of_a_view(
    tmp_path, monkeypatch, fault, said
):
    monkeypatch.setattr(gcode, "PATIENCE_S", 0.3)
    cell, simulated = write_cell(
        tmp_path, camera=True, simulation=QUIET, plan=FEW, cell=CELL
    )
    firmware = FaultyGrbl(fault, after=150)
    with over_tcp(firmware) as port:
        machine = WithPlate(simulated, port=port, dialect="grbl")
        with pytest.raises(MachineError, match=said):
            Run(
                read_plan(tmp_path / "plan.yaml"),
                cell,
                machine,
                tmp_path / "bag",
                Agreeing(),
            ).measure()
        machine.close()
    assert firmware.stopped >= 2 or fault == "silent"  # feed hold and reset
    readings = collect_bag(tmp_path / "bag", CollectorSettings()).measurements
    assert sum(int(view.count.sum()) for view in readings.views) >= 3


@pytest.mark.parametrize("over", [over_tcp, over_pty])
def test_a_lost_connection_is_named(over, monkeypatch):
    monkeypatch.setattr(gcode, "PATIENCE_S", 0.3)
    firmware = Grbl()
    with over(firmware) as port:
        machine = GcodeMachine(port, "grbl", feed=6000.0)
        firmware.dead = True
        with pytest.raises(MachineError, match=r"connection was lost|no answer"):
            machine.move_to((0.001, 0.0))
        machine.close()


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"dialect": "grbel"}, "the dialect 'grbel' is unknown"),
        ({"feed": 0.0}, "a feed of 0.0 mm/min"),
        ({"port": "/dev/there_is_none"}, "the port cannot be opened"),
    ],
)
def test_keys_that_cannot_be(keys, said):
    with pytest.raises(MachineError, match=said):
        GcodeMachine(
            **{"port": "socket://127.0.0.1:1", "dialect": "grbl", "feed": 1.0} | keys
        )


def test_a_password_that_is_refused():
    with (
        over_tcp(LinuxCnc()) as port,
        pytest.raises(MachineError, match="check password"),
    ):
        GcodeMachine(port, "linuxcnc", feed=1.0, password="other")
