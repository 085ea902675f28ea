# SPDX-License-Identifier: Apache-2.0
"""Parts of a result that not every run has: tables behind figures and sections of a report."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from selfcal_ros.model.findings import SlipBefore, SlipFound
from selfcal_ros.model.recheck import PlateCalibration
from selfcal_ros.outputs import filled_fields


@dataclass(frozen=True, eq=False)
class ViewCourse:
    """Mean residuals of a view in intervals of its time.

    Attributes
    ----------
    time_s : float array (parts,)
        From the first visit of the run to the first of each interval, s.
    dx, dy : float array (parts,)
        Means, stage axes, m.
    count : tuple of int
        Readings behind each.
    """

    time_s: np.ndarray
    dx: np.ndarray
    dy: np.ndarray
    count: tuple[int, ...]

    def __post_init__(self) -> None:
        """Raise ValueError if the columns differ in length, or a value is not finite."""
        columns = (self.time_s, self.dx, self.dy)
        if {len(column) for column in columns} != {len(self.count)}:
            raise ValueError("the columns of a course differ in length")
        if not np.isfinite(columns).all():
            raise ValueError("a value of a course is not finite")


@dataclass(frozen=True, eq=False)
class ViewResiduals:
    """Residuals of one view.

    Attributes
    ----------
    view : str
        Its name.
    dx, dy : float array (nx, ny), optional
        By mark of the plate, stage axes, m; NaN where not read, None without marks.
    course : ViewCourse, optional
        Over the time of the view; None where that is not known.
    dtheta : float array (K,), optional
        By line, counter-clockwise, rad; NaN where not read, None without lines.
    """

    view: str
    dx: np.ndarray | None = None
    dy: np.ndarray | None = None
    course: ViewCourse | None = None
    dtheta: np.ndarray | None = None


@dataclass(frozen=True)
class ResidualsOfViews:
    """Residuals of all readings, view by view."""

    views: tuple[ViewResiduals, ...]


@dataclass(frozen=True, eq=False)
class RejectedAt:
    """Where the stage stood for rejected detections of a view, m, and the reason of each."""

    view: str
    reason: tuple[str, ...]
    x: np.ndarray
    y: np.ndarray

    def __post_init__(self) -> None:
        """Raise ValueError if reasons and places differ in number."""
        if not len(self.reason) == len(self.x) == len(self.y):
            raise ValueError(
                "reasons and places of rejected detections differ in number"
            )


@dataclass(frozen=True)
class Removed:
    """A reading that was removed.

    Attributes
    ----------
    view, kind : str
        Name of the view; ``grid`` or ``angular``.
    mark : tuple of int
        (m, n), or (k,).
    standardised : float
        Residual over its standard deviation when it was removed.
    leverage : float
        Part of the reading that the fit followed.
    residual_m, residual_rad : float
        Length of the residual of a mark, m, and size of that of a line, rad; NaN of the other.
    """

    view: str
    kind: str
    mark: tuple[int, ...]
    standardised: float
    leverage: float
    residual_m: float = float("nan")
    residual_rad: float = float("nan")

    def __post_init__(self) -> None:
        """Raise ValueError if the mark is not one of its kind."""
        if len(self.mark) != (2 if self.kind == "grid" else 1):
            raise ValueError(f"{self.mark} is not a mark of the kind {self.kind!r}")


@dataclass(frozen=True)
class Outliers:
    """Readings that were removed, by which rule, and how many could not be checked."""

    rule: str
    unchecked: int
    removed: tuple[Removed, ...]


@dataclass(frozen=True)
class SlipPlace:
    """Where in a view the plate may have slipped.

    Attributes
    ----------
    view : str
        Name of the view.
    index : int
        Its position in the measurement.
    axis : str
        ``m`` or ``n``: index of the marks along which the view was read.
    first : int
        First value of that index after the slip.
    chi2 : float
        Explained sum of squares over the noise variance; 3 on average without a slip.
    """

    view: str
    index: int
    axis: str
    first: int
    chi2: float = 0.0

    @property
    def place(self) -> SlipBefore:
        """View, axis and first line of marks after the slip."""
        return SlipBefore(self.view, self.axis, self.first)


@dataclass(frozen=True)
class Slip(SlipPlace):
    """A slip of the plate within a view, at a place.

    Attributes
    ----------
    tx_m, ty_m, phi_rad : float
        Change of offset and rotation, stage frame.
    alternatives : tuple of SlipPlace
        Other places that explain the readings equally well: few views do not always determine it.
    """

    tx_m: float = 0.0
    ty_m: float = 0.0
    phi_rad: float = 0.0
    alternatives: tuple[SlipPlace, ...] = ()

    def finding(self, *, spoils: bool) -> SlipFound:
        """Return the slip as a finding; `spoils` if the view had to be kept unsplit."""
        return SlipFound(
            size=float(np.hypot(self.tx_m, self.ty_m)),
            unit="m",
            view=self.view,
            places=tuple(slip.place for slip in (self, *self.alternatives)),
            x=self.tx_m,
            y=self.ty_m,
            phi=self.phi_rad,
            spoils=spoils,
        )


@dataclass(frozen=True)
class ViewNoise:
    """A view that is noisier than the others, and how many times."""

    view: str
    ratio: float


@dataclass(frozen=True)
class HeldOutFigures:
    """Prediction error of one set of held-out readings, as `HeldOut` has it, with its words."""

    name: str
    view: str
    n_grid: int
    n_angular: int
    rms_m: float
    max_m: float
    rms_rad: float
    ratio: float
    note: str
    limit: float
    exceeds: bool


@dataclass(frozen=True)
class CombinedRun:
    """A run behind a mean of maps, against the mean of the others.

    Attributes
    ----------
    file, run_id, sha256 : str
        Its file, its run, and the digest of its readings; empty if unknown.
    weight : float
        Its part of the mean.
    e_n_rms, e_n_largest : float
        |E_n| of its XY map: root mean square and largest.
    beyond : float
        Share of coordinates with |E_n| above 1.
    p : float
        Probability of such a difference by chance; NaN if it was not tested.
    agrees : bool, optional
        The verdict of that test.
    stands_out : bool
        Whether it scatters more than the others.
    e_n_rms_theta, ... : optional
        The same of the angular map.
    calibration : PlateCalibration, optional
        Of a recheck: what made its plate known.
    """

    file: str
    run_id: str
    sha256: str
    weight: float
    e_n_rms: float
    e_n_largest: float
    beyond: float
    p: float
    agrees: bool | None
    stands_out: bool
    e_n_rms_theta: float | None = None
    e_n_largest_theta: float | None = None
    beyond_theta: float | None = None
    p_theta: float | None = None
    agrees_theta: bool | None = None
    stands_out_theta: bool | None = None
    calibration: PlateCalibration | None = None


@dataclass(frozen=True)
class Combined:
    """Scatter between the runs behind a mean of maps, m and rad, with its probability."""

    u_between_m: float
    p_between: float
    u_between_rad: float | None = None
    p_between_theta: float | None = None
    runs: tuple[CombinedRun, ...] = ()


@dataclass(frozen=True)
class Parts:
    """Keys of RESULT.json that not every run has; None if it does not have them.

    Attributes
    ----------
    residuals : ResidualsOfViews
        Of all readings; not of large fields.
    rejected_at : tuple of RejectedAt
        Positions of rejected grid detections.
    turned : tuple of str
        Views whose lines turned slowly while they were read, which was taken out.
    outliers : Outliers
        What a robust calibration removed.
    slips, noisy_views : tuple
        Views in which the plate slipped, and those noisier than the others, likewise.
    validation : tuple of HeldOutFigures
        Readings held out in turn, and predicted.
    combined : Combined
        The runs behind a mean of maps.
    """

    residuals: ResidualsOfViews | None = None
    rejected_at: tuple[RejectedAt, ...] | None = None
    turned: tuple[str, ...] | None = None
    outliers: Outliers | None = None
    slips: tuple[Slip, ...] | None = None
    noisy_views: tuple[ViewNoise, ...] | None = None
    validation: tuple[HeldOutFigures, ...] | None = None
    combined: Combined | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the keys of RESULT.json that they are."""
        return filled_fields(self)


PARTS = tuple(part.name for part in fields(Parts))
"""Their keys in RESULT.json."""
