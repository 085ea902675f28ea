# SPDX-License-Identifier: Apache-2.0
"""What mark_detector needs in tests of all nodes: parameters, and a camera on the graph."""

from selfcal_ros.nodes import names

DETECTS = {"pixel_size": 2e-6, "mark_size": 5e-5}
"""Parameters that it cannot do without."""


def camera(graph):
    """Return a publisher of images: they are subscribed to as they are offered."""
    topic = names.image_topics("raw", 100)[0]
    return graph.hand.create_publisher(topic.type, topic.name, topic.qos)
