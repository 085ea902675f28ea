# SPDX-License-Identifier: Apache-2.0
"""``selfcal camera init``: the camera of a simulated cell, from a bag and from files."""

import json

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import EncoderSample
from selfcal_ros.files import read_yaml
from selfcal_ros.settings.nodes import overrides_in
from selfcal_ros.simulation.rendering import Camera
from selfcal_ros.topics import ENCODER_TOPIC, IMAGE_TOPICS, IMAGE_TYPES, INPUT_TOPICS

MOVES = [(0.0, 0.0), (4e-5, 0.0), (4e-5, 3e-5), (0.0, 5e-5), (-5e-5, -2e-5)]
MARKS = np.array([[-1e-4, 1e-4, 1e-4], [-9e-5, -7e-5, 9e-5]])
OPTIONS = ["--mark-size", "50e-6", "--mark-pixels", "19"]


def views(camera, sign=-1):
    """Return an image at each position; the marks move against the microscope (sign -1)."""
    rng = np.random.default_rng(2)
    return [camera.image(MARKS + sign * np.array([move]).T, rng) for move in MOVES]


def bag_of(path, camera, sign=-1):
    with BagWriter(path) as writer:
        writer.add_topic(f"/{ENCODER_TOPIC}", INPUT_TOPICS[ENCODER_TOPIC], [])
        writer.add_topic(f"/{IMAGE_TOPICS['raw']}", IMAGE_TYPES["raw"], [])
        for number, (move, values) in enumerate(
            zip(MOVES, views(camera, sign), strict=True), 1
        ):
            for stamp in (number * 10**9 - 10**7, number * 10**9 + 10**7):
                writer.write(
                    f"/{ENCODER_TOPIC}",
                    from_model.joint_state(
                        EncoderSample(
                            stamp, ("theta", "y", "x"), (0.0, move[1], move[0])
                        ),
                        "stage",
                    ),
                    stamp,
                )
            writer.write(
                f"/{IMAGE_TOPICS['raw']}",
                from_model.image(values, "mono8", number * 10**9, "camera"),
                number * 10**9,
            )
    return path


def init(source, output, *more):
    return main(["camera", "init", str(source), "-o", str(output), *OPTIONS, *more])


@pytest.mark.parametrize("sense, sign", [("microscope_moves", -1), ("plate_moves", 1)])
@pytest.mark.parametrize(
    "turn, mirror",
    [
        (0.0, False),
        (30.0, False),
        (-140.0, False),
        (0.0, True),
        (75.0, True),
        (180.0, True),
    ],
)
def test_the_camera_is_found_within_its_uncertainty(
    tmp_path, capsys, turn, mirror, sense, sign
):
    camera = Camera(
        width=200, height=180, pixel_size_m=2.6e-6, turn_deg=turn, mirror=mirror
    )
    bag_of(tmp_path / "bag", camera, sign)
    assert (
        init(tmp_path / "bag", tmp_path / "nodes.yaml", "--json", "--sense", sense) == 0
    )
    said = json.loads(capsys.readouterr().out)
    given = overrides_in(
        read_yaml(tmp_path / "nodes.yaml"), "mark_detector", "nodes.yaml"
    )
    assert given["mirror"] is mirror and given["mark_size"] == 50e-6
    assert 0 < said["u_pixel_size"] < 1e-3 * 2.6e-6 and 0 < said["u_turn"] < 0.05
    assert abs(given["pixel_size"] - 2.6e-6) < 5 * said["u_pixel_size"]
    away = (given["turn"] - turn + 180) % 360 - 180
    assert abs(away) < 5 * said["u_turn"]
    assert said["sheared"] < 5 * said["u_sheared"]


def test_a_folder_of_files_with_positions_serves_as_well(tmp_path):
    camera = Camera(width=200, height=180, pixel_size_m=2.6e-6, turn_deg=30.0)
    bag_of(tmp_path / "bag", camera)
    rows = ["file,x,y"]
    for number, (move, values) in enumerate(zip(MOVES, views(camera), strict=True)):
        Image.fromarray(values).save(tmp_path / f"{number}.png")
        rows.append(f"{number}.png,{move[0]},{move[1]}")
    (tmp_path / "p.csv").write_text("\n".join(rows))
    assert init(tmp_path / "bag", tmp_path / "a.yaml") == 0
    assert (
        init(tmp_path, tmp_path / "b.yaml", "--positions", str(tmp_path / "p.csv")) == 0
    )
    found = [
        read_yaml(tmp_path / name)["mark_detector"]["ros__parameters"]
        for name in ("a.yaml", "b.yaml")
    ]
    assert found[0].pop("pixel_size") == pytest.approx(
        found[1].pop("pixel_size"), rel=1e-9
    )
    assert found[0].pop("turn") == pytest.approx(found[1].pop("turn"), abs=1e-9)
    assert found[0] == found[1]


