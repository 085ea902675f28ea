# SPDX-License-Identifier: Apache-2.0
"""The machine ``gcode``: GRBL, Marlin, Klipper and LinuxCNC, over a serial port or TCP.

Positions are the machine's own coordinates: GRBL's MPos, the steps that Marlin counts, Klipper's
GET_POSITION, LinuxCNC's absolute actual position. Moves are G1 in mm with the feed rate of
CELL.yaml, with G53 where the dialect has it. Modes of units, distances and feeds are set anew
before each move: a pendant, another program, or a start-up line of GRBL after a reset may have
changed them.
"""

import math
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass

from selfcal_ros.machine.calling import stopping_on_error
from selfcal_ros.machine.interface import Image, MachineError, Offset
from selfcal_ros.machine.lines import Lines
from selfcal_ros.units import M_PER_INCH, M_PER_MM, MM_PER_M

DIALECTS = ("grbl", "marlin", "klipper", "linuxcnc")
LETTERS = {"x": "X", "y": "Y", "theta": "A"}
FEED_HOLD, RESET, STATUS = b"!", b"\x18", b"?"
ALLOWANCE = 2.0
"""Longest time of a move over that at the feed rate."""
PATIENCE_S = 5.0
"""The same for its acceleration, and for answers."""
POLL_S = 0.02
GREETING_S = 2.0
"""Longest silence in the greeting of a board that was reset by opening its port, and
between the answers to what was given up: Marlin says every 2 s that it is busy."""
HOLD_S = 0.3
"""Shortest time from a feed hold to the reset: a reset during the motion loses the position."""
MOTION_STATES = ("run", "jog", "hold", "home", "check", "door")


@dataclass(frozen=True)
class _Travel:
    """A move: axes in the order of the machine, mm and degrees."""

    words: str
    longest_s: float


class GcodeMachine:
    """A controller that takes G-code lines, and a camera.

    Parameters
    ----------
    port : str
        Serial port, or ``socket://host:port``.
    dialect : str
        ``grbl``, ``marlin``, ``klipper`` or ``linuxcnc`` (linuxcncrsh).
    feed : float
        Speed of moves, mm/min.
    baud : int, optional
        Rate of a serial port.
    axes : list of str, optional
        ``[x, y]`` or ``[x, y, theta]``; theta is the axis A, in degrees.
    camera : int or str, optional
        Number or address for OpenCV's VideoCapture; None = no images.
    width, height : int, optional
        Size of the image to ask for.
    password, enable_password : str, optional
        Of linuxcncrsh.

    Raises
    ------
    MachineError
        If the controller does not answer, or is in alarm.
    """

    def __init__(
        self,
        port: str,
        dialect: str,
        feed: float,
        baud: int = 115200,
        axes: Sequence[str] = ("x", "y"),
        camera: int | str | None = None,
        width: int = 0,
        height: int = 0,
        password: str = "EMC",
        enable_password: str = "EMCTOO",
    ) -> None:
        if dialect not in DIALECTS:
            raise MachineError(
                f"the dialect '{dialect}' is unknown",
                "gcode: dialect",
                f"choose one of {', '.join(DIALECTS)}",
            )
        if not (math.isfinite(feed) and feed > 0):
            raise MachineError(
                f"a feed of {feed} mm/min", "gcode: feed", "give mm/min above 0"
            )
        self.axes = tuple(axes)
        self._feed = float(feed)
        self._camera = None
        self._lines = Lines(port, baud, PATIENCE_S)
        try:
            self._talk = _TALKS[dialect](
                self._lines, self.axes, (password, enable_password), self._feed
            )
            if camera is not None:
                from selfcal_ros.machine.video import VideoCamera  # extra camera

                self._camera = VideoCamera(camera, width, height)
        except BaseException:
            self._lines.close()
            raise

    def position(self) -> tuple[float, ...]:
        """Return the indicated position, m and rad."""
        native = self._talk.position()
        return tuple(
            _to_si(axis, value) for axis, value in zip(self.axes, native, strict=True)
        )

    def move_to(self, position: tuple[float, ...]) -> None:
        """Move, and wait for the end of the motion."""
        start = self._talk.position()
        native = [
            _from_si(axis, value)
            for axis, value in zip(self.axes, position, strict=True)
        ]
        way = math.hypot(*(to - at for to, at in zip(native, start, strict=True)))
        words = " ".join(
            f"{LETTERS[axis]}{value:.6f}"
            for axis, value in zip(self.axes, native, strict=True)
        )
        longest_s = ALLOWANCE * way / self._feed * 60 + PATIENCE_S
        with stopping_on_error(self.stop):
            self._talk.move(_Travel(f"{words} F{self._feed:g}", longest_s))

    def image(self) -> Image | None:
        """Expose; None without a camera."""
        return self._camera.image() if self._camera else None

    def offsets(self) -> list[Offset]:
        """Return nothing: without a camera nothing is seen."""
        return []

    def stop(self) -> None:
        """Stop at once.

        Raises
        ------
        MachineError
            If the connection does not carry it.
        """
        self._talk.stop()

    def close(self) -> None:
        """Release port and camera."""
        if self._camera:
            self._camera.close()
        self._talk.close()
        self._lines.close()


