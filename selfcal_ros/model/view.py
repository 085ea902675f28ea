# SPDX-License-Identifier: Apache-2.0
"""Views: poses of the plate on the stage; plans: the views to be measured."""

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from selfcal_ros.errors import InputError
from selfcal_ros.files import checked_fields
from selfcal_ros.model.artifact import (
    Artifact,
    artifact_of,
    artifact_to_dict,
    default_map_grid,
    harmonics_of,
    map_grid_of,
    map_to_dict,
)
from selfcal_ros.model.orders import parse_order
from selfcal_ros.model.pose import (
    OFF,
    Image,
    LatticePose,
    PlacedPose,
    Pose,
    StagePose,
    cell_label,
    image_of,
    nearest_step,
    turn_in_lines,
    whole_steps,
)
from selfcal_ros.model.terms import terms_of, with_microscope
from selfcal_ros.units import MM_PER_M

MAX_VIEWS = 1000
"""Largest number of views of a plan."""

MAX_SHIFT = 100_000
"""Largest translation of a view, in pitches."""

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
        Order in which the grid marks are visited, see `selfcal_ros.model.orders`; empty =
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
    image: Image | None = None
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
        return self.image.step_on_plate(cell, self.pose, artifact) if self.image else (0, 0)

    @property
    def plan_view(self) -> str:
        """Name of the view in the plan: of a sub-view without its cell."""
        return self.name if self.cell is None else self.name.removesuffix(cell_label(self.cell))

    @property
    def sub_views(self) -> tuple["View", ...]:
        """The views of the cells of the image; lines belong to that of the optical axis."""
        if self.image is None or self.cell is not None or not self.grid:
            return (self,)
        out = []
        for cell in self.image.cells:
            view = replace(self, name=self.name + cell_label(cell), cell=cell,
                           angular=self.angular and cell == (0, 0))
            x, y = self.translation_m
            out.append(replace(view, translation_m=(x - view.cell_m.real, y - view.cell_m.imag)))
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
            raise InputError(where, f"{self.check_marks} marks, {self.check_offset_m:g} m off",
                             "give marks and offset both, e.g. {marks: 5, offset: 20e-6}")
        most = MOST_CHECK_OFFSET * artifact.grid_pitch_m
        if self.check_offset_m > most:
            raise InputError(where, f"{self.check_offset_m:g} m is more than a quarter of the "
                             "pitch", f"stop at most {most:g} m off the mark; 20e-6 is usual")
        there = self.on_stage(artifact).n_in_field(artifact) if self.grid else 0
        if self.check_marks > there:
            raise InputError(where, f"{self.check_marks} marks are wanted, {there} lie in the "
                             "field", "ask for fewer marks")

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
            beyond every field, or has lines to be measured and is no whole number of them.
        """
        if artifact.map_grid is None and artifact.marks is None:
            return self.lattice_pose(artifact)
        shift = self._pitches(artifact)
        lines = self._lines(artifact) if self.angular and artifact.angular_count else None
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
        a, b = (whole_steps(step, f"{where} translation", "pitch", f"place the plate on the {OFF}")
                for step in self._pitches(artifact))
        quarter = nearest_step(self.rotation_rad / (math.pi / 2))
        if self.grid and quarter is None:
            raise InputError(where, f"grid marks cannot be measured at a turn of "
                             f"{math.degrees(self.rotation_rad):.6g} deg",
                             f"turn by 90 deg, set grid to false, or place it on the {OFF}")
        lines = turn_in_lines(self.rotation_rad, artifact)
        if lines is None and artifact.angular_count and (self.angular or quarter is None):
            lines = self._lines(artifact)
        if lines is None and quarter is None:
            raise InputError(where, "a turn that is not a quarter needs angular lines",
                             "turn by a multiple of 90 deg")
        return LatticePose(None if quarter is None else quarter % 4, (a, b), lines)

    def is_on_lattice(self, artifact: Artifact) -> bool:
        """Return whether the grid marks, if any are wanted, lie on the artifact's lattice."""
        if artifact.marks is not None:
            return False
        steps = (*self._pitches(artifact), self.rotation_rad / (math.pi / 2))
        return not self.grid or all(nearest_step(step) is not None for step in steps)

    def _pitches(self, artifact: Artifact) -> tuple[float, float]:
        """Return the translation in pitches; InputError unless the pose is finite."""
        where = f"view '{self.name}'"
        if not all(map(math.isfinite, self.translation_m)):
            raise InputError(f"{where} translation", f"{self.translation_m} are not two lengths",
                             "give a finite translation")
        if not math.isfinite(self.rotation_rad):
            raise InputError(f"{where} rotation", f"{self.rotation_rad} is not an angle",
                             "give a finite turn")
        a, b = (value / artifact.grid_pitch_m for value in self.translation_m)
        if max(abs(a), abs(b)) > MAX_SHIFT + 0.5:
            raise InputError(f"{where} translation", f"{max(a, b, key=abs):.6g} pitches are beyond "
                             "every field", "is it in mm? give the translation in metres")
        return a, b

    def _lines(self, artifact: Artifact) -> float:
        """Return the turn in angular lines, 0 to K; whole unless the map is a Fourier series."""
        lines = turn_in_lines(self.rotation_rad, artifact)
        return lines if lines is not None else whole_steps(
            self.rotation_rad * artifact.angular_count / math.tau, f"view '{self.name}' rotation",
            "angular line", "turn by whole lines, or set angular to false, or give map: harmonics")


