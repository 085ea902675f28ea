# SPDX-License-Identifier: Apache-2.0
"""A view of which nothing became a reading stands in the result, not only on stderr."""

from dataclasses import replace

import numpy as np

from selfcal_ros.estimation.api import calibrate
from selfcal_ros.model.readings import ViewReadings
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.reporting.summary.sections import summary_text
from selfcal_ros.reporting.words.findings import worded
from test.support.sessions import collected, events_of, small_plan


def test_a_view_that_was_left_out_is_a_warning_of_the_result():
    readings = collected(events_of(small_plan("0, 90, 180, tx")))[1]
    none = np.zeros(0)
    out = ViewReadings(readings.views[2].view, none.astype(int), none.astype(int), none, none,
                       none.astype(int), rejected={"too_far_from_nominal": 50, "low_score": 2})
    views = tuple(out if view.view == out.view else view for view in readings.views)
    result = worded(calibrate(replace(readings, views=views)))
    line = (f"view '{out.view.name}' is not part of the map: none of its detections became a "
            "reading "
            "(too_far_from_nominal 50, low_score 2)")
    assert [text for text in result_to_dict(result)["warnings"] if "not part of" in text] == [line]
    assert line in " ".join(summary_text(result).split())
    whole = worded(calibrate(readings))
    assert not any("not part of the map" in text for text in whole.warnings)
