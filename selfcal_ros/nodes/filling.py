# SPDX-License-Identifier: Apache-2.0
"""Messages of rclpy from plain nested dicts and error maps, and back to the types of sessions."""

import array
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from selfcal_ros.bagio.messages.from_model import header
from selfcal_ros.errors import printable
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.nodes.sessions.health import Diagnosis, Level
from selfcal_ros.reporting.figures.drawing import round_down
from selfcal_ros.units import UM_PER_M

MOST_SITES = 51
"""Sites shown along a side; larger fields show every second, third, ... site."""
CERTAIN, UNCERTAIN, UNKNOWN = (0.85, 0.93, 1.0), (0.0, 0.27, 0.61), (0.6, 0.6, 0.6)


@dataclass(frozen=True)
class MapGeometry:
    """What to draw, stage frame, m.

    Attributes
    ----------
    factor : float
        Enlargement of the error vectors: 1, 2 or 5 times a power of ten, so that the longest one
        is no longer than the distance of the sites shown.
    ends : float array (2 n, 3)
        Nominal site and head of its vector, in turn; head = site + factor * G.
    sites : float array (n, 3)
        Nominal sites.
    colours : float array (n, 3)
        RGB 0..1: pale where u is 0, dark where it is largest, grey where it is not known.
    spacing_m : float
        Distance of the sites shown.
    legend : str
        What length and colour mean.
    legend_at : tuple of float
        Place of the legend, below the field.
    """

    factor: float
    ends: np.ndarray
    sites: np.ndarray
    colours: np.ndarray
    spacing_m: float
    legend: str
    legend_at: tuple[float, float, float]


def map_geometry(error_map: ErrorMap) -> MapGeometry:
    """Return the geometry of the sites of `error_map` whose error is known."""
    artifact = error_map.artifact
    step = math.ceil(max(artifact.shape) / MOST_SITES)
    spacing = step * artifact.grid_pitch_m
    m = artifact.m[:, 0]
    n = artifact.n[0]
    shown_sites = error_map.valid & (
        (m % step == 0)[:, None] & (n % step == 0)[None, :]
    )
    x = artifact.x_m[shown_sites]
    y = artifact.y_m[shown_sites]
    zero = np.zeros(np.count_nonzero(shown_sites))
    sites = np.column_stack((x, y, zero))
    errors = np.column_stack(
        (error_map.gx[shown_sites], error_map.gy[shown_sites], zero)
    )
    longest = float(np.linalg.norm(errors, axis=1).max(initial=0.0))
    factor = enlargement(spacing, longest)
    ends = np.stack((sites, sites + factor * errors), axis=1).reshape(-1, 3)
    u = np.hypot(error_map.u_gx[shown_sites], error_map.u_gy[shown_sites])
    largest = float(np.max(u, where=np.isfinite(u), initial=0.0))
    legend = (
        f"stage error (indicated - true), enlarged {factor:,.0f} x, longest "
        f"{longest * UM_PER_M:.3g} um; dark: u = {largest * UM_PER_M:.3g} um (k=1)"
    )
    below = -(artifact.half[1] * artifact.grid_pitch_m + 1.5 * spacing)
    return MapGeometry(
        factor=factor,
        ends=ends,
        sites=sites,
        colours=_colours(u, largest),
        spacing_m=spacing,
        legend=legend,
        legend_at=(0.0, below, 0.0),
    )


def enlargement(spacing_m: float, longest_m: float) -> float:
    """Return the largest of 1, 2, 5, 10, ... times that keeps `longest_m` within `spacing_m`."""
    if longest_m <= 0 or longest_m >= spacing_m:
        return 1.0
    return round_down(spacing_m / longest_m)


def _colours(u: np.ndarray, largest: float) -> np.ndarray:
    fraction = (u / largest if largest > 0 else np.zeros_like(u))[:, None]
    colours = (1 - fraction) * CERTAIN + fraction * UNCERTAIN
    colours[~np.isfinite(u)] = UNKNOWN
    return colours


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Return an rclpy message with its fields set from a plain nested dict."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            current = getattr(message, name)
            if isinstance(current, array.array):
                code = current.typecode
                # otherwise `array` checks each number
                fits = np.can_cast(value.dtype, code)
                value = array.array(
                    code, value.astype(code).tobytes() if fits else value.tolist()
                )
            setattr(message, name, value)
        else:
            setattr(message, name, value)
    return message


