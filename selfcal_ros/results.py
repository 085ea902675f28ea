# SPDX-License-Identifier: Apache-2.0
"""Where results are read from: a RESULT.json."""

import hashlib
import os
from dataclasses import replace

from selfcal_ros.files import parse_json, read_bytes
from selfcal_ros.model.result import CalibrationResult, require_unchanged, result_from_dict
from selfcal_ros.model.verdict import Grade

UNCHECKED = "the file has no digests, so whether it was edited cannot be checked"
"""Reason against results of versions that wrote no digests."""


def read_result(path: str | os.PathLike, limit: int | None = None) -> CalibrationResult:
    """Return the result in a file, with the file's name and SHA-256 in `read_from`.

    A result of a version that wrote no digests is not qualified.

    Parameters
    ----------
    path : str or Path
        RESULT.json.
    limit : int, optional
        Largest number of bytes, as for `selfcal_ros.files.read_bytes`.

    Raises
    ------
    InputError
        If it is not a result, or was changed after it was written.
    """
    raw, where = read_bytes(path, limit), str(path)
    data = parse_json(raw, path, limit)
    result = result_from_dict(data, where)
    if not require_unchanged(data, where):
        result = replace(result, verdict=replace(
            result.verdict, grade=Grade.NOT_QUALIFIED, sentence=f"Not qualified: {UNCHECKED}",
            reasons=(UNCHECKED, *result.verdict.reasons)))
    return replace(result, read_from=(where, hashlib.sha256(raw).hexdigest()))
