# SPDX-License-Identifier: Apache-2.0
"""Each reason of rejection: counted once for the message that deserves it, neighbours kept."""

import math

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Kind, Reason
from selfcal_ros.collection.reduce import PlaceList
from selfcal_ros.model.readings import RejectedPlaces, Sense
from test.support.collecting import collect, scene, table

PITCH = 0.01
GRID_FAULTS = {
    "unknown kind": ({"kind": 2}, Reason.UNKNOWN_KIND),
    "kind 255": ({"kind": 255}, Reason.UNKNOWN_KIND),
    "nan x": ({"offset_x": math.nan}, Reason.NOT_FINITE),
    "inf y": ({"offset_y": math.inf}, Reason.NOT_FINITE),
    "-inf y": ({"offset_y": -math.inf}, Reason.NOT_FINITE),
    "nan sigma": ({"sigma": math.nan}, Reason.NOT_FINITE),
    "inf sigma": ({"sigma": math.inf}, Reason.NOT_FINITE),
    "negative sigma": ({"sigma": -1e-9}, Reason.NOT_FINITE),
    "sigma of a pixel": ({"sigma": 1000.1}, Reason.BAD_SIGMA),
    "sigma of 1e4": ({"sigma": 1e4}, Reason.BAD_SIGMA),
    "sigma too small": ({"sigma": 0.9e-12}, Reason.BAD_SIGMA),
    "sigma of nothing": ({"sigma": 1e-200}, Reason.BAD_SIGMA),
    "nan score": ({"score": math.nan}, Reason.NOT_FINITE),
    "low score": ({"score": 0.39}, Reason.LOW_SCORE),
    "zero score": ({"score": 0.0}, Reason.LOW_SCORE),
    "m off the plate": ({"m": 3}, Reason.UNKNOWN_MARK),
    "n off the plate": ({"n": -3}, Reason.UNKNOWN_MARK),
    "extreme id": ({"m": -(2**31), "n": 2**31 - 1}, Reason.UNKNOWN_MARK),
    "one pitch off": ({"offset_x": PITCH}, Reason.TOO_FAR),
    "1 mm off": ({"offset_y": -1e-3}, Reason.TOO_FAR),
    "absurdly far": ({"offset_x": 1e300}, Reason.TOO_FAR),
}
ANGULAR_FAULTS = {
    "nan": ({"offset_theta": math.nan}, Reason.NOT_FINITE),
    "inf": ({"offset_theta": -math.inf}, Reason.NOT_FINITE),
    "negative sigma": ({"sigma": -1e-9}, Reason.NOT_FINITE),
    "sigma of 1e4": ({"sigma": 1e4}, Reason.BAD_SIGMA),
    "sigma of nothing": ({"sigma": 1e-200}, Reason.BAD_SIGMA),
    "low score": ({"score": 0.2}, Reason.LOW_SCORE),
    "k is K": ({"k": 8}, Reason.UNKNOWN_MARK),
    "k huge": ({"k": 2**32 - 1}, Reason.UNKNOWN_MARK),
    "a third of a line": ({"offset_theta": math.pi / 12}, Reason.TOO_FAR),
    "a whole turn off": ({"offset_theta": 2 * math.pi}, Reason.TOO_FAR),
    "absurdly far": ({"offset_theta": 1e300}, Reason.TOO_FAR),
}


def assert_only_this_is_lost(spoilt, lost, reason, **parameters):
    """Compare with the unspoilt scene: the mark gone, its reason counted once, the rest equal."""
    clean, _ = collect(scene().events, **parameters)
    found, progress = collect(spoilt.events, **parameters)
    before, after = table(clean.views[0]), table(found.views[0])
    assert clean.all_rejected() == {}
    assert found.all_rejected() == {str(reason): 1}
    assert found.views[0].used == len(before) - 1
    del before[lost]
    assert after == before
    assert not progress[0].complete


