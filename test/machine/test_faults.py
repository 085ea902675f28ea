# SPDX-License-Identifier: Apache-2.0
"""Faults of machines: each stops the stage or is named; what was measured is kept and continued."""

import errno
import math
import re
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.journal import Journal
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.checks.wiring import WiringError
from selfcal_ros.machine import Image, MachineError, Offset, visiting
from selfcal_ros.machine.clock import Clock
from selfcal_ros.machine.seeing import Eye
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.nodes import CollectorSettings
from test.machine.test_measuring import away_from, run_of
from test.support.cells import PLAN, Agreeing, Jumping, write_cell
from test.support.faults import Spoilt

LINES = PLAN.replace("angular_count: 0", "angular_count: 4")
SMALL_M, SMALL_RAD = 1.01e-4, 0.011
"""First moves of this cell, at most."""
ONSET = 16
"""Exposures before a fault in the middle of a view: the small moves need six."""

AT_THE_FIRST_MOVE = [
    ("frozen position", "nothing moved: its position is frozen"),
    ("stands still", "nothing moved: its position is frozen"),
    ("position in mm", "1e\\+03 times as far: is it mm for m?"),
    ("position in um", "1e\\+06 times as far: is it µm for m?"),
    ("position in inches", "39 times as far: is it inches for m?"),
    ("x is reversed", "the opposite direction: x is reversed"),
    ("y is reversed", "the opposite direction: y is reversed"),
    ("x and y are exchanged", "y moved instead: the axes are exchanged"),
    ("theta is reversed", "the opposite direction: theta is reversed"),
    ("turns the other way", "the opposite direction: theta is reversed"),
    ("theta in degrees", "57 times as far: is it degrees for rad?"),
    ("rotary drive is off", "theta was sent .* nothing moved"),
    ("position lacks an axis", "its position is"),
]


@pytest.mark.parametrize(("fault", "said"), AT_THE_FIRST_MOVE)
def test_a_wrong_stage_is_named_before_it_has_moved_farther_than_a_mark(
    tmp_path, fault, said
):
    cell, machine = write_cell(tmp_path, plan=LINES)
    spoilt = Spoilt(machine, fault)
    with pytest.raises(MachineError, match=said):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops
    moves = np.abs(np.array(spoilt.moves).reshape(-1, 3)).max(axis=0, initial=0)
    assert (moves <= [SMALL_M, SMALL_M, SMALL_RAD]).all()


AT_THE_FIRST_MARK = [
    ("mirrored", "the opposite direction: x is reversed"),
    ("turned by 180 degrees", "the opposite direction: x is reversed"),
    ("turned by 90 degrees", "y moved instead: the axes are exchanged"),
    ("late by one frame", "late by one frame"),
    ("late by two frames", "late by one frame"),
    ("of sixteen bits", "black, grey values up to 2.. of 65535.*full_scale"),
    ("of half the size", "nothing is seen at the first 5 stops.*pixel_size"),
    ("no image", "nothing is seen at the first 5 stops; the machine returns no images"),
    ("offsets in um", "is it µm for m?"),
    ("offsets are reversed", "the opposite direction: x is reversed"),
    ("offsets are exchanged", "y moved instead: the axes are exchanged"),
]


@pytest.mark.parametrize(("fault", "said"), AT_THE_FIRST_MARK)
def test_a_wrong_camera_or_sensor_is_named_at_the_first_marks(tmp_path, fault, said):
    cell, machine = write_cell(tmp_path, camera="offset" not in fault)
    spoilt = Spoilt(machine, fault)
    with pytest.raises((MachineError, NoDataError), match=said):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops
    assert len(spoilt.moves) < 20


