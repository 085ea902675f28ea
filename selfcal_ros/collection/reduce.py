# SPDX-License-Identifier: Apache-2.0
"""From the detections of one view to its readings: a pure function of their set.

Rejected grid detections are kept with the position of the stage, which may indicate dirt.
"""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from selfcal_ros.collection.encoder import GOOD, MOVING, REASONS
from selfcal_ros.collection.exposures import Exposures, JointAt
from selfcal_ros.collection.inputs import LARGEST_OFFSET, Kind, Reason, good_sigmas
from selfcal_ros.collection.marks import identify, stops
from selfcal_ros.collection.marks.repeats import (
    Means,
    grid_visits,
    reduce_repeats,
    repeat_motion,
    without_turning,
)
from selfcal_ros.collection.marks.rigid import Rigid
from selfcal_ros.collection.marks.stops import without_aside
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.parts import RejectedAt
from selfcal_ros.model.pose import without_cell
from selfcal_ros.model.readings import RejectedPlaces, Sense, ViewReadings
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.view import View
from selfcal_ros.units import S_PER_NS


@dataclass(frozen=True)
class Rules:
    """All settings for the conversion of detections to readings."""

    sense: Sense
    identity: identify.IdentityRules
    min_score: float
    outlier_limit: float


class PlaceList:
    """Collects the rejected detections of a view with the indicated positions."""

    def __init__(self, before: RejectedPlaces | None = None) -> None:
        before = before or RejectedPlaces()
        self._reason = [np.array(before.reason, dtype=object)]
        self._at = [np.stack([before.x, before.y])]

    def add(self, reasons: np.ndarray, at_m: np.ndarray) -> None:
        """Take rejected detections: their reasons (D,) and positions (2, D) in m."""
        self._reason.append(reasons)
        self._at.append(at_m)

    def places(self) -> RejectedPlaces:
        """Return the positions; if more than `RejectedPlaces.MOST`, an even selection."""
        reason = np.concatenate(self._reason)
        at = np.concatenate(self._at, axis=1)
        if len(reason) > RejectedPlaces.MOST:
            chosen = (
                np.linspace(0, len(reason) - 1, RejectedPlaces.MOST).round().astype(int)
            )
            reason = reason[chosen]
            at = at[:, chosen]
        return RejectedPlaces(tuple(map(str, reason)), *at)


def canonical(detections: np.ndarray) -> np.ndarray:
    """Return the detections in canonical form, structured array (n,).

    Fields that a kind does not use are 0, and so are missing ids; -0.0 becomes 0.0.
    """
    d = detections.copy()
    grid, angular = d["kind"] == Kind.GRID, d["kind"] == Kind.ANGULAR
    for field, has_field in (
        ("offset_x", grid),
        ("offset_y", grid),
        ("offset_theta", angular),
    ):
        d[field] = np.where(has_field, d[field] + 0.0, 0.0)
    for field, has_field in (("m", grid), ("n", grid), ("k", angular)):
        d[field] *= has_field & d["has_id"]
    for field in ("sigma", "score"):
        d[field] += 0.0
    return d


def clean(
    detections: np.ndarray, rules: Rules, *, scored: bool
) -> tuple[np.ndarray, np.ndarray, Counter]:
    """Return usable detections, those of a low score, and how many were rejected for what reason.

    Both in canonical order, each once.

    Parameters
    ----------
    detections : structured array of `DETECTION`
        In any order, from `canonical`.
    rules : Rules
        Limits.
    scored : bool
        Whether scores are reported (any detection of the session has one above 0).
    """
    rejected: Counter = Counter()
    known_kind = (detections["kind"] == Kind.GRID) | (
        detections["kind"] == Kind.ANGULAR
    )
    rejected[Reason.UNKNOWN_KIND] = int((~known_kind).sum())
    d = _where(known_kind, detections)
    finite = d["sigma"] >= 0
    for field in ("offset_x", "offset_y", "offset_theta", "sigma", "score"):
        finite &= np.isfinite(d[field])
    rejected[Reason.NOT_FINITE] = int((~finite).sum())
    d = _where(finite, d)
    far = (np.abs(d["offset_x"]) > LARGEST_OFFSET) | (
        np.abs(d["offset_y"]) > LARGEST_OFFSET
    )
    rejected[Reason.TOO_FAR] = int(far.sum())
    d = _where(~far, d)
    unique = _canonical(d)
    rejected[Reason.DUPLICATE] += len(d) - len(unique)
    good = np.ones(len(unique), dtype=bool)
    for kind in Kind if unique["sigma"].any() else ():
        mine = unique["kind"] == kind
        good[mine] = good_sigmas(unique["sigma"][mine])
    rejected[Reason.BAD_SIGMA] = int((~good).sum())
    unique = _where(good, unique)
    low = unique[:0]
    if scored:
        below = unique["score"] < rules.min_score
        low = unique[below]
        unique = _where(~below, unique)
        rejected[Reason.LOW_SCORE] = len(low)
    return unique, low, +rejected


