# SPDX-License-Identifier: Apache-2.0
"""The lines of the uncertainty budget of a map, and how each was found."""

import contextlib
import math
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from selfcal_ros.files import read

READING_NOISE = "reading noise"
"""The component that the noise of readings is."""


@dataclass(frozen=True)
class OfNoise:
    """Noise by ``residuals``, ``repeats``, what was ``declared``, or the last and the first.

    `contradicted` says whether these differ by more than chance.
    """

    by: str
    contradicted: bool


@dataclass(frozen=True)
class OfTerm:
    """A size `given`, the one the readings `allowed` if larger, and the part they leave of it."""

    given: float
    allowed: float | None
    remaining: float


@dataclass(frozen=True)
class OfAssumption:
    """A size `given` of a term that no reading determines."""

    given: float


@dataclass(frozen=True)
class OfCause:
    """The effect of a cause, by name, that the readings show."""

    cause: str


@dataclass(frozen=True)
class OfRuns:
    """The scatter or the uncertainties of a number of combined runs."""

    runs: int


@dataclass(frozen=True)
class OfReference:
    """A reference length, by its kind."""

    kind: str


@dataclass(frozen=True)
class OfPlate:
    """A known plate, by the file of its calibration."""

    plate: str


Details = OfNoise | OfTerm | OfAssumption | OfCause | OfRuns | OfReference | OfPlate
KINDS: tuple[type[Details], ...] = (
    OfNoise,
    OfTerm,
    OfAssumption,
    OfCause,
    OfRuns,
    OfReference,
    OfPlate,
)


@dataclass(frozen=True, kw_only=True)
class BudgetLine:
    """A line of the uncertainty budget of a map (GUM), SI units.

    Attributes
    ----------
    quantity : str
        ``xy``, one coordinate of the XY map, m; or ``theta``, the angular map, rad.
    component : str
        Source of the uncertainty.
    kind : str
        ``A`` (statistics of readings) or ``B`` (other knowledge), GUM 4.2 and 4.3.
    value, u, unit : float, float, str
        Estimate of the input quantity and its standard uncertainty; of a term its largest
        coefficient. NaN where it is not known.
    effect_rms, effect_max : float
        Standard uncertainty of the map from it, over the field and at its worst node or line.
    dof : float
        Degrees of freedom; infinite if known.
    source : str
        What gives `u`: ``readings``, or what was ``declared`` or is assumed by ``default``.
    details : one of KINDS, or dict
        How it was found; of a file that this version does not know, its data by name.
    text : str
        The same in words; empty before it is worded.
    """

    quantity: str
    component: str
    kind: str
    value: float = 0.0
    u: float = 0.0
    unit: str
    effect_rms: float = 0.0
    effect_max: float = 0.0
    dof: float = math.inf
    source: str
    details: Details | dict[str, Any] = field(default_factory=dict)
    text: str = ""


def line_to_dict(line: BudgetLine) -> dict[str, Any]:
    """Return the JSON form of a line of the budget."""
    return {
        "type" if name == "kind" else name: value
        for name, value in asdict(line).items()
    }


def budget_from_list(rows: Any) -> tuple[BudgetLine, ...]:
    """Return the lines of a budget."""
    return tuple(_line(read(dict, row)) for row in read(list, rows))


def _line(row: dict[str, Any]) -> BudgetLine:
    dof = math.inf if row["dof"] is None else row["dof"]
    details = _details(read(dict, row.get("details", {})))
    without = {name: value for name, value in row.items() if name != "details"}
    line = read(BudgetLine, without | {"dof": dof, "kind": row["type"]})
    return replace(line, details=details)


def _details(data: dict[str, Any]) -> Details | dict[str, Any]:
    for kind in KINDS:
        if {item.name for item in fields(kind)} == data.keys():
            with contextlib.suppress(ValueError):  # written by another version
                return read(kind, data)
    return data
