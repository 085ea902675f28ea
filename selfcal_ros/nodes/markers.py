# SPDX-License-Identifier: Apache-2.0
"""The geometry of an error map as markers of RViz."""

from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from selfcal_ros.messages.from_model import header
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.nodes.filling import fill
from selfcal_ros.reporting.markers import map_geometry

INK = (0.1, 0.1, 0.1)


def map_markers(error_map: ErrorMap, stamp_ns: int, frame_id: str) -> MarkerArray:
    """Return vectors (LINE_LIST), uncertainties (CUBE_LIST) and legend of an error map."""
    shape = map_geometry(error_map)
    wide = shape.spacing_m

    def marker(number: int, kind: int, namespace: str, **fields: Any) -> Marker:
        return fill(Marker(), {
            "header": header(stamp_ns, frame_id), "id": number, "type": kind, "ns": namespace,
            "action": Marker.ADD, "color": _colour(INK), "pose": {"orientation": {"w": 1.0}},
            **fields})
    return MarkerArray(markers=[
        marker(0, Marker.LINE_LIST, "error", scale={"x": wide / 20}, points=_points(shape.ends)),
        marker(1, Marker.CUBE_LIST, "uncertainty",
               scale={"x": 0.9 * wide, "y": 0.9 * wide, "z": wide / 100},
               points=_points(shape.sites - (0.0, 0.0, wide / 20)),  # below the vectors
               colors=[_colour(rgb) for rgb in shape.colours.tolist()]),
        marker(2, Marker.TEXT_VIEW_FACING, "legend", scale={"z": wide / 3}, text=shape.legend,
               pose={"position": dict(zip("xyz", shape.legend_at, strict=True)),
                     "orientation": {"w": 1.0}})])


def _points(places: np.ndarray) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in places.tolist()]


def _colour(rgb: tuple | list) -> ColorRGBA:
    return ColorRGBA(**dict(zip("rgba", (*rgb, 1.0), strict=True)))
