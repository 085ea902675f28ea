# SPDX-License-Identifier: Apache-2.0
"""Views: poses of the plate on the stage, orders of visits; plans: the views to be measured."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import share_between
from selfcal_ros.model.pose import (
    OFF,
    ImageCells,
    LatticePose,
    PlacedPose,
    Pose,
    StagePose,
    cell_label,
    nearest_step,
    turn_in_lines,
    whole_steps,
)

ORDERS = (
    "raster",
    "serpentine",
    "there_and_back",
    "x_then_y",
    "x_back_y_back",
    "random",
)
"""raster: line by line along x, each line along y from its first mark to its last. serpentine:
the same, every other line backwards. there_and_back: a raster pass, then the same pass
backwards. x_then_y: a raster pass, then one that goes line by line along y. x_back_y_back: line by
line along x, back, along y, back. random: every mark once in each pass, in any order."""
PASSES = {"there_and_back": 2, "x_then_y": 2, "x_back_y_back": 4}
"""Number of passes after which an order repeats; default one."""
PLATE_SUFFIX = "@plate"
"""Suffix for lines of the plate's marks: the same marks in the same order in every view. Without
it lines are those of the stage's sites: the same sites in the same order in every view. Where the
map has nodes of its own the lines are always the plate's."""
PLAN_KEYS = ("verify",)
"""Keys of a plan that have no field in the messages and travel there as `plan_keys`: each is a text
of this name in `Plan`, `Command`, `Timeline` and `Measurements`, empty without it."""
DEFAULT_ORDER = "serpentine"
"""Order of a cell if none is specified."""


@dataclass(frozen=True)
class VisitOrder:
    """A visiting order: one of `ORDERS`, along the lines of the stage or of the plate."""

    name: str
    of_plate: bool = False

    @property
    def passes(self) -> int:
        """Passes after which it repeats: a view has as many repeats, or a multiple."""
        return PASSES.get(self.name, 1)

    def __str__(self) -> str:
        """Return the name of the order."""
        return self.name + PLATE_SUFFIX * self.of_plate


def parse_order(text: str, where: str = "visit_order") -> VisitOrder:
    """Return the order named by a text such as ``there_and_back@plate``.

    Raises
    ------
    InputError
        If no order has that name.
    """
    name = text.removesuffix(PLATE_SUFFIX)
    if name not in ORDERS:
        raise InputError(
            where,
            f"'{text}' is not a visiting order",
            f"use one of {', '.join(ORDERS)}, if need be with {PLATE_SUFFIX}",
        )
    return VisitOrder(name, name != text)


MAX_SHIFT = 100_000
"""Largest translation of a view, in pitches."""

MAX_TURN_RAD = 100.0
"""Largest rotation of a view."""
MOST_CHECK_OFFSET = 0.25
"""Largest distance of a check stop from its mark, in pitches."""


