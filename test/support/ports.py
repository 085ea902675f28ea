# SPDX-License-Identifier: Apache-2.0
"""Ports of a session that a test holds in its hands: what was published, said, and the time."""

from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.bagio.writer import build
from selfcal_ros.nodes.sessions.health import Level, Ports
from selfcal_ros.settings.nodes import NODE_SETTINGS, Settings

START_NS = 1_700_000_000_000_000_000


class Hands:
    """A clock that stands until it is moved, and lists of what a session did."""

    def __init__(self) -> None:
        self.seconds, self.costs = 100.0, 0.0
        self.worked, self.works = 0.0, 0.0
        self.published: list[tuple[str, dict]] = []
        self.said: list[tuple[Level, str]] = []
        self.ports = Ports(
            self._publish,
            lambda level, line: self.said.append((level, line)),
            lambda: self.seconds,
            lambda: self.now_ns,
            lambda: self.worked,
            lambda: self.now_ns,
        )

    def _publish(self, output: str, fields: dict) -> None:
        """Take what is published; a status takes the time `costs`, and the CPU time `works`."""
        self.published.append((output, fields))
        self.seconds += self.costs if output == "status" else 0.0
        self.worked += self.works if output == "status" else 0.0

    @property
    def now_ns(self) -> int:
        return START_NS + round((self.seconds - 100.0) * 1e9)

    def pass_time(self, seconds: float) -> None:
        self.seconds += seconds

    def of(self, output: str) -> list[dict]:
        return [fields for name, fields in self.published if name == output]

    def lines(self, level: Level) -> list[str]:
        return [line for at, line in self.said if at == level]


def settings_of(node: str, **overrides) -> Settings:
    return NODE_SETTINGS[node].checked(overrides, "test")


def message(kind: str, fields: dict) -> object:
    """Return a message as sessions get it, from the fields that another session published."""
    return build(typestore(), f"selfcal_msgs/msg/{kind}", fields)
