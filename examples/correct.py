#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Use a calibrated stage in your own program: commands, true positions, a distance with its U.

Run it with ``.venv/bin/python examples/correct.py RESULT.json``.
"""

import sys

import numpy as np

from selfcal_ros.apply import load


def main(path: str) -> None:
    """Print commands for three points, the way back, and the distance of two points."""
    stage = load(path)
    x = np.array([-0.01, 0.0, 0.01])  # where the stage has to be, m
    y = np.array([0.01, 0.0, -0.005])

    x_command, y_command = stage.command(x, y)
    u_x, u_y = stage.uncertainty(x, y)
    for row in zip(x, y, x_command, y_command, u_x, u_y, strict=True):
        print(
            "be at {:+.6f} {:+.6f} m: command {:+.9f} {:+.9f} m, u {:.1e} {:.1e} m".format(
                *row
            )
        )

    x_true, y_true = stage.correct(x_command, y_command)
    print(f"and back: off by at most {np.hypot(x_true - x, y_true - y).max():.0e} m")

    # the first point to the last
    error, u = stage.length_error((x[0], y[0]), (x[2], y[2]))
    k = stage.result.noise.k_xy
    print(
        f"distance {np.hypot(x[2] - x[0], y[2] - y[0]):.6f} m is indicated {error[0]:+.1e} m "
        f"too long, U {k * u[0]:.1e} m (k = {k:.2f}, 95.45 %)"
    )

    # the mean of Gx at the three points
    gradient = np.array([1 / 3, 1 / 3, 1 / 3, 0, 0, 0])
    u_mean = np.sqrt(gradient @ stage.covariance(x, y) @ gradient)
    print(f"mean error in x {(x_command - x).mean():+.1e} m, U {k * u_mean:.1e} m")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: correct.py RESULT.json")
    main(sys.argv[1])
