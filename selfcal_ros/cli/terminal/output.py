# SPDX-License-Identifier: Apache-2.0
"""Output of a verb on stdout: text, or one JSON object (docs/json.md)."""

import argparse
import json
import sys
from typing import Any, TextIO

STDOUT = "-"
"""Name of an output file: the result goes to stdout, everything else to stderr."""


def add_json(parser: argparse.ArgumentParser, what: str = "one JSON object") -> None:
    """Add the option ``--json``."""
    parser.add_argument("--json", action="store_true", help=f"print {what} (docs/json.md)")


def say(args: argparse.Namespace, text: str, data: dict[str, Any]) -> None:
    """Print `data` as JSON if requested, else `text`."""
    if args.json:
        put(data)
    else:
        tell(text)


def tell(text: str) -> None:
    """Print text; if stdout cannot encode µ, ° and the like, they are spelled out."""
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
    """Return the stream for other text: stderr if the result is on stdout."""
    return sys.stderr if on_stdout(args) else sys.stdout
