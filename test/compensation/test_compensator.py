# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline, RectBivariateSpline

from selfcal_ros.compensation.cells import bicubic_cells, cubic_pieces
from selfcal_ros.compensation.compensator import Compensator
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.error_map import ErrorMap, error_halfway
from test.support.maps import random_map

ARTIFACT = Artifact(11, 0.01, 24)
OBLONG = Artifact(7, 0.01, 8, 5)
MAP = random_map(ARTIFACT, 1)
METHODS = ("bilinear", "bicubic")
OF_MAP = {method: Compensator(MAP, method=method) for method in METHODS}
inside = st.floats(-0.05, 0.05)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("artifact", [ARTIFACT, OBLONG, Artifact(3, 0.02)])
def test_sites_give_the_map_itself(method, artifact):
    emap = random_map(artifact, 2)
    gx, gy = Compensator(emap, method=method).error(artifact.x_m, artifact.y_m)
    np.testing.assert_allclose(gx, emap.gx, rtol=0, atol=1e-20)
    np.testing.assert_allclose(gy, emap.gy, rtol=0, atol=1e-20)


@given(x=inside, y=inside)
def test_bilinear_is_the_weighted_mean_of_four_corners(x, y):
    s, t = x / 0.01 + 5, y / 0.01 + 5
    i, j = min(int(s), 9), min(int(t), 9)
    u, v = s - i, t - j
    for got, field in zip(
        OF_MAP["bilinear"].error(x, y), (MAP.gx, MAP.gy), strict=True
    ):
        want = (
            (1 - u) * (1 - v) * field[i, j]
            + u * (1 - v) * field[i + 1, j]
            + (1 - u) * v * field[i, j + 1]
            + u * v * field[i + 1, j + 1]
        )
        assert got == pytest.approx(want, rel=0, abs=1e-19)


@given(x=inside, y=inside)
def test_bicubic_is_the_interpolating_spline(x, y):
    sites = np.arange(-5, 6) * 0.01
    for got, field in zip(OF_MAP["bicubic"].error(x, y), (MAP.gx, MAP.gy), strict=True):
        assert got == pytest.approx(
            RectBivariateSpline(sites, sites, field).ev(x, y), abs=1e-17
        )


@pytest.mark.parametrize("method", METHODS)
@given(x=st.floats(-0.2, 0.2), y=st.floats(-0.2, 0.2))
def test_correct_undoes_command_anywhere(method, x, y):
    compensator = OF_MAP[method]
    np.testing.assert_allclose(
        compensator.correct(*compensator.command(x, y)), (x, y), rtol=0, atol=1e-16
    )


def test_correct_undoes_command_for_a_steep_map_and_at_sites():
    steep = random_map(ARTIFACT, 3, gain=1500)
    compensator = Compensator(steep)
    got = compensator.correct(*compensator.command(ARTIFACT.x_m, ARTIFACT.y_m))
    np.testing.assert_allclose(got, (ARTIFACT.x_m, ARTIFACT.y_m), rtol=0, atol=1e-15)


def test_the_sign_is_indicated_minus_true():
    one = np.ones(ARTIFACT.shape)
    emap = ErrorMap(
        ARTIFACT, 3e-6 * one, -2e-6 * one, one, one, np.full(24, 1e-4), np.zeros(24)
    )
    compensator = Compensator(emap)
    assert compensator.command(0.01, 0.02) == pytest.approx(
        (0.010003, 0.019998), abs=1e-16
    )
    assert compensator.correct(0.01, 0.02) == pytest.approx(
        (0.009997, 0.020002), abs=1e-16
    )
    assert compensator.command_theta(1.0) == pytest.approx(1.0001, abs=1e-15)
    assert compensator.correct_theta(1.0) == pytest.approx(0.9999, abs=1e-15)


