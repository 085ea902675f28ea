# SPDX-License-Identifier: Apache-2.0
"""Which form a report takes: the ending of its name says it. Only that form is loaded."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.result import CalibrationResult


def write_report(result: CalibrationResult, path: str | os.PathLike, *,
                 truth: Mapping[str, np.ndarray] | None = None) -> None:
    """Write the report of a calibration, HTML or PDF, atomically.

    Raises
    ------
    InputError
        If the name ends in neither .html nor .pdf, `truth` does not fit the map, or the file
        cannot be written.
    """
    check_name(path)
    if Path(path).suffix.lower() == ".pdf":
        from selfcal_ros.reporting.pdf import save_pdf as save  # loads matplotlib
    else:
        from selfcal_ros.reporting.html import save_report as save  # loads every figure
    save(result, path, truth=truth)


def check_name(path: str | os.PathLike) -> None:
    """Refuse a name that says neither HTML nor PDF.

    Raises
    ------
    InputError
        If it ends in something else.
    """
    if Path(path).suffix.lower() not in (".html", ".htm", ".pdf"):
        raise InputError(str(path), "a report is HTML or PDF", "end the name in .html or .pdf")
