# SPDX-License-Identifier: Apache-2.0
"""What may be found in readings: a class for each finding, with the data that its sentence needs.

`selfcal_ros.reporting.words` has the sentences. All data are in SI units.
"""

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

from selfcal_ros.files import read
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View


@dataclass(frozen=True)
class Remedy:
    """Remedy for a cause: solve with a `model` or `map`, measure a `view`, or an `action`."""

    kind: Literal["model", "map", "view", "action"]
    value: str


@dataclass(frozen=True, kw_only=True)
class Found:
    """What all findings and causes have.

    Attributes
    ----------
    size, u : float
        Largest component and its standard uncertainty, in `unit`; NaN if none.
    unit : str
        ``m``, ``rad`` or ``m/m`` (also for a ratio of noises); empty without a size.
    p : float
        Probability of as much without it.
    view, axis : str
        Location: name of the view, ``x`` or ``y``; empty if not applicable.
    mark : tuple of int
        Mark (m, n) or line (k,) of a single reading; else empty.
    text : str
        Its sentence; empty before wording.
    """

    size: float = math.nan
    u: float = math.nan
    unit: str = ""
    p: float = math.nan
    view: str = ""
    axis: str = ""
    mark: tuple[int, ...] = ()
    text: str = ""


@dataclass(frozen=True, kw_only=True)
class CauseDetails:
    """Further data of the sentence of a cause, SI units; what a cause does not have is left out.

    Attributes
    ----------
    part, against : str
        Component of its block, and the view from which its view differs.
    either : bool
        Whether the scale of the other offsets explains it as well.
    given : float
        Size with which the term was assumed, where readings show a larger one.
    declared : float
        0 of a term that was declared to be so.
    x, y, phi : float
        Slip of the plate, stage frame, m and rad.
    after : float
        Part of the visits of the view before it.
    away : float
        Distance of the stage from the sites, m.
    harmonics : int
        Harmonics of the angular map that do not suffice.
    nodes : tuple of int
        Nodes of the map along x and y that do not.
    robust : bool
        Whether what contradicts the other readings was left out already.
    """

    part: str = ""
    against: str = ""
    either: bool = False
    given: float = math.nan
    declared: float = math.nan
    x: float = math.nan
    y: float = math.nan
    phi: float = math.nan
    after: float = math.nan
    away: float = math.nan
    harmonics: int = 0
    nodes: tuple[int, ...] = ()
    robust: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Return what there is, by name."""
        return {
            item.name: value
            for item in fields(self)
            if (value := getattr(self, item.name)) == value  # no NaN
            and value != item.default
        }


@dataclass(frozen=True, kw_only=True)
class Cause(Found):
    """Explanation of the residuals, or of an enlarged uncertainty.

    Attributes
    ----------
    name : str
        Name of a term, or ``slip``, ``reading``, ``off_sites``, ``roughness``, ``reversal`` or
        ``noise``.
    details : CauseDetails
        Further data of its sentence.
    effect_rms, effect_max : float
        Effect on the map: of one coordinate, m, or of the angular map, rad, if `unit` is
        rad and it is in the lines; NaN if unknown.
    told : bool
        Whether the readings determine all of it.
    remedies : tuple of Remedy
        Remedies, the best first; those that name a model were tried on these readings.
    """

    name: str
    details: CauseDetails = CauseDetails()
    effect_rms: float = math.nan
    effect_max: float = math.nan
    told: bool = True
    remedies: tuple[Remedy, ...] = ()


def _name_of(kind: type) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", kind.__name__).lower()


def _own_fields(kind: type[Found]) -> set[str]:
    return {item.name for item in fields(kind)} - {item.name for item in fields(Found)}


class Finding(Found):
    """Something found in the readings; each kind is a class of its own."""

    @property
    def name(self) -> str:
        """Name of the kind in results: that of its class, in lower case with underscores."""
        return _name_of(type(self))

    @property
    def details(self) -> dict[str, Any]:
        """What the kind has besides size and location, as in results."""
        own_fields = _own_fields(type(self))
        details = {
            name: value for name, value in asdict(self).items() if name in own_fields
        }
        of_causes = {
            name: value.to_dict()
            for name, value in vars(self).items()
            if isinstance(value, CauseDetails)
        }
        return details | of_causes


@dataclass(frozen=True, kw_only=True)
class InWords(Finding):
    """A finding of a file, of which this version knows only what the file says."""

    kind: str = "in_words"
    data: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the kind, as the file has it."""
        return self.kind

    @property
    def details(self) -> dict[str, Any]:
        """The further data, as the file has them."""
        return self.data


# -- tests that failed


