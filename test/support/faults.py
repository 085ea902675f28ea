# SPDX-License-Identifier: Apache-2.0
"""Machines with a fault, from an exposure on: what a sound machine does or returns is changed."""

import errno
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from selfcal_ros.machine import Image, MachineError

START_NS = 1_700_000_000_000_000_000
BACKLASH_M, LOST_M, LOSS_M = 5e-6, 2e-5, 1e-6


def _lost(*_):
    raise MachineError("the connection was lost", "port /dev/ttyUSB0", "plug it in")


def _raises(*_):
    raise OSError(errno.EIO, "Input/output error")


def _timed_out(*_):
    raise TimeoutError("no answer in 5 s")


def _with(at, axis, value):
    """Return a position with another value of an axis."""
    changed = np.array(at, float)
    changed[axis] = value
    return changed


def _frozen(spoilt, at):
    spoilt.kept = at if spoilt.kept is None else spoilt.kept
    return spoilt.kept


def _one_reading_old(spoilt, at):
    before, spoilt.kept = spoilt.kept, at
    return at if before is None else before


def _oscillating(spoilt, at):
    spoilt.n += 1
    return _with(at, 0, at[0] + 3e-6 * (-1) ** spoilt.n)


def _creeping(spoilt, at):
    spoilt.n += 1
    return _with(at, 1, at[1] + 2e-6 * spoilt.n)


def _swaying(spoilt, at):
    """Three times the tolerance of x, twice that of theta."""
    spoilt.n += 1
    return np.add(at, np.array([3e-6, 0.0, 2e-5]) * (-1) ** spoilt.n / 2)


def _other_order(spoilt, at):
    spoilt.n += 1
    return at[[1, 0, 2]] if spoilt.n % 2 else at


POSITIONS: dict[str, Callable] = {
    "no answer for the position": _timed_out,
    "connection lost at a reading": _lost,
    "position is not a number": lambda _, at: _with(at, 1, math.nan),
    "position is infinite": lambda _, at: _with(at, 0, math.inf),
    "position is None": lambda _, at: None,
    "position lacks an axis": lambda _, at: at[:2],
    "position is text": lambda _, at: "1.0 mm",
    "frozen position": _frozen,
    "position one reading old": _one_reading_old,
    "never at rest": _oscillating,
    "creeps at rest": _creeping,
    "sways": _swaying,
    "replies of another axis": _other_order,
    "position in mm": lambda _, at: at * [1e3, 1e3, 1.0],
    "position in um": lambda _, at: at * [1e6, 1e6, 1.0],
    "position in inches": lambda _, at: at / [0.0254, 0.0254, 1.0],
    "x is reversed": lambda _, at: at * [-1, 1, 1],
    "y is reversed": lambda _, at: at * [1, -1, 1],
    "x and y are exchanged": lambda _, at: at[[1, 0, 2]],
    "theta is reversed": lambda _, at: at * [1, 1, -1],
    "theta in degrees": lambda _, at: at * [1, 1, math.degrees(1.0)],
    "zero lost at rest": lambda _, at: np.add(at, [3e-3, 0.0, 0.0]),
    "moved by hand": lambda _, at: np.add(at, [0.0, 5e-5, 0.0]),
}
"""Fault -> what becomes of an indicated position."""


def _limit_switch(_, target):
    return (min(target[0], 0.0), *target[1:])


def _backlash(spoilt, target):
    """Return where a stage with play stands; indicated is the target."""
    target = np.array(target)
    way = np.sign(target - (target if spoilt.kept is None else spoilt.kept)) * [1, 1, 0]
    spoilt.kept = target
    spoilt.side = np.where(way == 0, spoilt.side, way)
    return tuple(target - BACKLASH_M / 2 * spoilt.side)


def _loses(spoilt, target):
    spoilt.n += 1
    return (target[0] - LOSS_M * spoilt.n, *target[1:])


MOVES: dict[str, Callable] = {
    "connection lost in a move": _lost,
    "driver raises an error of its own": _raises,
    "no answer to a move": _timed_out,
    "stands still": lambda spoilt, _: tuple(spoilt.machine.position()),
    "limit switch": _limit_switch,
    "ends short": lambda _, target: (target[0] - 1e-4, *target[1:]),
    "ends a little short": lambda _, target: (target[0] - 5e-6, *target[1:]),
    "turns the other way": lambda _, target: (*target[:2], -target[2]),
    "rotary drive is off": lambda spoilt, target: (
        *target[:2],
        spoilt.machine.position()[2],
    ),
    "backlash of 5 um": _backlash,
    "steps were lost once": lambda _, target: (target[0] - LOST_M, *target[1:]),
    "loses steps": _loses,
}
"""Fault -> what becomes of a target."""
UNSEEN = ("backlash of 5 um", "steps were lost once", "loses steps")
"""Faults of a move that the indicated position does not show."""


def _as_before(spoilt, shown):
    return spoilt.kept or shown


def _late(spoilt, shown, frames=1):
    spoilt.queue.append(shown)
    return spoilt.queue.pop(0) if len(spoilt.queue) > frames else spoilt.queue[0]


