# SPDX-License-Identifier: Apache-2.0
"""``selfcal detect``: images to a map within its uncertainty of the truth; bad images."""

import io
import json
import re
import shutil
from pathlib import Path

import mcap.reader
import mcap.writer
import numpy as np
import pytest
import yaml
from PIL import Image

from selfcal_ros.bagio.images import ImageBag
from selfcal_ros.bagio.schemas import store_with
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.cli.detect import _drawn
from selfcal_ros.cli.main import main
from selfcal_ros.files import read_json
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    IMAGE_TOPICS,
    IMAGE_TYPES,
    INPUT_TOPICS,
)
from selfcal_ros.vision.drawing import COLOUR, REJECTED
from selfcal_ros.vision.images import Picture

SIM = """
plan:
  plan_id: camera
  artifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 0}
  views:
    - {name: identity, repeats: 2}
    - {name: rot90, rotation_deg: 90, repeats: 2}
    - {name: shift, translation_pitch: [1, 0], repeats: 2}
seed: 4
truth: {t: 1.0e-5, phi: 1.0e-4}
noise: {sigma_xy: 2.0e-8}
camera: {width: 72, height: 64, pixel_size: 3.0e-6, mark_size: 60.0e-6, turn: 30.0, mirror: true,
  blur: 0.9, read_noise: 0.004, shot_noise: 0.006, vignetting: 0.1}
"""
OPTIONS = ["--pixel-size", "3e-6", "--mark-size", "60e-6", "--turn", "30", "--mirror"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    (folder / "sim.yaml").write_text(SIM)
    assert main(["simulate", str(folder / "sim.yaml"), "-o", str(folder / "bag")]) == 0
    return folder / "bag"


def items(bag):
    return list(ImageBag(bag).items())


def contents(folder, topic):
    """Return log time and bytes of the messages of a topic, by the library's own reader."""
    with next(Path(folder).glob("*.mcap")).open("rb") as file:
        return [
            (message.log_time, message.data)
            for _, channel, message in mcap.reader.make_reader(file).iter_messages()
            if channel.topic == topic
        ]


def detect(bag, output, *more):
    return main(["detect", str(bag), "-o", str(output), *OPTIONS, *more])


@pytest.fixture(scope="module")
def found(bag):
    """Return the bag of what is found in the images."""
    assert detect(bag, bag.parent / "found") == 0
    return bag.parent / "found"


def test_the_map_from_images_is_within_five_u_of_the_truth(bag, tmp_path, capsys):
    assert detect(bag, tmp_path / "found", "--json") == 0
    counts = json.loads(capsys.readouterr().out)["counts"]
    assert counts == {
        "images": 140,
        "images_refused": 0,
        "images_without_marks": 0,
        "marks": 140,
    }
    assert main(
        ["solve", str(tmp_path / "found"), "-o", str(tmp_path / "R.json"), "--force"]
    ) in (0, 5)
    result, truth = read_json(tmp_path / "R.json"), read_json(bag / "truth.json")
    emap = result["error_map"]
    for axis in ("gx", "gy"):
        away = np.array(emap[axis], float) - truth[axis]
        assert (np.abs(away) < 5 * np.array(emap[f"u_{axis}"], float)).all()
        assert np.abs(truth[axis]).max() > 10 * np.abs(away).max()


@pytest.mark.parametrize("wrong", [["--turn", "210"], ["--turn", "120"]])
def test_a_camera_that_is_turned_otherwise_is_noticed(bag, tmp_path, wrong):
    assert detect(bag, tmp_path / "found", *wrong) == 0
    assert main(["solve", str(tmp_path / "found"), "-o", str(tmp_path / "R.json")]) in (
        2,
        5,
    )


def test_other_topics_are_unchanged_and_images_left_out(bag, found):
    for topic in (f"/{ENCODER_TOPIC}", "/selfcal/view_command"):
        assert contents(found, topic) == contents(bag, topic) != []
    images = contents(bag, "/stage/image")
    marks = contents(found, f"/{DETECTION_TOPIC}")
    assert [stamp for stamp, _ in marks] == [stamp for stamp, _ in images]
    assert contents(found, "/stage/image") == []
    assert (found / "truth.json").read_bytes() == (bag / "truth.json").read_bytes()


def rewritten(bag, target, change, space=""):
    """Write a bag with the first 20 images, each as `change` (number, message) gives them."""
    transport = "compressed" if change is compressed else "raw"
    topic, kind = f"/{space}{IMAGE_TOPICS[transport]}", IMAGE_TYPES[transport]
    images = [item for item in items(bag) if item.is_image][:20]
    with BagWriter(target) as writer:
        writer.add_topic(topic, kind, [])
        for number, item in enumerate(images):
            data = change(number, item.image)
            writer.write_raw(topic, data, item.message.log_time)


def bytes_of(message, kind=IMAGE_TYPES["raw"]):
    return bytes(store_with(kind).serialize_cdr(message, kind))


def unchanged(number, message):
    return bytes_of(message)


def compressed(number, message):
    file = io.BytesIO()
    Image.fromarray(message.data.reshape(message.height, message.width)).save(
        file, "PNG"
    )
    kind = store_with(IMAGE_TYPES["compressed"]).types[IMAGE_TYPES["compressed"]]
    return bytes_of(
        kind(
            message.header,
            "mono8; png compressed mono8",
            np.frombuffer(file.getvalue(), np.uint8),
        ),
        IMAGE_TYPES["compressed"],
    )


def test_compressed_images_give_the_same(bag, tmp_path):
    for name, change in (("raw", unchanged), ("compressed", compressed)):
        rewritten(bag, tmp_path / name, change, "cell1/")
        assert detect(tmp_path / name, tmp_path / f"found_{name}") == 0
    found = [
        contents(tmp_path / f"found_{name}", f"/cell1/{DETECTION_TOPIC}")
        for name in ("raw", "compressed")
    ]
    assert found[0] == found[1] and len(found[0]) == 20


STAMPS = []


def spoilt(number, message):
    STAMPS.append(message.header.stamp)
    if number == 3:
        message.encoding = "yuv422"
    if number == 5:
        message.height -= 1
    if number == 7:
        message.data = message.data[:100]
    if number == 9:
        return b"\0\1\0\0garbage"
    if number == 11:
        message.header.stamp = STAMPS[number - 1]
    if number == 14:
        # this one's own stamp is wrong, and no other's
        message.header.stamp.sec += 10**6
    if number == 13:
        message.data = np.full_like(message.data, 200)
    return bytes_of(message)


def test_bad_images_give_one_line_each_and_lose_nothing_else(bag, tmp_path, capsys):
    STAMPS.clear()
    rewritten(bag, tmp_path / "bad", spoilt)
    assert detect(tmp_path / "bad", tmp_path / "found") == 0
    printed = capsys.readouterr()
    assert printed.out.strip().endswith(
        "14 marks in 15 images; 1 image without marks; 4 images refused"
    )
    lines = printed.err.splitlines()
    assert len(lines) == 5
    for text in (
        "encoding 'yuv422'",
        "72 x 63 pixels, but earlier images have 72 x 64",
        "100 bytes in rows of 72",
        "messages on /stage/image could not be decoded",
        "its stamp is that of an earlier image",
    ):
        assert sum(text in line for line in lines) == 1
    assert len(contents(tmp_path / "found", f"/{DETECTION_TOPIC}")) == 14


@pytest.mark.parametrize(
    "arguments, code, line",
    [
        (["--pixel-size", "0"], 2, "--pixel-size: is not set; give it in m"),
        (
            ["--mark-size", "2e-6"],
            2,
            "--mark-size: 0.667 pixels; a mark has 6 to 2000 pixels",
        ),
        (
            ["--mark-size", "-20e-6"],
            2,
            "--mark-size: -2e-05 is outside 0.0 to 1000.0 m",
        ),
        (["--aruco", "9"], 2, "--aruco: '9' is not the marks along x and y"),
        (["--namespace", "other"], 4, "no topic stage/image or stage/image/compressed"),
    ],
)
def test_impossible_requests_end_with_one_line(
    bag, tmp_path, capsys, arguments, code, line
):
    assert detect(bag, tmp_path / "found", *arguments) == code
    [printed] = capsys.readouterr().err.splitlines()
    assert line in printed
    assert not (tmp_path / "found").exists()


def test_a_recording_that_is_in_the_bag_twice_is_refused(bag, tmp_path, capsys):
    [file] = bag.glob("*.mcap")
    (tmp_path / "twice.mcap").write_bytes(2 * file.read_bytes())
    assert detect(tmp_path / "twice.mcap", tmp_path / "out") == 2
    err = capsys.readouterr().err
    assert re.search(
        r"twice\.mcap from byte \d+ on begins \S+ s before the end of what was read "
        r"before it: a copy, .*; give each recording once",
        err,
    )
    assert err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_parameters_come_from_a_file_of_the_nodes(bag, found, tmp_path):
    (tmp_path / "nodes.yaml").write_text(
        "mark_detector: {ros__parameters: {pixel_size: 3.0e-6, mark_size: 60.0e-6, turn: 30.0,"
        " mirror: true}}"
    )
    assert (
        main(
            [
                "detect",
                str(bag),
                "-o",
                str(tmp_path / "b"),
                "--params",
                str(tmp_path / "nodes.yaml"),
            ]
        )
        == 0
    )
    marks = [contents(each, f"/{DETECTION_TOPIC}") for each in (found, tmp_path / "b")]
    assert marks[0] == marks[1]


def test_topics_of_foreign_types_are_kept(bag, tmp_path):
    with (tmp_path / "foreign.mcap").open("wb") as file:
        writer = mcap.writer.Writer(file)
        writer.start("ros2")
        schema = writer.register_schema("odd_msgs/msg/Odd", "ros2msg", b"float64 x")
        odd = writer.register_channel(
            "/odd", "cdr", schema, {"offered_qos_profiles": ": : ["}
        )
        text = store_with(IMAGE_TYPES["raw"]).generate_msgdef(
            IMAGE_TYPES["raw"], ros_version=2
        )[0]
        image = writer.register_channel(
            "/stage/image",
            "cdr",
            writer.register_schema(IMAGE_TYPES["raw"], "ros2msg", text.encode()),
        )
        data = bytes_of(next(item.image for item in items(bag) if item.is_image))
        writer.add_message(image, 7, data, 7)
        writer.add_message(odd, 8, b"\0\1\0\0" + bytes(8), 6, 3)
        writer.finish()
    assert detect(tmp_path / "foreign.mcap", tmp_path / "found") == 0
    assert contents(tmp_path / "found", "/odd") == [(8, b"\0\1\0\0" + bytes(8))]
    assert "/odd" in (tmp_path / "found" / "metadata.yaml").read_text()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return a folder with the images as files, what is found in them, and its result."""
    folder = tmp_path_factory.mktemp("files")
    images = folder / "pictures"
    (folder / "sim.yaml").write_text(SIM)
    (folder / "plan.yaml").write_text(yaml.safe_dump(yaml.safe_load(SIM)["plan"]))
    assert main(["simulate", str(folder / "sim.yaml"), "-o", str(images), "--png"]) == 0
    assert (
        detect(
            images,
            folder / "found",
            "--positions",
            str(images / "positions.csv"),
            "--plan",
            str(folder / "plan.yaml"),
        )
        == 0
    )
    assert main(
        ["solve", str(folder / "found"), "-o", str(folder / "R.json"), "--force"]
    ) in (0, 5)
    return folder


def test_a_folder_of_files_gives_the_detections_of_the_bag(found, files):
    assert len(list((files / "pictures").glob("*.png"))) == 140
    values = [
        [own_values(data) for _, data in contents(each, f"/{DETECTION_TOPIC}")]
        for each in (files / "found", found)
    ]
    assert values[0] == values[1]
    for topic, kind in INPUT_TOPICS.items():
        for time, data in contents(files / "found", f"/{topic}"):
            stamp = store_with(kind).deserialize_cdr(data, kind).header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == time
    with (files / "found" / "metadata.yaml").open() as file:
        topics = yaml.safe_load(file)["rosbag2_bagfile_information"][
            "topics_with_message_count"
        ]
    latched = [
        one["topic_metadata"]["name"]
        for one in topics
        if "transient_local" in str(one["topic_metadata"]["offered_qos_profiles"])
    ]
    assert latched == [f"/{COMMAND_TOPIC}"]
    result, truth = (
        read_json(files / "R.json"),
        read_json(files / "pictures" / "truth.json"),
    )
    for axis in ("gx", "gy"):
        away = np.array(result["error_map"][axis], float) - truth[axis]
        assert (
            np.abs(away) < 5 * np.array(result["error_map"][f"u_{axis}"], float)
        ).all()


def test_the_times_of_files_are_those_of_the_table_and_unknown_without(files, tmp_path):
    folder = files / "pictures"
    heading, *rows = (folder / "positions.csv").read_text().splitlines()
    (tmp_path / "timed.csv").write_text(
        "\n".join(
            [
                f"{heading},time",
                *(
                    f"{row},2026-11-21T10:{10 + number // 60}:{number % 60:02}.5+01:00"
                    for number, row in enumerate(rows)
                ),
            ]
        )
    )
    assert (
        detect(
            folder,
            tmp_path / "timed",
            "--positions",
            str(tmp_path / "timed.csv"),
            "--plan",
            str(files / "plan.yaml"),
        )
        == 0
    )
    assert main(
        ["solve", str(tmp_path / "timed"), "-o", str(tmp_path / "R.json"), "--force"]
    ) in (0, 5)
    timed, plain = (read_json(each / "R.json") for each in (tmp_path, files))
    made = timed["provenance"]
    assert made["first_exposure"] == "2026-11-21T09:10:00.500+00:00"
    assert made["last_exposure"] == "2026-11-21T09:12:19.500+00:00"
    assert made["duration_s"] == 139
    made = plain["provenance"]
    assert "first_exposure" not in made and made["duration_s"] is None
    assert timed["error_map"]["gx"] == plain["error_map"]["gx"]


def own_values(data):
    kind = "selfcal_msgs/msg/MarkDetection"
    message = store_with(kind).deserialize_cdr(data, kind)
    return message.offset_x, message.offset_y, message.sigma, message.score


@pytest.mark.parametrize(
    "table, problem",
    [
        ("file,view,x\n", "no column 'y'; begin with the line file,view,x,y"),
        ("file,view,x,y\na.png,tilted,0,0\n", ":2: the plan has no view 'tilted'"),
        ("file,view,x,y\n\na.png,shift,0,far\n", ":3: 'far' is not a position"),
        ("file,view,x,y\na.png,shift,nan,0\n", ":2: 'nan' is not a position"),
        ("file,view,x,y\na.png,,0,0\n", ":2: an empty cell"),
        ("\ufefffile,view,x,y\r\na.png,,0,0\r\n", ":2: an empty cell"),
        (
            "file,view,x,y\na.png,shift,0,0\n#\na.png,shift,0,0\n",
            ":4: a.png is in line 2 as well",
        ),
        (
            "file,view,x,y,time\na.png,shift,0,0,2026-11-21T09:30:00\n",
            ":2: '2026-11-21T09:30:00' is not a time with its zone; write it as "
            "2026-11-21T09:30:00.25+0",
        ),
        (
            "file,view,x,y,time\na.png,shift,0,0,1904-01-01T00:00:00Z\n",
            ":2: '1904-01-01T00:00:00Z' is not between 1970-01-02 and 2038-01-18",
        ),
        (
            "file,view,x,y,time\na.png,shift,0,0,2062-11-21T09:30:00Z\n",
            ":2: '2062-11-21T09:30:00Z' is not between 1970-01-02 and 2038-01-18",
        ),
        (
            "file,view,x,y,time\na.png,shift,0,0,\n",
            ":2: an empty cell; give file, view, x, y, time",
        ),
        (
            "file,view,x,y,time\na.png,shift,0,0,2026-11-21T09:30:01Z\n"
            "b.png,shift,0,0,2026-11-21T10:30:01.05+01:00\n",
            ":3: not exposed 0.1 s or more after line 2; give the times in the order "
            "of the exposures",
        ),
        (
            "file,view,x,y\na.png,shift,9,9\nb.png,shift,0,-1.2\nc.png,shift,0,0\n",
            "p.csv: half of the positions are over 1.2 m from the origin, the marks "
            "of the plan within 0.0383 m; give x and y in m",
        ),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path, capsys, table, problem):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(yaml.safe_load(SIM)["plan"]))
    (tmp_path / "p.csv").write_text(table)
    assert (
        detect(
            tmp_path,
            tmp_path / "found",
            "--positions",
            str(tmp_path / "p.csv"),
            "--plan",
            str(tmp_path / "plan.yaml"),
        )
        == 2
    )
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "found").exists()


def test_a_table_without_rows_is_no_data(tmp_path, capsys):
    (tmp_path / "plan.yaml").write_text(yaml.safe_dump(yaml.safe_load(SIM)["plan"]))
    (tmp_path / "p.csv").write_text("file,view,x,y\n")
    assert (
        detect(
            tmp_path,
            tmp_path / "found",
            "--positions",
            str(tmp_path / "p.csv"),
            "--plan",
            str(tmp_path / "plan.yaml"),
        )
        == 4
    )
    assert (
        "p.csv: no row below the heading; give one for each exposure"
        in capsys.readouterr().err
    )
    assert not (tmp_path / "found").exists()


def test_damaged_files_are_one_line_each(files, tmp_path, capsys):
    folder, plan = (
        shutil.copytree(files / "pictures", tmp_path / "p"),
        files / "plan.yaml",
    )
    images = sorted(folder.glob("*.png"))
    images[4].write_bytes(b"no image")
    Image.fromarray(np.zeros((50, 60), np.uint8)).save(images[6])
    assert (
        detect(
            folder,
            tmp_path / "found",
            "--positions",
            str(folder / "positions.csv"),
            "--plan",
            str(plan),
        )
        == 0
    )
    damaged, other_size = capsys.readouterr().err.splitlines()
    assert (
        f"{images[4].name}: not an image of a known kind, or damaged; give PNG"
        in damaged
    )
    assert (
        f"{images[6].name}: 60 x 50 pixels, but earlier images have 72 x 64"
        in other_size
    )


def test_a_table_of_files_that_are_not_there_is_refused_with_its_line(
    files, tmp_path, capsys
):
    folder, plan = (
        shutil.copytree(files / "pictures", tmp_path / "p"),
        files / "plan.yaml",
    )
    images = sorted(folder.glob("*.png"))
    for image in images[2:4]:
        image.unlink()
    assert (
        detect(
            folder,
            tmp_path / "found",
            "--positions",
            str(folder / "positions.csv"),
            "--plan",
            str(plan),
        )
        == 4
    )
    (line,) = capsys.readouterr().err.splitlines()
    assert (
        f"positions.csv:4: {images[2].name} is not in {folder} (2 of 140 files are not)"
        in line
    )
    assert not (tmp_path / "found").exists()


def test_images_of_one_name_are_drawn_as_several_pictures(tmp_path):
    picture = Picture(np.zeros((8, 8), dtype=np.uint8), 255)
    settings = DetectorSettings(pixel_size=2e-6, mark_size=1e-5)
    for name in ("a/1.png", "b/1.png", "a/1.tif", "7"):
        _drawn(tmp_path, settings, name, picture, [])
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "7.png",
        "a_1.png",
        "a_1.tif.png",
        "b_1.png",
    ]


def test_positions_without_a_plan_are_refused(bag, tmp_path, capsys):
    assert detect(bag, tmp_path / "found", "--positions", "p.csv") == 2
    assert (
        "--positions: the plan is missing; give --plan PLAN.yaml"
        in capsys.readouterr().err
    )


def test_a_cell_without_a_camera_has_no_png_files(tmp_path, capsys):
    (tmp_path / "sim.yaml").write_text(SIM.partition("camera:")[0])
    assert (
        main(
            ["simulate", str(tmp_path / "sim.yaml"), "-o", str(tmp_path / "p"), "--png"]
        )
        == 2
    )
    assert "the cell has no camera" in capsys.readouterr().err


SEVERAL = """
plan:
  plan_id: several
  artifact: {grid_size: 5, grid_pitch: 2.0e-4, angular_count: 0}
  image: {nx: 3, ny: 3}
  views: [{name: identity, repeats: 2}, {name: rot90, rotation_deg: 90, repeats: 2}]
seed: 3
truth: {t: 1.0e-5, phi: 1.0e-4, g: 2.0e-7}
noise: {sigma_xy: 1.0e-8}
camera: {width: 144, height: 144, pixel_size: 4.0e-6, mark_size: 60.0e-6, turn: 90.0, blur: 0.9,
  distortion: 0.01}
"""


def test_images_of_nine_marks_give_the_map_from_two_views(tmp_path):
    """A camera turned by a quarter, with 1 % distortion in the corners."""
    (tmp_path / "sim.yaml").write_text(SEVERAL)
    assert (
        main(["simulate", str(tmp_path / "sim.yaml"), "-o", str(tmp_path / "bag")]) == 0
    )
    assert (
        main(
            [
                "detect",
                str(tmp_path / "bag"),
                "-o",
                str(tmp_path / "found"),
                "--pixel-size",
                "4e-6",
                "--mark-size",
                "60e-6",
                "--turn",
                "90",
            ]
        )
        == 0
    )
    assert main(
        ["solve", str(tmp_path / "found"), "-o", str(tmp_path / "R.json"), "--force"]
    ) in (0, 5)
    result, truth = (
        read_json(tmp_path / "R.json"),
        read_json(tmp_path / "bag" / "truth.json"),
    )
    assert result["observability"]["identifiable"] and result["rejected"] == {}
    for axis in ("gx", "gy"):
        away = np.array(result["error_map"][axis], float) - truth[axis]
        assert np.abs(away).max() < 0.2 * np.abs(truth[axis]).max()


@pytest.mark.parametrize(
    "options, said",
    [
        (
            ["--mark-size", "30e-6"],
            r"no dark disc of 10 px was found.*; what repeats is (19|20)[.\d]* "
            r"px, dark; try --mark-size (5\.[89]|6|6\.1)e-05$",
        ),
        (
            ["--polarity", "bright"],
            r"no bright disc of 20 px was found.*; try --polarity dark$",
        ),
    ],
)
def test_images_without_the_mark_say_what_they_show_instead(
    bag, tmp_path, capsys, options, said
):
    assert detect(bag, tmp_path / "found", *options) == 4
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(said, line), line
    assert not (tmp_path / "found").exists()


def test_images_with_nothing_in_them_are_refused(bag, tmp_path, capsys):
    def flat(number, message):
        message.data = np.full_like(message.data, 100)
        return bytes_of(message)

    rewritten(bag, tmp_path / "flat", flat)
    assert detect(tmp_path / "flat", tmp_path / "found") == 4
    assert (
        "nothing repeats in them; check exposure and focus" in capsys.readouterr().err
    )


def test_a_bag_none_of_whose_images_can_be_used_is_refused(bag, tmp_path, capsys):
    def unknown(number, message):
        message.encoding = "yuv422"
        return bytes_of(message)

    rewritten(bag, tmp_path / "unknown", unknown)
    assert detect(tmp_path / "unknown", tmp_path / "found") == 4
    assert "no image could be used: image: encoding 'yuv422'" in capsys.readouterr().err


def test_images_are_drawn_with_what_was_found_and_what_was_rejected(
    bag, tmp_path, capsys
):
    """Green around a mark, red around a mark that a fibre crosses."""

    def dirty(number, message):
        if number == 0:
            message.data = message.data.copy()
            pixels = message.data.reshape(message.height, message.width)
            pixels[:, message.width // 2 : message.width // 2 + 3] = 0
        return bytes_of(message)

    rewritten(bag, tmp_path / "dirty", dirty)
    assert (
        detect(
            tmp_path / "dirty", tmp_path / "found", "--draw", str(tmp_path / "drawn")
        )
        == 0
    )
    pictures = sorted((tmp_path / "drawn").glob("*.png"))
    assert len(pictures) == 20
    before = pictures[0].read_bytes()
    assert detect(bag, tmp_path / "again", "--draw", str(tmp_path / "drawn")) == 2
    assert (
        "drawn: has files, which pictures could replace; name another folder\n"
        in capsys.readouterr().err
    )
    left_out = tmp_path / "not_drawn"
    assert detect(tmp_path / "no", tmp_path / "x", "--draw", str(left_out)) == 2
    assert not left_out.exists()
    left_out.mkdir()
    assert detect(tmp_path / "no", tmp_path / "x", "--draw", str(left_out)) == 2
    assert left_out.is_dir()  # whoever made it keeps it
    assert pictures[0].read_bytes() == before and not (tmp_path / "again").exists()
    colours = []
    for picture in pictures[:2]:
        pixels = np.asarray(Image.open(picture)).reshape(-1, 3)
        colours.append({tuple(colour) for colour in np.unique(pixels, axis=0).tolist()})
    assert REJECTED in colours[0] and COLOUR not in colours[0]
    assert COLOUR in colours[1] and REJECTED not in colours[1]
