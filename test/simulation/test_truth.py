# SPDX-License-Identifier: Apache-2.0
"""The truth satisfies Hu's datum to rounding; its deviations follow the written-out equations."""

from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import datum_modes, remove_modes
from selfcal_ros.model.readings import Sense
from selfcal_ros.simulation.cell import CellSettings
from selfcal_ros.simulation.machine import _stage
from selfcal_ros.simulation.physics import encoder_error, stage_error
from test.support.plans import plan_of
from test.support.truth import (
    Spread,
    angular_deviation,
    grid_deviation,
    hu_plan,
    random_truth,
    simulate_measurements,
)

PLATES = [
    Artifact(11, 0.01, 24),
    Artifact(21, 0.005, 72),
    Artifact(5, 0.01, 8, 9),
    Artifact(5, 0.01, 12),
]


AS_PUBLISHED = Spread(encoder="xy_axes", rotation="linear")


def truth_of(artifact, views=4, seed=1):
    return random_truth(artifact, views, np.random.default_rng(seed), AS_PUBLISHED)


@pytest.mark.parametrize("artifact", PLATES, ids=str)
def test_the_truth_satisfies_the_datum_to_rounding(artifact):
    truth, x, y = truth_of(artifact), artifact.x_m, artifact.y_m
    reach = np.abs(x).max() * x.size
    (gx, gy), (ax, ay) = truth.g, truth.a
    for total in (gx.sum(), gy.sum(), ax.sum(), ay.sum()):  # Hu 5, 11
        assert abs(total) < 1e-20 * x.size
    for moment in (
        (gy * x - gx * y).sum(),
        (gx * x + gy * y).sum(),
        (ay * x - ax * y).sum(),
    ):
        assert abs(moment) < 1e-20 * reach
    assert abs((ax * x + ay * y).sum()) > 1e-9 * reach  # the plate keeps its scale


@pytest.mark.parametrize("artifact", PLATES, ids=str)
def test_the_angular_truth_continues_the_axes(artifact):
    truth, (hx, hy) = truth_of(artifact), artifact.half
    (gx, gy), quarter, pitch = (
        truth.g,
        artifact.angular_count // 4,
        artifact.grid_pitch_m,
    )
    slopes = [
        np.polyfit(np.arange(1, hx + 1) * pitch, gy[hx + 1 :, hy], 1)[0],  # Hu 9
        -np.polyfit(np.arange(1, hy + 1) * pitch, gx[hx, hy + 1 :], 1)[0],
        np.polyfit(np.arange(-hx, 0) * pitch, gy[:hx, hy], 1)[0],
        -np.polyfit(np.arange(-hy, 0) * pitch, gx[hx, :hy], 1)[0],
    ]
    np.testing.assert_allclose(truth.g_theta[::quarter], slopes, rtol=1e-9, atol=1e-17)


def test_the_spread_is_that_of_hu():
    truth = truth_of(Artifact(101, 0.001, 360), views=4000)
    assert truth.g.std() == pytest.approx(0.2e-6, rel=0.03)
    assert truth.a.std() == pytest.approx(0.3e-6, rel=0.03)
    assert truth.a_theta.std() == pytest.approx(np.deg2rad(0.01), rel=0.2)
    assert truth.phi_rad.std() == pytest.approx(np.deg2rad(0.3), rel=0.06)
    assert truth.t_m.std() == pytest.approx(30e-6, rel=0.06)


def test_hu_equations_12_to_15_written_out():
    artifact = Artifact(5, 0.01, 8)
    plan, truth, h = hu_plan(artifact), truth_of(Artifact(5, 0.01, 8)), 2
    (gx, gy), (ax, ay), phi, t = truth.g, truth.a, truth.phi_rad, truth.t_m
    v = [
        grid_deviation(truth, i, view) if view.grid else None
        for i, view in enumerate(plan.views)
    ]
    for m in range(-h, h + 1):
        for n in range(-h, h + 1):
            x, y, at, turned = 0.01 * m, 0.01 * n, (m + h, n + h), (-n + h, m + h)
            want = {
                0: (
                    gx[at] + ax[at] - phi[0] * y + t[0, 0],
                    gy[at] + ay[at] + phi[0] * x + t[0, 1],
                ),
                1: (
                    gx[turned] - ay[at] - phi[1] * x + t[1, 0],
                    gy[turned] + ax[at] - phi[1] * y + t[1, 1],
                ),
            }
            if m < h:
                moved = (m + 1 + h, n + h)
                want[3] = (
                    gx[moved] + ax[at] - phi[3] * y + t[3, 0],
                    gy[moved] + ay[at] + phi[3] * x + t[3, 1],
                )
            else:
                assert np.isnan(v[3][:, m + h, n + h]).all()
            for view, expected in want.items():
                np.testing.assert_allclose(
                    v[view][:, m + h, n + h], expected, atol=1e-19
                )
    for index, turn in ((0, 0), (1, 2), (2, 1), (3, 0)):
        want = np.roll(truth.g_theta, -turn) + truth.a_theta + phi[index]
        np.testing.assert_allclose(
            angular_deviation(truth, index, plan.views[index]), want, atol=1e-17
        )


