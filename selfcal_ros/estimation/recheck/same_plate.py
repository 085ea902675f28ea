# SPDX-License-Identifier: Apache-2.0
"""Whether what was read is the known plate, placed as planned (method eq. 13.5).

With the stage as it was, the readings of a view less both known maps leave motion, strain and
noise. A wrong pose or another plate leaves differences of marks instead: unlike a change of the
stage, they have nothing in common from one mark to the next.
"""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.estimation.checks.placing import (
    BETTER,
    CLEARLY,
    CONTRADICTED,
    LEAST_READINGS,
    ON_MARKS,
    Misplaced,
    motions,
    on_marks,
    said,
)
from selfcal_ros.estimation.recheck.plate import KnownPlate, rows_at
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import rms
from selfcal_ros.model.readings import Measurements, Sense, ViewReadings
from selfcal_ros.model.verdict import Finding

MANY = 5.0
"""Median difference, in standard uncertainties, beyond which most marks differ."""

ALIKE = 0.3
"""Correlation of neighbours below which differences are of marks, not of a stage."""

BY_CHANCE = 3.5
"""Part of differences that neighbours may by chance not share, over the root of their number."""

BY_CHANCE_BETTER = 8.0
"""Gain of the log-likelihood that one of all poses may have by chance, over the same root."""

LEAST = 0.01
"""Part of the known errors of the marks by which those of another plate differ at least."""

STEPS = 6
"""Steps to the motion of a view by least absolute values."""

NEIGHBOURS = 1.3
"""Largest distance of neighbouring marks, in pitches."""

DISTANCES = ((0.7, 1.2), (1.2, 1.7), (1.7, 2.2))
"""Distances at which differences are compared, in pitches."""

FAR = 3.0
"""Length of a difference, in standard deviations, beyond which it is of a single mark."""

PLANNED = (1 + 0j, 0j)
"""No further turn, no further shift."""

RAYLEIGH_MEDIAN = 1.1774
"""Median length of a vector whose two components have the standard deviation 1."""


