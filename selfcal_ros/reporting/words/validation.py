# SPDX-License-Identifier: Apache-2.0
"""A held-out validation in words: a line a set, and as the rows of a RESULT.json."""

from functools import singledispatch
from typing import Any

import numpy as np

from selfcal_ros.estimation.findings import (
    NothingToPredict,
    OwnTermsUnknown,
    RestNotIdentified,
    RestNotSettled,
)
from selfcal_ros.estimation.observability.plan_check import describe_view
from selfcal_ros.estimation.quality.validation import HeldOut
from selfcal_ros.model.verdict import Finding
from selfcal_ros.units import ARCSEC_PER_RAD, UM_PER_M


@singledispatch
def why_text(why: Finding | None) -> str:
    """Return why nothing could be predicted, or why it is not judged; empty for None."""
    raise TypeError(f"no words for {type(why).__name__}")


@why_text.register
def _(_: None) -> str:
    return ""


@why_text.register
def _(why: RestNotIdentified) -> str:
    more = ("no single further view would change that" if why.more is None else
            f"with {describe_view(why.more, why.artifact)} measured as well it could be")
    return f"cannot be held out: the rest does not identify the stage; {more}"


@why_text.register
def _(_: RestNotSettled) -> str:
    return "cannot be held out: the estimate does not settle on the rest"


@why_text.register
def _(_: NothingToPredict) -> str:
    return "nothing to predict: no held-out mark is known from the rest"


@why_text.register
def _(why: OwnTermsUnknown) -> str:
    return f"its own {' and '.join(why.terms)} cannot be known: not judged"


def validation_json(found: list[HeldOut]) -> list[dict[str, Any]]:
    """Return the validation for ``extra["validation"]`` of a result: SI units."""
    return [{"name": item.name, "n_grid": item.n_grid, "n_angular": item.n_angular,
             "rms_m": item.rms_m, "max_m": item.max_m, "rms_rad": item.rms_rad,
             "ratio": item.ratio, "note": why_text(item.why), "limit": item.limit,
             "exceeds": item.exceeds} for item in found]


def validation_text(found: list[HeldOut]) -> list[str]:
    """Return one line a held-out set, µm and arcsec."""
    lines = []
    for item in found:
        if not item.n_grid and not item.n_angular:
            lines.append(f"{item.name}: {why_text(item.why)}")
            continue
        parts = []
        if item.n_grid:
            parts.append(f"{item.n_grid} marks predicted within {item.rms_m * UM_PER_M:.4g} µm "
                         f"rms, {item.max_m * UM_PER_M:.4g} µm at most "
                         f"({item.ratio:.2f} times the noise{_limit_text(item)})")
        if item.n_angular:
            parts.append(f"{item.n_angular} lines within "
                         f"{item.rms_rad * ARCSEC_PER_RAD:.4g} arcsec rms")
        lines.append(f"{item.name}: " + ", ".join(parts))
    return lines


def _limit_text(item: HeldOut) -> str:
    if item.why is not None:
        return f"; {why_text(item.why)}"
    if not np.isfinite(item.limit):
        return ""
    return f", {'EXCEEDS' if item.exceeds else 'within'} the limit of {item.limit:.2f}"