@pytest.mark.parametrize("fault", GRID_FAULTS)
def test_a_bad_grid_detection_is_counted_under_its_reason(fault):
    fields, reason = GRID_FAULTS[fault]
    spoilt = scene()
    index = spoilt.grid(7)
    mark = ("grid", spoilt.detections[index].m, spoilt.detections[index].n)
    spoilt.spoil(index, **fields)
    assert_only_this_is_lost(spoilt, mark, reason)


@pytest.mark.parametrize(("score", "rejected"), [(0.5, {}), (0.49, {"low_score": 1})])
def test_a_score_at_the_limit_is_enough(score, rejected):
    marked = scene()
    marked.spoil(marked.grid(7), score=score)
    assert collect(marked.events, min_score=0.5)[0].all_rejected() == rejected


@pytest.mark.parametrize("fault", ["low score", "m off the plate", "one pitch off"])
@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
def test_the_place_of_a_rejected_grid_detection_is_where_the_stage_stood(fault, sense):
    fields, reason = GRID_FAULTS[fault]
    spoilt = scene(sense=Sense(sense))
    index = spoilt.grid(7)
    m, n = spoilt.detections[index].m, spoilt.detections[index].n
    spoilt.spoil(index, **fields)
    places = collect(spoilt.events, measurement_sense=sense)[0].views[0].places
    sign = -1 if sense == "plate_moves" else 1
    assert places.reason == (str(reason),)
    assert places.x == pytest.approx([sign * m * PITCH], abs=1e-4)
    assert places.y == pytest.approx([sign * n * PITCH], abs=1e-4)


@pytest.mark.parametrize("fault", ["nan x", "sigma of 1e4", "absurdly far"])
def test_of_a_detection_with_two_faults_the_first_is_counted_and_has_the_place(fault):
    """Each place has a reason that is counted, or the message to the solver cannot be made."""
    spoilt = scene()
    spoilt.spoil(spoilt.grid(7), **GRID_FAULTS[fault][0], score=0.0)
    measurements, progress = collect(spoilt.events)
    assert measurements.all_rejected() == {str(GRID_FAULTS[fault][1]): 1}
    assert measurements.views[0].places.reason == ()
    fields = from_model.view_measurement(progress[0], measurements, 5, "stage")
    assert list(fields["rejected_reason"]) == []


@pytest.mark.parametrize("sense", ["microscope_moves", "plate_moves"])
def test_the_place_of_an_outlier_is_where_the_stage_stood(sense):
    spoilt = scene(repeats=4, sense=Sense(sense))
    index = spoilt.grid(30)
    bad = spoilt.detections[index]
    spoilt.spoil(index, offset_x=bad.offset_x + 5e-6)
    places = collect(spoilt.events, measurement_sense=sense)[0].views[0].places
    sign = -1 if sense == "plate_moves" else 1
    assert bad.m and bad.n and places.reason == ("outlier_among_repeats",)
    assert places.x == pytest.approx([sign * bad.m * PITCH], abs=1e-4)
    assert places.y == pytest.approx([sign * bad.n * PITCH], abs=1e-4)


def test_a_place_that_the_encoder_does_not_tell_is_unknown_and_lines_have_none():
    spoilt = scene()
    spoilt.spoil(spoilt.angular(3), k=8)
    begins = spoilt.detections[spoilt.grid(3)].stamp_ns + 1
    spoilt.samples = [sample for sample in spoilt.samples if sample.stamp_ns > begins]
    places = collect(spoilt.events)[0].views[0].places
    assert places.reason == ("no_encoder_sample_near",) * len(places.reason)
    assert len(places.reason) >= 3
    assert np.isnan(places.x).all() and np.isnan(places.y).all()


def test_of_many_places_an_even_choice_is_kept():
    gathered = PlaceList()
    at = np.arange(2 * RejectedPlaces.MOST - 1.0)
    gathered.add(np.full(len(at), Reason.TOO_FAR, dtype=object), np.stack([at, -at]))
    places = gathered.places()
    np.testing.assert_array_equal(places.x, at[::2])
    np.testing.assert_array_equal(places.y, -at[::2])
    assert set(places.reason) == {"too_far_from_nominal"}


