# SPDX-License-Identifier: Apache-2.0
"""The length that sets the scale of a map: what was certified, and at which temperature."""

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from selfcal_ros.errors import InputError, check_celsius
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.plain_numbers import number_of, whole_number_of

MAX_EXPANSION_PER_K = 1e-3
"""Coefficient of linear expansion above that of any solid, 1/K."""
LEAST_EXPANSION_PER_K = -2e-6
"""Coefficient below those of what plates and scales are made of, 1/K: carbon fibre has -1e-6,
glass ceramics -0.1e-6. A smaller one is a lost sign."""


class ReferenceKind(StrEnum):
    """Object on which the reference length was measured."""

    ARTIFACT = "artifact"
    STAGE_X = "stage_x"
    STAGE_Y = "stage_y"
    MARKS = "marks"

    @property
    def of_plate(self) -> bool:
        """Whether the plate is what was measured, not an axis of the stage."""
        return self in (ReferenceKind.ARTIFACT, ReferenceKind.MARKS)


@dataclass(frozen=True)
class ReferenceLength:
    """A length that sets the scale, which no view determines.

    Attributes
    ----------
    kind : ReferenceKind
        ``artifact``: a certified plate; ``marks``: the distance of two of its marks; ``stage_x``,
        ``stage_y``: a laser-measured axis.
    relative_error : float
        Plate: (true - nominal) / nominal length, the least-squares scale of A over the plate.
        Marks: (true - nominal) / nominal distance.
        Stage axis: (indicated - true) / nominal length, the least-squares slope of Gx on x
        (of Gy on y) over the field.
    u_relative : float
        Its standard uncertainty (k=1).
    certificate : str
        Certificate: number and issuer, as text.
    certified : dict, optional
        If the numbers above were moved to the temperature of the measurement (`at_temperature`):
        those of the certificate, and what moved them.
    marks : pair of (int, int), optional
        (m, n) of the two marks.

    Raises
    ------
    InputError
        If a number is not finite, not small, or the uncertainty is negative; if the marks are
        not two.
    """

    kind: ReferenceKind
    relative_error: float
    u_relative: float = 0.0
    certificate: str = ""
    certified: dict[str, float] | None = None
    marks: tuple[tuple[int, int], ...] | None = None

    @classmethod
    def between(cls, text: str, artifact: Artifact, certificate: str = "") -> "ReferenceLength":
        """Return the distance of two marks of a plate as a reference.

        Parameters
        ----------
        text : str
            M,N:M,N:LENGTH:U: the marks, their distance and its standard uncertainty, m; of a list
            of marks ID:ID:LENGTH:U.
        artifact : Artifact
            The plate.
        certificate : str
            Number and issuer.

        Raises
        ------
        InputError
            If the text is something else, or the marks are not two of the plate.
        """
        where, form = "reference length", "ID:ID" if artifact.marks else "M,N:M,N"
        example = f"write e.g. {'17:42' if artifact.marks else '-5,0:5,0'}:0.1000002:5e-9 (m)"
        try:
            first, second, *numbers = text.split(":")
            more = ",0" * (artifact.marks is not None)
            marks = tuple((whole_number_of(m), whole_number_of(n)) for m, n in (
                (name + more * ("," not in name)).split(",") for name in (first, second)))
            length, u = map(number_of, numbers)
        except ValueError as error:
            raise InputError(where, f"'{text}' is not {form}:LENGTH:U", example) from error
        for mark in marks:
            if not artifact.has(*map(np.array, mark)):
                known = "write the ids of marks in its list" if artifact.marks else (
                    "its marks go from ({}, {}) to ({}, {})".format(
                        *(end for ends in zip(*artifact.limits, strict=True) for end in ends)))
                raise InputError(where, f"the plate has no mark {mark}", known)
        nominal = artifact.grid_pitch_m * math.dist(*(
            tuple(map(float, artifact.places(*map(np.array, mark)))) for mark in marks))
        if nominal == 0:
            raise InputError(where, f"'{text}' names one mark twice", "name two marks")
        return cls(ReferenceKind.MARKS, (length - nominal) / nominal, u / nominal, certificate,
                   marks=marks)

    def __post_init__(self) -> None:
        """Refuse values that cannot be relative errors, and marks that are not two."""
        if self.marks is not None:  # lists in a file
            object.__setattr__(self, "marks", tuple(tuple(mark) for mark in self.marks))
        if (self.kind == ReferenceKind.MARKS) != (len(set(self.marks or ())) == 2):
            raise InputError("reference length", f"kind '{self.kind}' with the marks {self.marks}",
                             "the kind 'marks' needs two different marks, other kinds have none")
        object.__setattr__(self, "kind", ReferenceKind(self.kind))
        if not abs(self.relative_error) < 0.1:
            raise InputError("reference length", f"{self.relative_error} is not a relative error",
                             "give (true - nominal) / nominal, below 0.1")
        if not 0 <= self.u_relative < 0.1:
            raise InputError("reference length", f"{self.u_relative} is not a standard "
                             "uncertainty of a relative error", "give a number from 0 to 0.1")

    def at_temperature(self, text: str) -> "ReferenceLength":
        """Return the length at the temperature of the measurement (method eq. 3.10).

        Parameters
        ----------
        text : str
            T:U_T:ALPHA:U_ALPHA[:T0]: temperature in the measurement and standard uncertainty, degC
            and K; coefficient of linear expansion of what was certified (plate, or scale of
            the axis) and standard uncertainty, 1/K; temperature of the certificate, degC (20).

        Raises
        ------
        InputError
            If the text is something else, or the uncertainties are negative.
        """
        names = ("temperature_c", "u_temperature_k", "expansion_per_k", "u_expansion_per_k",
                 "certified_at_c")
        try:
            numbers = [*map(number_of, text.split(":"))]
        except ValueError:
            numbers = []
        known = dict(zip(names, [*numbers, 20.0], strict=False))
        if len(numbers) not in (4, 5) or not all(map(math.isfinite, numbers)) or min(
                known["u_temperature_k"], known["u_expansion_per_k"]) < 0 or not (
                LEAST_EXPANSION_PER_K <= known["expansion_per_k"] <= MAX_EXPANSION_PER_K):
            raise InputError("reference length", f"'{text}' is not T:U_T:ALPHA:U_ALPHA[:T0]",
                             "write e.g. 20.4:0.05:0.5e-6:0.05e-6 (degC, K, 1/K, 1/K)")
        for name in ("temperature_c", "certified_at_c"):
            check_celsius(known[name], "reference length", f" in '{text}'")
        warmer = known["temperature_c"] - known["certified_at_c"]
        sign = 1 if self.kind.of_plate else -1  # a longer scale indicates less
        return replace(
            self, relative_error=self.relative_error + sign * known["expansion_per_k"] * warmer,
            u_relative=math.hypot(self.u_relative, known["expansion_per_k"]
                                  * known["u_temperature_k"], warmer * known["u_expansion_per_k"]),
            certified={"relative_error": self.relative_error, "u_relative": self.u_relative,
                       **known})
