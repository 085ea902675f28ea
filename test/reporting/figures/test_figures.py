# SPDX-License-Identifier: Apache-2.0
"""Figures show what they say, where they say it, and nothing of them is cut off."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.parts import (
    Parts,
    RejectedAt,
    ResidualsOfViews,
    ViewCourse,
    ViewResiduals,
)
from selfcal_ros.model.verdict import ModelResult, TermEstimate, TermResult
from selfcal_ros.model.view import View
from selfcal_ros.reporting.figures.drawing import (
    COLOURS,
    Discs,
    Drawing,
    Frame,
    Label,
    Path,
    Spot,
    round_down,
    round_step,
    round_ticks,
)
from selfcal_ros.reporting.figures.maps import (
    CENTRE,
    ZERO,
    angular_map,
    component_maps,
    error_map,
)
from selfcal_ros.reporting.figures.parts import Scale, levels, ordinal, range_scale
from selfcal_ros.reporting.figures.places import plan_figure, rejected_in, rejected_map
from selfcal_ros.reporting.figures.residuals import (
    courses,
    distributions,
    drift_found,
    residual_maps,
    residuals_in,
)
from selfcal_ros.reporting.figures.svg import inline_svg, svg_file
from test.support.drawings import cut_off, words_on_words
from test.support.results import chapters_of, known_result, with_residuals


def drawn(result, truth=None):
    return [
        figure.drawing
        for chapter in chapters_of(result, truth)
        for figure in chapter.figures
    ]


def long_names(result):
    """Return a result whose views have long names, and one that has a model with a drift."""
    views = tuple(
        replace(v, name=f"{v.name} of the third repetition on Monday morning")
        for v in result.views
    )
    rows = tuple(
        replace(row, view=view.name)
        for row, view in zip(result.parts.residuals.views, views, strict=True)
    )
    estimates = tuple(
        TermEstimate(v.name, f"{axis} P{n}", 1e-7 / n, 1e-9, "m")
        for v in views
        for axis in "xy"
        for n in (1, 2)
    )
    return replace(
        result,
        views=views,
        model=ModelResult("rigid", (TermResult("drift", None, estimates),)),
        parts=replace(result.parts, residuals=ResidualsOfViews(rows)),
    )


RESULTS = {
    "usual": lambda: with_residuals(11, 24),
    "smallest": lambda: with_residuals(3, 4),
    "wide": lambda: with_residuals(9, 8, size_y=5),
    "large": lambda: known_result(51, 360)[0],
    "long names": lambda: long_names(with_residuals()),
    "huge errors": lambda: replace(
        known_result(5, 8)[0],
        error_map=replace(known_result(5, 8)[0].error_map, gx=np.full((5, 5), 123.456)),
    ),
}


@pytest.mark.parametrize("name", RESULTS)
def test_nothing_lies_outside_of_a_figure(name):
    figures = drawn(RESULTS[name]())
    assert len(figures) >= 3
    for drawing in figures:
        assert cut_off(drawing) == [], drawing.name


@pytest.mark.parametrize("name", RESULTS)
def test_words_do_not_lie_on_each_other(name):
    for drawing in drawn(RESULTS[name]()):
        assert words_on_words(drawing) == [], drawing.name


def shafts(drawing, colour="ink", width=1.2):
    """Return the vectors (start, end) drawn in a colour and width, map frame left out."""
    return [
        line
        for item in drawing.items
        if isinstance(item, Path) and (item.stroke, item.width) == (colour, width)
        for line in item.lines
    ]


def test_vectors_begin_at_their_sites_and_point_along_the_error():
    result, _ = known_result(5, 0, size_y=3)
    emap = result.error_map
    drawing = error_map(result)
    factor = float(
        next(
            re.search(r"enlarged ([\d,]+) ×", i.text)[1].replace(",", "")
            for i in drawing.items
            if isinstance(i, Label) and "enlarged" in i.text
        )
    )
    vectors = np.array(shafts(drawing))
    assert vectors.shape == (15, 2, 2)
    starts, ends = vectors[:, 0], vectors[:, 1]
    # pixels of a pitch, from neighbouring sites: x to the right, y upwards
    pitch = starts[3, 0] - starts[0, 0]
    assert pitch > 0 and starts[1, 1] - starts[0, 1] == pytest.approx(-pitch)
    scale = pitch / emap.artifact.grid_pitch_m * factor
    np.testing.assert_allclose(
        ends[:, 0] - starts[:, 0], emap.gx.ravel() * scale, atol=1e-9
    )
    np.testing.assert_allclose(
        ends[:, 1] - starts[:, 1], -emap.gy.ravel() * scale, atol=1e-9
    )


def test_residuals_of_a_turned_view_stand_where_its_marks_lie():
    """Mark (1, 0) of a plate turned by 90 degrees lies on the stage at (0, 1)."""
    result = with_residuals(3, 0)
    only = np.full((3, 3), np.nan)
    only[2, 1] = 1e-8
    rows = [ViewResiduals(v.name) for v in result.views]
    rows[1] = replace(rows[1], dx=only, dy=np.where(np.isnan(only), np.nan, 0.0))
    turned = replace(result, parts=Parts(ResidualsOfViews(tuple(rows))))
    assert math.degrees(turned.views[1].rotation) == pytest.approx(90)
    drawing = residual_maps(turned, residuals_in(turned))
    box = next(
        i
        for i in drawing.items
        if isinstance(i, Path) and i.stroke == "soft" and len(i.lines[0]) == 5
    ).lines[0]
    centre = np.mean(box[:4], axis=0)
    ((start, end),) = shafts(drawing, width=0.9)
    assert start[0] == pytest.approx(centre[0])
    assert start[1] < centre[1] - 20
    assert end[0] > start[0] + 5 and end[1] == pytest.approx(start[1])


@pytest.mark.parametrize(
    ("value", "step"),
    [(0.0, 0), (0.0999, 0), (0.1001, 1), (0.95, 9), (1.0, 9), (7.0, 9), (np.nan, -1)],
)
def test_steps_of_a_scale_from_zero(value, step):
    assert levels(np.array([value]), Scale("e", 0.0, 1.0)) == [step]
    assert levels(np.array([value + 5]), Scale("e", 5.0, 6.0)) == [step]


@pytest.mark.parametrize(
    ("value", "step"),
    [
        (-2.0, 0),
        (-1.0, 0),
        (-0.11, 4),
        (-0.09, 5),
        (0.09, 5),
        (0.11, 6),
        (1.0, 10),
        (np.nan, -1),
    ],
)
def test_steps_of_a_scale_to_both_sides(value, step):
    assert levels(np.array([value]), Scale("d", -1.0, 1.0)) == [step]


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([0.0231, 0.0362, np.nan], (0.0225, 0.0375)),
        ([3.0, 3.02], (3.02, 3.02)),
        ([np.nan], (0, 0)),
        ([0.0, 1.0], (0.0, 1.0)),
    ],
)
def test_a_scale_over_a_range_shows_the_variation_unless_there_is_none(values, ends):
    scale = range_scale(np.array(values))
    assert (scale.low, scale.high) == pytest.approx(ends)


def fills(drawing, ramp):
    return [
        item.fill
        for item in drawing.items
        if isinstance(item, Path) and re.fullmatch(rf"{ramp}\d+", item.fill)
    ]


def test_components_share_one_scale_and_their_u_another_that_shows_where_it_is_large():
    result, _ = known_result(3, 0)
    gx, gy = np.zeros((2, 3, 3))
    gx[2, 0], gy[0, 2] = 1e-6, -1e-6
    u = np.full((3, 3), 1.5e-8)
    u[1, 1] = 2.5e-8
    emap = replace(result.error_map, gx=gx, gy=gy, u_gx=u, u_gy=u)
    result = replace(result, error_map=emap, noise=replace(result.noise, k_xy=2.28))
    drawing = component_maps(result)
    assert fills(drawing, "d")[:4] == ["d5", "d10", "d0", "d5"]
    assert fills(drawing, "v")[:4] == ["v0", "v9"] * 2
    words = [item.text for item in drawing.items if isinstance(item, Label)]
    assert words[0].endswith("U with k = 2.28") and {"U(Gx)", "U(Gy)", "0.05"} <= set(
        words
    )
    even = replace(
        result,
        error_map=replace(
            emap, u_gx=np.full((3, 3), 1e-7), u_gy=np.full((3, 3), 1.001e-7)
        ),
    )
    drawing = component_maps(even)
    words = [item.text for item in drawing.items if isinstance(item, Label)]
    assert words.count("0.228 µm everywhere") == 2
    assert fills(drawing, "v") == ["v4", "v4"]  # no scale bar


def test_ellipses_are_as_wide_as_u_along_x_and_as_high_as_u_along_y_with_the_k_of_the_result():
    result, _ = known_result(7, 0, size_y=5)
    wide, high = np.full((7, 5), 3e-7), np.full((7, 5), 1e-7)
    result = replace(
        result,
        noise=replace(result.noise, k_xy=2.5),
        error_map=replace(result.error_map, u_gx=wide, u_gy=high),
    )
    drawing = error_map(result)
    (found,) = (
        item
        for item in drawing.items
        if isinstance(item, Discs) and item.fill == "band" and len(item.radii) > 1
    )
    vectors = np.array(shafts(drawing))
    gain = (
        vectors[:, 1, 0] - vectors[:, 0, 0]
    ) / result.error_map.gx.ravel()  # pixels a metre
    np.testing.assert_allclose(found.radii, np.outer(gain, (2.5 * 3e-7, 2.5 * 1e-7)))
    np.testing.assert_allclose(found.centres, vectors[:, 1])
    words = [item.text for item in drawing.items if isinstance(item, Label)]
    assert "U at the nodes, k = 2.5" in words
    told = next(item.title for item in drawing.items if isinstance(item, Spot))
    assert "± 0.75 µm" in told and "± 0.25 µm (k = 2.5)" in told


def test_a_map_without_one_known_site_says_so():
    result, _ = known_result(3, 0)
    nothing = np.full((3, 3), np.nan)
    drawing = error_map(
        replace(result, error_map=replace(result.error_map, gx=nothing))
    )
    assert "no site is known" in [i.text for i in drawing.items if isinstance(i, Label)]
    assert shafts(drawing, width=1.2) == []


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (1, "1st"),
        (2, "2nd"),
        (3, "3rd"),
        (4, "4th"),
        (11, "11th"),
        (12, "12th"),
        (21, "21st"),
        (22, "22nd"),
        (23, "23rd"),
        (113, "113th"),
    ],
)
def test_ordinals(number, words):
    assert ordinal(number) == words


@pytest.mark.parametrize(
    ("value", "rounded"),
    [
        (1, 1),
        (1.99, 1),
        (2, 2),
        (4.9, 2),
        (5, 5),
        (9.99, 5),
        (19564, 10000),
        (0.0021, 0.002),
    ],
)
def test_round_numbers(value, rounded):
    assert round_down(value) == pytest.approx(rounded)


def test_lines_lie_outside_the_circle_where_the_error_is_positive():
    result, _ = known_result(3, 4)
    emap = replace(
        result.error_map,
        g_theta=np.array([1e-5, -1e-5, 0.0, np.nan]),
        u_g_theta=np.zeros(4),
    )
    drawing = angular_map(replace(result, error_map=emap))
    dots = next(
        i for i in drawing.items if isinstance(i, Discs) and i.radii[0][0] == 1.8
    ).centres
    away = [math.dist(CENTRE, dot) for dot in dots]
    assert (
        away[0] > ZERO + 50 and away[1] < ZERO - 50 and away[2] == pytest.approx(ZERO)
    )
    assert dots[0][0] > CENTRE[0] + ZERO and dots[1][1] < CENTRE[1] - 30
    assert len(dots) == 3


def test_histograms_hold_every_residual():
    result = with_residuals(11, 24)
    found = residuals_in(result)
    for kind, values in (
        ("xy", [v.xy_m for v in found]),
        ("theta", [v.theta_rad for v in found]),
    ):
        drawing = distributions(found, kind)
        said = [
            int(i.text.split()[0])
            for i in drawing.items
            if isinstance(i, Label) and "residuals, rms" in i.text
        ]
        assert said == [np.isfinite(v).sum() for v in values]
        bars = [i for i in drawing.items if isinstance(i, Path) and i.fill == "band"]
        for item, count in zip(bars, said, strict=True):
            # heights in pixels add up to the number of residuals in units of the axis
            heights = [line[0][1] - line[1][1] for line in item.lines]
            per_one = min(heights) / round(min(heights) / (sum(heights) / count))
            assert sum(heights) / per_one == pytest.approx(count, rel=1e-6)


def test_a_drift_is_drawn_from_its_legendre_coefficients():
    result = with_residuals()
    estimates = (
        TermEstimate("identity", "x P1", 3e-7, 1e-9, "m"),
        TermEstimate("identity", "y P2", 2e-7, 1e-9, "m"),
    )
    drawing = drift_found(
        replace(
            result, model=ModelResult("rigid", (TermResult("drift", None, estimates),))
        )
    )
    x, y = (
        next(
            i.lines[0]
            for i in drawing.items
            if isinstance(i, Path) and i.stroke == "c0" and i.dash == dash
        )
        for dash in ((), (5, 3))
    )
    zero = next(
        i.lines[0][0][1]
        for i in drawing.items
        if isinstance(i, Path) and i.stroke == "line"
    )
    up = np.array([zero - point[1] for point in x])
    assert up[0] == pytest.approx(-up[-1]) and up[-1] > 0  # P1 goes from -1 to 1
    bent = np.array([zero - point[1] for point in y])
    assert bent[0] == pytest.approx(2 / 3 * up[-1])  # P2 is 1 at both ends
    assert bent[30] == pytest.approx(-bent[0] / 2)  # and -1/2 in the middle
    assert drift_found(result) is None


def test_courses_need_times_and_show_a_rise_upwards():
    result = with_residuals()
    course = ViewCourse(
        np.arange(5.0), dx=np.arange(5) * 1e-8, dy=np.zeros(5), count=(1,) * 5
    )
    first, *others = result.parts.residuals.views
    rows = [
        replace(first, course=course),
        *(replace(row, course=None) for row in others),
    ]
    found = residuals_in(replace(result, parts=Parts(ResidualsOfViews(tuple(rows)))))
    drawing = courses(found, 1e-8)
    rise = next(
        i.lines[0] for i in drawing.items if isinstance(i, Path) and i.stroke == "c0"
    )
    assert len(rise) == 5 and rise[-1][1] < rise[0][1] - 20
    assert courses(found[1:], 1e-8) is None


def test_the_plate_of_one_view_is_shown_with_the_axes_and_what_is_there():
    """For whoever places it: without a turn no arrow is explained, and x and y are."""
    plate = Artifact(5, 0.01, 0)
    for views, title, arrow in (
        ([View("a")], "Place the plate", False),
        ([View("a", np.pi / 2)], "Place the plate", True),
        ([View("a"), View("b", np.pi / 2)], "How the plate lies in every view", True),
    ):
        said = svg_file(plan_figure(plate, views))
        assert title in said and "stage x to the right, y upwards" in said
        assert ("arrow: its turn" in said) is arrow


def turned(rotation_deg, shift=(0.0, 0.0), grid=None, **more):
    """Return the figure of one view of a plate of 5 x 9 marks, and the middle of its panel."""
    view = View("v", math.radians(rotation_deg), shift, **more)
    drawing = plan_figure(Artifact(5, 0.01, 24, 9, grid), [view])
    frame = next(
        item.lines[0]
        for item in drawing.items
        if isinstance(item, Path) and item.stroke == "soft" and len(item.lines[0]) == 5
    )
    return drawing, np.mean(frame[:4], axis=0)


def heads(drawing):
    return [
        np.array(item.lines[0])
        for item in drawing.items
        if isinstance(item, Path) and item.fill == "truth"
    ]


@pytest.mark.parametrize(
    ("rotation", "corner", "sense"),
    [(90, (-1, -1), "left"), (-90, (1, 1), "right"), (180, (-1, 1), "left")],
)
def test_the_arrow_leads_the_corner_of_a_turned_plate_the_way_it_is_turned(
    rotation, corner, sense
):
    """Pixels grow downwards: (-1, -1) is top left, where a quarter turn to the left leads it."""
    drawing, middle = turned(rotation)
    (dot,) = (
        item.centres[0]
        for item in drawing.items
        if isinstance(item, Discs) and item.fill == "truth"
    )
    assert tuple(np.sign(dot - middle)) == corner
    (way,) = (
        np.array(item.lines[0]) - middle
        for item in drawing.items
        if isinstance(item, Path)
        and item.stroke == "truth"
        and len(item.lines[0]) == 61
    )
    # begins at the top right, where the corner is without a turn
    assert way[0][0] > 0 > way[0][1]
    assert np.sign(way[-1]).tolist() == list(corner)
    # < 0: counter-clockwise
    across = way[:-1, 0] * way[1:, 1] - way[:-1, 1] * way[1:, 0]
    assert (across < 0).all() if sense == "left" else (across > 0).all()
    (head,) = heads(drawing)
    np.testing.assert_allclose(head[0] - middle, way[-1])


def test_a_plate_off_the_lattice_is_drawn_within_its_panel():
    """Turned by 37 deg over a map of 30 x 60 mm: what lies beyond the nodes is hollow."""
    grid = MapGrid(3, 0.015, size_y=5)
    view = View("v", math.radians(37), (0.013, -0.007), angular=False)
    drawing, middle = turned(
        37, view.translation_m, grid, angular=False, check_marks=1, check_offset_m=2e-5
    )
    (hollow,) = (
        item
        for item in drawing.items
        if isinstance(item, Discs) and item.stroke == "bad"
    )
    (read,) = (
        item for item in drawing.items if isinstance(item, Discs) and item.fill == "ink"
    )
    inside = view.pose.in_field(Artifact(5, 0.01, 24, 9, grid))
    assert (len(read.centres), len(hollow.centres)) == (inside.sum(), (~inside).sum())
    frame = next(
        np.array(item.lines[0])
        for item in drawing.items
        if isinstance(item, Path) and item.stroke == "soft" and len(item.lines[0]) == 5
    )
    plate = next(
        np.array(item.lines[0])
        for item in drawing.items
        if isinstance(item, Path) and item.stroke == "truth" and len(item.lines[0]) == 5
    )
    assert (frame.min(axis=0) < plate.min(axis=0)).all()
    assert (plate.max(axis=0) < frame.max(axis=0)).all()
    places = view.pose.places(Artifact(5, 0.01), 0, 0)
    # pixels grow downwards
    assert np.sign(np.mean(plate[:4], axis=0) - middle).tolist() == [
        np.sign(places.real),
        -np.sign(places.imag),
    ]


def test_a_plate_that_is_not_turned_has_no_arrow_and_marks_off_the_field_are_hollow():
    drawing, middle = turned(0, (0.01, 0.0))
    assert heads(drawing) == []
    (hollow,) = (
        item
        for item in drawing.items
        if isinstance(item, Discs) and item.stroke == "bad"
    )
    assert len(hollow.centres) == 9 and all(x > middle[0] for x, _ in hollow.centres)


def test_check_stops_are_crosses_at_the_marks_that_are_visited_again():
    drawing, middle = turned(0, check_marks=5, check_offset_m=2e-5)
    crosses = [
        np.mean(np.concatenate(item.lines), axis=0) - middle
        for item in drawing.items
        if isinstance(item, Path) and item.stroke == "c0"
    ]
    pitch = next(
        abs(a[0] - b[0])
        for item in drawing.items
        if isinstance(item, Discs) and item.fill == "ink"
        for a, b in [(item.centres[0], item.centres[9])]
    )
    sites = {tuple(np.rint(cross / pitch).astype(int).tolist()) for cross in crosses}
    assert sites == {(0, 0), (1, -2), (-1, -2), (-1, 2), (1, 2)}
    words = [item.text for item in drawing.items if isinstance(item, Label)]
    assert words[-1] == "crosses: check stops, measured again with the stage 20 µm off"
    assert not any(
        "crosses" in item.text for item in turned(0)[0].items if isinstance(item, Label)
    )


def test_rejected_readings_stand_where_they_happened():
    result = with_residuals(5, 0)
    found = rejected_in(result)
    assert found[:2] == [
        ("identity", "low_score", 10.0, 20.0),
        ("identity", "too_far_from_nominal", -20.0, 0.0),
    ]
    # mark (1, 0) in the view that is turned by 90 degrees
    view, reason, x, y = found[2]
    assert (view, reason) == (result.views[1].name, "outlier_among_views")
    assert (x, y) == pytest.approx((0.0, 10.0), abs=1e-9)
    words = [i.text for i in rejected_map(result).items if isinstance(i, Label)]
    assert "low score (1)" in words and "outlier among views (1)" in words


def test_readings_rejected_far_away_stand_at_the_edge_of_their_panel():
    result = with_residuals(9, 8, size_y=5)
    edge = np.array([1.0, -1.0])
    far = RejectedAt(result.views[0].name, ("low_score",) * 2, edge, edge)
    drawing = rejected_map(replace(result, parts=Parts(rejected_at=(far,))))
    (left, top), _, (right, bottom), *_ = next(
        item.lines[0]
        for item in drawing.items
        if isinstance(item, Path) and item.stroke == "soft" and len(item.lines[0]) == 5
    )
    dots = next(item for item in drawing.items if isinstance(item, Discs))
    assert np.ravel(dots.centres) == pytest.approx([right, top, left, bottom])


@pytest.mark.parametrize("views", [(), ("a",), ("a",) * 4])
def test_residuals_of_other_views_or_of_none_are_left_out(views):
    rows = tuple(ViewResiduals(name, dx=np.zeros((1, 1))) for name in views)
    result = replace(known_result(3, 0)[0], parts=Parts(ResidualsOfViews(rows)))
    found = residuals_in(result)
    assert residual_maps(result, found) is None and courses(found, 1e-8) is None
    assert distributions(found, "xy") is None and rejected_map(result) is None


def test_svg_of_a_figure_stands_alone_and_is_the_same_twice():
    result, truth = known_result(5, 8)
    drawing = error_map(result, truth)
    text = svg_file(drawing)
    assert text == svg_file(error_map(result, truth))
    assert (
        'xmlns="http://www.w3.org/2000/svg"' in text
        and "prefers-color-scheme: dark" in text
    )
    assert "url(" not in text and "<script" not in text and "href" not in text
    used = set(re.findall(r'class="(?:[^"]* )?[fs]-(\w+)', text))
    assert used and used <= set(COLOURS)


def test_words_in_a_figure_are_escaped():
    drawing = Drawing("a", "<b>", 100, 100)
    drawing.label(1, 20, "<script>\x1b")
    text = inline_svg(drawing)
    assert r"&lt;script&gt;\x1b</text>" in text and "&lt;b&gt;" in text


def test_numbers_that_are_none_are_no_part_of_a_drawing():
    drawing = Drawing("a", "b", 100, 100)
    drawing.line([(0, 0), (float("nan"), 1)])
    with pytest.raises(ValueError, match=r"^nan in a drawing$"):
        inline_svg(drawing)


@pytest.mark.parametrize(
    ("span", "count", "step"),
    [(10, 5, 2), (1, 5, 0.2), (0.7, 5, 0.2), (26, 5, 10), (0, 5, 1), (math.inf, 5, 1)],
)
def test_round_steps(span, count, step):
    assert round_step(span, count) == pytest.approx(step)


def test_ticks_lie_within_their_range_and_y_grows_upwards():
    assert round_ticks(-1.0, 1.0, 4) == pytest.approx([-1.0, -0.5, 0.0, 0.5, 1.0])
    frame = Frame(Drawing("a", "b", 100, 100), (10, 20, 50, 60), (0, 1), (0, 2))
    assert frame.at(0, 0) == (10, 80) and frame.at(1, 2) == (60, 20)
