# SPDX-License-Identifier: Apache-2.0
"""The stage error where the stage stood (method eq. 7.10): in the iteration, and in the noise."""

import math
from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.joint.fit import JointFit, angular_part, fit
from selfcal_ros.estimation.joint.problem import Problem, sigma_of
from selfcal_ros.estimation.terms.ground import TermInputs
from selfcal_ros.estimation.terms.visits import squares_within

FAR = 0.02
"""Distance from the sites, in pitches (rms), up to which the noise of the map stays what it is."""

SAMPLES = 1000
"""Fewest sites of all draws of noise together: enough for a ratio of sums of squares."""

STEPS = 30
"""Most steps to the map of a draw."""

SETTLED = 1e-2
"""Change of the map of a draw, relative to its size, that counts as none."""


class Moving:
    """What the readings have because the stage stood off the sites, step by step.

    Parameters
    ----------
    problem : Problem
        Readings and model; nothing is taken off where it takes the sites for the places.
    """

    def __init__(self, problem: Problem) -> None:
        self.problem, self.change = problem, 0.0
        self.places = problem.places if problem.moves else None
        self.moved: np.ndarray | None = None
        """Stage error where the stage stood less that at the site, at each reading, m."""

    def taken(self, field: np.ndarray) -> np.ndarray | float:
        """Return what the readings have because of it, (views, nx, ny), m; keep its change."""
        if self.places is None:
            return 0.0
        before: np.ndarray | float = 0.0 if self.moved is None else self.moved
        near = None if self.moved is None else self.places.errors(field, self.moved)
        self.moved = self.places.moved(field, near)
        self.change = float(np.abs(self.moved - before).max())
        return self.places.changes(self.moved, self.problem.turn_rad)

    def ground(self, found: JointFit) -> TermInputs:
        """Return the ground with visits less what the stage error differs by between them."""
        ground = self.problem.ground
        if self.places is None or self.moved is None:
            return ground
        about = self.places.about(found.field, self.places.errors(found.field, self.moved),
                                  self.problem.turn_rad)
        return replace(ground, visits=tuple(
            None if view is None else replace(view, y=view.y - more)
            for view, more in zip(ground.visits, about, strict=True)))

    def repeats(self, found: JointFit) -> tuple[float, float]:
        """Return (sigma, dof) of the repeats without what the stage error differs by."""
        sigma, dof = self.problem.repeats_xy
        less = (squares_within(self.problem.ground.visits)
                - squares_within(self.ground(found).visits))
        return sigma_of(max(sigma**2 * dof - less, 0.0), dof)


def noise_gain(problem: Problem, found: JointFit) -> np.ndarray:
    """Return the standard uncertainty of each node over that without places, (nx, ny).

    Between its nodes a spline is smoother than the nodes, so that readings there tell less of each
    node; the equations that are solved, and so their covariance, are those of the sites. Draws of
    noise are solved with the places of the stage and without, and compared node by node together
    with its neighbours, both coordinates alike.

    Parameters
    ----------
    problem, found : Problem, JointFit
        A solution.
    """
    places, grid = problem.places, problem.system.grid
    if places is None or not problem.moves or places.distance < FAR:
        return np.ones(grid.views.shape)
    rng, spread = np.random.default_rng(0), np.zeros(grid.weight.shape)
    spread[grid.read] = max(found.xy.sigma, np.finfo(float).tiny) / np.sqrt(grid.weight[grid.read])
    lines = angular_part(problem)
    still = replace(lines, free=0 * lines.free, d=0 * lines.d)
    there, sums = places.errors(found.field), np.zeros((2, *grid.views.shape))
    for _ in range(math.ceil(SAMPLES / grid.n_sites)):
        y = spread * (rng.normal(size=spread.shape) + 1j * rng.normal(size=spread.shape))
        plain = now = fit(problem, y, still).field
        for _ in range(STEPS):
            changes = places.changes(places.moved(now, there), problem.turn_rad)
            before, now = now, fit(problem, y - changes, still).field
            if np.abs(now - before).max() <= SETTLED * np.abs(now).max():
                break
        sums += np.stack([np.abs(now) ** 2, np.abs(plain) ** 2])
    ratio = _with_neighbours(np.where(problem.system.known_sites, sums, 0.0))
    return np.sqrt(ratio[0] / np.where(ratio[1] > 0, ratio[1], 1.0))


def _with_neighbours(values: np.ndarray) -> np.ndarray:
    """Return the sums of fields (k, nx, ny) over each node and those around it."""
    padded = np.pad(values, ((0, 0), (1, 1), (1, 1)))
    nx, ny = values.shape[1:]
    return np.sum([padded[:, i:i + nx, j:j + ny] for i in range(3) for j in range(3)], axis=0)
