# SPDX-License-Identifier: Apache-2.0
"""Verdict on a result with its reasons, and the estimates of terms."""

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from selfcal_ros.files import read
from selfcal_ros.model.findings import (
    Cause,
    Finding,
    cause_from_dict,
    finding_from_dict,
    finding_to_dict,
)


class Grade(StrEnum):
    """Grade of a result.

    GOOD: within its U. ENLARGED: within a U that was enlarged for effects in the readings.
    NOT_QUALIFIED: the readings contradict the model by more than any U given here covers.
    """

    GOOD = "good"
    ENLARGED = "enlarged"
    NOT_QUALIFIED = "not_qualified"


@dataclass(frozen=True)
class Enlargement:
    """Cause that enlarged the uncertainty: name, rms and largest contribution to u, unit.

    `unit` is ``m`` for the XY map, ``rad`` for causes of the angular map only.
    """

    name: str
    u_rms: float
    u_max: float
    unit: str = "m"


@dataclass(frozen=True)
class Verdict:
    """Whether the readings agree with the model that the uncertainties assume.

    Attributes
    ----------
    grade : Grade
        Good, good within an enlarged uncertainty, or not qualified.
    failed : tuple of Finding
        The tests that failed.
    causes : tuple of Cause
        Explanations, the most likely first.
    enlarged_by : tuple of Enlargement
        Causes that enlarged the uncertainty, the largest first.
    sentence, reasons : str, tuple of str
        The verdict in one sentence, and one for each failed test and cause; empty before
        wording.
    """

    grade: Grade
    failed: tuple[Finding, ...] = ()
    causes: tuple[Cause, ...] = ()
    enlarged_by: tuple[Enlargement, ...] = ()
    sentence: str = ""
    reasons: tuple[str, ...] = ()

    @property
    def qualified(self) -> bool:
        """Whether the stage is identified and U covers the effects in the readings."""
        return self.grade is not Grade.NOT_QUALIFIED


@dataclass(frozen=True)
class TermEstimate:
    """One coefficient of a term: SI unit, standard uncertainty (k=1).

    `view` is empty if all views share the coefficient; `value` and `u` are NaN if
    undetermined.
    """

    view: str
    component: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class TermResult:
    """A term of the model with its estimates.

    `size` is the given one, None if the term was free; `size_used` the larger one of the
    solution if the readings contradict it or make it doubtful, else None. `source` is the origin
    of the term: ``declared``, ``default``, or ``readings``, which show it.
    """

    name: str
    size: float | None
    estimates: tuple[TermEstimate, ...] = ()
    size_used: float | None = None
    source: str = "declared"

    @property
    def solved_with(self) -> float:
        """The size of the solution; infinite if the term was free."""
        return self.size_used or self.size or math.inf


@dataclass(frozen=True)
class ModelResult:
    """The model behind a map: ``linear`` or ``rigid`` misalignments, and the terms."""

    misalignment: str = "linear"
    terms: tuple[TermResult, ...] = ()


@dataclass(frozen=True)
class Provenance:
    """Origin and time of a result.

    Attributes
    ----------
    created : str
        Time of computation, ISO 8601; empty if unknown.
    duration_s : float
        From the first to the last command or reading; NaN if unknown.
    version : str
        Version of this package.
    extra : dict
        Further facts for reports: stage, operator, visit_order.
    first_exposure, last_exposure : str
        Time of the first and the last reading, ISO 8601; empty if unknown.
    """

    created: str = ""
    duration_s: float = float("nan")
    version: str = ""
    extra: dict[str, Any] = field(default_factory=dict)
    first_exposure: str = ""
    last_exposure: str = ""

    @property
    def facts(self) -> dict[str, Any]:
        """What reports list of it by name: `extra`, and the times of the exposures if known."""
        times = {
            "first_exposure": self.first_exposure,
            "last_exposure": self.last_exposure,
        }
        return {**self.extra, **{name: time for name, time in times.items() if time}}


def verdict_to_dict(verdict: Verdict) -> dict[str, Any]:
    """Return the JSON form of a verdict; ValueError if it has no sentences."""
    return {
        "qualified": verdict.qualified,
        "grade": str(verdict.grade),
        "sentence": verdict.sentence,
        "reasons": list(verdict.reasons),
        "failed": [finding_to_dict(finding) for finding in verdict.failed],
        "causes": [finding_to_dict(cause) for cause in verdict.causes],
        "enlarged_by": [vars(item) for item in verdict.enlarged_by],
    }


def verdict_from_dict(data: dict | None, *, identifiable: bool) -> Verdict:
    """Return the verdict of a result; without one, whether it is identified decides."""
    if data is None:
        grade = Grade.GOOD if identifiable else Grade.NOT_QUALIFIED
        return Verdict(
            grade, sentence="Not judged: written by a version without verdicts"
        )
    qualified = read(bool, data["qualified"])
    grade = Grade(data.get("grade", "good" if qualified else "not_qualified"))
    if qualified is (grade is Grade.NOT_QUALIFIED):
        raise ValueError(f"the grade '{grade}' contradicts qualified {qualified}")
    return Verdict(
        grade=grade,
        failed=tuple(map(finding_from_dict, read(list, data.get("failed", [])))),
        causes=tuple(map(cause_from_dict, read(list, data["causes"]))),
        enlarged_by=read(tuple[Enlargement, ...], data.get("enlarged_by", [])),
        sentence=read(str, data["sentence"]),
        reasons=read(tuple[str, ...], data["reasons"]),
    )


def provenance_from_dict(data: dict | None) -> Provenance:
    """Return the provenance of a result, as far as known."""
    own_fields = ("created", "duration_s", "version", "first_exposure", "last_exposure")
    return (
        Provenance()
        if data is None
        else read(
            Provenance,
            data
            | {
                "extra": {
                    key: value for key, value in data.items() if key not in own_fields
                }
            },
        )
    )
