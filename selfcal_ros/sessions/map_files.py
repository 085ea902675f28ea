# SPDX-License-Identifier: Apache-2.0
"""Files of maps named in requests: where they may be written, and what may be read."""

import os
import re
from pathlib import Path

from selfcal_ros.errors import InputError
from selfcal_ros.files import read_json
from selfcal_ros.model.result import CalibrationResult, result_from_dict

LARGEST_FILE = 32 << 20
"""Largest result read for a request, bytes."""


def result_file(path: str, folder: str) -> Path:
    """Return the absolute path of a result to be written.

    Parameters
    ----------
    path : str
        Path in the request; a relative one is relative to `folder`.
    folder : str
        Folder in which results may be written; empty = the working directory.

    Raises
    ------
    InputError
        If `path` is empty, outside the folder, or exists and is not a regular file.
    """
    if not path or "\0" in path:
        raise InputError("path", "is no file name" if path else "is empty", "name a file")
    root = Path(os.path.realpath(folder or os.curdir))
    target = Path(os.path.realpath(root / path))
    if not target.is_relative_to(root):
        raise InputError(path, f"lies outside of {root}", "name a file in it, or set the parameter "
                         "result_folder of the solver")
    if os.path.exists(target) and not os.path.isfile(target):  # a pipe would block
        raise InputError(path, "is not a regular file", "name another file")
    return target


def plan_file_name(plan_id: str) -> str:
    """Return PLAN_ID.json; all but letters, digits, ``.``, ``-`` and ``_`` become ``_``."""
    return f"{_word(plan_id) or 'plan'}.json"


def run_file(path: str, run_id: str) -> Path:
    """Return the absolute path of the map of a run; ``{run_id}`` in `path` is replaced."""
    return Path(os.path.abspath(path.replace("{run_id}", _word(run_id) or "run")))


def _word(text: str) -> str:
    return re.sub(r"[^\w.-]", "_", text).lstrip(".")[:200]


def read_result(path: str) -> CalibrationResult:
    """Return the result in a file named by another process.

    Raises
    ------
    InputError
        If it is not a regular file of at most `LARGEST_FILE`, or not a result.
    """
    if not path:
        raise InputError("path", "is empty", "name a file")
    return result_from_dict(read_json(path, LARGEST_FILE), path)


def is_qualified(result: CalibrationResult) -> bool:
    """Return whether the stage error is identified and the readings do not contradict the model."""
    return result.observability.identifiable and result.verdict.qualified
