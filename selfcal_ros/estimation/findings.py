# SPDX-License-Identifier: Apache-2.0
"""What estimation has to tell a person, as data in SI units: what failed, why, what was left out.

`selfcal_ros.reporting.words` makes the sentences of it.
"""

from dataclasses import dataclass

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.verdict import Cause, Finding
from selfcal_ros.model.view import View


@dataclass(frozen=True)
class NoiseContradicted(Finding):
    """The residuals of ``grid`` or ``angular`` readings contradict the stated noise, m or rad.

    It is stated by the detections' own sigma if `declared`, else by repeats.
    """

    kind: str
    residuals: float
    stated: float
    declared: bool


@dataclass(frozen=True)
class NoiseUnknown(Finding):
    """Neither repeats nor residuals of the grid readings determine their noise."""


@dataclass(frozen=True)
class SignNotShown(Finding):
    """Nothing in the readings shows the sign of the offsets, and nobody declared the microscope."""


@dataclass(frozen=True)
class NotConverged(Finding):
    """The estimate converged only without what is assumed of the measurement."""


@dataclass(frozen=True)
class FiniteRotation(Finding):
    """A linear model was used, and finite rotations leave much less: `residuals_m`."""

    largest_rad: float
    residuals_m: float


@dataclass(frozen=True)
class AxesNotMet(Finding):
    """The stage does not satisfy the axis conditions of the datum ``xy_axes``."""

    misclosure_rad: float
    p: float


@dataclass(frozen=True)
class MicroscopeCause(Finding):
    """Which combination of the microscope's matrix stands out.

    ``scale`` or ``turn``, or half of the difference of its ``scales`` or of its ``shear``.
    """

    part: str


@dataclass(frozen=True)
class DriftCause(Finding):
    """Along which axis the plate drifted, and in which view."""

    axis: str
    view: str


@dataclass(frozen=True)
class PlateScaleCause(Finding):
    """In which view the plate is larger, and than in which."""

    view: str
    against: str


@dataclass(frozen=True)
class PlateShapeCause(Finding):
    """In which view the plate is bent against which; `whole`: the readings tell all of it."""

    view: str
    against: str
    whole: bool


@dataclass(frozen=True)
class PlateStrainCause(Finding):
    """In which view the plate is strained against which: its scale, stretch (x - y) or shear."""

    view: str
    against: str
    part: str


@dataclass(frozen=True)
class LineEccentricityCause(Finding):
    """The view in which the circle of lines lies off the axis of rotation."""

    view: str


@dataclass(frozen=True)
class ApproachCause(Finding):
    """The axis that indicates something else by the direction of approach."""

    axis: str


@dataclass(frozen=True)
class SlipCause(Finding):
    """Offset and rotation of a plate after a part (0..1) of a view's visits."""

    view: str
    part: float
    x_m: float
    y_m: float
    phi_rad: float


@dataclass(frozen=True)
class RotationCause(Finding):
    """The view whose lines are turned against its marks."""

    view: str


@dataclass(frozen=True)
class ReadingCause(Finding):
    """A reading that the others contradict: its view, and its mark (m, n), or line (k,)."""

    view: str
    mark: tuple[int, ...]


@dataclass(frozen=True)
class SizeCause(Finding):
    """The size that was given for a term, and the largest that the readings show."""

    given: float
    shown: float


@dataclass(frozen=True)
class OffSitesCause(Finding):
    """How far the stage stood off the sites of the marks at its visits, rms.

    `shown`: residuals are smaller without what that makes of the readings.
    """

    away_m: float
    shown: bool


@dataclass(frozen=True)
class NoiseCause(Finding):
    """A view that is noisier than the others."""

    view: str


@dataclass(frozen=True)
class PredictionFailed(Finding):
    """Readings that were held out are predicted worse than noise and the map's u allow."""

    what: str
    ratio: float
    limit: float


@dataclass(frozen=True)
class RestNotIdentified(Finding):
    """Readings cannot be held out: the rest does not identify the stage.

    With the view `more` of a plate measured as well it would; None: no single view would do.
    """

    artifact: Artifact
    more: View | None = None


@dataclass(frozen=True)
class RestNotSettled(Finding):
    """Readings cannot be held out: the estimate does not settle on the rest."""


@dataclass(frozen=True)
class NothingToPredict(Finding):
    """No mark that was held out is known from the rest."""


@dataclass(frozen=True)
class OwnTermsUnknown(Finding):
    """What a view held out has of its own, by terms, cannot be known: it is not judged."""

    terms: tuple[str, ...]


@dataclass(frozen=True)
class NoUncertainty(Finding):
    """The field is so large that the uncertainty is computed only when it is asked for."""


@dataclass(frozen=True)
class VisitedOnce(Finding):
    """Each mark was visited once in a view, its repeats one after the other."""


@dataclass(frozen=True)
class Unchecked(Finding):
    """Sites (m, n) and lines (k,) of the map that rest on readings which no other checks."""

    sites: tuple[tuple[int, ...], ...]
    lines: tuple[tuple[int, ...], ...] = ()


@dataclass(frozen=True)
class Magnification(Finding):
    """Plate and encoders differ in scale, m/m, by more than they can between them; with u."""

    value: float
    u: float


@dataclass(frozen=True)
class DrawnUncertainty(Finding):
    """The uncertainty of Hu's law comes from that many draws of unit noise."""

    n_draws: int


@dataclass(frozen=True)
class Removed(Finding):
    """A reading that was removed.

    Attributes
    ----------
    view : str
        Name of the view.
    kind : str
        ``grid`` or ``angular``.
    mark : tuple of int
        (m, n), or (k,).
    standardised : float
        Residual over its standard deviation when it was removed.
    leverage : float
        Part of the reading that the fit followed.
    residual : float
        Length of the residual, m, or its size, rad.
    """

    view: str
    kind: str
    mark: tuple[int, ...]
    standardised: float
    leverage: float
    residual: float


@dataclass(frozen=True)
class OutliersRemoved(Finding):
    """All readings that were removed as outliers; at least one."""

    removed: tuple[Removed, ...]


@dataclass(frozen=True)
class NoisyView(Finding):
    """A view whose noise is `ratio` times that of the others."""

    view: str
    ratio: float


@dataclass(frozen=True)
class TooManyOutliers(Finding):
    """More than that part of the readings contradict the others, so that none was removed."""

    limit: float


@dataclass(frozen=True)
class OutliersKept(Finding):
    """Removing more outliers would leave the stage undetermined."""


@dataclass(frozen=True)
class OutliersGivenUp(Finding):
    """Outliers were left after that many rounds."""

    n_rounds: int


@dataclass(frozen=True)
class SlipFound(Finding):
    """A plate that slipped within a view.

    Attributes
    ----------
    view : str
        Name of the view.
    places : tuple of str
        Before which line of marks; more than one if the readings do not tell which.
    tx_m, ty_m, phi_rad : float
        Change of offset and rotation, stage frame.
    spoils : bool
        Whether the view had to stay as it was; else it was split, or left out where the readings
        do not tell the place.
    """

    view: str
    places: tuple[str, ...]
    tx_m: float
    ty_m: float
    phi_rad: float
    spoils: bool


@dataclass(frozen=True)
class TakenForSlip(Finding):
    """What looks like a slip in a view is explained better by a cause."""

    view: str
    cause: Cause


@dataclass(frozen=True)
class SlipsGivenUp(Finding):
    """Slips were left after that many had been found."""

    n_slips: int
