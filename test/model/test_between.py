# SPDX-License-Identifier: Apache-2.0
"""U between the nodes of maps of smooth stages: waves of 4 pitches and longer, known everywhere."""

import numpy as np
import pytest

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import (
    CELL_MEAN,
    ErrorMap,
    error_halfway,
    share_between,
)

PITCH_M, NOISE_M, WAVES = 0.01, 1e-9, 12


def stage(seed, pitches):
    """Return an error of x and y as sums of waves of at least so many pitches, about 1 um."""
    rng = np.random.default_rng(seed)
    k = rng.normal(size=(2, WAVES, 2))
    k *= (
        2
        * np.pi
        / pitches
        * rng.uniform(0.2, 1, (2, WAVES))
        / np.linalg.norm(k, axis=-1)
    )[..., None] / PITCH_M
    phase, size = rng.uniform(0, 2 * np.pi, (2, WAVES)), rng.normal(0, 4e-7, (2, WAVES))
    return lambda x, y: [
        np.sum(
            s
            * np.cos(np.multiply.outer(x, a[:, 0]) + np.multiply.outer(y, a[:, 1]) + p),
            axis=-1,
        )
        for a, p, s in zip(k, phase, size, strict=True)
    ]


def shares_in_u(size, pitches, method):
    """Return the shares of places between the nodes whose error is within 2 u, of 30 stages."""
    artifact, found = Artifact(size, PITCH_M), []
    for seed in range(30):
        rng, error = np.random.default_rng([seed, 1]), stage(seed, pitches)
        g = [
            part + rng.normal(0, NOISE_M, artifact.shape)
            for part in error(artifact.x_m, artifact.y_m)
        ]
        u = np.full(artifact.shape, NOISE_M)
        used = Compensator(
            ErrorMap(artifact, *g, u, u, np.zeros(0), np.zeros(0)), method=method
        )
        x, y = rng.uniform(-1, 1, (2, 200)) * artifact.half[0] * PITCH_M
        found.append(
            np.mean(
                np.abs(np.subtract(used.error(x, y), error(x, y)))
                <= 2 * np.array(used.uncertainty(x, y))
            )
        )
    return np.array(found)


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
@pytest.mark.parametrize(("size", "pitches"), [(9, 5), (11, 4), (11, 8)])
def test_the_stage_is_within_u_between_the_nodes(size, pitches, method):
    assert shares_in_u(size, pitches, method).mean() > 0.94


def test_a_bicubic_map_of_a_smooth_stage_is_worth_more_between_the_nodes():
    artifact, error = Artifact(11, PITCH_M), stage(3, 6)
    u = np.zeros(artifact.shape)
    emap = ErrorMap(
        artifact, *error(artifact.x_m, artifact.y_m), u, u, np.zeros(0), np.zeros(0)
    )
    linear, cubic = (
        Compensator(emap, method=method).halfway for method in ("bilinear", "bicubic")
    )
    assert (cubic < 0.3 * linear).all() and (cubic > 0).all()
    assert not Compensator(emap, method="bicubic", fitted="bicubic").halfway.any()
    assert (Compensator(emap, fitted="bicubic").halfway == linear).all()


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
def test_a_map_with_x_and_y_exchanged_has_its_errors_between_nodes_exchanged(method):
    rng, artifact, other = (
        np.random.default_rng(5),
        Artifact(9, PITCH_M, 0, 7),
        Artifact(7, PITCH_M, 0, 9),
    )
    g = rng.normal(0, 1e-7, (2, *artifact.shape))
    u = 1e-8 * rng.uniform(1, 9, (2, *artifact.shape))
    one = ErrorMap(artifact, *g, *u, np.zeros(0), np.zeros(0))
    exchanged = ErrorMap(
        other, g[1].T, g[0].T, u[1].T, u[0].T, np.zeros(0), np.zeros(0)
    )
    found = Compensator(one, method=method).halfway
    assert found.any()
    assert Compensator(exchanged, method=method).halfway == pytest.approx(
        found[::-1, ::-1]
    )


def test_a_parabola_and_a_fourth_power_have_the_error_of_their_formula():
    """c s^2: c / 4 halfway. s^4 through four nodes: 9 over two pitches, 9/16 over one."""
    s = np.linspace(-4, 4, 9)
    assert error_halfway(3 * s**2, 0 * s) == pytest.approx((0.75, 0.75))
    assert error_halfway(3 * s[:3] ** 2, 0 * s[:3]) == pytest.approx((0.75, 0.75))
    assert error_halfway(s[:6] ** 2, 0 * s[:6], cubic=True) == pytest.approx(
        (0.25, 0.25)
    )
    assert error_halfway(s**3, 0 * s, cubic=True) == pytest.approx((0, 0), abs=1e-12)
    wide = np.linspace(-4, 4, 9) + 1000  # of s^2 what is left of s^4 is small: smooth
    assert error_halfway(wide**4, 0 * s, cubic=True)[0] == pytest.approx(
        9 / 16, rel=1e-3
    )


def test_independent_nodes_know_nothing_of_what_lies_between_them():
    values = np.random.default_rng(6).normal(0, 1e-6, (101, 101))
    linear, cubic = (
        error_halfway(values, 0 * values, cubic=cubic)[0] for cubic in (False, True)
    )
    assert linear == pytest.approx(np.sqrt(1.5) * 1e-6, rel=0.05)
    assert cubic == pytest.approx(np.sqrt(1 + 164 / 256) * 1e-6, rel=0.05)


def test_noise_alone_is_no_error_of_interpolation():
    rng = np.random.default_rng(5)
    for cubic in (False, True):
        values = rng.normal(0, 2e-9, (201, 41))
        found, _ = error_halfway(values, np.full(values.shape, 2e-9), cubic=cubic)
        assert found < 0.3 * 2e-9


@pytest.mark.parametrize("cubic", [False, True])
def test_each_node_of_a_ring_counts_once(cubic):
    """Of a harmonic, cos(a) for a mean over two steps a: 1 - cos(2 a) over four, times cos."""
    wave, a = np.sin(2 * np.pi * np.arange(8) / 8), np.pi / 4
    left = 1 - np.cos(a) if not cubic else 1 - 9 / 8 * np.cos(a) + np.cos(3 * a) / 8
    shrunk = ((1 - np.cos(a)) / (1 - np.cos(2 * a))) ** (2 if cubic else 1)
    found = error_halfway(wave, 0 * wave, cubic=cubic, ring=True)
    assert found == pytest.approx((shrunk * left / np.sqrt(2), shrunk * left))
    for steps in range(8):
        assert error_halfway(
            np.roll(wave, steps), 0 * wave, cubic=cubic, ring=True
        ) == pytest.approx(found)


def test_unknown_nodes_are_left_out():
    values = np.arange(9.0) ** 2
    values[4] = np.nan
    assert error_halfway(values, 0 * values) == pytest.approx((0.25, 0.25))
    assert error_halfway(np.full(9, np.nan), np.zeros(9)) == (0.0, 0.0)
    every_second = np.where(np.arange(9) % 2, np.nan, np.arange(9.0) ** 2)
    assert error_halfway(every_second, np.zeros(9)) == (0.0, 0.0)


def test_the_mean_square_is_that_of_the_parabola_over_a_cell():
    s = (np.arange(1000) + 0.5) / 1000
    assert np.mean(share_between(s) ** 2) == pytest.approx(CELL_MEAN, rel=1e-5)
    assert share_between(np.array([0.0, 0.5, 1.0, 7.25])) == pytest.approx(
        [0, 1, 0, 0.75]
    )
