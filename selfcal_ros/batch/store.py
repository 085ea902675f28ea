# SPDX-License-Identifier: Apache-2.0
"""The folder of a batch: what is done already, what is to do, and one batch in it at a time."""

import contextlib
import fcntl
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from selfcal_ros.batch.bags import stat_of
from selfcal_ros.batch.records import (
    RECORDS,
    RESULTS,
    Job,
    Record,
    Settings,
    is_whole,
    read_record,
)
from selfcal_ros.errors import InputError
from selfcal_ros.outputs import sweep

LOCK = ".lock"


@contextlib.contextmanager
def opened(folder: Path) -> Iterator[None]:
    """Make the folder of a batch, and hold it against other batches while the block runs.

    Raises
    ------
    InputError
        If it cannot be made, or another batch works in it.
    """
    try:
        for part in (folder / RECORDS, folder / RESULTS):
            part.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK).open("w")
    except OSError as error:
        raise InputError(str(folder), f"cannot be created ({error.strerror})",
                         "name a writable folder") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(str(folder), "another batch works in this folder",
                             "wait for its end or name another folder") from error
        for part in (folder / RECORDS, folder / RESULTS):
            sweep(part)
        yield


def kept_records(folder: Path, settings: Settings) -> list[Record]:
    """Return the records of these settings that are in the folder."""
    digest = settings.digest()
    found = (read_record(path) for path in sorted((folder / RECORDS).glob("*.json")))
    return [record for record in found if record is not None and record["settings"] == digest
            and is_whole(folder, record)]


def done_and_to_do(kept: Sequence[Record], bags: Sequence[Path],
                   ) -> tuple[dict[int, Record], list[int]]:
    """Return the records of bags that are done, by their place in `bags`, and the others' places.

    A bag is done if it has a record and its files are as they were. The largest of the others come
    first, so that no core ends long after the others.
    """
    known = {record["bag"]: record for record in kept}
    done, sizes = {}, {}
    for index, bag in enumerate(bags):
        files = stat_of(bag)
        record = known.get(os.path.realpath(bag))
        if record is not None and record["files"] == files:
            done[index] = record
        else:
            sizes[index] = sum(size for _, size, _ in files)
    return done, sorted(sizes, key=lambda index: -sizes[index])


def jobs_of(folder: Path, bags: Sequence[Path], settings: Settings,
            places: Sequence[int], *, redo: bool) -> list[Job]:
    """Return the jobs of the bags at `places`."""
    return [Job(bags[index], folder, settings, redo) for index in places]


def work_on(job: Job) -> Record:
    """Return what `selfcal_ros.batch.jobs.run_job` makes of a job."""
    from selfcal_ros.batch.jobs import run_job  # heavy, and in a worker loaded already

    return run_job(job)
