# SPDX-License-Identifier: Apache-2.0
"""`selfcal cell check` of a machine that shares no code with the package, right and wrong.

Each wrong cell fails; the first line names its fault, and what follows from it is told as such.
"""

import re
import tracemalloc
from dataclasses import replace
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Phase
from selfcal_ros.model.readings import RepeatMotion
from selfcal_ros.nodes.sessions import cell_check
from selfcal_ros.nodes.sessions.cell_check import (
    MOST_KEPT,
    CellCheck,
    CheckItem,
    grouped,
)
from selfcal_ros.nodes.sessions.health import Level
from test.support.bench_cell import Bench
from test.support.ports import Hands, settings_of
from test.support.sessions import small_plan

TICK_S, PERIOD_S = 0.05, 0.1
PLACE, MEASURE, DONE, ABORT = range(4)


class Cell(Bench):
    """A bench that is driven without ROS: a stage that stops for 0.1 s at each exposure.

    `fault` is what is wrong with it, in words.
    """

    def __init__(self, fault, hands, **kwargs):
        super().__init__(seed=4, **kwargs)
        self.fault, self.hands, self.check = fault, hands, None
        self.work, self.acted, self.begun_s, self.last = [], 0, 0.0, None
        # a view without an end is exposed only until it is aborted
        self.planned = iter(())
        self.view, self.position, self.late = None, self.home, []  # in transit
        self.noise = np.random.default_rng(1)
        self.ended = False
        self.came = 1.0  # sign of the last motion along x

    def lay(self):
        """Place the plate turned by 1 mrad, or too straight to show the sign of the lines."""
        super().lay()
        self.laid[0] = 2e-5 if self.fault.endswith("straight") else 1e-3

    def obey(self, fields):
        """Act on a command, once."""
        view = SimpleNamespace(**fields)
        stamp = fields["header"]["stamp"]
        stamp = stamp["sec"] * 10**9 + stamp["nanosec"]
        if stamp <= self.acted or (
            self.fault == "ignores ABORT" and view.phase == ABORT
        ):
            return
        self.acted, self.planned = stamp, iter(())
        self.ended |= self.fault == "ends at ABORT" and view.phase == ABORT
        self.work = self.work[:1] if self.fault == "arrives late, right" else []
        self.begun_s = self.hands.seconds  # an exposure that has begun may end
        if view.phase == PLACE:
            self.lay()
            if self.fault == "measures at PLACE":
                self.view, self.planned = view, self.exposures(view)
                self.take_next()
        elif view.phase == MEASURE:
            if self.fault == "another view":
                view.rotation += np.pi / 2
            if self.fault.startswith("shifted view"):
                _, _, pitches, axis = self.fault.split()
                along = f"translation_{axis}"
                shift_m = int(pitches) * view.grid_pitch
                setattr(view, along, getattr(view, along) + shift_m)
            if self.fault.endswith("no check stops"):
                view.check_marks = 0
            self.view, self.planned = view, self.exposures(view)
            self.take_next()
            self.begun_s = self.hands.seconds

    def take_next(self):
        """Plan the next stop of the view."""
        self.work += islice(self.planned, 1)

    def see_again(self, fields):
        """Measure what a status names as missing."""
        assert fields["grid_done"] >= 0  # it is unsigned in the message
        if not self.work and self.view is not None and not fields["complete"]:
            for m, n in zip(fields["missing_m"], fields["missing_n"], strict=True):
                self.work += self.stops(self.view, m, n)
            self.begun_s = self.hands.seconds

    def tick(self):
        """Publish the encoder, and the detection that is due."""
        if self.ended:
            return
        now = self.hands.seconds
        if self.work and now >= self.begun_s:
            before, self.position = self.position[0], self.work[0][0]
            self.came = np.sign(self.position[0] - before) or self.came
        if self.fault != "encoder with gaps" or round(now / TICK_S) % 20 > 8:
            self.check.take_encoder(self.encoder(now))
        while self.late and self.late[0][0] <= now:
            self.check.take_detection(self.late.pop(0)[1])
        if self.work and now >= self.begun_s + PERIOD_S / 2:
            _, seen = self.work.pop(0)
            self.take_next()
            self.begun_s = now + PERIOD_S / 2
            self.show(seen, now - TICK_S / 2)

    def encoder(self, now):
        """Return the sample of the encoder."""
        x, y, theta = self.position
        if self.fault == "does not move":
            x, y, theta = self.home
        if self.fault == "is pushed at times":  # to 0.1 mm and back, at 1 mm/s
            x += 5e-5 * max(0, 2 - abs(round(now / TICK_S) % 41 - 2))
        if self.fault == "indicates NaN" or (
            self.fault == "indicates NaN at times" and self.noise.random() < 0.3
        ):
            x = np.nan
        if self.fault == "x and y exchanged":
            x, y = y, x
        scale = {
            "millimetres": (1e3, 1e3),
            "x in millimetres": (1e3, 1.0),
            "inches": (39.37, 39.37),
            "x a twentieth too long": (1.05, 1.0),
            "a fiftieth too long": (1.02, 1.02),
            "a tenth": (0.1, 0.1),
            "y does not move": (1.0, 0.0),
        }.get(self.fault, (1.0, 1.0))
        x, y = scale[0] * x, scale[1] * y
        if self.fault.startswith("reversed x"):
            x = -x
        theta *= {
            "reversed theta": -1.0,
            "theta in degrees": np.rad2deg(1.0),
            "theta in mrad": 1e3,
            "frozen theta": 0.0,
        }.get(self.fault, 1.0)
        if self.fault == "half a pitch aside":
            y += 5.1e-3
        if self.fault == "another zero of theta":
            theta += 0.4
        names = ("a", "b", "c") if self.fault == "other joints" else ("x", "y", "theta")
        stamped = 0.0 if self.fault == "one stamp" else now
        positions = [x, y, theta]
        if self.fault == "x twice":
            names, positions = (*names, "x"), [*positions, x]
        return SimpleNamespace(
            header=self.header(stamped), name=names, position=positions
        )

    def show(self, seen, seconds):
        """Publish a detection of an exposure."""
        seen, before = dict(FIELDS) | seen, self.last
        self.last = seen
        if self.fault == "repeats the last detection" and before is not None:
            seen = before
        if self.fault.startswith("theta reversed"):
            seen["offset_theta"] *= -1
        if "camera turned" in self.fault:
            turned = np.exp(1j * np.deg2rad(float(self.fault.split()[-1]))) * (
                seen["offset_x"] + 1j * seen["offset_y"]
            )
            seen = seen | {"offset_x": turned.real, "offset_y": turned.imag}
        if self.fault.startswith("mirrored camera"):
            seen = seen | {"offset_x": -seen["offset_x"]}
        if self.fault == "offsets in mm":
            seen = seen | {key: 1e3 * seen[key] for key in ("offset_x", "offset_y")}
        if self.fault == "pixels too large":
            seen = seen | {key: 1.3 * seen[key] for key in ("offset_x", "offset_y")}
        if self.fault == "no offsets":
            seen = seen | {"offset_x": 0.0, "offset_y": 0.0}
        if self.fault == "offsets 1000 times too small":
            noise = self.noise.normal(scale=2e-8, size=2)
            seen = seen | {
                key: 1e-3 * seen[key] + float(one)
                for key, one in zip(("offset_x", "offset_y"), noise, strict=True)
            }
        if self.fault == "backlash":
            seen = seen | {"offset_x": seen["offset_x"] + 1e-6 * self.came}
        seen = seen | {
            "m and n exchanged": {"m": seen["n"], "n": seen["m"]},
            "offsets with the place of the stage": {
                "offset_x": seen["offset_x"] + self.position[0],
                "offset_y": seen["offset_y"] + self.position[1],
            },
            "offset_theta in degrees": {
                "offset_theta": np.degrees(seen["offset_theta"])
            },
            "offset_theta in mrad": {"offset_theta": 1e3 * seen["offset_theta"]},
            "no offset_theta": {"offset_theta": 0.0},
            "offsets in pixels": {
                key: 2e5 * seen[key] for key in ("offset_x", "offset_y")
            },
            "one id": {"m": 0, "n": 0},
            "m reversed": {"m": -seen["m"]},
            "n reversed": {"n": -seen["n"]},
            "m and n reversed": {"m": -seen["m"], "n": -seen["n"]},
            "counts from a corner": {"m": seen["m"] + 1, "n": seen["n"] + 1},
            "counts from one": {"m": seen["m"] + 2, "n": seen["n"] + 2},
            "k reversed": {"k": -seen["k"] % 8},
            "k shifted": {"k": (seen["k"] + 1) % 8},
        }.get(self.fault, {})
        seconds += {"stamped late": PERIOD_S, "old stamps": -30.0}.get(self.fault, 0.0)
        arrives = self.hands.seconds + {
            "arrives late": 11.0,
            "arrives late, right": 2.0,
        }.get(self.fault, 0.0)
        again_s = {"publishes twice": [0.0], "stamps twice": [1e-6]}.get(self.fault, [])
        if self.fault == "second camera":
            again_s = [0.0]
            self.check.publishers = {"stage/mark_detections": ["camera", "old_camera"]}
        for more_s in (0.0, *again_s):
            self.late.append(
                (arrives, SimpleNamespace(header=self.header(seconds + more_s), **seen))
            )

    def header(self, seconds):
        stamp = self.hands.now_ns + round((seconds - self.hands.seconds) * 1e9)
        return SimpleNamespace(
            stamp=SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9)
        )


