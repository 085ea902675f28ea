# SPDX-License-Identifier: Apache-2.0
"""Plates and the nodes of their maps in the form of files, checked, and back."""

from dataclasses import replace
from typing import Any

from selfcal_ros.errors import InputError
from selfcal_ros.files import checked_fields
from selfcal_ros.model.artifact import Artifact, Interpolation, MapGrid
from selfcal_ros.model.marks import marks_of


def map_to_dict(artifact: Artifact) -> dict[str, Any]:
    """Return what a map has of its own in the form of ``map`` in PLAN.yaml; empty if nothing."""
    grid = artifact.map_grid
    map_fields = {}
    if grid is not None:
        map_fields = {
            "grid_size": grid.size,
            "grid_pitch": grid.pitch_m,
            "interpolation": str(grid.interpolation),
            **({"grid_size_y": grid.size_y} if grid.size_y else {}),
        }
    return map_fields | (
        {"harmonics": artifact.harmonics} if artifact.harmonics else {}
    )


def map_grid_from_dict(data: dict[str, Any]) -> MapGrid | None:
    """Return the nodes of `map_to_dict`; None if there are none.

    Raises
    ------
    KeyError, ValueError
        If a key is missing, or the interpolation is unknown.
    """
    if not set(data) - {"harmonics"}:
        return None
    return MapGrid(
        data["grid_size"],
        float(data["grid_pitch"]),
        Interpolation(data["interpolation"]),
        data.get("grid_size_y", 0),
    )


def harmonics_of(data: dict, where: str) -> int:
    """Return the harmonics of the angular map in a plan; 0 if it does not give them."""
    fields = {"harmonics": data.get("harmonics", 0)}
    return checked_fields(fields, where, {"harmonics": int})["harmonics"]


def map_grid_of(data: dict, artifact: Artifact, where: str) -> MapGrid | None:
    """Return the nodes of the map; None if the plan does not give them."""
    if not set(data) - {"harmonics"}:
        return None
    raw = checked_fields(
        data,
        where,
        {"grid_size": int},
        {
            "grid_pitch": (float, 0.0),
            "interpolation": (str, str(Interpolation.BICUBIC)),
            "grid_size_y": (int, 0),
            "harmonics": (int, 0),
        },
    )
    if raw["interpolation"] not in list(Interpolation):
        raise InputError(
            f"{where}: interpolation",
            f"'{raw['interpolation']}' is not known",
            f"use one of {', '.join(Interpolation)}",
        )
    sizes = raw["grid_size"], raw["grid_size_y"] or raw["grid_size"]
    spans = max(
        2 * half / max(size - 1, 1)
        for half, size in zip(artifact.reach, sizes, strict=True)
    )
    return MapGrid(
        sizes[0],
        raw["grid_pitch"] or spans * artifact.grid_pitch_m,
        Interpolation(raw["interpolation"]),
        raw["grid_size_y"],
    )


def artifact_of(data: dict, where: str) -> Artifact:
    """Return the plate of a mapping without the nodes of its map.

    Parameters
    ----------
    data : dict
        ``grid_size`` (a number or [along x, along y]), ``grid_pitch`` (m), ``angular_count`` and
        optionally ``grid_size_y``; or ``marks {id, x, y}``, lists (m), and optionally
        ``angular_count``.
    where : str
        File name and key, for messages.

    Raises
    ------
    InputError
        For a missing or unknown key, a wrong type, or an impossible plate.
    """
    if "marks" in data:
        raw = checked_fields(data, where, {"marks": dict}, {"angular_count": (int, 0)})
        lists = checked_fields(
            raw["marks"], f"{where}: marks", dict.fromkeys("xy", list) | {"id": list}
        )
        if len({len(column) for column in lists.values()}) > 1 or not all(
            type(value) in ((int,) if key == "id" else (int, float))
            for key, column in lists.items()
            for value in column
        ):
            raise InputError(
                f"{where}: marks",
                "id, x and y are not as many numbers each",
                "give each mark a whole id, x and y in m",
            )
        return Artifact(
            0,
            0.0,
            raw["angular_count"],
            marks=marks_of(lists["id"], lists["x"], lists["y"]),
        )
    raw = checked_fields(
        _with_sides(data, where),
        where,
        {"grid_size": int, "grid_pitch": float},
        # marks, which are not here, are named where a key is not known
        {"angular_count": (int, 0), "grid_size_y": (int, 0), "marks": (dict, {})},
    )
    return Artifact(
        raw["grid_size"], raw["grid_pitch"], raw["angular_count"], raw["grid_size_y"]
    )


def _with_sides(data: dict, where: str) -> dict:
    """Return a mapping with ``grid_size_y`` instead of a ``grid_size`` of two numbers."""
    sides = data.get("grid_size") if isinstance(data, dict) else None
    if not isinstance(sides, list):
        return data
    if (
        len(sides) != 2
        or "grid_size_y" in data
        or not all(type(size) is int for size in sides)
    ):
        raise InputError(
            f"{where}: grid_size",
            f"{sides!r} is not a number of marks along x and y",
            "give [8, 6], or grid_size and grid_size_y",
        )
    return data | {
        "grid_size": sides[0],
        "grid_size_y": sides[1] if sides[1] != sides[0] else 0,
    }


def artifact_to_dict(artifact: Artifact) -> dict[str, Any]:
    """Return a plate as `artifact_of` takes it."""
    count = {"angular_count": artifact.angular_count}
    if artifact.marks is not None:
        marks = artifact.marks
        return {
            "marks": {
                "id": list(marks.ids),
                "x": list(marks.x_m),
                "y": list(marks.y_m),
            },
            **count,
        }
    return {
        "grid_size": artifact.grid_size,
        "grid_pitch": artifact.grid_pitch_m,
        **count,
        **({"grid_size_y": artifact.grid_size_y} if artifact.grid_size_y else {}),
    }


def with_nodes(artifact: Artifact, text: str, where: str) -> Artifact:
    """Return the plate with a map of NODES[:INTERPOLATION] over the same field."""
    size, _, interpolation = text.partition(":")
    if not (size.isascii() and size.isdecimal() and int(size) >= 3):
        raise InputError(
            where,
            f"'{text}' is not NODES[:INTERPOLATION]",
            "give a number of nodes a side from 3 on, e.g. 9:bicubic",
        )
    fields = {
        "grid_size": int(size),
        "interpolation": interpolation or str(Interpolation.BICUBIC),
    }
    field = artifact.field
    if field.half[0] == field.half[1]:
        fields["grid_pitch"] = 2 * field.half[0] * field.grid_pitch_m / (int(size) - 1)
    return replace(artifact, map_grid=map_grid_of(fields, artifact, where))
