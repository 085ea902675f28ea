# SPDX-License-Identifier: Apache-2.0
"""``selfcal solve``: exit codes, one clear line for each fault, the keys of RESULT.json."""

import json
import re
from dataclasses import replace

import pytest
import yaml

from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample
from test.support import bags
from test.support.bags import Foreign
from test.support.sessions import events_of, small_bag, small_plan

KEYS = {
    "": {
        "schema": str,
        "plan_id": str,
        "artifact": dict,
        "views": list,
        "error_map": dict,
        "artifact_map": dict,
        "observability": dict,
        "noise": dict,
        "rejected": dict,
        "input": dict,
    },
    "artifact": {"grid_size": int, "grid_pitch": float, "angular_count": int},
    "error_map": {
        "gx": list,
        "gy": list,
        "u_gx": list,
        "u_gy": list,
        "g_theta": list,
        "u_g_theta": list,
        "nonorthogonality": float,
        "scale_difference": float,
        "datum_theta": str,
    },
    "artifact_map": {
        "ax": list,
        "ay": list,
        "a_theta": list,
        "u_ax": list,
        "u_ay": list,
        "u_a_theta": list,
    },
    "observability": {
        "rank": int,
        "unknowns": int,
        "deficiency": int,
        "identifiable": bool,
        "modes": list,
    },
    "noise": {"sigma_xy": float, "sigma_theta": float},
    "input": {"file": str, "sha256": str},
}


@pytest.fixture(scope="module")
def events():
    return events_of(small_plan())


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return small_bag(tmp_path_factory.mktemp("solve"))


def solve(path, *options, output=None):
    more = ("-o", str(output)) if output else ()
    return main(["solve", str(path), "--quiet", *more, *options])


def test_a_budget_that_is_asked_for_is_printed_without_the_summary(bag, capsys):
    assert solve(bag, "--budget") == 0
    text = capsys.readouterr().out
    assert "uncertainty of XY" in text and "Calibrated" not in text


def refused(capsys, code, path, *options):
    """Return the one line on stderr of a solve that must end with `code`."""
    assert solve(path, *options) == code
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1 and "Traceback" not in printed.err
    assert printed.err.startswith("selfcal solve: ")
    return printed.err.removeprefix("selfcal solve: ").rstrip()


def without(events, kind):
    return [event for event in events if not isinstance(event, kind)]


def test_the_terms_of_the_plan_travel_in_the_bag_and_options_add_to_them(tmp_path):
    plan = replace(small_plan(), model_terms=("plate_scale:1e-06",))
    bag = small_bag(tmp_path, plan)
    found = {}
    for name, options in {
        "plan": (),
        "options": ("--model", "drift:1e-08"),
        "none": ("--model", "none"),
    }.items():
        out = tmp_path / f"{name}.json"
        assert solve(bag, *options, output=out) in (0, 5)
        result = json.loads(out.read_text())
        found[name] = (
            [term["name"] for term in result["model"]["terms"]],
            result["provenance"].get("model_terms_from"),
        )
    assumed = [
        "microscope",
        "plate_shape",
        "plate_strain",
        "line_eccentricity",
        "line_scale",
        "rotation",
    ]
    assert found == {
        "plan": (["plate_scale", *assumed], "plan"),
        "options": (["drift", "plate_scale", *assumed], "options"),
        "none": ([], None),
    }


def test_what_is_no_bag(tmp_path, capsys):
    text, empty, folder = (
        tmp_path / "a.txt",
        tmp_path / "empty.mcap",
        tmp_path / "folder",
    )
    text.write_text("some words, and no bag at all")
    empty.write_bytes(b"")
    folder.mkdir()
    lines = [
        refused(capsys, 2, path) for path in (text, empty, folder, tmp_path / "none")
    ]
    assert lines == [
        f"{text}: not an MCAP file; give an .mcap file or a rosbag2 folder",
        f"{empty}: the file is empty; record the bag again",
        f"{folder}: no .mcap file in this folder; give an MCAP file or a rosbag2 folder with MCAP "
        "storage",
        f"{tmp_path / 'none'}: no such file or folder; check the path",
    ]


@pytest.mark.parametrize(
    ("kind", "topic"),
    [
        (Command, "selfcal/view_command"),
        (Detection, "stage/mark_detections"),
        (EncoderSample, "stage/joint_states"),
    ],
)
def test_a_topic_without_messages(tmp_path, capsys, events, kind, topic):
    path = Foreign().write(tmp_path / "x.mcap", without(events, kind))
    assert refused(capsys, 4, path).startswith(
        f"{path}: no message on {topic}; record this topic"
    )


