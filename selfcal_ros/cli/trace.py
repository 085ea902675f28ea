# SPDX-License-Identifier: Apache-2.0
"""``selfcal trace``: the result behind an exported table, and whether both are unchanged.

Every exported FILE has a record beside it, FILE.origin.json; `selfcal embed` keeps both in a bag.
"""

import argparse
import hashlib
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from selfcal_ros import __version__
from selfcal_ros.aerotech.write import refuse_existing, write_cal
from selfcal_ros.cli.terminal import STDOUT, add_json, exit_code, say
from selfcal_ros.errors import InputError
from selfcal_ros.files import parse_json, read_bytes, sha256_of
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.outputs import check_outputs, write_bytes, write_json
from selfcal_ros.results import attachments, bag_files, result_bytes

SCHEMA = "selfcal.origin/1"
ENDING = ".origin.json"
REMEDY = "export it again"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.add_argument("files", metavar="FILE|BAG", nargs="+", help="exported tables, programs "
                        "and certificates; a bag stands for all those in it")
    parser.add_argument("--result", metavar="RESULT.json", help="the result that they should come "
                        "from (default: the one in the record, relative to the file)")
    add_json(parser)


def records_of(paths: Iterable[str | os.PathLike]) -> list[str]:
    """Return the names of the records of exported files."""
    return [f"{path}{ENDING}" for path in paths]


def outputs_of(args: argparse.Namespace) -> list[str]:
    """Return the file that ``--output`` names, and its record; none for stdout."""
    return [] if args.output == STDOUT else [args.output, *records_of([args.output])]


def record(args: argparse.Namespace, result: "CalibrationResult",
           paths: Iterable[str | os.PathLike]) -> None:
    """Write the record of each exported file; none of a pipe or a device."""
    source, digest = result.read_from or ("", "")
    for path in map(Path, paths):
        if path.is_file():
            write_json(f"{path}{ENDING}", {
                "schema": SCHEMA, "file": path.name, "sha256": sha256_of(path),
                "result": {"file": os.path.relpath(source, path.parent), "sha256": digest,
                           "plan_id": result.plan_id, "run_id": result.run_id},
                "created": datetime.now(UTC).isoformat(timespec="seconds"),
                "command": command(args), "version": __version__})


def deliver(args: argparse.Namespace, result: CalibrationResult, content: str | bytes, key: str, *,
            note: str = "", **data: Any) -> int:
    """Write an export of a result to its file with a record, or to stdout; return the exit code.

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
    raw = content.encode(errors="backslashreplace") if isinstance(content, str) else content
    if args.output == STDOUT:
        text = raw.decode()
        say(args, text.removesuffix("\n"), {key: text})
    else:
        write_bytes(args.output, raw)
        record(args, result, [args.output])
        say(args, f"written: {args.output}{note}", {"written": args.output, **data})
    return exit_code(result)


def replace_files(args: argparse.Namespace, texts: Mapping[str, str], sources: Iterable[str | None],
                  result: CalibrationResult | None = None) -> dict[str, str | None]:
    """Write files with their records, keep those that they replace; return path -> the old one.

    Raises
    ------
    InputError
        If one of them is a source, cannot be written, or exists and ``--force`` is not given.
    """
    check_outputs(sources, [*texts, *records_of(texts)])
    refuse_existing(list(texts), force=args.force)
    backups = {path: write_cal(path, text, force=args.force) for path, text in texts.items()}
    if result is not None:
        record(args, result, texts)
    return {path: str(backup) if backup else None for path, backup in backups.items()}


def replaced(backup: str | None) -> str:
    """Return a note on the old file, empty if there was none."""
    return f"; the old file is {backup}" if backup else ""


def command(args: argparse.Namespace) -> str:
    """Return the command line."""
    return shlex.join(["selfcal", *args.words])


def origin(raw: bytes, where: str) -> dict[str, Any]:
    """Return the fields of a record; InputError if it is none."""
    data = parse_json(raw, where)
    texts = [data.get(key) for key in ("file", "sha256", "created", "command")] if isinstance(
        data, dict) and data.get("schema") == SCHEMA else [None]
    if all(isinstance(text, str) for text in texts) and isinstance(data["result"], dict):
        texts = [data["result"].get(key) for key in ("file", "sha256")]
    if not all(isinstance(text, str) for text in texts):
        raise InputError(where, f"not a record of schema {SCHEMA}", REMEDY)
    return dict(data)


def require_unchanged(name: str, raw: bytes, made: dict[str, Any]) -> None:
    """Refuse a file that is not as it was exported."""
    if hashlib.sha256(raw).hexdigest() != made["sha256"]:
        raise InputError(name, f"was changed after its export on {made['created']}", REMEDY)


def run(args: argparse.Namespace) -> int:
    """Compare files and results with the records, print a line for each file."""
    lines, found = [], []
    for name in args.files:
        for file, made, source in traced(name, args.result):
            lines.append(f"{file}: unchanged, from {source} "
                         f"(SHA-256 {made['result']['sha256'][:16]}…), "
                         f"exported on {made['created']} by: {made['command']}")
            found.append({"file": file, "result": source, **{
                key: made[key] for key in ("created", "command", "sha256")},
                "result_sha256": made["result"]["sha256"]})
    say(args, "\n".join(lines), {"files": found})
    return 0


def traced(name: str, result: str | None) -> Sequence[tuple[str, dict[str, Any], str]]:
    """Return name, record and result of an exported file, or of those in a bag.

    Raises
    ------
    InputError
        If there is no record, or the file or its result is not the one of the record.
    """
    files = bag_files(Path(name))
    if not files:
        if not Path(name).exists():
            raise InputError(name, "no such file", "check the path")
        if not Path(f"{name}{ENDING}").is_file():
            raise InputError(name, f"has no record {Path(name).name}{ENDING} next to it", REMEDY)
        made = origin(read_bytes(f"{name}{ENDING}"), f"{name}{ENDING}")
        require_unchanged(name, read_bytes(name), made)
        source = result or os.path.normpath(Path(name).parent / made["result"]["file"])
        _require_result(name, made, {source: result_bytes(source)[1]})
        return [(name, made, source)]
    kept, out = attachments(files), []
    others = kept if result is None else {result: result_bytes(result)[1]}
    for key in kept:
        if key.endswith(ENDING):
            file, made = key.removesuffix(ENDING), origin(kept[key], f"{name}/{key}")
            if file not in kept:
                raise InputError(f"{name}/{key}", f"{file} is not in the bag", "embed it as well")
            require_unchanged(f"{name}/{file}", kept[file], made)
            out.append((f"{name}/{file}", made, _require_result(f"{name}/{file}", made, others)))
    if not out:
        raise InputError(name, "no exported file with its record is in it",
                         "embed one with `selfcal embed`")
    return out


def _require_result(name: str, made: dict[str, Any], candidates: dict[str, bytes]) -> str:
    """Return which of several files is the result of a record."""
    for source, raw in candidates.items():
        if hashlib.sha256(raw).hexdigest() == made["result"]["sha256"]:
            return source
    where = next(iter(candidates)) if len(candidates) == 1 else "no file in the bag"
    raise InputError(name, f"{where} is not the result that it was exported from (SHA-256 "
                     f"{made['result']['sha256'][:16]}…)", f"name that by --result, or {REMEDY}")
