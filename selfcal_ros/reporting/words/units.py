# SPDX-License-Identifier: Apache-2.0
"""Quantities as sentences name them: lengths in µm, ratios in µm/m, turns in mrad or arcsec."""

import math
from typing import NamedTuple

from selfcal_ros.units import ARCSEC_PER_RAD, MRAD_PER_RAD, PPM_PER_ONE, UM_PER_M, URAD_PER_RAD


class Unit(NamedTuple):
    """How a person reads a quantity: how many of the unit are one in SI, and its name."""

    per_si: float
    name: str


UM, RATIO = Unit(UM_PER_M, "µm"), Unit(PPM_PER_ONE, "µm/m")
MRAD, PERCENT = Unit(MRAD_PER_RAD, "mrad"), Unit(100.0, "%")
ARCSEC, URAD = Unit(ARCSEC_PER_RAD, "arcsec"), Unit(URAD_PER_RAD, "µrad")


def plus_minus(value: float, u: float, unit: Unit) -> str:
    """Return ``value ± u unit`` with two figures of the uncertainty."""
    value, u = value * unit.per_si, u * unit.per_si
    digits = 3
    if math.isfinite(u) and u > 0:
        digits = min(max(1 - math.floor(math.log10(u)), 0), 9)
    return f"{value:.{digits}f} ± {u:.{digits}f} {unit.name}"
