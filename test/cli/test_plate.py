# SPDX-License-Identifier: Apache-2.0
"""``selfcal plate``: artwork rendered by another program is found where it was drawn."""

import re
import sys
from dataclasses import replace
from shutil import copyfile

import numpy as np
import pytest
from PIL import Image, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.cli.detect import text_of
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.edge_markers import edge_markers
from selfcal_ros.model.marks import MarkList
from selfcal_ros.settings.detector import MARKS, DetectorSettings
from selfcal_ros.vision.coded import CodedPlate
from selfcal_ros.vision.detector import MarkDetector
from selfcal_ros.vision.exposures import ImageDetector
from selfcal_ros.vision.images import Picture
from test.support.bags import Foreign
from test.support.plans import plan_of
from test.support.sessions import events_of
from test.support.sources import ROOT

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
    width, height = map(
        float, re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg).groups()
    )
    columns, rows = int(width / PIXEL_MM), int(height / PIXEL_MM)
    image = Image.new("L", (columns * FINE, rows * FINE), 220)
    draw = ImageDraw.Draw(image)
    for outline in re.search(r'<path d="([^"]*)"', svg)[1].split("Z")[:-1]:
        points = np.array(
            [point.split(",") for point in outline[1:].split("L")], dtype=float
        )
        at = points / PIXEL_MM * FINE - 0.5
        draw.polygon([tuple(point) for point in at], fill=40)
    fine = np.asarray(image, dtype=float).reshape(rows, FINE, columns, FINE)
    return fine.mean(axis=(1, 3)), (width, height)


@pytest.mark.parametrize("mark", MARKS)
def test_marks_are_found_where_they_are_drawn(plan, tmp_path, mark):
    """True to 0.01 pixel against each other, behind a lens of 0.7 pixels blur."""
    file = tmp_path / f"{mark}.svg"
    assert (
        main(["plate", plan, "-o", str(file), "--mark", mark, "--mark-size", "3e-4"])
        == 0
    )
    image, _ = rendered(file.read_text())
    image = np.round(gaussian_filter(image, 0.7) * 256).astype(np.uint16)
    detector = MarkDetector(
        DetectorSettings.checked(
            {"pixel_size": 1e-5, "mark": mark, "mark_size": 3e-4}, "test"
        )
    )
    marks, _ = detector.marks(Picture(image, 65535))
    found = np.array(sorted((found.v, found.u) for found in marks))
    assert len(found) == 9
    rows = found.reshape(3, 3, 2)
    rows = np.array([sorted(row.tolist(), key=lambda at: at[1]) for row in rows])
    wanted = np.stack(
        np.meshgrid([-100, 0, 100], [-100, 0, 100], indexing="ij"), axis=2
    )
    assert np.abs(rows - rows.mean(axis=(0, 1)) - wanted).max() < 0.01


SEEN = """plan_id: seen
artifact: {grid_size: [6, 5], grid_pitch: 1.0e-3, angular_count: 0}
views: [{name: one}]
"""
PITCH_PX, IMAGE_PX = 50, 220


def photographed(svg, rng, *, turn, centre, mirror):
    """Return a camera's image of an SVG and the function from plate (mm) to pixel.

    Outlines and texts are drawn turned and shifted by PIL, 16 x 16 points a pixel.
    """
    drawn = [
        np.array([point.split(",") for point in outline[1:].split("L")], dtype=float)
        for outline in re.search(r'<path d="([^"]*)"', svg)[1].split("Z")[:-1]
    ]
    # the first are the marks
    marks = np.array([outline.mean(axis=0) for outline in drawn[:30]])
    middle = (marks.min(axis=0) + marks.max(axis=0)) / 2

    def pixel(places):  # of places on the page, mm, y downwards
        away = (places - middle) * (1, -1) - centre
        rows = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        across, up = rows @ away.T * PITCH_PX
        return (
            np.stack([(-across if mirror else across), -up], axis=1)
            + (IMAGE_PX - 1) / 2
        )

    image = Image.new("L", (IMAGE_PX * FINE,) * 2, 210)
    draw = ImageDraw.Draw(image)
    for outline in drawn:
        draw.polygon([tuple(point) for point in (pixel(outline) + 0.5) * FINE], fill=30)
    for x, y, size, text in re.findall(
        r'<text x="([\d.-]+)" y="([\d.-]+)" font-size="([\d.]+)"[^>]*>([^<]*)<', svg
    ):
        at = pixel(np.array([[float(x), float(y)]]))[0] * FINE
        draw.text(
            tuple(at),
            text,
            fill=30,
            font=ImageFont.load_default(float(size) * PITCH_PX * FINE),
        )
    grey = np.asarray(image, dtype=float).reshape(IMAGE_PX, FINE, IMAGE_PX, FINE)
    grey = gaussian_filter(grey.mean(axis=(1, 3)), rng.uniform(0.5, 1.5))
    grey = grey + rng.normal(0, 0.5, grey.shape)
    return Picture(np.clip(np.round(grey), 0, 255).astype(np.uint8), 255), pixel(marks)