def test_outside_is_clamped_to_the_nearest_point_of_the_edge():
    compensator = Compensator(MAP)
    assert compensator.error(9.0, 0.0) == compensator.error(0.05, 0.0)
    assert compensator.error(-np.inf, -9.0) == compensator.error(-0.05, -0.05)
    assert not compensator.inside(0.0501, 0.0) and compensator.inside(0.05, -0.05)


@pytest.mark.parametrize("call", ["error", "command", "correct", "uncertainty"])
def test_outside_is_refused_on_request(call):
    compensator = Compensator(MAP, outside="refuse")
    getattr(compensator, call)(0.0, 0.0)
    with pytest.raises(
        InputError, match=r"\(0\.06.*outside the calibrated field; stay"
    ):
        getattr(compensator, call)([0.0, 0.06], [0.0, 0.01])


def test_the_edge_belongs_to_the_field_in_both_directions():
    compensator = Compensator(MAP, outside="refuse")
    edge = compensator.command(0.05, -0.05)
    np.testing.assert_allclose(
        compensator.correct(*edge), (0.05, -0.05), rtol=0, atol=1e-16
    )


def test_nan_positions_give_nan_and_leave_the_others_alone():
    gx, _ = Compensator(MAP).error([np.nan, 0.012], 0.0)
    tx, ty = Compensator(MAP).correct([np.nan, 0.012], 0.0)
    assert (
        np.isnan([gx[0], tx[0], ty[0]]).all()
        and np.isfinite([gx[1], tx[1], ty[1]]).all()
    )


def test_what_is_not_known_is_nan_and_not_outside():
    holed = Compensator(random_map(ARTIFACT, 3, unknown=[(5, 5)]), outside="refuse")
    for call in ("error", "command", "correct"):
        assert np.isnan(getattr(holed, call)(0.002, 0.002)).all()
    for call in ("error", "command", "correct", "uncertainty"):
        assert np.isnan(getattr(holed, call)(np.nan, 0.02)[0])
        with pytest.raises(InputError, match=r"\(0\.06.*, 0\.0"):
            getattr(holed, call)([np.nan, 0.06], [0.0, 0.01])


@pytest.mark.parametrize("method", METHODS)
def test_nan_positions_do_not_spoil_the_precision_of_the_others(method):
    rng = np.random.default_rng(5)
    compensator = Compensator(random_map(ARTIFACT, 3, gain=1000), method=method)
    x, y = rng.uniform(-0.05, 0.05, (2, 500))
    q = np.array(compensator.command(x, y))
    q[:, ::50] = np.nan
    known = np.isfinite(q[0])
    got = np.array(compensator.correct(*q))
    assert np.isnan(got[:, ~known]).all()
    np.testing.assert_allclose(
        got[:, known], np.stack([x, y])[:, known], rtol=0, atol=1e-15
    )


def test_unknown_sites_do_not_spoil_the_precision_of_the_others():
    compensator = Compensator(random_map(ARTIFACT, 3, gain=1000, unknown=[(5, 5)]))
    x, y = np.random.default_rng(5).uniform(-0.05, 0.05, (2, 500))
    far = np.hypot(x, y) > 0.02
    got = np.array(compensator.correct(*compensator.command(x, y)))
    np.testing.assert_allclose(
        got[:, far], np.stack([x, y])[:, far], rtol=0, atol=1e-15
    )


def test_an_unknown_site_spoils_its_cells_but_not_its_neighbours():
    emap = random_map(ARTIFACT, 4, unknown=[(5, 5)])
    compensator = Compensator(emap)
    gx, gy = compensator.error(ARTIFACT.x_m, ARTIFACT.y_m)
    np.testing.assert_allclose(gx, emap.gx, rtol=0, atol=1e-20)
    np.testing.assert_allclose(gy, emap.gy, rtol=0, atol=1e-20)
    assert np.isnan(compensator.error(0.001, -0.001)).all()
    assert np.isfinite(compensator.error(0.01, 0.005)).all()
    assert np.isnan(compensator.correct(0.001, -0.001)).all()


