# SPDX-License-Identifier: Apache-2.0
"""Deliver an export: to stdout or to files, of which old ones are kept; with its exit code."""

import argparse
import shlex
import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from selfcal_ros.applications.aerotech.write import write_cals
from selfcal_ros.cli.arguments import STDOUT
from selfcal_ros.cli.terminal import exit_code, put, put_text, say
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import check_outputs, utf8, write_bytes


def deliver(
    args: argparse.Namespace,
    result: CalibrationResult,
    content: str | bytes,
    key: str,
    *,
    note: str = "",
    **data: Any,
) -> int:
    """Write an export of a result to its file or to stdout; return the exit code.

    Parameters
    ----------
    args : argparse.Namespace
        Arguments with ``output``.
    result : CalibrationResult
        The result; if it is not qualified, the code is 5 and the reason on stderr.
    content : str or bytes
        Content of the file.
    key : str
        Key of the content in the JSON of ``--json``, if it goes to stdout.
    note : str
        Follows the name of the file that was written.
    **data
        More JSON on the file.
    """
    raw = utf8(content) if isinstance(content, str) else content
    if args.output == STDOUT:
        text = raw.decode()
        if args.json:
            put({key: text})
        else:
            put_text(text.removesuffix("\n"), sys.stdout)
    else:
        write_bytes(args.output, raw)
        say(args, f"written: {args.output}{note}", {"written": args.output, **data})
    return exit_code(result)


def csv_text(head: Sequence[str], rows: Iterable[Iterable[float | None]]) -> str:
    """Return a table; what is not known is empty."""
    lines = [
        ",".join("" if cell is None or cell != cell else repr(cell) for cell in row)
        for row in rows
    ]
    return "\n".join([",".join(head), *lines]) + "\n"


def replace_files(
    args: argparse.Namespace, texts: Mapping[str, str], sources: Iterable[str | None]
) -> dict[str, str | None]:
    """Write files, all or none; keep those that they replace; return path -> the old one.

    Raises
    ------
    InputError
        If one of them is a source, cannot be written, or exists and ``--force`` is not given.
    """
    check_outputs(sources, texts)
    backups = write_cals(texts, force=args.force)
    return {path: str(backup) if backup else None for path, backup in backups.items()}


def replaced(backup: str | None) -> str:
    """Return a note on the old file, empty if there was none."""
    return f"; the old file is {backup}" if backup else ""


def command(args: argparse.Namespace) -> str:
    """Return the command line."""
    return shlex.join(["selfcal", *args.words])