def identify(svg, seed):
    """Check ids and centres in an image that shows a marker, at a random turn, shift and blur."""
    rng = np.random.default_rng(seed)
    mirror = bool(rng.integers(2))
    markers = [(x, y) for x in np.arange(6) - 2.5 for y in (-3, 3)]
    markers += [(x, y) for x in (-3.5, 3.5) for y in np.arange(5) - 2.0]
    centre = markers[rng.integers(len(markers))] + rng.uniform(-1.2, 1.2, 2)
    picture, pixels = photographed(
        svg, rng, turn=rng.uniform(0, 2 * np.pi), centre=centre, mirror=mirror
    )
    settings = DetectorSettings.checked(
        {
            "pixel_size": 2e-5,
            "mark": "disc",
            "mark_size": 3e-4,
            "mirror": mirror,
            "aruco": "6x5",
        },
        "test",
    )
    found = ImageDetector(settings).take_picture(picture, 1)
    inside = np.flatnonzero(((pixels > 15) & (pixels < IMAGE_PX - 16)).all(axis=1))
    wanted = {
        (m - 3, n - 2): pixels[m * 5 + n]
        for m in range(6)
        for n in range(5)
        if m * 5 + n in inside
    }
    assert all(each.has_id for each in found)
    told = {(each.m, each.n): each for each in found}
    assert len(told) == len(found) and wanted.keys() <= told.keys()
    for mark, (u, v) in wanted.items():
        x, y = np.array([u, -v]) - np.array([1, -1]) * (IMAGE_PX - 1) / 2
        at = told[mark].offset_x / 2e-5, told[mark].offset_y / 2e-5
        assert np.hypot(at[0] - (-x if mirror else x), at[1] - y) < 0.05
    return len(wanted)


@pytest.fixture
def coded_svg(tmp_path):
    """The artwork of a plate of 6 x 5 marks with markers."""
    pytest.importorskip("cv2")
    (tmp_path / "seen.yaml").write_text(SEEN)
    file = tmp_path / "seen.svg"
    words = ["--aruco", "--mark-size", "3e-4"]
    assert main(["plate", str(tmp_path / "seen.yaml"), "-o", str(file), *words]) == 0
    return file.read_text()


def test_markers_that_do_not_lie_as_on_the_plate_name_no_mark_and_are_counted(
    coded_svg,
):
    """In a corner, markers of two sides of another plate contradict each other."""
    rng = np.random.default_rng(1)
    picture, _ = photographed(
        coded_svg, rng, turn=0.3, centre=(2.5, -2.0), mirror=False
    )
    sizes = {"pixel_size": 2e-5, "mark": "disc", "mark_size": 3e-4}
    of_plate, of_other = (
        ImageDetector(DetectorSettings.checked(sizes | {"aruco": shape}, "test"))
        for shape in ("6x5", "5x6")
    )
    named = of_plate.take_picture(picture, 1)
    assert named and all(each.has_id for each in named)
    assert of_plate.counts.values()["marks_with_ids"] == len(named)
    assert not any(each.has_id for each in of_other.take_picture(picture, 1))
    counts = of_other.counts.values()
    assert counts["marks_with_ids"] == 0
    assert counts["images_with_contradicting_markers"] == 1
    assert text_of("bag", counts).startswith(
        f"bag: {counts['marks']} marks in 1 image, 0 with their ids"
    )
    assert "1 image without ids" in text_of("bag", counts)


class Shrunk:
    """A reader that gives the first marker alone, smaller than it is: cut by the border."""

    def __init__(self, reader):
        self.reader = reader

    def detectMarkers(self, values):
        corners, numbers, rejected = self.reader.detectMarkers(values)
        corner = corners[0]
        middle = corner.mean(axis=1, keepdims=True)
        return [middle + 0.75 * (corner - middle)], numbers[:1], rejected


