# SPDX-License-Identifier: Apache-2.0
"""Controllers written from the documents of their protocols, over TCP and over a pty.

They keep the resolution of the real ones: 1 um in GRBL's report, 1/80 mm in Marlin's steps.
"""

import contextlib
import os
import pty
import re
import socket
import threading
import time
import tty

WORD = re.compile(r"([XYAF])(-?\d+\.?\d*)")


class Firmware:
    """Answers lines and real-time bytes; moves end after two status reports."""

    greeting, realtime = b"", b""

    def __init__(self) -> None:
        self.at = {"X": 0.0, "Y": 0.0, "A": 0.0}
        self.lines, self.stopped, self.dead, self.alarm = [], 0, False, ""
        self.zero = 0.0  # of the x of moves, mm: G92, M206
        self.unit_mm, self.relative = 1.0, False  # G20, G91
        self._moving = 0

    def session(self):
        """Return what answers a connection."""
        return self

    def answer(self, line: str) -> bytes:
        raise AssertionError(line)

    def byte(self, byte: bytes) -> bytes:
        raise AssertionError(byte)

    def set_modes(self, line: str) -> None:
        """Take the modes of a line; they last."""
        codes = line.split()
        if {"G20", "G21"} & {*codes}:
            self.unit_mm = 25.4 if "G20" in codes else 1.0
        if {"G90", "G91"} & {*codes}:
            self.relative = "G91" in codes

    def move(self, line: str) -> None:
        relative = self.relative and "G53" not in line
        self.at |= {
            letter: float(value) * self.unit_mm + relative * self.at[letter]
            for letter, value in WORD.findall(line)
            if letter != "F"
        }
        self._moving = 2

    def feed(self, data: bytes, rest: bytearray) -> bytes:
        """Take bytes, return what is sent back."""
        out = b""
        for value in data:
            byte = bytes([value])
            if byte in self.realtime and byte:
                out += self.byte(byte)
            elif byte in b"\r\n":
                line, rest[:] = rest.decode(), b""
                self.lines.append(line)
                self.set_modes(line)
                out += self.answer(line)
            else:
                rest += byte
        return out


class Grbl(Firmware):
    greeting, realtime = b"\r\nGrbl 1.1h ['$' for help]\r\n", b"?!\x18"
    settings, resting = b"$10=1\r\n$13=0\r\n$32=0\r\n", "Idle"

    def answer(self, line):
        if self.alarm:
            return b"error:9\r\n"
        if line == "$$":
            return self.settings + b"ok\r\n"
        if " G1 " in f" {line} ":
            if "G53" not in line or "F" not in line:
                return b"error:22\r\n"
            self.move(line)
        return b"ok\r\n"

    def byte(self, byte):
        if byte != b"?":
            self.stopped += 1
            return self.greeting if byte == b"\x18" else b""
        self._moving = max(self._moving - 1, 0)
        state = "Alarm" if self.alarm else "Run" if self._moving else self.resting
        return (
            f"<{state}|MPos:{self.at['X']:.3f},{self.at['Y']:.3f},0.000|FS:0,0>\r\n"
        ).encode()


class SlowGrbl(Grbl):
    """Slows down at 100 mm/s^2 from 6000 mm/min; a reset before it stands loses the position."""

    settings = b"$10=1\r\n$13=0\r\n$120=100.000\r\n$121=500.000\r\n$122=1.000\r\n"
    slowing_s = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.held_at = 0.0

    def byte(self, byte):
        if byte == b"!":
            self.held_at = time.monotonic()
        elif byte == b"\x18" and time.monotonic() < self.held_at + self.slowing_s:
            self.alarm = "ALARM:3"
        return super().byte(byte)


class FaultyGrbl(Grbl):
    """Answers wrongly from a status report on; `reports` counts them."""

    def __init__(self, fault: str, after: int) -> None:
        super().__init__()
        self.fault, self.after, self.reports = fault, after, 0

    def byte(self, byte):
        right = super().byte(byte)
        self.reports += byte == b"?"
        if byte != b"?" or self.reports < self.after:
            return right
        if self.fault == "garbage":
            return right[:8] + bytes([0xF0, 0x9F, 0x07]) + right[12:]
        if self.fault == "digits lost":
            return right.replace(b".000,", b".0x0,")
        if self.fault == "line cut":
            return right[:16] + b"\r\n"
        if self.fault == "reset":
            self.at = dict.fromkeys(self.at, 0.0)
            return self.greeting + right
        if self.fault == "alarm":
            return right.replace(b"Idle", b"Alarm:1").replace(b"Run", b"Alarm:1")
        if self.fault == "never idle":
            return right.replace(b"Idle", b"Run")
        assert self.fault == "silent"
        return b""


class Marlin(Firmware):
    greeting = b"start\nMarlin 2.1.2\n"
    PER_MM = 80.0
    halt_s = 0.0
    """Time to come to rest."""

    def answer(self, line):
        if self.alarm:
            return b"Error:Printer halted. kill() called!\n"
        if line == "M92":
            return b"echo:  M92 X80.00 Y80.00 Z400.00 E93.00\nok\n"
        if line == "M114 R":
            steps = {
                letter: round(value * self.PER_MM) for letter, value in self.at.items()
            }
            return (
                f"X:{steps['X'] / 80 - self.zero:.2f} Y:{steps['Y'] / 80:.2f} Z:0.00 E:0.00 "
                f"Count X:{steps['X']} Y:{steps['Y']} Z:0\nok\n"
            ).encode()
        if line == "M410":
            self.stopped += 1
            time.sleep(self.halt_s)
        elif line.startswith("G1"):
            self.move(line)
        elif line == "M400":
            return b"echo:busy: processing\nok\n"
        return b"ok P15 B3\n"


