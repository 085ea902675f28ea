# SPDX-License-Identifier: Apache-2.0
"""The map as one picture: PNG, SVG and PDF of the figures that the report shows."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread

from selfcal_ros.errors import InputError
from selfcal_ros.reporting.figures import paper
from selfcal_ros.reporting.figures.drawing import Discs, Drawing, Label, Path
from selfcal_ros.reporting.figures.maps import angular_map, error_map, map_picture
from selfcal_ros.reporting.figures.paper import drawable, save_picture
from test.support.results import known_result


@pytest.fixture
def coarse(monkeypatch):
    """Draw few pixels, in tests that do not count them: 40 an inch."""
    monkeypatch.setattr(paper, "DPI", 40)


@pytest.mark.parametrize(("size", "lines"), [(3, 0), (5, 720)])
def test_png_of_any_size(tmp_path, size, lines):
    result, truth = known_result(size, lines)
    drawing = map_picture(result, truth)
    save_picture(drawing, tmp_path / "map.png")
    height, width = imread(tmp_path / "map.png").shape[:2]
    assert (width, height) == pytest.approx(
        (drawing.width * 150 / 72, drawing.height * 150 / 72), abs=1
    )
    assert (width > 2000) == (lines > 0)
    assert list(tmp_path.iterdir()) == [tmp_path / "map.png"]


def test_what_is_drawn_at_the_edge_of_a_figure_has_a_margin_in_a_file(tmp_path):
    drawing = Drawing("corner", "", 200, 100)
    drawing.label(0, 16, "Title", size=13, bold=True)
    save_picture(drawing, tmp_path / "corner.png")
    pixels = imread(tmp_path / "corner.png")[..., :3]
    columns = np.flatnonzero((pixels < 0.5).any(axis=(0, 2)))
    assert 0.015 < columns[0] / pixels.shape[1] < 0.04


def test_the_picture_holds_the_figures_of_the_report_beside_each_other():
    """That the same input gives the same bytes is tested with the verb, for every form."""
    result, truth = known_result(5, 8)
    found = map_picture(result, truth)
    figures = error_map(result, truth), angular_map(result, truth)
    # two lines, origin
    assert len(found.items) == sum(len(figure.items) for figure in figures) + 3
    shapes = [item for item in found.items if isinstance(item, Path)]
    alone = [
        item for figure in figures for item in figure.items if isinstance(item, Path)
    ]
    moves = [
        np.subtract(a.lines[0][0], b.lines[0][0])
        for a, b in zip(shapes, alone, strict=True)
    ]
    count = sum(isinstance(item, Path) for item in figures[0].items)
    np.testing.assert_allclose(moves[:count], np.broadcast_to(moves[0], (count, 2)))
    np.testing.assert_allclose(
        moves[count:], np.broadcast_to(moves[-1], (len(moves) - count, 2))
    )
    assert moves[-1][0] - moves[0][0] >= figures[0].width and moves[0][
        1
    ] == pytest.approx(moves[-1][1])
    for kind in (Discs, Label):
        assert (
            min(
                at[0]
                for item in found.items
                if isinstance(item, kind)
                for at in (item.centres if kind is Discs else [item.at])
            )
            >= moves[0][0]
        )


@pytest.mark.parametrize("value", [np.nan, 0.0, 1e-30, 1e300])
def test_maps_without_size_and_of_absurd_size_are_drawn(tmp_path, coarse, value):
    result, _ = known_result(3, 8)
    field, lines = np.full((3, 3), value), np.full(8, value)
    emap = replace(
        result.error_map,
        gx=field,
        gy=field,
        u_gx=field,
        u_gy=field,
        g_theta=lines,
        u_g_theta=lines,
    )
    if value == 1e300:
        emap = replace(
            emap, gx=field * 1e-302, gy=field * 1e-302, g_theta=lines * 1e-302
        )
    with np.errstate(over="ignore", invalid="ignore"):
        save_picture(map_picture(replace(result, error_map=emap)), tmp_path / "map.png")
    assert imread(tmp_path / "map.png").shape[0] > 200


def test_text_of_the_user_is_drawn_as_it_is(tmp_path, coarse):
    result, _ = known_result(3, 0)
    save_picture(
        map_picture(
            replace(result, plan_id=r"$\frac{ $ 長 \x", input={"file": "$a_$"})
        ),
        tmp_path / "map.png",
    )
    assert drawable("a\nb 長 θ$") == "a?b ? θ$"
    assert drawable("x" * 400, 10) == "x" * 9 + "…"


def test_unusable_truth_names_and_folders_are_refused(tmp_path):
    result, truth = known_result(3, 0)
    with pytest.raises(InputError, match=r"^truth gx: has the shape \(5, 5\)"):
        map_picture(result, {**truth, "gx": np.zeros((5, 5))})
    drawing = Drawing("a", "b", 10, 10)
    with pytest.raises(
        InputError, match=r"map\.jpg: not a picture format by its suffix"
    ):
        save_picture(drawing, tmp_path / "map.jpg")
    with pytest.raises(InputError, match=r"none/a\.png: cannot be written"):
        save_picture(drawing, tmp_path / "none" / "a.png")
    assert list(tmp_path.iterdir()) == []
