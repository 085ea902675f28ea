# SPDX-License-Identifier: Apache-2.0
"""Plans that turn or mirror into each other have one key, and one uncertainty."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest

from selfcal_ros.estimation.observability.rank import equivalent_key
from selfcal_ros.estimation.observability.suggest import score_plan
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import Plan, View

SQUARE, LONG = Artifact(5, 0.01), Artifact(5, 0.01, 0, 7)


def views_of(poses):
    return tuple(
        View(f"v{n}", q * pi / 2, (a * 0.01, b * 0.01), True, False)
        for n, (q, a, b) in enumerate(poses)
    )


BASE = [(0, 0, 0), (1, 1, 0), (0, 0, 2), (2, -1, 0)]
SAME = {
    "order": BASE[::-1],
    "plate turned in all views": [(q + 1, a, b) for q, a, b in BASE],
    "stage and plate turned": [(q, -b, a) for q, a, b in BASE],
    "mirrored": [(-q, a, -b) for q, a, b in BASE],
    "all of it": [(-q + 3, b, a) for q, a, b in BASE],
}
OTHER = {
    "one shift back": [(0, 0, 0), (1, -1, 0), (0, 0, 2), (2, -1, 0)],
    "one turn": [(0, 0, 0), (3, 1, 0), (0, 0, 2), (2, -1, 0)],
    "one more": [*BASE, (0, 0, 0)],
}


@pytest.mark.parametrize("name", SAME)
def test_what_only_renames_marks_and_sites_has_one_key_and_one_score(name):
    views = views_of(SAME[name])
    assert equivalent_key(SQUARE, views) == equivalent_key(SQUARE, views_of(BASE))
    found, base = (score_plan(Plan("p", SQUARE, v)) for v in (views, views_of(BASE)))
    assert (found.rms_xy, found.max_xy) == pytest.approx(
        (base.rms_xy, base.max_xy), rel=1e-9
    )


@pytest.mark.parametrize("name", OTHER)
def test_what_changes_the_plan_has_another_key_and_score(name):
    views = views_of(OTHER[name])
    assert equivalent_key(SQUARE, views) != equivalent_key(SQUARE, views_of(BASE))
    found, base = (score_plan(Plan("p", SQUARE, v)) for v in (views, views_of(BASE)))
    assert abs(found.rms_xy - base.rms_xy) > 1e-6


def test_shifts_are_compared_in_pitches_whatever_the_pitch():
    """With marks 10 um apart a shift of a pitch is far below the rounding in metres."""
    small = Artifact(5, 1e-5)
    plans = [
        [
            replace(
                view, translation_m=tuple(1e-3 * part for part in view.translation_m)
            )
            for view in views_of(poses)
        ]
        for poses in (BASE, OTHER["one shift back"])
    ]
    assert equivalent_key(small, plans[0]) == equivalent_key(SQUARE, views_of(BASE))
    assert equivalent_key(small, plans[1]) != equivalent_key(small, plans[0])


def test_a_long_field_only_turns_by_a_half():
    poses = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 2)]
    along_y = [(-q, b, a) for q, a, b in poses]
    key = equivalent_key(LONG, views_of(poses))
    assert key != equivalent_key(LONG, views_of(along_y))
    assert equivalent_key(SQUARE, views_of(poses)) == equivalent_key(
        SQUARE, views_of(along_y)
    )
    half = [(2 - q, -a, b) for q, a, b in poses]
    assert key == equivalent_key(LONG, views_of(half))
    scores = [
        score_plan(Plan("p", LONG, views_of(p))).rms_xy for p in (poses, half, along_y)
    ]
    assert np.isfinite(scores).all()
    assert scores[0] == pytest.approx(scores[1], rel=1e-9)
    assert abs(scores[0] - scores[2]) > 1e-6