def _to_si(axis: str, value: float) -> float:
    return math.radians(value) if axis == "theta" else value * M_PER_MM


def _from_si(axis: str, value: float) -> float:
    return math.degrees(value) if axis == "theta" else value * MM_PER_M


class _Talk:
    """How a dialect moves, stops and tells its position."""

    GREETING = ""
    """How the first line after a reset begins."""
    MODES: tuple[str, ...] = ("G21 G90 G94",)
    """Lines that set mm, absolute coordinates and mm/min."""

    def __init__(
        self,
        lines: Lines,
        axes: tuple[str, ...],
        passwords: tuple[str, str],
        feed: float,
    ) -> None:
        self._lines, self._axes, self._passwords = lines, axes, passwords
        self._feed = feed
        self._stale = False  # answers of what was given up may still come
        self._may_greet = True  # it is being reset, or may have been before
        self._begin()
        self._may_greet = False

    def _begin(self) -> None:
        """Bring the controller to mm and absolute coordinates."""

    def close(self) -> None:
        """Release what is not the connection of the machine."""

    def _until_quiet(self) -> None:
        """Read away what comes by itself: a greeting, answers of what was given up."""
        deadline = time.monotonic() + 3 * PATIENCE_S  # M155 reports for good
        try:
            while time.monotonic() < deadline:
                self._lines.receive(GREETING_S)
        except MachineError as error:
            if "no answer" not in error.what:
                raise

    def _receive(self, timeout_s: float | None = None) -> str:
        """Return the next line.

        Raises
        ------
        MachineError
            If it shows that the controller was reset, or is not text.
        """
        answer = self._lines.receive(timeout_s)
        if self._may_greet:
            self._may_greet = not (self.GREETING and answer.startswith(self.GREETING))
        elif self.GREETING and answer.startswith(self.GREETING):
            raise MachineError(
                f"the controller was reset: it says '{answer}'",
                "controller",
                "home it: its position may be lost",
            )
        elif "\N{REPLACEMENT CHARACTER}" in answer:
            raise MachineError(
                f"'{answer:.40}' is not an answer",
                "controller",
                "check baud, cable and its shield",
            )
        return answer

    def _ok(self, line: str, timeout_s: float = PATIENCE_S) -> list[str]:
        """Send a line, return what comes before its ``ok``."""
        if self._stale:
            self._stale = False
            self._until_quiet()
        self._lines.send(line)
        before: list[str] = []
        deadline = time.monotonic() + timeout_s
        while True:
            answer = self._receive(max(deadline - time.monotonic(), 0.01))
            if answer.lower() == "ok" or answer.lower().startswith("ok "):
                return before
            self._refuse(answer, line)
            before.append(answer)
            if answer.startswith(("echo:busy", "//")):  # it is alive
                deadline = time.monotonic() + timeout_s

    def _set_modes(self) -> None:
        for line in self.MODES:
            self._ok(line)

    def _refuse(self, answer: str, line: str) -> None:
        """Raise if an answer is an error."""
        low = answer.lower()
        if (
            low.startswith(("error", "alarm", "!!"))
            or "kill()" in low
            or "halted" in low
        ):
            raise MachineError(
                f"'{line}' was answered by '{answer}'",
                "controller",
                "check limit switches, soft limits and homing; reset it",
            )


