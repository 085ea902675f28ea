# SPDX-License-Identifier: Apache-2.0
"""Units in which sizes and estimates of terms are said."""

from typing import NamedTuple

from selfcal_ros.blocks import blocks
from selfcal_ros.estimation.verdict.uncertainty import TERM
from selfcal_ros.model.budget import BudgetLine
from selfcal_ros.units import (
    ARCSEC_PER_RAD,
    MRAD_PER_RAD,
    PPM_PER_ONE,
    UM_PER_M,
    URAD_PER_RAD,
)


class DisplayUnit(NamedTuple):
    """Display unit of a quantity: factor from SI, and name."""

    per_si: float
    name: str


UM, RATIO = DisplayUnit(UM_PER_M, "µm"), DisplayUnit(PPM_PER_ONE, "µm/m")
MRAD = DisplayUnit(MRAD_PER_RAD, "mrad")
PERCENT = DisplayUnit(100.0, "%")
ARCSEC, URAD = DisplayUnit(ARCSEC_PER_RAD, "arcsec"), DisplayUnit(URAD_PER_RAD, "µrad")


def unit_of(name: str, si: str) -> DisplayUnit:
    """Return the display unit of the estimates of a term, or of the size of a cause.

    Small angles of axes and lines are in µrad, rotations of plate and microscope in mrad.
    """
    block = blocks().get(name)
    if si == "rad" and block is not None and (block.of_lines or block.of_images):
        return URAD
    return {"m": UM, "rad": MRAD, "m/m": RATIO}.get(si, DisplayUnit(1.0, si))


def size_text(line: BudgetLine, size_si: float) -> str:
    """Return a size of the term of a line of the budget, with its unit."""
    return size_of(line.component.removeprefix(TERM), line.unit, size_si)


def size_of(name: str, si: str, size_si: float) -> str:
    """Return a size of a term, whose coefficients have the unit `si`, with its unit."""
    unit = PERCENT if name in ("microscope", "line_scale") else unit_of(name, si)
    return f"{size_si * unit.per_si:.3g} {unit.name}".rstrip()