OF_THE_STAGE = [
    ("connection lost in a move", "the connection was lost"),
    ("connection lost at a reading", "the connection was lost"),
    ("no answer to a move", "machine.move_to: TimeoutError: no answer in 5 s"),
    ("no answer for the position", "machine.position: TimeoutError: no answer in 5 s"),
    (
        "driver raises an error of its own",
        "machine.move_to: OSError: .*faults.py, line",
    ),
    ("position is not a number", "its position is .*nan"),
    ("position is infinite", "its position is .*inf"),
    ("position is None", "its position is None"),
    ("position is text", "its position is '1.0 mm'"),
    ("frozen position", "nothing moved: its position is frozen"),
    ("stands still", "nothing moved.* its drive is off"),
    ("limit switch", "x was sent to .* limit switch"),
    ("ends short", "x was sent to .*, -100 µm away"),
    ("never at rest", "x (does not come to rest|moved by)"),
    ("creeps at rest", "y (does not come to rest|moved by)"),
    ("sways", "x moved by -?3 µm during 3 exposures"),
    ("replies of another axis", "it answers for the other axis"),
    ("zero lost at rest", "x has changed by 3000 µm at rest, without a command"),
    ("moved by hand", "y has changed by 50 µm at rest, without a command"),
]
OF_IMAGES = [
    ("no answer of the camera", "machine.image: TimeoutError: no answer in 5 s"),
    ("camera disconnected", "machine.image: OSError"),
    ("last image again", "returns the last image again"),
    ("late by one frame", "late by one frame"),
    ("torn image", "nothing is seen at the last 5 stops"),
    ("black", "the image is black"),
    ("saturated", "the image is saturated"),
    ("blank", "the image is blank"),
    ("empty", "an image is uint8 \\(0, 150\\)"),
    ("noise alone", "nothing is seen at the last 5 stops"),
    ("out of focus", "nothing is seen at the last 5 stops .rejected: no_fit"),
    ("colour", "an image is uint8 \\(140, 150, 3\\)"),
    ("of floats", "an image is float64"),
    (
        "of half the size",
        "an image is 75 x 70 uint8, those before were 150 x 140 uint8",
    ),
    ("of sixteen bits", "an image is 150 x 140 uint16, those before"),
    ("no image", "it returns no image any more"),
    ("stamp of the future", "the stamp of an exposure"),
    ("stamp of the past", "the stamp of an exposure"),
]


@pytest.mark.parametrize(
    ("fault", "said", "camera"),
    [
        *((*fault, False) for fault in OF_THE_STAGE),
        *((*fault, True) for fault in OF_IMAGES),
    ],
)
def test_a_fault_in_the_middle_of_a_view_stops_the_stage_and_keeps_the_readings(
    tmp_path, fault, said, camera
):
    cell, machine = write_cell(tmp_path, camera=camera)
    spoilt = Spoilt(machine, fault, after=ONSET)
    with pytest.raises((MachineError, NoDataError), match=said):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops
    assert len(spoilt.moves) - spoilt.moves_before <= (
        6 if "last 5 stops" in said else 4
    )
    readings = collect_bag(tmp_path / "bag", CollectorSettings()).measurements
    assert sum(int(view.count.sum()) for view in readings.views) >= 8


def test_of_axes_that_do_not_rest_the_one_farthest_beyond_its_tolerance_is_named(
    tmp_path,
):
    cell, machine = write_cell(tmp_path)
    with pytest.raises(
        MachineError,
        match=r"x does not come to rest in 1 s: two readings differ by -?3",
    ):
        run_of(tmp_path, Spoilt(machine, "sways"), cell).measure()


@pytest.mark.parametrize(
    ("fault", "camera"),
    [
        ("connection lost in a move", False),
        ("zero lost at rest", False),
        ("out of focus", True),
    ],
)
def test_a_run_that_a_fault_has_ended_is_resumed_to_the_right_map(
    tmp_path, fault, camera
):
    cell, machine = write_cell(tmp_path, camera=camera)
    with pytest.raises((MachineError, NoDataError)):
        run_of(tmp_path, Spoilt(machine, fault, after=ONSET), cell).measure()
    run_of(tmp_path, machine, cell, Jumping(Jumping().ns + 10**12)).measure(resume=True)
    away, result = away_from(machine.truth, tmp_path / "bag")
    assert result.verdict.qualified
    assert np.abs(away).max() < 5e-8


HARMLESS = {
    "position one reading old": False,
    "ends a little short": False,
    "light is failing": True,
    "camera was knocked": True,
}
"""Faults, and whether they are the camera's."""


