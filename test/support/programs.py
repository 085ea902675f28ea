# SPDX-License-Identifier: Apache-2.0
"""A slow interpreter of G-code, apart from the code under test."""

import math
import re

import numpy as np

Move = tuple[str, np.ndarray]
"""G code of a motion in XY, and points of its path, m."""


class Machine:
    """The modal state of a program that runs."""

    def __init__(self) -> None:
        self._unit, self._absolute, self._motion = 1e-3, True, ""
        self._at = np.full(2, np.nan)

    def line(self, text: str) -> Move | None:
        """Return the move of a line, None if it has none in XY."""
        line = re.sub(r"\(.*?\)|;.*", "", text).upper()
        if re.match(r"\s*(\$|[A-Z_]{2}|M117|G28|G92)", line):
            return None
        words = [(c, float(v)) for c, v in re.findall(r"([A-Z])\s*([-+.\d]+)", line)]
        for letter, value in words:
            if letter == "G":
                self._unit = {20: 0.0254, 21: 1e-3}.get(value, self._unit)
                self._absolute = {90: True, 91: False}.get(value, self._absolute)
                self._motion = f"{value:g}" if value in (0, 1, 2, 3, 80, 81) else self._motion
        w, unit, at = dict(words), self._unit, self._at
        arc = self._motion in ("2", "3") and set("IJ") & set(w)
        if not set("XY") & set(w) and not arc:
            return None
        end = np.array([w[c] * unit + (0 if self._absolute else old) if c in w else old
                        for c, old in zip("XY", at, strict=True)])
        points = end[None]
        if self._motion == "1" and np.isfinite(at).all():
            points = np.linspace(at, end, 4 + int(np.hypot(*(end - at)) / 3e-4))
        elif self._motion in ("2", "3"):
            points = arc_points(at, end, w, unit, clockwise=self._motion == "2")
        self._at = end
        return self._motion, points


def run_program(text: str) -> list[Move]:
    """Return the moves of a program in XY."""
    machine = Machine()
    return [move for line in text.splitlines() if (move := machine.line(line)) is not None]


def arc_points(start, end, w, unit, *, clockwise):
    """Points of an arc by complex numbers: z = centre + (start - centre) e^(i angle)."""
    a, b = complex(*start), complex(*end)
    if "R" in w:
        r = w["R"] * unit
        rise = math.sqrt(max(r * r - abs(b - a) ** 2 / 4, 0))
        left = 1j * (b - a) / abs(b - a)  # to the left of the way
        # counter-clockwise, up to half a turn: the centre lies to the left
        side = (1 if not clockwise else -1) * (1 if r > 0 else -1)
        centre = (a + b) / 2 + side * rise * left
    else:
        centre = a + complex(w.get("I", 0), w.get("J", 0)) * unit
    turn = np.angle((b - centre) / (a - centre))
    if clockwise and turn >= -1e-12:
        turn -= 2 * np.pi
    if not clockwise and turn <= 1e-12:
        turn += 2 * np.pi
    z = centre + (a - centre) * np.exp(1j * turn * np.linspace(0, 1, 1500))
    return np.stack([z.real, z.imag], axis=1)


def farthest(points: np.ndarray, path: np.ndarray) -> float:
    """Return the largest distance of points from a path through many points."""
    path = np.concatenate([path, path[-1:]])  # it may be one point
    a, b = path[:-1], path[1:]
    d = b - a
    length2 = np.maximum((d**2).sum(axis=1), 1e-30)
    t = np.clip(((points[:, None] - a) * d).sum(axis=2) / length2, 0, 1)
    off = a + t[:, :, None] * d - points[:, None]
    return float(np.hypot(off[..., 0], off[..., 1]).min(axis=1).max())