@dataclass(frozen=True)
class View:
    """One placement of the plate, in the stage frame.

    Attributes
    ----------
    name : str
        Name in the plan.
    rotation_rad : float
        Nominal turn of the plate, counter-clockwise, rad.
    translation_m : tuple of float
        Nominal position of the plate's centre, m.
    grid, angular : bool
        Kinds of marks that are measured.
    repeats : int
        Number of times that every mark is measured.
    visit_order : str
        Order in which the grid marks are visited, see `selfcal_ros.model.view`; empty =
        chosen by the cell.
    check_marks : int
        Grid marks that are measured four more times, the stage at +x, -x, +y and -y of the mark.
    check_offset_m : float
        Distance of these stops from the mark, m.
    image : Image, optional
        Marks that an exposure shows; None = the one at which the stage stands.
    cell : tuple of int, optional
        Cell of the image, of a sub-view: the marks seen there, as a view of their own. The stage
        stands beside them, at a pose of the plate shifted by minus the place of the cell.
    """

    name: str
    rotation_rad: float = 0.0
    translation_m: tuple[float, float] = (0.0, 0.0)
    grid: bool = True
    angular: bool = True
    repeats: int = 1
    visit_order: str = ""
    check_marks: int = 0
    check_offset_m: float = 0.0
    image: ImageCells | None = None
    cell: tuple[int, int] | None = None

    @property
    def cell_m(self) -> complex:
        """Place of the sub-view's cell in the image, stage axes, x + iy, m; 0 without one."""
        if self.image is None or self.cell is None:
            return 0j
        return self.pose.rows * complex(*self.cell) * self.image.pitch_m

    def step_on_plate(self, artifact: Artifact) -> tuple[int, int]:
        """Return the steps (m, n) on the plate from the mark on the optical axis to the cell's."""
        cell = self.cell or (0, 0)
        return (
            self.image.step_on_plate(cell, self.pose, artifact)
            if self.image
            else (0, 0)
        )

    @property
    def plan_view(self) -> str:
        """Name of the view in the plan: of a sub-view without its cell."""
        return (
            self.name
            if self.cell is None
            else self.name.removesuffix(cell_label(self.cell))
        )

    @property
    def sub_views(self) -> tuple["View", ...]:
        """The views of the cells of the image; lines belong to that of the optical axis."""
        if self.image is None or self.cell is not None or not self.grid:
            return (self,)
        out = []
        for cell in self.image.cells:
            view = replace(
                self,
                name=self.name + cell_label(cell),
                cell=cell,
                angular=self.angular and cell == (0, 0),
            )
            x, y = self.translation_m
            out.append(
                replace(
                    view, translation_m=(x - view.cell_m.real, y - view.cell_m.imag)
                )
            )
        return tuple(out)

    def require_check_stops(self, artifact: Artifact) -> None:
        """Raise InputError for check stops that are impossible at the marks of this view.

        At more than a quarter of the pitch a microscope need not see the mark, and a mark without
        an id is not identified.
        """
        where = f"view '{self.name}' check_stops"
        if not self.check_marks and not self.check_offset_m:
            return
        if self.check_marks < 1 or not self.check_offset_m > 0:
            raise InputError(
                where,
                f"{self.check_marks} marks, {self.check_offset_m:g} m off",
                "give both marks and offset, e.g. {marks: 5, offset: 20e-6}",
            )
        most = MOST_CHECK_OFFSET * artifact.grid_pitch_m
        if self.check_offset_m > most:
            raise InputError(
                where,
                f"{self.check_offset_m:g} m is more than a quarter of the pitch",
                f"stop at most {most:g} m off the mark; 20e-6 is usual",
            )
        n_in_field = self.on_stage(artifact).n_in_field(artifact) if self.grid else 0
        if self.check_marks > n_in_field:
            raise InputError(
                where,
                f"{self.check_marks} marks are requested, {n_in_field} lie in the field",
                "ask for fewer marks",
            )

    @property
    def pose(self) -> Pose:
        """Nominal pose of the plate, on the lattice or off it."""
        return Pose(self.rotation_rad, self.translation_m)

    def on_stage(self, artifact: Artifact) -> StagePose:
        """Return the pose in pitches; on the lattice unless the map has nodes of its own.

        Raises
        ------
        InputError
            As `lattice_pose`; if the map has nodes of its own, only if the pose is not finite, is
            beyond every field, or has lines to be measured and is not a whole number of them.
        """
        if artifact.map_grid is None and artifact.marks is None:
            return self.lattice_pose(artifact)
        shift = self._pitches(artifact)
        lines = (
            self._lines(artifact) if self.angular and artifact.angular_count else None
        )
        return PlacedPose(self.pose.phase, shift, lines)

    def lattice_pose(self, artifact: Artifact) -> LatticePose:
        """Return the pose in whole steps of the artifact's lattice.

        Raises
        ------
        InputError
            If the pose is off the lattice, or grid marks are requested at a turn that is
            not a whole quarter.
        """
        where = f"view '{self.name}'"
        quarter_shift = self._quarter_shift(artifact)
        a, b = (
            self._half_steps(step, artifact)
            if quarter_shift
            else whole_steps(
                step, f"{where} translation", "pitch", f"place the plate on the {OFF}"
            )
            for step in self._pitches(artifact)
        )
        quarter = nearest_step(self.rotation_rad / (math.pi / 2))
        if self.grid and quarter is None:
            raise InputError(
                where,
                f"grid marks cannot be measured at a turn of "
                f"{math.degrees(self.rotation_rad):.6g}°",
                f"turn by 90°, set grid to false, or place it on the {OFF}",
            )
        lines = turn_in_lines(self.rotation_rad, artifact)
        if (
            lines is None
            and artifact.angular_count
            and (self.angular or quarter is None)
        ):
            lines = self._lines(artifact)
        if lines is None and quarter is None:
            raise InputError(
                where,
                "a turn that is not a quarter needs angular lines",
                "turn by a multiple of 90°",
            )
        return LatticePose(None if quarter is None else quarter % 4, (a, b), lines)

    def is_on_lattice(self, artifact: Artifact) -> bool:
        """Return whether the grid marks, if any are wanted, lie on the artifact's lattice."""
        if artifact.marks is not None:
            return False
        turn = self.rotation_rad / (math.pi / 2)
        quarter_shift = self._quarter_shift(artifact)
        steps = (*(step - quarter_shift for step in self._pitches(artifact)), turn)
        return not self.grid or all(nearest_step(step) is not None for step in steps)

    def _quarter_shift(self, artifact: Artifact) -> float:
        """Return by how much more than whole pitches the plate is shifted on its lattice."""
        quarter = nearest_step(self.rotation_rad / (math.pi / 2))
        return (
            artifact.quarter_shift
            if self.grid and quarter is not None and quarter % 2
            else 0
        )

    def _half_steps(self, step: float, artifact: Artifact) -> float:
        """Return the odd multiple of 1/2 that a translation in pitches is meant to be."""
        whole_pitches = nearest_step(step - 0.5)
        if whole_pitches is None:
            nx, ny = artifact.shape
            raise InputError(
                f"view '{self.name}' translation",
                f"after a quarter turn the rows of {nx} x {ny} marks lie between rows "
                f"at a shift of {step:.6g} pitch",
                f"shift it by [0.5, 0.5] pitch to place it on the {OFF}",
            )
        return whole_pitches + 0.5

    def _pitches(self, artifact: Artifact) -> tuple[float, float]:
        """Return the translation in pitches; InputError unless the pose is finite."""
        where = f"view '{self.name}'"
        if not all(map(math.isfinite, self.translation_m)):
            raise InputError(
                f"{where} translation",
                f"{self.translation_m} are not two lengths",
                "give a finite translation",
            )
        if not math.isfinite(self.rotation_rad):
            raise InputError(
                f"{where} rotation",
                f"{self.rotation_rad} is not an angle",
                "give a finite turn",
            )
        if abs(self.rotation_rad) > MAX_TURN_RAD:
            raise InputError(
                f"{where} rotation",
                f"{math.degrees(self.rotation_rad):g}° are many turns of a plate",
                "give it within 360°",
            )
        a, b = (value / artifact.grid_pitch_m for value in self.translation_m)
        if max(abs(a), abs(b)) > MAX_SHIFT + 0.5:
            raise InputError(
                f"{where} translation",
                f"{max(a, b, key=abs):.6g} pitches are beyond every field",
                "is it in mm? give the translation in metres",
            )
        return a, b

    def _lines(self, artifact: Artifact) -> float:
        """Return the turn in angular lines, 0 to K; whole unless the map is a Fourier series."""
        lines = turn_in_lines(self.rotation_rad, artifact)
        return (
            lines
            if lines is not None
            else whole_steps(
                self.rotation_rad * artifact.angular_count / math.tau,
                f"view '{self.name}' rotation",
                "angular line",
                "turn by whole lines, or set angular to false, or give map: harmonics",
            )
        )


