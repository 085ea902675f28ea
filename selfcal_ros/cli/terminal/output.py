# SPDX-License-Identifier: Apache-2.0
"""What a verb gives on stdout: text for a person, or one JSON object (docs/json.md)."""

import argparse
import json
import sys
from typing import Any, TextIO

STDOUT = "-"
"""As the name of an output file: the result goes to stdout, all else to stderr."""


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the option ``--json``."""
    parser.add_argument("--json", action="store_true", help=f"print {what} (docs/json.md)")


def say(args: argparse.Namespace, text: str, data: dict[str, Any]) -> None:
    """Print `data` as JSON if that is wanted, else `text`."""
    if args.json:
        put(data)
    else:
        tell(text)


def tell(text: str) -> None:
    """Print text for a person; where stdout cannot take µ, ° and the like, spelled out."""
    from selfcal_ros.reporting.summary.format import can_print_symbols, to_ascii

    print(text if can_print_symbols(sys.stdout) else to_ascii(text))


def put(data: Any) -> None:
    """Print strict JSON (no NaN) on stdout."""
    print(json.dumps(data, indent=1, allow_nan=False))


def file_of(args: argparse.Namespace) -> str | None:
    """Return the file that ``--output`` names; None for stdout."""
    return None if args.output == STDOUT else args.output


def on_stdout(args: argparse.Namespace) -> bool:
    """Return whether the result itself goes to stdout."""
    return bool(args.json or args.output == STDOUT)


def aside(args: argparse.Namespace) -> TextIO:
    """Return where text beside the result goes: stderr if the result is on stdout."""
    return sys.stderr if on_stdout(args) else sys.stdout
