# SPDX-License-Identifier: Apache-2.0
"""config/rosbag2: the recorder of ROS 2 gets the queues that this package's own nodes have."""

from pathlib import Path

from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
)

from selfcal_ros.files import read_yaml
from selfcal_ros.nodes import names

FILE = Path(__file__).parents[2] / "config/rosbag2/record_qos.yaml"
KINDS = {
    "history": HistoryPolicy,
    "reliability": ReliabilityPolicy,
    "durability": DurabilityPolicy,
}


def overrides() -> dict[str, QoSProfile]:
    """Read the file as ros2bag does."""
    return {
        topic.removeprefix("/"): QoSProfile(
            **{
                key: KINDS[key].get_from_short_key(value) if key in KINDS else value
                for key, value in profile.items()
            }
        )
        for topic, profile in read_yaml(FILE).items()
    }


def test_every_input_has_the_depth_of_the_own_recorder():
    found = overrides()
    assert {topic.name for topic in names.INPUTS} == set(found)
    for topic in names.INPUTS:
        assert found[topic.name].depth == topic.qos.depth
        assert found[topic.name].durability == topic.qos.durability


def test_it_hears_whatever_the_contract_lets_a_cell_offer():
    for offer in (
        names.ENCODER,
        names.ENCODER_EITHER[1],
        names.DETECTIONS,
        names.COMMAND,
    ):
        verdict, reason = qos_check_compatible(offer.qos, overrides()[offer.name])
        assert verdict != QoSCompatibility.ERROR, reason