def test_commands_without_measure(tmp_path, capsys, events):
    kept = [e for e in events if not isinstance(e, Command) or e.phase != 1]
    path = Foreign().write(tmp_path / "x.mcap", kept)
    assert "no MEASURE command; readings" in refused(capsys, 4, path)


def test_commands_that_cannot_be_used_are_given_with_the_reason(
    tmp_path, capsys, events
):
    off = [
        replace(e, view=replace(e.view, translation_m=(0.003, 0.0)))
        if isinstance(e, Command) and e.view
        else e
        for e in events
    ]
    said = refused(capsys, 4, Foreign().write(tmp_path / "x.mcap", off))
    assert (
        "no MEASURE command that can be used (a view command was not used: view '"
        in said
    )
    assert said.count("0.3 is not a whole number of pitch steps") == said.count(
        "view '"
    )


@pytest.mark.parametrize(
    ("names", "field", "typename"),
    [
        ("detection", "float64 offset_theta", "selfcal_msgs/msg/MarkDetection"),
        ("command", "uint32 repeats", "selfcal_msgs/msg/ViewCommand"),
    ],
)
def test_another_version_of_a_message(tmp_path, capsys, events, names, field, typename):
    text = {"detection": bags.DETECTION, "command": bags.COMMAND}[names]
    types = bags.contract_types(**{names: text.replace(field + "\n", "")})
    line = refused(capsys, 2, Foreign(types=types).write(tmp_path / "x.mcap", events))
    assert (
        f"another version of {typename}: no field '{field.split()[1]}'; record" in line
    )


@pytest.mark.parametrize(
    ("wanted", "other"), [("kind", "uint8 kind"), ("offset_x", "x")]
)
def test_a_field_of_another_type(tmp_path, capsys, events, wanted, other):
    old = {"kind": "uint8 kind", "offset_x": "float64 offset_x"}[wanted]
    text = bags.DETECTION.replace(
        old, {"uint8 kind": "string kind", "x": "string offset_x"}[other]
    )
    types = bags.contract_types(detection=text)
    path = Foreign(types=types).write(tmp_path / "x.mcap", without(events, Detection))
    line = refused(capsys, 4, path)
    assert "no message on stage/mark_detections" in line


def test_bags_of_ros1_and_topics_of_another_type(tmp_path, capsys, events):
    ros1 = Foreign(encoding="ros1").write(tmp_path / "ros1.mcap", events)
    assert refused(capsys, 2, ros1).endswith(
        "message encoding 'ros1' instead of cdr; convert the bag to ROS 2, e.g. with "
        "rosbags-convert"
    )
    wrong = Foreign(renamed={"stage/joint_states": "sensor_msgs/msg/Range"}).write(
        tmp_path / "wrong.mcap", events
    )
    assert refused(capsys, 2, wrong) == (
        f"{wrong}: topic /stage/joint_states: type sensor_msgs/msg/Range instead of "
        "sensor_msgs/msg/JointState; remap the topic or record the right one"
    )


def test_two_cells_name_the_option_and_the_option_works(tmp_path, capsys, events):
    for name in ("one", "two"):
        Foreign(namespace=f"/{name}").write(tmp_path / "bag" / f"{name}.mcap", events)
    assert refused(capsys, 2, tmp_path / "bag").endswith("choose one with --namespace")
    assert solve(tmp_path / "bag", "--namespace", "two") == 0


def test_a_plan_that_does_not_identify_the_stage(tmp_path, capsys):
    path = Foreign().write(tmp_path / "x.mcap", events_of(small_plan("0, 90")))
    output = tmp_path / "result.json"
    assert solve(path, output=output) == 3
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and "shift" in printed
    found = json.loads(output.read_text())
    check_keys(found)
    assert found["observability"]["identifiable"] is False
    assert found["observability"]["deficiency"] > 0 and found["observability"]["modes"]
    assert {value for row in found["error_map"]["gx"] for value in row} == {None}
    assert found["error_map"]["nonorthogonality"] is None


def test_nothing_usable(tmp_path, capsys, events):
    moved = [
        e
        if not isinstance(e, EncoderSample)
        else EncoderSample(e.stamp_ns - 10**12, e.names, e.positions)
        for e in events
    ]
    line = refused(capsys, 4, Foreign().write(tmp_path / "x.mcap", moved))
    count = len([e for e in events if isinstance(e, Detection)])
    assert (
        f"none of {count} detections became a reading (rejected: no_encoder_sample_near {count})"
    ) in line
    assert line.strip().endswith(
        "the detections are stamped about 1000 s after the encoder samples; stamp both by one clock"
    )