def with_sub_views(views: Iterable[View]) -> tuple[View, ...]:
    """Return the views, those with images as the sub-views of their cells."""
    return tuple(sub for view in views for sub in view.sub_views)


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
    """

    plan_id: str
    artifact: Artifact
    views: tuple[View, ...]
    model_terms: tuple[str, ...] = ()
    artifact_from: str = ""

    @property
    def check_stops(self) -> tuple[int, float]:
        """Marks checked in each view of grid marks, and their distance, m."""
        checks = ((view.check_marks, view.check_offset_m) for view in self.views if view.grid)
        return next(checks, (0, 0.0))


def plan_from_dict(data: object, where: str) -> Plan:
    """Return the plan in a PLAN.yaml mapping.

    Parameters
    ----------
    data : object
        Parsed YAML: ``plan_id``, ``artifact`` as `artifact_of` takes it,
        ``views [{name, rotation_deg, translation_pitch, grid, angular, repeats, visit_order}]``,
        with ``translation_mm`` instead of ``translation_pitch``, ``visit_order``, for views without
        their own, ``map {grid_size, grid_pitch, interpolation, grid_size_y, harmonics}``, nodes
        off the plate's sites (default off the lattice: `default_map_grid`), harmonics of the
        angular map, ``model_terms``, each ``TERM`` or ``TERM:SIZE``, ``check_stops {marks,
        offset}`` (m) of views with grid marks, ``microscope {scale_u, rotation_u, shear_u}`` (u),
        ``image {nx, ny, pitch_m}``, and ``artifact_from``, which made the plate known.
    where : str
        File name, for messages.

    Raises
    ------
    InputError
        For a missing or unknown key, a wrong type, an unknown visiting order or term, or an
        impossible pose.
    """
    fields = checked_fields(data, where, {"plan_id": str, "artifact": dict, "views": list},
                            {"visit_order": (str, ""), "model_terms": (list, []),
                             "check_stops": (dict, {}), "microscope": (dict, {}),
                             "map": (dict, {}), "image": (dict, {}), "artifact_from": (str, "")})
    artifact = replace(artifact_of(fields["artifact"], f"{where}: artifact"),
                       harmonics=harmonics_of(fields["map"], f"{where}: map"))
    order = _order(fields["visit_order"], where)
    if len(fields["views"]) > MAX_VIEWS:
        raise InputError(f"{where}: views", f"{len(fields['views'])} views are more than "
                         f"{MAX_VIEWS}", "measure fewer views")
    checks = _checks(fields["check_stops"], f"{where}: check_stops")
    views = tuple(_view_from_dict(view, f"{where}: views[{index}]", artifact, order)
                  for index, view in enumerate(fields["views"]))
    grid = map_grid_of(fields["map"], artifact, f"{where}: map")
    if grid is None and not all(view.is_on_lattice(artifact) for view in views):
        grid = default_map_grid(artifact)
    artifact = replace(artifact, map_grid=grid)
    image = image_of(fields["image"], artifact, f"{where}: image")
    views = tuple(replace(_with_checks(view, *checks, artifact, where),
                          image=image if view.grid else None) for view in views)
    if len(with_sub_views(views)) > MAX_VIEWS:
        raise InputError(f"{where}: image", f"{len(with_sub_views(views))} views with the cells of "
                         f"the image are more than {MAX_VIEWS}", "state fewer marks in an image")
    if not views:
        raise InputError(where, "the plan has no views", "add at least one view")
    for index, view in enumerate(views):
        if view.name in [other.name for other in views[:index]]:
            raise InputError(f"{where}: views[{index}]", f"the name '{view.name}' is used twice",
                             "give every view its own name")
    terms = terms_of(fields["model_terms"], where)
    return Plan(fields["plan_id"], artifact, views, with_microscope(
        terms, fields["microscope"], f"{where}: microscope"), fields["artifact_from"])


def _checks(data: dict, where: str) -> tuple[int, float]:
    """Return the number of marks checked and their distance, m; (0, 0) if none."""
    if not data:
        return 0, 0.0
    if isinstance(data.get("offset"), str):  # YAML reads 20e-6, without a point, as a string
        with suppress(ValueError):  # refused below
            data = data | {"offset": float(data["offset"])}
    raw = checked_fields(data, where, {"marks": int, "offset": float})
    return raw["marks"], raw["offset"]


def _with_checks(view: View, marks: int, offset_m: float, artifact: Artifact, where: str) -> View:
    """Return the view with check stops if it has grid marks; InputError for an impossible pose."""
    view.on_stage(artifact)
    if not view.grid:
        return view
    checked = replace(view, check_marks=marks, check_offset_m=offset_m)
    try:
        checked.require_check_stops(artifact)
    except InputError as error:
        raise InputError(f"{where}: {error.where}", error.what, error.remedy) from error
    return checked


def _order(text: str, where: str) -> str:
    return str(parse_order(text, f"{where}: visit_order")) if text else ""


def _view_from_dict(data: object, where: str, artifact: Artifact, order: str) -> View:
    raw = checked_fields(data, where, {"name": str},
                         {"rotation_deg": (float, 0.0), "translation_pitch": (list, None),
                          "translation_mm": (list, None), "grid": (bool, True),
                          "angular": (bool, None), "repeats": (int, 1),
                          "visit_order": (str, order)})
    a, b = _translation_m(raw, where, artifact)
    if raw["repeats"] < 1:
        raise InputError(f"{where}: repeats", f"{raw['repeats']} is not positive", "give 1 or more")
    if raw["angular"] and not artifact.angular_count:
        raise InputError(where, "angular marks are wanted but the plate has none",
                         "set angular to false")
    turn = math.radians(raw["rotation_deg"])
    if raw["angular"] is None:  # without harmonics only grid marks can be read between two lines
        raw["angular"] = artifact.angular_count > 0 and (
            not raw["grid"] or not math.isfinite(turn) or turn_in_lines(turn, artifact) is not None)
    if not (raw["grid"] or raw["angular"]):
        raise InputError(where, "neither grid nor angular marks are wanted", "set one to true")
    return View(raw["name"], turn, (a, b), raw["grid"], raw["angular"], raw["repeats"],
                _order(raw["visit_order"], where))


def _translation_m(raw: dict, where: str, artifact: Artifact) -> tuple[float, float]:
    """Return the translation of a view in PLAN.yaml, m; (0, 0) if it has none."""
    given = [key for key in ("translation_pitch", "translation_mm") if raw[key] is not None]
    if len(given) > 1:
        raise InputError(where, f"{' and '.join(given)} are given", "leave one of them out")
    if given == ["translation_pitch"] and artifact.marks is not None:
        raise InputError(f"{where}: translation_pitch", "a list of marks has no pitch",
                         "give translation_mm: [a, b]")
    shift = raw[given[0]] if given else [0, 0]
    if len(shift) != 2 or not all(isinstance(s, int | float) for s in shift):
        raise InputError(f"{where}: {given[0]}", "not two numbers", "give [a, b]")
    if given == ["translation_mm"]:
        return shift[0] / MM_PER_M, shift[1] / MM_PER_M
    return shift[0] * artifact.grid_pitch_m, shift[1] * artifact.grid_pitch_m


def view_to_dict(view: View, artifact: Artifact) -> dict[str, Any]:
    """Return a view in the format of PLAN.yaml."""
    unit = "pitch" if artifact.marks is None else "mm"
    shift = view.on_stage(artifact).shift if unit == "pitch" else [
        value * MM_PER_M for value in view.translation_m]
    order = {"visit_order": view.visit_order} if view.visit_order else {}
    return {"name": view.name, "rotation_deg": round(math.degrees(view.rotation_rad), 9),
            f"translation_{unit}": [round(step, 9) for step in shift], "grid": view.grid,
            "angular": view.angular, "repeats": view.repeats, **order}


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """Return a plan in the format of PLAN.yaml."""
    artifact, own = plan.artifact, map_to_dict(plan.artifact)
    marks, offset_m = plan.check_stops
    image = next((view.image for view in plan.views if view.image), None)
    return {"plan_id": plan.plan_id, "artifact": artifact_to_dict(artifact),
            **({"map": own} if own else {}),
            "views": [view_to_dict(view, artifact) for view in plan.views],
            **({"check_stops": {"marks": marks, "offset": offset_m}} if marks else {}),
            **({"image": dict(vars(image))} if image else {}),
            **({"model_terms": list(plan.model_terms)} if plan.model_terms else {}),
            **({"artifact_from": plan.artifact_from} if plan.artifact_from else {})}