@pytest.mark.parametrize("fault", ANGULAR_FAULTS)
def test_a_bad_angular_detection_is_counted_under_its_reason(fault):
    fields, reason = ANGULAR_FAULTS[fault]
    spoilt = scene()
    spoilt.spoil(spoilt.angular(3), **fields)
    assert_only_this_is_lost(spoilt, ("line", 3), reason)


def test_what_does_not_concern_a_kind_is_not_looked_at():
    plain, odd = scene(), scene()
    for index in range(len(odd.detections)):
        grid = odd.detections[index].kind == Kind.GRID
        odd.spoil(
            index,
            **(
                {"offset_theta": math.nan, "k": 99}
                if grid
                else {"offset_x": math.inf, "offset_y": math.nan, "m": 99, "n": -99}
            ),
        )
    found, _ = collect(odd.events)
    assert found.all_rejected() == {}
    assert table(found.views[0]) == table(collect(plain.events)[0].views[0])


def test_scores_count_only_where_any_is_reported():
    silent = scene()
    for index in range(len(silent.detections)):
        silent.spoil(index, score=0.0)
    found, progress = collect(silent.events)
    assert found.all_rejected() == {}
    assert progress[0].complete
    silent.spoil(silent.grid(0), score=0.9)
    found, _ = collect(silent.events)
    assert found.all_rejected() == {"low_score": len(silent.detections) - 1}


@pytest.mark.parametrize("score", [math.inf, math.nan])
def test_a_score_that_is_no_number_does_not_say_that_scores_are_reported(score):
    silent = scene()
    for index in range(len(silent.detections)):
        silent.spoil(index, score=0.0)
    silent.spoil(silent.grid(0), score=score)
    found, _ = collect(silent.events)
    assert found.all_rejected() == {"not_finite": 1}


@pytest.mark.parametrize("copies", [2, 3, 7])
def test_exact_duplicates_count_once_as_readings_and_the_rest_as_duplicates(copies):
    doubled = scene()
    doubled.detections += [doubled.detections[4]] * (copies - 1)
    found, _ = collect(doubled.events)
    assert found.all_rejected() == {"duplicate": copies - 1}
    assert table(found.views[0]) == table(collect(scene().events)[0].views[0])


def test_a_duplicate_of_minus_zero_is_a_duplicate():
    doubled = scene()
    doubled.spoil(4, offset_x=0.0)
    doubled.detections.append(doubled.detections[4])
    doubled.spoil(4, offset_x=-0.0)
    found, _ = collect(doubled.events)
    assert found.all_rejected() == {"duplicate": 1}


def test_the_same_mark_at_another_instant_is_a_repeat_and_no_duplicate():
    twice = scene(repeats=2)
    found, _ = collect(twice.events)
    assert found.all_rejected() == {}
    assert set(found.views[0].count) == {2}
    assert set(found.views[0].count_theta) == {2}


def test_an_outlier_among_repeats_goes_and_the_others_stay():
    noise = {"sigma_xy_m": 2e-8, "sigma_theta_rad": 2e-6}
    spoilt = scene(repeats=5, **noise)
    grid, line = spoilt.grid(30), spoilt.angular(12)
    mark = ("grid", spoilt.detections[grid].m, spoilt.detections[grid].n)
    spoilt.spoil(grid, offset_y=spoilt.detections[grid].offset_y + 1e-6)
    spoilt.spoil(line, offset_theta=spoilt.detections[line].offset_theta - 1e-3)
    found, _ = collect(spoilt.events)
    assert found.all_rejected() == {"outlier_among_repeats": 2}
    before = table(collect(scene(repeats=5, **noise).events)[0].views[0])
    after = table(found.views[0])
    changed = {key for key in before if before[key] != after[key]}
    assert changed == {mark, ("line", spoilt.detections[line].k)}
    assert after[mark][2] == 4
    assert after[("line", spoilt.detections[line].k)][1] == 4
    kept, _ = collect(spoilt.events, outlier_limit=0.0)
    assert kept.all_rejected() == {}


