# SPDX-License-Identifier: Apache-2.0
"""The names and types of all topics and their quality of service, declared once.

Names are relative: a namespace goes in front.
"""

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

INFINITE = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(*, reliable: bool, transient_local: bool, depth: int) -> dict:
    """Return one offered QoS profile as rosbag2 (Jazzy) writes it."""
    return {"history": "keep_last", "depth": depth,
            "reliability": "reliable" if reliable else "best_effort",
            "durability": "transient_local" if transient_local else "volatile",
            "deadline": INFINITE, "lifespan": INFINITE, "liveliness": "automatic",
            "liveliness_lease_duration": INFINITE, "avoid_ros_namespace_conventions": False}
