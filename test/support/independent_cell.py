# SPDX-License-Identifier: Apache-2.0
"""A machine cell written from the documentation alone: rclpy, the messages, numpy, own formulas.

Nothing of selfcal_ros is imported. Signs are those of cell.md: an indicated position is the
true one plus the stage's error there; an offset is mark centre less optical axis, in stage axes.
"""

import numpy as np
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rclpy.time import Time
from selfcal_msgs.msg import MarkDetection, ViewCommand
from sensor_msgs.msg import JointState

STEP_NS, PERIOD_S, IDLE_NS = 400_000, 0.003, 20_000_000
NOISE_M, NOISE_RAD = 2e-9, 1e-7
QUARTERS = {0: ((1, 0), (0, 1)), 1: ((0, -1), (1, 0)), 2: ((-1, 0), (0, -1)), 3: ((0, 1), (-1, 0))}


def error_m(x, y):
    """Return the stage's error where it is indicated at x, y (m): what is to be found, m."""
    return (3e-7 * np.sin(120 * x) * np.cos(80 * y) + 1e-7 * np.cos(70 * y),
            2e-7 * np.cos(90 * x + 60 * y) - 2e-7 * np.sin(50 * x))


def error_rad(theta):
    """Return the rotary encoder's error where it indicates theta."""
    return 3e-5 * np.sin(theta) + 2e-5 * np.cos(2 * theta)


class IndependentCell(Node):
    """Encoders, microscope and plate.

    Parameters
    ----------
    ids : bool
        Whether detections tell which mark they are of.
    plate_moves : bool
        Whether the plate rides on the stage, below a microscope that rests.
    joints : sequence of str
        Order of the joints in a message; those other than x, y, theta are NaN.
    size : float
        Factor of the stage's error.
    """

    def __init__(self, *, ids=True, plate_moves=False, joints=("x", "y", "theta"), size=1.0,
                 seed=1, **kwargs) -> None:
        super().__init__("independent_cell", **kwargs)
        self.ids, self.sign, self.joints, self.size = ids, -1 if plate_moves else 1, joints, size
        self.rng = np.random.default_rng(seed)
        self.plate = self.rng.normal(0, 3e-7, (2, 99, 99))
        self.lines = self.rng.normal(0, 2e-5, 99)
        self.laid = np.zeros(3)
        self.home = (0.0, 0.0, 0.0)
        self.hold_at: tuple[int, int] | None = None  # view, and exposures after which it waits
        self.exposed, self.view = 0, 0
        self._work: list = []
        self._acted = self._idle = 0
        self.marks = self.create_publisher(MarkDetection, "stage/mark_detections",
                                           QoSProfile(depth=1000))
        self.encoder = self.create_publisher(JointState, "stage/joint_states",
                                             QoSProfile(depth=1000))
        self.create_subscription(ViewCommand, "selfcal/view_command", self.on_command, QoSProfile(
            depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
        self.create_timer(PERIOD_S, self.on_timer)

    def now_ns(self) -> int:
        return self.get_clock().now().nanoseconds

    def on_command(self, view: ViewCommand) -> None:
        stamp = view.header.stamp.sec * 10**9 + view.header.stamp.nanosec
        if stamp <= self._acted:
            return
        self._acted, self._work, self.exposed, self.view = stamp, [], 0, view.view_index
        if view.phase == ViewCommand.PLACE:
            self.laid = self.rng.normal(0, (5e-4, 2e-5, 2e-5))
        elif view.phase == ViewCommand.MEASURE:
            self._work = list(self.exposures(view))
        self._due = self.now_ns() + 2 * STEP_NS

    def exposures(self, view):
        """Yield indicated position and detection of all that the view asks for."""
        for _ in range(view.repeats):
            if view.grid:
                yield from self.grid(view)
            if view.angular:
                for k in range(view.angular_count):
                    yield self.line(view, k)

    def grid(self, view):
        half = view.grid_size // 2
        turn = np.array(QUARTERS[round(view.rotation / (np.pi / 2)) % 4])
        shift = np.round(np.array([view.translation_x, view.translation_y]) / view.grid_pitch)
        for m, n in np.ndindex(view.grid_size, view.grid_size):
            site = turn @ (m - half, n - half) + shift
            if abs(site).max() <= half:
                yield self.mark(view, m - half, n - half, site * view.grid_pitch)

    def mark(self, view, m, n, site):
        """See a mark: its centre, where the plate lies, less the true optical axis."""
        p = self.sign * site
        phi, tx, ty = self.laid
        c, s = np.cos(view.rotation + phi), np.sin(view.rotation + phi)
        centre = np.array(((c, -s), (s, c))) @ (
            np.array((m, n)) * view.grid_pitch + self.plate[:, m, n])
        centre += (view.translation_x + tx, view.translation_y + ty)
        true = p - self.size * np.array(error_m(*p))
        offset = centre - self.sign * true + self.rng.normal(0, NOISE_M, 2)
        return (*p, self.home[2]), MarkDetection(
            kind=MarkDetection.GRID, has_id=self.ids, m=m * self.ids, n=n * self.ids,
            offset_x=offset[0], offset_y=offset[1], score=1.0)

    def line(self, view, k):
        """See an angular line."""
        site = view.rotation + 2 * np.pi * k / view.angular_count
        p = self.sign * site
        true = p - self.size * error_rad(p)
        offset = site + self.lines[k] + self.laid[0] - self.sign * true
        return (*self.home[:2], p), MarkDetection(
            kind=MarkDetection.ANGULAR, has_id=self.ids, k=k * self.ids,
            offset_theta=offset + self.rng.normal(0, NOISE_RAD), score=1.0)

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
            self.send(self.marks, seen, self._due + STEP_NS)
            self.send(self.encoder, self.sample(position), self._due + 2 * STEP_NS)
            self._due += 3 * STEP_NS
            self.exposed += 1

    @property
    def held(self) -> bool:
        return self.hold_at is not None and (self.view, self.exposed) >= self.hold_at

    def sample(self, position) -> JointState:
        where = dict(zip(("x", "y", "theta"), position, strict=True))
        return JointState(name=list(self.joints), position=[
            float(where.get(name, np.nan)) for name in self.joints])

    def send(self, publisher, message, stamp_ns: int) -> None:
        message.header.stamp = Time(nanoseconds=stamp_ns).to_msg()
        publisher.publish(message)


def largest_deviation(found, size: float = 1.0) -> tuple[float, float]:
    """Return by how much an ErrorMap differs from the truth, m and rad, free of its datum.

    No view tells shift, turn and magnification of the field, nor the constant of the angles.
    """
    index = (np.arange(found.grid_size) - found.grid_size // 2) * found.grid_pitch
    x, y = (part.ravel() for part in np.meshgrid(index, index, indexing="ij"))
    difference = np.concatenate([found.gx, found.gy]) - size * np.concatenate(error_m(x, y))
    one, none = np.ones_like(x), np.zeros_like(x)
    free = np.array([np.r_[one, none], np.r_[none, one], np.r_[-y, x], np.r_[x, y]]).T
    rest = difference - free @ np.linalg.lstsq(free, difference, rcond=None)[0]
    theta = 2 * np.pi * np.arange(found.angular_count) / found.angular_count
    turn = np.array(found.g_theta) - size * error_rad(theta)
    return float(np.abs(rest).max()), float(np.abs(turn - turn.mean()).max())