def test_a_mark_that_lies_off_the_field_in_the_shifted_view_is_not_in_view():
    shifted = scene("tx")
    index = shifted.grid(0)
    known = ("grid", shifted.detections[index].m, shifted.detections[index].n)
    shifted.spoil(index, m=2, n=0)  # would lie at site 3 of -2..2
    found, _ = collect(shifted.events)
    assert found.all_rejected() == {"mark_not_in_view": 1}
    before = table(collect(scene("tx").events)[0].views[0])
    del before[known]
    assert table(found.views[0]) == before


def test_kinds_that_the_view_does_not_measure_are_not_in_view():
    line = scene("0", line=True)
    borrowed = line.detections[line.grid(3)]
    stamp = line.detections[-1].stamp_ns  # in the view of angular lines only
    line.detections.append(borrowed)
    line.spoil(len(line.detections) - 1, stamp_ns=stamp)
    found, _ = collect(line.events)
    assert found.views[1].rejected == {"mark_not_in_view": 1}
    assert found.views[0].rejected == {}


def stage_position(spoilt, index):
    """Return where the stage stood at a detection: x, y, theta."""
    stamp = spoilt.detections[index].stamp_ns
    return max(
        (s for s in spoilt.samples if s.stamp_ns <= stamp), key=lambda s: s.stamp_ns
    ).positions


@pytest.mark.parametrize(
    ("offset", "reason"),
    [
        ((0.5, 0.0), Reason.AMBIGUOUS),
        ((0.0, -0.5), Reason.AMBIGUOUS),
        ((0.5, 0.5), Reason.AMBIGUOUS),
        ((0.4, 0.0), Reason.AMBIGUOUS),
        ((0.2, 0.0), Reason.TOO_FAR),
        ((0.06, 0.0), Reason.TOO_FAR),
    ],
)
def test_a_mark_without_id_between_marks(offset, reason):
    spoilt = scene(with_ids=False)
    index = spoilt.grid(12)
    x, y, _ = stage_position(spoilt, index)
    spoilt.spoil(
        index,
        offset_x=offset[0] * PITCH - x + round(x / PITCH) * PITCH,
        offset_y=offset[1] * PITCH - y + round(y / PITCH) * PITCH,
    )
    found, _ = collect(spoilt.events)
    assert found.all_rejected() == {str(reason): 1}
    assert len(found.views[0].m) == 24


def test_a_mark_without_id_far_off_the_plate_is_too_far():
    spoilt = scene(with_ids=False)
    spoilt.spoil(spoilt.grid(24), offset_x=0.0095)
    found, _ = collect(spoilt.events)
    assert found.all_rejected() == {"too_far_from_nominal": 1}


@pytest.mark.parametrize(
    ("lines", "reason"),
    [(0.5, Reason.AMBIGUOUS), (-0.4, Reason.AMBIGUOUS), (0.3, Reason.TOO_FAR)],
)
def test_a_line_without_id_between_lines(lines, reason):
    spoilt = scene(with_ids=False)
    spoilt.spoil(spoilt.angular(2), offset_theta=lines * 2 * math.pi / 8)
    found, _ = collect(spoilt.events)
    assert found.all_rejected() == {str(reason): 1}
    assert found.views[0].k.tolist() == [0, 1, 3, 4, 5, 6, 7]


def test_the_largest_deviation_is_a_parameter():
    spoilt = scene()
    index = spoilt.grid(7)
    spoilt.spoil(index, offset_x=spoilt.detections[index].offset_x + 1e-3)
    assert collect(spoilt.events, max_deviation=1.2e-3)[0].all_rejected() == {}
    assert collect(spoilt.events)[0].all_rejected() == {"too_far_from_nominal": 1}