def test_bicubic_refuses_unknown_sites_and_lines():
    with pytest.raises(InputError, match="1 sites are unknown; bicubic needs all"):
        Compensator(random_map(ARTIFACT, 4, unknown=[(5, 5)]), method="bicubic")
    emap = random_map(ARTIFACT, 4)
    emap.g_theta[3] = np.nan
    with pytest.raises(InputError, match="1 angular lines are unknown"):
        Compensator(emap, method="bicubic")
    at = Compensator(emap).error_theta(np.arange(24) * np.pi / 12)
    np.testing.assert_allclose(at, emap.g_theta, rtol=1e-9)
    assert np.isnan(Compensator(emap).error_theta(3.5 * np.pi / 12))


@pytest.mark.parametrize("method", METHODS)
@given(theta=st.floats(-50, 50), turns=st.integers(-3, 3))
def test_theta_is_periodic_and_inverts(method, theta, turns):
    compensator = OF_MAP[method]
    assert compensator.error_theta(theta + 2 * np.pi * turns) == pytest.approx(
        compensator.error_theta(theta), abs=1e-14
    )
    assert compensator.correct_theta(compensator.command_theta(theta)) == pytest.approx(
        theta, abs=3e-14
    )


@pytest.mark.parametrize("method", METHODS)
def test_theta_gives_the_lines_themselves_and_the_mean_between_them(method):
    compensator = Compensator(MAP, method=method)
    lines = np.arange(-24, 48)
    np.testing.assert_allclose(
        compensator.error_theta(lines * np.pi / 12),
        MAP.g_theta[lines % 24],
        rtol=0,
        atol=1e-16,
    )
    if method == "bilinear":
        assert compensator.error_theta(-np.pi / 24) == pytest.approx(
            (MAP.g_theta[23] + MAP.g_theta[0]) / 2, abs=1e-16
        )
        assert compensator.uncertainty_theta(-np.pi / 24) == pytest.approx(
            np.hypot(
                (MAP.u_g_theta[23] + MAP.u_g_theta[0]) / 2,
                error_halfway(MAP.g_theta, MAP.u_g_theta, ring=True)[0],
            )
        )
        assert compensator.uncertainty_theta(-np.pi / 12) == pytest.approx(
            MAP.u_g_theta[23]
        )


def test_uncertainty_is_that_of_the_sites_and_a_bound_between_them():
    compensator = Compensator(MAP)
    ux, uy = compensator.uncertainty(ARTIFACT.x_m, ARTIFACT.y_m)
    np.testing.assert_allclose(ux, MAP.u_gx, rtol=1e-12)
    np.testing.assert_allclose(uy, MAP.u_gy, rtol=1e-12)
    compensator.halfway = np.zeros((2, 2))
    assert compensator.uncertainty(0.005, 0.0)[0] == pytest.approx(
        MAP.u_gx[5:7, 5].mean()
    )


def test_bicubic_uncertainty_exceeds_that_of_the_sites_in_the_outermost_cells_only():
    # Variances of independent sites add up with the squares of the weights that each site has;
    # those along x and y multiply.
    x = np.linspace(-0.05, 0.05, 401)
    weights = []
    for site in range(11):
        g = np.zeros(ARTIFACT.shape)
        g[site] = 1e-6
        emap = ErrorMap(ARTIFACT, g, 0 * g, 0 * g, 0 * g, np.zeros(24), np.zeros(24))
        weights.append(Compensator(emap, method="bicubic").error(x, 0.0)[0] / 1e-6)
    # of the variance along x, of the u over the field
    ratio = np.sum(np.square(weights), axis=0)
    assert ratio[np.abs(x) <= 0.04 + 1e-9].max() < 1.01
    assert 1.37 < ratio.max() < 1.38