@pytest.mark.parametrize(("fault", "camera"), HARMLESS.items())
def test_a_fault_that_the_readings_allow_for_leaves_the_map_right(
    tmp_path, fault, camera
):
    cell, machine = write_cell(tmp_path, camera=camera)
    desk = Agreeing()
    run_of(tmp_path, Spoilt(machine, fault, after=ONSET), cell, desk=desk).measure()
    away, _ = away_from(machine.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8
    noted = [line for line in desk.lines if line.startswith("note: view 'identity'")]
    assert [("has slipped" in line) for line in noted] == [True] * (
        fault == "camera was knocked"
    )


NOT_SHOWN_BY_THE_POSITION = [
    (
        "backlash of 5 um",
        0,
        r"lie (4|5)[.]?\d* µm apart in x and (4|5)[.]?\d* µm in y: backlash",
    ),
    ("steps were lost once", 40, r"[+]20 µm in x and .* steps were lost"),
    ("loses steps", 0, r"the marks run away by [+]\d+ µm in x"),
]


@pytest.mark.parametrize(("fault", "after", "said"), NOT_SHOWN_BY_THE_POSITION)
def test_what_no_position_shows_is_named_from_the_repeats(tmp_path, fault, after, said):
    cell, machine = write_cell(
        tmp_path, plan=PLAN.replace("grid_size: 3", "grid_size: 5")
    )
    desk = Agreeing()
    try:
        run_of(tmp_path, Spoilt(machine, fault, after), cell, desk=desk).measure()
    except NoDataError as error:
        desk.say(str(error))
    assert re.search(said, "\n".join(desk.lines))


def test_marks_of_exchanged_names_and_bad_ones_are_named_with_the_reason(tmp_path):
    cell, machine = write_cell(
        tmp_path, plan=PLAN.replace("grid_size: 3", "grid_size: 5")
    )
    for fault, said in (
        ("m and n are exchanged", "the ids have m and n exchanged"),
        ("score is low", "rejected as low_score"),
    ):
        with pytest.raises(NoDataError, match=said):
            run_of(tmp_path, Spoilt(machine, fault), cell, Jumping()).measure()
        (tmp_path / "bag").rename(tmp_path / fault)


def test_a_sensor_that_turns_its_sign_is_named_at_the_end_of_the_view(tmp_path):
    cell, machine = write_cell(tmp_path)
    with pytest.raises(WiringError, match="offset_x and offset_y rise"):
        run_of(tmp_path, Spoilt(machine, "offsets are reversed", ONSET), cell).measure()


def test_an_offset_that_is_no_number_stops_the_stage(tmp_path):
    cell, machine = write_cell(tmp_path)
    spoilt = Spoilt(machine, "offset is not a number", ONSET)
    with pytest.raises(
        MachineError, match=r"an offset is x nan.*leave out what is not seen"
    ):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops


def test_lines_of_the_wrong_sense_are_refused_when_the_map_is_solved(tmp_path):
    cell, machine = write_cell(tmp_path, plan=LINES)
    run_of(tmp_path, Spoilt(machine, "line reversed"), cell).measure()
    with pytest.raises(WiringError, match="offset_theta has the other sign"):
        away_from(machine.truth, tmp_path / "bag")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("image", np.zeros((140, 150), np.uint8), "it returns ndarray; return Image"),
        ("offsets", None, "it returns None; return a list of Offset"),
        ("offsets", [Offset(mark=(0.9999, 0))], r"it returns Offset\(.*0.9999, 0"),
        ("offsets", [Offset(mark=1)], "mark as two whole numbers"),
        ("offsets", [Offset(x="1 um")], r"it returns Offset\(x='1 um'"),
        ("offsets", [Offset(stamp_ns="now")], "a stamp is 'now'; give ns since 1970"),
        ("offsets", [Offset(stamp_ns=math.inf)], "a stamp is inf; give ns since 1970"),
    ],
)
def test_a_class_that_returns_something_else(tmp_path, name, value, said):
    cell, machine = write_cell(tmp_path)
    setattr(machine, name, lambda: value)
    with pytest.raises(MachineError, match=said):
        run_of(tmp_path, machine, cell).measure()


@pytest.mark.parametrize("camera", [False, True])
def test_stamps_as_python_tells_the_time_in_seconds_are_ns_as_well(tmp_path, camera):
    """time.time() * 1e9 is a float, and an image's was a traceback in the journal."""
    cell, machine = write_cell(tmp_path, camera=camera)
    run = run_of(tmp_path, machine, cell)
    name = "image" if camera else "offsets"
    seen = getattr(machine, name)

    def stamped():
        # a float has 256 ns there, so not at the begin of the call
        run.clock.ns += 1000
        stamp_ns = float(run.clock.ns)
        run.clock.ns += 1000
        if camera:
            return replace(seen(), stamp_ns=stamp_ns)
        return [replace(offset, stamp_ns=stamp_ns) for offset in seen()]

    setattr(machine, name, stamped)
    run.measure()
    assert away_from(machine.truth, tmp_path / "bag")[1].verdict.qualified


@pytest.mark.parametrize("name", ["move_to", "position", "offsets"])
def test_a_device_that_never_answers_is_stopped_and_named(tmp_path, monkeypatch, name):
    cell, machine = write_cell(tmp_path)
    spoilt = Spoilt(machine, "")
    answer = getattr(spoilt, name)

    def silent(*values):
        if len(spoilt.moves) > ONSET:
            time.sleep(100)
        return answer(*values)

    monkeypatch.setattr(spoilt, name, silent)
    monkeypatch.setattr(visiting, "ANSWER_S", 0.2)
    quick = replace(cell, settle=replace(cell.settle, patience=1.0))
    with pytest.raises(
        MachineError, match=rf"machine.{name}: it has not answered for 1.2 s"
    ):
        run_of(tmp_path, spoilt, quick).measure()
    assert spoilt.stops


