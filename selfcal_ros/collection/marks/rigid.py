# SPDX-License-Identifier: Apache-2.0
"""Robust estimate of a view's own rotation and offset, to identify marks."""

from dataclasses import dataclass

import numpy as np

from selfcal_ros.collection.marks.repeats import distances, median

LARGEST_TURN_RAD = 0.2
"""Largest misalignment; a plate turned by more is wrongly placed."""
EXPECTED_SCATTER = 0.03
"""Expected distance of a mark from the rigid motion while few marks determine it, in pitches."""
EXPECTED_WEIGHT = 4
"""Degrees of freedom of this expectation."""
COVERAGE = 3.0
"""Standard deviations within which the motion is taken as known."""
FEW_MARKS_COVERAGE = 10.0
"""The same if the scatter itself is estimated, from as few as three marks."""


@dataclass(frozen=True)
class Rigid:
    """A small turn and an offset: deviation = (R(phi) - 1) p + t; rad and m, stage frame."""

    phi_rad: float = 0.0
    tx_m: float = 0.0
    ty_m: float = 0.0

    def at(self, p: np.ndarray) -> np.ndarray:
        """Return the deviation at nominal positions `p` (2, n) about the plate centre."""
        turn = np.sin(self.phi_rad)
        cos_less_1 = np.cos(self.phi_rad) - 1
        return np.stack(
            [
                cos_less_1 * p[0] - turn * p[1] + self.tx_m,
                turn * p[0] + cos_less_1 * p[1] + self.ty_m,
            ]
        )

    def undo(self, q: np.ndarray) -> np.ndarray:
        """Return the nominal positions (2, n) of marks read at `q`."""
        turn, cosine = np.sin(self.phi_rad), np.cos(self.phi_rad)
        x, y = q[0] - self.tx_m, q[1] - self.ty_m
        return np.stack([cosine * x + turn * y, cosine * y - turn * x])


@dataclass(frozen=True)
class MotionEstimate:
    """Estimate of a view's motion, and the largest error of its prediction.

    Attributes
    ----------
    rigid : Rigid
        The motion.
    centre_m : tuple of float
        Nominal position where the offset is known best, relative to the plate centre.
    offset_error_m : float
        Largest error of a prediction there, a mark's own scatter included.
    phi_error_rad : float
        Largest error of the rotation.
    """

    rigid: Rigid = Rigid()
    centre_m: tuple[float, float] = (0.0, 0.0)
    offset_error_m: float = 0.0
    phi_error_rad: float = 0.0

    def error_at(self, p: np.ndarray) -> np.ndarray:
        """Return the largest error (n,) of the predicted deviation at `p` (2, n), m."""
        away = np.hypot(p[0] - self.centre_m[0], p[1] - self.centre_m[1])
        return self.offset_error_m + self.phi_error_rad * away


@dataclass(frozen=True)
class RigidFit:
    """A rigid motion fitted to marks.

    Attributes
    ----------
    rigid : Rigid
        The motion; without rotation if all readings are of one mark.
    centre_m : tuple of float
        Mean nominal position of the marks, relative to the plate centre.
    marks : int
        Number of distinct marks in the fit.
    power_m2 : float
        Sum of their squared distances from the centre.
    squares_m2 : float
        Sum of their squared residuals.
    """

    rigid: Rigid
    centre_m: tuple[float, float]
    marks: int
    power_m2: float
    squares_m2: float

    @property
    def phi_error_rad(self) -> float:
        """Largest error of the rotation, from the scatter of the marks; inf below three."""
        if self.marks < 3 or not self.power_m2:
            return float("inf")
        return FEW_MARKS_COVERAGE * float(
            np.sqrt(self.squares_m2 / (2 * self.marks - 3) / self.power_m2)
        )

    def known(self, pitch_m: float, max_rotation_rad: float) -> MotionEstimate:
        """Return the estimate from the fit combined with prior knowledge.

        A priori the rotation is 0 to within `max_rotation_rad`, and marks
        scatter by `EXPECTED_SCATTER`: with few or close marks this is better than the fit.
        """
        expected = EXPECTED_WEIGHT * (EXPECTED_SCATTER * pitch_m) ** 2
        freedom = EXPECTED_WEIGHT + max(2 * self.marks - 3, 0)
        scatter = COVERAGE * np.sqrt((expected + self.squares_m2) / freedom)
        weight = 0.0
        error = max_rotation_rad
        if self.power_m2 and max_rotation_rad:
            fit_error_rad = scatter / np.sqrt(self.power_m2)
            weight = max_rotation_rad**2 / (max_rotation_rad**2 + fit_error_rad**2)
            error = weight * fit_error_rad + (1 - weight) * max_rotation_rad
        rigid = _through(
            weight * self.rigid.phi_rad,
            self.centre_m,
            self.rigid.at(np.array(self.centre_m)),
        )
        return MotionEstimate(
            rigid,
            self.centre_m,
            float(scatter * np.sqrt(1 + 1 / max(self.marks, 1))),
            float(error),
        )


