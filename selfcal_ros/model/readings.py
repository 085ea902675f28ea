# SPDX-License-Identifier: Apache-2.0
"""Readings of the marks, view by view, and their digests."""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, ClassVar
from weakref import WeakKeyDictionary

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View

OUTLIER = "outlier_among_views"
REPEAT_OUTLIER = "outlier_among_repeats"
AFTER_SLIP = " after slip"
"""End of the name of the part of a view that was read after the plate slipped."""
Key = tuple[int, str, tuple[int, ...]]
"""A reading: position of its view, ``grid`` or ``angular``, and (m, n) or (k,)."""
COLUMNS = (
    ("m", "i8"),
    ("n", "i8"),
    ("dx", "f8"),
    ("dy", "f8"),
    ("count", "i8"),
    ("u", "f8"),
    ("k", "i8"),
    ("dtheta", "f8"),
    ("count_theta", "i8"),
    ("u_theta", "f8"),
)
"""Columns of `ViewReadings` with their types, named like their fields in ViewMeasurement."""
VISIT_COLUMNS = (
    ("mark", "i8"),
    ("dx", "f8"),
    ("dy", "f8"),
    ("count", "i8"),
    ("stamp_ns", "i8"),
    ("offset_x", "f8"),
    ("offset_y", "f8"),
    ("approach_x", "i1"),
    ("approach_y", "i1"),
    ("u", "f8"),
)
"""Columns of `GridVisits`; their fields in ViewMeasurement begin with visit_, that of stamp_ns is
visit_stamp."""


class Sense(StrEnum):
    """What moves: the microscope over a resting plate, or the plate under the microscope.

    With ``plate_moves`` the mark at X is measured with the stage at p = -X, so that the
    stage's part of a deviation is -G(-X), and -Gtheta(-k) (method eq. 1.6).
    """

    MICROSCOPE_MOVES = "microscope_moves"
    PLATE_MOVES = "plate_moves"

    @property
    def sign(self) -> int:
        """Sign of the stage's position over the place of the mark that it measures."""
        return -1 if self is Sense.PLATE_MOVES else 1


def turned_over(
    sense: str, field: np.ndarray, *, sign: int = -1, axes: tuple[int, int] = (-2, -1)
) -> np.ndarray:
    """Return what the map of the stage is of the solved one, or the solved of that of the stage.

    With ``plate_moves`` the equations are solved for H(X) = -G(-X) (method eq. 1.6).

    Parameters
    ----------
    sense : str
        What moves.
    field : array (..., nx, ny)
        The map, or rows of functionals of it.
    sign : int
        1 for what has no sign: u, or which sites are known.
    axes : tuple of int
        The axes of x and y.
    """
    if sense != Sense.PLATE_MOVES:
        return field
    flipped = np.flip(field, axes)
    return flipped if sign > 0 else -flipped


def lines_turned_over(sense: str, values: np.ndarray, *, sign: int = -1) -> np.ndarray:
    """Return the same of the angular map, (K, ...): Htheta(k) = -Gtheta(-k)."""
    if sense != Sense.PLATE_MOVES:
        return values
    flipped = np.roll(values[::-1], 1, axis=0)
    return flipped if sign > 0 else -flipped


def _empty(kind: type) -> Any:
    return field(default_factory=lambda: np.zeros(0, dtype=kind))


