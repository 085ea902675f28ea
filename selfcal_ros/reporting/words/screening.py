# SPDX-License-Identifier: Apache-2.0
"""What was left out or could not be done, in words: the warnings of a result."""

import math
from functools import singledispatch

from selfcal_ros.estimation.findings import (
    DrawnUncertainty,
    Magnification,
    NoisyView,
    NoUncertainty,
    OutliersGivenUp,
    OutliersKept,
    OutliersRemoved,
    Removed,
    SlipFound,
    SlipsGivenUp,
    TakenForSlip,
    TooManyOutliers,
    Unchecked,
    VisitedOnce,
)
from selfcal_ros.model.verdict import Finding
from selfcal_ros.reporting.words.causes import what_it_is
from selfcal_ros.reporting.words.units import RATIO, plus_minus
from selfcal_ros.units import UM_PER_M, URAD_PER_RAD

NAMED = 5
"""Readings, sites or lines that are named one by one; the others are counted."""


@singledispatch
def warning(finding: Finding) -> str:
    """Return what was left out or could not be done, in words."""
    raise TypeError(f"no words for {type(finding).__name__}")


@warning.register
def _(_: NoUncertainty) -> str:
    return ("no uncertainty map, because of the size of the field: ask for it "
            "(--uncertainty always)")


@warning.register
def _(_: VisitedOnce) -> str:
    return ("each mark was visited once in a view, its repeats one after the other: a drift that "
            "is alike in all views is a part of the map, and repeats do not show it; visit the "
            "marks there and back, along x and along y")


@warning.register
def _(found: Unchecked) -> str:
    what = " and ".join(_counted(places, kind) for places, kind in (
        (found.sites, "site"), (found.lines, "line")) if places)
    one = len(found.sites) + len(found.lines) == 1
    rest, them = ("rests on a single reading", "it") if one else ("rest on single readings", "them")
    return (f"{what} of the map {rest} that no other checks; what is wrong with {them} is in the "
            "map, and no residual shows it: measure the marks that are missing, or add a view")


@warning.register
def _(found: Magnification) -> str:
    word = "larger" if found.value > 0 else "smaller"
    return (f"the plate is {word} than the encoders say by "
            f"{plus_minus(abs(found.value), found.u, RATIO)}, more than plate and encoders can "
            "have between them: check the pitch in the plan (grid_pitch), and the encoders' scale")


def _counted(places: tuple[tuple[int, ...], ...], kind: str) -> str:
    named = ", ".join(str(at if len(at) > 1 else at[0]) for at in places[:NAMED])
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    if len(places) == 1:
        return f"1 {kind} {named}"
    return f"{len(places)} {kind}s ({named}{more})"


@warning.register
def _(found: DrawnUncertainty) -> str:
    return (f"uncertainties of the law from {found.n_draws} draws of unit noise: "
            f"{100 / math.sqrt(2 * found.n_draws):.1f} % standard error")


@warning.register
def _(found: OutliersRemoved) -> str:
    removed = found.removed
    more = f" and {len(removed) - NAMED} more" if len(removed) > NAMED else ""
    return f"removed {len(removed)} outliers: {', '.join(map(_name, removed[:NAMED]))}{more}"


def _name(item: Removed) -> str:
    mark = item.mark if len(item.mark) > 1 else item.mark[0]
    return f"'{item.view}' {item.kind} {mark} ({item.standardised:.1f} sigma)"


@warning.register
def _(found: NoisyView) -> str:
    return (f"view '{found.view}' is {found.ratio:.1f} times as noisy as the others: measure it "
            "again")


@warning.register
def _(found: TooManyOutliers) -> str:
    return (f"more than {found.limit:.0%} of the readings contradict the others: none was "
            "removed; look for a wrong plan or a faulty view")


@warning.register
def _(_: OutliersKept) -> str:
    return "removing more outliers would leave the stage undetermined"


@warning.register
def _(found: OutliersGivenUp) -> str:
    return (f"gave up on outliers after {found.n_rounds} rounds: more of them seem to be in the "
            "readings; look for a wrong plan or a faulty view")


@warning.register
def _(found: SlipFound) -> str:
    size = (f"({found.tx_m * UM_PER_M:.3g}, {found.ty_m * UM_PER_M:.3g}) µm and "
            f"{found.phi_rad * URAD_PER_RAD:.3g} µrad")
    spoils = "; the map is spoiled by it: measure the view again"
    if len(found.places) > 1:
        return (f"view '{found.view}': the plate slipped by about {size}, "
                f"{' or '.join(found.places)}; the readings do not tell which"
                f"{spoils if found.spoils else '; the view is left out'}")
    return (f"view '{found.view}': the plate slipped {found.places[0]} by {size}; treated as two "
            f"placements{spoils if found.spoils else ''}")


@warning.register
def _(found: TakenForSlip) -> str:
    return (f"view '{found.view}' looks as if the plate slipped, but the readings show "
            f"{what_it_is(found.cause)}, which explains them better: no view was split")


@warning.register
def _(found: SlipsGivenUp) -> str:
    return (f"gave up on slips after {found.n_slips}: more of them seem to be in the readings; "
            "measure again")
