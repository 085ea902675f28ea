# SPDX-License-Identifier: Apache-2.0
"""A machine written from the documentation alone: what its encoders and its microscope show.

Nothing of selfcal_ros is imported. Signs are those of cell.md: an indicated position is the
true one plus the stage's error there; an offset is mark centre less optical axis, in stage axes.
"""

import numpy as np

NOISE_M, NOISE_RAD = 2e-9, 1e-7
QUARTERS = {
    0: ((1, 0), (0, 1)),
    1: ((0, -1), (1, 0)),
    2: ((-1, 0), (0, -1)),
    3: ((0, 1), (-1, 0)),
}
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
GRID, ANGULAR = 0, 1


def error_m(x, y):
    """Return the stage's error where it is indicated at x, y (m): what is to be found, m."""
    return (
        3e-7 * np.sin(120 * x) * np.cos(80 * y) + 1e-7 * np.cos(70 * y),
        2e-7 * np.cos(90 * x + 60 * y) - 2e-7 * np.sin(50 * x),
    )


def error_rad(theta):
    """Return the rotary encoder's error where it indicates theta."""
    return 3e-5 * np.sin(theta) + 2e-5 * np.cos(2 * theta)


class Bench:
    """Encoders, microscope and plate.

    Parameters
    ----------
    ids : bool
        Whether detections tell which mark they are of.
    plate_moves : bool
        Whether the plate rides on the stage, below a microscope that rests.
    size : float
        Factor of the stage's error.
    """

    def __init__(self, *, ids=True, plate_moves=False, size=1.0, seed=1) -> None:
        self.ids, self.sign, self.size = ids, -1 if plate_moves else 1, size
        self.rng = np.random.default_rng(seed)
        self.plate = self.rng.normal(0, 3e-7, (2, 99, 99))
        self.lines = self.rng.normal(0, 2e-5, 99)
        self.laid = np.zeros(3)
        self.home = (0.0, 0.0, 0.0)

    def lay(self) -> None:
        """Place the plate by hand."""
        self.laid = self.rng.normal(0, (5e-4, 2e-5, 2e-5))

    def exposures(self, view):
        """Yield indicated position and fields of a detection, of all that the view asks for."""
        half = view.grid_size // 2
        marks = [
            (m - half, n - half) for m, n in np.ndindex(view.grid_size, view.grid_size)
        ]
        for _ in range(view.repeats):
            if view.grid:
                for mark in marks:
                    yield from self.stops(view, *mark)
            if view.angular:
                for k in range(view.angular_count):
                    yield self.line(view, k)
        if view.grid:
            for mark in marks[: view.check_marks]:
                for side in SIDES:
                    yield from self.stops(
                        view, *mark, view.check_offset * np.array(side)
                    )

    def stops(self, view, m, n, aside=(0.0, 0.0)):
        """Yield the sight of a mark, if it lies in the field."""
        turn = np.array(QUARTERS[round(view.rotation / (np.pi / 2)) % 4])
        shift = np.round(
            np.array([view.translation_x, view.translation_y]) / view.grid_pitch
        )
        site = turn @ (m, n) + shift
        if abs(site).max() <= view.grid_size // 2:
            yield self.mark(view, m, n, site * view.grid_pitch + aside)

    def mark(self, view, m, n, site):
        """See a mark: its centre, where the plate lies, less the true optical axis."""
        p = self.sign * site
        phi, tx, ty = self.laid
        c, s = np.cos(view.rotation + phi), np.sin(view.rotation + phi)
        centre = np.array(((c, -s), (s, c))) @ (
            np.array((m, n)) * view.grid_pitch + self.plate[:, m, n]
        )
        centre += (view.translation_x + tx, view.translation_y + ty)
        true = p - self.size * np.array(error_m(*p))
        offset = centre - self.sign * true + self.rng.normal(0, NOISE_M, 2)
        return (*p, self.home[2]), {
            "kind": GRID,
            "has_id": self.ids,
            "m": m * self.ids,
            "n": n * self.ids,
            "offset_x": offset[0],
            "offset_y": offset[1],
            "score": 1.0,
        }

    def line(self, view, k):
        """See an angular line."""
        site = view.rotation + 2 * np.pi * k / view.angular_count
        p = self.sign * site
        true = p - self.size * error_rad(p)
        offset = site + self.lines[k] + self.laid[0] - self.sign * true
        return (*self.home[:2], p), {
            "kind": ANGULAR,
            "has_id": self.ids,
            "k": k * self.ids,
            "offset_theta": offset + self.rng.normal(0, NOISE_RAD),
            "score": 1.0,
        }


def largest_deviation(found, size: float = 1.0) -> tuple[float, float]:
    """Return by how much an ErrorMap differs from the truth, m and rad, free of its datum.

    No view tells shift, turn and magnification of the field, nor the constant of the angles.
    """
    index = (np.arange(found.grid_size) - found.grid_size // 2) * found.grid_pitch
    x, y = (part.ravel() for part in np.meshgrid(index, index, indexing="ij"))
    difference = np.concatenate([found.gx, found.gy]) - size * np.concatenate(
        error_m(x, y)
    )
    one, none = np.ones_like(x), np.zeros_like(x)
    free = np.array([np.r_[one, none], np.r_[none, one], np.r_[-y, x], np.r_[x, y]]).T
    rest = difference - free @ np.linalg.lstsq(free, difference, rcond=None)[0]
    theta = 2 * np.pi * np.arange(found.angular_count) / found.angular_count
    turn = np.array(found.g_theta) - size * error_rad(theta)
    return float(np.abs(rest).max()), float(np.abs(turn - turn.mean()).max())
