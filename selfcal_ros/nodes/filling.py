# SPDX-License-Identifier: Apache-2.0
"""Messages of rclpy from plain nested dicts and error maps, and back to the types of sessions."""

import array
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from selfcal_ros.errors import printable
from selfcal_ros.messages.from_model import header
from selfcal_ros.model.error_map import ErrorMap
from selfcal_ros.reporting.markers import map_geometry
from selfcal_ros.sessions.ports import Diagnosis, Level


def fill(message: Any, fields: dict[str, Any]) -> Any:
    """Return an rclpy message with its fields set from a plain nested dict."""
    for name, value in fields.items():
        if isinstance(value, dict):
            fill(getattr(message, name), value)
        elif isinstance(value, np.ndarray):
            current = getattr(message, name)
            if isinstance(current, array.array):
                code = current.typecode
                fits = np.can_cast(value.dtype, code)  # otherwise `array` checks each number
                value = array.array(code, value.astype(code).tobytes() if fits else value.tolist())
            setattr(message, name, value)
        else:
            setattr(message, name, value)
    return message


def status_of(diagnosis: Diagnosis, name: str, hardware_id: str) -> DiagnosticStatus:
    """Return the status message of a diagnosis; control characters are made visible."""
    return DiagnosticStatus(
        level=bytes([diagnosis.level]), name=name, message=printable(diagnosis.message),
        hardware_id=printable(hardware_id),
        values=[KeyValue(key=printable(key), value=printable(str(value)))
                for key, value in diagnosis.values.items()])


def diagnosis_of(status: DiagnosticStatus) -> Diagnosis:
    """Return the diagnosis in a status message; an unknown level counts as ERROR."""
    level = status.level[0]
    return Diagnosis(Level(level) if level in list(Level) else Level.ERROR, status.message,
                     {item.key: item.value for item in status.values})


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
