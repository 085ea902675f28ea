# SPDX-License-Identifier: Apache-2.0
"""A cause in words: what the readings show, with its uncertainty, and what to do about it."""

from functools import singledispatch

from selfcal_ros.estimation.findings import (
    ApproachCause,
    DriftCause,
    LineEccentricityCause,
    MicroscopeCause,
    NoiseCause,
    OffSitesCause,
    PlateScaleCause,
    PlateShapeCause,
    PlateStrainCause,
    ReadingCause,
    RotationCause,
    SizeCause,
    SlipCause,
)
from selfcal_ros.model.terms import UNITS, TermName
from selfcal_ros.model.verdict import Cause, Finding, Remedy
from selfcal_ros.reporting.words.units import (
    ARCSEC,
    MRAD,
    PERCENT,
    RATIO,
    UM,
    URAD,
    plus_minus,
)
from selfcal_ros.units import MM_PER_M, UM_PER_M, URAD_PER_RAD

_OF_SIZES = {TermName.MICROSCOPE: MRAD, TermName.LINE_ECCENTRICITY: URAD}
"""Unit in which a person reads the coefficients of a term; by the SI unit for the others."""

_ACTIONS = {
    TermName.MICROSCOPE: "align the microscope, or let the stage stop beside the marks on purpose "
                         "(check_stops)",
    TermName.DRIFT: "visit the marks there and back",
    TermName.PLATE_SCALE: "let the plate reach thermal equilibrium",
    TermName.PLATE_SHAPE: "support the plate without strain",
    TermName.PLATE_STRAIN: "support the plate without strain",
    TermName.LINE_ECCENTRICITY: "centre the circle of lines on the axis of rotation in each view",
    TermName.APPROACH: "arrive from one side",
    "slip": "measure the view again, or solve with --robust",
    "rotation": "check whether the plate moved between marks and lines, and the sign of the "
                "lines' offsets",
    "reading": "solve with --robust, or measure it again",
    "off_sites": "lay the plate nearer to its place, or let the stage go to the sites",
    "noise": "measure the view again, and look for a source of vibration"}
"""What to do about a cause besides what was tried on the readings."""


def remedies(cause: Cause) -> tuple[Remedy, ...]:
    """Return the remedies of a cause: those that were tried, and the action that removes it."""
    if any(remedy.kind == "action" for remedy in cause.remedies):
        return cause.remedies
    return (*cause.remedies, Remedy("action", _ACTIONS[cause.name]))


def cause_text(cause: Cause) -> str:
    """Return what a cause is, a colon, and what to do about it."""
    return cause.text if cause.what is None else f"{what_it_is(cause)}: {advice(cause)}"


def advice(cause: Cause) -> str:
    """Return what to do about a cause, in words; empty where nothing is known."""
    said = [f"solve with --model {remedy.value}" if remedy.kind == "model" else remedy.value
            for remedy in (cause.remedies if cause.what is None else remedies(cause))
            if remedy.kind != "view"]
    return ", or ".join(said)


def what_it_is(cause: Cause) -> str:
    """Return what a cause is, without what to do about it."""
    if cause.what is not None:
        return _text(cause.what, cause)
    return cause.text.removesuffix(f": {advice(cause)}")


@singledispatch
def _text(what: Finding, cause: Cause) -> str:
    raise TypeError(f"no words for {type(what).__name__} of {cause.name}")


@_text.register
def _(what: MicroscopeCause, cause: Cause) -> str:
    value, u = cause.size, cause.u
    return {"turn": f"microscope turned by {plus_minus(value, u, MRAD)}",
            "scale": f"scale of the microscope off by {plus_minus(value, u, PERCENT)}",
            "scales": f"scales of the microscope along x and y differ by "
                      f"{plus_minus(2 * value, 2 * u, PERCENT)}",
            "shear": f"axes of the microscope out of square by "
                     f"{plus_minus(2 * value, 2 * u, MRAD)}"}[what.part]


@_text.register
def _(what: DriftCause, cause: Cause) -> str:
    return (f"drift of {plus_minus(cause.size, cause.u, UM)} along {what.axis} while view "
            f"'{what.view}' was measured")


@_text.register
def _(what: PlateScaleCause, cause: Cause) -> str:
    word = "larger" if cause.size >= 0 else "smaller"
    return (f"plate {word} by {plus_minus(abs(cause.size), cause.u, RATIO)} in view '{what.view}' "
            f"than in view '{what.against}'")


@_text.register
def _(what: PlateStrainCause, cause: Cause) -> str:
    kind = {"scale": "in size", "stretch": "along x against y", "shear": "in shear"}[what.part]
    return (f"plate strained {kind} by {plus_minus(cause.size, cause.u, RATIO)} in view "
            f"'{what.view}' against view '{what.against}'")


@_text.register
def _(what: LineEccentricityCause, cause: Cause) -> str:
    return (f"circle of lines off the axis by {plus_minus(cause.size, cause.u, URAD)} of its "
            f"radius in view '{what.view}'")


@_text.register
def _(what: PlateShapeCause, cause: Cause) -> str:
    more = "" if what.whole else ", part of which cannot be separated from the stage"
    return (f"plate bent by {plus_minus(abs(cause.size), cause.u, UM)} at the middle of an edge in "
            f"view '{what.view}' against view '{what.against}'{more}")


@_text.register
def _(what: ApproachCause, cause: Cause) -> str:
    return (f"indicated {what.axis} differs by ±({plus_minus(cause.size, cause.u, UM)}) with the "
            "direction of approach")


@_text.register
def _(what: SlipCause, _: Cause) -> str:
    return (f"the plate slipped by ({what.x_m * UM_PER_M:.3g}, {what.y_m * UM_PER_M:.3g}) µm and "
            f"{what.phi_rad * URAD_PER_RAD:.3g} µrad after about {what.part:.0%} of view "
            f"'{what.view}'")


@_text.register
def _(what: RotationCause, cause: Cause) -> str:
    return (f"lines of view '{what.view}' turned by {plus_minus(cause.size, cause.u, ARCSEC)} "
            "against its marks")


@_text.register
def _(what: ReadingCause, cause: Cause) -> str:
    grid = len(what.mark) > 1
    name = f"mark {what.mark}" if grid else f"line {what.mark[0]}"
    size = plus_minus(cause.size, cause.u, UM if grid else ARCSEC)
    return f"a reading of {name} in view '{what.view}' that is off by {size}"


@_text.register
def _(what: SizeCause, cause: Cause) -> str:
    name = TermName(cause.name)
    unit = _OF_SIZES.get(name, RATIO if UNITS[name] == "m/m" else UM)
    ratio = cause.size / what.given
    times = f"{ratio:.3g}" if ratio < 1e3 else f"{ratio:.0f}"
    return (f"{cause.name} up to {cause.size * unit.per_si:.3g} {unit.name}, {times} times the "
            "size assumed")


@_text.register
def _(what: OffSitesCause, cause: Cause) -> str:
    return (f"the stage standing {what.away_m * MM_PER_M:.3g} mm off the sites, where its error is "
            f"another one by {plus_minus(cause.size, cause.u, UM)}")


@_text.register
def _(what: NoiseCause, cause: Cause) -> str:
    return f"view '{what.view}' is {cause.size:.2f} times as noisy as the others"
