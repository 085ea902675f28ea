# SPDX-License-Identifier: Apache-2.0
"""Every topic with its message type and QoS; names are declared in `topics`."""

from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticStatus
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
from std_msgs.msg import String, UInt64MultiArray
from visualization_msgs.msg import MarkerArray

from selfcal_ros import topics


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


# encoder at 1 kHz: a pause of a second must not overwrite a sample
ENCODER = Topic(topics.ENCODER_TOPIC, JointState, _qos(5000))
ENCODER_BEST_EFFORT = Topic(topics.ENCODER_TOPIC, JointState, _qos(5000, reliable=False))
# corrected positions of earlier, displaced samples are useless
ENCODER_NEWEST = Topic(topics.ENCODER_TOPIC, JointState, _qos(100, reliable=False))
DETECTIONS = Topic(topics.DETECTION_TOPIC, MarkDetection, _qos(5000))
COMMAND = Topic(topics.COMMAND_TOPIC, ViewCommand, _qos(256, latched=True))
NEWEST_COMMAND = Topic(topics.COMMAND_TOPIC, ViewCommand, _qos(1, latched=True))
"""Offered by a sequencer: a late cell acts on the first command that it receives."""
STATUS = Topic(topics.STATUS_TOPIC, ViewStatus, _qos(64, latched=True))
STATUS_AS_IT_COMES = Topic(topics.STATUS_TOPIC, ViewStatus, _qos(64))
MEASUREMENT = Topic(topics.MEASUREMENT_TOPIC, ViewMeasurement, _qos(64, latched=True))
ERROR_MAP = Topic(topics.ERROR_MAP_TOPIC, ErrorMap, _qos(1, latched=True))
SUMMARY = Topic(topics.SUMMARY_TOPIC, CalibrationSummary, _qos(1, latched=True))
MAP_MARKERS = Topic(topics.MAP_MARKERS_TOPIC, MarkerArray, _qos(1, latched=True))
CORRECTED = Topic(topics.CORRECTED_TOPIC, JointState, _qos(100, reliable=False))

# below the node's own name (~/)
HEALTH = Topic("health", DiagnosticStatus, _qos(1, latched=True))
RECEIVED = Topic("received", UInt64MultiArray, _qos(1, latched=True))
"""The collector's counts of encoder samples, detections and commands, for a player's pace."""
SOLVED = Topic("solved", String, _qos(1, latched=True))
"""The solver's fingerprint of the readings behind its results."""


def of_node(node: str, topic: Topic) -> Topic:
    """Return the topic below a node's name as seen by others in its namespace."""
    return Topic(f"{node}/{topic.name}", topic.type, topic.qos)


def private(topic: Topic) -> Topic:
    """Return the topic as named by the node itself."""
    return Topic(f"~/{topic.name}", topic.type, topic.qos)


INPUTS = (ENCODER, DETECTIONS, COMMAND)
RESULTS = (STATUS, MEASUREMENT, ERROR_MAP, SUMMARY, CORRECTED)