def test_the_detector_takes_the_file_that_it_writes(tmp_path):
    camera = Camera(
        width=200, height=180, pixel_size_m=2.6e-6, turn_deg=30.0, mirror=True
    )
    bag_of(tmp_path / "bag", camera)
    assert init(tmp_path / "bag", tmp_path / "nodes.yaml") == 0
    assert (
        main(
            [
                "detect",
                str(tmp_path / "bag"),
                "-o",
                str(tmp_path / "found"),
                "--params",
                str(tmp_path / "nodes.yaml"),
            ]
        )
        == 0
    )


def test_images_that_are_not_used_are_said(tmp_path, capsys, monkeypatch):
    """One image shows no mark, and one message is torn."""
    camera = Camera(width=200, height=180, pixel_size_m=2.6e-6)
    images = views(camera)
    images[4] = np.full_like(images[4], 90)
    monkeypatch.setattr(f"{__name__}.views", lambda *_: images)
    write = BagWriter.write

    def torn(self, topic, message, stamp_ns):
        if topic.endswith(IMAGE_TOPICS["raw"]) and stamp_ns == 4 * 10**9:
            self.write_raw(topic, b"\0\1\0\0", stamp_ns)
        else:
            write(self, topic, message, stamp_ns)

    monkeypatch.setattr(BagWriter, "write", torn)
    bag_of(tmp_path / "bag", camera)
    assert init(tmp_path / "bag", tmp_path / "nodes.yaml") == 0
    said = capsys.readouterr().err
    assert f"{tmp_path / 'bag'}: 1 of 4 images show no mark and are left out" in said
    assert "1 x messages on /stage/image could not be decoded" in said


@pytest.mark.parametrize(
    ("step", "said"), [(3e-5, "moved along one line only"), (0.0, "did not move")]
)
def test_moves_along_one_line_are_refused(tmp_path, capsys, monkeypatch, step, said):
    monkeypatch.setattr(f"{__name__}.MOVES", [(0.0, 0.0), (step, 0.0), (2 * step, 0.0)])
    bag_of(tmp_path / "bag", Camera(width=200, height=180, pixel_size_m=2.6e-6))
    assert init(tmp_path / "bag", tmp_path / "nodes.yaml") == 2
    assert f"the stage {said}; move it in x and in y" in capsys.readouterr().err
    assert not (tmp_path / "nodes.yaml").exists()


def test_moves_by_a_whole_pitch_are_refused(tmp_path, capsys, monkeypatch):
    """Each image looks like the one before: what a calibration's images show."""
    moves = [(x * 2e-4, y * 2e-4) for x in range(3) for y in range(3)]
    monkeypatch.setattr(f"{__name__}.MOVES", moves)
    monkeypatch.setattr(
        f"{__name__}.views",
        lambda camera, sign: [
            camera.image(MARKS, np.random.default_rng(number))
            for number in range(len(moves))
        ],
    )
    bag_of(tmp_path / "bag", Camera(width=200, height=180, pixel_size_m=2.6e-6))
    assert init(tmp_path / "bag", tmp_path / "nodes.yaml") == 2
    [line] = capsys.readouterr().err.splitlines()
    assert (
        "the marks do not follow the stage" in line
        and "less than 0.4 times the distance" in line
    )
    assert not (tmp_path / "nodes.yaml").exists()


@pytest.mark.parametrize("part", [0.51, 0.53, 0.545])
def test_moves_by_half_a_pitch_are_refused(tmp_path, capsys, monkeypatch, part):
    """Marks seem to move the other way: a camera turned by 180°, with pixels of nearly its size."""
    pitch = 2e-4
    moves = [(x * part * pitch, y * part * pitch) for x, y in ((0, 0), (1, 0), (1, 1))]
    lattice = pitch * np.stack(np.mgrid[-3:4, -3:4]).reshape(2, -1)
    monkeypatch.setattr(f"{__name__}.MOVES", [*moves, (0.0, part * pitch)])
    monkeypatch.setattr(f"{__name__}.MARKS", lattice)
    bag_of(tmp_path / "bag", Camera(width=200, height=180, pixel_size_m=2.6e-6))
    assert init(tmp_path / "bag", tmp_path / "nodes.yaml") == 4
    assert "less than 0.4 times the distance of two marks" in capsys.readouterr().err


