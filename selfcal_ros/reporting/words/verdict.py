# SPDX-License-Identifier: Apache-2.0
"""The verdict in words: a sentence, and a reason for each test that failed."""

from dataclasses import replace
from functools import singledispatch

import numpy as np

from selfcal_ros.estimation.findings import (
    AxesNotMet,
    FiniteRotation,
    NoiseContradicted,
    NoiseUnknown,
    NoisyView,
    NotConverged,
    OutliersGivenUp,
    OutliersKept,
    PredictionFailed,
    SignNotShown,
    SlipFound,
    SlipsGivenUp,
    TooManyOutliers,
)
from selfcal_ros.model.result import Noise
from selfcal_ros.model.verdict import Cause, Finding, Grade, Verdict
from selfcal_ros.reporting.words.causes import cause_text, remedies, what_it_is
from selfcal_ros.reporting.words.screening import warning
from selfcal_ros.units import ARCSEC_PER_RAD, RAD_PER_MRAD, UM_PER_M


def worded_verdict(verdict: Verdict, noise: Noise) -> Verdict:
    """Return a verdict with its sentence, reasons and the texts of its causes.

    One that has a sentence stays as it is, but for findings that came later.

    Parameters
    ----------
    verdict : Verdict
        As estimation gives it, or as a file tells it.
    noise : Noise
        Of the same result: whether there was something to compare residuals with.
    """
    if verdict.sentence and not verdict.findings:
        return verdict
    reasons = (*verdict.reasons, *(reason(finding) for finding in verdict.findings))
    causes = tuple(replace(cause, text=cause_text(cause), remedies=remedies(cause), what=None)
                   for cause in verdict.causes)
    return Verdict(verdict.grade, _sentence(verdict.grade, reasons, causes, noise),
                   reasons, causes, enlarged_by=verdict.enlarged_by)


def _sentence(grade: Grade, reasons: tuple[str, ...], causes: tuple[Cause, ...],
              noise: Noise) -> str:
    if grade is Grade.GOOD:
        tested = np.isfinite(noise.p_xy) or np.isfinite(noise.p_theta)
        return ("Good: residuals and the noise of readings agree" if tested else
                "Good: residuals show the noise; there are no repeats to compare it with")
    if grade is Grade.ENLARGED:
        return f"Good within an enlarged U: {causes[0].text if causes else reasons[0]}"
    if causes:
        return f"Not qualified: most likely {causes[0].text}"
    return f"Not qualified: {reasons[0]}"


@singledispatch
def reason(finding: Finding) -> str:
    """Return why a result is not qualified, in words."""
    raise TypeError(f"no words for {type(finding).__name__}")


@reason.register
def _(cause: Cause) -> str:
    return f"the readings show {what_it_is(cause)}"


@reason.register
def _(_: SignNotShown) -> str:
    return ("nothing in the readings shows the sign of the microscope's offsets, and with the "
            "other sign the map would be that of another stage: let the stage stop beside the "
            "marks on purpose (check_stops in the plan), or declare the microscope (--microscope "
            "0.01)")


@reason.register
def _(_: NotConverged) -> str:
    return ("the readings are so far from what is assumed of the measurement that the estimate "
            "converged only without the assumptions: check the sense, the axes and the pixel size "
            "of the microscope")


@reason.register
def _(found: FiniteRotation) -> str:
    return (f"the model is linear, but the plate was turned by up to "
            f"{found.largest_rad / RAD_PER_MRAD:.2f} mrad: solve jointly with finite rotations, "
            f"the default, which leaves {found.residuals_m * UM_PER_M:.3g} µm")


@reason.register
def _(found: NoiseContradicted) -> str:
    factor, unit = (UM_PER_M, "µm") if found.kind == "grid" else (ARCSEC_PER_RAD, "arcsec")
    name = "the detections' own sigma" if found.declared else "repeats"
    return (f"{found.kind} readings: residuals show a noise of {found.residuals * factor:.3g} "
            f"{unit}, {name} {found.stated * factor:.3g} {unit}; " + (
                "something beside random noise is in the readings"
                if found.residuals > found.stated else
                "repeats share what single readings do not (drift between passes), or the stated "
                "noise is too large"))


@reason.register
def _(_: NoiseUnknown) -> str:
    return ("grid readings: neither repeats nor residuals determine the noise, so that the "
            "uncertainty is not known; read every mark twice")


@reason.register
def _(found: AxesNotMet) -> str:
    return (f"theta: the stage does not satisfy the axis conditions of the datum xy_axes "
            f"(misclosure {found.misclosure_rad * ARCSEC_PER_RAD:.3g} arcsec, p = {found.p:.2g}); "
            "use zero_mean")


@reason.register
def _(found: PredictionFailed) -> str:
    return (f"{found.what} is predicted with {found.ratio:.2f} times the noise, beyond the limit "
            f"of {found.limit:.2f}")


for _kind in (NoisyView, TooManyOutliers, OutliersKept, OutliersGivenUp, SlipFound, SlipsGivenUp):
    reason.register(_kind, warning)  # what screening could not mend is a reason in the same words