def _through(
    phi_rad: float, centre: tuple[float, float], deviation: np.ndarray
) -> Rigid:
    """Return the motion that turns by phi and has a given deviation at a point."""
    shift_m = deviation - Rigid(phi_rad).at(np.array(centre))
    return Rigid(float(phi_rad), float(shift_m[0]), float(shift_m[1]))


def fit_motion(p: np.ndarray, deviation: np.ndarray) -> RigidFit:
    """Fit a rigid motion to deviations, without outliers.

    Parameters
    ----------
    p : float array (2, n)
        Nominal positions about the plate centre, m.
    deviation : float array (2, n)
        Reading minus nominal, m.

    Returns
    -------
    RigidFit
        From the median start, five rounds of least squares over the deviations within three
        times the median distance. The turn is never beyond `LARGEST_TURN_RAD`.
    """
    if not p.shape[1]:
        return RigidFit(Rigid(), (0.0, 0.0), 0, 0.0, 0.0)
    rigid = _median_motion(p, deviation)
    keep = np.zeros(p.shape[1], dtype=bool)
    for _ in range(5):
        distance = distances(deviation - rigid.at(p))
        before = keep
        keep = distance <= 3 * median(distance) + 1e-9
        if (keep == before).all():  # the same marks give the same motion
            break
        near, read = columns_where(keep, p, deviation)
        rigid, middle, power = _least_squares(near, read)
    near, read = columns_where(keep, p, deviation)
    residual = read - rigid.at(near)
    differs = (near[:, 1:] != near[:, :-1]).any(axis=0)  # from the one before
    first = near[:, np.append(True, differs)]
    marks = len(np.unique(first[0] + 1j * first[1]))
    share = marks / keep.sum()  # repeats of a mark are not further marks
    return RigidFit(
        rigid, middle, marks, float(power * share), float((residual**2).sum() * share)
    )


def _median_motion(p: np.ndarray, deviation: np.ndarray) -> Rigid:
    """Return the median offset, and the median turn of the marks in the outer half."""
    middle = p.mean(axis=1)
    arm = p - middle[:, None]
    offset = np.array([median(row) for row in deviation])
    radius2 = (arm**2).sum(axis=0)
    rim = (radius2 >= median(radius2)) & (radius2 > 0)
    cross = _cross(arm, deviation - offset[:, None])
    phi_rad = _turn(median(cross[rim] / radius2[rim])) if rim.any() else 0.0
    return _through(phi_rad, tuple(middle), offset)


def _least_squares(
    p: np.ndarray, deviation: np.ndarray
) -> tuple[Rigid, tuple[float, float], float]:
    """Return the motion, the centre of the marks and the sum of squared distances from it."""
    middle, mean = p.mean(axis=1), deviation.mean(axis=1)
    arm = p - middle[:, None]
    power = (arm**2).sum()
    cross = _cross(arm, deviation - mean[:, None]).sum()
    centre = float(middle[0]), float(middle[1])
    return (
        _through(_turn(cross / power) if power > 0 else 0.0, centre, mean),
        centre,
        float(power),
    )


def columns_where(keep: np.ndarray, *tables: np.ndarray) -> list[np.ndarray]:
    """Return some of the columns of tables (2, n), without a copy if all.

    Ten times as fast as indexing by the mask.
    """
    if keep.all():
        return [*tables]
    index = np.flatnonzero(keep)
    return [np.take(table, index, axis=1) for table in tables]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[0] * b[1] - a[1] * b[0]


def _turn(sine: float) -> float:
    # the deviation across the arm is its sine; the shortening of the arm is not used
    largest = np.sin(LARGEST_TURN_RAD)
    return float(np.arcsin(np.clip(sine, -largest, largest)))