def test_a_moved_plate_sees_the_stage_at_minus_p_with_the_other_sign():
    artifact = Artifact(5, 0.01, 8)
    plan, truth = plan_of("0, 90, tx", 5, count=8), truth_of(artifact)
    mirrored = truth_of(artifact)
    mirrored.g[:] = -truth.g[:, ::-1, ::-1]
    mirrored.g_theta[:] = -np.roll(truth.g_theta[::-1], 1)
    for index, view in enumerate(plan.views):
        np.testing.assert_array_equal(
            grid_deviation(truth, index, view, sense=Sense.PLATE_MOVES),
            grid_deviation(mirrored, index, view),
        )
        np.testing.assert_array_equal(
            angular_deviation(truth, index, view, sense=Sense.PLATE_MOVES),
            angular_deviation(mirrored, index, view),
        )


def test_simulated_readings_are_determined_by_their_seed():
    plan, truth = (
        plan_of("0, 90, tx", 11, count=24, repeats=4),
        truth_of(Artifact(11, 0.01, 24)),
    )
    a, b, c = (
        simulate_measurements(
            truth,
            plan,
            np.random.default_rng(seed),
            sigma_m=2e-8,
            sigma_theta_rad=1e-6,
            missing=0.1,
        )
        for seed in (1, 1, 2)
    )
    assert all((p.dx == q.dx).all() for p, q in zip(a.views, b.views, strict=True))
    assert not np.array_equal(a.views[0].m, c.views[0].m)


def test_simulated_noise_is_that_of_a_mean_of_repeats():
    plan = plan_of("0", 101, count=360, repeats=4)
    artifact = plan.artifact
    truth = random_truth(artifact, 1, np.random.default_rng(1), Spread(phi_rad=0.0))
    found = simulate_measurements(
        truth,
        plan,
        np.random.default_rng(2),
        sigma_m=2e-8,
        sigma_theta_rad=1e-6,
        missing=0.25,
    ).views[0]
    noise = (
        found.dx
        - grid_deviation(truth, 0, plan.views[0])[0, found.m + 50, found.n + 50]
    )
    assert noise.std() == pytest.approx(1e-8, rel=4 / np.sqrt(2 * len(noise)))
    assert len(found.m) == pytest.approx(0.75 * 101**2, abs=4 * np.sqrt(0.1875) * 101)
    assert set(found.count) == {4}
    assert found.used == 4 * (len(found.m) + len(found.k))
    assert found.dof_xy == 2 * 3 * len(found.m)


def test_plates_without_lines_have_three_views_of_hu():
    assert [v.name for v in hu_plan(Artifact(5, 0.01)).views] == [
        "identity",
        "rot90",
        "shift_x",
    ]
    assert truth_of(Artifact(5, 0.01)).g_theta.shape == (0,)


def test_axes_between_the_lines_are_refused():
    with pytest.raises(
        InputError, match="of 6 lines, none lies on the y axis; use independent"
    ):
        truth_of(Artifact(5, 0.01, 6))


def test_half_axes_of_one_site_leave_the_lines_as_drawn():
    truth = truth_of(Artifact(3, 0.01, 8), 1)
    assert np.isfinite(truth.g_theta).all()


def test_simulated_visits_begin_on_a_day_of_2023_with_a_minute_between_views():
    plan, rng = plan_of("0, 90, tx", 3, repeats=2), np.random.default_rng(1)
    truth = random_truth(plan.artifact, 3, rng)
    settings = CellSettings(exposure_period_s=0.02)
    readings = simulate_measurements(truth, plan, rng, settings=settings, visits=True)
    stamps = [view.visits.stamp_ns for view in readings.views]
    begin = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC).timestamp()
    assert min(stamps[0]) / 1e9 == pytest.approx(begin, abs=1)
    for before, after in pairwise(stamps):
        assert 60 < (min(after) - max(before)) / 1e9 < 62


