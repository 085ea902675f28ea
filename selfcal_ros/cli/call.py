# SPDX-License-Identifier: Apache-2.0
"""``selfcal call``: one request to the sequencer of a cell, and its answer."""

import argparse

from selfcal_ros.cli.processes import eyes
from selfcal_ros.cli.terminal import add_json, add_namespace, say
from selfcal_ros.errors import ExitCode
from selfcal_ros.portable import ended_by_signals
from selfcal_ros.topics import REQUESTS


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument(
        "request",
        choices=tuple(REQUESTS),
        help="start: begin the plan; confirm: the "
        "plate is in place; redo: measure the view again; skip: continue without it; "
        "abort: end the plan",
    )
    add_namespace(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Send the request, print the answer; exit code 2 if it was refused."""
    with ended_by_signals(), eyes(args.namespace) as monitor:
        monitor.ask(args.request)
        for message in monitor.messages():
            if "answer" in message:
                say(
                    args,
                    message["answer"],
                    {
                        "request": args.request,
                        "answer": message["answer"],
                        "success": bool(message["success"]),
                    },
                )
                return ExitCode.DONE if message["success"] else ExitCode.BAD_INPUT
    return ExitCode.INTERNAL