class _Grbl(_Talk):
    """GRBL 1.1: real-time status reports ``<Idle|MPos:1.000,2.000,0.000|...>``."""

    GREETING = "Grbl "

    def _begin(self) -> None:
        self._lines.send("")
        self._until_quiet()
        state, _ = self._status()  # raises if it does not answer, or is in alarm
        if state != "idle":
            raise MachineError(
                f"the controller is in state '{state}'",
                "controller",
                "let its program end, or leave the mode, first",
            )
        settings = self._ok("$$")
        if any(setting.startswith("$13=1") for setting in settings):
            raise MachineError(
                "it reports positions in inches ($13=1)", "controller", "set $13=0"
            )
        # the answers to ? belong to the thread that waits for the end of the move
        slowing = self._feed / 60 / _least_acceleration(settings, self._axes)
        self._hold_s = HOLD_S + min(slowing, PATIENCE_S)

    def _status(self) -> tuple[str, list[float]]:
        """Return the state, and the machine's position, mm."""
        self._lines.send_raw(STATUS)
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            answer = self._receive()
            if answer.startswith("<"):
                return self._parsed(answer)
            self._refuse(answer, "?")
        raise MachineError("no status report", "controller", "check the dialect")

    def _parsed(self, answer: str) -> tuple[str, list[float]]:
        state, *fields = answer.strip("<>").split("|")
        report = dict(field.partition(":")[::2] for field in fields)
        state = state.partition(":")[0].lower()
        if state in ("alarm", "door", "sleep"):
            raise MachineError(
                f"the controller is in state '{state}'",
                "controller",
                "find out why, then home or unlock it ($H, $X)",
            )
        if "WCO" in report:
            self._offset = _numbers(report["WCO"])
        if "MPos" in report:
            return state, self._chosen(_numbers(report["MPos"]))
        if "WPos" in report and hasattr(self, "_offset"):
            at = [
                value + off
                for value, off in zip(
                    _numbers(report["WPos"]), self._offset, strict=True
                )
            ]
            return state, self._chosen(at)
        raise MachineError(
            f"its report '{answer}' has no machine position", "controller", "set $10=1"
        )

    def _chosen(self, values: list[float]) -> list[float]:
        if len(values) < len(self._axes):
            raise MachineError(
                f"it reports {len(values)} axes", "controller", "correct axes"
            )
        return [
            values[index] for index in ([0, 1, 3] if len(values) > 3 else [0, 1, 2])
        ][: len(self._axes)]

    def position(self) -> list[float]:
        return self._status()[1]

    def move(self, travel: _Travel) -> None:
        self._set_modes()
        self._ok(f"G53 G1 {travel.words}", travel.longest_s)
        deadline = time.monotonic() + travel.longest_s
        while self._status()[0] in MOTION_STATES:
            if time.monotonic() > deadline:
                raise MachineError(
                    f"the move has not ended in {travel.longest_s:.3g} s",
                    "controller",
                    "check feed and drives",
                )
            time.sleep(POLL_S)

    def stop(self) -> None:
        self._lines.send_raw(FEED_HOLD)
        time.sleep(self._hold_s)
        self._may_greet = True
        self._lines.send_raw(RESET)