def test_a_wrong_sense_is_said_before_any_advice_on_views(capsys):
    assert main(["solve", "bags/hu_noise", "--sense", "plate_moves"]) == 2
    first, last = capsys.readouterr().err.splitlines()
    assert first.startswith(
        "selfcal solve: bags/hu_noise: 1745 of 2240 detections were rejected as "
        "stage_not_at_mark: the stage is indicated at minus the marks' sites; the sense is "
        "reversed: measurement_sense microscope_moves (--sense microscope_moves)"
    )
    assert last.startswith(
        "selfcal solve: bags/hu_noise: correct this first; as it is, the marks "
        "that were read do not identify the stage"
    )


def check_keys(found):
    for part, wanted in KEYS.items():
        values = found[part] if part else found
        for key, kind in wanted.items():
            assert key in values
            assert isinstance(values[key], kind) or (
                kind is float and values[key] is None
            ), key
    size, count = found["artifact"]["grid_size"], found["artifact"]["angular_count"]
    for name in ("gx", "gy", "u_gx", "u_gy"):
        assert [len(row) for row in found["error_map"][name]] == [size] * size
    assert (
        len(found["error_map"]["g_theta"])
        == len(found["error_map"]["u_g_theta"])
        == count
    )
    for view in found["views"]:
        assert {
            "name",
            "rotation",
            "translation_x",
            "translation_y",
            "misalignment",
            "used",
            "rejected",
        } <= set(view)
        assert set(view["misalignment"]) == {"phi", "tx", "ty"}


def result_of(tmp_path, bag, *options, codes=(0,)):
    output = tmp_path / "result.json"
    assert solve(bag, "--force", *options, output=output) in codes
    return re.sub(r'"created": "[^"]*"', '"created": ""', output.read_text())


@pytest.fixture(scope="module")
def plain(bag):
    """Return the result of the bag without options."""
    return result_of(bag.parent, bag)


def test_the_result_has_the_keys_of_the_contract(plain):
    found = json.loads(plain)
    check_keys(found)
    assert found["schema"] == "selfcal.result/1"
    assert found["input"]["file"] == "bag" and len(found["input"]["sha256"]) == 64
    assert found["rejected"]["duplicate"] > 0
    assert sum(view["rejected"] for view in found["views"]) == sum(
        found["rejected"].values()
    )


def test_the_same_bits_every_time_and_for_file_and_folder(tmp_path, bag, plain):
    assert result_of(tmp_path, bag) == plain
    folder = json.loads(plain)
    assert folder["error_map"] is not None
    single = json.loads(result_of(tmp_path, next(bag.glob("*.mcap"))))
    assert single["input"].pop("file") != folder["input"].pop("file")
    assert single["digest"].pop("input") != folder["digest"].pop("input")
    assert single == folder


def params(tmp_path, **nodes):
    path = tmp_path / "nodes.yaml"
    path.write_text(
        yaml.safe_dump(
            {name: {"ros__parameters": values} for name, values in nodes.items()}
        )
    )
    return str(path)


def test_parameters_reach_collector_and_solver_and_options_win(
    tmp_path, capsys, bag, plain
):
    path = params(
        tmp_path,
        solver={"theta_datum": "xy_axes", "misalignment_model": "linear"},
        measurement_collector={"measurement_sense": "plate_moves"},
    )
    assert solve(bag, "--params", path) == 2
    by_file = capsys.readouterr().err
    assert solve(bag, "--sense", "plate_moves") == 2
    assert by_file == capsys.readouterr().err
    assert (
        " of 198 detections were rejected as stage_not_at_mark: the stage is ind"
        in by_file
    )
    sense = ("--sense", "microscope_moves")
    papers = ("--theta-datum", "xy_axes", "--misalignment", "linear")
    linear = {"codes": (0, 5)}  # whether the readings contradict it is another question
    assert result_of(tmp_path, bag, "--params", path, *sense, **linear) == result_of(
        tmp_path, bag, *papers, **linear
    )
    mine = ("--theta-datum", "zero_mean", "--misalignment", "rigid")
    assert plain == result_of(tmp_path, bag, *mine)
    assert plain == result_of(tmp_path, bag, "--params", path, *sense, *mine)
    assert sum(json.loads(plain)["error_map"]["g_theta"]) == pytest.approx(0, abs=1e-15)
    other = result_of(tmp_path, bag, "--misalignment", "linear", **linear)
    assert json.loads(other)["error_map"]["gx"] != json.loads(plain)["error_map"]["gx"]
    assert plain != result_of(tmp_path, bag, "--theta-datum", "xy_axes", **linear)


def test_the_law_is_linear_and_says_so(tmp_path, capsys, bag):
    law = result_of(tmp_path, bag, "--method", "law", codes=(0, 5))
    assert law == result_of(
        tmp_path, bag, "--method", "law", "--misalignment", "linear", codes=(0, 5)
    )
    capsys.readouterr()
    assert refused(capsys, 2, bag, "--method", "law", "--misalignment", "rigid") == (
        "--misalignment: Hu's law is linear, not rigid; omit it, or use --method joint"
    )


