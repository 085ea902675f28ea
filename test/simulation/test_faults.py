# SPDX-License-Identifier: Apache-2.0
"""Faults: the ledger of what was spoilt is what the collector rejects, and nothing slips by."""

import numpy as np
import pytest

from selfcal_ros.collection.inputs import Detection, EncoderSample
from selfcal_ros.simulation.spec import Faults, apply_faults
from test.support.collecting import collect, scene
from test.support.truth import angular_deviation, grid_deviation

NOISE = {"sigma_xy_m": 2e-8, "sigma_theta_rad": 2e-6}


def spoilt(faults, *, seed=1, **settings):
    cell = scene(
        "0, 90, tx", size=11, count=24, line=True, repeats=5, **NOISE, **settings
    )
    events = sorted(cell.events, key=lambda e: e.stamp_ns)
    arrivals, ledger = apply_faults(events, faults, np.random.default_rng(seed))
    return cell, arrivals, ledger


def assert_close_to_truth(cell, found):
    """Check that no reading is further off than its noise allows: no fault was used."""
    for index, readings in enumerate(found.views):
        if readings.view.grid:
            want = grid_deviation(cell.truth, index, readings.view)
            off = (
                np.stack([readings.dx, readings.dy])
                - want[:, readings.m + 5, readings.n + 5]
            )
            assert (np.abs(off) < 6 * 2e-8 / np.sqrt(readings.count)).all()
        off = (
            readings.dtheta
            - angular_deviation(cell.truth, index, readings.view)[readings.k]
        )
        assert (np.abs(off) < 6 * 2e-6 / np.sqrt(readings.count_theta)).all()


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("duplicated", "duplicate"),
        ("low_score", "low_score"),
        ("not_finite", "not_finite"),
        ("unknown_mark", "unknown_mark"),
        ("outliers", "outlier_among_repeats"),
    ],
)
def test_the_ledger_is_what_the_collector_rejects(name, reason):
    cell, arrivals, ledger = spoilt(Faults(**{name: 0.01}))
    found, _ = collect([event for _, event in arrivals])
    assert list(ledger) == [name]
    assert ledger[name] > 5
    assert found.all_rejected() == {reason: ledger[name]}
    assert_close_to_truth(cell, found)


def test_lost_detections_are_not_there():
    cell, arrivals, ledger = spoilt(Faults(lost=0.03))
    n_seen = sum(isinstance(event, Detection) for _, event in arrivals)
    assert n_seen == len(cell.detections) - ledger["lost"]
    found, _ = collect([event for _, event in arrivals])
    assert found.all_rejected() == {}
    assert sum(v.used for v in found.views) == n_seen


@pytest.mark.parametrize("ids", [True, False])
def test_everything_at_once_is_counted_and_nothing_is_used_silently(ids):
    faults = Faults(
        lost=0.03,
        duplicated=0.02,
        outliers=0.01,
        low_score=0.01,
        not_finite=0.01,
        delay_s=0.2,
        clock_step_s=0.1555,
        encoder_gap_s=0.4,
    )
    cell, arrivals, ledger = spoilt(faults, with_ids=ids)
    found, _ = collect([event for _, event in arrivals])
    rejected = found.all_rejected()
    assert rejected["no_encoder_sample_near"] > 20
    assert rejected["encoder_contradiction"] > 10
    for name, reason in (
        ("low_score", "low_score"),
        ("not_finite", "not_finite"),
        ("duplicated", "duplicate"),
    ):
        assert rejected[reason] == ledger[name]
    n_seen = sum(isinstance(event, Detection) for _, event in arrivals)
    assert n_seen == sum(v.used for v in found.views) + sum(rejected.values())
    assert_close_to_truth(cell, found)


def test_delay_shuffles_the_arrival_but_not_the_stamps():
    cell, arrivals, _ = spoilt(Faults(delay_s=0.2))
    assert [at for at, _ in arrivals] == sorted(at for at, _ in arrivals)
    assert all(at >= event.stamp_ns for at, event in arrivals)
    stamps = [event.stamp_ns for _, event in arrivals]
    assert stamps != sorted(stamps)
    assert sorted(stamps) == sorted(event.stamp_ns for event in cell.events)


def test_a_stepped_clock_and_a_gap_are_in_the_ledger():
    cell, arrivals, ledger = spoilt(Faults(clock_step_s=0.5, encoder_gap_s=0.3))
    n_samples = sum(isinstance(event, EncoderSample) for _, event in arrivals)
    assert n_samples == len(cell.samples) - ledger["encoder_samples_lost"]
    assert ledger["encoder_samples_lost"] == 150
    back = sum(event.stamp_ns != at for at, event in arrivals)
    assert back == ledger["stamped_by_the_stepped_clock"] > len(cell.events) / 3


def test_no_fault_changes_nothing_and_a_seed_decides_the_rest():
    cell, arrivals, ledger = spoilt(Faults())
    assert ledger == {}
    assert [event for _, event in arrivals] == sorted(
        cell.events, key=lambda e: e.stamp_ns
    )
    many = Faults(lost=0.1, outliers=0.1, delay_s=0.1)
    first, again, other = (spoilt(many, seed=seed) for seed in (3, 3, 4))
    assert (first[1], first[2]) == (again[1], again[2])
    assert first[1] != other[1]


def test_outliers_are_1_to_20_um_and_mrad_off_in_any_direction():
    cell, arrivals, _ = spoilt(Faults(outliers=1.0))
    right = {event.stamp_ns: event for event in cell.detections}
    far = [
        (event, right[event.stamp_ns])
        for _, event in arrivals
        if isinstance(event, Detection)
    ]
    turned_mrad = np.array([1e3 * (e.offset_theta - r.offset_theta) for e, r in far])
    moved_um = np.array(
        [
            (1e6 * (e.offset_x - r.offset_x), 1e6 * (e.offset_y - r.offset_y))
            for e, r in far
        ]
    )
    turned_mrad = turned_mrad[turned_mrad != 0]
    size_um = np.hypot(*moved_um.T)
    for size in (np.abs(turned_mrad), size_um[size_um > 0]):
        assert 1 <= size.min() < 2 and 19 < size.max() <= 20
    assert (turned_mrad < 0).any() and (turned_mrad > 0).any()
    assert (moved_um < 0).any(axis=0).all() and (moved_um > 0).any(axis=0).all()
