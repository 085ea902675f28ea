# SPDX-License-Identifier: Apache-2.0
"""Where results are read from: a RESULT.json, or a folder in which one is the active map."""

import hashlib
import os
from dataclasses import replace
from pathlib import Path

from selfcal_ros.errors import InputError
from selfcal_ros.files import parse_json, read_bytes, read_text
from selfcal_ros.model.result import (
    CalibrationResult,
    require_unchanged,
    result_from_dict,
)
from selfcal_ros.model.verdict import Grade

UNCHECKED = "the file has no digests, so whether it was edited cannot be checked"
"""Reason against results of versions that wrote no digests."""

ACTIVE = "active"
"""File of a folder of calibrations: name of the active map, and since when (ISO 8601)."""


def active_map(folder: str | os.PathLike) -> tuple[Path, str]:
    """Return the active map of a folder of calibrations, and since when it is active.

    Raises
    ------
    InputError
        If none is active.
    """
    path = Path(folder, ACTIVE)
    if not path.is_file():
        raise InputError(
            str(folder),
            "is a folder, and no map in it is active",
            f"name a RESULT.json, or: selfcal history {folder} --activate RESULT.json",
        )
    name, _, since = read_text(path).strip().partition("\n")
    map_path = Path(folder, name)
    if not map_path.is_file():
        raise InputError(
            str(path),
            f"names '{name}', which is not there",
            f"selfcal history {folder} --activate RESULT.json",
        )
    return map_path, since.strip()


def read_result(path: str | os.PathLike, limit: int | None = None) -> CalibrationResult:
    """Return the result in a file, with the file's name and SHA-256 in `read_from`.

    A result of a version that wrote no digests is not qualified.

    Parameters
    ----------
    path : str or Path
        RESULT.json, or a folder with an active map.
    limit : int, optional
        Largest number of bytes, as for `selfcal_ros.files.read_bytes`.

    Raises
    ------
    InputError
        If it is not a result, or was changed after it was written.
    """
    if os.path.isdir(path):
        path = active_map(path)[0]
    raw = read_bytes(path, limit)
    where = str(path)
    data = parse_json(raw, path, limit)
    result = result_from_dict(data, where)
    if not require_unchanged(data, where):
        result = replace(
            result,
            verdict=replace(
                result.verdict,
                grade=Grade.NOT_QUALIFIED,
                sentence=f"Not qualified: {UNCHECKED}",
                reasons=(UNCHECKED, *result.verdict.reasons),
            ),
        )
    return replace(result, read_from=(where, hashlib.sha256(raw).hexdigest()))
