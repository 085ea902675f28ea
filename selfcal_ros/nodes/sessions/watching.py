# SPDX-License-Identifier: Apache-2.0
"""State of a cell for display, collected from its topics as plain values."""

import math
from collections.abc import Iterable
from itertools import islice
from math import ceil
from typing import Any

import numpy as np

from selfcal_ros.bagio.messages import to_model
from selfcal_ros.collection.expected import mark_rows
from selfcal_ros.collection.inputs import Phase
from selfcal_ros.errors import printable
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View
from selfcal_ros.nodes.sessions.health import Diagnosis, Ports, Presence
from selfcal_ros.units import ARCSEC_PER_RAD, MM_PER_M, UM_PER_M

PATIENCE_S = 3.0
NODES = ("measurement_collector", "pose_sequencer", "solver")
"""Nodes needed for a calibration; others are shown if heard."""
MOST_SITES = 41
"""Cells per side of the pictures; for a larger plate each represents 2 x 2, 3 x 3, ... marks."""
MOST_ENTRIES = 200
"""Entries of a list that are shown: as many as the missing marks in a ViewStatus."""


class Watch:
    """Keep the newest messages, and combine them into one picture.

    Parameters
    ----------
    ports : Ports
        Clocks.
    """

    def __init__(self, ports: Ports) -> None:
        self._presence = Presence(ports.now_s, PATIENCE_S)
        self._seen: set[str] = set(NODES)
        self._command: Any = None
        self._status: Any = None
        self._measured: Any = None  # its command
        self._summary: Any = None
        self._map: Any = None

    def take_health(self, node: str, diagnosis: Diagnosis) -> None:
        """Take the health of a node."""
        self._seen.add(node)
        self._presence.take(node, diagnosis)

    def take_command(self, message: Any) -> None:
        """Take a view command; the newest by stamp is used."""
        if self._command is None or to_model.stamp_ns(message) >= to_model.stamp_ns(
            self._command
        ):
            self._command = message

    def take_status(self, message: Any) -> None:
        """Take the progress of a view; that of the commanded view is used."""
        command = self._command
        if command is None or (message.plan_id, message.view_index) == (
            command.plan_id,
            command.view_index,
        ):
            self._status, self._measured = message, command

    def take_summary(self, message: Any) -> None:
        """Take the summary of the calibration."""
        self._summary = message

    def take_map(self, message: Any) -> None:
        """Take the error map."""
        self._map = message

    def picture(self) -> dict[str, Any]:
        """Return everything as JSON values, its texts printable."""
        return _printable_texts(
            {
                "health": {node: self._health(node) for node in sorted(self._seen)},
                "command": self._commanded(),
                "view": self._view(),
                "summary": self._summed(),
                "map": self._mapped(),
            }
        )

    def _health(self, node: str) -> dict[str, Any] | None:
        health = self._presence.of(node)
        return (
            None
            if health is None
            else {
                "level": int(health.level),
                "message": health.message,
                "values": dict(islice(health.values.items(), MOST_ENTRIES)),
            }
        )

    def _commanded(self) -> dict[str, Any] | None:
        command = self._command
        return command and {
            "phase": Phase(command.phase).name if command.phase in list(Phase) else "?",
            "plan_id": command.plan_id,
            "run_id": command.run_id,
            "view_index": command.view_index,
            "view_name": command.view_name,
            "views_planned": command.views_planned,
            "rotation_deg": _finite(math.degrees(command.rotation)),
            "translation_mm": [
                _finite(command.translation_x * MM_PER_M),
                _finite(command.translation_y * MM_PER_M),
            ],
        }

    def _view(self) -> dict[str, Any] | None:
        status, command = self._status, self._command
        if status is None or (
            status.run_id
            and command is not None
            and command.run_id
            and status.run_id != command.run_id
        ):
            return None  # nothing measured in this run yet
        plate, step = self._plate()
        return {
            "view_name": status.view_name,
            "complete": bool(status.complete),
            "grid": [status.grid_done, status.grid_expected],
            "angular": [status.angular_done, status.angular_expected],
            "checks": [status.check_done, status.check_expected],
            "used": status.detections_used,
            "rejected": dict(
                zip(
                    _lines(status.reject_reasons),
                    map(int, status.reject_counts),
                    strict=False,
                )
            ),
            "repeatability_um": _finite(status.sigma_xy * UM_PER_M),
            "repeatability_arcsec": _finite(status.sigma_theta * ARCSEC_PER_RAD),
            "missing_lines": [int(k) for k in status.missing_k[:MOST_ENTRIES]],
            "plate": plate,
            "plate_step": step,
        }

    def _plate(self) -> tuple[list[str], int]:
        """Return the plate as in `plate_picture`; empty if the command has none."""
        command, status = self._measured, self._status
        try:
            artifact = to_model.artifact_of(command)
            view = to_model.view_of(
                command, repeats=1, grid=bool(command.grid), angular=False
            )
            missing = list(
                zip(
                    map(int, status.missing_m[:MOST_ENTRIES]),
                    map(int, status.missing_n[:MOST_ENTRIES]),
                    strict=False,
                )
            )
            return plate_picture(
                artifact,
                view,
                missing,
                status.grid_expected - status.grid_done,
                MOST_SITES,
            )
        except Exception:  # faults of a command are not reported here
            return [], 1

    def _summed(self) -> dict[str, Any] | None:
        summary = self._summary
        return summary and {
            "state": summary.state,
            "views": [summary.views_done, summary.views_planned],
            "identifiable": bool(summary.identifiable),
            "qualified": bool(summary.qualified),
            "enlarged": bool(summary.qualified)
            and int(getattr(summary, "grade", 2)) == 1,
            "max_error_um": _finite(summary.max_error_um),
            "rms_uncertainty_um": _finite(summary.rms_uncertainty_um),
            "advice": _lines(summary.advice),
            "causes": _lines(summary.causes),
            "run_id": summary.run_id,
        }

    def _mapped(self) -> dict[str, Any] | None:
        """Return |G| in um by site, rows from the top; None if unknown.

        For a larger map each number is the largest of its sites, None if one of them is unknown.
        """
        message = self._map
        if message is None:
            return None
        try:
            error_map = to_model.error_map(message)
        except Exception:  # reported in the solver's health
            return None
        with np.errstate(over="ignore"):
            size = np.hypot(error_map.gx, error_map.gy) * UM_PER_M
        step = max(1, math.ceil(max(size.shape) / MOST_SITES))
        for axis in (0, 1):
            size = np.maximum.reduceat(
                size, np.arange(0, size.shape[axis], step), axis=axis
            )
        return {
            "run_id": message.run_id,
            "qualified": bool(message.qualified),
            "step": step,
            "um": [[_finite(value) for value in row] for row in size.T[::-1].tolist()],
        }