class NotIdentified(Finding):
    """The readings do not identify the stage."""


class SignNotShown(Finding):
    """Nothing shows the sign of the offsets of marks."""


class NoOffsets(Finding):
    """All offsets of marks are 0: of marks that were centred, or of a detector that is dead."""


class SignShownByLines(Finding):
    """Only the offsets of lines show the sign of the offsets of marks."""


class LinesSignNotShown(Finding):
    """Nothing shows the sign of the offsets of lines."""


@dataclass(frozen=True, kw_only=True)
class ScaleOfOffsets(Finding):
    """Offsets are `size` to `most` times what the stage moves, their scale is 1 ± `u_scale`."""

    most: float
    u_scale: float


class NotConverged(Finding):
    """The estimate did not converge with what is assumed of the measurement."""


@dataclass(frozen=True, kw_only=True)
class FiniteRotation(Finding):
    """The model is linear and the plate turned by up to `size`; a rigid one leaves `residuals`."""

    residuals: float


@dataclass(frozen=True, kw_only=True)
class NoiseContradicted(Finding):
    """Residuals show a noise of `size`; repeats, or what was `declared`, state another."""

    stated: float
    declared: bool


class NoiseUnknown(Finding):
    """Neither repeats nor residuals determine the noise of marks."""


class AxesNotMet(Finding):
    """The angular map does not meet the conditions of the axes."""


@dataclass(frozen=True, kw_only=True)
class PredictionFailed(Finding):
    """A view held out, or a random tenth by its number, is predicted worse than `limit`."""

    tenth: int
    limit: float


@dataclass(frozen=True, kw_only=True)
class BetweenRuns(Finding):
    """Combined runs differ in a quantity (``xy``, ``theta``) by more than their uncertainties.

    `of_scale`: whether nearly all of it is their scale.
    """

    runs: int
    quantity: str
    of_scale: bool = False


@dataclass(frozen=True, kw_only=True)
class EnlargedRuns(Finding):
    """Combined runs whose uncertainty was enlarged, by name."""

    runs: tuple[str, ...]


# -- of a recheck


@dataclass(frozen=True, kw_only=True)
class Changed(Finding):
    """The stage changed since `of`, the file of a calibration, most clearly at (x, y), m."""

    x: float
    y: float
    of: str


class ChangedOrDrifted(Changed):
    """A change that one pass cannot tell from drift."""


@dataclass(frozen=True, kw_only=True)
class ChangedOrMicroscope(Changed):
    """A change that a microscope of another scale and turn, rad, explains as well."""

    scale: float
    u_scale: float
    turn: float
    u_turn: float


@dataclass(frozen=True, kw_only=True)
class ChangedOrMarks(Changed):
    """A change that `mark` shows by itself, `away` from its neighbours, and `others` likewise."""

    away: float
    others: int


@dataclass(frozen=True, kw_only=True)
class ScaleChanged(Finding):
    """The scale of the encoders against the plate changed since `of`, a file; seen in `passes`."""

    passes: int = 0
    of: str


@dataclass(frozen=True, kw_only=True)
class ScaleNotCompared(Finding):
    """The map in `of`, a file, has a scale; the temperature of the plate now is not stated.

    `certified`: whether that of the calibration was.
    """

    of: str
    certified: bool


@dataclass(frozen=True, kw_only=True)
class MicroscopeOff(Finding):
    """The microscope has another scale (`size`) and turn, rad, than assumed; it was corrected."""

    turn: float
    u_turn: float


class PlateMisfit(Finding):
    """Residuals are `size` times what the noise and the known plate allow."""


@dataclass(frozen=True, kw_only=True)
class OtherPlate(Finding):
    """The marks differ from those of the plate in `of`, a file, by `times` u."""

    times: float
    of: str


# -- what was left out, could not be done, or should be looked at


@dataclass(frozen=True, kw_only=True)
class NotInAll(Finding):
    """Number of sites that are not known in all of the combined runs."""

    sites: int


@dataclass(frozen=True, kw_only=True)
class WarningOfRuns(Finding):
    """A warning of combined `runs`, by their files, in words."""

    runs: tuple[str, ...]
    warning: str


class NoUncertainty(Finding):
    """The field is too large for an uncertainty that nobody asked for."""


class RoughnessUntested(Finding):
    """Whether the nodes of the map suffice was not tested."""


class HarmonicsUntested(Finding):
    """Whether the harmonics of the angular map suffice was not tested."""


@dataclass(frozen=True, kw_only=True)
class TermWithoutReadings(Finding):
    """A term on which no reading depends."""

    term: str


class VisitedOnce(Finding):
    """Each mark was visited once in a view."""


