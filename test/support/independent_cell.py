# SPDX-License-Identifier: Apache-2.0
"""A machine cell written from the documentation alone: rclpy, the messages, `Bench`.

Nothing of selfcal_ros is imported.
"""

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from selfcal_msgs.msg import MarkDetection, ViewCommand
from sensor_msgs.msg import JointState

from test.support.bench_cell import Bench

STEP_NS, PERIOD_S, IDLE_NS = 400_000, 0.003, 20_000_000


class IndependentCell(Bench, Node):
    """A bench with a driver.

    Parameters
    ----------
    joints : sequence of str
        Order of the joints in a message; those other than x, y, theta are NaN.
    ids, plate_moves, size, seed
        As of `Bench`.
    """

    def __init__(
        self,
        *,
        ids=True,
        plate_moves=False,
        joints=("x", "y", "theta"),
        size=1.0,
        seed=1,
        **kwargs,
    ) -> None:
        Node.__init__(self, "independent_cell", **kwargs)
        Bench.__init__(self, ids=ids, plate_moves=plate_moves, size=size, seed=seed)
        self.joints = joints
        # view, and exposures after which it waits
        self.hold_at: tuple[int, int] | None = None
        self.exposed, self.view = 0, 0
        self._work: list = []
        self._acted = self._idle = 0
        self.marks = self.create_publisher(
            MarkDetection, "stage/mark_detections", QoSProfile(depth=1000)
        )
        self.encoder = self.create_publisher(
            JointState, "stage/joint_states", QoSProfile(depth=1000)
        )
        self.create_subscription(
            ViewCommand,
            "selfcal/view_command",
            self.on_command,
            # a PLACE that MEASURE overtakes would leave the plate where it was
            QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL),
        )
        self.create_timer(PERIOD_S, self.on_timer)

    def now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def on_command(self, view: ViewCommand) -> None:
        stamp = view.header.stamp.sec * 10**9 + view.header.stamp.nanosec
        if stamp <= self._acted:
            return
        self._acted, self._work, self.exposed, self.view = stamp, [], 0, view.view_index
        if view.phase == ViewCommand.PLACE:
            self.lay()
        elif view.phase == ViewCommand.MEASURE:
            self._work = list(self.exposures(view))
        self._due = self.now_ns() + 2 * STEP_NS

    def on_timer(self) -> None:
        """Send what is due: rest, exposure, rest, one after the other."""
        now = self.now_ns()
        if self.held or not self._work:
            self._due = now + 2 * STEP_NS
            if now - self._idle > IDLE_NS:
                self._idle = now
                self.send(self.encoder, self.sample(self.home), now)
        while self._work and self._due + 2 * STEP_NS < now and not self.held:
            position, seen = self._work.pop(0)
            self.send(self.encoder, self.sample(position), self._due)
            self.send(self.marks, MarkDetection(**seen), self._due + STEP_NS)
            self.send(self.encoder, self.sample(position), self._due + 2 * STEP_NS)
            self._due += 3 * STEP_NS
            self.exposed += 1

    @property
    def held(self) -> bool:
        return self.hold_at is not None and (self.view, self.exposed) >= self.hold_at

    def sample(self, position) -> JointState:
        where = dict(zip(("x", "y", "theta"), position, strict=True))
        return JointState(
            name=list(self.joints),
            position=[float(where.get(name, np.nan)) for name in self.joints],
        )

    def send(self, publisher, message, stamp_ns: int) -> None:
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        publisher.publish(message)
