# SPDX-License-Identifier: Apache-2.0
"""The length that sets the scale of a map: what was certified, and at which temperature."""

import math
import re
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import read
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.plain_numbers import number_of, whole_number_of

MAX_RELATIVE = 0.1
"""Relative error, and its u, above which a length is not the one that is meant."""
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


CERTIFIED_WITH = ("expansion_per_k", "u_expansion_per_k", "certified_at_c")
"""What does not change from one measurement of a certified length to another, beside the length."""


@dataclass(frozen=True)
class Certified:
    """The certificate of a length that was moved to the temperature of the measurement.

    Attributes
    ----------
    relative_error, u_relative : float
        As of `ReferenceLength`, at the temperature of the certificate.
    temperature_c, u_temperature_k : float
        Temperature in the measurement and its standard uncertainty, degC and K.
    expansion_per_k, u_expansion_per_k : float
        Coefficient of linear expansion and its standard uncertainty, 1/K.
    certified_at_c : float
        Temperature of the certificate, degC.
    """

    relative_error: float
    u_relative: float
    temperature_c: float
    u_temperature_k: float
    expansion_per_k: float
    u_expansion_per_k: float
    certified_at_c: float


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
    certified : Certified, optional
        If the numbers above were moved to the temperature of the measurement (`at_temperature`):
        those of the certificate, and what moved them.
    marks : pair of (int, int), optional
        (m, n) of the two marks.
    runs : tuple of ReferenceLength
        Of the mean of several runs with different lengths: that of each.

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
    certified: Certified | None = None
    marks: tuple[tuple[int, ...], ...] | None = None
    runs: tuple["ReferenceLength", ...] = ()

    @property
    def name(self) -> str:
        """What was certified: the kind of the length, or its marks."""
        if not self.marks:
            return str(self.kind)
        return "distance of the marks {} and {}".format(*self.marks)

    @property
    def certificate_key(self) -> str:
        """Words and numbers of the certificate: the same however it is spelled."""
        return " ".join(re.findall(r"[^\W\d_]+|\d+", self.certificate.casefold()))

    @property
    def each(self) -> tuple["ReferenceLength", ...]:
        """The lengths that were certified: one, or those of the runs of a mean."""
        return self.runs or (self,)

    @classmethod
    def between(
        cls, text: str, artifact: Artifact, certificate: str = ""
    ) -> "ReferenceLength":
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
        where = "reference length"
        form = "ID:ID" if artifact.marks else "M,N:M,N"
        example = (
            f"write e.g. {'17:42' if artifact.marks else '-5,0:5,0'}:0.1000002:5e-9 (m)"
        )
        try:
            first, second, *numbers = text.split(":")
            more = ",0" * (artifact.marks is not None)
            marks = tuple(
                (whole_number_of(m), whole_number_of(n))
                for m, n in (
                    (name + more * ("," not in name)).split(",")
                    for name in (first, second)
                )
            )
            length, u = map(number_of, numbers)
        except ValueError as error:
            raise InputError(
                where, f"'{text}' is not {form}:LENGTH:U", example
            ) from error
        for mark in marks:
            if not artifact.has(*map(np.array, mark)):
                remedy = (
                    "write the ids of marks in its list"
                    if artifact.marks
                    else (
                        "its marks go from ({}, {}) to ({}, {})".format(
                            *(
                                end
                                for ends in zip(*artifact.limits, strict=True)
                                for end in ends
                            )
                        )
                    )
                )
                raise InputError(where, f"the plate has no mark {mark}", remedy)
        nominal = artifact.grid_pitch_m * math.dist(
            *(
                tuple(map(float, artifact.places(*map(np.array, mark))))
                for mark in marks
            )
        )
        if nominal == 0:
            raise InputError(where, f"'{text}' names one mark twice", "name two marks")
        if not abs(length - nominal) < MAX_RELATIVE * nominal:
            raise InputError(
                where,
                f"{length:g} in '{text}' is not the distance of these marks, nominally "
                f"{nominal:g} m",
                "give m",
            )
        return cls(
            ReferenceKind.MARKS,
            (length - nominal) / nominal,
            u / nominal,
            certificate,
            marks=marks,
        )

    def __post_init__(self) -> None:
        """Refuse values that cannot be relative errors, and marks that are not two."""
        two = len(set(self.marks or ())) == 2 and all(
            len(mark) == 2 for mark in self.marks or ()
        )
        if (self.kind == ReferenceKind.MARKS) != two:
            raise InputError(
                "reference length",
                f"kind '{self.kind}' with the marks {self.marks}",
                "the kind 'marks' needs two different marks, other kinds have none",
            )
        object.__setattr__(self, "kind", ReferenceKind(self.kind))
        if not abs(self.relative_error) < MAX_RELATIVE:
            raise InputError(
                "reference length",
                f"{self.relative_error} is not a relative error",
                "give (true - nominal) / nominal, below 0.1",
            )
        if not 0 <= self.u_relative < MAX_RELATIVE:
            raise InputError(
                "reference length",
                f"{self.u_relative} is not a standard uncertainty of a relative error",
                "give a number from 0 to 0.1",
            )

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
        names = (
            "temperature_c",
            "u_temperature_k",
            "expansion_per_k",
            "u_expansion_per_k",
            "certified_at_c",
        )
        try:
            numbers = [*map(number_of, text.split(":"))]
        except ValueError:
            numbers = []
        values = dict(zip(names, [*numbers, 20.0], strict=False))
        if (
            len(numbers) not in (4, 5)
            or not all(map(math.isfinite, numbers))
            or min(values["u_temperature_k"], values["u_expansion_per_k"]) < 0
        ):
            raise InputError(
                "reference length",
                f"'{text}' is not T:U_T:ALPHA:U_ALPHA[:T0]",
                "write e.g. 20.4:0.05:0.5e-6:0.05e-6 (degC, K, 1/K, 1/K)",
            )
        expansion = values["expansion_per_k"]
        if not LEAST_EXPANSION_PER_K <= expansion <= MAX_EXPANSION_PER_K:
            raise InputError(
                "reference length",
                f"{expansion:g} in '{text}' is not a coefficient of expansion from "
                f"{LEAST_EXPANSION_PER_K:g} to {MAX_EXPANSION_PER_K:g} 1/K",
                "give 1/K, as 0.5e-6 of fused silica",
            )
        for name in ("temperature_c", "certified_at_c"):
            check_celsius(values[name], "reference length", f" in '{text}'")
        warmer = values["temperature_c"] - values["certified_at_c"]
        sign = 1 if self.kind.of_plate else -1  # a longer scale indicates less
        return replace(
            self,
            relative_error=self.relative_error
            + sign * values["expansion_per_k"] * warmer,
            u_relative=math.hypot(
                self.u_relative,
                values["expansion_per_k"] * values["u_temperature_k"],
                warmer * values["u_expansion_per_k"],
            ),
            certified=Certified(self.relative_error, self.u_relative, **values),
        )


def reference_to_dict(length: ReferenceLength | None) -> dict[str, Any] | None:
    """Return the JSON form of a reference length; null without one."""
    if length is None:
        return None
    return {
        "kind": str(length.kind),
        "relative_error": length.relative_error,
        "u_relative": length.u_relative,
        "certificate": length.certificate,
        **({"certified": vars(length.certified)} if length.certified else {}),
        **({"marks": [*map(list, length.marks)]} if length.marks else {}),
        **({"runs": [*map(reference_to_dict, length.runs)]} if length.runs else {}),
    }


def reference_from_dict(raw: Any) -> ReferenceLength | None:
    """Return the reference length of a result; ValueError or KeyError if invalid."""
    try:
        return None if raw is None else read(ReferenceLength, raw)
    except InputError as error:
        raise ValueError(str(error)) from error


def check_celsius(value: float, where: str, of: str = "") -> None:
    """Raise InputError for a temperature that no machine has in degC, as one given in kelvin."""
    if not -50.0 <= value <= 100.0:
        raise InputError(
            where,
            f"{value:g}{of} is not a temperature from -50 to 100 degC: is it in K?",
            "give degC",
        )
