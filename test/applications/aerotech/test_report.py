# SPDX-License-Identifier: Apache-2.0
"""What the report says of an exported table: the controller's error before and after."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.applications.aerotech.export import table_theta, table_xy
from selfcal_ros.applications.aerotech.read import parse_cal
from selfcal_ros.applications.aerotech.verify import (
    controller_figure,
    table_chapter,
    verify_tables,
)
from selfcal_ros.applications.aerotech.write import cal_text
from selfcal_ros.compensation.frame import MachineFrame
from selfcal_ros.reporting.figures.drawing import Discs, Label, Path
from test.support.results import known_result


def parabola():
    """Return a result whose Gx is a parabola of 1 um a squared pitch."""
    result, _ = known_result(5, 8)
    x = result.artifact.x_m
    gx = 1e-6 * (x / result.artifact.grid_pitch_m) ** 2
    return replace(
        result, error_map=replace(result.error_map, gx=gx, gy=np.zeros_like(gx))
    )


def words(drawing):
    return [item.text for item in drawing.items if isinstance(item, Label)]


def exported(result, frame=None):
    """Return the file that `selfcal cal export` writes of a result, read back."""
    text = cal_text([table_xy(result.error_map, frame or MachineFrame())])
    return parse_cal(text.encode(), "stage.cal")


def test_the_table_leaves_nothing_at_the_nodes_and_the_curvature_between():
    result, frame = parabola(), MachineFrame()
    found = verify_tables(result.error_map, [table_xy(result.error_map, frame)], frame)
    assert found.sites.largest("before") > 1e-6
    assert found.sites.largest("after") < 1e-11
    # a parabola of 1 um a squared pitch lies 1/4 um below its chords at the middle of a cell
    shift = found.between.shift_after - found.sites.shift_after
    assert shift == pytest.approx([0.25e-6, 0.0], rel=1e-3, abs=1e-12)


def test_before_and_after_are_drawn_at_one_scale():
    chapter = table_chapter(parabola(), exported(parabola()))
    (drawing,) = (figure.drawing for figure in chapter.figures)
    titles = words(drawing)
    assert [t for t in titles if t.startswith(("before", "after"))] == [
        "before, at the nodes",
        "after, at the nodes",
        "before, between the nodes",
        "after, between the nodes",
    ]
    assert [text for text in titles if text.startswith(("rms", "below"))][1] == (
        "below 0.0001 µm everywhere"
    )
    # key
    assert (
        sum(text.endswith(" µm") and not text.startswith("rms") for text in titles) == 1
    )
    shafts = [
        line
        for item in drawing.items
        if isinstance(item, Path) and (item.stroke, item.width) == ("ink", 0.9)
        for line in item.lines
    ]
    lengths = [abs(end[0] - start[0]) for start, end in shafts]
    # nothing can be seen of what the table leaves at the nodes
    assert len(lengths) < 40 + 16 + 1
    assert max(lengths) > 10


def test_the_lines_before_and_after_share_one_chart():
    result, frame = known_result(5, 8)[0], MachineFrame(theta_axis=3)
    found = verify_tables(
        result.error_map, [table_theta(result.error_map, frame)], frame
    )
    drawing = controller_figure(found)
    before, after = (
        item.centres
        for item in drawing.items
        if isinstance(item, Discs) and item.radii[0][0] == 2.0
    )
    assert np.ptp([y for _, y in before]) > 100 > 0.1 > np.ptp([y for _, y in after])
    legend = [
        text for text in words(drawing) if text.endswith("arcsec") and "rms" in text
    ]
    assert legend[0].startswith("before: rms") and legend[1].startswith("after: rms")


def test_a_table_of_the_other_sign_doubles_the_error_that_the_chapter_states():
    result = parabola()
    emap = result.error_map
    flipped = exported(
        replace(result, error_map=replace(emap, gx=-emap.gx, gy=-emap.gy))
    )
    for cal, factor in ((exported(result), 0.0), (flipped, 2.0)):
        (section,) = table_chapter(result, cal).sections
        at_nodes = section.table[1]
        assert at_nodes[0] == "at the nodes"
        assert float(at_nodes[2]) == pytest.approx(
            factor * float(at_nodes[1]), abs=2e-4
        )
