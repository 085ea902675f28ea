# SPDX-License-Identifier: Apache-2.0
"""The names of all topics, declared once. They are relative: a namespace goes in front."""

ENCODER_TOPIC = "stage/joint_states"
DETECTION_TOPIC = "stage/mark_detections"
CORRECTED_TOPIC = "stage/corrected_joint_states"
COMMAND_TOPIC = "selfcal/view_command"
STATUS_TOPIC = "selfcal/view_status"
MEASUREMENT_TOPIC = "selfcal/view_measurement"
ERROR_MAP_TOPIC = "selfcal/error_map"
SUMMARY_TOPIC = "selfcal/summary"
MAP_MARKERS_TOPIC = "selfcal/map_markers"

INPUT_TOPICS = {
    ENCODER_TOPIC: "sensor_msgs/msg/JointState",
    DETECTION_TOPIC: "selfcal_msgs/msg/MarkDetection",
    COMMAND_TOPIC: "selfcal_msgs/msg/ViewCommand",
}
"""Type of each topic that readings are made of."""
