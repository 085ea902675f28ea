# SPDX-License-Identifier: Apache-2.0
"""Entry points of all commands. An interrupt during imports waits until they are done.

Otherwise Python would end in the middle of an import with a traceback. Blocked, Ctrl-C is kept by
the system until `cli.main.main` or `nodes.running.run` unblock it. So this module imports as little
as it can.
"""

import importlib
import os
import signal
import sys
from functools import partial

BUILD = "colcon build --base-paths src/selfcal_ros src/selfcal_ros/msg_defs"
"""Command that builds the messages as well: colcon does not search inside a package."""


NEEDED = {
    "rclpy": "source a ROS 2 installation, or use the environment of `make setup`",
    "selfcal_msgs": f"run `make setup`, or in the workspace `{BUILD}` and "
    "source install/setup.bash",
    "threadpoolctl": "`sudo apt install python3-threadpoolctl`, or with pip",
}
"""Modules of a node that neither pip nor rosdep installs by default, and how to install them."""


def missing_ros() -> str:
    """Return what a node needs and this environment lacks, and the remedy; "" if nothing.

    A module, or a field of a message that was built before the field was added.
    """
    from importlib.util import find_spec  # not before interrupts are held

    from selfcal_ros.topics import message_texts  # likewise

    for name, remedy in NEEDED.items():
        if find_spec(name) is None:
            return f"there is no {name} in this environment; {remedy}"
    built = importlib.import_module("selfcal_msgs.msg")
    for name, text in message_texts().items():
        kind = getattr(built, name, None)
        field_names = kind.get_fields_and_field_types() if kind else {}
        for field in fields_of(text):
            if field not in field_names:
                return (
                    f"the selfcal_msgs in this environment is of another version: its {name} "
                    f"has no {field}; build it again: {NEEDED['selfcal_msgs']}"
                )
    return ""


def fields_of(text: str) -> list[str]:
    """Return the names of the fields of a .msg file, without its constants."""
    lines = [
        line.partition("#")[0].split() for line in text.splitlines() if line.strip()
    ]
    return [words[1] for words in lines if len(words) > 1 and "=" not in "".join(words)]


def hold_interrupts(*, held: bool) -> None:
    """Block Ctrl-C in this thread, or let it through, at once if it came meanwhile.

    Not on Windows.
    """
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(
            signal.SIG_BLOCK if held else signal.SIG_UNBLOCK, {signal.SIGINT}
        )


def begin_node() -> None:
    """Block interrupts while a node is imported; end the process if the import fails."""
    hold_interrupts(held=True)
    missing = missing_ros()
    if missing:
        print(f"selfcal: environment: {missing}", file=sys.stderr)
        sys.exit(2)


def open_streams() -> None:
    """Give a standard stream that was closed at the start (``>&-``) a place to write to.

    Else Python has None for it, and the next file that is opened takes its number.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # the lowest free number is this one
            setattr(sys, name, open(number, "w" if number else "r", closefd=False))  # noqa: SIM115


def selfcal() -> int:
    """Run the command ``selfcal``."""
    hold_interrupts(held=True)
    open_streams()
    return importlib.import_module("selfcal_ros.cli.main").main()


def _run(node: str) -> int | None:
    begin_node()
    return importlib.import_module(f"selfcal_ros.nodes.{node}").main()


(
    measurement_collector,
    pose_sequencer,
    solver,
    compensator,
    mark_detector,
    bag_player,
    bag_recorder,
    cell_driver,
    stage_simulator,
) = (
    partial(_run, node)
    for node in (
        "measurement_collector",
        "pose_sequencer",
        "solver",
        "compensator",
        "mark_detector",
        "bag_player",
        "bag_recorder",
        "cell_driver",
        "stage_simulator",
    )
)
