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
    BAD_SIGMA = "sigma_out_of_range"
    UNKNOWN_KIND = "unknown_kind"
    UNKNOWN_MARK = "unknown_mark"
    NOT_IN_VIEW = "mark_not_in_view"
    AMBIGUOUS = "ambiguous_mark"
    ROTATION = "rotation_not_known"
    TOO_FAR = "too_far_from_nominal"
    NOT_AT_MARK = "stage_not_at_mark"
    SEVERAL = "other_mark_of_one_exposure"
    LOW_SCORE = "low_score"
    DUPLICATE = "duplicate"
    OUTLIER = "outlier_among_repeats"
    ENCODER_UNKNOWN_JOINT = "encoder_sample_unknown_joint"
    ENCODER_NOT_FINITE = "encoder_sample_not_finite"
    ENCODER_MALFORMED = "encoder_sample_malformed"
    ENCODER_FUTURE = "encoder_sample_from_the_future"
    COMMAND_BAD = "command_unusable"
    COMMAND_FUTURE = "command_from_the_future"
    FUTURE = "from_the_future"


ADVICE = {
    Reason.ROTATION: "the view's rotation is not known well enough to tell these marks or lines "
                     "from their neighbours; let the detections carry ids, or measure grid marks "
                     "in the same view, or state a max_rotation of less than half a line",
    Reason.BAD_SIGMA: "their sigma is no standard uncertainty in m or rad (1e-12 to 1000, 0 = not "
                      "known), or 10,000 times smaller than that of the others; correct the "
                      "publisher of the detections",
    Reason.FUTURE: "they were stamped more than a minute ahead of the collector's clock; set the "
                   "clock that stamps them",
}
"""What to do about a reason of which a single detection is worth a line."""

REMEDY = {
    Reason.NO_ENCODER: "the encoder has a gap around the exposures; let it send without gaps, or "
                       "raise max_encoder_gap",
    Reason.MOVING: "the stage moved at the exposure; expose at rest, stamp the exposure itself, or "
                   "raise max_speed and max_angular_speed",
    Reason.OUTSIDE_VIEWS: "they were exposed when no view was being measured; expose between "
                          "MEASURE and the next command, stamped by one clock",
    Reason.CONTRADICTION: "encoder samples contradict each other; let one source publish the "
                          "joints, with a clock that does not step",
    Reason.NOT_FINITE: "NaN, infinite or negative where a length or an angle is wanted; correct "
                       "the publisher of the detections",
    Reason.BAD_SIGMA: ADVICE[Reason.BAD_SIGMA],
    Reason.FUTURE: ADVICE[Reason.FUTURE],
    Reason.UNKNOWN_KIND: "kind is neither GRID nor ANGULAR; correct the publisher of the "
                         "detections",
    Reason.UNKNOWN_MARK: "their ids are not on the plate; check grid_size, angular_count and the "
                         "numbering of the marks (m, n from -h to h, k from 0)",
    Reason.NOT_IN_VIEW: "the view does not ask for these marks; check its pose and its kinds of "
                        "marks in the plan",
    Reason.AMBIGUOUS: "two marks are about equally near; let the detections carry ids",
    Reason.ROTATION: ADVICE[Reason.ROTATION],
    Reason.TOO_FAR: "the marks are not where the view has them; check how the plate lies, the unit "
                    "of the offsets (m, stage axes) and the ids, or raise max_deviation",
    Reason.NOT_AT_MARK: "the stage does not stand at the marks that are seen; check joint_x, "
                        "joint_y and measurement_sense, or set max_stage_distance",
    Reason.SEVERAL: "an exposure shows several marks, and only that at which the stage stands is "
                    "read: the stage's error is mapped where it stands; go to every mark, and "
                    "publish of each image the mark nearest to the optical axis",
    Reason.LOW_SCORE: "their score is below min_score; correct the detection, or lower min_score",
    Reason.OUTLIER: "repeats of a mark contradict each other; check that each id is of one mark, "
                    "or raise outlier_limit",
}
"""What to do when most detections are rejected for a reason; reasons not listed are not faults."""


def advice(rejected: Mapping[str, int]) -> list[str]:
    """Return one line for each reason in `rejected` that has an advice, with its count."""
    return [f"{count} detection{'s' * (count != 1)} rejected as {reason}: {text}"
            for reason, text in ADVICE.items() if (count := rejected.get(reason))]