class _Marlin(_Talk):
    """Marlin: ``M400`` waits for the end of motion; ``M114 R`` tells the steps that were made.

    Its X: has two decimals, 10 um: the steps over the steps per mm (``M92``) are finer.
    """

    QUERY, HALT, STEPS = "M114 R", b"M410\n", "M92"
    GREETING = "start"
    MODES = ("G21", "G90")
    SAME_ZERO_MM = 0.02
    """Difference of a position in its own frame, which has two decimals, from the machine's."""

    def _begin(self) -> None:
        self._lines.forget()
        self._ok("G21", 3 * PATIENCE_S)  # a board that was reset by opening the port
        self._per_mm: dict[str, float] = {}
        for answer in self._ok(self.STEPS) if self.STEPS else ():
            self._per_mm |= {
                letter: float(value)
                for letter, value in re.findall(r"\b([XYZABC])(\d+\.?\d*)", answer)
            }

    def position(self) -> list[float]:
        for answer in self._answers():
            logical, _, counted = answer.partition("Count")
            position_of_letter = _by_letter(logical)
            by_steps = {
                letter: steps / self._per_mm[letter]
                for letter, steps in _by_letter(counted).items()
                if self._per_mm.get(letter)
            }
            self._refuse_offset(position_of_letter, by_steps | _of_duet(counted))
            position_of_letter |= by_steps
            if {LETTERS[axis] for axis in self._axes} <= position_of_letter.keys():
                return [position_of_letter[LETTERS[axis]] for axis in self._axes]
        raise self._tells_not_all()

    def _answers(self) -> list[str]:
        """Return what it tells of its position."""
        answers = self._ok(self.QUERY)
        if not any(NUMBER.search(answer) for answer in answers):
            raise MachineError(
                f"'{self.QUERY}' was answered by 'ok' alone: that of a former command, one "
                "'ok' too many has come",
                "controller",
                "let nothing else write to its port, check cable and its shield, reset it",
            )
        return answers

    def _tells_not_all(self) -> MachineError:
        return MachineError(
            f"{self.QUERY} tells no position of all axes", "controller", "correct axes"
        )

    def _refuse_offset(
        self, told: dict[str, float], machines: dict[str, float]
    ) -> None:
        """Raise if moves count from another zero than the machine."""
        for letter, value in machines.items():
            if abs(told.get(letter, value) - value) > self.SAME_ZERO_MM:
                raise MachineError(
                    f"it says {letter}{told[letter]:g}, the machine stands at {value:.6g} mm: an "
                    "offset is active",
                    "controller",
                    "home it; reset what shifts its zero: G92, M206, work and tool offsets",
                )

    def move(self, travel: _Travel) -> None:
        self._set_modes()
        self._ok(f"G1 {travel.words}", travel.longest_s)
        self._ok("M400", travel.longest_s)

    def stop(self) -> None:
        self._stale = True  # its ok, and that of a move it ends, come when they come
        self._lines.send_raw(self.HALT)


class _Klipper(_Marlin):
    """Klipper's serial port (/tmp/printer): ``M112`` is its only stop.

    ``M114`` counts from the zero of G92 and SET_GCODE_OFFSET, ``GET_POSITION`` tells both.
    """

    QUERY, HALT, STEPS = "GET_POSITION", b"M112\n", ""
    GREETING = ""
    SAME_ZERO_MM = 1e-5  # of six decimals

    def position(self) -> list[float]:
        positions = {
            name: _by_letter(values)
            for name, _, values in (
                answer.partition(": ") for answer in self._answers()
            )
        }
        machines, zero = positions.get("// gcode"), positions.get("// gcode base")
        letters = [LETTERS[axis] for axis in self._axes]
        if not machines or not zero or not {*letters} <= machines.keys() & zero.keys():
            raise self._tells_not_all()
        at = {letter: machines[letter] for letter in letters}
        self._refuse_offset({letter: at[letter] - zero[letter] for letter in at}, at)
        return [*at.values()]


