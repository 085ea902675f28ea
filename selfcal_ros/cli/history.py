# SPDX-License-Identifier: Apache-2.0
"""``selfcal history``: the calibrations of a stage, the active map, and when the next is due."""

import argparse
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from selfcal_ros.applications.batch.history import Drift, Entry, drift_from, history
from selfcal_ros.cli.terminal import add_json, busy, say
from selfcal_ros.errors import ExitCode, InputError
from selfcal_ros.estimation.comparison.maps import MapDifference
from selfcal_ros.estimation.comparison.verification import require_correctable
from selfcal_ros.outputs import plain, write_text
from selfcal_ros.reporting.summary.numbers import map_figures, um, with_u
from selfcal_ros.results import ACTIVE, active_map, read_result
from selfcal_ros.units import UM_PER_M


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the verb."""
    parser.description = (
        "Lists the RESULT.json files in a folder, whatever verb wrote them, with the change of "
        "each from the one before. Wherever a RESULT.json is read, by the compensator too, the "
        "folder itself stands for its active map."
    )
    parser.add_argument("folder", metavar="FOLDER", help="calibrations of one stage")
    parser.add_argument(
        "--activate",
        metavar="RESULT.json",
        help="make this result of the folder the active map",
    )
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """List the folder, after a change of the active map if one is asked for."""
    folder = Path(args.folder)
    if args.activate:
        _activate(folder, Path(args.activate))
    with busy("comparing"):
        entries = history(folder)
        active, since = active_map(folder) if (folder / ACTIVE).exists() else (None, "")
        used = next(
            (entry for entry in entries if active and entry.path.samefile(active)), None
        )
        drift = drift_from(used, entries) if used else None
    say(
        args,
        "\n".join(_text(folder, entries, (used, since), drift)),
        plain(
            {
                "folder": str(folder),
                "active": used and str(used.path),
                "since": since or None,
                "entries": [_entry_json(entry) for entry in entries],
                "drift": drift
                and {
                    "per_day_m": drift.per_day_m,
                    "u_per_day_m": drift.u_per_day_m,
                    "clear": drift.is_clear,
                    "limit_m": drift.limit_m,
                    "due": drift.due and drift.due.isoformat(timespec="seconds"),
                    "checked": drift.checked.isoformat(timespec="seconds"),
                    "too_coarse": drift.too_coarse,
                },
            }
        ),
    )
    return ExitCode.DONE


def _activate(folder: Path, path: Path) -> None:
    inside = folder / path
    path = inside if inside.exists() or not path.exists() else path
    if folder.resolve() not in path.resolve().parents:
        raise InputError(str(path), f"is not in {folder}", "copy it there first")
    require_correctable(read_result(path), str(path))
    if path.suffix != ".json":
        raise InputError(
            str(path), "the folder does not list it", "end the name in .json"
        )
    now = datetime.now(UTC).isoformat(timespec="seconds")
    write_text(
        folder / ACTIVE, f"{path.resolve().relative_to(folder.resolve())}\n{now}\n"
    )


def _text(
    folder: Path,
    entries: list[Entry],
    active: tuple[Entry | None, str],
    drift: Drift | None,
) -> Iterator[str]:
    used, since = active
    yield (
        f"  {'measured':<18}{'what':<12}{'largest error':>14}{'U rms':>11}  change: largest, rms"
    )
    for entry in entries:
        mark = "*" if entry is used else " "
        grade = "" if entry.result.verdict.qualified else ", not qualified"
        yield (
            f"{mark} {entry.measured:%Y-%m-%d %H:%M}  {entry.kind:<12}"
            f"{um(_largest_m(entry)):>14}{um(entry.expanded_m):>11}  "
            f"{_change_text(entry.change)}  {entry.path.relative_to(folder)}{grade}"
        )
    if used is None:
        yield f"no map is active: selfcal history {folder} --activate RESULT.json"
        return
    yield f"active (*): {used.path.relative_to(folder)}, since {since or 'an unknown time'}"
    yield _drift_text(drift)


def _change_text(change: MapDifference | str) -> str:
    if isinstance(change, str):
        return f"not compared: {change}" if change else "-"
    u_largest, u_rms = (
        (math.nan, math.nan)
        if change.xy is None
        else (change.xy.u_largest, change.xy.u_rms)
    )
    clear = {True: "changed", False: "within u", None: "u unknown"}[change.significant]
    return (
        f"{with_u(change.max_m * UM_PER_M, u_largest * UM_PER_M)} µm, "
        f"{with_u(change.rms_m * UM_PER_M, u_rms * UM_PER_M)} µm (k=1), {clear}"
    )


def _drift_text(drift: Drift | None) -> str:
    if drift is None:
        return "drift: nothing to compare with the active map; recheck the stage to learn it"
    day = (
        f"{with_u(drift.per_day_m * UM_PER_M, drift.u_per_day_m * UM_PER_M)} µm a day (k=1)"
        if drift.is_clear
        else f"none that is clear, so below {um(drift.most_per_day_m)} a day"
    )
    limit = f"U, {um(drift.limit_m)},"
    if drift.too_coarse:
        end = (
            f"until {drift.checked:%Y-%m-%d %H:%M} a drift of {limit} may have been missed, so no "
            "date is given: recheck with more views and repeats"
        )
    elif drift.due is None:
        end = "it will not reach U"
    elif drift.is_clear:
        end = f"it reaches {limit} on {drift.due:%Y-%m-%d %H:%M}: calibrate by then"
    else:
        end = (
            f"it does not reach {limit} before {drift.due:%Y-%m-%d %H:%M}: recheck by then, or "
            "calibrate"
        )
    return f"drift from the active map: {day}; {end}"


def _largest_m(entry: Entry) -> float:
    return map_figures(entry.result.error_map).max_error_m


def _entry_json(entry: Entry) -> dict[str, Any]:
    change = entry.change
    fields: dict[str, Any] = (
        {"not_compared": change or None}
        if isinstance(change, str)
        else {
            "changed": change.significant,
            "change_rms_m": change.rms_m,
            "change_max_m": change.max_m,
            "u_change_rms_m": change.xy and change.xy.u_rms,
            "u_change_max_m": change.xy and change.xy.u_largest,
        }
    )
    return {
        "file": str(entry.path),
        "kind": entry.kind,
        "measured": entry.measured.isoformat(timespec="seconds"),
        "grade": str(entry.result.verdict.grade),
        "largest_m": _largest_m(entry),
        "U_rms_m": entry.expanded_m,
        **fields,
    }
