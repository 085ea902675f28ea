# SPDX-License-Identifier: Apache-2.0
"""``selfcal embed``: result, plan and exports as attachments of the bag they belong to."""

import argparse
import mimetypes
import re
import time
from collections.abc import Iterable, Sequence
from pathlib import Path

from selfcal_ros.bagio.attachments import attach, attached
from selfcal_ros.bagio.offline import bag_input
from selfcal_ros.cli.terminal import add_json, say
from selfcal_ros.cli.trace import origin, records_of, require_unchanged
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_bytes, read_json
from selfcal_ros.model.result import SCHEMA, result_from_dict
from selfcal_ros.outputs import check_outputs, write_bytes
from selfcal_ros.results import unused

KINDS = {".json": "application/json", ".yaml": "application/yaml", ".xml": "application/xml"}
"""Ending -> media type, where the system's table may lack it."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("bag", metavar="BAG", help="MCAP file or rosbag2 folder")
    parser.add_argument("files", metavar="FILE", nargs="*",
                        help="files to keep in the bag: RESULT.json, PLAN.yaml, tables, report; "
                        "without any, those in the bag are listed")
    parser.add_argument("--extract", metavar="FOLDER",
                        help="existing folder to write the files in the bag to")
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Add files to the bag, or list or extract those that it has."""
    if args.files and args.extract:
        raise InputError("--extract", "files are named as well", "embed first, then extract")
    if args.files:
        names = with_records(args.files)
        items = [(Path(name).name, _kind(name), read_bytes(name)) for name in names]
        check_results(args.bag, args.files)
        attach(args.bag, items, time.time_ns())
    found = attached(args.bag)
    if args.extract:
        names = [str(Path(args.extract, name)) for name in file_names(found)]
        check_outputs([args.bag], names)
        for name, data in zip(names, found.values(), strict=True):
            if Path(name).exists() and read_bytes(name) != data:
                raise InputError(name, "the file exists with other contents",
                                 "extract to an empty folder")
        for name, data in zip(names, found.values(), strict=True):
            write_bytes(name, data)
    lines = [f"{name}: {len(data)} bytes" for name, data in found.items()]
    say(args, "\n".join(lines or [f"{args.bag}: no attachments"]), {
        "bag": args.bag, "extracted": args.extract or "",
        "attachments": [{"name": name, "bytes": len(data)} for name, data in found.items()]})
    return 0


def file_names(names: Iterable[str]) -> list[str]:
    """Return different names of files in one folder for names of attachments."""
    out: list[str] = []
    for name in names:
        last = "".join(c if c.isprintable() else "_" for c in re.split(r"[\\/]", name)[-1])
        out.append(unused("attachment" if last in ("", ".", "..") else last, out))
    return out


def with_records(names: Sequence[str]) -> list[str]:
    """Return files and the records beside them; refuse files that are not as exported."""
    more = [(name, record) for name, record in zip(names, records_of(names), strict=True)
            if Path(record).is_file() and record not in names]
    for name, record in more:
        require_unchanged(name, read_bytes(name), origin(read_bytes(record), record))
    return [*names, *(record for _, record in more)]


def _kind(name: str) -> str:
    suffix = Path(name).suffix.lower()
    return KINDS.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"


def check_results(bag: str, names: list[str]) -> None:
    """Refuse results of another bag; a bag with attachments is not that of its results any more."""
    results = {name: data for name in names if name.lower().endswith(".json")
               and isinstance(data := read_json(name), dict) and data.get("schema") == SCHEMA}
    if not results or attached(bag):
        return
    digest = bag_input(bag)["sha256"]
    for name, data in results.items():
        of = result_from_dict(data, name).input.get("sha256")
        if of and of != digest:
            raise InputError(name, f"is not a result of {bag}: it was calibrated from a bag with "
                             f"the SHA-256 {of[:16]}…", "name the bag that it belongs to")