def with_low_scores(
    readings: ViewReadings, low: np.ndarray, exposures: Exposures
) -> ViewReadings:
    """Return `readings` with the positions of grid detections rejected for a low score."""
    low = low[low["kind"] == Kind.GRID]
    if not len(low):
        return readings
    stage = exposures.at(low["stamp"])
    places = PlaceList(readings.places)
    places.add(
        np.full(len(low), Reason.LOW_SCORE, dtype=object),
        np.stack([stage.x.position, stage.y.position]),
    )
    return replace(readings, places=places.places())


def _canonical(d: np.ndarray) -> np.ndarray:
    """Return the detections sorted by all fields, without duplicates: a faster `numpy.unique`."""
    step = np.diff(d["stamp"])
    if (step > 0).all():  # in order of arrival
        return d
    d = d[np.argsort(d["stamp"], kind="stable")]
    same_stamp = d["stamp"][1:] == d["stamp"][:-1]
    if not same_stamp.any():
        return d
    shares_stamp = np.append(same_stamp, False) | np.append(False, same_stamp)
    d = np.concatenate([d[~shares_stamp], np.unique(d[shares_stamp])])
    return d[np.argsort(d["stamp"], kind="stable")]


def reduce_view(
    artifact: Artifact,
    view: View,
    detections: np.ndarray,
    *,
    exposures: Exposures,
    rules: Rules,
) -> ViewReadings:
    """Return the readings of one view from its cleaned detections (see `clean`).

    `exposures` contain the stage at the instants of at least these detections.
    """
    rejected: Counter = Counter()
    places = PlaceList()
    grid = _where(detections["kind"] == Kind.GRID, detections)
    angular = _where(detections["kind"] == Kind.ANGULAR, detections)
    marks = _grid_marks(
        artifact,
        view,
        grid,
        exposures=exposures,
        rules=rules,
        rejected=rejected,
        places=places,
    )
    lines = _reduce_angular(
        artifact, view, angular, exposures, rules, rejected, marks.phi_rad
    )
    cells = []
    for number, sub in enumerate(view.sub_views):
        grid_fields = _reduce_grid(
            artifact, sub, marks.of_cell(number), rules, rejected, places
        )
        with_lines = lines if sub.cell in (None, (0, 0)) else {}
        cells.append(
            replace(
                ViewReadings(sub),
                **grid_fields,
                **with_lines,
                used=int(
                    grid_fields["count"].sum()
                    + (lines["count_theta"].sum() if with_lines else 0)
                ),
            )
        )
    readings = cells[0] if cells[0].view is view else _of_image(view, cells, lines)
    return replace(
        with_rejections(
            readings, dict(sorted((str(r), c) for r, c in rejected.items()))
        ),
        places=places.places(),
    )


def _of_image(view: View, cells: Sequence[ViewReadings], lines: dict) -> ViewReadings:
    """Return the readings of a view with images from those of its cells, and of its lines."""
    dof = sum(cell.dof_xy for cell in cells)
    squares = sum(cell.dof_xy * cell.sigma_xy**2 for cell in cells if cell.dof_xy)
    return replace(
        ViewReadings(view),
        **lines,
        cells=tuple(cells),
        dof_xy=dof,
        sigma_xy=float(np.sqrt(squares / dof)) if dof else float("nan"),
        used=sum(cell.used for cell in cells),
    )