def test_a_marker_that_the_marks_contradict_is_not_believed(coded_svg):
    picture, _ = photographed(
        coded_svg, np.random.default_rng(1), turn=0.3, centre=(2.0, 0), mirror=False
    )
    sizes = {"pixel_size": 2e-5, "mark": "disc", "mark_size": 3e-4, "aruco": "6x5"}
    detector = ImageDetector(DetectorSettings.checked(sizes, "test"))
    assert all(each.has_id for each in detector.take_picture(picture, 1))
    detector._coded._reader = Shrunk(detector._coded._reader)
    assert not any(each.has_id for each in detector.take_picture(picture, 2))
    assert detector.counts.contradicting == 1


def test_a_mark_keeps_its_id_beside_one_speck(coded_svg):
    picture, _ = photographed(
        coded_svg, np.random.default_rng(1), turn=0.3, centre=(2.0, 0), mirror=False
    )
    sizes = {"pixel_size": 2e-5, "mark": "disc", "mark_size": 3e-4}
    marks, _ = MarkDetector(DetectorSettings.checked(sizes, "test")).marks(picture)
    plate = CodedPlate("6x5", "test")
    name = plate.identified(marks, picture, mirror=False)[0]
    assert name is not None
    speck = replace(marks[0], u=marks[0].u + PITCH_PX / 2)
    both = plate.identified([marks[0], speck], picture, mirror=False)
    assert both == [name, None] and plate.contradicting == 0
    assert plate.identified([speck], picture, mirror=False) == [None]
    assert plate.contradicting == 0
    # two marks lie on a lattice of any size: as many without ids contradict them
    four = plate.identified([*marks[:2], speck, speck], picture, mirror=False)
    assert four == [None] * 4 and plate.contradicting == 1


@pytest.mark.parametrize("factor", [16, 0.15])
def test_markers_are_read_whatever_the_exposure_and_the_bits(coded_svg, factor):
    """12 bits in 16, and a dark image."""
    picture, _ = photographed(
        coded_svg, np.random.default_rng(1), turn=0.3, centre=(2.5, -2.0), mirror=False
    )
    values = np.round(factor * picture.values.astype(float)).astype(np.uint16)
    sizes = {"pixel_size": 2e-5, "mark": "disc", "mark_size": 3e-4, "aruco": "6x5"}
    detector = ImageDetector(DetectorSettings.checked(sizes, "test"))
    marks = detector.take_picture(Picture(values, 65535), 1)
    assert marks and all(each.has_id for each in marks)


def test_a_camera_knows_which_marks_it_sees(coded_svg):
    """Ids and centres in ten images at any turn, shift and blur, mirrored or not."""
    assert sum(identify(coded_svg, seed) for seed in range(10)) > 30


@pytest.mark.parametrize(
    ("artifact", "said"),
    [
        (Artifact(6, 1e-3, grid_size_y=5), ""),
        (
            Artifact(5, 1e-3, grid_size_y=6),
            "'6x5', but the plate of the plan has 5 x 6",
        ),
        (
            Artifact(
                5, 1e-3, marks=MarkList((7, 8, 9), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))
            ),
            "the plate of the plan is a list of marks",
        ),
    ],
)
def test_markers_are_those_of_the_plate_of_the_plan(artifact, said):
    settings = DetectorSettings.checked({"aruco": "6x5"}, "test")
    if not said:
        return settings.require_plate(artifact, "test")
    with pytest.raises(InputError, match=said):
        settings.require_plate(artifact, "test")


def test_markers_are_those_of_the_plate_in_the_commands_of_a_bag(tmp_path, capsys):
    pytest.importorskip("cv2")
    command = ["detect", str(ROOT / "bags/camera"), "-o", str(tmp_path / "out")]
    options = ["--pixel-size", "6e-6", "--mark-size", "72e-6", "--aruco", "4x6"]
    assert main([*command, *options]) == 2
    assert (
        "aruco: '4x6', but the plate of the plan has 5 x 5" in capsys.readouterr().err
    )
    assert not (tmp_path / "out").exists()


def test_the_plates_of_a_bag_are_those_of_the_cell_with_the_images(tmp_path):
    """Another cell in it has no images, and needs no --namespace."""
    bag = tmp_path / "bag"
    other = events_of(plan_of("0, 90, tx", 3, count=4))
    Foreign(namespace="/other").write(bag / "other.mcap", other)
    copyfile(ROOT / "bags/camera/camera_0.mcap", bag / "camera.mcap")
    assert {plate.shape for plate in ImageBag(bag).plates()} == {(5, 5)}


