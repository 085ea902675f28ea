# SPDX-License-Identifier: Apache-2.0
"""Lists of marks: read from files, identified with and without ids, expected and missing."""

from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.expected import expected_marks, missing_marks
from selfcal_ros.collection.inputs import Command, Phase, Reason, check_view
from selfcal_ros.collection.marks.identify import IdentityRules, identify_grid
from selfcal_ros.errors import InputError
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.marks import marks_of
from selfcal_ros.model.plan_form import plan_from_dict, plan_to_dict
from selfcal_ros.model.readings import ViewReadings, placing_digest
from selfcal_ros.model.view import View
from selfcal_ros.model.visit_order import visit_sequence
from selfcal_ros.nodes.sessions.watching import plate_picture
from selfcal_ros.settings.estimator import plan_of
from test.bagio.messages.test_convert import through_cdr
from test.support.mark_lists import HALF_M, lattice, rings, scatter

RULES = IdentityRules(1e-3, 0.5, 0.02)
VIEW = View("v", np.radians(37), (4e-3, -7e-3))
GOOD = "id,x,y\n1,-0.05,-0.05\n2,0.05,-0.05\n3,-0.05,0.05\n4,0.05,0.05\n5,0.0,0.01\n"
PLAN = {
    "plan_id": "p",
    "artifact": {"marks": "marks.csv", "angular_count": 8},
    "map": {"grid_size": 3},
    "views": [{"name": "a"}],
}


def planned(folder, text: str, **changes):
    (folder / "marks.csv").write_bytes(
        text if isinstance(text, bytes) else text.encode()
    )
    return plan_of(PLAN | changes, "PLAN.yaml", folder)


def test_a_plan_reads_its_marks_from_a_table(tmp_path):
    """In any order, with further columns; a plan written back has them in it."""
    plan = planned(
        tmp_path,
        "# plate 7\nname,Y_m,id,x_m\n"
        "a,-0.05,9,-0.05\nb,-0.05,-2,0.05\n\nc,0.05,3,-0.05\nd,0.05,40,0.05\n",
    )
    marks = plan.artifact.marks
    assert marks.ids == (-2, 3, 9, 40)
    assert (marks.x_m[1], marks.y_m[1]) == (-0.05, 0.05)
    assert plan.artifact.angular_count == 8 and plan.artifact.field.shape == (3, 3)
    assert plan.artifact.field_half_m == pytest.approx((0.05, 0.05))
    written = plan_to_dict(plan)
    assert written["artifact"]["marks"]["id"] == [-2, 3, 9, 40]
    assert plan_from_dict(written, "again") == plan
    moved = planned(
        tmp_path, GOOD, views=[{"name": "a", "translation_mm": [6.5, -1.0]}]
    )
    assert moved.views[0].translation_m == (0.0065, -0.001)
    assert plan_from_dict(plan_to_dict(moved), "again") == moved


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "id,x\n1,0\n",
            r"marks.csv:1: no column y; begin with the line id,x,y \(x and y in m\)",
        ),
        ("", r"marks.csv:1: no column id, x, y"),
        ("id,x,y,Y_m\n", r"marks.csv:1: two columns y; leave the right one of them"),
        (GOOD + "6,0.01\n", r"marks.csv:7: 2 cells, not 3; correct the line"),
        (GOOD + "6,a,0\n", r"marks.csv:7: x 'a' is not a number"),
        (GOOD + "6,0.0_1,0\n", r"marks.csv:7: x '0.0_1' is not a number"),
        (GOOD + "1_0,0,0\n", r"marks.csv:7: id '1_0' is not a whole number"),
        (GOOD + "b,0,0\n", r"marks.csv:7: id 'b' is not a whole number"),
        (GOOD + "1.0,0,0\n", r"marks.csv:7: id '1.0' is not a whole number"),
        (
            GOOD + "3,0.02,0\n",
            r"marks.csv:7: the id 3 is used already in .*marks.csv:4",
        ),
        (GOOD + "6,0.05,0.05\n", r"marks.csv:7: marks 4 and 6 lie at one place"),
        (GOOD + "6,nan,0\n", r"marks.csv:7: mark 6 has no place \(nan, 0\)"),
        (GOOD + "6,0,inf\n", r"marks.csv:7: mark 6 has no place"),
        (
            GOOD + "6,20.5,0\n",
            r"marks.csv:7: .*beyond every plate \(2 m\); is it in mm\?",
        ),
        (
            GOOD + f"{2**31},0,0\n",
            r"marks.csv:7: id 2147483648 is not a 32 bit integer",
        ),
        ("id,x,y\n1,0,0\n2,0,0.1\n3,0.1,0\n", r"marks.csv: 3 marks, not 4 to 10000"),
        (
            "id,x,y\n1,-.1,0\n2,-.05,0\n3,0.05,0\n4,.1,1e-6\n",
            r"marks.csv: all marks lie on one line",
        ),
        (
            "id,x,y\n1,0,0\n2,0,0.1\n3,0.1,0\n4,0.1,0.1\n",
            r"marks.csv: the marks lie about "
            r"\(0.05, 0.05\) m, not about the plate's centre; count x and y from the centre",
        ),
        (b"id,x,y\n1,0,\xff\n", r"marks.csv: byte 11: not UTF-8 text"),
    ],
)
def test_bad_tables_are_refused_in_one_line(tmp_path, text, said):
    with pytest.raises(InputError, match=said) as error:
        planned(tmp_path, text)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"artifact": {"marks": "gone.csv"}}, "gone.csv: no such file"),
        (
            {"artifact": {"marks": "marks.csv", "grid_size": 5}},
            "marks and grid_size are both given",
        ),
        ({"artifact": {"marks": 5}}, "artifact: marks: 5 is not of type dict"),
        (
            {"artifact": {"marks": {"id": [1], "x": [0.0], "y": []}}},
            "not as many numbers each",
        ),
        (
            {"map": {}},
            r"artifact marks: 5 marks are too few to choose the nodes of the map; give them "
            r"in the plan, e.g. map: \{grid_size: 3\}",
        ),
        (
            {"views": [{"name": "a", "translation_pitch": [1, 0]}]},
            r"translation_pitch: a list of marks has no pitch; give translation_mm",
        ),
        (
            {"image": {"nx": 3, "ny": 3}},
            "images show the cells of a lattice, the plate is a list",
        ),
    ],
)
def test_plans_that_a_list_cannot_have_are_refused(tmp_path, changes, said):
    with pytest.raises(InputError, match=said):
        planned(tmp_path, GOOD, **changes)


