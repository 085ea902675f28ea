# SPDX-License-Identifier: Apache-2.0
"""A real LinuxCNC in simulation: two joints that follow their commands, driven over linuxcncrsh."""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from test.support.waiting import PATIENCE_S, wait_until

JOINT = """
[AXIS_{letter}]
MIN_LIMIT = -20
MAX_LIMIT = 20
MAX_VELOCITY = 500
MAX_ACCELERATION = 20000
[JOINT_{number}]
TYPE = LINEAR
MIN_LIMIT = -20
MAX_LIMIT = 20
MAX_VELOCITY = 500
MAX_ACCELERATION = 20000
FERROR = 5
MIN_FERROR = 1
HOME_SEQUENCE = 0
COMP_FILE = comp_{axis}.txt
COMP_FILE_TYPE = 0
"""
INI = (
    """
[EMC]
VERSION = 1.1
[DISPLAY]
DISPLAY = {folder}/display
[RS274NGC]
PARAMETER_FILE = parameters
[EMCMOT]
EMCMOT = motmod
SERVO_PERIOD = 1000000
[TASK]
TASK = milltask
CYCLE_TIME = 0.001
[HAL]
HALFILE = joints.hal
[TRAJ]
COORDINATES = X Y
LINEAR_UNITS = mm
ANGULAR_UNITS = degree
MAX_LINEAR_VELOCITY = 500
[EMCIO]
EMCIO = io
CYCLE_TIME = 0.1
[KINS]
KINEMATICS = trivkins coordinates=XY
JOINTS = 2
"""
    + JOINT.format(letter="X", axis="x", number=0)
    + JOINT.format(letter="Y", axis="y", number=1)
)
HAL = """
loadrt [KINS]KINEMATICS
loadrt [EMCMOT]EMCMOT servo_period_nsec=[EMCMOT]SERVO_PERIOD num_joints=[KINS]JOINTS
addf motion-command-handler servo-thread
addf motion-controller servo-thread
net x joint.0.motor-pos-cmd => joint.0.motor-pos-fb
net y joint.1.motor-pos-cmd => joint.1.motor-pos-fb
net estop iocontrol.0.user-enable-out => iocontrol.0.emc-enable-in
"""
DISPLAY = """#!/bin/sh
exec linuxcncrsh --port {port} -- "$@"
"""
MOTORS = """
import hal
reader = hal.component("reader")
print(*(repr(hal.get_value(f"joint.{number}.motor-pos-cmd")) for number in (0, 1)))
"""
SWITCHED_ON = (
    "verbose on",
    "enable EMCTOO",
    "estop off",
    "machine on",
    "mode manual",
    "home 0",
    "home 1",
)


@contextlib.contextmanager
def running(folder: Path) -> Iterator[str]:
    """Run LinuxCNC in a folder, switched on and homed; yield its address for pyserial.

    The folder has its tables, comp_x.txt and comp_y.txt. Only one can run on a machine. Limits of
    X and Y are -20 and 20 mm.
    """
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    (folder / "machine.ini").write_text(INI.format(folder=folder))
    (folder / "joints.hal").write_text(HAL)
    (folder / "display").write_text(DISPLAY.format(port=number))
    (folder / "display").chmod(0o755)
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            [*_as_ordinary_user(folder), "linuxcnc", "-r", "machine.ini"],
            cwd=folder,
            stdout=log,
            stderr=log,
            start_new_session=True,
            env={**os.environ, "HOME": str(folder)},
        )
    try:
        wait_until(
            lambda: process.poll() is not None or _listens(number), "linuxcncrsh"
        )
        assert process.poll() is None, (folder / "log").read_text()
        _switch_on(number)
        yield f"socket://127.0.0.1:{number}"
    finally:
        for stop in (signal.SIGTERM, signal.SIGKILL):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, stop)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)


def motors() -> tuple[float, float]:
    """Return where its motors are commanded to be, mm: where its axes are, and the correction."""
    done = subprocess.run(
        [*_ordinary_user(), "/usr/bin/python3", "-I", "-c", MOTORS],
        check=True,
        capture_output=True,
        text=True,
    )
    x, y = done.stdout.split()
    return float(x), float(y)


def _as_ordinary_user(folder: Path) -> list[str]:
    """Give a folder to that user; return the words of `_ordinary_user`."""
    for path in (folder, *folder.iterdir()) if _ordinary_user() else ():
        shutil.chown(path, "nobody")
    return _ordinary_user()


def _ordinary_user() -> list[str]:
    """Return the words before a command that give up the rights of root, with which it stops."""
    return (
        ["setpriv", "--reuid", "nobody", "--clear-groups"] if os.getuid() == 0 else []
    )


def _listens(number: int) -> bool:
    with socket.socket() as connection:
        return connection.connect_ex(("127.0.0.1", number)) == 0


def _switch_on(number: int) -> None:
    with socket.create_connection(
        ("127.0.0.1", number), timeout=PATIENCE_S
    ) as connection:
        lines = connection.makefile("rw", newline="\n")
        _answer(lines, "hello EMC test 1.0", "HELLO ACK")
        for words in SWITCHED_ON:
            answer = _answer(lines, f"set {words}", f"SET {words.split()[0].upper()} ")
            assert answer.endswith("ACK"), answer
        wait_until(
            lambda: (
                _answer(lines, "get joint_homed", "JOINT_HOMED").split()[1:3]
                == ["YES", "YES"]
            ),
            "homing",
        )


def _answer(lines: TextIO, words: str, beginning: str) -> str:
    """Send a line; return the first answer that begins so, past its echo."""
    lines.write(f"{words}\n")
    lines.flush()
    while not (line := lines.readline()).startswith(beginning):
        assert line, f"'{words}' was not answered"
    return line.strip()