def with_sub_views(views: Iterable[View]) -> tuple[View, ...]:
    """Return the views, those with images as the sub-views of their cells."""
    return tuple(sub for view in views for sub in view.sub_views)


SEEN_BETWEEN = 0.05
"""Mean square of `share_between` at the readings from which they show the error of interpolation:
0 at the nodes, 8/15 evenly between them, 9/100 with one view of six between them."""


def reads_between_nodes(views: Iterable[View], artifact: Artifact) -> bool:
    """Return whether marks are read between the nodes, along x and y, of a map that has its own.

    Only then residuals, and u, contain what interpolation lacks there.
    """
    grid = artifact.map_grid
    if grid is None:
        return False
    sites = [
        view.on_stage(artifact).marks_in_field(artifact)[1]
        for view in with_sub_views(views)
        if view.grid
    ]
    if not sites:
        return False
    along = np.concatenate(sites, axis=1) * (artifact.grid_pitch_m / grid.pitch_m)
    middle = np.array(artifact.field.half)[:, None]
    seen = (share_between(along + middle) ** 2).mean(axis=1)
    return bool(seen.min() > SEEN_BETWEEN)


def placings_of(views: Iterable[View]) -> tuple[int, ...]:
    """Return the first of the views that belong to the same placing of the plate, for each view."""
    first: dict[str, int] = {}
    return tuple(
        row if view.cell is None else first.setdefault(view.plan_view, row)
        for row, view in enumerate(views)
    )


