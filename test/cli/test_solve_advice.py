# SPDX-License-Identifier: Apache-2.0
"""``selfcal solve`` says in one line what helps detections that nothing identifies."""

import json
from dataclasses import replace

import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import Command, Detection, Kind, Phase
from test.support.bags import Foreign, shuffled
from test.support.plans import plan_of
from test.support.sessions import events_of, small_plan, stepped_bag
from test.support.verbs import simulate


def test_lines_that_cannot_be_told_apart_are_said_with_their_mend(tmp_path, capsys):
    events = [
        replace(e, has_id=False) if isinstance(e, Detection) else e
        for e in events_of(plan_of("0, 90, tx", 5, count=96, line=True))
    ]
    path = Foreign().write(tmp_path / "x.mcap", events)
    code = main(["solve", str(path), "--quiet"])
    first, *rest = capsys.readouterr().err.splitlines()
    finding = "96 of 96 detections were rejected as rotation_not_known: the view's rotation is not"
    assert first.startswith(f"selfcal solve: {path}: view 'line': {finding}")
    # the view of lines alone is what identifies theta
    assert code == 2 and len(rest) == 1
    assert rest[0].startswith(
        f"selfcal solve: {path}: correct this first; as it is, the marks"
    )
    mended = tmp_path / "p.yaml"
    mended.write_text(
        "measurement_collector: {ros__parameters: {max_rotation: 0.02}}\n"
    )
    assert main(["solve", str(path), "--quiet", "--params", str(mended)]) == 0
    assert capsys.readouterr().err == ""


def test_commands_that_cannot_be_followed_are_said_and_change_nothing(tmp_path, capsys):
    events = events_of(plan_of("0, 90, tx", 5, count=8, line=True))
    plain = Foreign().write(tmp_path / "plain.mcap", events)
    measure = next(
        e for e in events if isinstance(e, Command) and e.phase == Phase.MEASURE
    )
    view = measure.view
    odd = [
        replace(measure, view=replace(view, translation_m=(1e17, 0.0))),
        replace(measure, view=replace(view, grid=False, angular=False)),
        replace(measure, view=replace(view, repeats=2**32 - 1)),
        replace(measure, view_index=2**31),
    ]
    spoilt = Foreign().write(tmp_path / "spoilt.mcap", [*events, *odd])
    outputs = []
    for bag, lines in ((plain, 0), (spoilt, 4)):
        output = tmp_path / "result.json"
        assert main(["solve", str(bag), "--quiet", "--force", "-o", str(output)]) == 0
        said = capsys.readouterr().err.splitlines()
        assert len(said) == lines
        assert all(": a view command was not used: view " in line for line in said)
        outputs.append(json.loads(output.read_text()))
    assert outputs[1]["rejected"] == {"command_unusable": 4}
    assert outputs[0]["error_map"] == outputs[1]["error_map"]


@pytest.mark.parametrize("placed", [{"rotation_deg": 180}, {"rotation_deg": -90}])
def test_a_plate_placed_otherwise_is_bad_input_and_not_a_deficient_plan(
    tmp_path, capsys, placed
):
    plan = {
        "plan_id": "p",
        "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 0},
        "views": [
            {"name": "a", "repeats": 2},
            {"name": "b", "rotation_deg": 90, "repeats": 2},
            {"name": "c", "translation_pitch": [1, 0], "repeats": 2},
        ],
    }
    simulate(tmp_path, "bag", plan, placed=[{"name": "b"} | placed])
    capsys.readouterr()
    assert main(["solve", str(tmp_path / "bag"), "--quiet"]) == 2
    first, last = capsys.readouterr().err.splitlines()
    assert (
        f"the plate lies turned by {placed['rotation_deg'] % 360}°, not by 90°" in first
    )
    assert "bag: correct this first; as it is, the marks" in last


@pytest.mark.parametrize(
    "step_s, code, way",
    [(37.0, 3, "back by 37 s"), (-37.0, 0, "ahead by 37 s"), (0.2, 0, "back by 0.2 s")],
)
def test_a_clock_that_stepped_is_named_first_and_in_the_result(
    tmp_path, capsys, step_s, code, way
):
    bag, out = str(stepped_bag(tmp_path, step_s)), tmp_path / "r.json"
    assert main(["solve", bag, "-o", str(out), "--quiet"]) == code
    first, *rest = capsys.readouterr().err.splitlines()
    line = (
        "the clock that stamps stage/joint_states and stage/mark_detections stepped "
        f"{way} in view '90', at 17000000"
    )
    assert first.startswith(f"selfcal solve: {bag}: {line}")
    *others, last = json.loads(out.read_text())["warnings"]
    # marks that the step lost may leave sites that nothing checks
    assert last.startswith(line)
    assert all(
        "that no other checks" in other
        or other.startswith("view '90' is only partly in the map: ")
        for other in others
    )
    assert code == 0 or rest[-1].startswith(
        f"selfcal solve: {bag}: correct this first; as it is, the marks"
    )


def test_the_same_messages_without_a_step_name_no_clock(tmp_path, capsys):
    path = Foreign().write(
        tmp_path / "x.mcap", shuffled(events_of(small_plan("0, 90, tx")))
    )
    assert main(["solve", str(path), "--quiet"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", [Kind.GRID, Kind.ANGULAR])
@pytest.mark.parametrize("sigma", [1e4, 1e-200])
def test_a_sigma_that_cannot_be_is_one_line_and_costs_that_detection(
    tmp_path, capsys, sigma, kind
):
    events = [
        replace(e, sigma=2e-8 if e.kind == Kind.GRID else 2e-5)
        if isinstance(e, Detection)
        else e
        for e in events_of(small_plan("0, 90, tx"))
    ]
    index = next(
        n for n, e in enumerate(events) if isinstance(e, Detection) and e.kind == kind
    )
    events[index] = replace(events[index], sigma=sigma)
    path = Foreign().write(tmp_path / "x.mcap", events)
    assert main(["solve", str(path), "--quiet", "-o", str(tmp_path / "r.json")]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"selfcal solve: {path}: 1 detection rejected as sigma_out_of_range: "
    )
    result = json.loads((tmp_path / "r.json").read_text())
    assert result["rejected"] == {"sigma_out_of_range": 1}


def test_reversed_offsets_are_one_line_that_names_the_bag_and_no_result(
    tmp_path, capsys
):
    events = [
        replace(e, offset_x=-e.offset_x, offset_y=-e.offset_y)
        if isinstance(e, Detection)
        else e
        for e in events_of(small_plan(repeats=9))
    ]
    path, out = Foreign().write(tmp_path / "x.mcap", events), tmp_path / "r.json"
    for more in ([], ["--robust"], ["--method", "law"]):
        assert main(["solve", str(path), "-o", str(out), *more]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(
            f"selfcal solve: {path}: plan '0, 90, tx', stage/mark_detections: offsets "
            "of the other sign: offset_x and offset_y rise"
        )
        assert not out.exists()