FIELDS = {
    "m": 0,
    "n": 0,
    "k": 0,
    "offset_x": 0.0,
    "offset_y": 0.0,
    "offset_theta": 0.0,
    "sigma": 0.0,
}


def checked(fault="", statuses=(), joints=(), **cell):
    """Return the items of a check of a cell, beside nodes with these statuses, and other joints."""
    hands = Hands()
    bench = Cell(fault, hands, **cell)
    check = bench.check = CellCheck(
        small_plan(),
        settings_of("measurement_collector"),
        hands.ports,
        settle_s=0.2,
        patience_s=30.0,
    )
    for status in statuses:
        check.take_diagnosis(*status)
    if joints:
        check.take_encoder(
            SimpleNamespace(
                header=bench.header(0.0), name=joints, position=[0.0] * len(joints)
            )
        )
    while not check.done:
        hands.published.clear()
        check.tick()
        for output, fields in hands.published:
            (bench.obey if output == "command" else bench.see_again)(fields)
        bench.tick()
        hands.pass_time(TICK_S)
    return check.items


@pytest.mark.parametrize("cell", [{}, {"ids": False}])
def test_the_right_cell_passes(cell):
    assert [item for item in checked(**cell) if not item.passed] == []


def test_a_right_cell_that_takes_its_time_for_each_image_passes():
    """What it exposed as ABORT came arrives long after it."""
    items = checked("arrives late, right")
    assert [item for item in items if not item.passed] == []