def _lines(texts: Iterable[str]) -> list[str]:
    return list(islice(texts, MOST_ENTRIES))


def _printable_texts(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {
            _printable_texts(key): _printable_texts(item) for key, item in value.items()
        }
    if isinstance(value, list):
        return [_printable_texts(item) for item in value]
    return value


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def plate_picture(
    artifact: Artifact,
    view: View,
    missing: Iterable[tuple[int, int]],
    n_missing: int,
    most: int,
) -> tuple[list[str], int]:
    """Return the plate in its own frame, top line first, and the number of marks per cell side.

    Of a list of marks each cell is a square, at least as wide as marks are apart.

    ``o`` read, ``.`` missing, ``?`` unknown, blank: not in this view. The worst of several marks
    is shown. Empty if nothing is known.

    Parameters
    ----------
    artifact : Artifact
        The plate.
    view : View
        Its pose.
    missing : iterable of (m, n)
        The first missing marks, in the order of m, then n.
    n_missing : int
        Number of missing marks, possibly more than `missing`.
    most : int
        Largest number of cells per side.
    """
    first, count = mark_rows(artifact, view)
    named = sorted(missing)
    if not count.any() or (n_missing > 0 and not named):
        return [], 1
    i, j = map(np.arange, artifact.shape)
    m = artifact.marks_at(i, i)[0][:, None]
    n = artifact.marks_at(j, j)[1]
    signs = ((n >= first[:, None]) & (n < (first + count)[:, None])).astype(np.int8)
    if n_missing > len(named):  # marks after the last named one are unknown
        signs[
            (signs > 0)
            & ((m > named[-1][0]) | ((m == named[-1][0]) & (n > named[-1][1])))
        ] = 2
    for mark in named:
        has_mark = artifact.has(*map(np.array, mark))
        index = artifact.index(*map(np.array, mark))
        if has_mark and signs[index]:
            signs[index] = 3
    signs, step = _squares(signs, artifact, most)
    for axis in (0, 1):
        signs = np.maximum.reduceat(
            signs, np.arange(0, signs.shape[axis], step), axis=axis
        )
    return ["".join(row) for row in np.array(list(" o?."))[signs].T[::-1]], step


def _squares(
    signs: np.ndarray, artifact: Artifact, most: int
) -> tuple[np.ndarray, int]:
    """Return the signs of marks by their places, the largest in each square, and marks a side."""
    if artifact.marks is None:
        return signs, max(1, ceil(max(artifact.shape) / most))
    size = np.minimum(np.ceil(2 * np.array(artifact.reach)).astype(int) + 1, most)
    low, high = (
        ends(artifact.marks.places_m, axis=1)[:, None] for ends in (np.min, np.max)
    )
    part = (artifact.marks.places_m - low) / (high - low)
    out = np.zeros(size, dtype=np.int8)
    np.maximum.at(
        out, tuple(np.rint(part * (size[:, None] - 1)).astype(int)), signs[:, 0]
    )
    return out, 1
