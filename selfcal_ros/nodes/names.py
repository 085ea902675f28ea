# SPDX-License-Identifier: Apache-2.0
"""Every topic with its type and QoS, named once. Names are relative: a namespace goes in front."""

from dataclasses import dataclass

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from selfcal_msgs.msg import (
    CalibrationSummary,
    ErrorMap,
    MarkDetection,
    ViewCommand,
    ViewMeasurement,
    ViewStatus,
)
from sensor_msgs.msg import JointState
from visualization_msgs.msg import MarkerArray


@dataclass(frozen=True)
class Topic:
    """Name, message type, QoS."""

    name: str
    type: type
    qos: QoSProfile


def _qos(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE)


# 1 kHz of encoder: a hiccup of a second must not overwrite a sample
ENCODER = Topic("stage/joint_states", JointState, _qos(5000))
ENCODER_BEST_EFFORT = Topic("stage/joint_states", JointState, _qos(5000, reliable=False))
DETECTIONS = Topic("stage/mark_detections", MarkDetection, _qos(5000))
COMMAND = Topic("selfcal/view_command", ViewCommand, _qos(256, latched=True))
STATUS = Topic("selfcal/view_status", ViewStatus, _qos(64))
MEASUREMENT = Topic("selfcal/view_measurement", ViewMeasurement, _qos(64, latched=True))
ERROR_MAP = Topic("selfcal/error_map", ErrorMap, _qos(1, latched=True))
SUMMARY = Topic("selfcal/summary", CalibrationSummary, _qos(1, latched=True))
MAP_MARKERS = Topic("selfcal/map_markers", MarkerArray, _qos(1, latched=True))
CORRECTED = Topic("stage/corrected_joint_states", JointState, _qos(100, reliable=False))

INPUTS = (ENCODER, DETECTIONS, COMMAND)
RESULTS = (STATUS, MEASUREMENT, ERROR_MAP, SUMMARY, CORRECTED)