REVERSED_THETA = (
    "the lines are counted clockwise, or theta is indicated with the wrong sign (54"
)
WRONG = [
    ("theta reversed", "theta", "offset_theta has the other sign"),
    ("theta reversed, straight", "theta", "too little to tell the sign"),
    ("laid straight", "theta", "too little to tell the sign"),
    ("ignores ABORT", "abort", "detections exposed later than 1.04 s after ABORT"),
    ("camera turned 30", "signs", "the offsets are turned by +30.0°"),
    ("camera turned 90", "signs", "the offsets are turned by +90.0°"),
    ("mirrored camera", "signs", "offsets of the other sign: offset_x rises"),
    (
        "pixels too large",
        "signs",
        "the offsets are 1.3 times as large as the motion of the stage",
    ),
    (
        "no offsets",
        "signs",
        "the offsets do not follow the stage: between the stops at a mark",
    ),
    ("offsets 1000 times too small", "signs", "it moves by 27 µm rms, they by 0.05"),
    ("backlash", "marks", "16 outlier_among_repeats"),
    ("m and n exchanged", "ids", "m and n are exchanged"),
    ("x and y exchanged", "ids", "x and y are exchanged"),
    ("millimetres", "ids", "the indicated positions are 1000 times those of the marks"),
    ("offsets in mm", "ids", "the offsets are in mm (54"),
    (
        "offsets with the place of the stage",
        "ids",
        "the offsets are places of the marks on the stage (54",
    ),
    ("y does not move", "ids", "y does not move: it is indicated within 0 mm during"),
    ("a tenth", "ids", "the stage moves by 2 mm alone during the whole view"),
    ("offset_theta in degrees", "theta", ": offset_theta is in degrees"),
    ("measures at PLACE", "commands", "detections between PLACE and MEASURE"),
    ("reversed x", "ids", "x is indicated with the wrong sign"),
    ("m reversed", "ids", "m is counted against plate x (54"),
    (
        "reversed x, no check stops",
        "ids",
        "m is counted against plate x, or x is indicated with the wrong sign (34",
    ),
    ("n reversed", "ids", "n is counted against plate y (54"),
    ("m and n reversed", "ids", "m and n are counted against plate x and y (54"),
    ("counts from a corner", "ids", "the one in the middle is called (1, 1) (54"),
    ("counts from one", "ids", "the one in the middle is called (2, 2) (54"),
    ("publishes twice", "marks", "54 of 108 detections used, 54 duplicate"),
    ("stamps twice", "marks", "108 of 108 detections used"),
    ("ends at ABORT", "commands", "0 samples and 0 detections after a MEASURE that"),
    ("encoder with gaps", "encoder rate", "largest 500 ms"),
    ("x twice", "joints", "heard theta, x, y; x twice in 4"),
    ("one id", "ids", "all marks are called (0, 0) (54"),
    ("x in millimetres", "ids", "x is indicated 1000 times as far as the marks lie"),
    ("x a twentieth too long", "ids", "x is indicated 1.05 times as far as the marks"),
    ("a fiftieth too long", "scale", "x is indicated 1.02 times as far as the marks"),
    (
        "inches",
        "ids",
        "x is indicated 39.37 times as far as the marks lie apart; y is indicated 39.37",
    ),
    ("theta in mrad", "ids", "theta is indicated 1000 times as far as the lines lie"),
    ("offset_theta in mrad", "ids", "offset_theta is not the offset of a line in rad"),
    ("no offset_theta", "theta", "+0.000 mrad: offset_theta is the same for all lines"),
    ("offsets in pixels", "ids", "the offsets are in µm or pixels (54"),
    ("mirrored camera turned 45", "signs", "mirrored (x) and turned by -45.0° against"),
    ("half a pitch aside", "placing", "+5.13) mm and"),
    ("one stamp", "encoder rate", "samples, all with one stamp"),
    ("reversed theta", "ids", REVERSED_THETA),
    ("k reversed", "ids", REVERSED_THETA),
    ("theta in degrees", "ids", "theta is indicated in degrees (54"),
    (
        "frozen theta",
        "ids",
        "theta does not move: it is indicated at 0 rad during the whole view",
    ),
    (
        "another zero of theta",
        "ids",
        "theta is indicated +22.92° from where the lines are (54",
    ),
    ("k shifted", "ids", "theta is indicated -45° from where the lines are (54"),
    ("indicates NaN", "joints", "heard theta, x, y; x without a number in 4"),
    ("indicates NaN at times", "joints", "; x without a number in 1"),
    ("other joints", "joints", "heard a, b, c"),
    ("old stamps", "detection clock", "stamps 3.008e+04 ms old when they arrive"),
    ("arrives late", "detection clock", "stamps 1.102e+04 ms old when they arrive"),
    (
        "stamped late",
        "ids",
        "each detection shows the mark of 1 exposure before its stamp",
    ),
    (
        "repeats the last detection",
        "ids",
        "each detection shows the mark of 1 exposure before",
    ),
    (
        "does not move",
        "ids",
        "the stage does not move: it is indicated at x = 0 mm, y = 0 mm",
    ),
    ("another view", "ids", "the marks are those of a plate turned by 90°"),
    *(
        (
            f"shifted view {pitches} {axis}",
            "ids",
            f"the marks are those of a plate shifted by {pitches} pitch along {axis}",
        )
        for axis in "xy"
        for pitches in ("+1", "-1")
    ),
]