@pytest.mark.parametrize(
    ("how", "known"),
    [({}, False), ({"visits": True}, True), ({"settings": CellSettings()}, True)],
)
def test_visits_are_known_where_they_are_wanted_or_the_cell_is_told(how, known):
    plan, rng = plan_of("0, 90", 3), np.random.default_rng(1)
    readings = simulate_measurements(
        random_truth(plan.artifact, 2, rng, AS_PUBLISHED), plan, rng, **how
    )
    assert [view.visits is not None for view in readings.views] == [known] * 2


LONG = Spread(correlation_pitches=3.0)


def test_without_a_correlation_each_site_has_an_error_of_its_own():
    artifact = Artifact(5, 0.01, 8)
    truth = random_truth(
        artifact, 2, np.random.default_rng(7), Spread(correlation_pitches=0.0)
    )
    drawn = np.random.default_rng(7).normal(0, Spread().g_m, (2, 5, 5))
    np.testing.assert_array_equal(
        truth.g, remove_modes(drawn, datum_modes(artifact, scale=True))
    )


def test_a_smooth_stage_stays_alike_over_its_correlation():
    """As exp(-d^2 / 2 L^2), along either axis, and alone in each component."""
    place = np.array([[0.0, 1.5, 3.0, 0.0, 6.0], [0.0, 0.0, 0.0, 3.0, 0.0]])
    found = np.stack(
        [
            _stage(Artifact(5, 0.01, 8), LONG, np.random.default_rng(seed))[1].at(place)
            for seed in range(2000)
        ]
    )
    cover = np.einsum("sci,sdj->cidj", found, found) / len(found) / LONG.g_m**2
    distance = np.hypot(*(place[:, :, None] - place[:, None]))
    for axis in range(2):
        np.testing.assert_allclose(
            cover[axis, :, axis], np.exp(-(distance**2) / 18), atol=0.1
        )
    assert np.abs(cover[0, :, 1]).max() < 0.1


def test_a_smooth_stage_is_its_map_at_the_sites_and_its_waves_between():
    artifact = Artifact(5, 0.01, 8)
    truth = random_truth(artifact, 2, np.random.default_rng(3), LONG)
    sites = np.stack([artifact.x_m.ravel(), artifact.y_m.ravel()])
    np.testing.assert_allclose(
        stage_error(truth, sites), truth.g.reshape(2, -1), atol=1e-21
    )
    u = np.linspace(-0.02, 0.02, 41)
    row = stage_error(truth, np.stack([u, np.full(41, 0.003)]))
    bend = np.diff(row, 2)
    assert np.abs(np.diff(bend)).max() < 0.2 * np.abs(bend).max()  # no corner at a site
    waves = truth.waves.at(np.stack([u, np.full(41, 0.003)]) / 0.01)
    # the datum is linear
    np.testing.assert_allclose(np.diff(row - waves, 2), 0.0, atol=1e-20)


def test_a_smooth_encoder_closes_and_is_its_map_at_the_lines():
    found = []
    for seed in range(400):
        truth = random_truth(
            Artifact(5, 0.01, 24), 1, np.random.default_rng(seed), LONG
        )
        lines = np.arange(24) * np.pi / 12
        np.testing.assert_allclose(
            encoder_error(truth, lines), truth.g_theta, atol=1e-18
        )
        asked = np.array([0.1, 2.3, 5.0])
        np.testing.assert_allclose(
            encoder_error(truth, asked + 2 * np.pi),
            encoder_error(truth, asked),
            atol=1e-16,
        )
        found.append(truth.g_theta)
    cover = np.mean(
        [np.roll(found, -d, axis=1) * found for d in (0, 3, 6)], axis=(1, 2)
    )
    # the mean, which no encoder has, is taken off what falls as exp(-d^2 / 2 L^2)
    away = np.minimum(np.arange(24), 24 - np.arange(24))
    want = np.exp(-(away**2) / 18)
    want = (want - want.mean()) / (want - want.mean())[0]
    np.testing.assert_allclose(cover / cover[0], want[[0, 3, 6]], atol=0.06)
    assert cover[0] == pytest.approx(LONG.g_theta_rad**2, rel=0.1)