def rotations_of(views: Sequence[View]) -> tuple[int, ...]:
    """Return the first of the views that have the same rotation of the plate, for each view."""
    return shared_rotations(placings_of(views), [view.cell or (0, 0) for view in views])


def shared_rotations(
    placings: Sequence[int], cells: Sequence[tuple[int, int]]
) -> tuple[int, ...]:
    """Return the same for views with the placings `placings`, and their cells in the image.

    A turned plate moves the marks in the image, and the camera's error there differs from that at
    the middle of the cell: where it is known in x and y, readings are freed from it. Cells in one
    line do not tell it: then each has a rotation of its own.
    """
    cells_of_placing = {
        placing: [
            cell
            for placing_of_cell, cell in zip(placings, cells, strict=True)
            if placing_of_cell == placing
        ]
        for placing in placings
    }
    return tuple(
        placing
        if all(
            len(set(along)) > 1
            for along in zip(*cells_of_placing[placing], strict=True)
        )
        else row
        for row, placing in enumerate(placings)
    )


CellsSeen = Sequence[tuple[Any, tuple[int, int]]]
"""Of each grid view its name in the plan, and the step of its cell on the plate."""


def cells_seen(artifact: Artifact, views: Sequence[View]) -> CellsSeen | None:
    """Return the cells of images that grid views are; None without images."""
    if not any(view.cell is not None for view in views):
        return None
    return tuple((view.plan_view, view.step_on_plate(artifact)) for view in views)


def plan_keys(source: object) -> dict[str, str]:
    """Return the `PLAN_KEYS` of a plan, a command, a timeline or measurements."""
    return {key: getattr(source, key) for key in PLAN_KEYS}


@dataclass(frozen=True)
class Plan:
    """An artifact and the views in which it is to be measured, in their order.

    Attributes
    ----------
    plan_id : str
        Its name.
    artifact : Artifact
        The plate.
    views : tuple of View
        Views to be measured.
    model_terms : tuple of str
        Terms to be estimated with the map, see `selfcal_ros.model.terms`.
    artifact_from : str
        RESULT.json of the calibration that made the plate known; empty if it is not.
    verify : str
        RESULT.json whose correction is on while the plan is measured; empty without one.
    """

    plan_id: str
    artifact: Artifact
    views: tuple[View, ...]
    model_terms: tuple[str, ...] = ()
    artifact_from: str = ""
    verify: str = ""

    @property
    def check_stops(self) -> tuple[int, float]:
        """Marks checked in each view of grid marks, and their distance, m."""
        checks = (
            (view.check_marks, view.check_offset_m) for view in self.views if view.grid
        )
        return next(checks, (0, 0.0))

    @property
    def image(self) -> ImageCells | None:
        """The marks that an image shows; None where every mark is seen alone."""
        return next((view.image for view in self.views if view.image), None)
