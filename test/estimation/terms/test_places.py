# SPDX-License-Identifier: Apache-2.0
"""Where the stage stood, and what its error is there."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline

from selfcal_ros.estimation.lattice.readings import grid_data
from selfcal_ros.estimation.terms.places import _filled, places_of
from selfcal_ros.estimation.terms.visits import term_inputs
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import GridVisits, Measurements, Sense, ViewReadings
from selfcal_ros.model.view import View

N, PITCH_M = 7, 0.01
STEPS = np.arange(N) - N // 2
SITES = STEPS * PITCH_M
FIELD = np.random.default_rng(1).normal(0, 1e-6, (2, N, N))
TURN_RAD = np.array([1e-3, -2e-3])


def readings(stands_m, sense=Sense.MICROSCOPE_MOVES):
    """Return two views, each mark visited twice; the stage stands off its site by `stands_m`."""
    m, n = (array.ravel() for array in np.meshgrid(STEPS, STEPS, indexing="ij"))
    views = []
    for quarter in (0, 1):
        offset = np.random.default_rng(quarter).normal(0, 1e-5, (2, 2 * N * N))
        away = np.tile(stands_m, N * N)
        deviation = offset + (-away if sense is Sense.PLATE_MOVES else away)
        mark, one = np.repeat(np.arange(N * N), 2), np.ones(2 * N * N, dtype=int)
        visits = GridVisits(
            mark,
            *deviation,
            one,
            np.arange(2 * N * N) * 10**9,
            *offset,
            0 * one.astype("i1"),
            0 * one.astype("i1"),
        )
        mean = deviation.reshape(2, -1, 2).mean(axis=2)
        views.append(
            ViewReadings(
                View(f"{quarter}", quarter * np.pi / 2),
                m,
                n,
                *mean,
                np.full(N * N, 2),
                visits=visits,
            )
        )
    return Measurements("places", Artifact(N, PITCH_M, 0), tuple(views), sense)


def found_in(measurements, known=None):
    grid = grid_data(measurements)
    known = np.ones((N, N), dtype=bool) if known is None else known
    return places_of(measurements, grid, term_inputs(measurements, grid), known)


def stands(x, y):
    """Return two visits, 20 um to either side along x."""
    return np.array([[x - 2e-5, x + 2e-5], [y, y]])


def error_at(x_m, y_m, field=FIELD):
    return sum(
        unit * RectBivariateSpline(SITES, SITES, part).ev(x_m, y_m)
        for unit, part in zip((1, 1j), field, strict=True)
    )


@pytest.mark.parametrize("sense", Sense)
def test_the_error_is_that_of_the_true_place_in_the_stage_frame(sense):
    """With plate_moves the equations have H(X) = -G(-X), and the stage stands at -X."""
    places = found_in(readings(stands(1.2e-3, -0.7e-3), sense))
    sign = -1 if sense is Sense.PLATE_MOVES else 1
    h = sign * FIELD[:, ::sign, ::sign]
    field = h[0] + 1j * h[1]
    near = places.errors(field, places.differences(field))
    moved = places.differences(field, near)
    at = np.flatnonzero(
        (np.abs(places.site // N - 3) < 3) & (np.abs(places.site % N - 3) < 3)
    )
    x, y = sign * SITES[places.site[at] // N], sign * SITES[places.site[at] % N]
    true = x + 1.2e-3 + 1j * (y - 0.7e-3) - sign * near[at]  # indicated less the error
    wanted = sign * (error_at(true.real, true.imag) - error_at(x, y))
    np.testing.assert_allclose(moved[at], wanted, atol=1e-20)
    assert np.abs(wanted).max() > 2e-7


def test_readings_have_it_in_the_frame_of_their_view():
    places = found_in(readings(stands(1e-3, 0.0)))
    moved = np.arange(2 * N * N) + 1j
    changes = places.changes(moved, TURN_RAD)
    assert changes[0, 1, 2] == moved[N + 2] * np.exp(-1j * TURN_RAD[0])
    assert changes[1, 1, 2] == pytest.approx(
        -1j * moved[N * N + N + 2] * np.exp(-1j * TURN_RAD[1])
    )


def test_visits_differ_by_the_slopes_between_their_places():
    places, field = (
        found_in(readings(stands(1.2e-3, -0.7e-3))),
        FIELD[0] + 1j * FIELD[1],
    )
    near = places.errors(field)
    first, second = places.about(field, near, TURN_RAD)
    at = 3 * N + 4
    x, y = 1.2e-3 - near[at].real, PITCH_M - 0.7e-3 - near[at].imag
    wanted = (
        (error_at(x + 2e-5, y) - error_at(x - 2e-5, y)) / 2 * np.exp(-1j * TURN_RAD[0])
    )
    np.testing.assert_allclose(first[2 * at : 2 * at + 2], [-wanted, wanted], rtol=1e-4)
    turned = N * 2 + 3  # mark (-1, 0), which lies on site (0, -1) after a quarter turn
    y = -PITCH_M - 0.7e-3 - near[N * N + turned].imag
    x = 1.2e-3 - near[N * N + turned].real
    wanted = (
        (error_at(x + 2e-5, y) - error_at(x - 2e-5, y)) / 2j * np.exp(-1j * TURN_RAD[1])
    )
    np.testing.assert_allclose(second[2 * turned + 1], wanted, rtol=1e-4)


def test_beyond_the_outermost_sites_the_spline_goes_on():
    cubic = (SITES[:, None] / 0.03) ** 3 + 0.5j * (SITES / 0.03) ** 2
    places = found_in(readings(stands(2e-3, 2e-3)))
    true = places._place(np.zeros(2 * N * N))
    x, y = ((part - 3) * PITCH_M / 0.03 for part in true)
    assert x.max() > 1 and y.max() > 1
    moved = places.differences(cubic, np.zeros(2 * N * N))
    np.testing.assert_allclose(
        moved + cubic.reshape(-1)[places.site], x**3 + 0.5j * y**2, atol=1e-14
    )


def test_a_stage_is_beside_its_sites_or_no_visit_tells():
    assert not found_in(readings(stands(0.0, 0.9e-7) * 0.004)).beside
    # as the mean of its visits
    assert not found_in(readings(stands(0.0, 0.0))).beside
    assert found_in(readings(stands(0.0, 1.1e-7))).beside
    whole = readings(stands(1e-3, 0.0))
    none = tuple(replace(view, visits=None) for view in whole.views)
    assert found_in(replace(whole, views=none)) is None
    half = found_in(replace(whole, views=(none[0], whole.views[1])))
    assert set(half.at[0]) == {1} and half.about_m[0] is None


def test_unknown_sites_are_on_lines_through_known_ones():
    known = np.random.default_rng(2).random((N, N)) > 0.4
    known[0, :5], known[3], known[:, 2] = False, False, False
    known[5, 5] = True
    plane = (3 * STEPS[:, None] - 2j * STEPS) + 7
    np.testing.assert_allclose(
        _filled(np.where(known, plane, 99), known), plane, atol=1e-13
    )
    one = np.zeros((N, N), dtype=bool)
    one[2, 3] = True
    np.testing.assert_array_equal(_filled(np.where(one, plane, 99), one), plane[2, 3])
    field = FIELD[0] + 1j * FIELD[1]
    np.testing.assert_array_equal(_filled(field, known)[known], field[known])


def test_an_unknown_site_lies_between_its_neighbours():
    """Of m^2 + n^2 the mean of the neighbours on either line is larger by 1."""
    field = (STEPS[:, None] ** 2 + STEPS**2).astype(complex)
    known = np.ones((N, N), dtype=bool)
    known[1, 1] = known[N - 2, 2] = False
    expected = field + ~known
    np.testing.assert_allclose(
        _filled(np.where(known, field, 99), known), expected, atol=1e-13
    )


def test_readings_at_unknown_sites_are_left_alone():
    known = np.ones((N, N), dtype=bool)
    known[0, 0] = False
    places = found_in(readings(stands(1e-3, 0.0)), known)
    assert len(places.away_m) == 2 * N * N - 2 and not (places.site == 0).any()
    field = FIELD[0] + 1j * FIELD[1]
    other = field.copy()
    other[0, 0] = 99.0
    np.testing.assert_array_equal(places.differences(field), places.differences(other))