REMEDIES = {
    "theta reversed, straight": "turn the plate by 1 mrad and check again",
    "laid straight": "turn the plate by 1 mrad and check again",
    "arrives late": "publish each detection as soon as it is found",
    "pixels too large": "divide pixel_size by this factor",
    "no offsets": "measure the offset anew in each image, and publish it in m",
    "offsets 1000 times too small": "measure the offset anew in each image",
    "backlash": "repeats of a mark contradict each other; check the stage for backlash, that one "
    "node alone publishes detections (ros2 topic info -v)",
    "old stamps": "stamp detections at the instant of exposure",
    "reversed theta": "count k counter-clockwise; or reverse the sign of theta",
    "stamps twice": "publish each detection once, with the stamp of its exposure",
    "ends at ABORT": "end the view alone when ABORT arrives",
    "x twice": "name each joint once",
    "one id": "publish m and n of the mark that is seen",
    "x in millimetres": "correct unit or scale of x (m, rad)",
    "inches": "correct unit or scale of x and y (m, rad)",
    "millimetres": "publish joint positions in metres",
    "half a pitch aside": "place it within 4 mm and 2°",
    "theta in degrees": "publish theta in rad",
    "frozen theta": "turn the stage to each line",
    "k shifted": "count k from the line along plate x, and set theta to 0",
    "m reversed": "m counts the marks along plate x",
    "x and y exchanged": "exchange joint_x and joint_y",
    "reversed x": "reverse the sign",
}