class Duet(Marlin):
    """RepRapFirmware: M114 tells the position in the frame of the tool, and the machine's."""

    def answer(self, line):
        if line == "M92":
            return b"Steps/mm: X: 80.000, Y: 80.000, Z: 400.000, E: 420.000\nok\n"
        if line == "M114 R":
            x, y = self.at["X"], self.at["Y"]
            return (
                f"X:{x - self.zero:.3f} Y:{y:.3f} Z:0.000 E:0.000 E0:0.0 Count 800 1600 0 "
                f"Machine {x:.3f} {y:.3f} 0.000 Bed comp 0.000\nok\n"
            ).encode()
        return super().answer(line)


class Klipper(Firmware):
    def answer(self, line):
        if self.alarm:
            return b"!! Must home axis first\nok\n"
        if line == "GET_POSITION":
            at = f"X:{self.at['X']:.6f} Y:{self.at['Y']:.6f} Z:0.000000"
            return (
                "// mcu: stepper_x:100 stepper_y:200 stepper_z:0\n"
                "// stepper: stepper_x:7.000000 stepper_y:8.000000 stepper_z:0.000000\n"
                f"// kinematic: X:7.000000 Y:8.000000 Z:0.000000\n// toolhead: {at} E:0.000000\n"
                f"// gcode: {at} E:0.000000\n"
                f"// gcode base: X:{self.zero:.6f} Y:0.000000 Z:0.000000 E:9.000000\n"
                "// gcode homing: X:0.000000 Y:0.000000 Z:0.000000\nok\n"
            ).encode()
        if line == "M112":
            self.stopped += 1
        elif line.startswith("G1"):
            self.move(line)
        return b"// a note\nok\n"


class LinuxCnc(Firmware):
    """linuxcncrsh: sets are answered once verbose is on; every command is echoed until echo off.

    A connection is not read while its move lasts (`move_s`), one of them is enabled.
    """

    move_s = 0.0
    unit, per_mm = "MM", 1.0
    """LINEAR_UNITS of its INI file."""

    def __init__(self) -> None:
        super().__init__()
        self.enabled = None  # the connection
        self.aborted = threading.Event()

    def session(self):
        return _Rsh(self)

    def carry_out(self, line: str) -> None:
        """Move; an abort ends the move half way."""
        before = dict(self.at)
        self.move(line)
        self.aborted.clear()
        if self.aborted.wait(self.move_s):
            self.at = {axis: (before[axis] + to) / 2 for axis, to in self.at.items()}


class _Rsh(Firmware):
    """A connection to LinuxCNC."""

    def __init__(self, machine: LinuxCnc) -> None:
        super().__init__()
        self._machine, self.lines = machine, machine.lines
        self.set_modes = machine.set_modes
        self._echo, self._verbose = True, False

    @property
    def dead(self):
        return self._machine.dead

    @dead.setter
    def dead(self, _):
        pass

    def answer(self, line):
        machine = self._machine
        echo = f"{line}\r\n".encode() if self._echo else b""
        word, *rest = line.split()
        if word == "hello":
            return echo + (
                b"HELLO ACK EMCNETSVR 1.1\r\n" if rest[0] == "EMC" else b"HELLO NAK\r\n"
            )
        if line == "get user_linear_units":
            return echo + f"USER_LINEAR_UNITS {machine.unit}\r\n".encode()
        if line == "get abs_act_pos":
            x, y = (machine.at[letter] * machine.per_mm for letter in "XY")
            return (
                echo
                + (
                    f"ABS_ACT_POS {x:.6f} {y:.6f} 0.000000 "
                    f"{machine.at['A']:.6f} 0.000000 0.000000\r\n"
                ).encode()
            )
        if rest[:2] == ["echo", "off"]:
            self._echo = False
        elif rest[:2] == ["verbose", "on"]:
            self._verbose = True
        elif rest[0] == "enable":
            if rest[1] != "EMCTOO":
                return echo + b"SET ENABLE NAK\r\n"
            machine.enabled = self
        elif machine.alarm or machine.enabled is not self:
            return echo + f"SET {rest[0].upper()} NAK\r\n".encode()
        elif rest[0] == "abort":
            machine.stopped += 1
            machine.aborted.set()
        elif "G1" in rest:
            machine.carry_out(line)
        return echo + (
            f"SET {rest[0].upper()} ACK\r\n".encode() if self._verbose else b""
        )


@contextlib.contextmanager
def over_tcp(firmware):
    """Yield the address of a firmware behind a socket."""
    server = socket.create_server(("127.0.0.1", 0))
    connections, threads = [], []

    def talk(connection) -> None:
        _talk(firmware.session(), lambda: connection.recv(4096), connection.sendall)
        connection.close()

    def serve() -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = server.accept()
                connections.append(connection)
                threads.append(
                    threading.Thread(target=talk, args=[connection], daemon=True)
                )
                threads[-1].start()

    threads.append(threading.Thread(target=serve, daemon=True))
    threads[-1].start()
    try:
        yield f"socket://127.0.0.1:{server.getsockname()[1]}"
    finally:
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_RDWR)  # wakes accept
        server.close()
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()
        for thread in threads:
            thread.join(5)


@contextlib.contextmanager
def over_pty(firmware):
    """Yield the name of a serial port with a firmware behind it."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    thread = threading.Thread(
        target=_talk,
        daemon=True,
        args=(firmware, lambda: os.read(ours, 4096), lambda data: os.write(ours, data)),
    )
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        os.close(theirs)
        thread.join(5)
        os.close(ours)


def _talk(firmware, read, write) -> None:
    rest = bytearray()
    with contextlib.suppress(OSError):
        write(firmware.greeting)
        while data := read():
            if firmware.dead:
                return
            write(firmware.feed(data, rest))
