# SPDX-License-Identifier: Apache-2.0
"""LinuxCNC's own interpreter, where it is installed: the ways that it reads in a program."""

import math
import re
import shutil
import subprocess

import numpy as np

RS274 = shutil.which("rs274")
CALL = re.compile(
    r"(STRAIGHT_TRAVERSE|STRAIGHT_FEED|ARC_FEED|USE_LENGTH_UNITS)\((.*)\)"
)


def ways_of(path) -> list[tuple[bool, np.ndarray]]:
    """Return for each stretch of feeds, and each traverse, whether it feeds, and points in mm.

    RuntimeError if the program is stopped. Coordinates have four decimals.
    """
    done = subprocess.run(
        [RS274, "-g", str(path)],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=path.parent,
        check=False,
    )
    if done.returncode or done.stderr.strip() != "executing":
        raise RuntimeError(done.stderr)
    at, unit, ways = np.zeros(3), 1.0, []
    for name, args in CALL.findall(done.stdout):
        if name == "USE_LENGTH_UNITS":
            unit = 25.4 if "INCHES" in args else 1.0
            continue
        numbers = [float(text) for text in args.split(",")[:6]]
        points = np.array([numbers[:3]]) * unit
        if name == "ARC_FEED":
            points = _arc(at, numbers, unit)
        if name == "STRAIGHT_TRAVERSE" or not ways or not ways[-1][0]:
            ways.append((name != "STRAIGHT_TRAVERSE", at[None]))
        ways[-1] = (ways[-1][0], np.vstack([ways[-1][1], points]))
        at = points[-1]
    return ways


def _arc(start: np.ndarray, numbers: list[float], unit: float) -> np.ndarray:
    """Return points of ARC_FEED in XY: end x, y, centre x, y, turns, end z."""
    x, y, cx, cy, turns, z = (
        value * factor
        for value, factor in zip(numbers, (unit,) * 4 + (1, unit), strict=True)
    )
    first, last = (math.atan2(b - cy, a - cx) for a, b in (start[:2], (x, y)))
    sweep = (last - first) * np.sign(turns) % (2 * math.pi)
    sweep = (sweep if sweep > 1e-4 else 2 * math.pi) + (abs(turns) - 1) * 2 * math.pi
    way = np.linspace(0, 1, 1000)
    radius = (
        np.hypot(start[0] - cx, start[1] - cy) * (1 - way)
        + np.hypot(x - cx, y - cy) * way
    )
    angle = first + np.sign(turns) * sweep * way
    return np.stack(
        [
            cx + radius * np.cos(angle),
            cy + radius * np.sin(angle),
            start[2] + way * (z - start[2]),
        ],
        axis=1,
    )
