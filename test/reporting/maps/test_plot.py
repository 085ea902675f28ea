# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.quiver import Quiver

from selfcal_ros.errors import InputError
from selfcal_ros.reporting.maps import plot
from selfcal_ros.reporting.maps.plot import save_map_plot
from selfcal_ros.reporting.maps.style import RC, drawable, round_down
from selfcal_ros.reporting.maps.theta import draw_theta
from selfcal_ros.reporting.maps.xy import choose_arrows, draw_error_map
from test.support.results import known_result


@pytest.fixture
def coarse(monkeypatch):
    """Draw few pixels, in tests that do not count them: 40 an inch."""
    monkeypatch.setattr(plot, "DPI", 40)


def drawn(result, draw, **options):
    """Return the axes on which `draw` has drawn the map of `result`."""
    with rc_context(RC):
        polar = {"projection": "polar"} if draw is draw_theta else {}
        axes = Figure(figsize=(6, 6)).add_subplot(**polar)
        draw(axes, result.error_map, **options)
    return axes


def arrows_in(axes):
    return [child for child in axes.get_children() if isinstance(child, Quiver)]


def test_arrows_point_along_the_error_from_their_sites():
    result, truth = known_result(5, 0)
    emap = result.error_map
    true_arrows, arrows = arrows_in(drawn(result, draw_error_map, truth=truth))
    enlarged = 1e3 * choose_arrows(emap).magnification
    np.testing.assert_allclose(arrows.XY, np.stack([emap.artifact.x_m.ravel(),
                                                    emap.artifact.y_m.ravel()], axis=1) * 1e3)
    np.testing.assert_allclose(arrows.U, emap.gx.ravel() * enlarged)
    np.testing.assert_allclose(arrows.V, emap.gy.ravel() * enlarged)
    np.testing.assert_allclose(true_arrows.U, truth["gx"].ravel() * enlarged)


def test_size_map_is_not_transposed():
    result, _ = known_result(5, 0, size_y=3)
    emap = result.error_map
    axes = drawn(result, draw_error_map)
    shown = axes.images[0].get_array()
    assert shown.shape == (3, 5)
    assert shown[0, 4] == pytest.approx(1e6 * np.hypot(emap.gx[4, 0], emap.gy[4, 0]))
    assert axes.images[0].get_extent() == pytest.approx([-25, 25, -15, 15])


def test_unknown_sites_have_no_arrow():
    result, _ = known_result(5, 0)
    gx = result.error_map.gx.copy()
    gx[1, 2] = np.nan
    axes = drawn(replace(result, error_map=replace(result.error_map, gx=gx)), draw_error_map)
    assert len(arrows_in(axes)[0].U) == 24
    assert axes.images[0].get_array().mask[2, 1]


def test_magnification_is_round_and_stated_and_large_fields_are_thinned():
    result, _ = known_result(101, 0)
    chosen = choose_arrows(result.error_map)
    assert chosen.step == 4 and len(chosen.x_mm) <= 27
    assert 0.0 in chosen.x_mm and 0.0 in chosen.y_mm
    title = drawn(result, draw_error_map).get_title()
    assert f"at every 4th site, enlarged {chosen.magnification:,.0f} ×" in title
    lengths = np.hypot(result.error_map.gx, result.error_map.gy)
    assert lengths.max() * chosen.magnification < 2.7 * 4 * 0.01


def test_theta_is_drawn_in_arcsec_and_closes_the_circle():
    result, truth = known_result(5, 24)
    axes = drawn(result, draw_theta, truth=truth)
    measured = next(line for line in axes.lines if line.get_label() == "measured")
    angle, radius = measured.get_data()
    expected = np.rad2deg(result.error_map.g_theta) * 3600
    np.testing.assert_allclose(radius, [*expected, expected[0]])
    np.testing.assert_allclose(np.rad2deg(angle), np.arange(25) * 15)
    known = next(line for line in axes.lines if line.get_label() == "known truth").get_ydata()
    np.testing.assert_allclose(known[:-1], np.rad2deg(truth["g_theta"]) * 3600)
    assert axes.get_rorigin() < axes.get_rmin() < radius.min()


@pytest.mark.parametrize(("size", "lines"), [(3, 0), (5, 720)])
def test_png_of_any_size(tmp_path, size, lines):
    result, truth = known_result(size, lines)
    save_map_plot(result, tmp_path / "map.png", truth=truth)
    height, width = imread(tmp_path / "map.png").shape[:2]
    assert (height, width) == (1170, 2160 if lines else 1200)
    assert list(tmp_path.iterdir()) == [tmp_path / "map.png"]


def test_truth_is_in_the_picture(tmp_path, monkeypatch):
    """That the same input gives the same bytes is tested with the verb, for every form."""
    figures = []
    monkeypatch.setattr(plot, "picture", lambda figure, *_, **__: figures.append(figure) or b"")
    result, truth = known_result(3, 8)
    save_map_plot(result, tmp_path / "a.png")
    save_map_plot(result, tmp_path / "b.png", truth=truth)
    counts = [(len(arrows_in(figure.axes[0])), len(figure.axes[1].lines)) for figure in figures]
    assert counts[1] == (counts[0][0] + 1, counts[0][1] + 1)


@pytest.mark.parametrize("value", [np.nan, 0.0, 1e-30, 1e300])
def test_maps_without_size_and_of_absurd_size_are_drawn(tmp_path, coarse, value):
    result, _ = known_result(3, 8)
    field, lines = np.full((3, 3), value), np.full(8, value)
    emap = replace(result.error_map, gx=field, gy=field, u_gx=field, u_gy=field, g_theta=lines,
                   u_g_theta=lines)
    if value == 1e300:
        emap = replace(emap, gx=field * 1e-302, gy=field * 1e-302, g_theta=lines * 1e-302)
    with np.errstate(over="ignore", invalid="ignore"):
        save_map_plot(replace(result, error_map=emap), tmp_path / "map.png")
    assert imread(tmp_path / "map.png").shape[0] == 312


def test_text_of_the_user_is_drawn_as_it_is(tmp_path, coarse):
    result, _ = known_result(3, 0)
    save_map_plot(replace(result, plan_id=r"$\frac{ $ 長 \x", input={"file": "$a_$"}),
                  tmp_path / "map.png")
    assert drawable("a\nb 長 θ$") == "a?b ? θ$"
    assert drawable("x" * 400, 10) == "x" * 9 + "…"


def test_unusable_truth_and_folder_are_refused_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(plot, "picture", lambda *_, **__: b"drawn")
    result, truth = known_result(3, 0)
    with pytest.raises(InputError, match=r"^truth gx: has the shape \(5, 5\)"):
        save_map_plot(known_result(3)[0], tmp_path / "a.png", truth={**truth,
                                                                     "gx": np.zeros((5, 5))})
    with pytest.raises(InputError, match=r"none/a\.png: cannot be written"):
        save_map_plot(result, tmp_path / "none" / "a.png")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("value", "rounded"), [(1, 1), (1.99, 1), (2, 2), (4.9, 2), (5, 5),
                                                (9.99, 5), (19564, 10000), (0.0021, 0.002)])
def test_round_numbers(value, rounded):
    assert round_down(value) == pytest.approx(rounded)


def test_a_map_without_one_known_site_says_so():
    result, _ = known_result(3, 0)
    nothing = np.full((3, 3), np.nan)
    axes = drawn(replace(result, error_map=replace(result.error_map, gx=nothing)), draw_error_map)
    assert axes.get_title() == "XY error: not one site is known" and arrows_in(axes) == []
