# SPDX-License-Identifier: Apache-2.0
"""What a batch is asked for and what it keeps: settings, jobs, records.

Nothing here needs the estimator: the command that hands out the jobs starts without it.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from selfcal_ros import __version__
from selfcal_ros.collection.settings.nodes import CollectorSettings, SolverSettings
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json

SCHEMA = "selfcal.batch/1"
RECORDS, RESULTS = "records", "results"
NO_INFLUENCE = ("save_path", "result_folder", "autostart", "status_period", "frame_id")
"""Parameters that decide nothing about a result."""


@dataclass(frozen=True)
class Settings:
    """How every bag of a batch is solved.

    Attributes
    ----------
    collector, solver : CollectorSettings, SolverSettings
        Those of the nodes.
    robust : bool
        Whether outliers are looked for.
    namespace : str or None
        Of the cell's topics, see `selfcal_ros.bagio.offline.collect_bag`.
    """

    collector: CollectorSettings
    solver: SolverSettings
    robust: bool = False
    namespace: str | None = None

    def digest(self) -> str:
        """Return a digest of all that decides a result beside the bag."""
        values = asdict(self) | {"schema": SCHEMA, "version": __version__}
        for node in ("collector", "solver"):
            values[node] = {k: v for k, v in values[node].items() if k not in NO_INFLUENCE}
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Job:
    """A bag to be solved into the folder of a batch; `redo`: also where it was solved before."""

    bag: Path
    folder: Path
    settings: Settings
    redo: bool = False


Record = dict[str, Any]
"""What is kept of a bag: JSON, schema `SCHEMA`, see docs/batch.md."""


def read_record(path: Path) -> Record | None:
    """Return the record in a file; None if there is none, or none that can be used."""
    try:
        record = read_json(path)
    except InputError:
        return None
    good = isinstance(record, dict) and record.get("schema") == SCHEMA and all(
        isinstance(record.get(name), kind) for name, kind in (
            ("bag", str), ("settings", str), ("files", list), ("exit_code", int),
            ("message", str)))
    return record if good else None


def is_whole(folder: Path, record: Record) -> bool:
    """Return whether the result that a record names is there."""
    return "result" not in record or (folder / str(record["result"])).is_file()