def test_the_nodes_of_the_map_are_chosen_from_the_marks():
    """At most three quarters as many a side as a lattice of as many marks; over their field."""
    for plate, size in (
        (scatter(225, 0), 11),
        (lattice(9, nodes=0), 5),
        (scatter(16, 0), 3),
    ):
        assert plate.map_grid.size == size <= 0.75 * plate.m.size**0.5
        assert plate.field_half_m == pytest.approx((HALF_M, HALF_M))
    at = np.stack(np.meshgrid(np.linspace(-1, 1, 30), np.linspace(-0.3, 0.3, 9)))
    marks = marks_of(range(270), at[0].ravel(), at[1].ravel())
    plan = plan_from_dict(
        {
            "plan_id": "p",
            "artifact": {
                "marks": {
                    "id": list(marks.ids),
                    "x": list(marks.x_m),
                    "y": list(marks.y_m),
                }
            },
            "views": [{"name": "a"}],
        },
        "f",
    )
    field = plan.artifact.field
    assert field.shape == (21, 7) and plan.artifact.field_half_m == pytest.approx(
        (1, 0.3)
    )


def read(plate: Artifact, rng, *, turn=3e-4, shift=(40e-6, -25e-6)):
    """Return where the marks in the field of VIEW are read, and their ids, (2, n) each."""
    marks, sites = VIEW.on_stage(plate).marks_in_field(plate)
    about = sites * plate.grid_pitch_m - np.array(VIEW.translation_m)[:, None]
    turned = (
        np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ about
    )
    where = turned + np.array(VIEW.translation_m)[:, None] + np.array(shift)[:, None]
    return where + rng.normal(0, 1e-6, where.shape), marks


def identified(plate, where, marks, has_id, rules=RULES):
    return identify_grid(
        plate,
        VIEW,
        where,
        ids=np.where(has_id, marks, 0),
        has_id=np.full(where.shape[1], has_id),
        rules=rules,
    )


@pytest.mark.parametrize("with_ids", [True, False])
@pytest.mark.parametrize("name", ["rings", "scatter", "holes", "lattice", "even"])
def test_marks_are_identified(name, with_ids):
    plate = {
        "rings": rings,
        "scatter": scatter,
        "holes": lambda: lattice(7, (0, 8, 24, 33)),
        "lattice": lambda: lattice(7),
        "even": lambda: lattice(8),
    }[name]()
    where, marks = read(plate, np.random.default_rng(1))
    found = identified(plate, where, marks, with_ids)
    assert not found.reasons.any()
    assert (found.index == marks).all()
    x, y = plate.places(*marks)
    site = np.stack(VIEW.on_stage(plate).site_of(x, y)) * plate.grid_pitch_m
    assert found.deviation == pytest.approx(where - site)


def test_a_plate_beside_its_place_is_identified_without_ids():
    """Scattered marks show an offset beyond half their distance, which a lattice hides."""
    plate = scatter()
    where, marks = read(
        plate, np.random.default_rng(2), shift=(0.7 * plate.grid_pitch_m, 1e-3)
    )
    found = identified(plate, where, marks, False)
    good = ~found.reasons.astype(bool)
    assert good.mean() > 0.9 and (found.index == marks)[:, good].all()