def weights_by_u(
    mark: np.ndarray, u: np.ndarray, repeats: np.ndarray | float, n_marks: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the weights of readings in the mean of their mark, (n,), and each mark's least u.

    Proportional to 1/u^2 if all readings of the mark state u, and 1 for its best, so that they stay
    finite; else `repeats`, and the least u is 0.

    Parameters
    ----------
    mark : int array (n,)
        Index of the mark of each reading.
    u : float array (n,)
        Stated standard uncertainties, m or rad; 0 or NaN = not stated.
    repeats : float array (n,) or float
        Weights without u.
    n_marks : int
        Number of marks.
    """
    is_stated = np.isfinite(u) & (u > 0)
    least = np.full(n_marks, np.inf)
    np.minimum.at(least, mark, np.where(is_stated, u, 0.0))
    ratio = least[mark] / np.where(is_stated, u, 1.0)
    return np.where(least[mark] > 0, ratio**2, repeats), least


@dataclass(frozen=True, eq=False)
class GridVisits:
    """Visits of grid marks in one view: successive readings of a mark, no other mark in between.

    Information lost by averaging all repeats of a mark, but needed by terms of the model: instant,
    offset, and approach of each visit. Sorted by (mark, stamp), each visit once.

    Attributes
    ----------
    mark : int array (V,)
        Index of the mark in `ViewReadings.m` and `ViewReadings.n`.
    dx, dy : float array (V,)
        Mean deviation of the visit, stage frame, m.
    count : int array (V,)
        Repeats in the visit.
    stamp_ns : int64 array (V,)
        Mean instant of exposure.
    offset_x, offset_y : float array (V,)
        Mean offset measured by the microscope, stage axes, m.
    approach_x, approach_y : int8 array (V,)
        Sign of the last motion of each stage axis before the exposure; 0 = unknown.
    u : float array (V,) or (0,)
        Declared standard uncertainty of each mean, m; as `ViewReadings.u`.
    sigma_m : float
        Repeatability of one reading within its visit, pooled, m; NaN without repeats.
    dof : int
        Degrees of freedom of `sigma_m`.
    """

    mark: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    count: np.ndarray
    stamp_ns: np.ndarray
    offset_x: np.ndarray
    offset_y: np.ndarray
    approach_x: np.ndarray
    approach_y: np.ndarray
    u: np.ndarray = _empty(float)
    sigma_m: float = float("nan")
    dof: int = 0

    def shares(self, n_marks: int) -> np.ndarray:
        """Return the part that each visit has in the mean of its mark, (V,).

        By 1/u^2 if all visits of the mark declare u, else by repeats.
        """
        weight = self.count.astype(float)
        if len(self.u):
            weight, _ = weights_by_u(self.mark, self.u, weight, n_marks)
        return weight / np.bincount(self.mark, weight)[self.mark]

    def means(self, values: np.ndarray, n_marks: int) -> np.ndarray:
        """Return the means over the visits of each mark of complex values (V,), (n_marks,)."""
        shares = self.shares(n_marks)
        x, y = (
            np.bincount(self.mark, shares * part, n_marks)
            for part in (values.real, values.imag)
        )
        return x + 1j * y

    def of_marks(self, keep: np.ndarray) -> "GridVisits":
        """Return the visits of the marks where `keep` (P,) is true, renumbered."""
        stay = keep[self.mark]
        columns = {
            name: column[stay]
            for name, _ in VISIT_COLUMNS
            if len(column := getattr(self, name))
        }
        return replace(
            self, **columns | {"mark": (np.cumsum(keep) - 1)[self.mark[stay]]}
        )


@dataclass(frozen=True, eq=False)
class RepeatMotion:
    """Changes of offset and stage position between repeats of the marks of one view.

    Attributes
    ----------
    products : float array (2c, 2c)
        Sums of products of the c coordinates of the optical axis over the plate (reading minus
        offset), then of the c offsets, each about the mean of its mark and without slow changes;
        m^2 or rad^2.
    dof : int
        Degrees of freedom behind the sums.
    """

    products: np.ndarray
    dof: int


@dataclass(frozen=True, eq=False)
class RejectedPlaces:
    """Stage positions at rejected detections of grid marks, at most MOST per view.

    Attributes
    ----------
    reason : tuple of str
        Reason for each detection.
    x, y : float array (R,)
        Indicated position at the exposure, m; NaN where unknown.
    """

    MOST: ClassVar[int] = 500

    reason: tuple[str, ...] = ()
    x: np.ndarray = _empty(float)
    y: np.ndarray = _empty(float)


@dataclass(frozen=True, eq=False)
class ViewReadings:
    """Deviations of one view: reading minus nominal position, stage frame, m and rad.

    Only marks that were read appear, sorted by (m, n) and by k, each once.

    Attributes
    ----------
    view : View
        The commanded view.
    m, n : int array (P,)
        Indices of the grid marks, plate frame.
    dx, dy : float array (P,)
        Mean deviation V of each mark, m.
    count : int array (P,)
        Repeats behind each mean.
    u : float array (P,) or (0,)
        Standard uncertainty of each mean as declared by the detections, m; empty = unknown,
        and NaN for a single mark without declaration.
    k, dtheta, count_theta, u_theta : arrays (Q,)
        The same for angular lines, rad.
    sigma_xy, sigma_theta : float
        Repeatability of one reading, pooled, m and rad; NaN if no mark was read twice.
    dof_xy, dof_theta : int
        Degrees of freedom of these.
    used : int
        Detections behind the means.
    rejected : dict
        Reason -> number of rejected detections.
    visits : GridVisits, optional
        The visits behind the means of the grid marks; None if unknown.
    places : RejectedPlaces
        Positions of rejected grid detections; empty if unknown.
    axis_theta : float
        Indicated angle of the axis about the nominal one in the frame of the equations, mean of the
        lines, rad; 0 if unknown.
    outliers, outliers_theta : int array (P,) or (0,), (Q,) or (0,)
        Outliers among the repeats of each mark and line, additional to the count; empty if unknown.
    motion, motion_theta : RepeatMotion, optional
        Response of the offsets to the stage, in x and y and in angle; None without repeats.
    cells : tuple of ViewReadings
        In a view with images, the readings of the sub-views of the cells, in their order; grid
        marks are then in these alone. Empty without images.
    """

    view: View
    m: np.ndarray = _empty(int)
    n: np.ndarray = _empty(int)
    dx: np.ndarray = _empty(float)
    dy: np.ndarray = _empty(float)
    count: np.ndarray = _empty(int)
    u: np.ndarray = _empty(float)
    k: np.ndarray = _empty(int)
    dtheta: np.ndarray = _empty(float)
    count_theta: np.ndarray = _empty(int)
    u_theta: np.ndarray = _empty(float)
    sigma_xy: float = float("nan")
    sigma_theta: float = float("nan")
    dof_xy: int = 0
    dof_theta: int = 0
    used: int = 0
    rejected: dict[str, int] = field(default_factory=dict)
    visits: GridVisits | None = None
    places: RejectedPlaces = RejectedPlaces()
    axis_theta: float = 0.0
    outliers: np.ndarray = _empty(int)
    outliers_theta: np.ndarray = _empty(int)
    motion: RepeatMotion | None = None
    motion_theta: RepeatMotion | None = None
    cells: tuple["ViewReadings", ...] = ()

    @property
    def parts(self) -> tuple["ViewReadings", ...]:
        """The readings that are solved: those of the cells, or these."""
        return self.cells or (self,)

    @property
    def is_without_turning(self) -> bool:
        """Whether a slow turning of all lines was taken out of their repeats: it costs dof."""
        return 0 < self.dof_theta < int((self.count_theta - 1).sum())


@dataclass(frozen=True, eq=False)
class Measurements:
    """All readings of one calibration.

    Attributes
    ----------
    plan_id : str
        Plan that was measured.
    artifact : Artifact
        The plate.
    views : tuple of ViewReadings
        In the order of their view_index.
    sense : Sense
        Sense of measurement, the same for all views.
    rejected : dict
        Reason -> number of detections that belong to no view.
    run_id : str
        Run of the plan: the stamp of its first command, ns, as text; empty if unknown.
    model_terms : tuple of str
        Terms of the plan to be estimated with the map, see `selfcal_ros.model.terms`.
    artifact_from : str
        RESULT.json of the calibration that made the plate known; empty if it is not.
    verify : str
        RESULT.json whose correction was on; empty without one.
    """

    plan_id: str
    artifact: Artifact
    views: tuple[ViewReadings, ...]
    sense: Sense = Sense.MICROSCOPE_MOVES
    rejected: dict[str, int] = field(default_factory=dict)
    run_id: str = ""
    model_terms: tuple[str, ...] = ()
    artifact_from: str = ""
    verify: str = ""

    @property
    def has_images(self) -> bool:
        """Whether any reading is of an image of several marks."""
        return any(view.view.cell is not None for view in self.views)

    def all_rejected(self) -> dict[str, int]:
        """Return reason -> count over all views and outside them, sorted by reason."""
        total: dict[str, int] = {}
        for rejected in (self.rejected, *(view.rejected for view in self.views)):
            for reason, count in rejected.items():
                total[reason] = total.get(reason, 0) + count
        return dict(sorted(total.items()))


def subset(view: ViewReadings, grid: np.ndarray, lines: np.ndarray) -> ViewReadings:
    """Return the readings of a view where the masks over its marks and lines are true."""
    return replace(
        view,
        **{name: getattr(view, name)[grid] for name in ("m", "n", "dx", "dy", "count")},
        **{name: getattr(view, name)[lines] for name in ("k", "dtheta", "count_theta")},
        u=view.u[grid] if len(view.u) else view.u,
        u_theta=view.u_theta[lines] if len(view.u_theta) else view.u_theta,
        visits=None if view.visits is None else view.visits.of_marks(grid),
    )


def left_out(measurements: Measurements, index: int) -> Measurements:
    """Return the measurement without the readings of one view, counted as rejected."""
    view = measurements.views[index]
    lost = int(view.count.sum() + view.count_theta.sum())
    empty = subset(
        view, np.zeros(len(view.m), dtype=bool), np.zeros(len(view.k), dtype=bool)
    )
    views = (
        *measurements.views[:index],
        _rejecting(empty, lost),
        *measurements.views[index + 1 :],
    )
    return replace(measurements, views=views)


def without(
    measurements: Measurements, removed: Iterable[Key], *, mark: bool = False
) -> Measurements:
    """Return the measurement without some readings; `mark` counts them as rejected."""
    views = []
    keys = set(removed)
    for index, view in enumerate(measurements.views):
        marks = {key[2] for key in keys if key[0] == index and key[1] == "grid"}
        lines = {key[2][0] for key in keys if key[0] == index and key[1] == "angular"}
        views.append(
            _thinned(view, marks, lines, mark=mark) if marks or lines else view
        )
    return replace(measurements, views=tuple(views))


def _thinned(
    view: ViewReadings, marks: set[tuple[int, ...]], lines: set[int], *, mark: bool
) -> ViewReadings:
    keep = np.array(
        [(int(m), int(n)) not in marks for m, n in zip(view.m, view.n, strict=True)],
        dtype=bool,
    )
    stay = np.array([int(k) not in lines for k in view.k], dtype=bool)
    lost = int(view.count[~keep].sum() + view.count_theta[~stay].sum())
    thinned = subset(view, keep, stay)
    return _rejecting(thinned, lost) if mark else thinned


def _rejecting(view: ViewReadings, lost: int) -> ViewReadings:
    rejected = {**view.rejected, OUTLIER: view.rejected.get(OUTLIER, 0) + lost}
    return replace(view, rejected=rejected, used=view.used - lost)


def readings_digest(readings: ViewReadings, rejected: dict[str, int]) -> str:
    """Return the SHA-256 of one view's readings, visits, and the rejections outside views."""
    if readings not in _KNOWN:
        _KNOWN[readings] = _digest(readings)
    return hashlib.sha256(
        repr((_KNOWN[readings], sorted(rejected.items()))).encode()
    ).hexdigest()


def view_digest(cells: Sequence[ViewReadings], rejected: dict[str, int]) -> str:
    """Return one digest of the readings of a view: of all cells, if it has images."""
    digests = [readings_digest(cell, rejected) for cell in cells]
    if len(digests) == 1:
        return digests[0]
    return hashlib.sha256(repr(digests).encode()).hexdigest()


_KNOWN: WeakKeyDictionary[ViewReadings, str] = WeakKeyDictionary()
"""Digests of readings still in use: those of a finished view are requested repeatedly."""


def _digest(readings: ViewReadings) -> str:
    digest = hashlib.sha256()
    visits = readings.visits
    for table, columns in (
        (readings, COLUMNS),
        *(((visits, VISIT_COLUMNS),) if visits else ()),
    ):
        for name, kind in columns:
            digest.update(
                np.ascontiguousarray(getattr(table, name), dtype=kind).tobytes()
            )
    if visits:
        digest.update(repr((visits.sigma_m, visits.dof)).encode())
    for motion in (readings.motion, readings.motion_theta):
        if motion:
            digest.update(motion.products.tobytes() + repr(motion.dof).encode())
    digest.update(repr(readings.places.reason).encode())
    digest.update(readings.places.x.tobytes() + readings.places.y.tobytes())
    # the readings, not the settings of the measurement
    view = replace(readings.view, visit_order="", check_marks=0, check_offset_m=0.0)
    digest.update(
        repr(
            (
                view,
                readings.sigma_xy,
                readings.sigma_theta,
                readings.dof_xy,
                readings.dof_theta,
                readings.used,
                readings.rejected,
                *([readings.axis_theta] if readings.axis_theta else []),
            )
        ).encode()
    )
    return digest.hexdigest()


def placing_digest(artifact: Artifact, view: View) -> str:
    """Return a short digest of a plate with its map, and of pose and marks of a view, unnamed."""
    numbers = (
        *artifact.shape,
        artifact.grid_pitch_m,
        artifact.angular_count,
        view.rotation_rad,
        *view.translation_m,
        view.grid,
        view.angular,
        view.repeats,
        view.check_marks,
        view.check_offset_m,
    )
    text = ",".join(float(number).hex() for number in numbers)
    text += "".join(
        repr(item)
        for item in (artifact.map_grid, view.image, artifact.marks)
        if item is not None
    )
    text += f",{artifact.harmonics}" if artifact.harmonics else ""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def session_digest(digests: dict[int, str]) -> str:
    """Return one digest of view_index -> digest."""
    return hashlib.sha256(repr(sorted(digests.items())).encode()).hexdigest()[:16]
