# SPDX-License-Identifier: Apache-2.0
"""Reference lengths of runs whose mean keeps its scale: what they share, and what may differ."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.model.reference import CERTIFIED_WITH, Certified, ReferenceLength


@dataclass(frozen=True, eq=False)
class Lengths:
    """Uncertainty of the lengths that set the scales of runs, m/m.

    Attributes
    ----------
    place : float array (d,)
        What a scale of 1 m/m adds to the values of a map, m.
    certificates : float array (runs, certificates)
        u of the length of each run by its certificate, 0 by the others; no columns if all runs
        have one certificate.
    one : float array (runs,)
        The same of a certificate that all runs have.
    thermal : float array (runs,)
        u by temperature and coefficient of expansion. Thermometer and material may be the same
        in all runs, so that it does not average out, or differ, so that the scales do.
    """

    place: np.ndarray
    certificates: np.ndarray
    one: np.ndarray
    thermal: np.ndarray

    @classmethod
    def none(cls, runs: int, values: int) -> "Lengths":
        """Return those of runs whose scales are not kept."""
        return cls(
            np.zeros(values), np.zeros((runs, 0)), np.zeros(runs), np.zeros(runs)
        )

    @cached_property
    def differing(self) -> np.ndarray:
        """Covariance of what the lengths of runs may differ by, (runs, runs), 1 = (m/m)^2."""
        return self.certificates @ self.certificates.T + np.diag(self.thermal**2)

    @cached_property
    def power(self) -> np.ndarray:
        """Sum of the variances of a map by what its length may differ by, (runs,), m^2."""
        return self.differing.diagonal() * (self.place @ self.place)

    def within(self, weights: np.ndarray) -> float:
        """Return the variance of a mean by the certificates of its runs, 1 = (m/m)^2."""
        return float(((weights @ self.certificates) ** 2).sum())

    def common(self, weights: np.ndarray) -> float:
        """Return the variance of a mean by what all runs may share, 1 = (m/m)^2."""
        return float((weights @ self.one) ** 2 + (weights @ self.thermal) ** 2)


def lengths_of(
    references: Sequence[ReferenceLength | None], place: np.ndarray
) -> Lengths:
    """Return the lengths of runs; None for a run whose u contains it.

    One certificate is one length, however it is spelled; so are equal numbers. Without a name it
    may be that of any other run.

    Parameters
    ----------
    references : sequence of ReferenceLength or None
        Of each run.
    place : float array (d,)
        As `Lengths.place`.
    """
    u, thermal = np.zeros((2, len(references)))
    keys: dict[object, int] = {}
    group = np.full(len(references), -1)
    unnamed = False
    for run, length in enumerate(references):
        if length is None:
            continue
        stated = length.certified or length
        u[run] = stated.u_relative
        thermal[run] = np.sqrt(max(length.u_relative**2 - u[run] ** 2, 0.0))
        unnamed |= not length.certificate_key
        same = (length.certificate_key, (stated.relative_error, stated.u_relative))
        group[run] = next((keys[key] for key in same if key in keys), run)
        keys |= dict.fromkeys(same, int(group[run]))
    groups = np.unique(group[group >= 0])
    if unnamed or len(groups) < 2:
        return Lengths(place, np.zeros((len(u), 0)), u, thermal)
    of_group = group[:, None] == groups
    return Lengths(place, of_group * u[:, None], np.zeros(len(u)), thermal)


def length_in_both(first: ReferenceLength, second: ReferenceLength) -> float:
    """Return u of the length of a plate by the one certificate that both name, m/m; 0 if none.

    A difference of two maps does not contain it. What their temperatures may be off by stays.
    """
    if not (
        first.kind.of_plate
        and first.certificate_key
        and (first.kind, first.marks, first.certificate_key)
        == (second.kind, second.marks, second.certificate_key)
    ):
        return 0.0
    require_one_text(("the first map", "the second map"), (first, second))
    stated, stated_again = (length.certified or length for length in (first, second))
    if stated.relative_error != stated_again.relative_error:
        return 0.0
    return min(stated.u_relative, stated_again.u_relative)


def require_one_text(
    names: Sequence[str], references: Sequence[ReferenceLength | None]
) -> None:
    """Refuse runs that state one certificate with different numbers."""
    first_of: dict[tuple, tuple[str, Certified]] = {}
    for name, length in zip(names, references, strict=True):
        if length is None or length.certified is None or not length.certificate:
            continue
        first_name, before = first_of.setdefault(
            (length.certificate_key, length.kind, length.marks),
            (name, length.certified),
        )
        for number in ("relative_error", "u_relative", *CERTIFIED_WITH):
            value, value_before = (
                getattr(certified, number) for certified in (length.certified, before)
            )
            if not np.isclose(value, value_before, rtol=1e-9, atol=0.0):
                raise InputError(
                    name,
                    f"{number} of the certificate '{length.certificate}' is {value:g}, and "
                    f"{value_before:g} in {first_name}",
                    "solve again with what it states; if it has several lengths, name them apart",
                )
