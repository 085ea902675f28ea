# SPDX-License-Identifier: Apache-2.0
"""A map from another source: a table of errors and uncertainties, as `selfcal table` writes."""

from typing import NamedTuple

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import csv_rows
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.plain_numbers import number_of

OFF_SITE = 0.01
"""Largest distance of a position in a table from its site, in pitches (of a line, in spacings)."""
XY = ("x", "y", "gx", "gy", "u_gx", "u_gy")
THETA = ("angle", "g_theta", "u_g_theta")


class _Row(NamedTuple):
    place: str
    cells: dict[str, float]


def map_from_table(text: str, where: str, artifact: Artifact) -> ErrorMap:
    """Return the map in a table, on the sites of a lattice.

    Parameters
    ----------
    text : str
        CSV with the columns x, y, gx, gy, u_gx, u_gy, with or without ``_m``, and optionally
        angle, g_theta, u_g_theta, with or without ``_rad``; SI units, u with k = 1, an empty
        cell = unknown. Other columns are ignored.
    where : str
        File name, for messages.
    artifact : Artifact
        Lattice of the map; sites and lines that the table does not have are unknown.

    Raises
    ------
    InputError
        If the table cannot be read, a position is not a site, or two rows are one site.
    """
    grid = {name: np.full(artifact.shape, np.nan) for name in XY[2:]}
    circle = {name: np.full(artifact.angular_count, np.nan) for name in THETA[1:]}
    places_read: set[tuple[int, ...]] = set()
    for row in _rows(text, where):
        is_site = np.isfinite([row.cells["x"], row.cells["y"]]).all()
        place = _site(row, artifact) if is_site else _line(row, artifact)
        if place in places_read:
            raise InputError(
                row.place, "its site is in the table twice", "delete one of the rows"
            )
        places_read.add(place)
        for name, values in (grid if is_site else circle).items():
            values[place] = row.cells[name]
            if name.startswith("u_") and (values[place] <= 0 or values[place] > 1):
                raise InputError(
                    row.place,
                    f"{name} {values[place]:g} is not a standard uncertainty",
                    "give it in m (rad), k = 1",
                )
    known_sites = np.isfinite(list(grid.values())).all(axis=0)
    if not known_sites.any():
        raise InputError(
            where,
            "no site has an error and its uncertainty",
            "fill the columns gx, gy, u_gx, u_gy",
        )
    gx, gy, u_gx, u_gy = (
        np.where(known_sites, values, np.nan) for values in grid.values()
    )
    return ErrorMap(
        artifact=artifact,
        gx=gx,
        gy=gy,
        u_gx=u_gx,
        u_gy=u_gy,
        g_theta=circle["g_theta"],
        u_g_theta=circle["u_g_theta"],
    )


def _rows(text: str, where: str) -> list[_Row]:
    """Return the rows of a table: known columns by name, NaN where empty or missing."""
    lines = csv_rows(text, where)
    head = (
        [cell.lower().removesuffix("_m").removesuffix("_rad") for cell in lines[0][1]]
        if lines
        else []
    )
    missing = [name for name in XY if name not in head]
    if missing:
        raise InputError(
            f"{where}:1",
            f"no column {', '.join(missing)}",
            "give x, y, gx, gy, u_gx, u_gy in m, as `selfcal table` writes",
        )
    rows = []
    for place, cells in lines[1:]:
        if len(cells) != len(head):
            raise InputError(
                place, f"{len(cells)} cells, not {len(head)}", "correct the line"
            )
        try:
            values = {
                name: number_of(cell) if cell else np.nan
                for name, cell in zip(head, cells, strict=True)
                if name in (*XY, *THETA)
            }
        except ValueError:
            raise InputError(
                place, "a cell is not a number", "correct the line"
            ) from None
        if any(abs(value) > 1e3 for value in values.values()):
            raise InputError(place, "a value beyond 1000 m or rad", "give m and rad")
        rows.append(_Row(place, dict.fromkeys((*XY, *THETA), np.nan) | values))
    return rows


def _site(row: _Row, artifact: Artifact) -> tuple[int, ...]:
    steps = (
        np.array([row.cells["x"], row.cells["y"]]) / artifact.grid_pitch_m
        + artifact.half
    )
    at = np.rint(steps)
    if (
        np.abs(steps - at).max() > OFF_SITE
        or (at < 0).any()
        or (at >= artifact.shape).any()
    ):
        raise InputError(
            row.place,
            f"({row.cells['x']:g}, {row.cells['y']:g}) m is not a site of the other maps",
            "give the errors at their sites",
        )
    return tuple(at.astype(int).tolist())


def _line(row: _Row, artifact: Artifact) -> tuple[int, ...]:
    step = row.cells["angle"] / (2 * np.pi) * artifact.angular_count
    if (
        not abs(step - np.rint(step)) <= OFF_SITE
        or not 0 <= np.rint(step) < artifact.angular_count
    ):
        raise InputError(
            row.place,
            "neither a site nor an angular line of the other maps",
            "give x and y, or the angle, of one",
        )
    return (int(np.rint(step)),)