def _torn(spoilt, shown):
    """Return an image whose lower half is of the one before."""
    before, spoilt.kept = spoilt.kept or shown, shown
    half = len(shown.pixels) // 2
    return Image(np.concatenate([shown.pixels[:half], before.pixels[half:]]))


def _noise(spoilt, shown):
    rng = np.random.default_rng(spoilt.exposures)
    return Image(rng.integers(0, 255, shown.pixels.shape, np.uint8))


def _blurred(_, shown):
    from scipy.ndimage import gaussian_filter

    return Image(gaussian_filter(shown.pixels, 30.0))


def _pixels(change: Callable) -> Callable:
    return lambda _, shown: Image(change(shown.pixels))


IMAGES: dict[str, Callable] = {
    "camera disconnected": _raises,
    "no answer of the camera": _timed_out,
    "last image again": _as_before,
    "late by one frame": _late,
    "late by two frames": lambda spoilt, shown: _late(spoilt, shown, 2),
    "torn image": _torn,
    "black": _pixels(np.zeros_like),
    "saturated": _pixels(lambda pixels: np.full_like(pixels, 255)),
    "blank": _pixels(lambda pixels: np.full_like(pixels, 120)),
    "noise alone": _noise,
    "out of focus": _blurred,
    "colour": _pixels(lambda pixels: np.dstack([pixels] * 3)),
    "of floats": _pixels(lambda pixels: pixels / 255.0),
    "empty": _pixels(lambda pixels: pixels[:0]),
    "of half the size": _pixels(lambda pixels: pixels[::2, ::2]),
    "of sixteen bits": _pixels(lambda pixels: pixels.astype(np.uint16)),
    "no image": lambda *_: None,
    "mirrored": _pixels(lambda pixels: pixels[:, ::-1]),
    "turned by 180 degrees": _pixels(lambda pixels: pixels[::-1, ::-1]),
    "turned by 90 degrees": _pixels(lambda pixels: np.rot90(pixels[:, 5:-5])),
    "stamp of the future": lambda _, shown: Image(shown.pixels, START_NS + 10**15),
    "stamp of the past": lambda _, shown: Image(shown.pixels, START_NS - 10**9),
    "camera was knocked": _pixels(lambda pixels: np.roll(pixels, 8, axis=1)),
    "light is failing": _pixels(lambda pixels: (pixels * 0.4).astype(np.uint8)),
}
"""Fault -> what becomes of an image."""


OFFSETS: dict[str, Callable] = {
    "offsets in um": lambda item: replace(item, x=item.x * 1e6, y=item.y * 1e6),
    "offset is not a number": lambda item: replace(item, x=math.nan),
    "offsets are reversed": lambda item: replace(item, x=-item.x, y=-item.y),
    "offsets are exchanged": lambda item: replace(item, x=item.y, y=item.x),
    "m and n are exchanged": lambda item: replace(
        item, mark=item.mark and item.mark[::-1]
    ),
    "score is low": lambda item: replace(item, score=0.1),
    "line reversed": lambda item: replace(item, theta=item.theta and -item.theta),
}
"""Fault -> what becomes of an offset."""


class Spoilt:
    """A machine with a fault, named in one of the tables above, once `after` exposures are made."""

    def __init__(self, machine, fault: str = "", after: int = 0) -> None:
        assert fault in {"", *POSITIONS, *MOVES, *IMAGES, *OFFSETS}
        self.machine, self.fault, self.after = machine, fault, after
        self.axes = machine.axes
        self.moves, self.stops, self.exposures = [], 0, 0
        self.moves_before = 0
        self.kept, self.queue, self.n, self.side = None, [], 0, np.zeros(len(self.axes))
        self._unseen = np.zeros(len(self.axes))

    def _is_on(self, faults) -> bool:
        return self.fault in faults and self.exposures >= self.after

    def place(self, placing) -> None:
        self.machine.place(placing)

    def position(self):
        at = np.array(self.machine.position()) + self._unseen
        if self._is_on(POSITIONS):
            at = POSITIONS[self.fault](self, at)
        return tuple(at.tolist()) if isinstance(at, np.ndarray) else at

    def move_to(self, position) -> None:
        self.moves.append(position)
        reached = position
        if self._is_on(MOVES):
            reached = MOVES[self.fault](self, position)
            if self.fault in UNSEEN:
                self._unseen = np.subtract(position, reached)
        self.machine.move_to(reached)

    def image(self):
        shown = self.machine.image()
        if shown is None:
            return shown
        self.exposures += 1
        if self.exposures == self.after:
            self.moves_before = len(self.moves)
        if self.exposures > self.after and self.fault in IMAGES:
            return IMAGES[self.fault](self, shown)
        self.kept = shown if self.fault in IMAGES else self.kept
        return shown

    def offsets(self):
        seen = self.machine.offsets()
        self.exposures += 1
        if self.exposures == self.after:
            self.moves_before = len(self.moves)
        return (
            [OFFSETS[self.fault](item) for item in seen]
            if self._is_on(OFFSETS)
            else seen
        )

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        self.machine.close()
