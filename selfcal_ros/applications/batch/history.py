# SPDX-License-Identifier: Apache-2.0
"""The calibrations of a stage in a folder: their changes, and when the next one is due."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError, NoDataError
from selfcal_ros.estimation.comparison.maps import MapDifference, compare
from selfcal_ros.files import read_text
from selfcal_ros.model.result import SCHEMA, CalibrationResult
from selfcal_ros.results import read_result
from selfcal_ros.units import S_PER_DAY

COVERAGE = 2.0
"""Coverage factor of U and of the drift that could have been missed."""


@dataclass(frozen=True, eq=False)
class Entry:
    """A calibration of the folder.

    Attributes
    ----------
    path : Path
        The file.
    result : CalibrationResult
        Its content.
    measured : datetime
        First exposure, or when it was computed if that is not known; of a mean the middle from the
        first exposure of its runs to the last.
    change : MapDifference or str
        Against the one before; why it was not compared, "" for the first.
    """

    path: Path
    result: CalibrationResult
    measured: datetime
    change: MapDifference | str = ""

    @property
    def kind(self) -> str:
        """``calibration``, ``recheck`` or ``mean``."""
        if self.result.recheck is not None:
            return "recheck"
        return "mean" if self.result.parts.combined else "calibration"

    @property
    def expanded_m(self) -> float:
        """U of the map at its nodes, root mean square, m."""
        emap = self.result.error_map
        u_rms_m = np.sqrt(np.nanmean(np.square([emap.u_gx, emap.u_gy])))
        return self.result.noise.k_xy * float(u_rms_m)


@dataclass(frozen=True)
class Drift:
    """How fast the stage departs from the active map, rms of a coordinate.

    Attributes
    ----------
    per_day_m, u_per_day_m : float
        Drift and its standard uncertainty, m.
    most_per_day_m : float
        The drift of a day if it is clear, else the largest that may have been missed, m.
    limit_m : float
        U of the active map, rms, which the drift may reach.
    checked : datetime
        When the stage was last compared with the active map.
    due : datetime or None
        When the drift, or the largest that may have been missed, reaches U; None if never, or
        if it is too coarse.
    too_coarse : bool
        Whether a drift of U may have been missed until `checked`.
    """

    per_day_m: float
    u_per_day_m: float
    most_per_day_m: float
    limit_m: float
    checked: datetime
    due: datetime | None = None
    too_coarse: bool = False

    @property
    def is_clear(self) -> bool:
        """Whether a drift is observed at all."""
        return self.per_day_m > COVERAGE * self.u_per_day_m


def history(folder: Path) -> list[Entry]:
    """Return the calibrations of a folder in the order of their measurement.

    Files below it that are not results are passed over, whatever wrote them.

    Raises
    ------
    InputError
        If it is not a folder, or a result cannot be read.
    NoDataError
        If it has no result with a map.
    """
    if not folder.is_dir():
        raise InputError(
            str(folder), "is not a folder", "name the folder of the calibrations"
        )
    entries = []
    for path in sorted(folder.rglob("*.json")):
        if _is_result(path):
            result = read_result(path)
            if result.observability.identifiable and result.verification is None:
                entries.append(Entry(path, result, _measured(result, str(path))))
    if not entries:
        raise NoDataError(
            str(folder),
            "no RESULT.json with a map is in it",
            "write the results of `selfcal solve` there",
        )
    entries.sort(key=lambda entry: (entry.measured, entry.result.provenance.created))
    return [
        Entry(
            entry.path,
            entry.result,
            entry.measured,
            _change(_one_before(entries[:number], entry), entry),
        )
        for number, entry in enumerate(entries)
    ]


def _is_result(path: Path) -> bool:
    try:
        data = json.loads(read_text(path))
    except (InputError, ValueError):
        return False
    return isinstance(data, dict) and data.get("schema") == SCHEMA


def _measured(result: CalibrationResult, where: str) -> datetime:
    provenance = result.provenance
    texts = [provenance.first_exposure or provenance.created]
    if result.parts.combined and provenance.last_exposure:
        texts.append(provenance.last_exposure)
    try:
        times = [datetime.fromisoformat(str(text)) for text in texts]
    except ValueError:
        raise InputError(
            where,
            "it does not tell when it was measured",
            "solve its bag again, or take it out of the folder",
        ) from None
    zoned = [time if time.tzinfo else time.replace(tzinfo=UTC) for time in times]
    first, last = zoned[0], zoned[-1]
    return first + (last - first) / 2


def _one_before(earlier: Sequence[Entry], entry: Entry) -> Entry:
    """Return the entry before another: the last that is independent of it, if one is."""
    for before in reversed(earlier):
        if not _share_run(before.result, entry.result):
            return before
    return earlier[-1] if earlier else entry


def _change(before: Entry, entry: Entry) -> MapDifference | str:
    if before is entry:
        return ""
    if _share_run(before.result, entry.result):
        return "a mean and one of its runs"
    try:
        return compare(
            before.result, entry.result, names=(str(before.path), str(entry.path))
        )
    except InputError as error:  # another lattice, or nothing that both know
        return error.what


def _share_run(first: CalibrationResult, second: CalibrationResult) -> bool:
    """Return whether one of two results is a mean with a run that is, or is in, the other."""
    if not (first.parts.combined or second.parts.combined):
        return False
    in_first, in_second = (
        {run.sha256 for run in result.parts.combined.runs}
        if result.parts.combined
        else {result.input.get("sha256", "")}
        for result in (first, second)
    )
    return bool(in_first & in_second - {""})


def drift_from(active: Entry, entries: Sequence[Entry]) -> Drift | None:
    """Return the drift about the active map; None if nothing can be compared with it.

    The part of each rms difference beyond its u, over the time between, a line through the active
    map by weighted least squares. All differences contain the error of the active map, so their
    errors count as common. A drift that is not clear is below what the best of them would have
    shown.
    """
    days, changes, u = [], [], []
    checked = passed = active.measured
    for entry in entries:
        days_between = (
            abs((entry.measured - active.measured).total_seconds()) / S_PER_DAY
        )
        change = _change(active, entry)
        if isinstance(change, str) or not days_between or change.xy is None:
            continue
        days.append(days_between)
        u.append(change.u_beyond_m)
        changes.append(change.beyond_m)
        checked = max(checked, entry.measured)
        if not change.significant:
            passed = max(passed, entry.measured)
    if not days:
        return None
    t, u_m = np.array(days), np.array(u)
    weights = t / u_m**2 / np.sum((t / u_m) ** 2)
    per_day = float(weights @ changes)
    u_per_day = float(weights @ u_m)
    missed = float(np.min(np.hypot(changes, COVERAGE * u_m) / t))
    drift = Drift(per_day, u_per_day, missed, active.expanded_m, checked)
    if drift.is_clear:
        drift = replace(drift, most_per_day_m=per_day)
    if not drift.most_per_day_m:
        return drift
    try:
        due = active.measured + timedelta(days=drift.limit_m / drift.most_per_day_m)
    except OverflowError:  # thousands of years
        return drift
    if drift.is_clear:
        return replace(drift, due=max(due, passed))
    if due < checked:
        return replace(drift, too_coarse=True)
    return replace(drift, due=due)