@dataclass(frozen=True, eq=False)
class _Read:
    """Readings of one view: marks, complex (n,), and offsets less the stage, stage frame, m."""

    marks: np.ndarray
    offsets: np.ndarray
    turn: complex
    shift: complex
    u: float

    def left(self, plate: np.ndarray, artifact: Artifact, pose: tuple[complex, complex],
             ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return what the known plate leaves, and of which readings; None if they are not on it.

        `pose`: factor of a further turn, and shift of the plate's centre, in its pitches.
        """
        mark, there = on_marks(artifact, (self.marks - pose[1]) / pose[0])
        if there.mean() < ON_MARKS:
            return None
        rest = self.offsets - self.turn * pose[0] * np.where(there, plate.flat[mark], np.nan)
        here = np.isfinite(rest)
        if here.sum() < LEAST_READINGS:
            return None
        z = self.marks[here]
        free = np.stack([np.ones(len(z)), z, z.conj()], axis=1)
        left, weight = rest[here], np.ones((len(z), 1))
        for _ in range(STEPS):  # least sum of lengths: single marks may be far off
            left = rest[here] - free @ np.linalg.lstsq(
                weight * free, weight[:, 0] * rest[here], rcond=None)[0]
            weight = np.maximum(abs(left), self.u)[:, None] ** -0.5
        return left, here


def check_plate(measurements: Measurements, plate: KnownPlate, sigma: float) -> Finding | None:
    """Return a finding if another plate was read, or one whose marks have changed.

    Of images by the marks on the optical axis.

    Parameters
    ----------
    measurements : Measurements
        Views of the plate.
    plate : KnownPlate
        What is known of it, and of the stage.
    sigma : float
        Noise of a reading, m.

    Raises
    ------
    PlacingError
        If the plate is not placed as planned.
    """
    for view in (one for one in measurements.views if one.view.cell in (None, (0, 0))):
        seen = _read(view, measurements, plate, sigma)
        planned = None if seen is None else seen.left(plate.field, measurements.artifact, PLANNED)
        if seen is None or planned is None:
            continue
        rest, here = planned
        if (many := _size(rest) / seen.u) ** 2 < CONTRADICTED:
            continue
        other = _other_pose(seen, plate.field, measurements.artifact)
        if other is not None:
            raise said(_misplaced(view, seen, other), f"plan '{measurements.plan_id}', ")
        if many > MANY and _of_marks(seen.marks[here], rest, seen.u):
            return Finding("other_plate", _size(rest), seen.u, "m",
                           view=view.view.name, details={"times": many, "of": plate.where})
    return None


def _read(view: ViewReadings, measurements: Measurements, plate: KnownPlate,
          sigma: float) -> _Read | None:
    """Return the readings of a view less the stage as it was, where it was known."""
    artifact, pitch = measurements.artifact, measurements.artifact.grid_pitch_m
    if not len(view.m):
        return None
    at, old = view.view.pose.places(artifact, view.m, view.n), plate.result.error_map
    sign = -1 if measurements.sense is Sense.PLATE_MOVES else 1
    rows, there = rows_at(sign * at, plate)
    stage = sign * (rows @ (old.gx + 1j * old.gy)[plate.together.sites])
    marks = plate.result.artifact_map
    u = [sigma / np.sqrt(view.count.mean()), rms(np.stack([old.u_gx, old.u_gy])),
         rms(np.stack([marks.u_ax, marks.u_ay])), LEAST * rms(np.stack([marks.ax, marks.ay]))]
    offsets = np.where(there, view.dx + 1j * view.dy - stage, complex(np.nan, np.nan))
    x, y = artifact.places(view.m, view.n)
    return _Read(x + 1j * y, offsets, complex(np.exp(1j * view.view.rotation_rad)),
                 complex(*view.view.translation_m) / pitch, float(np.linalg.norm(u)))


def _other_pose(seen: _Read, plate: np.ndarray,
                artifact: Artifact) -> tuple[complex, complex] | None:
    """Return the pose that explains the readings much better than the planned one; else None.

    By the gain of the log-likelihood of differences of unknown size.
    """
    tried = []
    for pose in motions(artifact, seen.turn, seen.shift):
        here, planned = (seen.left(plate, artifact, each) for each in (pose, PLANNED))
        if here is None or planned is None:
            continue
        before, after = (max(_size(rest), seen.u) for rest, _ in (planned, here))
        tried.append((2 * len(here[0]) * float(np.log(before / after)), pose))
    tried.sort(key=lambda item: -item[0])
    second = tried[1][0] if len(tried) > 1 else 0.0
    least = max(BETTER, BY_CHANCE_BETTER * np.sqrt(len(seen.marks)))
    if not tried or tried[0][0] < least or tried[0][0] - second < CLEARLY:
        return None
    return tried[0][1]


def _size(rest: np.ndarray) -> float:
    """Return the standard deviation of a component by the median, which few marks do not move."""
    return float(np.median(np.abs(rest))) / RAYLEIGH_MEDIAN


def _misplaced(view: ViewReadings, seen: _Read, pose: tuple[complex, complex]) -> Misplaced:
    """Return how the plate lies, turns in degrees, shifts in pitches along the stage's axes."""
    deg, moved = np.degrees(view.view.rotation_rad), seen.shift + seen.turn * pose[1]
    planned, found = (tuple(float(np.round(part, 6)) for part in (at.real, at.imag))
                      for at in (seen.shift, moved))
    turned = deg + np.degrees(np.angle(pose[0]))
    return Misplaced(view.view.name, round(float(deg) % 360, 6), round(float(turned) % 360, 6),
                     (planned[0], planned[1]), (found[0], found[1]))


def _of_marks(marks: np.ndarray, rest: np.ndarray, u: float) -> bool:
    """Return whether what is left is of the marks, not of a stage alone, which changes smoothly."""
    own, least = _not_shared(marks, rest), BY_CHANCE / np.sqrt(len(marks))
    return _neighbours(marks, rest) < ALIKE or own > max(MANY * u, least * _size(rest))


def _neighbours(marks: np.ndarray, rest: np.ndarray) -> float:
    """Return the correlation of what is left at neighbouring marks."""
    away = np.abs(marks[:, None] - marks)
    first, other = np.nonzero((away > 0) & (away < NEIGHBOURS))
    products = (rest[first] * rest[other].conj()).real
    return float(products.mean() / np.mean(np.abs(rest)**2)) if len(products) else 1.0


def _not_shared(marks: np.ndarray, rest: np.ndarray) -> float:
    """Return the standard deviation, of a component, of what no neighbour shares; 0 if unknown.

    Half the mean squares of differences at 1, 1.4 and 2 pitches, continued to no distance by a
    parabola in its square. Single marks that are far off count as far off as others.
    """
    size = np.maximum(np.abs(rest) / (FAR * _size(rest)), 1.0)
    away, rest, means = np.abs(marks[:, None] - marks), rest / size, []
    for nearest, farthest in DISTANCES:
        first, other = np.nonzero((away > nearest) & (away < farthest))
        if len(first) < len(marks):
            return 0.0
        square = np.mean(away[first, other] ** 2)
        means.append((1.0, square, square**2, np.mean(np.abs(rest[first] - rest[other])**2) / 4))
    of = np.array(means)
    return float(np.sqrt(max(np.linalg.solve(of[:, :3], of[:, 3])[0], 0.0)))
