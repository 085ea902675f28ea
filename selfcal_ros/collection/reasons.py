# SPDX-License-Identifier: Apache-2.0
"""Why a message did not become a reading; each rejection is counted under one of these."""

from collections.abc import Mapping
from enum import StrEnum


class Reason(StrEnum):
    """Reasons of rejection; those of encoder samples start with ``encoder_sample``."""

    NO_ENCODER = "no_encoder_sample_near"
    MOVING = "stage_moving"
    OUTSIDE_VIEWS = "outside_every_view"
    SUPERSEDED = "superseded_by_redo"
    OTHER_PLAN = "other_plan"
    OTHER_RUN = "other_run"
    CONTRADICTION = "encoder_contradiction"
    NOT_FINITE = "not_finite"
    UNKNOWN_KIND = "unknown_kind"
    UNKNOWN_MARK = "unknown_mark"
    NOT_IN_VIEW = "mark_not_in_view"
    AMBIGUOUS = "ambiguous_mark"
    ROTATION = "rotation_not_known"
    TOO_FAR = "too_far_from_nominal"
    NOT_AT_MARK = "stage_not_at_mark"
    LOW_SCORE = "low_score"
    DUPLICATE = "duplicate"
    OUTLIER = "outlier_among_repeats"
    ENCODER_UNKNOWN_JOINT = "encoder_sample_unknown_joint"
    ENCODER_NOT_FINITE = "encoder_sample_not_finite"
    ENCODER_MALFORMED = "encoder_sample_malformed"
    COMMAND_BAD = "command_unusable"


ADVICE = {
    Reason.ROTATION: "the view's rotation is not known well enough to tell these marks or lines "
                     "from their neighbours; let the detections carry ids, or measure grid marks "
                     "in the same view, or state a max_rotation of less than half a line",
}
"""What to do about a reason that is mended in the plan or in the parameters, one line each."""


def advice(rejected: Mapping[str, int]) -> list[str]:
    """Return one line for each reason in `rejected` that has an advice, with its count."""
    return [f"{rejected[reason]} detections rejected as {reason}: {text}"
            for reason, text in ADVICE.items() if rejected.get(reason)]
