# SPDX-License-Identifier: Apache-2.0
"""Bags of a step-diagonal measurement."""

from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.topics import qos_profile

EPOCH_NS = 1_700_000_000_000_000_000
QOS = [qos_profile(reliable=True, transient_local=False, depth=10)]


def _header(stamp_ns):
    return {
        "stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9},
        "frame_id": "",
    }


def laser_fields(kind, stamp_ns, value):
    """Return the fields of one laser message."""
    return {
        "std_msgs/msg/Float64": {"data": value},
        "sensor_msgs/msg/Range": {
            "header": _header(stamp_ns),
            "radiation_type": 1,
            "field_of_view": 0.0,
            "min_range": 0.0,
            "max_range": 1.0,
            "range": value,
            "variance": 0.0,
        },
        "sensor_msgs/msg/JointState": {
            "header": _header(stamp_ns),
            "name": ["laser"],
            "position": [value],
            "velocity": [],
            "effort": [],
        },
        "sensor_msgs/msg/Temperature": {
            "header": _header(stamp_ns),
            "temperature": value,
            "variance": 0.0,
        },
    }[kind]


def position_fields(kind, stamp_ns, values):
    """Return the fields of one message of axis positions."""
    x, y, *rest = values
    point = {"x": x, "y": y, "z": rest[0] if rest else 0.0}
    return {
        "sensor_msgs/msg/JointState": {
            "header": _header(stamp_ns),
            "name": ["theta", "x", "y", "z"][: 1 + len(values)],
            "position": [0.5, *values],
            "velocity": [],
            "effort": [],
        },
        "geometry_msgs/msg/PointStamped": {"header": _header(stamp_ns), "point": point},
        "geometry_msgs/msg/PoseStamped": {
            "header": _header(stamp_ns),
            "pose": {
                "position": point,
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        },
    }[kind]


def write_laser_bag(
    path,
    series,
    *,
    laser="std_msgs/msg/Float64",
    position="sensor_msgs/msg/JointState",
    backwards=False,
):
    """Write a recording as a bag; `backwards` puts the messages in reverse order."""
    items = [
        (
            int(t) + EPOCH_NS,
            "cell/laser",
            laser_fields(laser, int(t) + EPOCH_NS, float(v)),
        )
        for t, v in zip(series.laser_ns, series.laser_m, strict=True)
    ]
    items += [
        (
            int(t) + EPOCH_NS,
            "cell/axes",
            position_fields(position, int(t) + EPOCH_NS, [float(v) for v in row]),
        )
        for t, row in zip(series.position_ns, series.position_m, strict=True)
    ]
    items.sort(key=lambda item: item[0], reverse=backwards)
    with BagWriter(path) as bag:
        bag.add_topic("/cell/laser", laser, QOS)
        bag.add_topic("/cell/axes", position, QOS)
        bag.add_topic("/cell/other", "std_msgs/msg/Float64", QOS)
        bag.write("/cell/other", {"data": 1.0}, EPOCH_NS)
        for stamp, topic, fields in items:
            bag.write("/" + topic, fields, stamp)
    return path