@pytest.mark.parametrize(
    ("fault", "name", "figure"), WRONG, ids=[fault for fault, *_ in WRONG]
)
def test_a_wrong_cell_fails_once_and_what_follows_is_told_as_that(fault, name, figure):
    first, *others = [item for item in checked(fault) if not item.passed]
    assert (first.name, first.follows) == (name, "")
    assert figure in first.figure
    assert first.remedy.startswith(REMEDIES.get(fault, ""))
    assert first.remedy
    assert {(item.follows, item.remedy) for item in others} <= {(name, "")}


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("deg", [30, -62])
def test_the_turn_and_mirror_that_are_advised_undo_those_of_the_camera(mirrored, deg):
    """By the formula of camera.md: R(turn), after the sign of u for a mirror."""
    fault = f"{'mirrored ' * mirrored}camera turned {deg}"
    first = next(item for item in checked(fault) if not item.passed)
    mirror = "mirror: true" in first.remedy
    turn_deg = float(re.search(r"turn: (-?[\d.]+)", first.remedy)[1])
    offset = np.array([3e-6 - 1e-6j, 2e-6j])
    published = np.exp(1j * np.deg2rad(deg)) * offset
    published = -published.conj() if mirrored else published
    seen = -published.conj() if mirror else published
    assert mirror is mirrored
    np.testing.assert_allclose(
        np.exp(1j * np.deg2rad(turn_deg)) * seen, offset, rtol=2e-3
    )


def test_a_unit_that_would_make_all_marks_one_is_not_named():
    """Without ids, positions a million times too large would all be those of one mark."""
    first = next(item for item in checked("millimetres", ids=False) if not item.passed)
    assert first.figure.startswith(
        "the indicated positions are 1000 times those of the marks: they are in mm ("
    )


def test_of_offsets_without_repeats_nothing_is_said(monkeypatch):
    """Most exposures were while the stage moved: that is the fault."""
    monkeypatch.setattr(cell_check, "wiring_faults", lambda measurements: [])
    check = CellCheck(small_plan(), settings_of("measurement_collector"), Hands().ports)
    view = SimpleNamespace(motion=None, motion_theta=None)
    told = check._judge_wiring(SimpleNamespace(views=[view]), stops=5)
    assert told == (False, False)
    assert check.items[-1].figure == "offset against stage not known (-1 expected)"