class _LinuxCnc(_Talk):
    """linuxcncrsh: ``get abs_act_pos`` tells the actual machine position, ``set mdi`` moves.

    It reads the next line of a connection when the move of the last one has ended: a stop needs
    a connection of its own. One connection at a time is enabled, the one that asked last.
    """

    ORDER = "XYZABCUVW"

    def _begin(self) -> None:
        self._greet(self._lines)
        unit = self._get("user_linear_units")
        if unit not in UNIT_MM:
            raise MachineError(
                f"its unit is '{unit}'", "controller", "set LINEAR_UNITS to mm or inch"
            )
        self._unit_mm = UNIT_MM[unit]
        self._take_over()
        self._for_stop = self._lines.again()
        try:
            self._greet(self._for_stop)
        except BaseException:
            self.close()
            raise

    def _greet(self, lines: Lines) -> None:
        password, _ = self._passwords
        lines.send(f"hello {password} selfcal 1.0")
        answer = lines.receive()
        if answer.startswith("hello"):  # its echo
            answer = lines.receive()
        if not answer.upper().startswith("HELLO ACK"):
            raise MachineError(
                f"linuxcncrsh answered '{answer}'", "controller", "check password"
            )
        lines.send("set echo off")
        self._set("verbose on", lines)

    def _take_over(self) -> None:
        """Be the connection that is enabled."""
        self._is_enabled = True
        for words in (f"enable {self._passwords[1]}", "mode mdi", "set_wait done"):
            self._set(words, self._lines)

    def _set(self, words: str, lines: Lines, timeout_s: float = PATIENCE_S) -> None:
        """Send a set command; raise MachineError unless it is acknowledged."""
        answer = self._answer(words, lines, timeout_s)
        if not answer.endswith("ACK"):
            raise MachineError(
                f"'set {words}' was answered by '{answer}'",
                "controller",
                "release the emergency stop, switch the machine on, home it",
            )

    def _answer(self, words: str, lines: Lines, timeout_s: float = PATIENCE_S) -> str:
        """Send a set command, return its answer; its echo is passed over."""
        lines.send(f"set {words}")
        deadline = time.monotonic() + timeout_s
        while True:
            answer = lines.receive(max(deadline - time.monotonic(), 0.01)).upper()
            if answer.endswith(("ACK", "NAK")) or answer.startswith("ERROR"):
                return answer

    def _get(self, name: str) -> str:
        """Return what a get command tells; other answers are passed over."""
        self._lines.send(f"get {name}")
        answer = ""
        while not answer.startswith(name.upper()):
            answer = self._lines.receive().upper()
        return answer.removeprefix(name.upper()).strip()

    def position(self) -> list[float]:
        text = self._get("abs_act_pos")
        values = [float(word) for word in text.split()]
        places = [self.ORDER.index(LETTERS[axis]) for axis in self._axes]
        if max(places) >= len(values):
            raise MachineError(
                f"its position is '{text}'", "controller", "correct axes"
            )
        return [
            values[place] * (1.0 if axis == "theta" else self._unit_mm)
            for axis, place in zip(self._axes, places, strict=True)
        ]

    def move(self, travel: _Travel) -> None:
        if not self._is_enabled:
            self._take_over()
        for line in self.MODES:
            self._set(f"mdi {line}", self._lines)
        self._set(f"mdi G53 G1 {travel.words}", self._lines, travel.longest_s)

    def stop(self) -> None:
        self._is_enabled = False
        self._set(f"enable {self._passwords[1]}", self._for_stop)
        self._answer("abort", self._for_stop)  # NAK: it is switched off, and stands

    def close(self) -> None:
        self._for_stop.close()


UNIT_MM = {"MM": 1.0, "CM": 10.0, "INCH": MM_PER_M * M_PER_INCH}
"""LINEAR_UNITS of LinuxCNC's INI file, in which it tells positions, whatever those of moves are."""
ACCELERATION = {"x": "$120=", "y": "$121=", "theta": "$123="}
"""GRBL's setting of an axis, mm/s^2 or deg/s^2."""


def _least_acceleration(settings: list[str], axes: tuple[str, ...]) -> float:
    """Return the least acceleration of some axes; infinite if none is told."""
    names = tuple(ACCELERATION[axis] for axis in axes)
    told = [
        float(number[0])
        for number in (
            re.findall(r"=(\d+\.?\d*)", setting)
            for setting in settings
            if setting.startswith(names)
        )
        if number
    ]
    return min(filter(None, told), default=math.inf)


NUMBER = re.compile(r"\b([XYZABC]):\s*(-?\d+\.?\d*)")


def _by_letter(text: str) -> dict[str, float]:
    return {letter: float(value) for letter, value in NUMBER.findall(text)}


def _of_duet(text: str) -> dict[str, float]:
    """Return the machine's position that RepRapFirmware tells behind its own, mm."""
    _, _, machines = text.partition("Machine")
    return dict(
        zip("XY", map(float, re.findall(r"-?\d+\.\d+", machines)), strict=False)
    )


def _numbers(text: str) -> list[float]:
    try:
        return [float(number) for number in text.split(",")]
    except ValueError:
        raise MachineError(
            f"'{text}' is not a position",
            "controller",
            "check baud, cable and its shield",
        ) from None


_TALKS: dict[str, type] = {
    "grbl": _Grbl,
    "marlin": _Marlin,
    "klipper": _Klipper,
    "linuxcnc": _LinuxCnc,
}
