# SPDX-License-Identifier: Apache-2.0
"""U between the nodes of maps of smooth stages: waves of 4 pitches and longer, known everywhere."""

import numpy as np
import pytest

from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import (
    CELL_MEAN,
    ErrorMap,
    error_at_edges,
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


def edge_departures(size, pitches, rise_m, begins, noise_m=NOISE_M, runs=20):
    """Return shares in 2 u of the three cells at the last column, and the sizes at all edges.

    Gx rises there as the square, from `begins` pitches before the column on.
    """
    artifact, shares, edges = Artifact(size, PITCH_M), [], []
    last = artifact.half[0] * PITCH_M
    for seed in range(runs):
        rng, smooth = np.random.default_rng([seed, 2]), stage(seed, pitches)

        def error(x, y, smooth=smooth):
            inside, gy = smooth(x, y)
            beyond = np.maximum(x - last + begins * PITCH_M, 0) / (begins * PITCH_M)
            return inside + rise_m * beyond**2, gy

        u = np.full(artifact.shape, noise_m)
        g = [
            part + rng.normal(0, noise_m, artifact.shape)
            for part in error(artifact.x_m, artifact.y_m)
        ]
        used = Compensator(
            ErrorMap(artifact, *g, u, u, np.zeros(0), np.zeros(0)), method="bicubic"
        )
        x = last - (np.arange(3)[:, None] + rng.uniform(0, 1, (3, 100))) * PITCH_M
        y = rng.uniform(-1, 1, (3, 100)) * artifact.half[1] * PITCH_M
        missed = np.abs(used.error(x, y)[0] - error(x, y)[0])
        shares.append(np.mean(missed <= 2 * used.uncertainty(x, y)[0], axis=1))
        edges.append(used.edges)
    return np.mean(shares, axis=0), np.array(edges)


@pytest.mark.parametrize("begins", [0.4, 0.5, 1.0])
@pytest.mark.parametrize(("size", "rise_m"), [(6, 3e-6), (7, 1e-6), (11, 5e-6)])
def test_an_error_that_begins_within_the_last_cell_is_within_u(size, rise_m, begins):
    """Without a size of the edge's own it was 2 to 40 % there, and the spline's echo next to it."""
    shares, edges = edge_departures(size, 14, rise_m, begins)
    assert (shares > 0.95).all()
    assert edges[:, 0, 0, 1] == pytest.approx(rise_m / 2, rel=0.2)
    edges[:, 0, 0, 1] = 0
    assert not edges.any()


@pytest.mark.parametrize("method", ["bilinear", "bicubic"])
@pytest.mark.parametrize("side", [0, 1])
@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("of", [0, 1])
def test_each_edge_of_a_rectangular_field_is_that_of_its_own_cells(
    of, axis, side, method
):
    """Gx or Gy departs at the first or last of 7 columns or 9 rows; U is larger there alone."""
    artifact = Artifact(7, PITCH_M, grid_size_y=9)
    g = np.zeros((2, *artifact.shape))
    np.moveaxis(g[of], axis, 0)[-side] = 1e-6
    u = np.full(artifact.shape, 1e-9)
    used = Compensator(
        ErrorMap(artifact, *g, u, u, np.zeros(0), np.zeros(0)), method=method
    )
    assert list(zip(*used.edges.nonzero(), strict=True)) == [(of, axis, side)]
    edge = np.zeros(2)
    edge[axis] = (2 * side - 1) * (artifact.half[axis] - 0.5)
    across = np.zeros(2)
    across[1 - axis] = artifact.half[1 - axis] - 0.5
    at_edge, opposite, beside = (
        used.uncertainty(*(place * PITCH_M))[of] for place in (edge, -edge, across)
    )
    assert at_edge > 0.45e-6
    assert max(opposite, beside) < at_edge / 2


@pytest.mark.parametrize("noise_m", [1e-9, 3e-8, 3e-7])
@pytest.mark.parametrize(("size", "pitches"), [(5, 5), (6, 5), (7, 4), (9, 8), (13, 4)])
def test_the_edges_of_smooth_stages_have_no_size_of_their_own(size, pitches, noise_m):
    _, edges = edge_departures(size, pitches, 0.0, 0.5, noise_m, runs=40)
    assert not edges.any()


def test_an_edge_is_told_from_its_known_nodes_and_another_axis_is_not_asked():
    values = np.zeros((7, 5))
    values[0] = [np.nan, 3e-7, np.nan, 4e-7, np.nan]
    u = np.full(values.shape, 1e-9)
    assert error_at_edges(values, u) == pytest.approx(
        [np.sqrt(12.5) * 0.5e-7, 0], rel=1e-3
    )
    assert not error_at_edges(values[:5], u[:5]).any()  # one row inside tells nothing
    assert not error_at_edges(np.full((7, 5), np.nan), u).any()
    assert not error_at_edges(np.moveaxis(values, 0, 1), u.T).any()


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