@pytest.mark.parametrize(("slope", "dof", "told"), [(-138, 2, False), (-1, 8, True)])
def test_a_slope_of_theta_is_told_where_it_is_one(monkeypatch, slope, dof, told):
    """Of two degrees of freedom noise alone often follows noise."""
    monkeypatch.setattr(cell_check, "wiring_faults", lambda measurements: [])
    check = CellCheck(small_plan(), settings_of("measurement_collector"), Hands().ports)
    products = np.array([[1.0, slope], [slope, slope**2 / 0.95]])
    motion = RepeatMotion(dof * 4e-18 * products, dof)
    view = SimpleNamespace(motion=None, motion_theta=motion)
    check._judge_wiring(SimpleNamespace(views=[view]), stops=5)
    assert ("theta" in check.items[-1].figure) == told


def test_a_check_that_an_error_ends_aborts_the_view():
    hands = Hands()
    check = CellCheck(small_plan(), settings_of("measurement_collector"), hands.ports)

    def script():
        check._send(Phase.MEASURE, check.view)
        raise RuntimeError("lost")
        yield

    check._script = script()
    with pytest.raises(RuntimeError):
        check.tick()
    phases = [command["phase"] for command in hands.of("command")]
    assert phases == [MEASURE, ABORT] and check.done
    check.end()
    assert len(hands.of("command")) == 2


def test_a_few_exposures_while_the_stage_moves_are_no_wrong_unit():
    """Without ids and in mm, all would be readings of one mark, at rest."""
    first = next(
        item for item in checked("is pushed at times", ids=False) if not item.passed
    )
    assert first.name == "rest" and "exposures while the stage moved" in first.figure


def test_what_a_node_of_the_cell_knows_of_its_fault_is_told():
    hands = Hands()
    bench = Cell("stands still", hands)
    check = bench.check = CellCheck(
        small_plan(),
        settings_of("measurement_collector"),
        hands.ports,
        settle_s=0.2,
        patience_s=5.0,
    )
    check.take_health("mark_detector", Level.ERROR, "no image")
    check.take_health("mark_detector", Level.OK, "")
    check.take_health(
        "cell_driver", Level.ERROR, "first move: x is reversed; correct turn"
    )
    while not check.done:
        check.tick()
        bench.tick()
        hands.pass_time(TICK_S)
    assert check.items[-1] == CheckItem(
        "commands",
        False,
        "0 detections in 5 s after MEASURE: cell_driver: first move: x is reversed",
        "correct turn",
    )


HOT = ("motor x", Level.ERROR, "too hot")


@pytest.mark.parametrize(
    "statuses, told",
    [
        ([HOT], "ERROR on /diagnostics: motor x: too hot"),
        ([HOT, ("motor x", Level.OK, "cooled")], ""),
        ([("fan", Level.WARN, "slow")], ""),
        (
            [(f"axis {number}", Level.ERROR, "off") for number in range(7)],
            "axis 4: off; and 2 more",
        ),
    ],
)
def test_other_nodes_in_error_fail_the_check_of_a_right_cell(statuses, told):
    failed = [item for item in checked(statuses=statuses) if not item.passed]
    assert [item.name for item in failed] == ["diagnostics"] * bool(told)
    assert not told or failed[0].figure.endswith(told)


def kept_of(number: int) -> int:
    """Return the memory, bytes, that as many statuses in error, each of a new name, take."""
    check = CellCheck(small_plan(), settings_of("measurement_collector"), Hands().ports)
    tracemalloc.start()
    for name in range(number):
        check.take_diagnosis(f"{name} " + "x" * 20_000, Level.ERROR, "y" * 20_000)
    kept, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return kept


def test_names_of_statuses_without_end_take_no_memory():
    assert kept_of(8 * MOST_KEPT) < 1.1 * kept_of(MOST_KEPT) < 1_000_000


def test_joints_without_end_do_not_hide_those_of_the_stage():
    made_up = [f"{number} " + "z" * 20_000 for number in range(2 * MOST_KEPT)]
    joints = next(item for item in checked(joints=made_up) if item.name == "joints")
    assert joints.passed and len(joints.figure) < 10_000


