# SPDX-License-Identifier: Apache-2.0
"""Whether a result can be relied on, why not, and what was estimated beside the map."""

import math
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Finding:
    """Something that is to be told to a person: each kind has its data as fields, SI units.

    `selfcal_ros.reporting.words` makes a sentence of it.
    """


@dataclass(frozen=True)
class Cause(Finding):
    """Something that the readings show and the model does not hold.

    Attributes
    ----------
    name : str
        A `selfcal_ros.model.terms.TermName`, ``slip`` (of a plate within a view), ``reading`` (a
        mark or line that is off in a view), ``rotation`` (of a view's lines against its marks),
        ``off_sites`` (of the stage) or ``noise`` (of a view).
    text : str
        What, with size, uncertainty and what to do, for a person; empty before it is worded.
    size, u : float
        Its largest component and standard uncertainty, in `unit`.
    unit : str
        ``m``, ``rad`` or ``m/m`` (also for a ratio of noises).
    p : float
        Probability that readings without it show as much.
    what : Finding, optional
        Where and of what kind; None of a cause that has its text.
    """

    name: str
    text: str
    size: float
    u: float
    unit: str
    p: float
    what: Finding | None = None


@dataclass(frozen=True)
class Verdict:
    """Whether the readings agree with the model that the uncertainties assume.

    Attributes
    ----------
    qualified : bool
        The stage is identified and no test contradicts the model.
    sentence : str
        The verdict in one sentence; empty before it is worded.
    reasons : tuple of str
        The tests that failed, in words.
    causes : tuple of Cause
        What explains it, the most likely first.
    findings : tuple of Finding
        The tests that failed and the causes as data, until they are worded.
    """

    qualified: bool
    sentence: str = ""
    reasons: tuple[str, ...] = ()
    causes: tuple[Cause, ...] = ()
    findings: tuple[Finding, ...] = ()


@dataclass(frozen=True)
class TermEstimate:
    """One coefficient of a term: SI unit, standard uncertainty (k=1).

    `view` is empty where all views share the coefficient; `value` and `u` are NaN where the
    readings do not tell it.
    """

    view: str
    component: str
    value: float
    u: float
    unit: str


@dataclass(frozen=True)
class TermResult:
    """A term of the model with what was found.

    `size` is as it was given, None where the term was free; `size_used` the larger one of the
    solution where the readings contradict that, else None.
    """

    name: str
    size: float | None
    estimates: tuple[TermEstimate, ...] = ()
    size_used: float | None = None

    @property
    def solved_with(self) -> float:
        """The size of the solution; infinite where the term was free."""
        return self.size_used or self.size or math.inf


@dataclass(frozen=True)
class ModelResult:
    """The model behind a map: ``linear`` or ``rigid`` misalignments, and the terms."""

    misalignment: str = "linear"
    terms: tuple[TermResult, ...] = ()


@dataclass(frozen=True)
class Provenance:
    """Where and when a result comes from.

    Attributes
    ----------
    created : str
        When it was computed, ISO 8601; empty if not known.
    duration_s : float
        From the first to the last command or reading; NaN if not known.
    version : str
        Of this package.
    extra : dict
        What else is known: recorded, visit_order, source.
    """

    created: str = ""
    duration_s: float = float("nan")
    version: str = ""
    extra: dict[str, Any] = field(default_factory=dict)
