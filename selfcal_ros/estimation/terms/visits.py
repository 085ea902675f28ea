# SPDX-License-Identifier: Apache-2.0
"""Inputs of the term columns: visits of each grid view, their approach, poses of the plate.

For the map, the mean over the visits of a mark is as good as the visits themselves. The scatter of
the visits of one mark about their mean determines terms that differ between them, and the noise.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from selfcal_ros.blocks import block_of, blocks
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.lattice.maps import maps_of
from selfcal_ros.estimation.lattice.readings import GridData
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.pose import Pose
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.terms import DRIFT_DEGREE
from selfcal_ros.model.view import placings_of

FARTHEST_M = 1e6
"""Largest valid deviation or offset of a visit."""


@dataclass(frozen=True, eq=False)
class ViewVisits:
    """Visits of one grid view; arrays (V,).

    Attributes
    ----------
    mark : int array
        Flat index of the mark on the plate's lattice.
    weight : float array
        Weight of each visit; the visits of a mark add up to the weight of its mean.
    y : complex array
        Deviation in the plate frame, m.
    time : float array
        Instant in the view's time, -1 at its first visit and +1 at its last.
    offset : complex array
        Offset measured by the microscope, stage axes, m.
    approach_x, approach_y : float array
        Sign of the last motion of each stage axis; 0 = unknown.
    phase : complex
        i^-q: from the stage frame to the plate frame.
    frame : complex
        Part of it that turns the nominal plate frame to that of the plate as it lies.
    """

    mark: np.ndarray
    weight: np.ndarray
    y: np.ndarray
    time: np.ndarray
    offset: np.ndarray
    approach_x: np.ndarray
    approach_y: np.ndarray
    phase: complex
    frame: complex = 1.0

    def means(self, values: np.ndarray, n_marks: int) -> np.ndarray:
        """Return the weighted mean of complex values (k, V) at each mark, (k, marks)."""
        out = np.zeros((len(values), n_marks), dtype=complex)
        if not self.repeated:
            out[:, self.mark] = values
            return out
        for row, value in zip(out, values, strict=True):
            row.real = np.bincount(self.mark, self._relative * value.real, n_marks)
            row.imag = np.bincount(self.mark, self._relative * value.imag, n_marks)
        return out

    @cached_property
    def _relative(self) -> np.ndarray:
        """Weights that add up to 1 over the visits of each mark, (V,).

        Those of a mark that does not count, as one that is not known in a recheck, are equal.
        """
        unused = np.bincount(self.mark, self.weight)[self.mark] == 0
        weight = np.where(unused, 1.0, self.weight)
        return weight / np.bincount(self.mark, weight)[self.mark]

    @cached_property
    def repeated(self) -> bool:
        """Whether a mark was visited more than once; if not, its visit is its mean."""
        return bool(len(self.mark)) and int(np.bincount(self.mark).max()) > 1

    @property
    def n_repeats(self) -> int:
        """Number of visits beyond the first of each mark."""
        return len(self.mark) - len(np.unique(self.mark))

    def about_means(self, values: np.ndarray, n_marks: int) -> np.ndarray:
        """Return complex values (k, V) minus the mean of their mark."""
        if not self.repeated:
            return np.zeros_like(values, dtype=complex)
        return values - self.means(values, n_marks)[:, self.mark]


def squares_within(visits: Iterable[ViewVisits | None]) -> float:
    """Return the weighted squares of deviations about the means of their marks, m^2."""
    total = 0.0
    for view in visits:
        if view is not None and view.repeated:
            deviations = view.about_means(view.y[None], 1 + int(view.mark.max()))[0]
            total += float(view.weight @ np.abs(deviations) ** 2)
    return total


def time_ranges(
    views: Iterable[ViewReadings], placings: Iterable[int]
) -> dict[int, tuple[int, int]]:
    """Return the first and the last instant of each placing, ns, that has visits."""
    out: dict[int, tuple[int, int]] = {}
    for view, placing in zip(views, placings, strict=True):
        if view.visits is not None and len(view.visits.stamp_ns):
            ends = int(view.visits.stamp_ns.min()), int(view.visits.stamp_ns.max())
            first, last = out.get(placing, ends)
            out[placing] = min(first, ends[0]), max(last, ends[1])
    return out


def _visits_of(
    view: ViewReadings,
    grid: GridData,
    row: int,
    ends: tuple[int, int] | None,
    flat: np.ndarray,
) -> ViewVisits | None:
    """Return the visits of a view whose marks have the indices `flat` (P,); None if unknown.

    `ends` are those of the time of the placing to which it belongs, see `TermInputs`.
    """
    visits = view.visits
    if visits is None or not len(visits.mark) or ends is None:
        return None
    mark = flat[visits.mark]
    weight = visits.shares(len(view.m)) * grid.weight[row].reshape(-1)[mark]
    phase = grid.poses[row].phase.conjugate()
    return ViewVisits(
        mark=mark,
        weight=weight,
        y=(visits.dx + 1j * visits.dy) * phase,
        time=view_time(visits.stamp_ns, *ends),
        offset=visits.offset_x + 1j * visits.offset_y,
        approach_x=visits.approach_x.astype(float),
        approach_y=visits.approach_y.astype(float),
        phase=phase,
    )


def check_visits(measurements: Measurements) -> None:
    """Raise InputError for invalid visits: of no mark, or not finite."""
    for view in measurements.views:
        visits = view.visits
        if visits is None or not len(visits.mark):
            continue
        where = f"view '{view.view.name}' visits of grid marks"
        columns = (
            visits.dx,
            visits.dy,
            visits.count,
            visits.stamp_ns,
            visits.offset_x,
            visits.offset_y,
            visits.approach_x,
            visits.approach_y,
        )
        if any(len(column) != len(visits.mark) for column in columns):
            raise InputError(
                where,
                "marks, deviations, counts, stamps, offsets and approaches differ in length",
                "give one value per visit",
            )
        if visits.mark.min() < 0 or visits.mark.max() >= len(view.m):
            raise InputError(
                where,
                "a visit belongs to none of the marks that were read",
                "number the marks as `m` and `n` have them",
            )
        if visits.count.min() < 1:
            raise InputError(
                where, "a count below 1", "leave out visits without a reading"
            )
        for values in (visits.dx, visits.dy, visits.offset_x, visits.offset_y):
            if not (np.abs(values) < FARTHEST_M).all():
                raise InputError(
                    where,
                    "a deviation or offset is not a finite number, or no length of a stage",
                    "remove the visit",
                )


def view_time(instants: np.ndarray, first: float, last: float) -> np.ndarray:
    """Return instants in the time of a view: -1 at its first, +1 at its last; 0 if only one."""
    if first == last:
        return np.zeros(len(instants))
    return 2 * (instants - first) / (last - first) - 1


def between_visits(
    measurements: Measurements, least_dof: int
) -> tuple[float, int] | None:
    """Return the noise of one reading from the visits of each mark, m, and its dof.

    Repeats of one visit share slow effects, visits do not: with both, the scatter between visits
    is the noise of a mean. None if no visit has repeats, or with fewer than `least_dof` degrees of
    freedom between visits: then all repeats count equally.
    """
    total, dof, repeated = 0.0, 0, False
    for view in measurements.views:
        visits = view.visits
        if visits is None or not len(visits.mark):
            continue
        repeated |= bool(visits.dof)
        n = len(view.m)
        count = np.bincount(visits.mark, visits.count, n)
        for values in (visits.dx, visits.dy):
            sums = np.bincount(visits.mark, visits.count * values, n)
            mean = sums[visits.mark] / count[visits.mark]
            total += float(visits.count @ (values - mean) ** 2)
        dof += 2 * (len(visits.mark) - int(np.count_nonzero(count)))
    if not repeated or dof < least_dof:
        return None
    return float(np.sqrt(total / dof)), dof


MOST_NODES = 11
"""Largest number of nodes along each axis; up to it they are the sites."""

MOST_VALUES = 16_000_000
"""Largest number of values of all columns, 256 MB, to which fewer nodes are due."""


@dataclass(frozen=True, eq=False)
class TermInputs:
    """Inputs of the term columns.

    Attributes
    ----------
    z : complex array (nx, ny)
        Marks in units of `half_width_m`.
    half_width_m : float
        Longer half width of the plate, m.
    weight : float array (views, nx, ny)
        Weight of the mean of each mark; 0 = not read.
    visits : tuple of ViewVisits or None
        Visits of each view.
    names : tuple of str
        Names of the views.
    sense : Sense
        What moves.
    line_names : tuple of str
        Names of the views in which lines were read.
    n_lines : int
        Lines of the plate, K.
    line_offsets : float array (views of lines, lines)
        Offset measured at each line, rad; 0 where not read.
    with_lines : tuple of int
        Which of these views are views of marks as well, if there are two or more: their marks and
        lines share rotations.
    placings : tuple of int
        First view of the placing of the plate to which each view belongs: the cells of an image
        see one plate, bent and drifting alike.
    placing_names : tuple of str
        Names of the placings of the views.
    cells_m : complex array (views,)
        Place of the cell of each view in its image, stage axes; 0 without images.
    stage : Artifact
        Its sites, or the nodes of the map.
    drift_degree : int
        Degree of the polynomial of a view's time that a block may have.
    poses : tuple of Pose
        Nominal pose of the plate in each view: `shift_m`, where its centre lies on the stage, and
        `phase`, from its frame to the stage's.
    """

    z: np.ndarray
    half_width_m: float
    weight: np.ndarray
    visits: tuple[ViewVisits | None, ...]
    names: tuple[str, ...]
    sense: Sense
    line_names: tuple[str, ...]
    n_lines: int
    line_offsets: np.ndarray
    with_lines: tuple[int, ...]
    placings: tuple[int, ...]
    placing_names: tuple[str, ...]
    cells_m: np.ndarray
    stage: Artifact
    drift_degree: int
    poses: tuple[Pose, ...]

    @property
    def node_axes_m(self) -> list[np.ndarray]:
        """Places along x and y of nodes of a term over the field, in the sense of (1.6), m."""
        most = max(2, int(np.sqrt(MOST_VALUES / (len(self.names) * self.z.size))))
        return [
            np.linspace(-half, half, min(sites, most, MOST_NODES))
            for half, sites in zip(
                self.stage.field_half_m, self.stage.shape, strict=True
            )
        ]

    def on_stage(self, view: int) -> np.ndarray:
        """Return the nominal places of all marks in a view, stage axes, complex (marks,), m."""
        pose = self.poses[view]
        return (
            complex(*pose.shift_m) + pose.phase * self.z.reshape(-1) * self.half_width_m
        )

    def at_visits(
        self,
        values_of: Callable[[ViewVisits], np.ndarray],
        views: Iterable[int] | None = None,
        *,
        nominal: bool = False,
    ) -> list[tuple[dict[int, np.ndarray], dict[int, np.ndarray]]]:
        """Return patterns that differ between the visits of a mark.

        Parameters
        ----------
        values_of : callable
            Visits of a view -> complex (k, V), stage frame.
        views : iterable of int, optional
            Which views; otherwise all.
        nominal : bool
            Whether the means are those in the nominal frame, as the map is.

        Returns
        -------
        list of (dict, dict)
            Of each of the k: means of the marks, and values at the visits, by view, plate frame.
        """
        at, means = {}, {}
        for view in range(len(self.visits)) if views is None else views:
            if (visits := self.visits[view]) is not None:
                at[view] = values_of(visits) * visits.phase
                frame = visits.frame if nominal else 1.0
                means[view] = visits.means(at[view] / frame, self.z.size)
        number = len(next(iter(at.values()), ()))
        return [
            (
                {view: mean[row] for view, mean in means.items()},
                {view: value[row] for view, value in at.items()},
            )
            for row in range(number)
        ]

    @property
    def members(self) -> dict[int, list[int]]:
        """Views of each placing of the plate, by the first of them."""
        out: dict[int, list[int]] = {}
        for view, first in enumerate(self.placings):
            out.setdefault(first, []).append(view)
        return out

    def names_of(self, term: str) -> tuple[str, ...]:
        """Return the names of the views of the columns of a term."""
        block = blocks().get(term)
        if block is None or block.shared:
            return self.names
        return self.line_names if block.of_lines else self.placing_names

    def has(self, term: str) -> bool:
        """Return whether any reading can depend on a term."""
        block = block_of(term)
        if block.of_images:
            return bool(self.cells_m.any())
        return not block.of_lines or bool(
            self.with_lines if block.between else self.line_names
        )

    def name_of(self, term: str, view: int) -> str:
        """Return the name of the view of a column; empty where all views share it (-1)."""
        return (*self.names_of(term), "")[view]


def term_inputs(
    measurements: Measurements,
    grid: GridData,
    *,
    drift_degree: int = DRIFT_DEGREE,
) -> TermInputs:
    """Return the inputs of a measurement whose grid readings are `grid`."""
    lines = [v for v in measurements.views if len(v.k)]
    shared = tuple(row for row, view in enumerate(lines) if len(view.m))
    z = maps_of(grid).z
    readings = [measurements.views[i] for i in grid.index]
    views = [view.view for view in readings]
    placings = placings_of(views)
    ranges = time_ranges(readings, placings)
    visits = tuple(
        _visits_of(
            view,
            grid,
            row,
            ranges.get(placings[row]),
            measurements.artifact.flat(view.m, view.n),
        )
        for row, view in enumerate(readings)
    )
    return TermInputs(
        z=z,
        half_width_m=measurements.artifact.half_width_m,
        weight=grid.weight,
        visits=visits,
        names=tuple(view.name for view in views),
        sense=measurements.sense,
        line_names=tuple(view.view.name for view in lines),
        n_lines=measurements.artifact.angular_count,
        line_offsets=_line_offsets_of(lines, measurements.artifact.angular_count),
        with_lines=shared if len(shared) > 1 else (),
        placings=placings,
        placing_names=tuple(view.plan_view for view in views),
        cells_m=np.array([view.cell_m for view in views]),
        stage=measurements.artifact.field,
        drift_degree=drift_degree,
        poses=tuple(view.pose for view in views),
    )


def _line_offsets_of(views: Sequence[ViewReadings], n_lines: int) -> np.ndarray:
    """Return the offset measured at each line, (views, lines), rad; 0 where not read.

    The stage stood at the nominal angle of each line up to what is the same for all of a view:
    deviations are offsets but for that.
    """
    out = np.zeros((len(views), n_lines))
    for row, view in zip(out, views, strict=True):
        row[view.k] = view.dtheta - view.axis_theta
    return out


def without_noise(
    inputs: TermInputs,
    residuals: np.ndarray,
    of_terms: Sequence[np.ndarray | float] = (),
) -> TermInputs:
    """Return the inputs with offsets from which the noise of the readings is taken off.

    The offset that a microscope saw holds the noise of its reading. As a column it would explain
    just that noise, and nothing else where offsets hardly differ. What the estimate leaves of each
    visit is taken off the offset: the rest owes nothing to the residuals. Of a stage that follows
    its marks residuals may be many times the offsets: all of them taken off, offsets would be the
    residuals, and explain them.

    Parameters
    ----------
    inputs : TermInputs
        With the offsets as they were seen.
    residuals : complex array (views, nx, ny)
        Residuals of the means of the marks, plate frame, m.
    of_terms : sequence, optional
        What terms make of each visit of each view, (V,), plate frame, m; none without terms.
    """
    visits = []
    marks = inputs.z.reshape(-1) * inputs.half_width_m
    terms = of_terms or [0.0] * len(inputs.visits)
    for view, residual, of_model in zip(inputs.visits, residuals, terms, strict=True):
        if view is not None:
            within, offsets_within = (
                view.about_means(values[None], residual.size)[0]
                for values in (view.y - of_model, view.offset)
            )
            means = residual.reshape(-1)[view.mark]
            turned = (view.frame - 1) * marks[view.mark]
            stood = (view.y - turned) * np.conj(view.phase) - view.offset
            of_offsets, of_stops, of_means, of_within, of_offsets_within = (
                float(np.sum(np.abs(values) ** 2))
                for values in (view.offset, stood, means, within, offsets_within)
            )
            noise = within + means
            # of a stage that follows its marks: offsets hold no more than they are
            if of_offsets < min(of_stops, of_means):
                noise = means * (of_offsets / of_means)
                if of_within > 0:
                    noise += within * min(of_offsets_within / of_within, 1.0)
            view = replace(view, offset=view.offset - noise * np.conj(view.phase))
        visits.append(view)
    return replace(inputs, visits=tuple(visits))
