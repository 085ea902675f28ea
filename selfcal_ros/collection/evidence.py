# SPDX-License-Identifier: Apache-2.0
"""The detections of a session with the stage at their exposures, as evidence of what is wrong."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.collection.diagnosis import (
    AT_LEAST,
    MOST,
    PLACED,
    Evidence,
    RejectionFinding,
    Span,
    diagnose,
    main_reason,
    wrong_joints,
)
from selfcal_ros.collection.expected import mark_rows
from selfcal_ros.collection.exposures import Exposures
from selfcal_ros.collection.inputs import REMEDY, Kind, Reason
from selfcal_ros.collection.lateness import Lag, lag_of
from selfcal_ros.collection.marks.identify import IdentityRules
from selfcal_ros.collection.marks.seen_poses import (
    NamedMarks,
    SeenPose,
    mirrored_alike,
    seen_poses,
    texts,
)
from selfcal_ros.collection.marks.stops import places_of_cells
from selfcal_ros.collection.reduce import UnnamedImages
from selfcal_ros.estimation.checks.placing import Misplaced
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import Sense, ViewReadings
from selfcal_ros.model.view import View

FAR_M = 1e9
"""Distance beyond which a number is not a place, whatever its unit."""
A_ROW = 0.25
"""Detections of a row of the plate, as a part of those of the row with most of them."""
LOOKED_AT = 2000
"""Number of the last detections of a view whose stage positions are examined."""
RESTS_LOOKED_AT = 100
"""The same for when the stage rests at their marks."""


@dataclass(frozen=True)
class EncoderFacts:
    """Summary of the encoder messages.

    Attributes
    ----------
    names : dict
        Axis -> name of its joint.
    sampled : dict
        Axis -> whether it has samples.
    foreign : tuple of str
        Other joint names received.
    span_ns : tuple of int or None
        First and last stamp.
    step_s, max_gap_s : float
        Usual time between samples of x, NaN if unknown, and the largest allowed.
    """

    names: Mapping[str, str]
    sampled: Mapping[str, bool]
    foreign: tuple[str, ...]
    span_ns: Span
    step_s: float
    max_gap_s: float


@dataclass(frozen=True)
class DetectionsSeen:
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
        Returns the `EncoderFacts`; called only if there is a fault.
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

    def of_last(
        self, index: int, readings: ViewReadings, rejected: Mapping[str, int]
    ) -> RejectionFinding | None:
        """Return why the last detections of a view were rejected, none of which was used."""
        marks, late = {}, ""
        if rejected.keys() & set(PLACED):
            marks = self._named({index: readings})
            late = str(self._lag({index: readings}) or "")
        return diagnose(
            self._evidence(
                rejected, 0, marks, joints=False, lies="", late=late, view=index
            )
        )

    def findings(
        self, views: Mapping[int, ViewReadings], loose: Mapping[str, int]
    ) -> dict[int | None, RejectionFinding]:
        """Return why most detections of the session (key None), or of single views, were rejected.

        Ids of a plate of another size are named for the session if they are most of those rejected.

        Parameters
        ----------
        views : dict
            view_index -> readings.
        loose : dict
            Reason -> detections that belong to no view.
        """
        rejected = Counter(loose)
        for readings in views.values():
            rejected.update(readings.rejected)
        used = sum(readings.used for readings in views.values())
        size = self._other_size(views, rejected, used)
        if size is not None:
            return {None: size}
        marks = self._named(views) if rejected.keys() & set(PLACED) else {}
        limit = self.rules.stage_limit_m(self.artifact) / self.artifact.grid_pitch_m
        poses = seen_poses(marks, limit, self.rules.max_rotation_rad)
        images = self._unnamed(views, marks) if rejected.keys() & set(PLACED) else {}
        poses |= self._poses_of(images)
        faults = texts(poses)
        joints = not any(pose.planned for pose in poses.values())
        session = self._evidence(
            rejected,
            used,
            marks,
            joints=joints,
            lies=faults.get(next(iter(views)), "")
            if len(views) == 1
            else mirrored_alike(poses.values()),
        )
        of_views = [(view.rejected, view.used) for view in views.values()]
        if any(
            main_reason(*counts, placed=True)
            for counts in ((rejected, used), *of_views)
        ):
            late = _late_images(images.values())
            late = late or self._late(self._lag(views), poses, session)
            session = replace(session, late=late)
        finding = diagnose(session)
        named: dict[int | None, RejectionFinding] = {}
        for index, readings in views.items():
            of_view = diagnose(
                self._evidence(
                    readings.rejected,
                    readings.used,
                    {index: marks[index]} if index in marks else {},
                    joints=joints and not faults,
                    lies=faults.get(index, ""),
                    late=session.late,
                    view=index,
                )
            )
            if of_view is not None:
                named[index] = of_view
        if finding is None:
            return named
        all_alike = bool(session.lies or session.late) or (
            finding.reason in PLACED and joints and wrong_joints(session) is not None
        )
        views_lie_wrong = bool(faults.keys() & named.keys())
        return named if views_lie_wrong and not all_alike else {None: finding}

    def _unnamed(
        self, views: Mapping[int, ViewReadings], marks: Mapping[int, NamedMarks]
    ) -> dict[int, UnnamedImages]:
        """Return view_index -> images without ids."""
        return {
            index: UnnamedImages.of(
                self.artifact,
                readings.view,
                self.table[self.view_of == index],
                self.exposures,
                self.rules,
                self.sense,
            )
            for index, readings in views.items()
            if readings.view.image and readings.view.grid and index not in marks
        }

    def _poses_of(self, images: Mapping[int, UnnamedImages]) -> dict[int, SeenPose]:
        """Return view_index -> where images without ids show the plate, of views that show it."""
        poses = {}
        for index, of_view in images.items():
            shift = of_view.displacement()
            if shift is None:
                continue
            pose = of_view.view.on_stage(self.artifact)
            x, y = pose.shift
            lies = (round(x + shift.real, 1), round(y + shift.imag, 1))
            as_planned = Misplaced.of(of_view.view.name, pose, pose)
            poses[index] = SeenPose(
                replace(as_planned, found_shift=lies),
                planned=not shift,
                mirrored=False,
                named=False,
            )
        return poses

    def _lag(self, views: Mapping[int, ViewReadings]) -> Lag | None:
        """Return when the stage rests at the marks, if not at the stamps of detections."""
        stamped = []
        for index, readings in views.items():
            if not readings.view.grid:
                continue
            table = self.table[self.view_of == index]
            table = table[table["kind"] == Kind.GRID][-RESTS_LOOKED_AT:]
            named = table["has_id"] & self.artifact.has(table["m"], table["n"])
            view = readings.view
            x, y = view.on_stage(self.artifact).site_of(
                *self.artifact.places(
                    *(np.where(named, table[axis], 0) for axis in "mn")
                )
            )
            offset = np.stack([table["offset_x"], table["offset_y"]])
            sites = (x + 1j * y) * self.artifact.grid_pitch_m - _complex(
                places_of_cells(view, offset)
            )
            stamped.append(
                (table["stamp"], self.sense.sign * np.where(named, sites, np.nan))
            )
        limit_m = self.rules.stage_limit_m(self.artifact)
        return lag_of(stamped, self.exposures, limit_m)

    def _late(
        self, lag: Lag | None, poses: Mapping[int, SeenPose], evidence: Evidence
    ) -> str:
        """Return what a lag says, unless the pose of a plate or the joints explain more."""
        wrong = [pose.explained for pose in poses.values() if not pose.planned]
        if lag is None or lag.explained <= max(wrong, default=0.0):
            return ""
        if lag.varies and (wrong or (evidence.joints and wrong_joints(evidence))):
            return ""
        return str(lag)

    def _other_size(
        self, views: Mapping[int, ViewReadings], rejected: Mapping[str, int], used: int
    ) -> RejectionFinding | None:
        """Return that the ids are those of a plate with more or fewer rows; None if not."""
        unknown = rejected.get(Reason.UNKNOWN_MARK, 0)
        bad = sum(count for reason, count in rejected.items() if reason in REMEDY)
        plate = self.artifact
        outside = unknown >= AT_LEAST and unknown > MOST * bad
        rows_planned = _planned_marks(
            plate, [view.view for view in views.values() if view.view.grid]
        )
        cells = [cell for view in views.values() for cell in view.parts]
        unread = [
            asked_rows.difference(
                *(np.unique(getattr(cell, axis)).tolist() for cell in cells)
            )
            for axis, asked_rows in zip("mn", rows_planned, strict=True)
        ]
        if plate.marks is not None or not (outside or any(unread)):
            return None
        seen_rows = self._seen_rows(rows_planned)
        if not all(
            rows and max(rows) - min(rows) + 1 == len(rows) for rows in seen_rows
        ):
            return None
        sides, planned = (tuple(map(len, rows)) for rows in (seen_rows, rows_planned))
        on_plate = all(
            low <= min(rows) and max(rows) <= high
            for rows, (low, high) in zip(seen_rows, plate.limits, strict=True)
        )
        if sides == planned or outside is on_plate:
            return None
        m, n = (f"{min(rows)} to {max(rows)}" for rows in seen_rows)
        nx, ny = plate.shape
        exchanged = " (the sides are exchanged)" if sides == (ny, nx) else ""
        return RejectionFinding(
            Reason.UNKNOWN_MARK,
            unknown,
            used + bad,
            f"the ids are those of {sides[0]} x {sides[1]} marks (m {m}, n {n}), not of "
            f"{nx} x {ny}{exchanged}; correct grid_size in the plan, or the ids",
        )

    def _seen_rows(self, planned: Iterable[set[int]]) -> list[set[int]]:
        """Return the rows of marks along m and n that the ids tell, gaps included."""
        named = (
            (self.table["kind"] == Kind.GRID)
            & self.table["has_id"]
            & (self.view_of >= 0)
        )
        view_of = self.view_of[named]
        seen = [
            _rows(self.table[axis][named], view_of, limits)
            for axis, limits in zip("mn", self.artifact.limits, strict=True)
        ]
        if len(np.unique(view_of)) < 2:  # rows that are missing may follow
            return [rows | asked for rows, asked in zip(seen, planned, strict=True)]
        return seen

    def _evidence(
        self,
        rejected: Mapping[str, int],
        used: int,
        marks: Mapping[int, NamedMarks],
        *,
        joints: bool,
        lies: str,
        late: str = "",
        view: int | None = None,
    ) -> Evidence:
        """Return the facts on a view, or on all."""
        of_view = (
            np.ones(len(self.table), dtype=bool)
            if view is None
            else self.view_of == view
        )
        table = self.table[of_view]
        encoder = self.encoder()
        kinds = {"x": Kind.GRID, "y": Kind.GRID, "theta": Kind.ANGULAR}
        missing = tuple(
            encoder.names[axis]
            for axis, kind in kinds.items()
            if not encoder.sampled[axis] and (table["kind"] == kind).any()
        )
        came = (
            *(name for axis, name in encoder.names.items() if encoder.sampled[axis]),
            *encoder.foreign,
        )
        return Evidence(
            rejected,
            used,
            missing,
            seen_joints=came,
            detections_ns=_span(table["stamp"]),
            encoder_ns=encoder.span_ns,
            commands_ns=self.commands_ns,
            encoder_step_s=encoder.step_s,
            max_gap_s=encoder.max_gap_s,
            marks=tuple(marks.values()),
            pitch_m=self.artifact.grid_pitch_m,
            limit_m=self.rules.stage_limit_m(self.artifact),
            sense=self.sense,
            lies=lies,
            joints=joints,
            late=late,
        )

    def _named(self, views: Mapping[int, ViewReadings]) -> dict[int, NamedMarks]:
        """Return view_index -> the last of its marks with ids, as `sense` has them."""
        named_marks = {}
        pitch = self.artifact.grid_pitch_m
        for index, readings in views.items():
            table = self.table[np.flatnonzero(self.view_of == index)[-LOOKED_AT:]]
            stage = self.exposures.at(table["stamp"])
            where = stage.x.position + 1j * stage.y.position
            good = (
                (table["kind"] == Kind.GRID) & table["has_id"] & (np.abs(where) < FAR_M)
            )
            good &= np.hypot(table["offset_x"], table["offset_y"]) < FAR_M
            good &= self.artifact.has(table["m"], table["n"])
            if not (good.any() and readings.view.grid):
                continue
            x, y = self.artifact.places(table["m"][good], table["n"][good])
            offset = np.stack([table["offset_x"][good], table["offset_y"][good]])
            cells = places_of_cells(readings.view, offset)
            named_marks[index] = NamedMarks(
                view=readings.view.name,
                pose=readings.view.on_stage(self.artifact),
                marks=x + 1j * y,
                stage=self.sense.sign * where[good] / pitch,
                cells=_complex(cells) / pitch,
                offsets=_complex(offset - cells) / pitch,
                listed=self.artifact.marks is not None,
            )
        return named_marks


def _late_images(images: Iterable[UnnamedImages]) -> str:
    """Return of which other exposures images are, and the remedy; empty if of none."""
    for of_view in images:
        late, seconds = of_view.late()
        if late:
            side = "before" if late > 0 else "after"
            exposures = "exposure" if abs(late) == 1 else "exposures"
            return (
                f"each image was taken {abs(late)} {exposures} {side} its stamp, about "
                f"{seconds:.2g} s, as the marks that it lacks at the edges of the plate show; "
                "stamp the image of each exposure with its own instant, and read none that "
                "the camera kept"
            )
    return ""


def _rows(ids: np.ndarray, view_of: np.ndarray, limits: tuple[int, int]) -> set[int]:
    """Return the ids that are rows: on the plate in any view, beyond it in most of the views.

    A row has many detections; few are mistakes.
    """
    views: Counter[int] = Counter()
    numbers = np.unique(view_of)
    for view in numbers:
        values, counts = np.unique(ids[view_of == view], return_counts=True)
        views.update(values[counts > A_ROW * counts.max()].tolist())
    return {
        row
        for row, count in views.items()
        if limits[0] <= row <= limits[1] or count > len(numbers) / 2
    }


def _planned_marks(
    artifact: Artifact, views: Iterable[View]
) -> tuple[set[int], set[int]]:
    """Return the m, and the n, of the marks that views ask for."""
    m, n = set(), set()
    for view in views:
        first, count = mark_rows(artifact, view)
        some = count > 0
        m |= set((np.flatnonzero(some) - artifact.middle[0]).tolist())
        n |= set(
            range(first[some].min(), (first + count)[some].max()) if some.any() else ()
        )
    return m, n


def _complex(values: np.ndarray) -> np.ndarray:
    return values[0] + 1j * values[1]


def _span(stamps_ns: Iterable[int]) -> Span:
    stamps = np.asarray(stamps_ns)
    return (int(stamps.min()), int(stamps.max())) if len(stamps) else None