def test_a_stop_that_never_answers_is_said(tmp_path, monkeypatch):
    cell, machine = write_cell(tmp_path)
    spoilt = Spoilt(machine, "connection lost in a move", ONSET)
    monkeypatch.setattr(spoilt, "stop", lambda: time.sleep(100))
    monkeypatch.setattr(visiting, "ANSWER_S", 0.2)
    with pytest.raises(
        MachineError, match=r"cannot be stopped .no answer.; use the emergency"
    ):
        run_of(tmp_path, spoilt, cell).measure()


def test_a_driver_that_ends_the_program_is_an_error(tmp_path, monkeypatch):
    cell, machine = write_cell(tmp_path)
    monkeypatch.setattr(machine, "move_to", lambda _: sys.exit(0))
    with pytest.raises(MachineError, match=r"machine\.move_to: SystemExit: 0"):
        run_of(tmp_path, machine, cell).measure()


def test_a_stage_that_runs_away_is_stopped_at_once_and_the_axis_named(
    tmp_path, monkeypatch
):
    cell, machine = write_cell(tmp_path)
    spoilt = Spoilt(machine, "")
    position = spoilt.position

    def far():
        x, *others = position()
        return (0.2 if len(spoilt.moves) > ONSET else x, *others)

    monkeypatch.setattr(spoilt, "position", far)
    with pytest.raises(
        MachineError, match=r"x was sent to \S+ and indicates 0.2 beyond its lim"
    ):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops and len(spoilt.moves) == ONSET + 1


def test_a_stage_that_cannot_be_stopped_is_said(tmp_path):
    cell, machine = write_cell(tmp_path)

    class Deaf(Spoilt):
        def stop(self):
            raise OSError("no route to host")

    spoilt = Deaf(machine, "connection lost in a move", ONSET)
    with pytest.raises(
        MachineError,
        match=r"connection was lost.* and it cannot be stopped .no "
        r"route to host.; use the emergency stop",
    ):
        run_of(tmp_path, spoilt, cell).measure()


def test_a_disk_that_is_full_stops_the_stage_and_the_run_is_resumed(
    tmp_path, monkeypatch
):
    cell, machine = write_cell(tmp_path)
    spoilt, written, write = Spoilt(machine), [], Journal.write

    def fill(journal, *args):
        written.append(args)
        if len(written) == 100:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(journal, *args)

    monkeypatch.setattr(Journal, "write", fill)
    with pytest.raises(OSError, match="No space left"):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops
    run_of(tmp_path, machine, cell, Jumping(Jumping().ns + 10**12)).measure(resume=True)
    away, _ = away_from(machine.truth, tmp_path / "bag")
    assert np.abs(away).max() < 5e-8


def test_a_clock_that_is_set_in_a_run_does_not_reach_the_stamps(monkeypatch):
    clock = Clock()
    before = clock.now_ns()
    monkeypatch.setattr("time.time_ns", lambda: 0)
    assert 0 <= clock.now_ns() - before < 10**9


def test_a_robot_that_lays_the_plate_otherwise_is_refused_by_its_view(tmp_path):
    *head, turned, shifted = PLAN.replace("grid_size: 3", "grid_size: 5").splitlines()
    cell, machine = write_cell(tmp_path, plan="\n".join([*head, shifted, turned]))

    class Clumsy(Spoilt):
        def place(self, placing):
            view = placing.command.view
            if view.name == "rot90":
                view = replace(view, rotation_rad=-view.rotation_rad)
            machine._lay(replace(placing.command, view=view))

    spoilt = Clumsy(machine)
    with pytest.raises(InputError, match="rot90"):
        run_of(tmp_path, spoilt, cell).measure()
    assert spoilt.stops


def test_a_camera_of_12_bits_in_16_saturates_where_it_ends():
    """As in the same image from a file: a clipped mark is rejected, a clipped image refused."""
    sizes = {"pixel_size": 1e-6, "mark": "disc", "mark_size": 4e-5}
    eye = Eye(DetectorSettings.checked({**sizes, "polarity": "bright"}, "test"), "test")
    v, u = np.mgrid[:120, :130]
    share = np.clip(20.5 - np.hypot(v - 60, u - 65), 0, 1)
    noise = np.random.default_rng(3).normal(0, 10, share.shape)
    values = np.clip(1000 + 4000 * share + noise, 0, 4095).astype(np.uint16)
    assert eye.detections(Image(values), 1, (0.0, 0.0, 0.0)) == []
    assert eye.why == " (rejected: saturated 1)"
    with pytest.raises(MachineError, match="the image is saturated"):
        eye.trusted(Image(np.where(v > 50, np.uint16(4095), values)), (0.0, 0.0, 0.0))
