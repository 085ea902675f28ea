# SPDX-License-Identifier: Apache-2.0
"""Names, types and quality of service of all topics, declared once.

Names are relative: a namespace is put in front.
"""

from pathlib import Path

LARGEST_DOMAIN = 232
"""Largest ROS domain whose ports exist."""
IMAGE_TOPICS = {"raw": "stage/image", "compressed": "stage/image/compressed"}
IMAGE_TYPES = {
    "raw": "sensor_msgs/msg/Image",
    "compressed": "sensor_msgs/msg/CompressedImage",
}
ENCODER_TOPIC = "stage/joint_states"
DETECTION_TOPIC = "stage/mark_detections"
CORRECTED_TOPIC = "stage/corrected_joint_states"
MOTION_TOPIC = "stage/command"
CORRECTED_MOTION_TOPIC = "stage/corrected_command"
COMMAND_TOPIC = "selfcal/view_command"
STATUS_TOPIC = "selfcal/view_status"
MEASUREMENT_TOPIC = "selfcal/view_measurement"
ERROR_MAP_TOPIC = "selfcal/error_map"
SUMMARY_TOPIC = "selfcal/summary"
PROGRESS_TOPIC = "selfcal/progress"
MAP_MARKERS_TOPIC = "selfcal/map_markers"

INPUT_TOPICS = {
    ENCODER_TOPIC: "sensor_msgs/msg/JointState",
    DETECTION_TOPIC: "selfcal_msgs/msg/MarkDetection",
    COMMAND_TOPIC: "selfcal_msgs/msg/ViewCommand",
}
"""Type of each input topic."""

REQUESTS = {
    "start": "start",
    "confirm": "confirm_view",
    "redo": "redo_view",
    "skip": "skip_view",
    "abort": "abort",
}
"""Requests to the sequencer, as a person gives them -> services of pose_sequencer."""

INFINITE = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(*, reliable: bool, transient_local: bool, depth: int) -> dict:
    """Return an offered QoS profile in the format of rosbag2 (Jazzy)."""
    return {
        "history": "keep_last",
        "depth": depth,
        "reliability": "reliable" if reliable else "best_effort",
        "durability": "transient_local" if transient_local else "volatile",
        "deadline": INFINITE,
        "lifespan": INFINITE,
        "liveliness": "automatic",
        "liveliness_lease_duration": INFINITE,
        "avoid_ros_namespace_conventions": False,
    }


def message_texts() -> dict[str, str]:
    """Return the .msg file of each message of this package: of the source tree, or installed."""
    source = Path(__file__).parents[1] / "msg_defs" / "msg"
    folder = source if source.is_dir() else Path(__file__).parent / "msg_text"
    return {file.stem: file.read_text() for file in sorted(folder.glob("*.msg"))}