def test_marks_that_may_be_confused_are_rejected_and_named():
    """Two marks nearer to each other than the pose is known: only their ids tell them apart."""
    plate = scatter()
    marks, near = plate.marks, int(np.hypot(*plate.marks.places_m).argmin())
    twin = replace(
        plate,
        marks=marks_of(
            [*marks.ids, 999],
            [*marks.x_m, marks.x_m[near] + 30e-6],
            [*marks.y_m, marks.y_m[near]],
        ),
    )
    where, ids = read(twin, np.random.default_rng(3))
    found = identified(twin, where, ids, False)
    pair = np.isin(ids[0], [999, marks.ids[near]])
    assert pair.sum() == 2 and (found.reasons[pair] == Reason.AMBIGUOUS).all()
    assert not found.reasons[~pair].any()
    assert not identified(twin, where, ids, True).reasons.any()


def test_detections_of_no_mark_are_rejected():
    plate = lattice(7, (24,))  # the middle mark is missing
    where, marks = read(plate, np.random.default_rng(4))
    strange = np.hstack([where, np.array([VIEW.translation_m]).T])
    reasons = identified(
        plate, strange, np.hstack([marks, marks[:, :1]]), False
    ).reasons
    assert reasons[-1] == Reason.TOO_FAR and not reasons[:-1].any()
    marks[0, 5] = 123456
    found = identified(plate, where, marks, True)
    assert found.reasons[5] == Reason.UNKNOWN_MARK and not found.reasons[6:].any()


def test_marks_expected_and_missing_are_those_of_the_list():
    plate = scatter()
    inside = VIEW.pose.in_field(plate)
    assert expected_marks(plate, VIEW) == (int(inside.sum()), 0)
    m = plate.m[inside]
    readings = ViewReadings(
        VIEW, m[3:], 0 * m[3:], count=np.ones(len(m) - 3, dtype=int)
    )
    missing = missing_marks(plate, VIEW, readings)
    assert missing.m == tuple(m[:3]) and missing.n == (0, 0, 0)


def test_every_mark_is_visited_once_in_lines_one_distance_wide():
    plate = scatter()
    for order in ("raster", "serpentine", "x_then_y"):
        found = visit_sequence(plate, View("v", repeats=2), order=order)
        assert sorted(set(found.m.tolist())) == plate.m.ravel().tolist()
    found = visit_sequence(plate, View("v"), order="serpentine")
    steps = np.hypot(*np.diff([found.i, found.j], axis=1))
    assert steps.mean() < 0.5 * np.hypot(*np.diff(plate.marks.places_m)).mean() / (
        plate.grid_pitch_m
    )


def test_a_measurement_with_an_id_that_is_not_listed_is_refused():
    plate = scatter()
    good = ViewReadings(
        VIEW, plate.m[:3, 0], plate.n[:3, 0], *np.zeros((2, 3)), np.ones(3, dtype=int)
    )
    check_view(good, plate, 0)
    with pytest.raises(InputError, match="an id that is not in the list of marks"):
        check_view(replace(good, m=good.m + 1), plate, 0)


def test_the_plate_of_a_command_comes_back():
    plate = rings(angular_count=12)
    command = Command(5, Phase.MEASURE, "p", 0, replace(VIEW, angular=False), plate, 1)
    fields = from_model.command(command, "stage")
    # old software refuses it
    assert (fields["grid_size"], fields["grid_pitch"]) == (0, 0.0)
    assert to_model.command(through_cdr("ViewCommand", fields)).artifact == plate
    for names, said in ((("mark_y",), "ids, "), (("map_grid_size",), "without nodes")):
        damaged = fields | {
            name: [] if name.startswith("mark") else 0 for name in names
        }
        with pytest.raises(InputError, match=said):
            to_model.command(through_cdr("ViewCommand", damaged)).artifact.field.shape  # noqa: B018


def test_plates_with_other_marks_are_other_plates():
    one, two = scatter(), scatter(seed=4)
    assert one == scatter() and one != two
    assert placing_digest(one, VIEW) != placing_digest(two, VIEW)


def test_the_monitor_draws_marks_where_they_are():
    plate = lattice(5, (12,), nodes=3)
    gone = int(plate.m[np.argmin(np.hypot(plate.x_m + HALF_M, plate.y_m - HALF_M))][0])
    picture, step = plate_picture(plate, View("v"), [(gone, 0)], 1, 60)
    assert step == 1 and picture == [".oooo", "ooooo", "oo oo", "ooooo", "ooooo"]
    assert len(plate_picture(scatter(2000), View("v"), [], 0, 20)[0]) == 20
