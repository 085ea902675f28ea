# SPDX-License-Identifier: Apache-2.0
"""Which bags a batch is made of, and whether one has changed."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

from selfcal_ros.errors import InputError, NoDataError

STORAGE = ".mcap"
METADATA = "metadata.yaml"


def find_bags(paths: Iterable[str]) -> list[Path]:
    """Return the bags among `paths` and below them, each once, in the order of their names.

    A file is a bag, and so is a folder with a metadata.yaml; below any other folder every bag
    counts, loose .mcap files included, but nothing in folders whose name begins with a dot.

    Raises
    ------
    InputError
        If a path does not exist.
    NoDataError
        If there is no bag.
    """
    found: dict[str, Path] = {}
    for name in paths:
        path = Path(name)
        if not path.exists():
            raise InputError(name, "no such file or folder", "check the path")
        for bag in sorted(_below(path)) if path.is_dir() else [path]:
            found.setdefault(os.path.realpath(bag), bag)
    if not found:
        raise NoDataError(", ".join(paths), "no bag in it", "give MCAP files, rosbag2 folders or "
                          "folders that hold them")
    return list(found.values())


def _below(top: Path) -> list[Path]:
    bags = []
    for folder, folders, files in top.walk(on_error=_refuse):
        if METADATA in files:
            bags.append(folder)
            folders.clear()
        else:
            folders[:] = [name for name in folders if not name.startswith(".")]
            bags += [folder / name for name in files
                     if not name.startswith(".") and Path(name).suffix == STORAGE]
    return bags


def _refuse(error: OSError) -> NoReturn:
    raise InputError(str(error.filename), f"cannot be read ({error.strerror})",
                     "name a folder that you may read") from error


def stat_of(bag: Path) -> list[list]:
    """Return name, size and time of change (ns) of the files of a bag: equal if it is as it was."""
    found = []
    for file in sorted(_entries(bag)) if bag.is_dir() else [bag]:
        try:
            if file.is_file():
                found.append([file.name, file.stat().st_size, file.stat().st_mtime_ns])
        except OSError:  # it has just vanished: reading it tells
            continue
    return found


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError as error:
        _refuse(error)
