# SPDX-License-Identifier: Apache-2.0
"""The folder of a batch: bags, settings, jobs, records; what is done and what remains.

Independent of the estimator: the command that distributes the jobs starts without it.
"""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NoReturn

from selfcal_ros import __version__, portable
from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.files import read_json
from selfcal_ros.outputs import creating, has_content, sweep
from selfcal_ros.settings.nodes import CollectorSettings, SolverSettings

STORAGE = ".mcap"
METADATA = "metadata.yaml"
SCHEMA = "selfcal.batch/1"
RECORDS, RESULTS = "records", "results"
PER = "_per_"
"""Replacement of the slash of a unit in the name of a quantity."""
NO_INFLUENCE = ("save_path", "result_folder", "autostart", "status_period", "frame_id")
"""Parameters without effect on a result."""
Record = dict[str, Any]
"""Record of a bag: JSON, schema `SCHEMA`, see docs/guides/batch.md."""
LOCK = ".lock"
TABLE, PAGE, DATA = WRITTEN = ("table.csv", "index.html", "batch.json")
"""Files of a batch, which each one writes anew."""


def find_bags(paths: Iterable[str]) -> list[Path]:
    """Return the bags among `paths` and below them, each once, in the order of their names.

    A file is a bag, and so is a folder with a metadata.yaml; any other folder is searched for
    bags, including single .mcap files, except in folders whose name begins with a dot.

    Raises
    ------
    InputError
        If a path does not exist.
    NoDataError
        If there is no bag.
    """
    bag_of_path: dict[str, Path] = {}
    for name in paths:
        path = Path(name)
        if not path.exists():
            raise InputError(name, "no such file or folder", "check the path")
        for bag in sorted(_below(path)) if path.is_dir() else [path]:
            bag_of_path.setdefault(os.path.realpath(bag), bag)
    if not bag_of_path:
        raise NoDataError(
            ", ".join(paths),
            "no bag in it",
            "give MCAP files, rosbag2 folders or folders that contain them",
        )
    return list(bag_of_path.values())


def _below(top: Path) -> list[Path]:
    bags = []
    for folder, folders, files in top.walk(on_error=_refuse):
        if METADATA in files:
            bags.append(folder)
            folders.clear()
        else:
            folders[:] = [name for name in folders if not name.startswith(".")]
            bags += [
                folder / name
                for name in files
                if not name.startswith(".") and Path(name).suffix == STORAGE
            ]
    return bags


def _refuse(error: OSError) -> NoReturn:
    raise InputError(
        str(error.filename),
        f"cannot be read ({error.strerror})",
        "name a readable folder",
    ) from error


def stat_of(bag: Path) -> list[list]:
    """Return name, size and time of change (ns) of the files of a bag, equal if unchanged."""
    stats = []
    for file in sorted(_entries(bag)) if bag.is_dir() else [bag]:
        try:
            if file.is_file():
                stats.append([file.name, file.stat().st_size, file.stat().st_mtime_ns])
        except OSError:  # it has just disappeared: reading it will fail
            continue
    return stats


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        _refuse(error)


@dataclass(frozen=True)
class BatchSettings:
    """Settings for every bag of a batch.

    Attributes
    ----------
    collector, solver : CollectorSettings, SolverSettings
        Settings of the nodes.
    namespace : str or None
        Namespace of the cell's topics, see `selfcal_ros.bagio.offline.collect_bag`.
    """

    collector: CollectorSettings
    solver: SolverSettings
    namespace: str | None = None

    def digest(self) -> str:
        """Return a digest of everything that affects a result, other than the bag."""
        values = asdict(self) | {"schema": SCHEMA, "version": __version__}
        for node in ("collector", "solver"):
            values[node] = {
                k: v for k, v in values[node].items() if k not in NO_INFLUENCE
            }
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class BatchJob:
    """A bag to be solved into the folder of a batch; `redo`: even if solved before."""

    bag: Path
    folder: Path
    settings: BatchSettings
    redo: bool = False


def read_record(path: Path) -> Record | None:
    """Return the record in a file; None if missing or unusable."""
    try:
        record = read_json(path)
    except InputError:
        return None
    good = (
        isinstance(record, dict)
        and record.get("schema") == SCHEMA
        and all(
            isinstance(record.get(name), kind)
            for name, kind in (
                ("bag", str),
                ("settings", str),
                ("files", list),
                ("exit_code", int),
                ("message", str),
            )
        )
    )
    return record if good else None


def is_whole(folder: Path, record: Record) -> bool:
    """Return whether the result of a record exists."""
    return "result" not in record or (folder / str(record["result"])).is_file()


@contextlib.contextmanager
def opened(folder: Path) -> Iterator[None]:
    """Create the folder of a batch, and lock it against other batches during the block.

    Raises
    ------
    InputError
        If it cannot be created, another batch is using it, or a file in it that would be replaced
        is not that of a batch.
    """
    if not _is_of_batch(folder):
        for name in WRITTEN:
            if has_content(folder / name):
                raise InputError(
                    str(folder / name),
                    "the file exists, and is not that of a batch",
                    "name another folder",
                )
    with creating(folder):
        for part in (folder / RECORDS, folder / RESULTS):
            part.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("w")
    with lock:
        try:
            portable.lock(lock.fileno())
        except OSError as error:
            raise InputError(
                str(folder),
                "another batch works in this folder",
                "wait for it to end or name another folder",
            ) from error
        for part in (folder / RECORDS, folder / RESULTS):
            sweep(part)
        yield


def _is_of_batch(folder: Path) -> bool:
    """Return whether a folder has the records or the data of a batch."""
    if (folder / RECORDS).is_dir():
        return True
    try:
        data = read_json(folder / DATA)
    except InputError:
        return False
    return isinstance(data, dict) and data.get("schema") == SCHEMA


def kept_records(folder: Path, settings: BatchSettings) -> list[Record]:
    """Return the records of these settings in the folder."""
    digest = settings.digest()
    records = (read_record(path) for path in sorted((folder / RECORDS).glob("*.json")))
    return [
        record
        for record in records
        if record is not None
        and record["settings"] == digest
        and is_whole(folder, record)
    ]


def done_and_to_do(
    kept: Sequence[Record], bags: Sequence[Path]
) -> tuple[dict[int, Record], list[int]]:
    """Return the records of finished bags, by their index in `bags`, and the other indices.

    A bag is finished if it has a record and its files are unchanged. The largest of the others come
    first, so that all cores finish at about the same time.
    """
    record_of_bag = {record["bag"]: record for record in kept}
    finished, sizes = {}, {}
    for index, bag in enumerate(bags):
        files = stat_of(bag)
        record = record_of_bag.get(os.path.realpath(bag))
        if record is not None and record["files"] == files:
            finished[index] = record
        else:
            sizes[index] = sum(size for _, size, _ in files)
    return finished, sorted(sizes, key=lambda index: -sizes[index])
