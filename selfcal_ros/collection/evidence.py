# SPDX-License-Identifier: Apache-2.0
"""What is known of the detections of a session, gathered for its diagnosis."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.diagnosis import Evidence, Finding, Span, diagnose, main_reason
from selfcal_ros.collection.inputs import Kind
from selfcal_ros.collection.marks.identify import IdentityRules
from selfcal_ros.collection.stage.exposures import Exposures
from selfcal_ros.estimation.checks.placing import Misplaced, other_poses, said
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense, ViewReadings
from selfcal_ros.model.view import View

LOOKED_AT = 2000
"""Detections whose stage positions are looked at, the last of them."""


@dataclass(frozen=True)
class EncoderFacts:
    """What came of the encoder.

    Attributes
    ----------
    names : dict
        Axis -> name of its joint.
    sampled : dict
        Axis -> whether it has samples.
    foreign : tuple of str
        Other joint names that came.
    span_ns : tuple of int or None
        First and last stamp.
    step_s, max_gap_s : float
        Usual time between samples of x, NaN if not known, and the largest allowed.
    """

    names: Mapping[str, str]
    sampled: Mapping[str, bool]
    foreign: tuple[str, ...]
    span_ns: Span
    step_s: float
    max_gap_s: float


@dataclass(frozen=True)
class Seen:
    """All detections of a session with the stage at their exposures.

    Attributes
    ----------
    table : structured array of `reduce.DETECTION`
        The detections.
    view_of : int array
        View of each, -1 for none.
    exposures : Exposures
        The stage at their instants.
    encoder : callable
        Returns what came of the encoder, `EncoderFacts`: asked only where something is amiss.
    commands_ns : tuple of int
        First and last stamp of the commands.
    artifact : Artifact
        The plate.
    rules : IdentityRules
        Limits of identification.
    sense : Sense
        Sense of measurement.
    """

    table: np.ndarray
    view_of: np.ndarray
    exposures: Exposures
    encoder: Callable[[], EncoderFacts]
    commands_ns: Span
    artifact: Artifact
    rules: IdentityRules
    sense: Sense

    def findings(self, views: Mapping[int, ViewReadings], loose: Mapping[str, int],
                 ) -> dict[int | None, Finding]:
        """Return what spoilt most detections of the session (key None), else of single views.

        Parameters
        ----------
        views : dict
            view_index -> readings.
        loose : dict
            Reason -> detections that belong to no view.
        """
        rejected = dict(loose)
        for readings in views.values():
            for reason, count in readings.rejected.items():
                rejected[reason] = rejected.get(reason, 0) + count
        used = sum(readings.used for readings in views.values())
        whole = self._finding(rejected, used, views, whole=True)
        if whole is not None:
            return {None: whole}
        found = {index: self._finding(readings.rejected, readings.used, {index: readings})
                 for index, readings in views.items()}
        return {index: finding for index, finding in found.items() if finding is not None}

    def _finding(self, rejected: Mapping[str, int], used: int,
                 views: Mapping[int, ViewReadings], *, whole: bool = False) -> Finding | None:
        if main_reason(rejected, used) is None:
            return None
        here = np.isin(self.view_of, list(views))
        rows = np.flatnonzero(here if here.any() else np.ones(len(here), dtype=bool))
        table, encoder = self.table[rows], self.encoder()
        kinds = {"x": Kind.GRID, "y": Kind.GRID, "theta": Kind.ANGULAR}
        missing = tuple(encoder.names[axis] for axis, kind in kinds.items()
                        if not encoder.sampled[axis] and (table["kind"] == kind).any())
        stage, site = self._stage_and_sites(rows[-LOOKED_AT:], views)
        # where all views are spoilt the sense may be wrong: it looks like half a turn
        lies = "" if whole else self._lies(rows[-LOOKED_AT:], views)
        return diagnose(Evidence(
            rejected, used, missing, encoder.foreign, _span(table["stamp"]), encoder.span_ns,
            self.commands_ns, encoder.step_s, encoder.max_gap_s, stage, site,
            self.artifact.grid_pitch_m, self.rules.stage_limit_m(self.artifact), self.sense, lies))

    def _lies(self, rows: np.ndarray, views: Mapping[int, ViewReadings]) -> str:
        """Return how the plate of a view lies, if its marks are where another pose has them."""
        ((_, readings),) = views.items()
        table, view = self.table[rows], readings.view
        if not _on_lattice(self.artifact, view):
            return ""
        stage, limit = self.exposures.at(table["stamp"]), self.rules.stage_limit_m(self.artifact)
        where = np.stack([stage.x.position, stage.y.position])
        where *= -1 if self.sense is Sense.PLATE_MOVES else 1
        good = (table["kind"] == Kind.GRID) & table["has_id"] & np.isfinite(where).all(axis=0)
        pose = view.lattice_pose(self.artifact)
        away = []
        for other in (pose, *other_poses(pose)):
            site = np.stack(other.site_of(table["m"], table["n"])) * self.artifact.grid_pitch_m
            away.append(np.quantile(np.hypot(*(where - site))[good], 0.9) if good.any() else np.inf)
        best = int(np.argmin(away))
        if not best or away[best] > limit:
            return ""
        error = said(Misplaced.of(view.name, pose, [*other_poses(pose)][best - 1]))
        return f"{error.what}; {error.remedy}"

    def _stage_and_sites(self, rows: np.ndarray, views: Mapping[int, ViewReadings],
                         ) -> tuple[np.ndarray, np.ndarray]:
        """Return indicated positions and sites, both (2, n), of grid marks with ids."""
        table, view_of = self.table[rows], self.view_of[rows]
        (hx, hy), pitch = self.artifact.half, self.artifact.grid_pitch_m
        stage = self.exposures.at(table["stamp"])
        where = np.stack([stage.x.position, stage.y.position])
        good = (table["kind"] == Kind.GRID) & table["has_id"] & np.isfinite(where).all(axis=0)
        good &= (np.abs(table["m"]) <= hx) & (np.abs(table["n"]) <= hy)
        parts = [np.zeros((4, 0))]
        for index, readings in views.items():
            here = good & (view_of == index)
            if here.any() and _on_lattice(self.artifact, readings.view):
                pose = readings.view.lattice_pose(self.artifact)
                site = np.stack(pose.site_of(table["m"][here], table["n"][here])) * pitch
                parts.append(np.concatenate([where[:, here], site]))
        both = np.concatenate(parts, axis=1)
        return both[:2], both[2:]


def _on_lattice(artifact: Artifact, view: View) -> bool:
    return view.grid and view.lattice_pose(artifact).quarter_turns is not None


def _span(stamps_ns: Iterable[int]) -> Span:
    stamps = np.asarray(stamps_ns)
    return (int(stamps.min()), int(stamps.max())) if len(stamps) else None