def test_what_was_not_read_is_said_and_fails():
    statuses = [
        (f"axis {number:03}", Level.ERROR, "off") for number in range(MOST_KEPT + 1)
    ]
    statuses += [(name, Level.OK, "on") for name, _, _ in statuses[1:]]
    (item,) = (item for item in checked(statuses=statuses) if not item.passed)
    assert item.figure == (
        "ERROR on /diagnostics: axis 000: off; there were more than 100 names, "
        "and others were not read"
    )


def test_a_status_that_is_known_is_read_however_many_there_are():
    statuses = [
        (f"axis {number:03}", Level.ERROR, "off") for number in range(MOST_KEPT + 1)
    ]
    (item,) = (
        item
        for item in checked(statuses=[*statuses, ("axis 000", Level.ERROR, "hot")])
        if not item.passed
    )
    assert item.figure.startswith(
        "ERROR on /diagnostics: axis 000: hot; axis 001: off; "
    )
    assert item.figure.endswith(
        "; and 95 more; there were more than 100 names, and others were not read"
    )


def test_two_publishers_are_the_only_fault():
    hands = Hands()
    check = CellCheck(small_plan(), settings_of("measurement_collector"), hands.ports)
    cell = Cell("", hands)
    cell.check, check.publishers = (
        check,
        {"stage/mark_detections": ["camera", "old_camera"]},
    )
    while not check.done:
        check.tick()
        cell.tick()
        hands.pass_time(TICK_S)
    [item] = check.items
    assert (item.name, item.passed) == ("publishers", False)
    assert item.figure == "2 publishers of stage/mark_detections: camera, old_camera"


def test_what_a_cell_that_goes_on_after_abort_still_shows_follows_from_that():
    items = [CheckItem(name, False, name) for name in ("commands", "rest")]
    assert [item.follows for item in grouped(items, "", ["abort"])] == ["abort", ""]


def test_a_second_publisher_that_comes_later_is_the_first_fault():
    """DDS may find it only seconds after the first."""
    first, *others = [item for item in checked("second camera") if not item.passed]
    assert (first.name, first.follows) == ("publishers", "")
    assert first.figure == "2 publishers of stage/mark_detections: camera, old_camera"
    assert others and {item.follows for item in others} == {"publishers"}


def test_faults_that_have_nothing_to_do_with_each_other_stand_side_by_side():
    items = [
        CheckItem(name, passed, name)
        for name, passed in (
            ("rest", True),
            ("ids", False),
            ("marks", False),
            ("signs", False),
            ("theta", False),
        )
    ]
    assert [(item.name, item.follows) for item in grouped(items, "signs")] == [
        ("rest", ""),
        ("signs", ""),
        ("ids", "signs"),
        ("marks", "signs"),
        ("theta", ""),
    ]
    assert [(item.name, item.follows) for item in grouped(items, "")] == [
        ("rest", ""),
        ("ids", ""),
        ("marks", "ids"),
        ("signs", "ids"),
        ("theta", ""),
    ]


def test_a_clock_that_is_set_back_leaves_the_commands_in_their_order():
    """A cell takes a command for old that is stamped before the last one."""
    hands = Hands()
    check = CellCheck(
        small_plan(),
        settings_of("measurement_collector"),
        replace(hands.ports, now_ns=lambda: hands.now_ns - set_back_ns),
        settle_s=0.2,
        patience_s=1.0,
    )
    cell = Cell("", hands)
    cell.check, set_back_ns, stamps_ns = check, 0, []
    begun_ns = hands.now_ns
    while not check.done:
        hands.published.clear()
        check.tick()
        for command in hands.of("command"):
            stamp = command["header"]["stamp"]
            stamps_ns.append(stamp["sec"] * 10**9 + stamp["nanosec"])
            set_back_ns = 60 * 10**9
        cell.tick()
        hands.pass_time(TICK_S)
    assert begun_ns <= stamps_ns[0] < begun_ns + 60 * 10**9
    assert stamps_ns == list(range(stamps_ns[0], stamps_ns[-1] + 1))
    assert len(stamps_ns) > 2
    told = [item.figure for item in check.items if item.name == "clock"]
    assert len(told) == 1
    assert told[0].startswith("the clock of this machine was set back by 59.8 s or")