def table_of(folder, factor_x, factor_y):
    """Write the images of the moves, and p.csv: the positions, each axis times a factor."""
    rows = ["file,x,y"]
    images = views(Camera(width=200, height=180, pixel_size_m=2.6e-6))
    for number, ((x, y), values) in enumerate(zip(MOVES, images, strict=True)):
        Image.fromarray(values).save(folder / f"{number}.png")
        rows.append(f"{number}.png,{factor_x * x},{factor_y * y}")
    (folder / "p.csv").write_text("\n".join(rows))


@pytest.mark.parametrize(
    ("factor", "options", "by_moves", "by_mark"),
    [(1e3, [], "2.6e+03", "2.63"), (1.0, ["--mark-size", "50"], "2.6", "2.63e+06")],
)
def test_positions_or_marks_in_other_units_are_refused(
    tmp_path, capsys, factor, options, by_moves, by_mark
):
    table_of(tmp_path, factor, factor)
    assert (
        init(
            tmp_path,
            tmp_path / "b.yaml",
            "--positions",
            str(tmp_path / "p.csv"),
            *options,
        )
        == 2
    )
    [line] = capsys.readouterr().err.splitlines()
    assert (
        f"a pixel has {by_moves} µm, by the size of the marks over their pixels {by_mark} µm; "
    ) in line
    assert not (tmp_path / "b.yaml").exists()


def test_exchanged_axes_with_one_of_them_short_are_refused(tmp_path, capsys):
    """The encoder of y counts half: the image of the motion is no similar one."""
    table_of(tmp_path, 1.0, 0.5)
    assert (
        init(tmp_path, tmp_path / "b.yaml", "--positions", str(tmp_path / "p.csv")) == 2
    )
    assert "the image of the motion is sheared by 33" in capsys.readouterr().err


@pytest.mark.parametrize(
    "count, problem",
    [(0, "no row below the heading"), (1, "move the stage in x and y")],
)
def test_too_few_images_are_said_so(tmp_path, capsys, count, problem):
    camera = Camera(width=200, height=180, pixel_size_m=2.6e-6)
    rows = ["file,x,y"]
    for number in range(count):
        Image.fromarray(views(camera)[0]).save(tmp_path / f"{number}.png")
        rows.append(f"{number}.png,0,0")
    (tmp_path / "p.csv").write_text("\n".join(rows) + "\n")
    assert (
        init(tmp_path, tmp_path / "b.yaml", "--positions", str(tmp_path / "p.csv")) == 4
    )
    assert problem in capsys.readouterr().err


@pytest.mark.parametrize(
    "options, said",
    [
        (
            ["--polarity", "bright"],
            "no bright disc of 19 px was found; what repeats is",
        ),
        (["--mark-pixels", "40"], "try --mark-pixels 19"),
    ],
)
def test_images_without_the_mark_say_what_they_show(tmp_path, capsys, options, said):
    """And not that the stage is to be moved: the moves are right."""
    assert said in said_of_images(tmp_path, capsys, *options)


@pytest.mark.parametrize(
    ("change", "reason", "remedy"),
    [
        # blurred marks look larger: their size is right
        (lambda v: ndimage.gaussian_filter(v, 8), "defocused", "; focus, and take"),
        (lambda v: np.clip(2.0 * v, 0, 255), "saturated", "; expose shorter, and"),
        (
            lambda v: v * MOSAIC,
            "was found",
            "; let the camera give grey or colour images",
        ),
        (lambda v: noise(v, 4) + 100, "was found; nothing", "; check exposure and foc"),
        # the rows of marks are 35 px apart, the upper one is at row 55
        (lambda v: v[50:86], "cut_off; nothing", "; let whole marks lie in the image"),
    ],
)
def test_images_that_cannot_be_used_say_how_to_take_them(
    tmp_path, capsys, change, reason, remedy
):
    said = said_of_images(tmp_path, capsys, change=change)
    assert reason in said and remedy in said


MOSAIC = np.tile([[0.0, 1.0], [1.0, 0.0]], (90, 100))
"""Part of green light that the filters of a Bayer pattern let through."""


def noise(values, size):
    return np.random.default_rng(int(values.sum())).normal(0, size, values.shape)


def said_of_images(tmp_path, capsys, *options, change=np.asarray):
    """Return the line that refuses images as without a mark."""
    for number, values in enumerate(views(Camera(200, 180, pixel_size_m=2.6e-6))):
        changed = np.rint(change(values)).astype(np.uint8)
        Image.fromarray(changed).save(tmp_path / f"{number}.png")
    rows = [f"{number}.png,{x},{y}" for number, (x, y) in enumerate(MOVES)]
    table = tmp_path / "p.csv"
    table.write_text("\n".join(["file,x,y", *rows]) + "\n")
    assert init(tmp_path, tmp_path / "b.yaml", "--positions", str(table), *options) == 4
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and "move the stage" not in err
    return err