class ApproachUnknown(Finding):
    """The encoder does not show from which side most marks were approached."""


@dataclass(frozen=True)
class FewReadCell:
    """A cell of images, in a view or in all of them: marks `read` of those `shown`."""

    view: str
    cell: tuple[int, int]
    read: int
    shown: int


@dataclass(frozen=True, kw_only=True)
class FewRead(Finding):
    """Cells with few readings, and those where the camera's error is not known; None: nowhere."""

    unknown: tuple[tuple[int, int], ...] | None
    cells: tuple[FewReadCell, ...]


@dataclass(frozen=True, kw_only=True)
class ViewLeftOut(Finding):
    """A view of which none, or less than half, of the (marks, lines) `asked` were `read`."""

    read: tuple[int, ...] = (0, 0)
    asked: tuple[int, ...] = (0, 0)
    rejected: dict[str, int]


@dataclass(frozen=True, kw_only=True)
class PlateHardlyMoved(Finding):
    """A plate without visible errors lies, but for a motion of `size`, as in the view `against`."""

    against: str


@dataclass(frozen=True, kw_only=True)
class RepeatsContradict(Finding):
    """Many of the readings of a view contradict the other repeats of their marks."""

    rejected: int
    of: int


@dataclass(frozen=True, kw_only=True)
class Unchecked(Finding):
    """Sites (m, n) and lines of the map that rest on single readings."""

    sites: tuple[tuple[int, ...], ...]
    lines: tuple[int, ...]


class Magnification(Finding):
    """The encoders indicate the plate larger than nominal by `size`, more than is plausible."""


class ReferenceOff(Finding):
    """By a reference length the encoders indicate lengths longer by `size` than they are."""


@dataclass(frozen=True, kw_only=True)
class DrawnUncertainty(Finding):
    """Uncertainties of Hu's law come from a number of draws."""

    draws: int


# -- of screening


@dataclass(frozen=True)
class OutlierRemoved:
    """A reading of a mark (m, n) or a line (k,) that was removed, and its standardised residual."""

    view: str
    kind: str
    mark: tuple[int, ...]
    standardised: float


@dataclass(frozen=True, kw_only=True)
class OutliersRemoved(Finding):
    """The number of readings removed, and the first of them."""

    number: int
    first: tuple[OutlierRemoved, ...]


class NoisyView(Finding):
    """A view is `size` times as noisy as the others."""


@dataclass(frozen=True, kw_only=True)
class TooManyOutliers(Finding):
    """More than this part of the readings contradict the others: none was removed."""

    limit: float


class OutliersKept(Finding):
    """Removing more outliers would leave the stage undetermined."""


@dataclass(frozen=True, kw_only=True)
class OutliersGivenUp(Finding):
    """There were outliers after this many rounds."""

    rounds: int


@dataclass(frozen=True)
class SlipBefore:
    """Where a plate may have slipped: in a view, before the first line of marks along an axis."""

    view: str
    axis: str
    first: int


@dataclass(frozen=True, kw_only=True)
class SlipFound(Finding):
    """A plate slipped by (x, y), m, and phi, rad, at one of `places`; whether it spoils the map."""

    places: tuple[SlipBefore, ...]
    x: float
    y: float
    phi: float
    spoils: bool


@dataclass(frozen=True, kw_only=True)
class TakenForSlip(Finding):
    """What looks like a slip in view `slip_in` is the cause `cause`, with its data."""

    cause: str
    slip_in: str
    told: bool = True
    of_cause: CauseDetails = CauseDetails()


@dataclass(frozen=True, kw_only=True)
class SlipsGivenUp(Finding):
    """There were slips after this many."""

    slips: int


# -- why readings held out were not predicted, or not judged


class RestNotConverged(Finding):
    """The remaining readings do not converge."""


class NothingToPredict(Finding):
    """No mark held out is known from the rest."""


@dataclass(frozen=True, kw_only=True)
class OwnTermsUnknown(Finding):
    """What a view held out has of its own cannot be known: terms, by name."""

    terms: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class RestNotIdentified(Finding):
    """The remaining readings do not identify the stage; with view `add` they would."""

    add: View | None = None


# -- what the readings, or a plan, do not determine


class Nonorthogonality(Finding):
    """Non-orthogonality of the axes."""


class ScaleDifference(Finding):
    """Scale difference of the axes."""


class BendingX(Finding):
    """Steady turn from column to column."""


class BendingY(Finding):
    """Steady turn from row to row."""


@dataclass(frozen=True, kw_only=True)
class UndeterminedFields(Finding):
    """A number of fields that are hardly determined."""

    count: int


