# SPDX-License-Identifier: Apache-2.0
"""A cause in words: what the readings show, with its uncertainty, and what to do about it."""

from functools import singledispatch

from selfcal_ros.estimation.findings import (
    ApproachCause,
    DriftCause,
    MicroscopeCause,
    NoiseCause,
    OffSitesCause,
    PlateScaleCause,
    PlateShapeCause,
    ReadingCause,
    RotationCause,
    SizeCause,
    SlipCause,
)
from selfcal_ros.model.terms import TermName
from selfcal_ros.model.verdict import Cause, Finding
from selfcal_ros.reporting.words.units import ARCSEC, MRAD, PERCENT, RATIO, UM, plus_minus
from selfcal_ros.units import MM_PER_M, UM_PER_M, URAD_PER_RAD

_OF_SIZES = {TermName.MICROSCOPE: MRAD, TermName.PLATE_SCALE: RATIO}
"""Unit in which a person reads the coefficients of a term; µm for the others."""


def cause_text(cause: Cause) -> str:
    """Return what a cause is, a colon, and what to do about it."""
    return cause.text if cause.what is None else _text(cause.what, cause)


def what_it_is(cause: Cause) -> str:
    """Return what a cause is, without what to do about it."""
    return cause_text(cause).partition(": ")[0]


@singledispatch
def _text(what: Finding, cause: Cause) -> str:
    raise TypeError(f"no words for {type(what).__name__} of {cause.name}")


@_text.register
def _(what: MicroscopeCause, cause: Cause) -> str:
    value, u = cause.size, cause.u
    if what.part == "scale" and abs(value) > 1:
        return (f"offsets of another sign (scale {plus_minus(value, u, PERCENT)}): look whether "
                "the sense is the other one (--sense, measurement_sense), or the axes of the "
                "microscope point the other way")
    said = {"turn": f"microscope turned by {plus_minus(value, u, MRAD)}",
            "scale": f"scale of the microscope off by {plus_minus(value, u, PERCENT)}",
            "scales": f"scales of the microscope along x and y differ by "
                      f"{plus_minus(2 * value, 2 * u, PERCENT)}",
            "shear": f"axes of the microscope out of square by "
                     f"{plus_minus(2 * value, 2 * u, MRAD)}"}[what.part]
    return f"{said}: solve with --model microscope, or align it"


@_text.register
def _(what: DriftCause, cause: Cause) -> str:
    return (f"drift of {plus_minus(cause.size, cause.u, UM)} along {what.axis} while view "
            f"'{what.view}' was measured: solve with --model drift, or visit the marks there and "
            "back")


@_text.register
def _(what: PlateScaleCause, cause: Cause) -> str:
    return (f"plate larger by {plus_minus(cause.size, cause.u, RATIO)} in view '{what.view}' than "
            f"in view '{what.against}': solve with --model plate_scale, or let it take the "
            "temperature")


@_text.register
def _(what: PlateShapeCause, cause: Cause) -> str:
    more = "" if what.whole else "; part of it cannot be separated from the stage: give its size"
    return (f"plate bent by {plus_minus(cause.size, cause.u, UM)} at the middle of an edge in "
            f"view '{what.view}' against view '{what.against}': solve with --model "
            f"plate_shape:SIZE, or lay it down without strain{more}")


@_text.register
def _(what: ApproachCause, cause: Cause) -> str:
    return (f"indicated {what.axis} differs by ±({plus_minus(cause.size, cause.u, UM)}) with the "
            "direction of approach: solve with --model approach, or arrive from one side")


@_text.register
def _(what: SlipCause, _: Cause) -> str:
    return (f"the plate slipped by ({what.x_m * UM_PER_M:.3g}, {what.y_m * UM_PER_M:.3g}) µm and "
            f"{what.phi_rad * URAD_PER_RAD:.3g} µrad after about {what.part:.0%} of view "
            f"'{what.view}': measure the view again, or solve with --robust")


@_text.register
def _(what: RotationCause, cause: Cause) -> str:
    return (f"lines of view '{what.view}' turned by {plus_minus(cause.size, cause.u, ARCSEC)} "
            "against its marks: look whether the plate moved between them, and at the sign of the "
            "lines' offsets")


@_text.register
def _(what: ReadingCause, cause: Cause) -> str:
    grid = len(what.mark) > 1
    name = f"mark {what.mark}" if grid else f"line {what.mark[0]}"
    size = plus_minus(cause.size, cause.u, UM if grid else ARCSEC)
    return (f"a reading of {name} in view '{what.view}' that is off by {size}: solve with "
            "--robust, or measure it again")


@_text.register
def _(what: SizeCause, cause: Cause) -> str:
    unit = _OF_SIZES.get(TermName(cause.name), UM)
    ratio = cause.size / what.given
    times = f"{ratio:.3g}" if ratio < 1e3 else f"{ratio:.0f}"
    return (f"{cause.name} up to {cause.size * unit.per_si:.3g} {unit.name}, {times} times the "
            f"size given: give a larger size, as in --model {cause.name}:{what.shown:.1e}, or "
            "leave it free")


@_text.register
def _(what: OffSitesCause, cause: Cause) -> str:
    return (f"the stage standing {what.away_m * MM_PER_M:.3g} mm off the sites, where its error is "
            f"another one by {plus_minus(cause.size, cause.u, UM)}: lay the plate nearer to its "
            "place, or let the stage go to the sites")


@_text.register
def _(what: NoiseCause, cause: Cause) -> str:
    return (f"view '{what.view}' is {cause.size:.2f} times as noisy as the others: measure it "
            "again, or look for what shook it")
