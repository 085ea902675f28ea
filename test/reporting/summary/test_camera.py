# SPDX-License-Identifier: Apache-2.0
"""The camera in summary and report: numbers of the result, arrows; nothing where there is none."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from selfcal_ros.applications.standards import dcc as standards
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.verdict.uncertainty import _term_line
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.reporting.chapters import chapters
from selfcal_ros.reporting.figures.places import camera_errors, stage_yaw, views_in
from selfcal_ros.reporting.summary.numbers import camera_facts, significant, yaw_facts
from selfcal_ros.reporting.summary.sections import (
    state_sentence,
    summary_text,
    terms_section,
)
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.simulation.cell import CellSettings
from test.support.plans import image_plan
from test.support.truth import Spread, random_truth, simulate_measurements


@cache
def result():
    plan, rng = image_plan(5), np.random.default_rng(4)
    truth = random_truth(
        plan.artifact,
        2,
        rng,
        Spread(
            phi_rad=0.003,
            correlation_pitches=4.0,
            microscope_distortion=0.01,
            microscope_field_m=1e-3,
            microscope_scale=0.004,
        ),
    )
    measured = simulate_measurements(
        truth,
        plan,
        rng,
        settings=CellSettings(sigma_xy_m=2e-8, image_xy_m=4e-8, servo_sigma_m=0.0),
    )
    made = worded(calibrate(measured))
    return result_from_dict(result_to_dict(made), "test")


def test_the_size_of_the_microscope_is_that_of_the_images():
    u = np.full(3, 1e-9)
    assert _term_line("xy", "microscope", u, result()).source == "readings"
    assert _term_line("xy", "plate_strain", u, result()).source == "default"


def test_the_summary_states_the_camera():
    facts = dict(camera_facts(result()))
    assert facts["scale"].startswith("-0.39")
    assert facts["distortion"] == "radial (cubic)"
    worst = max(result().camera.cells, key=lambda c: np.hypot(c.dx, c.dy))
    assert facts["largest error"].startswith(
        f"{1e6 * np.hypot(worst.dx, worst.dy):.4f} ± 0.00"
    )
    assert facts["largest error"].endswith(
        f" at x {worst.x * 1e3:.4g} mm, y {worst.y * 1e3:.4g} mm of the image"
    )
    assert "Camera" in summary_text(result())
    words = {
        line.split("  ")[1]: line
        for line in summary_text(result()).splitlines()
        if line.startswith("  ")
    }
    assert "-0.39" in words["scale"]


def test_cells_of_images_are_no_views():
    assert state_sentence(result()).startswith(
        "Calibrated from 2 views with images of 9 marks: "
    )
    assert "2 views with images of 9 marks, 2 measured" in summary_text(result())
    assert [view.name for view in views_in(result())] == ["0", "90"]
    named = standards._meta(result(), {})
    assert "view 0, cell [+1,-1]" in [name for name, _ in named]


def test_the_summary_states_the_yaw_of_the_stage():
    yaw = result().stage_yaw
    (fact,) = yaw_facts(result())
    assert fact in camera_facts(result())
    assert fact[1].startswith(
        f"{significant(min(yaw.yaw) * 1e6)} to {significant(max(yaw.yaw) * 1e6)} ± "
    )
    assert "not more than its noise" in fact[1]
    turning = replace(result(), camera=None, stage_yaw=replace(yaw, p=1e-5))
    assert yaw_facts(turning)[0][1].endswith("mean; p = 1e-05")
    assert camera_facts(turning) == yaw_facts(turning)
    assert [row for row in terms_section(result()).table if "yaw" in row[0]] == []


def test_the_report_draws_its_errors():
    (chapter,) = [c for c in chapters(result(), None) if c.title == "Camera"]
    assert [figure.drawing.name for figure in chapter.figures] == ["camera", "yaw"]
    drawing = camera_errors(result())
    spots = [item for item in drawing.items if type(item).__name__ == "Spot"]
    assert len(spots) == 9
    dx = result().camera.cells[0].dx
    assert f" {dx * 1e6:.1f}" in spots[0].title and " ± 0.0" in spots[0].title


def test_the_report_draws_the_yaw():
    drawing, yaw = stage_yaw(result()), result().stage_yaw
    spots = [item for item in drawing.items if type(item).__name__ == "Spot"]
    assert len(spots) == 25
    assert spots[7].title.startswith(
        f"x {yaw.x[7] * 1e3:.4g} mm, y {yaw.y[7] * 1e3:.4g} mm"
    )
    assert f": {yaw.yaw[7] * 1e6:.1f} ±" in spots[7].title
    # those of the scale are closed
    fields = [
        item
        for item in drawing.items
        if getattr(item, "fill", "").startswith("d") and len(item.lines[0]) == 4
    ]
    assert len({item.fill for item in fields}) > 5
    corners = np.concatenate([item.lines for item in fields])
    low, high = corners.min(axis=1), corners.max(axis=1)
    (left, top), _, (right, bottom), *_ = next(
        item.lines[0]
        for item in drawing.items
        if getattr(item, "stroke", "") == "soft" and len(item.lines[0]) == 5
    )
    assert len(corners) == 25  # 5 x 5 fields that fill the frame
    assert high - low == pytest.approx(
        np.tile([right - left, bottom - top], (25, 1)) / 5
    )
    assert low.min(axis=0) == pytest.approx([left, top])


def test_without_images_nothing_is_shown():
    other = replace(result(), camera=None, stage_yaw=None)
    assert camera_facts(other) == yaw_facts(other) == ()
    assert camera_errors(other) is None and stage_yaw(other) is None
    assert "Camera" not in summary_text(other)


def test_a_cell_without_an_error_is_not_drawn():
    first, *others = result().camera.cells
    blind = replace(result().camera, cells=(replace(first, dx=np.nan), *others))
    assert blind.known_cells.shape == (6, 8)


@pytest.mark.parametrize(
    "camera", [[1], {"cells": []}, {"yaw": {"x": [1.0]}}, {"yaw": []}]
)
def test_a_damaged_camera_is_refused(camera):
    data = result_to_dict(result()) | {"camera": camera}
    with pytest.raises(InputError, match="damaged result"):
        result_from_dict(data, "test")