def test_the_uncertainty_map_on_request(tmp_path, bag, plain):
    assert plain == result_of(tmp_path, bag, "--uncertainty", "always")
    bare = json.loads(result_of(tmp_path, bag, "--uncertainty", "never"))["error_map"]
    assert bare["gx"] == json.loads(plain)["error_map"]["gx"]
    assert all(u is None for row in bare["u_gx"] for u in row)


def test_numbers_in_a_parameter_file_are_read_as_the_nodes_read_them(
    tmp_path, bag, plain
):
    path = tmp_path / "nodes.yaml"
    text = "measurement_collector:\n  ros__parameters: {max_speed: 5e-4, outlier_limit: %s}\n"
    path.write_text(text % "6e0")
    assert result_of(tmp_path, bag, "--params", str(path)) == plain
    path.write_text(text % "10e-1")
    assert (
        json.loads(result_of(tmp_path, bag, "--params", str(path)))["rejected"]
        != (json.loads(plain)["rejected"])
    )


def test_methods(tmp_path):
    complete = small_bag(tmp_path, small_plan("0, 90, tx"))
    joint = json.loads(result_of(tmp_path, complete))
    assert joint == json.loads(result_of(tmp_path, complete, "--method", "joint"))
    law = json.loads(result_of(tmp_path, complete, "--method", "law", codes=(0, 5)))
    assert (joint["method"], law["method"]) == ("joint", "law")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"solver": {"methode": "joint"}}, "methode: solver has no such parameter"),
        (
            {"solver": {"method": "best"}},
            "method: 'best' is not known; choose one of joint, law",
        ),
        (
            {"measurement_collector": {"min_score": 7.0}},
            "min_score: 7.0 is outside 0.0 to 1.0",
        ),
        (
            {"measurement_collector": {"min_score": "much"}},
            "min_score: 'much' is not of type float",
        ),
        ({"colector": {"min_score": 0.5}}, "colector: no node of this package"),
    ],
)
def test_bad_parameters(tmp_path, capsys, bag, values, message):
    path = params(tmp_path, **values)
    line = refused(capsys, 2, bag, "--params", path)
    assert line.startswith(path) and message in line


def test_parameter_files_that_cannot_be_read(tmp_path, capsys, bag):
    assert "no such file" in refused(
        capsys, 2, bag, "--params", str(tmp_path / "none.yaml")
    )
    (tmp_path / "bad.yaml").write_text("solver:\n  a: [1\n")
    assert "bad.yaml:3:1: not YAML" in refused(
        capsys, 2, bag, "--params", str(tmp_path / "bad.yaml")
    )


@pytest.mark.parametrize(
    "options, said",
    [
        (("--reference", "artifact:2:0"), "--reference: 2.0 is outside -0.09 to 0.09"),
        (("--model", "drift:-1"), "--model: drift: the size '-1' is not a positive"),
        (("--microscope", "0.01:5"), "--microscope: microscope: the size 5 is outside"),
    ],
)
def test_a_wrong_value_is_named_by_its_option(tmp_path, capsys, bag, options, said):
    path = params(tmp_path, solver={"method": "joint"})
    for more in ((), ("--params", path)):
        assert refused(capsys, 2, bag, *options, *more).startswith(said)


@pytest.mark.parametrize(
    "options",
    [
        ("--method", "best"),
        ("--theta-datum", "up"),
        ("--sense", "none"),
        ("--nonsense",),
    ],
)
def test_bad_options(capsys, bag, options):
    with pytest.raises(SystemExit) as stop:
        solve(bag, *options)
    assert stop.value.code == 2
    assert options[-1] in capsys.readouterr().err


def test_an_output_that_cannot_be_written(tmp_path, capsys, bag):
    line = refused(capsys, 2, bag, "-o", str(tmp_path / "none" / "r.json"))
    assert "cannot be written (No such file or directory); name an existing" in line


def test_the_measurement_is_never_written_over(tmp_path, capsys):
    bag = small_bag(tmp_path)
    parts = sorted(bag.rglob("*")) if bag.is_dir() else [bag]
    before = [part.read_bytes() for part in parts]
    for target in parts:
        assert solve(bag, output=target) == 2
        assert (
            f"{target.name}: would be overwritten; name another"
            in capsys.readouterr().err
        )
    assert solve(bag, output=tmp_path / "none" / "r.json") == 2
    assert "cannot be written (No such file or directory)" in capsys.readouterr().err
    assert [part.read_bytes() for part in parts] == before
