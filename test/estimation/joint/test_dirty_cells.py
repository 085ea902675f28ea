# SPDX-License-Identifier: Apache-2.0
"""Images with cells that were not read: the camera of the others, and what is said of them."""

from dataclasses import fields, replace

import numpy as np
import pytest

from selfcal_ros.estimation import api
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.joint import camera
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.pose import ImageCells
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.result import result_from_dict, result_to_dict
from selfcal_ros.model.view import View
from selfcal_ros.outputs import plain
from selfcal_ros.reporting.figures.places import camera_errors
from selfcal_ros.reporting.summary.numbers import camera_facts
from selfcal_ros.reporting.summary.sections import state_sentence
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.phrases import few_read_text
from selfcal_ros.simulation import physics
from test.estimation.joint.test_images import DISTORTED, MARK, measured, within
from test.support.options import STILL

CORNER = (1, 1)


def with_dirt(
    measurements: Measurements, dirty: dict[tuple[str, tuple[int, int]], int]
) -> Measurements:
    """Return readings of which so many are left in some cells of some views."""
    out = []
    for one in measurements.views:
        left = dirty.get((one.view.plan_view, one.view.cell))
        if left is not None:
            of_visits = one.visits.mark < left
            visits = replace(
                one.visits,
                **{
                    item.name: value[of_visits]
                    for item in fields(one.visits)
                    if len(value := np.atleast_1d(getattr(one.visits, item.name)))
                    == len(of_visits)
                },
            )
            one = replace(
                one,
                visits=visits,
                **{
                    name: getattr(one, name)[:left]
                    for name in ("m", "n", "dx", "dy", "count")
                },
            )
        out.append(one)
    return replace(measurements, views=tuple(out))


def everywhere(*cells):
    return {(name, cell): 0 for name in ("0", "90") for cell in cells}


def population(dirty, runs):
    """Return errors of map and camera over u, and the results, of machines with dirt."""
    maps, cameras, results = [], [], []
    for seed in range(runs):
        truth, measurements = measured(MARK, seed, size=7, **DISTORTED)
        found = calibrate(
            with_dirt(measurements, dirty), Options(causes=False, terms=STILL)
        )
        emap, cells = found.error_map, found.camera.known_cells
        maps.append(
            (np.stack([emap.gx, emap.gy]) - truth.g) / np.stack([emap.u_gx, emap.u_gy])
        )
        cameras.append(
            (cells[2:4] - (physics.seen_offset(truth, cells[:2]) - cells[:2]))
            / cells[4:]
        )
        results.append(found)
    return np.array(maps), np.array(cameras), results


@pytest.mark.parametrize(
    ("dirty", "cells"),
    [
        ({("0", (0, 0)): 0, ("90", CORNER): 1}, 9),
        (everywhere((0, 0)), 8),
        (everywhere(CORNER, (-1, 0)), 7),
    ],
)
def test_map_and_camera_are_found_without_some_cells(dirty, cells):
    maps, cameras, results = population(dirty, 3)
    within(maps, 20)
    away = cameras
    assert (np.abs(away[np.isfinite(away)]) < 4.5).all()
    assert 0.75 < np.sqrt(np.nanmean(away**2)) < 1.3
    for found in results:
        shown = found.camera
        assert found.camera.known_cells.shape == (6, cells) and len(shown.cells) == 9
        assert shown.degree == 3
        assert shown.scale == pytest.approx(-0.005, abs=2e-4)
        assert shown.rotation == pytest.approx(0.003, abs=2e-4)


def test_a_cell_that_no_view_shows_is_said_to_be_unknown():
    _, measurements = measured(MARK, 3, size=7, **DISTORTED)
    found = worded(calibrate(with_dirt(measurements, everywhere(CORNER))))
    found = result_from_dict(result_to_dict(found), "test")
    assert found.verdict.qualified
    assert plain(found.camera.cells[-1]) == {
        "x": pytest.approx(1e-3),
        "y": pytest.approx(1e-3),
        "dx": None,
        "dy": None,
        "u_dx": None,
        "u_dy": None,
    }
    assert found.warnings == (
        "few marks were read in cell [+1,+1] of the images (0 of 72): look for dirt or a shadow in "
        "that part of the image; the camera's error is not known in cell [+1,+1]",
    )
    assert state_sentence(found).startswith(
        "Calibrated from 2 views with images of 9 marks, few of them read in cell [+1,+1]: largest"
    )
    assert dict(camera_facts(found))["distortion"] == "radial (cubic)"
    spots = [
        item for item in camera_errors(found).items if type(item).__name__ == "Spot"
    ]
    assert len(spots) == 8


def test_a_cell_that_one_view_lacks_is_named_with_the_view():
    _, measurements = measured(MARK, 3, size=7, **DISTORTED)
    (said,) = worded(
        calibrate(with_dirt(measurements, {("90", CORNER): 17, ("0", (0, -1)): 21}))
    ).warnings
    assert said == (
        "few marks were read in cell [+1,+1] of the images of view '90' (17 of 36): "
        "look for dirt or a shadow in that part of the image"
    )


def test_two_rows_of_cells_show_the_linear_part():
    """Of six cells in two rows a polynomial of the second degree is not determined."""
    _, measurements = measured(MARK, 3, size=7, **DISTORTED)
    shown = calibrate(
        with_dirt(measurements, everywhere((-1, 0), (0, 0), (1, 0)))
    ).camera
    assert shown.scale == pytest.approx(-0.005, abs=0.02)
    assert (2, 0) not in [part.power for part in shown.coefficients]


def test_one_row_of_cells_shows_no_camera():
    _, measurements = measured(MARK, 3, size=7)
    measurements = with_dirt(
        measurements, everywhere(*((x, y) for x in (-1, 0, 1) for y in (-1, 1)))
    )
    found, straight = api._camera(measurements, Options())
    assert found is None and straight is measurements
    (finding,) = camera.few_read(measurements, found)
    assert few_read_text(finding).endswith(
        "; the camera's error could not be determined"
    )


def test_full_images_have_no_cell_with_few_readings():
    _, measurements = measured(MARK, 3, size=7, missing=0.3)
    assert not [
        one for one in calibrate(measurements).findings if one.name == "few_read"
    ]


def test_gaps_have_the_value_of_the_other_views():
    """Offsets that are sums of one of the view and one of the cell are found without any gap."""
    rng, image = np.random.default_rng(1), ImageCells(3, 3, 1e-3)
    views = [part for name in "abc" for part in View(name, image=image).sub_views]
    of_view, of_cell = (rng.normal(size=(size, 2)) @ [1, 1j] for size in (3, 9))
    offsets = (of_view[:, None] + of_cell).ravel()
    for _ in range(20):
        seen = rng.random(27) > 0.35
        layout = camera._layout(views, image, seen)
        if layout is None:
            continue
        cells, rows, errors = layout
        at = [image.cells.index(cell) for cell in cells]
        middle = np.argmin([abs(complex(*cell)) for cell in cells])
        found = errors(np.where(seen, offsets, np.nan))
        np.testing.assert_allclose(found, of_cell[at] - of_cell[at][middle], atol=1e-12)
        assert sorted(rows[rows >= 0]) == np.flatnonzero(seen).tolist()
    apart = np.zeros(27, dtype=bool)
    apart[[0, 1, 9 + 7, 9 + 8]] = True  # two cells in one view, two others in another
    assert camera._layout(views, image, apart) is None