def status_of(diagnosis: Diagnosis, name: str, hardware_id: str) -> DiagnosticStatus:
    """Return the status message of a diagnosis; control characters are made visible."""
    return DiagnosticStatus(
        level=bytes([diagnosis.level]),
        name=name,
        message=printable(diagnosis.message),
        hardware_id=printable(hardware_id),
        values=[
            KeyValue(key=printable(key), value=printable(str(value)))
            for key, value in diagnosis.values.items()
        ],
    )


def diagnosis_of(status: DiagnosticStatus) -> Diagnosis:
    """Return the diagnosis in a status message; an unknown level counts as ERROR."""
    level = status.level[0]
    return Diagnosis(
        Level(level) if level in list(Level) else Level.ERROR,
        status.message,
        {item.key: item.value for item in status.values},
    )


UNKNOWN_PITCH_M = 1e-3
"""Of a plate with a list of marks, for the size of what is drawn."""
INK, RED = (0.1, 0.1, 0.1), (0.8, 0.1, 0.1)


def map_markers(error_map: ErrorMap, stamp_ns: int, frame_id: str) -> MarkerArray:
    """Return vectors (LINE_LIST), uncertainties (CUBE_LIST) and legend of an error map."""
    shape = map_geometry(error_map)
    wide = shape.spacing_m

    def marker(number: int, kind: int, namespace: str, **fields: Any) -> Marker:
        return fill(
            Marker(),
            {
                "header": header(stamp_ns, frame_id),
                "id": number,
                "type": kind,
                "ns": namespace,
                "action": Marker.ADD,
                "color": _colour(INK),
                "pose": {"orientation": {"w": 1.0}},
                **fields,
            },
        )

    return MarkerArray(
        markers=[
            marker(
                0,
                Marker.LINE_LIST,
                "error",
                scale={"x": wide / 20},
                points=_points(shape.ends),
            ),
            marker(
                1,
                Marker.CUBE_LIST,
                "uncertainty",
                scale={"x": 0.9 * wide, "y": 0.9 * wide, "z": wide / 100},
                points=_points(
                    shape.sites - (0.0, 0.0, wide / 20)
                ),  # below the vectors
                colors=[_colour(rgb) for rgb in shape.colours.tolist()],
            ),
            marker(
                2,
                Marker.TEXT_VIEW_FACING,
                "legend",
                scale={"z": wide / 3},
                text=shape.legend,
                pose={
                    "position": dict(zip("xyz", shape.legend_at, strict=True)),
                    "orientation": {"w": 1.0},
                },
            ),
        ]
    )


def rejected_marker(measurement: Any, frame_id: str) -> Marker:
    """Return where the stage stood at the rejected detections of a view.

    It takes the place of that of the view's earlier measurement, and deletes it if there are none.
    """
    wide = measurement.map_grid_pitch or measurement.grid_pitch or UNKNOWN_PITCH_M
    places = np.stack([measurement.rejected_x, measurement.rejected_y], axis=1)
    finite = np.isfinite(places).all(axis=1)
    above = np.full((finite.sum(), 1), wide / 20)  # the vectors of the map
    return fill(
        Marker(),
        {
            "header": {"stamp": measurement.header.stamp, "frame_id": frame_id},
            "ns": "rejected",
            "id": int(measurement.view_index),
            "type": Marker.POINTS,
            "action": Marker.ADD if finite.any() else Marker.DELETE,
            "scale": {"x": wide / 5, "y": wide / 5},
            "color": _colour(RED),
            "pose": {"orientation": {"w": 1.0}},
            "points": _points(np.hstack([places[finite], above])),
        },
    )


def _points(places: np.ndarray) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in places.tolist()]


def _colour(rgb: tuple | list) -> ColorRGBA:
    return ColorRGBA(**dict(zip("rgba", (*rgb, 1.0), strict=True)))