def test_a_map_without_lines_says_so():
    compensator = Compensator(random_map(Artifact(5, 0.01), 1))
    assert not compensator.has_theta
    for call in ("error_theta", "command_theta", "correct_theta", "uncertainty_theta"):
        with pytest.raises(InputError, match="it has no angular lines"):
            getattr(compensator, call)(0.0)


@pytest.mark.parametrize("words", [{"method": "spline"}, {"outside": "extrapolate"}])
def test_unknown_words_are_refused(words):
    with pytest.raises(InputError, match="is unknown; use"):
        Compensator(MAP, **words)


def test_lines_that_are_known_only_here_and_there():
    emap = random_map(ARTIFACT, 4)
    emap.g_theta[::2] = np.nan
    compensator = Compensator(emap)
    assert compensator.error_theta(np.pi / 12) == pytest.approx(emap.g_theta[1])
    assert np.isnan(compensator.correct_theta(np.pi / 12))
    emap.g_theta[:] = np.nan
    assert np.isnan(Compensator(emap).error_theta(0.0))


def test_a_map_in_the_wrong_unit_is_refused():
    with pytest.raises(InputError, match=r"neighbouring sites .* cannot be inverted"):
        Compensator(random_map(ARTIFACT, 1, gain=1e6))
    emap = random_map(ARTIFACT, 1)
    emap.g_theta[2] = 20.0
    with pytest.raises(InputError, match="angular lines"):
        Compensator(emap)


def checked(step, lines=0.0):
    """Return a map that jumps by `step` pitches from site to site, `lines` from line to line."""
    sign = (-1.0) ** np.add.outer(np.arange(11), np.arange(11))
    g = sign * step * ARTIFACT.grid_pitch_m / 2
    theta = (-1.0) ** np.arange(24) * lines * np.pi / 24
    return ErrorMap(ARTIFACT, g, -g, 0 * g, 0 * g, theta, 0 * theta)