@dataclass(frozen=True, kw_only=True)
class SitesNeverVisited(Finding):
    """A number of sites that no mark reaches, and the first, (m, n)."""

    count: int
    first: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class MarksNeverRead(Finding):
    """A number of marks of the plate that no view reads."""

    count: int


class EveryField(Finding):
    """Everything: there is one view."""


@dataclass(frozen=True, kw_only=True)
class LineOffsets(Finding):
    """Offsets of ``rows`` or ``columns`` against each other; whether opposite in opposite ones."""

    lines: str
    opposite: bool


@dataclass(frozen=True, kw_only=True)
class RotationSymmetric(Finding):
    """Fields that a quarter turn, or a half turn, maps to themselves: how many `numbers`."""

    half: bool
    numbers: int


@dataclass(frozen=True, kw_only=True)
class PeriodicFields(Finding):
    """Fields that repeat with a period along x and y, in pitches: how many `numbers`."""

    period: tuple[int, ...]
    numbers: int


@dataclass(frozen=True, kw_only=True)
class GroupsOfSites(Finding):
    """A number of groups of sites that no reading connects, and the sites of the smallest."""

    count: int
    smallest: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, kw_only=True)
class HarmonicsUnseen(Finding):
    """Harmonics of the angular map; whether any view turns the lines."""

    harmonics: tuple[int, ...]
    turned: bool


@dataclass(frozen=True, kw_only=True)
class PeriodicLines(Finding):
    """Patterns of the angular map that repeat every `period` of its lines."""

    period: int
    of: int


@dataclass(frozen=True, kw_only=True)
class GroupsOfLines(Finding):
    """A number of groups of lines that no view connects."""

    count: int


@dataclass(frozen=True, kw_only=True)
class LinesNeverVisited(Finding):
    """A number of angles of the stage that no line reaches."""

    count: int


@dataclass(frozen=True, kw_only=True)
class LooksLikeStage(Finding):
    """A number of modes of the stage that look like a term."""

    term: str
    count: int


# -- what would determine it


@dataclass(frozen=True, kw_only=True)
class SeparateTerm(Finding):
    """A term has to be told apart from the stage."""

    term: str


@dataclass(frozen=True, kw_only=True)
class MarksMissing(Finding):
    """Sites and lines that are determined, and those there are."""

    sites: int
    of_sites: int
    lines: int
    of_lines: int


@dataclass(frozen=True, kw_only=True)
class AddViews(Finding):
    """Views that a plan with this plate lacks."""

    views: tuple[View, ...]
    plate: Artifact


class OrAddViews(AddViews):
    """Other views that it lacks instead."""


class AddViewsOrFewerNodes(AddViews):
    """Views that it lacks, if the map shall keep its nodes."""


def finding_to_dict(finding: Finding | Cause) -> dict[str, Any]:
    """Return the JSON form of a finding, or of a cause.

    Raises
    ------
    ValueError
        If it has no sentence.
    """
    if not finding.text:
        raise ValueError(f"the finding '{finding.name}' is not worded")
    data = {item.name: getattr(finding, item.name) for item in fields(Found)}
    data |= {
        "name": finding.name,
        "mark": list(finding.mark),
        "details": finding.details.to_dict()
        if isinstance(finding, Cause)
        else finding.details,
    }
    if isinstance(finding, Cause):
        data |= {
            "effect_rms": finding.effect_rms,
            "effect_max": finding.effect_max,
            "told": finding.told,
            "remedies": [{remedy.kind: remedy.value} for remedy in finding.remedies],
        }
    return data


def cause_from_dict(data: Any) -> Cause:
    """Return a cause from its JSON form."""
    cause = read(dict, data)
    remedies = [
        {"kind": kind, "value": value}
        for remedy in cause.get("remedies", [])
        for kind, value in remedy.items()
    ]
    return read(Cause, cause | {"remedies": remedies})


def finding_from_dict(data: Any) -> Finding:
    """Return a finding from its JSON form; one that this version does not know, in its words."""
    finding = read(dict, data)
    name = read(str, finding["name"])
    details = read(dict, finding.get("details", {}))
    kind = {_name_of(kind): kind for kind in _kinds_of(Finding)}.get(name)
    # of another version: what its class has no place for would be lost
    if kind is not None and details.keys() <= _own_fields(kind):
        with contextlib.suppress(KeyError, ValueError):
            return read(kind, finding | details)
    return read(InWords, finding | {"kind": name, "data": details})


def _kinds_of(base: type[Finding]) -> Iterator[type[Finding]]:
    for kind in base.__subclasses__():
        yield kind
        yield from _kinds_of(kind)
