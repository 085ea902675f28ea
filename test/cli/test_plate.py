# SPDX-License-Identifier: Apache-2.0
"""``selfcal plate``: artwork rendered by another program is found where it was drawn."""

import re
import sys

import numpy as np
import pytest
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter

from selfcal_ros.cli.main import main
from selfcal_ros.collection.settings.detector import MARKS, DetectorSettings
from selfcal_ros.vision.detector import MarkDetector
from selfcal_ros.vision.images import Picture

PLAN = """plan_id: tiny
artifact: {grid_size: 3, grid_pitch: 1.0e-3, angular_count: 0}
views: [{name: one}]
"""
FINE, PIXEL_MM = 16, 0.01


@pytest.fixture
def plan(tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(PLAN)
    return str(path)


def rendered(svg):
    """Return an image (rows, columns) of an SVG's outlines, 0.01 mm a pixel, by PIL."""
    width, height = map(float, re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg).groups())
    columns, rows = int(width / PIXEL_MM), int(height / PIXEL_MM)
    image = Image.new("L", (columns * FINE, rows * FINE), 220)
    draw = ImageDraw.Draw(image)
    for outline in re.search(r'<path d="([^"]*)"', svg)[1].split("Z")[:-1]:
        points = np.array([point.split(",") for point in outline[1:].split("L")], dtype=float)
        at = points / PIXEL_MM * FINE - 0.5
        draw.polygon([tuple(point) for point in at], fill=40)
    fine = np.asarray(image, dtype=float).reshape(rows, FINE, columns, FINE)
    return fine.mean(axis=(1, 3)), (width, height)


@pytest.mark.parametrize("mark", MARKS)
def test_marks_are_found_where_they_are_drawn(plan, tmp_path, mark):
    """True to 0.01 pixel against each other, behind a lens of 0.7 pixels blur."""
    file = tmp_path / f"{mark}.svg"
    assert main(["plate", plan, "-o", str(file), "--mark", mark, "--mark-size", "3e-4"]) == 0
    image, _ = rendered(file.read_text())
    image = np.round(gaussian_filter(image, 0.7) * 256).astype(np.uint16)
    detector = MarkDetector(DetectorSettings.checked(
        {"pixel_size": 1e-5, "mark": mark, "mark_size": 3e-4}, "test"))
    marks, _ = detector.marks(Picture(image, 65535))
    found = np.array(sorted((found.v, found.u) for found in marks))
    assert len(found) == 9
    rows = found.reshape(3, 3, 2)
    rows = np.array([sorted(row.tolist(), key=lambda at: at[1]) for row in rows])
    wanted = np.stack(np.meshgrid([-100, 0, 100], [-100, 0, 100], indexing="ij"), axis=2)
    assert np.abs(rows - rows.mean(axis=(0, 1)) - wanted).max() < 0.01


def test_the_file_is_true_to_size(plan, tmp_path, capsys):
    file = tmp_path / "a4.svg"
    assert main(["plate", plan, "-o", str(file), "--paper", "a4"]) == 0
    assert 'width="210.000000mm" height="297.000000mm"' in file.read_text()
    assert "0.1 mm" in capsys.readouterr().out
    assert main(["plate", plan, "-o", str(tmp_path / "plate.pdf")]) == 0
    assert (tmp_path / "plate.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("ending", "package"), [("dxf", "ezdxf"), ("gds", "gdstk")])
def test_a_missing_package_is_named(plan, tmp_path, capsys, monkeypatch, ending, package):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["plate", plan, "-o", str(tmp_path / f"plate.{ending}")]) == 2
    assert f"pip install {package}" in capsys.readouterr().err


def test_marks_that_touch_are_refused(plan, tmp_path, capsys):
    assert main(["plate", plan, "-o", str(tmp_path / "p.svg"), "--mark-size", "9e-4"]) == 2
    assert "the marks are 1 mm apart" in capsys.readouterr().err


def test_dxf_is_true_to_size(plan, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    assert main(["plate", plan, "-o", str(tmp_path / "p.dxf")]) == 0
    drawing = ezdxf.readfile(tmp_path / "p.dxf")
    lines = [np.array(line.get_points("xy")) for line in drawing.modelspace().query("LWPOLYLINE")]
    assert drawing.units == 4 and len(lines) == 9 + 2
    assert np.allclose(lines[8].mean(axis=0), (1.0, 1.0))
    assert np.ptp(lines[8], axis=0) == pytest.approx((0.2, 0.2))


def test_gds_is_true_to_size(plan, tmp_path):
    gdstk = pytest.importorskip("gdstk")
    assert main(["plate", plan, "-o", str(tmp_path / "p.gds")]) == 0
    library = gdstk.read_gds(tmp_path / "p.gds")
    marks = [np.array(each.points) for each in library.cells[0].polygons if each.layer == 0]
    assert library.unit == 1e-6 and len(marks) == 9 + 2
    assert np.allclose(marks[8].mean(axis=0), (1000.0, 1000.0), atol=0.01)
