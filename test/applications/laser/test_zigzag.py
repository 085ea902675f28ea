# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from selfcal_ros.applications.laser.identify import identify_ibaraki
from selfcal_ros.applications.laser.simulation import (
    Measurement,
    SetUp,
    case_study_machine,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.applications.laser.zigzag import (
    CutRule,
    Recording,
    cut_zigzag,
    find_rests,
)
from selfcal_ros.errors import InputError, NoDataError
from test.support.laser import recorded

RULE = CutRule((0.01, 0.01))


def recording(**options):
    setups = {"pp": SetUp(mirror_rad=(5e-4,)), "np": SetUp(mirror_rad=(-3e-4,))}
    return recorded(
        case_study_machine(), setups, rng=np.random.default_rng(1), **options
    )


@pytest.mark.parametrize("steps", [(0.01, 0.007), (0.01, 0.01, 0.005)])
def test_a_recording_gives_back_the_machine(steps):
    rng = np.random.default_rng(2)
    machine = random_machine(steps, 4, rng)
    cut = cut_zigzag(recorded(machine, {}, rng=rng), CutRule(steps))
    np.testing.assert_allclose(
        identify_ibaraki(cut.data).errors_m, machine.errors_m, atol=1e-13
    )
    assert set(cut.runs.values()) == {1} and set("xy") < set(cut.runs)


def test_blocks_of_np_are_numbered_by_place():
    machine = case_study_machine()
    cut = cut_zigzag(recording(), RULE)
    assert cut.data.diagonals == ("pp", "np") and cut.data.n_blocks == 6
    np.testing.assert_allclose(
        cut.data.linear_mean_m[0], machine.errors_m[0, :, 0], atol=1e-15
    )
    measurement = Measurement(
        {"pp": SetUp(mirror_rad=(5e-4,)), "np": SetUp(mirror_rad=(-3e-4,))}
    )
    expected = simulate_step_diagonal(machine, measurement, np.random.default_rng(0))
    np.testing.assert_allclose(cut.data.readings_m, expected.readings_m, atol=1e-14)
    backwards = np.ptp(cut.data.readings_m[1, 0] - expected.readings_m[1, 0, ::-1])
    assert backwards > 10e-9, "the X readings of np would be told apart by their order"


def test_repeats_of_a_whole_recording_become_samples():
    one = recording(noise_m=10e-9)
    other = recorded(
        case_study_machine(), {}, rng=np.random.default_rng(5), noise_m=10e-9
    )
    gap = int(one.laser_ns[-1]) + 10**9
    both = Recording(
        np.concatenate([one.laser_ns, other.laser_ns + gap]),
        np.concatenate([one.laser_m, other.laser_m]),
        np.concatenate([one.position_ns, other.position_ns + gap]),
        np.concatenate([one.position_m, other.position_m]),
    )
    cut = cut_zigzag(both, RULE)
    assert cut.runs == {"np": 2, "pp": 2, "x": 2, "y": 2}
    assert cut.data.samples_m.shape == (2, 2, 2, 6) and cut.data.counts.min() == 2


def test_runs_that_were_repeated_more_often_than_others_keep_all_samples():
    one, other = recording(noise_m=10e-9), recording()
    until = 13 * 1_200_000_000  # one diagonal alone
    laser, position = other.laser_ns < until, other.position_ns < until
    gap = int(one.laser_ns[-1]) + 10**9
    cut = cut_zigzag(
        Recording(
            np.concatenate([one.laser_ns, other.laser_ns[laser] + gap]),
            np.concatenate([one.laser_m, other.laser_m[laser]]),
            np.concatenate([one.position_ns, other.position_ns[position] + gap]),
            np.concatenate([one.position_m, other.position_m[position]]),
        ),
        RULE,
    )
    assert cut.runs == {"np": 1, "pp": 2, "x": 1, "y": 1}
    exact = cut_zigzag(recording(), RULE).data.readings_m
    np.testing.assert_allclose(cut.data.samples_m[1, 0], exact[0], atol=1e-14)
    assert np.isnan(cut.data.samples_m[1, 1]).all()


def test_a_distance_that_shrinks_along_the_diagonal_is_turned_by_the_sign():
    series = recording()
    shrinking = replace(series, laser_m=-series.laser_m)
    with pytest.raises(
        InputError,
        match=r"run pp, x move, block 1: .*the sign is wrong; give --laser-sign -1",
    ):
        cut_zigzag(shrinking, RULE)
    turned = cut_zigzag(shrinking, replace(RULE, laser_sign=-1)).data
    np.testing.assert_allclose(
        turned.readings_m, cut_zigzag(series, RULE).data.readings_m
    )


def test_the_mean_of_a_rest_leaves_the_moves_out():
    rests = find_rests(recording(), RULE)
    assert len(rests) == 2 * 13 + 2 * 7
    np.testing.assert_allclose(rests[0].position_m, [0.3, -0.2], atol=1e-9)
    np.testing.assert_allclose(rests[1].position_m, [0.31, -0.2], atol=1e-9)
    assert rests[1].laser_m - rests[0].laser_m == pytest.approx(7.0676e-3, abs=1e-6)


def test_a_recording_of_the_diagonals_only_has_no_linear_errors():
    series = recording()
    until = 26 * 1_200_000_000
    short = Recording(
        series.laser_ns[series.laser_ns < until],
        series.laser_m[series.laser_ns < until],
        series.position_ns[series.position_ns < until],
        series.position_m[series.position_ns < until],
    )
    cut = cut_zigzag(short, RULE)
    assert cut.runs == {"np": 1, "pp": 1} and cut.data.linear_m is None
    assert cut.notes == ("1 move(s) that are not one step of one axis",)


def test_linear_errors_of_some_axes_only_are_left_out_and_said():
    series, until = recording(), 33 * 1_200_000_000  # rests of pp, np: 13 each, of x: 7
    laser, position = series.laser_ns < until, series.position_ns < until
    cut = cut_zigzag(
        Recording(
            series.laser_ns[laser],
            series.laser_m[laser],
            series.position_ns[position],
            series.position_m[position],
        ),
        RULE,
    )
    said = "linear errors of some axes only: not used"
    assert cut.runs == {"np": 1, "pp": 1, "x": 1} and cut.data.linear_m is None
    assert said in cut.notes and said not in cut_zigzag(series, RULE).notes


def test_a_missing_rest_is_named():
    # The 5th rest of pp never comes to rest: two moves are no steps, the run falls apart.
    def wander(positions):
        return positions + np.linspace(0, 1e-4, len(positions))[:, None]

    with pytest.raises(
        InputError, match=r"different numbers of blocks: np \[6\], pp \["
    ):
        cut_zigzag(recording(extra={5: wander}), RULE)


def test_runs_over_different_places_are_refused():
    def shifted(positions):
        return positions + np.array([0.01, 0.0])

    series = recording(extra=dict.fromkeys(range(13, 26), shifted))
    with pytest.raises(InputError, match="starts elsewhere on the axis"):
        cut_zigzag(series, RULE)


@pytest.mark.parametrize(
    ("spoil", "kind", "message"),
    [
        (
            lambda s: replace(
                s, laser_m=np.where(np.arange(len(s.laser_m)) == 7, np.nan, s.laser_m)
            ),
            InputError,
            "laser: sample 7 is not finite",
        ),
        (
            lambda s: replace(s, laser_ns=s.laser_ns[:0], laser_m=s.laser_m[:0]),
            NoDataError,
            "laser: no samples; check the topic",
        ),
        (
            lambda s: replace(s, position_m=s.position_m * 1000),
            NoDataError,
            "recording: no run along a diagonal; check topics, joints, steps",
        ),
        (
            lambda s: replace(s, laser_m=s.laser_m * 1000),
            InputError,
            "run pp, x move, block 1: 7067.64 where 7.07107 mm is nominal, 999.5 "
            "times as much; check --laser-unit and --step-x, --step-y",
        ),
    ],
)
def test_a_spoilt_recording_is_one_clear_line(spoil, kind, message):
    with pytest.raises(kind) as caught:
        cut_zigzag(spoil(recording()), RULE)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("edge", ["start", "end"])
def test_both_ends_of_a_rest_are_left_out(edge):
    series = recording()
    rest, phase = np.divmod(series.laser_ns - 3_000_000, 1_200_000_000)
    creeping = (
        phase < 80_000_000
        if edge == "start"
        else (phase > 900_000_000) & (phase < 10**9)
    )
    creeping &= rest % 2 == 1  # of every rest alike it would cancel in the readings
    spoilt = replace(series, laser_m=series.laser_m + 1e-6 * creeping)
    np.testing.assert_allclose(
        cut_zigzag(spoilt, RULE).data.readings_m,
        cut_zigzag(series, RULE).data.readings_m,
        atol=1e-14,
    )
    with_all = cut_zigzag(spoilt, replace(RULE, settle_s=0.0)).data.readings_m
    assert np.abs(with_all - cut_zigzag(series, RULE).data.readings_m).max() > 10e-9


@pytest.mark.parametrize("noise_m", [0.0, 1e-8])
@pytest.mark.parametrize("spike_m", [1e-3, -3e-6])
def test_single_laser_samples_beside_their_rest_are_left_out_and_said(noise_m, spike_m):
    series = recording()
    rng = np.random.default_rng(8)
    quiet = series.laser_m + rng.normal(0, 1, len(series.laser_m)) * noise_m
    phase = np.divmod(series.laser_ns - 3_000_000, 1_200_000_000)[1]
    in_rest = np.flatnonzero((phase > 200_000_000) & (phase < 800_000_000))
    spiked = quiet.copy()
    spiked[in_rest[::50]] += spike_m
    cut = cut_zigzag(replace(series, laser_m=spiked), RULE)
    want = cut_zigzag(replace(series, laser_m=quiet), RULE)
    atol = 3 * noise_m / np.sqrt(len(in_rest) / 50) + 1e-14
    np.testing.assert_allclose(cut.data.readings_m, want.data.readings_m, atol=atol)
    assert cut.notes == (
        f"{len(in_rest[::50])} outlying laser sample(s) within a rest are left out",
        *want.notes,
    )
    assert not any("jump" in note for note in want.notes)


def rests_by_trying_every_start(series, rule):
    """Return (first, number of samples) of every rest, as the definition says."""
    found, start, stamps = [], 0, series.position_ns
    while start < len(stamps):
        end = start + 1
        while (
            end < len(stamps)
            and np.ptp(series.position_m[start : end + 1], axis=0).max()
            <= rule.rest_tolerance_m
        ):
            end += 1
        if stamps[end - 1] - stamps[start] >= rule.min_rest_s * 1e9:
            found.append(int(stamps[start]))
            start = end
        else:
            start += 1
    return found


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-8, 3e-7), st.integers(2, 40))
def test_rests_of_creeping_axes_are_those_of_the_definition(seed, creep, jumps):
    rng = np.random.default_rng(seed)
    walk = np.cumsum(rng.normal(0, creep, (300, 2)), axis=0)
    walk += np.cumsum(rng.random((300, 1)) < jumps / 300, axis=0) * 1e-5
    stamps = np.arange(300) * 20_000_000
    series = Recording(stamps, np.zeros(300), stamps, walk)
    rule = CutRule((0.01, 0.01), min_rest_s=0.2, settle_s=0.0)
    assert [
        rest.start_ns for rest in find_rests(series, rule)
    ] == rests_by_trying_every_start(series, rule)


def test_a_rest_without_laser_samples_does_not_count():
    series = recording()
    lost = (series.laser_ns > 1_200_000_000) & (series.laser_ns < 2_400_000_000)
    gap = replace(
        series, laser_ns=series.laser_ns[~lost], laser_m=series.laser_m[~lost]
    )
    assert len(find_rests(gap, RULE)) == len(find_rests(series, RULE)) - 1