def with_rejections(readings: ViewReadings, rejected: dict[str, int]) -> ViewReadings:
    """Return the readings of a view with its rejections; of an image, in the cell of the axis."""
    cells = tuple(
        replace(cell, rejected=rejected, places=readings.places)
        if cell.view.cell == (0, 0)
        else cell
        for cell in readings.cells
    )
    return replace(readings, rejected=rejected, cells=cells)


@dataclass(frozen=True)
class _GridMarks:
    """Grid detections whose marks are known: arrays (n,) and (2, n) in their order.

    `position` is that of the stage, `approach` its direction of approach; `phi_rad` is the view's
    rotation if known from the marks; `cell` is the index of the cell that shows the mark.
    """

    detections: np.ndarray
    index: np.ndarray
    deviation: np.ndarray
    residual: np.ndarray
    position: np.ndarray
    approach: np.ndarray
    phi_rad: float | None
    cell: np.ndarray

    def of_cell(self, number: int) -> "_GridMarks":
        """Return the detections in one cell of the image."""
        in_cell = self.cell == number
        if in_cell.all():
            return self
        columns: dict[str, Any] = {
            field.name: np.compress(in_cell, getattr(self, field.name), axis=-1)
            for field in fields(self)
            if field.name != "phi_rad"
        }
        return replace(self, **columns)


def _grid_marks(
    artifact: Artifact,
    view: View,
    d: np.ndarray,
    *,
    exposures: Exposures,
    rules: Rules,
    rejected: Counter,
    places: PlaceList,
) -> _GridMarks:
    """Identify the marks of grid detections; count the others, with the stage positions."""
    stage = exposures.at(d["stamp"])
    position = np.stack([stage.x.position, stage.y.position])
    why = _reasons((stage.x, stage.y), (stage.theta,))
    d, (position, approach) = _keep(
        d, why, rejected, position, stage.approach, places=places
    )
    assignment, number = _identified(artifact, view, d, position, rules)
    d, (position, index, deviation, residual, approach, number) = _keep(
        d,
        assignment.reasons,
        rejected,
        position,
        assignment.index,
        assignment.deviation,
        assignment.residual,
        approach,
        number,
        places=places,
    )
    quarter_line_rad = np.pi / 2 / max(artifact.angular_count, 1)
    phi_determined = assignment.phi_error_rad <= quarter_line_rad
    return _GridMarks(
        detections=d,
        index=index,
        deviation=deviation,
        residual=residual,
        position=position,
        approach=approach,
        phi_rad=assignment.rigid.phi_rad if phi_determined else None,
        cell=number,
    )


def _identified(
    artifact: Artifact, view: View, d: np.ndarray, position: np.ndarray, rules: Rules
) -> tuple[identify.MarkAssignment, np.ndarray]:
    """Return the marks of detections with the stage at `position` (2, n), and their cells (n,).

    Marks of a displaced plate are displaced in the image, and lie beside it without ids.
    """
    assignment, number = _identified_at(artifact, view, d, position, rules)
    if view.image is None or not np.isin(assignment.reasons, DISPLACED).any():
        return assignment, number
    offset = np.stack([d["offset_x"], d["offset_y"]])
    images = UnnamedImages(
        artifact,
        view,
        d,
        assignment.rigid,
        reading_m=_reading(rules.sense, position, offset),
        stage_m=_reading(rules.sense, position, 0.0),
    )
    if not d["has_id"].any() and images.exposures_late():
        assignment.reasons[:] = Reason.NOT_AT_MARK
        return assignment, number
    named = d["has_id"] & (assignment.reasons != Reason.UNKNOWN_MARK)
    marks = artifact.places(d["m"][named], d["n"][named])
    away = offset[:, named] + _reading(rules.sense, position[:, named], 0.0)
    away -= np.stack(view.on_stage(artifact).site_of(*marks)) * artifact.grid_pitch_m
    plate = (
        0j
        if named.any()
        else displacement(
            artifact, view, assignment.rigid, _reading(rules.sense, position, offset)
        )
    )
    tried = _identified_at(
        artifact,
        view,
        d,
        position,
        rules,
        plate=plate,
        shift=stops.shift_of(view, offset, away),
    )
    scaled = _identified_at(artifact, view, d, position, rules, of_cell=True)
    return (
        tried
        if plate
        else max(
            (assignment, number),
            scaled,
            tried,
            key=lambda attempt: _n_identified(attempt[0]),
        )
    )


