# SPDX-License-Identifier: Apache-2.0
"""Why a message did not become a reading; each rejection is counted under one of these."""

from enum import StrEnum


class Reason(StrEnum):
    """Reasons of rejection; those of encoder samples start with ``encoder_sample``."""

    NO_ENCODER = "no_encoder_sample_near"
    MOVING = "stage_moving"
    OUTSIDE_VIEWS = "outside_every_view"
    SUPERSEDED = "superseded_by_redo"
    OTHER_PLAN = "other_plan"
    CONTRADICTION = "encoder_contradiction"
    NOT_FINITE = "not_finite"
    UNKNOWN_KIND = "unknown_kind"
    UNKNOWN_MARK = "unknown_mark"
    NOT_IN_VIEW = "mark_not_in_view"
    AMBIGUOUS = "ambiguous_mark"
    TOO_FAR = "too_far_from_nominal"
    LOW_SCORE = "low_score"
    DUPLICATE = "duplicate"
    OUTLIER = "outlier_among_repeats"
    ENCODER_UNKNOWN_JOINT = "encoder_sample_unknown_joint"
    ENCODER_NOT_FINITE = "encoder_sample_not_finite"
    ENCODER_MALFORMED = "encoder_sample_malformed"
    COMMAND_BAD = "command_unusable"
