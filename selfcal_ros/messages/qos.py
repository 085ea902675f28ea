# SPDX-License-Identifier: Apache-2.0
"""Quality of service in the words of rosbag2."""

INFINITE = {"sec": 9223372036, "nsec": 854775807}


def qos_profile(*, reliable: bool, transient_local: bool, depth: int) -> dict:
    """Return one offered QoS profile as rosbag2 (Jazzy) writes it."""
    return {"history": "keep_last", "depth": depth,
            "reliability": "reliable" if reliable else "best_effort",
            "durability": "transient_local" if transient_local else "volatile",
            "deadline": INFINITE, "lifespan": INFINITE, "liveliness": "automatic",
            "liveliness_lease_duration": INFINITE, "avoid_ros_namespace_conventions": False}
