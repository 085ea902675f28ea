# SPDX-License-Identifier: Apache-2.0
"""Plans of views in the form of a PLAN.yaml, checked, and back."""

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

from selfcal_ros.errors import InputError, printable
from selfcal_ros.files import checked_fields
from selfcal_ros.model.artifact import Artifact, default_map_grid
from selfcal_ros.model.plate_form import (
    artifact_of,
    artifact_to_dict,
    harmonics_of,
    map_grid_of,
    map_to_dict,
)
from selfcal_ros.model.pose import image_of, turn_in_lines
from selfcal_ros.model.terms import terms_of, with_microscope
from selfcal_ros.model.view import (
    PLAN_KEYS,
    Plan,
    View,
    parse_order,
    plan_keys,
    with_sub_views,
)
from selfcal_ros.units import MM_PER_M

MAX_VIEWS = 1000
"""Largest number of views of a plan."""
MOST_REPEATS = 10_000
"""Largest number of repeats of a mark in a view of a plan."""
ROUNDED = 1e-3
"""Relative difference up to which a number is one of rad that was rounded, as 1.57."""
MOST_CHARACTERS = 200
"""Largest length of the name of a plan or view."""


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
        ``image {nx, ny, pitch_m}``, ``artifact_from``, which made the plate known, and ``verify``,
        the result whose correction is on while the plan is measured.
    where : str
        File name, for messages.

    Raises
    ------
    InputError
        For a missing or unknown key, a wrong type, an unknown visiting order or term, or an
        impossible pose.
    """
    fields = checked_fields(
        data,
        where,
        {"plan_id": str, "artifact": dict, "views": list},
        {
            "visit_order": (str, ""),
            "model_terms": (list, []),
            "check_stops": (dict, {}),
            "microscope": (dict, {}),
            "map": (dict, {}),
            "image": (dict, {}),
            "artifact_from": (str, ""),
            **dict.fromkeys(PLAN_KEYS, (str, "")),
        },
    )
    artifact = replace(
        artifact_of(fields["artifact"], f"{where}: artifact"),
        harmonics=harmonics_of(fields["map"], f"{where}: map"),
    )
    order = _order(fields["visit_order"], where)
    views = _views_from_list(fields["views"], where, artifact, order)
    grid = map_grid_of(fields["map"], artifact, f"{where}: map")
    if grid is None and not all(view.is_on_lattice(artifact) for view in views):
        grid = default_map_grid(artifact)
    artifact = replace(artifact, map_grid=grid)
    checks = _checks(fields["check_stops"], f"{where}: check_stops")
    image = image_of(fields["image"], artifact, f"{where}: image")
    views = tuple(
        replace(
            _with_checks(view, *checks, artifact, where),
            image=image if view.grid else None,
        )
        for view in views
    )
    if len(with_sub_views(views)) > MAX_VIEWS:
        raise InputError(
            f"{where}: image",
            f"{len(with_sub_views(views))} views with the cells of the image are more "
            f"than {MAX_VIEWS}",
            "state fewer marks in an image",
        )
    terms = terms_of(fields["model_terms"], where)
    return Plan(
        _name(fields["plan_id"], f"{where}: plan_id"),
        artifact,
        views,
        with_microscope(terms, fields["microscope"], f"{where}: microscope"),
        fields["artifact_from"],
        **{key: fields[key] for key in PLAN_KEYS},
    )


def _views_from_list(
    data: list, where: str, artifact: Artifact, order: str
) -> tuple[View, ...]:
    """Return the views of a plan, each with a name of its own; `order` where one has none."""
    if not data:
        raise InputError(where, "the plan has no views", "add at least one view")
    if len(data) > MAX_VIEWS:
        raise InputError(
            f"{where}: views",
            f"{len(data)} views are more than {MAX_VIEWS}",
            "measure fewer views",
        )
    views: dict[str, View] = {}
    for index, item in enumerate(data):
        view = _view_from_dict(item, f"{where}: views[{index}]", artifact, order)
        if view.name in views:
            raise InputError(
                f"{where}: views[{index}]",
                f"the name '{view.name}' is used twice",
                "give every view its own name",
            )
        views[view.name] = view
    return tuple(views.values())


def _checks(data: dict, where: str) -> tuple[int, float]:
    """Return the number of marks checked and their distance, m; (0, 0) if none."""
    if not data:
        return 0, 0.0
    # YAML reads 20e-6, without a point, as a string
    if isinstance(data.get("offset"), str):
        with suppress(ValueError):  # refused below
            data = data | {"offset": float(data["offset"])}
    raw = checked_fields(data, where, {"marks": int, "offset": float})
    return raw["marks"], raw["offset"]


def _with_checks(
    view: View, marks: int, offset_m: float, artifact: Artifact, where: str
) -> View:
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


def _name(text: str, where: str) -> str:
    """Return the name of a plan or view, which has to fit in commands, lines and drawings."""
    if not text.strip():
        raise InputError(where, "the name is empty", "give one")
    if not text.isprintable():
        raise InputError(
            where,
            f"'{printable(text)}' has characters that cannot be printed, such as a line break",
            "write the name in one line",
        )
    if len(text) > MOST_CHARACTERS:
        raise InputError(
            where,
            f"a name of {len(text)} characters",
            f"give one of at most {MOST_CHARACTERS}",
        )
    return text


def _order(text: str, where: str) -> str:
    return str(parse_order(text, f"{where}: visit_order")) if text else ""


def _view_from_dict(data: object, where: str, artifact: Artifact, order: str) -> View:
    raw = checked_fields(
        data,
        where,
        {"name": str},
        {
            "rotation_deg": (float, 0.0),
            "translation_pitch": (list, None),
            "translation_mm": (list, None),
            "grid": (bool, True),
            "angular": (bool, None),
            "repeats": (int, 1),
            "visit_order": (str, order),
        },
    )
    a, b = _translation_m(raw, where, artifact)
    if raw["repeats"] < 1:
        raise InputError(
            f"{where}: repeats", f"{raw['repeats']} is not positive", "give 1 or more"
        )
    if raw["repeats"] > MOST_REPEATS:
        raise InputError(
            f"{where}: repeats",
            f"{raw['repeats']} are more than {MOST_REPEATS}",
            "give fewer",
        )
    if raw["angular"] and not artifact.angular_count:
        raise InputError(
            where,
            "angular marks are wanted but the plate has none",
            "set angular to false, or give the plate its angular_count",
        )
    _check_degrees(raw["rotation_deg"], where)
    turn = math.radians(raw["rotation_deg"])
    # without harmonics only grid marks can be read between two lines
    if raw["angular"] is None:
        raw["angular"] = artifact.angular_count > 0 and (
            not raw["grid"]
            or not math.isfinite(turn)
            or turn_in_lines(turn, artifact) is not None
        )
    if not (raw["grid"] or raw["angular"]):
        raise InputError(
            where, "neither grid nor angular marks are wanted", "set one to true"
        )
    return View(
        name=_name(raw["name"], f"{where}: name"),
        rotation_rad=turn,
        translation_m=(a, b),
        grid=raw["grid"],
        angular=raw["angular"],
        repeats=raw["repeats"],
        visit_order=_order(raw["visit_order"], where),
    )


def _check_degrees(rotation_deg: float, where: str) -> None:
    """Raise InputError for a rotation that is a whole number of quarter turns in rad."""
    quarters = rotation_deg / (math.pi / 2) if math.isfinite(rotation_deg) else 0.0
    if 1 <= abs(round(quarters)) <= 4 and math.isclose(
        quarters, round(quarters), rel_tol=ROUNDED
    ):
        raise InputError(
            f"{where}: rotation_deg",
            f"{rotation_deg:g} degrees: is it in rad?",
            f"give {90 * round(quarters)} for {round(quarters)} quarter turns",
        )


def _translation_m(raw: dict, where: str, artifact: Artifact) -> tuple[float, float]:
    """Return the translation of a view in PLAN.yaml, m; (0, 0) if it has none."""
    keys = [
        key for key in ("translation_pitch", "translation_mm") if raw[key] is not None
    ]
    if len(keys) > 1:
        raise InputError(
            where, f"{' and '.join(keys)} are given", "leave one of them out"
        )
    if keys == ["translation_pitch"] and artifact.marks is not None:
        raise InputError(
            f"{where}: translation_pitch",
            "a list of marks has no pitch",
            "give translation_mm: [a, b]",
        )
    shift = raw[keys[0]] if keys else [0, 0]
    if len(shift) != 2 or not all(type(step) in (int, float) for step in shift):
        raise InputError(f"{where}: {keys[0]}", "not two numbers", "give [a, b]")
    if keys == ["translation_mm"]:
        return shift[0] / MM_PER_M, shift[1] / MM_PER_M
    return shift[0] * artifact.grid_pitch_m, shift[1] * artifact.grid_pitch_m


def view_to_dict(view: View, artifact: Artifact) -> dict[str, Any]:
    """Return a view in the format of PLAN.yaml."""
    unit = "pitch" if artifact.marks is None else "mm"
    shift = (
        view.on_stage(artifact).shift
        if unit == "pitch"
        else [value * MM_PER_M for value in view.translation_m]
    )
    order = {"visit_order": view.visit_order} if view.visit_order else {}
    return {
        "name": view.name,
        "rotation_deg": round(math.degrees(view.rotation_rad), 9),
        f"translation_{unit}": [round(step, 9) for step in shift],
        "grid": view.grid,
        "angular": view.angular,
        "repeats": view.repeats,
        **order,
    }


def plan_to_dict(plan: Plan) -> dict[str, Any]:
    """Return a plan in the format of PLAN.yaml."""
    artifact = plan.artifact
    map_fields = map_to_dict(plan.artifact)
    marks, offset_m = plan.check_stops
    return {
        "plan_id": plan.plan_id,
        "artifact": artifact_to_dict(artifact),
        **({"map": map_fields} if map_fields else {}),
        "views": [view_to_dict(view, artifact) for view in plan.views],
        **({"check_stops": {"marks": marks, "offset": offset_m}} if marks else {}),
        **({"image": dict(vars(plan.image))} if plan.image else {}),
        **({"model_terms": list(plan.model_terms)} if plan.model_terms else {}),
        **({"artifact_from": plan.artifact_from} if plan.artifact_from else {}),
        **{key: text for key, text in plan_keys(plan).items() if text},
    }