DISPLACED = (
    Reason.OUTSIDE_IMAGE,
    Reason.NOT_AT_MARK,
    Reason.SEVERAL,
    Reason.TOO_FAR,
    Reason.NOT_IN_VIEW,
)
"""Reasons of rejection of marks in images of a displaced plate."""


def _n_identified(marks: identify.MarkAssignment) -> int:
    return int((marks.reasons == None).sum())  # noqa: E711


def displacement(
    artifact: Artifact, view: View, rigid: Rigid, reading_m: np.ndarray
) -> complex:
    """Return by how many whole pitches marks without ids lie beside the plate, stage frame."""
    rows = _rows_at(artifact, view, rigid, reading_m)
    return _on_stage(artifact, view, map(stops.middle_of, rows, artifact.shape))


@dataclass(frozen=True, eq=False)
class UnnamedImages:
    """Marks without ids of a view with images: where they and the stage are, (2, n), m."""

    artifact: Artifact
    view: View
    detections: np.ndarray
    rigid: Rigid
    reading_m: np.ndarray
    stage_m: np.ndarray

    @classmethod
    def of(
        cls,
        artifact: Artifact,
        view: View,
        detections: np.ndarray,
        exposures: Exposures,
        rules: identify.IdentityRules,
        sense: Sense,
    ) -> "UnnamedImages":
        """Return those of a view whose stage positions are known."""
        grid = detections[detections["kind"] == Kind.GRID]
        stage = exposures.at(grid["stamp"])
        usable = (stage.x.code == GOOD) & (stage.y.code == GOOD)
        position = np.stack([stage.x.position, stage.y.position])[:, usable]
        grid = grid[usable]
        offset = np.stack([grid["offset_x"], grid["offset_y"]])
        reading_m = _reading(sense, position, offset)
        marks = identify.identify_grid(
            artifact,
            view,
            reading_m,
            ids=np.zeros(reading_m.shape, dtype=np.int64),
            has_id=np.zeros(len(grid), dtype=bool),
            rules=rules,
        )
        stage_m = _reading(sense, position, 0.0)
        return cls(artifact, view, grid, marks.rigid, reading_m, stage_m)

    def displacement(self) -> complex | None:
        """Return by how many pitches they show the plate beside its place, stage frame.

        Of several places that where the images lack the fewest marks; None if marks are seen
        beside the plate at each.
        """
        if not len(self.detections):
            return None
        middles, beside = self._middles_seen()
        if 4 * max(self.artifact.shape) * beside > len(self.detections):
            return None
        whole = _on_stage(self.artifact, self.view, middles)
        part = complex(self.rigid.tx_m, self.rigid.ty_m) / self.artifact.grid_pitch_m
        return whole + (part if whole and abs(part) > NEARLY_WHOLE else 0)

    def late(self) -> tuple[int, float]:
        """Return by how many exposures, and s, they are late; 0 if they are not."""
        late = self.exposures_late()
        if not late:
            return 0, 0.0
        stamps = np.unique(self.detections["stamp"])
        by = abs(late)
        late_ns = np.median(stamps[by:] - stamps[: len(stamps) - by])
        return late, float(late_ns * S_PER_NS)

    def exposures_late(self) -> int:
        """Return by how many exposures they are late; 0 if they are not.

        Which cells show a mark tells at which stops near the edge of the plate an image was taken.
        """
        d, view = self.detections, self.view
        offset = np.stack([d["offset_x"], d["offset_y"]])
        number = stops.numbers_of(view, stops.cells_of(view, offset))
        _, first, image = np.unique(d["stamp"], return_index=True, return_inverse=True)
        if len(first) < LEAST_IMAGES:
            return 0
        seen = np.zeros((len(first), len(view.sub_views)), dtype=bool)
        seen[image[number >= 0], number[number >= 0]] = True
        at = self._rows(self.stage_m[:, first])

        def fitting(middles: Sequence[int], late: int = 0) -> float:
            expected = np.ones_like(seen)
            for row, side, middle, step in zip(
                at, self.artifact.shape, middles, self._steps, strict=True
            ):
                from_first = row[:, None] + np.array(step) - (middle - side // 2)
                expected &= (from_first >= 0) & (from_first < side)
            ends = slice(max(late, 0), len(seen) + min(late, 0))
            as_expected = seen == np.roll(expected, late, axis=0)
            return float(as_expected.all(axis=1)[ends].mean())

        planned = fitting((0, 0))
        if planned > ALL_FIT:
            return 0
        displaced = fitting(self._middles_seen()[0])
        by_late = {late: fitting((0, 0), late) for late in LATE_IMAGES}
        best = max(by_late, key=lambda late: by_late[late])
        return best if by_late[best] > max(displaced, planned) + CLEARLY else 0

    @property
    def _steps(self) -> tuple[tuple[int, ...], ...]:
        """Steps along m and n from the mark at the stage to that of each cell."""
        steps = (cell.step_on_plate(self.artifact) for cell in self.view.sub_views)
        return tuple(zip(*steps, strict=True))

    def _rows(self, places_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return _rows_at(self.artifact, self.view, self.rigid, places_m)

    def _middles_seen(self) -> tuple[list[int], int]:
        """Return where, m and n, they lack the fewest marks, and how many are beside it."""
        middles, most = [], 0
        for row, side, stage_row, step in zip(
            self._rows(self.reading_m),
            self.artifact.shape,
            self._rows(self.stage_m),
            self._steps,
            strict=True,
        ):
            visible = (
                int(stage_row.min()) + min(step),
                int(stage_row.max()) + max(step),
            )
            middle = stops.middle_of(row, side, visible=visible)
            first = middle - side // 2
            most = max(most, int(((row < first) | (row >= first + side)).sum()))
            middles.append(middle)
        return middles, most


LEAST_IMAGES = 20
"""Images that show whether they are late."""
LATE_IMAGES = (1, -1, 2, -2, 3, -3)
"""Exposures by which images may be late: a camera gives the one before."""
ALL_FIT, CLEARLY = 0.95, 0.05
"""Part of the images that fit the stops of their stamps from which none is late, and how many more
fit the stops of other stamps if they are. Marks that are not detected lessen both."""
NEARLY_WHOLE = 0.25
"""Part of a pitch up to which a plate is said to lie at a whole one."""


def _rows_at(
    artifact: Artifact, view: View, rigid: Rigid, places_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return m and n of the marks, of a lattice without an edge, at places (2, n) on the stage."""
    pose = view.on_stage(artifact)
    pitch = artifact.grid_pitch_m
    centred = places_m - np.array(pose.shift)[:, None] * pitch
    return artifact.nearest(*pose.turned_back(*(rigid.undo(centred) / pitch)))


def _on_stage(artifact: Artifact, view: View, steps: Iterable[int]) -> complex:
    """Return steps along m and n as x + iy in the stage frame."""
    columns = (np.array([float(step)]) for step in steps)
    x, y = view.on_stage(artifact).turned(*columns)
    return complex(x[0], y[0])


def _identified_at(
    artifact: Artifact,
    view: View,
    d: np.ndarray,
    position: np.ndarray,
    rules: Rules,
    *,
    shift: complex = 0j,
    plate: complex = 0j,
    of_cell: bool = False,
) -> tuple[identify.MarkAssignment, np.ndarray]:
    """Return marks and cells with a displacement of the image, cells, and of the plate, pitches."""
    offset = np.stack([d["offset_x"], d["offset_y"]])
    number = stops.numbers_of(view, stops.cells_of(view, offset, shift))
    cell_places_m = stops.places_of_cells(view, offset, shift)
    away = np.array([[plate.real], [plate.imag]]) * artifact.grid_pitch_m + (
        stops.middles(view, number, offset - cell_places_m) if of_cell else 0.0
    )
    assignment = identify.identify_grid(
        artifact,
        view,
        _reading(rules.sense, position, offset) - away,
        ids=np.stack([d["m"], d["n"]]),
        has_id=d["has_id"],
        rules=rules.identity,
        stage_m=_reading(rules.sense, position, cell_places_m),
        beside_m=cell_places_m if view.image else None,
    )
    assignment = replace(assignment, deviation=assignment.deviation + away)
    assignment.reasons[number < 0] = Reason.OUTSIDE_IMAGE
    if view.image is None:
        assignment.reasons[_beside_a_nearer(d, assignment)] = Reason.SEVERAL
        astray = assignment.reasons == Reason.NOT_AT_MARK
        astray &= np.isin(d["stamp"], d["stamp"][assignment.reasons == None])  # noqa: E711
        assignment.reasons[astray] = Reason.SEVERAL
    return assignment, number


def _beside_a_nearer(d: np.ndarray, assignment: identify.MarkAssignment) -> np.ndarray:
    """Return the accepted detections whose exposure shows a mark nearer to the stage, int (k,).

    Marks of a list lie closer together than the stage may stand beside the site of one.
    """
    accepted = np.flatnonzero(assignment.reasons == None)  # noqa: E711
    if (np.diff(d["stamp"][accepted]) > 0).all():
        return accepted[:0]
    away = (
        assignment.deviation[:, accepted]
        - np.stack([d["offset_x"], d["offset_y"]])[:, accepted]
    )
    order = accepted[np.lexsort((np.hypot(*away), d["stamp"][accepted]))]
    _, first, exposure = np.unique(
        d["stamp"][order], return_index=True, return_inverse=True
    )
    nearest = assignment.index[:, order[first[exposure]]]
    return order[(assignment.index[:, order] != nearest).any(axis=0)]


def _reduce_grid(
    artifact: Artifact,
    view: View,
    marks: _GridMarks,
    rules: Rules,
    rejected: Counter,
    places: PlaceList,
) -> dict:
    """Return the grid readings of a view, or of a sub-view: offsets from the place of its cell."""
    d = marks.detections
    key = artifact.flat(*marks.index)
    offset = np.stack(
        [d["offset_x"] - view.cell_m.real, d["offset_y"] - view.cell_m.imag]
    )
    means = reduce_repeats(
        key,
        marks.deviation,
        d["sigma"],
        limit=rules.outlier_limit,
        extent=2 * max(artifact.reach) * artifact.grid_pitch_m,
        residual=marks.residual,
        steady=without_aside(key, marks.deviation, offset, view.check_offset_m),
    )
    _count(rejected, Reason.OUTLIER, means.outlier)
    out = np.flatnonzero(means.outlier)
    places.add(np.full(len(out), Reason.OUTLIER, dtype=object), marks.position[:, out])
    visits = grid_visits(
        means,
        key,
        d["sigma"],
        stamps_ns=d["stamp"],
        deviation=marks.deviation,
        offset=offset,
        approach=marks.approach,
        step_m=view.check_offset_m / 2 or np.inf,
    )
    motion = (
        None
        if view.cell not in (None, (0, 0))
        else repeat_motion(  # the same in every cell
            key, _reading(rules.sense, marks.position, 0.0), offset, means.outlier
        )
    )
    m, n = artifact.marks_at(*np.divmod(means.key.astype(np.int64), artifact.shape[1]))
    return {
        "m": m,
        "n": n,
        "dx": means.mean[0],
        "dy": means.mean[1],
        "count": means.count,
        "u": means.u,
        "sigma_xy": means.sigma,
        "dof_xy": means.dof,
        "visits": visits,
        "motion": motion,
        "outliers": _outliers_of(means, key),
    }


def _reduce_angular(
    artifact: Artifact,
    view: View,
    d: np.ndarray,
    exposures: Exposures,
    rules: Rules,
    rejected: Counter,
    phi: float | None,
) -> dict:
    stage = exposures.at(d["stamp"])
    why = _reasons((stage.theta,), (stage.x, stage.y))
    # an offset beyond half a turn is invalid, though it may wrap to a small one
    why[(why == None) & (np.abs(d["offset_theta"]) > np.pi)] = Reason.TOO_FAR  # noqa: E711
    d, (theta,) = _keep(d, why, rejected, stage.theta.position)
    assignment = identify.identify_angular(
        artifact,
        view,
        _reading(rules.sense, theta, d["offset_theta"]),
        ids=d["k"],
        has_id=d["has_id"],
        rules=rules.identity,
        phi_rad=phi,
    )
    d, (k, v, residual) = _keep(
        d,
        assignment.reasons,
        rejected,
        assignment.index,
        assignment.deviation,
        assignment.residual,
    )
    means = reduce_repeats(
        k,
        v[None],
        d["sigma"],
        limit=rules.outlier_limit,
        extent=4 * np.pi,
        residual=residual[None],
    )
    _count(rejected, Reason.OUTLIER, means.outlier)
    means = without_turning(means, k, v[None], sigma=d["sigma"])
    # of the axis relative to the line, without full turns
    place = identify.wrap(v - d["offset_theta"])
    motion = repeat_motion(k, place[None], d["offset_theta"][None], means.outlier)
    about = place[~means.outlier].mean() if len(means.key) else 0.0
    return {
        "k": means.key.astype(np.int64),
        "dtheta": means.mean[0],
        "count_theta": means.count,
        "u_theta": means.u,
        "sigma_theta": means.sigma,
        "dof_theta": means.dof,
        "motion_theta": motion,
        "outliers_theta": _outliers_of(means, k),
        "axis_theta": float(about),
    }


def _outliers_of(means: Means, key: np.ndarray) -> np.ndarray:
    """Return the number of outliers of each mark with a mean, int array."""
    marks = np.append(means.key, -1)
    place = np.searchsorted(means.key, key[means.outlier])
    place = place[marks[place] == key[means.outlier]]
    return np.bincount(place, minlength=len(means.key))


def _reading(
    sense: Sense, position: np.ndarray, offset: np.ndarray | float
) -> np.ndarray:
    """Return the position of the mark, for a moving microscope or a moving plate (method 1)."""
    return offset - position if sense is Sense.PLATE_MOVES else position + offset


def _reasons(needed: Sequence[JointAt], still: Sequence[JointAt]) -> np.ndarray:
    """Return the first reason of each detection, or None: each counts once.

    The position of `needed` joints must be known, those of `still` must not move.
    """
    codes = needed[0].code
    for joint in needed[1:]:
        codes = np.where(codes == GOOD, joint.code, codes)
    for joint in still:
        codes = np.where((codes == GOOD) & joint.moving, MOVING, codes)
    return REASONS[codes]


def _where(good: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return some of the rows; all of them without a copy."""
    return rows if good.all() else rows[good]


def _keep(
    d: np.ndarray,
    reasons: np.ndarray,
    rejected: Counter,
    *values: np.ndarray,
    places: PlaceList | None = None,
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return detections and values (n,) or (k, n) without the rejected ones, which are counted.

    Their stage positions, the first of the values, go to `places`.
    """
    good = reasons == None  # noqa: E711
    if good.all():
        return d, [*values]
    rejected.update(str(reason) for reason in reasons[~good])
    if places is not None:
        places.add(reasons[~good], values[0][:, ~good])
    return d[good], [np.compress(good, value, axis=-1) for value in values]


def _count(rejected: Counter, reason: Reason, mask: np.ndarray) -> None:
    if mask.any():
        rejected[str(reason)] += int(mask.sum())


def with_collected(
    result: CalibrationResult, views: Iterable[ViewReadings]
) -> CalibrationResult:
    """Return the result with what the readings do not show: places of rejections, turned lines."""
    views = tuple(views)
    rejected_at = tuple(
        RejectedAt(
            view.view.name,
            tuple(view.places.reason),
            view.places.x.round(6),
            view.places.y.round(6),
        )
        for view in views
        if view.places.reason
    )
    turned = tuple(
        without_cell(view.view.name) for view in views if view.is_without_turning
    )
    parts = replace(
        result.parts, rejected_at=rejected_at or None, turned=turned or None
    )
    return replace(result, parts=parts)
