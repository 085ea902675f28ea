# SPDX-License-Identifier: Apache-2.0
"""A view of which little or nothing became a reading stands in the result, not only on stderr."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.quality.outliers import SlipPlace, split_view
from selfcal_ros.model.readings import subset
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.summary.sections import summary_text
from selfcal_ros.reporting.words.findings import worded
from test.support.sessions import collected, events_of, small_plan

LATE = 2
"""The view of which readings are taken away."""


@pytest.fixture(scope="module")
def readings():
    return collected(events_of(small_plan("0, 90, 180, tx")))[1]


def thinned(readings, marks, lines, rejected):
    """Return the readings with the first marks and lines of one view alone."""
    view = readings.views[LATE]
    part = subset(view, np.arange(len(view.m)) < marks, np.arange(len(view.k)) < lines)
    part = replace(
        part, used=int(part.count.sum() + part.count_theta.sum()), rejected=rejected
    )
    return replace(
        readings, views=tuple(part if one is view else one for one in readings.views)
    )


def left_out(result):
    return [one for one in result.findings if one.name == "view_left_out"]


@pytest.mark.parametrize(
    ("marks", "lines", "rejected", "said"),
    [
        (
            0,
            0,
            {"too_far_from_nominal": 50, "low_score": 2},
            "is not part of the map: none of its detections became a reading "
            "(too_far_from_nominal 50, low_score 2)",
        ),
        (0, 0, {}, "is not part of the map: nothing was detected in it"),
        (
            1,
            0,
            {"stage_not_at_mark": 144},
            "is only partly in the map: 1 of {marks} marks and 0 of "
            "{lines} lines became readings (stage_not_at_mark 144)",
        ),
        (
            1,
            0,
            {},
            "is only partly in the map: 1 of {marks} marks and 0 of {lines} lines became readings",
        ),
    ],
)
def test_a_view_that_was_left_out_is_a_warning_of_the_result(
    readings, marks, lines, rejected, said
):
    view = readings.views[LATE]
    result = worded(calibrate(thinned(readings, marks, lines, rejected)))
    line = f"view '{view.view.name}' " + said.format(
        marks=len(view.m), lines=len(view.k)
    )
    data = result_to_dict(result)
    assert [text for text in data["warnings"] if " the map: " in text] == [line]
    summary = " ".join(summary_text(result_from_dict(data, "r")).split())
    assert line in summary
    assert summary.startswith("Calibrated from 4 of 5 views")
    assert "5 views, 4 measured" in summary


def test_a_view_without_most_of_its_marks_or_lines_is_told_and_no_other(readings):
    view = readings.views[LATE]
    marks, lines = len(view.m), len(view.k)
    assert left_out(calibrate(thinned(readings, marks // 2 - 1, lines, {})))
    assert left_out(calibrate(thinned(readings, marks, lines // 2 - 1, {})))
    for kept in (1.0, 0.8, 0.6):
        part = thinned(
            readings, int(kept * marks), int(kept * lines), {"low_score": 1000}
        )
        result = worded(calibrate(part))
        assert not left_out(result)
        assert summary_text(result).startswith("Calibrated from 5 views")


def test_lines_that_no_view_has_are_not_missed(readings):
    views = tuple(
        subset(view, np.full(len(view.m), True), np.full(len(view.k), False))
        for view in readings.views
    )
    assert [
        one.view for one in left_out(calibrate(replace(readings, views=views)))
    ] == ["line"]


def test_the_parts_of_a_view_that_slipped_are_one_view(readings):
    name = readings.views[LATE].view.name
    place = SlipPlace(name, LATE, "m", int(readings.views[LATE].m.min()) + 1)
    result = calibrate(split_view(readings, place))
    assert [view.name for view in result.views if view.name.startswith(name)] == [
        name,
        f"{name} after slip",
        f"{name} lines",
    ]
    assert not left_out(result)
