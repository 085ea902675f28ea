# SPDX-License-Identifier: Apache-2.0
"""Sentence and table of what a correction does in the machine."""

import math
from dataclasses import replace

from selfcal_ros.estimation.comparison.verification import (
    TableFault,
    Verification,
    is_believed,
    verify,
)
from selfcal_ros.model.result import CalibrationResult
from selfcal_ros.model.verified import AxisError, Verified
from selfcal_ros.reporting.summary.numbers import aligned, significant
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M

_FAULTS = {
    TableFault.OFF: "the correction does not act: the table is not switched on or not loaded, or "
    "its unit is much too small",
    TableFault.SIGN: "the correction acts with the wrong sign: negate the table",
    TableFault.COMPONENTS: "the corrections of x and y are exchanged: the correction of x acts on "
    "y, and that of y on x",
    TableFault.PLACES: "the places of the table are exchanged: its rows are read as columns",
    TableFault.TRANSPOSED: "x and y are exchanged in the whole table: its places and its "
    "corrections",
    TableFault.MIRRORED_X: "the table acts mirrored along x: its order, or the direction of x",
    TableFault.MIRRORED_Y: "the table acts mirrored along y: its order, or the direction of y",
    TableFault.MIRRORED: "the table acts mirrored along x and y: its order, or both directions",
    TableFault.OTHER: "a correction acts that is not this map: another table is loaded, or its "
    "places are wrong",
    TableFault.OLDER: "a correction acts that is like this map but not this map: an older table is "
    "loaded, or the stage has changed since",
    TableFault.TOO_SMALL: "the map is not larger than its own uncertainty: there is nothing to "
    "verify",
}

_ACTS = {TableFault.OFF: "does not act", TableFault.SIGN: "has the wrong sign"}

UNIT = {
    "x": ("µm", UM_PER_M),
    "y": ("µm", UM_PER_M),
    "theta": ("arcsec", ARCSEC_PER_RAD),
}
"""Unit of an axis in a text, and how many of it are an SI unit."""


def with_verification(
    before: CalibrationResult, after: CalibrationResult, *, names: tuple[str, str]
) -> tuple[CalibrationResult, Verification]:
    """Return the result with the correction on, with its ``verification``, and what that found."""
    verification = verify(before, after, names=names)
    passed = verification.passed and is_believed(after, verification)
    verified = Verified(
        of=names[0],
        sentence=verification_sentence(verification),
        better=verification.better,
        passed=passed,
        fault=str(verification.fault),
        theta_fault=str(verification.theta_fault),
        remains=verification.remains,
        correlation=verification.alike,
        axes=dict(verification.axes),
        remaining=verification.remaining,
    )
    return replace(after, verification=verified), verification


def verification_sentence(verification: Verification) -> str:
    """Return the verdict in one sentence."""
    axes = [verification.axes[name] for name in "xy"]
    was, now, U_was, U_now = (
        significant(
            UM_PER_M * math.sqrt(sum(getattr(axis, name) ** 2 for axis in axes) / 2)
        )
        for name in ("rms_before", "rms_after", "U_before", "U_after")
    )
    head = "Better" if verification.better else "Not better"
    text = (
        f"{head}: the error is {was} µm rms per axis without the correction, {now} µm with it "
        f"(U of a node {U_was} and {U_now} µm)"
    )
    return "; ".join([text, *_why(verification)])


def _why(verification: Verification) -> list[str]:
    """Return the further parts of the sentence."""
    clauses = []
    if verification.fault is TableFault.FACTOR:
        mean = sum(verification.axes[name].factor for name in "xy") / 2
        clauses.append(
            f"{significant(mean)} times the correction acts: look for a wrong unit or "
            "scale of the table"
        )
    elif verification.fault is TableFault.AXES_DIFFER:
        clauses.append(
            "the axes differ: "
            + ", ".join(
                f"{significant(verification.axes[name].factor)} times the correction acts in {name}"
                for name in "xy"
            )
            + ": compare their tables"
        )
    elif verification.fault is not TableFault.NONE:
        clauses.append(_FAULTS[verification.fault])
    elif verification.remains:
        clauses.append(
            "more remains than the uncertainties explain: the stage has changed a little "
            "since, or an older table is loaded"
        )
    else:
        clauses.append(
            "the correction acts as the map says"
            if verification.better
            else "the difference is within the uncertainties"
        )
    theta = verification.axes.get("theta")
    if theta is not None and verification.theta_fault is not TableFault.NONE:
        clauses.append(_of_theta(verification.theta_fault, theta))
    if verification.without_scale:
        clauses.append("the scale of the map, by its reference length, is not compared")
    return clauses


def _of_theta(fault: TableFault, theta: AxisError) -> str:
    """Return what is wrong with the correction of the angle."""
    if fault is TableFault.FACTOR:
        return f"that of θ acts {significant(theta.factor)} times"
    return f"that of θ {_ACTS.get(fault, 'is not that of this map')}"


def verification_text(verification: Verification) -> str:
    """Return the sentence, and the error of each axis before and after."""
    rows = [
        [
            "",
            "rms without",
            "rms with",
            "largest without",
            "largest with",
            "U without",
            "U with",
            "acts",
        ]
    ]
    for name, axis in verification.axes.items():
        unit, scale = UNIT[name]
        values = (
            axis.rms_before,
            axis.rms_after,
            axis.largest_before,
            axis.largest_after,
            axis.U_before,
            axis.U_after,
        )
        acts = (
            "not shown"
            if math.isnan(axis.factor)
            else (f"{axis.factor:.3f} ± {axis.u_factor:.3f}")
        )
        rows.append(
            [
                f"{'θ' if name == 'theta' else name}, {unit}",
                *(significant(value * scale) for value in values),
                acts,
            ]
        )
    return "\n".join(
        [
            verification_sentence(verification),
            "",
            *aligned(list(zip(*rows, strict=True))),
            "",
            "  U: expanded uncertainty of a node, rms; acts: part of the correction that "
            "acts (1 is right), ± u",
        ]
    )