def test_markers_need_opencv_and_a_lattice(plan, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert main(["plate", plan, "-o", str(tmp_path / "p.svg"), "--aruco"]) == 2
    assert "pip install 'selfcal_ros[camera]'" in capsys.readouterr().err
    settings = {"pixel_size": 1e-5, "mark_size": 3e-4, "aruco": "3x3"}
    with pytest.raises(
        InputError, match="OpenCV, which reads the markers, is not installed"
    ):
        ImageDetector(DetectorSettings.checked(settings, "test"))
    with pytest.raises(InputError, match="'three' is not the marks along x and y"):
        ImageDetector(DetectorSettings.checked(settings | {"aruco": "three"}, "test"))
    with pytest.raises(InputError, match="251 x 251 marks need 1004 markers"):
        edge_markers(251, 251)


def test_rows_and_columns_are_numbered(plan, tmp_path):
    file = tmp_path / "p.svg"
    assert main(["plate", plan, "-o", str(file)]) == 0
    texts = re.findall(
        r'<text x="([\d.-]+)" y="([\d.-]+)"[^>]*>(-?\d)<', file.read_text()
    )
    columns, rows = texts[:3], texts[3:]
    assert [text for _, _, text in texts] == ["-1", "0", "1"] * 2
    assert np.allclose(np.diff([float(x) for x, _, _ in columns]), 1.0, atol=0.1)
    # n upwards, the page down
    assert np.allclose(np.diff([float(y) for _, y, _ in rows]), -1.0)
    height = float(re.search(r'viewBox="0 0 [\d.]+ ([\d.]+)"', file.read_text())[1])
    assert all(
        float(y) < height
        for y in re.findall(r'<text x="[\d.-]+" y="([\d.-]+)"', file.read_text())
    )


def test_the_file_is_true_to_size(plan, tmp_path, capsys):
    file = tmp_path / "a4.svg"
    assert main(["plate", plan, "-o", str(file), "--paper", "a4"]) == 0
    assert 'width="210.000000mm" height="297.000000mm"' in file.read_text()
    assert "0.1 mm" in capsys.readouterr().out
    assert main(["plate", plan, "-o", str(tmp_path / "plate.pdf")]) == 0
    assert (tmp_path / "plate.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(("ending", "package"), [("dxf", "ezdxf"), ("gds", "gdstk")])
def test_a_missing_package_is_named(
    plan, tmp_path, capsys, monkeypatch, ending, package
):
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["plate", plan, "-o", str(tmp_path / f"plate.{ending}")]) == 2
    assert f"pip install {package}" in capsys.readouterr().err


def test_marks_that_touch_are_refused(plan, tmp_path, capsys):
    assert (
        main(["plate", plan, "-o", str(tmp_path / "p.svg"), "--mark-size", "9e-4"]) == 2
    )
    assert "the marks are 1 mm apart" in capsys.readouterr().err


@pytest.mark.parametrize("width", ["nan", "inf", "-1e-5", "1.5e-4", "0.03"])
def test_lines_that_fill_their_marks_are_refused(plan, tmp_path, capsys, width):
    words = ["--mark", "ring", "--mark-size", "3e-4", "--mark-width", width]
    assert main(["plate", plan, "-o", str(tmp_path / "p.svg"), *words]) == 2
    assert (
        "a mark has 0.3 mm; give a width above 0 and below 0.15 mm, in m"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "p.svg").exists()


def test_dxf_is_true_to_size(plan, tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    assert main(["plate", plan, "-o", str(tmp_path / "p.dxf")]) == 0
    drawing = ezdxf.readfile(tmp_path / "p.dxf")
    lines = [
        np.array(line.get_points("xy"))
        for line in drawing.modelspace().query("LWPOLYLINE")
    ]
    assert drawing.units == 4 and len(lines) == 9 + 2
    assert np.allclose(lines[8].mean(axis=0), (1.0, 1.0))
    assert np.ptp(lines[8], axis=0) == pytest.approx((0.2, 0.2))


def test_gds_is_true_to_size(plan, tmp_path):
    gdstk = pytest.importorskip("gdstk")
    assert main(["plate", plan, "-o", str(tmp_path / "p.gds")]) == 0
    library = gdstk.read_gds(tmp_path / "p.gds")
    marks = [
        np.array(each.points) for each in library.cells[0].polygons if each.layer == 0
    ]
    assert library.unit == 1e-6 and len(marks) == 9 + 2
    assert np.allclose(marks[8].mean(axis=0), (1000.0, 1000.0), atol=0.01)