def test_a_spline_that_is_too_steep_between_its_sites_is_refused():
    # Between the sites the spline is steeper than from site to site: at steps of 0.24 pitches the
    # fixed point did not come to rest, and the inverse erred by millimetres without a word.
    x, y = np.random.default_rng(6).uniform(-0.05, 0.05, (2, 2000))
    Compensator(checked(0.24, 0.24))
    with pytest.raises(
        InputError, match="spline between the sites is steeper than one half"
    ):
        Compensator(checked(0.24), method="bicubic")
    compensator = Compensator(checked(0.05, 0.24), method="bicubic")
    back = compensator.correct(*compensator.command(x, y))
    np.testing.assert_allclose(back, (x, y), rtol=0, atol=1e-16)
    theta = np.linspace(-4, 4, 99)
    np.testing.assert_allclose(
        compensator.correct_theta(compensator.command_theta(theta)),
        theta,
        rtol=0,
        atol=4e-15,
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_largest_slope_of_the_spline(seed):
    rng = np.random.default_rng(seed)
    cells = bicubic_cells(rng.normal(size=(2, 7, 5)))
    s, t = np.meshgrid(
        np.linspace(1e-5, 6 - 1e-5, 301), np.linspace(1e-5, 4 - 1e-5, 201)
    )
    s, t = s.ravel(), t.ravel()
    step = 1e-6
    slopes = [
        np.abs(np.subtract(cells.at(s + a, t + b), cells.at(s - a, t - b))) / (2 * step)
        for a, b in ((step, 0), (0, step))
    ]
    assert cells.steepest() == pytest.approx(np.max(slopes[0] + slopes[1]), rel=0.1)


def test_scalars_and_shapes_come_back_as_they_were():
    compensator = Compensator(MAP)
    assert compensator.command(0.0, 0.0)[0].shape == ()
    x, y = compensator.correct(np.zeros((3, 1)), np.zeros(4))
    assert x.shape == y.shape == (3, 4)


POSITIONS = st.one_of(
    st.floats(-0.2, 0.2), st.sampled_from([-0.05, -0.01, 0.0, 0.03, 0.05, 1e9])
)
HOLES = random_map(ARTIFACT, 1, unknown=[(4, 5), (0, 0)])
OF_POINTS = {
    **OF_MAP,
    "unknown": Compensator(HOLES),
    "oblong": Compensator(random_map(OBLONG, 2)),
}


@pytest.mark.parametrize("which", OF_POINTS)
@given(x=POSITIONS, y=POSITIONS)
def test_a_point_is_corrected_to_the_bit_as_an_array_of_one(which, x, y):
    compensator = OF_POINTS[which]
    np.testing.assert_array_equal(
        compensator.correct_point(x, y), compensator.correct(x, y)
    )


@pytest.mark.parametrize("which", OF_POINTS)
@given(theta=st.floats(-20.0, 20.0))
def test_an_angle_is_corrected_to_the_bit_as_an_array_of_one(which, theta):
    compensator = OF_POINTS[which]
    np.testing.assert_array_equal(
        compensator.correct_angle(theta), compensator.correct_theta(theta)
    )


def test_points_outside_are_refused_on_request_and_angles_without_lines():
    refusing = Compensator(MAP, outside="refuse")
    with pytest.raises(InputError, match="outside the calibrated field"):
        refusing.correct_point(0.06, 0.0)
    assert refusing.correct_point(0.049, 0.0) == OF_MAP["bilinear"].correct_point(
        0.049, 0.0
    )
    with pytest.raises(InputError, match="has no angular lines"):
        Compensator(random_map(Artifact(5, 0.01, 0), 1)).correct_angle(0.0)


@pytest.mark.parametrize("periodic", [False, True])
@pytest.mark.parametrize("count", [3, 4, 5, 12])
def test_cubic_pieces_are_those_of_scipy(count, periodic):
    values = np.random.default_rng(count).normal(size=(count, 2))
    closed = np.concatenate([values, values[:1]]) if periodic else values
    want = CubicSpline(
        np.arange(len(closed)), closed, bc_type="periodic" if periodic else "not-a-knot"
    ).c[::-1]
    np.testing.assert_allclose(
        cubic_pieces(values, periodic=periodic), want, atol=1e-14
    )


def test_a_fourier_series_goes_through_the_lines_in_their_order():
    """cos t - 2 sin t + 3 sin 2t in urad, at and between eight lines."""
    plate = Artifact(3, 0.01, 8, harmonics=2)
    wanted = lambda t: 1e-6 * (np.cos(t) - 2 * np.sin(t) + 3 * np.sin(2 * t))  # noqa: E731
    emap, zero = random_map(plate, 1), np.zeros(8)
    stage = Compensator(
        ErrorMap(
            plate, emap.gx, emap.gy, emap.u_gx, emap.u_gy, wanted(plate.theta_rad), zero
        )
    )
    angle = np.linspace(-3, 9, 25)
    np.testing.assert_allclose(stage.error_theta(angle), wanted(angle), atol=1e-18)
    assert stage.correct_angle(0.7 + wanted(0.7)) == pytest.approx(0.7, abs=1e-15)


@pytest.mark.parametrize(("field", "axis"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_the_error_halfway_is_that_of_its_field_along_its_axis(field, axis):
    """One field is a parabola along one axis, which a line misses by its curvature over eight."""
    plate = Artifact(7, 0.01, 0, 9)
    fields = np.zeros((2, 7, 9))
    fields[field] = 1e-3 * (plate.x_m, plate.y_m)[axis] ** 2
    none = np.full((7, 9), 1e-15)
    found = Compensator(
        ErrorMap(plate, *fields, none, none, np.zeros(0), np.zeros(0))
    ).halfway
    assert found[field, axis] > 1e-9
    found[field, axis] = 0
    assert found.max() < 1e-12
