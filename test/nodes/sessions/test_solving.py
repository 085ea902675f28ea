# SPDX-License-Identifier: Apache-2.0
"""The session of the solver: which readings count, runs kept apart, files, and what is told."""

import json
import os
import platform
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.inputs import (
    MAX_TEXT,
    Command,
    Detection,
    Kind,
    Phase,
    begun_ns,
)
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.errors import InputError, NoDataError, NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.files import read_json
from selfcal_ros.model.readings import session_digest, view_digest
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.terms import default_terms
from selfcal_ros.nodes.sessions.clocks import PlanRun, supersedes
from selfcal_ros.nodes.sessions.compensating import (
    plan_file_name,
    read_result,
    result_file,
)
from selfcal_ros.nodes.sessions.health import Level
from selfcal_ros.nodes.sessions.solving import RETRY_S, SolvingSession, solve
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.settings.estimator import solver_options
from selfcal_ros.settings.nodes import SolverSettings
from test.support.plans import image_plan
from test.support.ports import START_NS, Hands, message, settings_of
from test.support.sessions import collected, events_of, small_plan

PLAN = small_plan()
OTHER_SIGN = (
    np.kron(np.ones((2, 2)), np.eye(2)) * 1e-8
).ravel()  # offsets rise with x, y
# which images show
ASSUMED = [term.name for term in default_terms() if term.name != "yaw"]


def views_of(
    plan=PLAN, seed: int = 5, run_id: str = "", *, grid: bool = True, **changes
) -> list:
    """Return the ViewMeasurement messages of a run, stamps 10, 11, ...; with marks or without."""
    _, measurements, progress = collected(
        [
            event
            for event in events_of(plan, seed)
            if grid or not isinstance(event, Detection) or event.kind == Kind.ANGULAR
        ]
    )
    return [
        message(
            "ViewMeasurement",
            from_model.view_measurement(view, measurements, 10 + index, "stage")
            | {"run_id": run_id}
            | changes,
        )
        for index, view in progress.items()
    ]


def command(
    views: int,
    run_id: str = "",
    plan_id: str = PLAN.plan_id,
    phase: Phase = Phase.MEASURE,
) -> object:
    told = Command(
        begun_ns(run_id) or 1,
        phase,
        plan_id,
        0,
        PLAN.views[0],
        PLAN.artifact,
        views,
        run_id,
    )
    return message("ViewCommand", from_model.command(told, "stage"))


class Desk:
    def __init__(self, **parameters) -> None:
        self.hands = Hands()
        self.session = SolvingSession(
            settings_of("solver", **parameters), self.hands.ports
        )

    def take(self, messages: list) -> None:
        for item in messages:
            self.session.take_measurement(item)
        self.solve()

    def solve(self) -> bool:
        job = self.session.next_job()
        if job is not None:
            self.session.take(solve(job))
        return job is not None


@pytest.fixture
def desk():
    return Desk()


def test_the_solver_estimates_the_terms_that_the_plan_asks_for(desk):
    plan = replace(PLAN, model_terms=("plate_scale:1e-06",))
    desk.take(views_of(plan))
    result = desk.session.result
    assert [term.name for term in result.model.terms] == ["plate_scale", *ASSUMED]
    assert result.provenance.extra["model_terms_from"] == "plan"
    own = Desk(model_terms=["plate_shape:1e-08"])
    own.take(views_of(plan))
    assert [term.name for term in own.session.result.model.terms] == [
        "plate_scale",
        "plate_shape",
        *(name for name in ASSUMED if name != "plate_shape"),
    ]
    assert own.session.result.provenance.extra["model_terms_from"] == "options"
    without = Desk(model_terms=["none"])
    without.take(views_of(plan))
    assert without.session.result.model.terms == ()
    assert "model_terms_from" not in without.session.result.provenance.extra


def test_a_plan_with_a_known_plate_is_a_recheck_as_offline(desk, tmp_path):
    first = collected(events_of(PLAN))[1]
    path = str(tmp_path / "first.json")
    write_json(path, result_to_dict(worded(calibrate(first, Options()))))
    plan = replace(PLAN, plan_id="again", views=PLAN.views[:1], artifact_from=path)
    desk.take(views_of(plan))
    shown = desk.session.result
    readings = collected(events_of(plan))[1]
    assert readings.artifact_from == path
    found = calibrate(
        readings, solver_options(SolverSettings.checked({}, ""), readings)
    )
    offline = worded(with_collected(found, readings.views))
    assert json.dumps(
        result_to_dict(replace(shown, run_id=offline.run_id))
    ) == json.dumps(result_to_dict(offline))
    assert shown.recheck.of == path
    (told,) = [
        fields["state"]
        for output, fields in desk.hands.published
        if output == "summary"
    ]
    assert told.startswith("Still good: no change since first.json")
    lost = Desk()
    with pytest.raises(InputError, match="no such file"):
        lost.take(views_of(replace(plan, artifact_from=str(tmp_path / "none.json"))))


def test_the_robust_solver_leaves_out_a_reading_that_contradicts_the_others():
    robust, plain = Desk(robust=True), Desk()
    for desk in (robust, plain):
        views = views_of()
        views[1].dx[3] += 5e-6
        desk.take(views)
    assert [
        (item.view, item.kind) for item in robust.session.result.parts.outliers.removed
    ] == [(PLAN.views[1].name, "grid")]
    assert robust.session.result.verdict.qualified
    assert not plain.session.result.verdict.qualified
    assert plain.session.result.parts.outliers is None


def test_pictures_come_after_what_they_show(desk):
    desk.take(views_of())
    assert [name for name, _ in desk.hands.published] == ["map", "summary", "markers"]


def test_terms_that_nobody_knows_are_told_and_the_solver_lives(desk):
    with pytest.raises(InputError) as caught:
        desk.take(views_of(model_terms=["creep"]))
    told = f"plan '{PLAN.plan_id}': model_terms: the term 'creep' is unknown"
    assert str(caught.value).startswith(told)
    assert str(desk.session.shown.problem).startswith(told)
    assert desk.hands.of("summary")[-1]["advice"] == [str(caught.value)]
    desk.take(views_of())
    assert [term.name for term in desk.session.result.model.terms] == ASSUMED


def test_a_refusal_replaces_the_summary_of_a_map_and_its_verdict(desk):
    """The summary is latched: whoever asks at the end must not get that of earlier readings."""
    views = views_of(run_id="7")
    desk.session.take_command(command(4, run_id="7"))
    desk.take(views)
    assert desk.hands.of("summary")[-1]["qualified"]
    views[1].motion, views[1].dof_motion = OTHER_SIGN, 50
    with pytest.raises(InputError) as caught:
        desk.take([views[1]])
    last = desk.hands.of("summary")[-1]
    assert "other sign" in str(caught.value) and last["advice"] == [str(caught.value)]
    assert str(caught.value).startswith(last["state"].rstrip("."))
    assert (last["views_done"], last["views_planned"], last["run_id"]) == (4, 4, "7")
    assert (last["identifiable"], last["qualified"], last["grade"]) == (False, False, 0)
    assert np.isnan(last["max_error_um"]) and np.isnan(last["rms_uncertainty_um"])
    assert message("CalibrationSummary", last).state == last["state"]
    assert len(desk.hands.of("map")) == 1


def test_readings_of_two_runs_are_never_mixed(desk):
    old, new = views_of(seed=5, run_id="100"), views_of(seed=6, run_id="200")
    desk.take(old)
    desk.take(new[:2])
    summary = desk.hands.of("summary")[-1]
    assert (summary["views_done"], summary["run_id"], summary["identifiable"]) == (
        2,
        "200",
        False,
    )
    desk.take([*new[2:], old[3]])
    last = desk.hands.of("map")[-1]
    _, fresh, _ = collected(events_of(PLAN, 6))
    np.testing.assert_array_equal(last["gx"], calibrate(fresh).error_map.gx.ravel())
    assert last["run_id"] == "200"
    assert desk.session.diagnosis().values["left_aside"] == 1


@pytest.mark.parametrize(
    "new, current, later",
    [
        (PlanRun("a", "2"), PlanRun("a", "1"), True),
        (PlanRun("a", "1"), PlanRun("a", "2"), False),
        (PlanRun("a", "10"), PlanRun("a", "9"), True),
        (PlanRun("b", "1"), PlanRun("a", "2"), False),
        (PlanRun("b"), PlanRun("a", "2"), False),
        (PlanRun("a", "2"), PlanRun("a"), True),
        (PlanRun("b"), PlanRun("a"), True),
        (PlanRun("b", "2"), PlanRun("a", "2"), False),
        (PlanRun("a", "x"), PlanRun("a", "2"), False),
        (PlanRun("a", "9" * 21), PlanRun("a", "2"), False),
        (PlanRun("a", "2"), PlanRun("a", "9" * 21), True),
        (PlanRun("a", "2"), PlanRun("a", "9" * 20), False),
    ],
)
def test_the_later_run_supersedes(new, current, later):
    assert supersedes(new, current) is later


@pytest.mark.parametrize("run_id", ["", "no stamp"])
def test_readings_that_name_no_beginning_take_nothing_from_a_run_that_does(
    desk, run_id
):
    views = views_of(run_id="100")
    desk.take(views[:2])
    with pytest.raises(InputError, match="readings without a run_id, while run 100"):
        desk.take(views_of(seed=6, run_id=run_id)[:1])
    desk.take(views[2:])
    last = desk.hands.of("map")[-1]
    _, measurements, _ = collected(events_of(PLAN))
    np.testing.assert_array_equal(
        last["gx"], calibrate(measurements).error_map.gx.ravel()
    )
    assert last["run_id"] == "100"


def test_names_of_runs_that_are_kept_are_no_longer_than_messages_to_the_collector(desk):
    desk.session.take_command(command(4, run_id="7", plan_id="x" * (MAX_TEXT - 1)))
    with pytest.raises(
        InputError, match="plan_id and run_id are longer than 8192 characters"
    ):
        desk.session.take_command(command(4, run_id="7", plan_id="x" * MAX_TEXT))


def test_what_arrives_while_a_job_runs_is_solved_next_and_a_newer_run_discards_it(desk):
    old, new = views_of(seed=5, run_id="1"), views_of(seed=6, run_id="2")
    for item in old[:3]:
        desk.session.take_measurement(item)
    running = desk.session.next_job()
    assert desk.session.next_job() is None
    desk.session.take_measurement(old[3])
    desk.session.take(solve(running))
    assert desk.session.digest() == ""  # not of the newest readings
    assert desk.solve()
    assert desk.session.digest() != ""
    late = solve(running)
    for item in new:
        desk.session.take_measurement(item)
    shown = len(desk.hands.published)
    desk.session.take(late)
    assert len(desk.hands.published) == shown


@pytest.mark.parametrize("first, second, counts", [(1, 2, 2), (2, 1, 2)])
def test_the_session_rejections_are_those_of_the_newest_view(
    desk, first, second, counts
):
    messages = views_of()[:2]
    for item, number in zip(messages, (first, second), strict=True):
        item.session_reject_reasons, item.session_reject_counts = (
            ["outside_every_view"],
            [number],
        )
    desk.take(messages)
    assert desk.session.measurements().rejected == {"outside_every_view": counts}


def test_the_stamp_is_that_of_the_newest_reading(desk):
    desk.take(list(reversed(views_of())))
    assert desk.hands.of("map")[-1]["header"]["stamp"]["nanosec"] == 13


@pytest.mark.parametrize(
    "planned, level, line",
    [
        (4, Level.OK, "1 of 4 views measured, not yet enough to identify the stage."),
        (1, Level.WARN, None),
    ],
)
def test_a_deficient_plan_is_a_warning_once_all_its_views_are_measured(
    tmp_path, planned, level, line
):
    desk = Desk(result_folder=str(tmp_path))
    desk.session.take_command(command(planned))
    desk.take(views_of()[:1])
    told = desk.session.diagnosis()
    assert told.level == level
    assert (told.message == line) is (line is not None)
    with pytest.raises(NotIdentifiableError):
        desk.session.save("x.json")
    saved = read_json(tmp_path / "x.json")
    assert (saved["plan_id"], saved["observability"]["identifiable"]) == (
        PLAN.plan_id,
        False,
    )
    (tmp_path / "good.json").write_text("a map")
    with pytest.raises(NotIdentifiableError):
        desk.session.save("good.json")
    assert (tmp_path / "good.json").read_text() == "a map"
    assert desk.session.diagnosis().values["saved"] == ""


def test_after_done_no_view_is_to_come_and_the_missing_one_is_named(desk):
    """A view that was skipped before anything was read never comes."""
    desk.session.take_command(command(4, run_id="7"))
    desk.take(views_of(run_id="7")[:1])
    assert desk.hands.of("summary")[-1]["advice"] == ["3 views to come"]
    desk.session.take_command(command(4, run_id="7", phase=Phase.DONE))
    assert desk.solve()
    last = desk.hands.of("summary")[-1]
    assert (last["views_done"], last["views_planned"]) == (1, 4)
    assert "do not identify the stage" in last["state"]
    assert (
        last["advice"]
        == [advice.text for advice in desk.session.result.observability.advice]
        != []
    )
    assert desk.session.diagnosis().level == Level.WARN


def test_what_an_earlier_run_lacks_is_no_warning_while_a_newer_one_is_measured(desk):
    """A restarted solver is sent the readings of an aborted run again."""
    desk.take(views_of(run_id=str(NOW))[:1])
    assert desk.session.diagnosis().level == Level.WARN
    desk.session.take_command(command(4, run_id=str(NOW + 5)))
    told = desk.session.diagnosis()
    assert told.level == Level.OK
    assert told.message.startswith(f"the earlier run {NOW}: the marks that were read")


def test_a_view_of_lines_alone_is_no_error_while_others_are_to_come(desk):
    lines = views_of()[3:]
    assert [len(view.m) for view in lines] == [0]
    desk.session.take_command(command(4))
    desk.take(lines)
    assert desk.hands.said == [
        (Level.OK, "1 of 4 views measured, not yet enough to identify the stage.")
    ]
    assert desk.hands.of("summary")[-1]["state"] == desk.hands.said[0][1]
    assert desk.hands.of("summary")[-1]["advice"] == ["3 views to come"]
    assert desk.session.diagnosis().level == Level.OK
    with pytest.raises(NoDataError, match="no grid mark was read"):
        desk.session.save("x.json")


def test_lines_of_all_views_are_a_beginning_until_done(desk):
    """Of messages that come shuffled, lines of every view may be there before any mark is."""
    lines = views_of(grid=False)
    assert [len(view.m) for view in lines] == [0] * 4 and all(
        len(view.k) for view in lines
    )
    desk.session.take_command(command(4))
    desk.take(lines)
    state = "4 of 4 views measured, not yet enough to identify the stage."
    assert desk.hands.said == [(Level.OK, state)]
    told = desk.session.diagnosis()
    assert (told.level, told.message) == (Level.OK, state)
    desk.take(views_of())
    assert desk.session.shown.problem is None
    desk.session.take_command(command(4, phase=Phase.DONE))
    assert not desk.solve()  # nothing is missing: DONE tells nothing new
    alone = Desk()
    alone.session.take_command(command(4))
    alone.take(lines)
    alone.session.take_command(command(4, phase=Phase.DONE))
    with pytest.raises(NoDataError, match="no grid mark was read"):
        alone.solve()
    assert alone.session.diagnosis().level == Level.WARN
    # solved
    assert alone.session.digest() == alone.session.diagnosis().values["readings"] != ""
    ended = Desk()  # where DONE came first
    ended.session.take_command(command(4, phase=Phase.DONE))
    with pytest.raises(NoDataError, match="no grid mark was read"):
        ended.take(lines)


def test_lines_that_come_before_any_command_are_no_error(desk):
    lines, grids = views_of(run_id="7")[3:], views_of(run_id="7")[:3]
    desk.take(lines)
    state = "1 view measured so far, not yet enough to identify the stage."
    assert desk.hands.said == [(Level.OK, state)]
    told = desk.session.diagnosis()
    assert (told.level, told.message) == (Level.OK, state)
    desk.session.take_command(command(4, run_id="7"))
    desk.take(grids)
    assert desk.session.shown.problem is None
    desk.session.take_command(command(4, run_id="7", phase=Phase.DONE))
    assert not desk.solve()
    assert [level for level, _ in desk.hands.said] == [Level.OK]


@pytest.mark.parametrize("run_id", ["", "7"])
def test_done_without_a_number_of_views_says_that_lines_alone_were_read(desk, run_id):
    desk.take(views_of(run_id="7")[3:])
    desk.session.take_command(command(0, run_id="8", phase=Phase.DONE))
    assert not desk.solve()
    desk.session.take_command(command(0, run_id=run_id))
    assert not desk.solve()
    desk.session.take_command(command(0, run_id=run_id, phase=Phase.DONE))
    with pytest.raises(NoDataError, match="no grid mark was read"):
        desk.solve()
    assert desk.session.diagnosis().level == Level.WARN


def test_more_planned_views_are_told_and_fewer_change_nothing(desk):
    desk.take(views_of())
    for views, solved in ((4, True), (4, False), (3, False), (5, True)):
        desk.session.take_command(command(views))
        assert desk.solve() is solved
    assert desk.hands.of("summary")[-1]["views_planned"] == 5
    desk.session.take_command(command(9, run_id="other"))
    assert not desk.solve()


@pytest.mark.parametrize(
    "field, value, problem",
    [
        ("dx", np.zeros(3), "m, n, dx, dy, count differ in length"),
        (
            "reject_reasons",
            ["one"],
            "reject_reasons and reject_counts differ in length",
        ),
    ],
)
def test_readings_that_contradict_themselves_are_refused_at_once(
    desk, field, value, problem
):
    bad = views_of()[0]
    setattr(bad, field, value)
    with pytest.raises(InputError, match=problem):
        desk.session.take_measurement(bad)
    assert desk.session.next_job() is None


def test_two_plates_in_one_run_are_told(desk):
    one, two = views_of()[:2]
    two.grid_pitch *= 2
    desk.session.take_measurement(one)
    desk.session.take_measurement(two)
    with pytest.raises(
        InputError, match="views of different plates in one plan; measure one"
    ):
        desk.session.next_job()
    assert desk.session.diagnosis().level == Level.WARN


def test_nothing_to_save_yet(desk):
    with pytest.raises(
        NoDataError, match="there is no map yet; measure the views of the plan"
    ):
        desk.session.save("map.json")


def test_maps_are_saved_in_the_folder_of_results_alone(tmp_path):
    desk = Desk(result_folder=str(tmp_path))
    desk.take(views_of())
    line, path = desk.session.save("map.json")
    assert path == str(tmp_path / "map.json")
    assert line.startswith(f"saved to {path}: plan '{PLAN.plan_id}'; readings ")
    assert json.loads((tmp_path / "map.json").read_text())["plan_id"] == PLAN.plan_id
    for outside in ("../map.json", "/tmp/map.json", f"{tmp_path}/../x.json"):
        with pytest.raises(
            InputError, match=r"lies outside of .*; name a file in it, or set the "
        ):
            desk.session.save(outside)


def test_a_link_out_of_the_folder_is_outside(tmp_path):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path)
    with pytest.raises(InputError, match="lies outside of"):
        result_file("link/map.json", str(tmp_path / "in"))


@pytest.mark.parametrize(
    "plan_id, name",
    [
        ("hu", "hu.json"),
        ("../../x", "_.._x.json"),
        ("/etc/passwd", "_etc_passwd.json"),
        ("", "plan.json"),
        ("..", "plan.json"),
        ("a b\x1b[2J", "a_b__2J.json"),
    ],
)
def test_a_plan_names_no_file_elsewhere(plan_id, name):
    assert plan_file_name(plan_id) == name


@pytest.mark.parametrize(
    "run_id, name",
    [("17", "map_17.json"), ("", "map_run.json"), ("../../x", "map__.._x.json")],
)
def test_each_run_has_a_file_of_its_own_and_the_health_names_it(tmp_path, run_id, name):
    desk = Desk(
        save_path=str(tmp_path / "map_{run_id}.json"), result_folder=str(tmp_path)
    )
    assert desk.session.diagnosis().values["saved"] == ""
    desk.take(views_of(run_id=run_id))
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert desk.session.diagnosis().values["saved"] == str(tmp_path / name)
    assert json.loads((tmp_path / name).read_text())["plan_id"] == PLAN.plan_id
    desk.session.save("other.json")
    assert desk.session.diagnosis().values["saved"] == str(tmp_path / "other.json")
    desk.session.load(str(tmp_path / name))
    assert desk.session.diagnosis().values["saved"] == ""


def test_a_map_that_cannot_be_saved_by_itself_is_still_published(tmp_path):
    desk = Desk(
        save_path=str(tmp_path / "no" / "map.json"), result_folder=str(tmp_path)
    )
    desk.take(views_of())
    [line] = desk.hands.lines(Level.ERROR)
    problem = f"{tmp_path}/no/map.json: cannot be written"
    assert line.startswith(f"save_path: {problem}")
    assert desk.hands.of("map")
    told = desk.session.diagnosis()
    assert (
        told.level == Level.WARN and f"the map is not saved: {problem}" in told.message
    )
    assert desk.session.save("map.json")[1] == str(tmp_path / "map.json")


def test_a_map_that_could_not_be_saved_is_saved_once_there_is_space(tmp_path):
    path = tmp_path / "no" / "map.json"
    desk = Desk(save_path=str(path), result_folder=str(tmp_path))
    desk.take(views_of())
    desk.hands.pass_time(RETRY_S - 1)
    desk.session.save_again()
    desk.hands.pass_time(1)
    desk.session.save_again()  # in vain, and not told again
    assert len(desk.hands.lines(Level.ERROR)) == 1
    path.parent.mkdir()
    desk.hands.pass_time(RETRY_S - 1)
    desk.session.save_again()
    assert not path.exists()
    desk.hands.pass_time(1)
    desk.session.save_again()
    assert json.loads(path.read_text())["plan_id"] == PLAN.plan_id
    told = desk.session.diagnosis()
    assert (told.level, told.values["saved"]) == (Level.OK, str(path))
    assert desk.hands.lines(Level.OK)[-1] == f"the map is saved now: {path}"
    path.unlink()
    desk.hands.pass_time(2 * RETRY_S)
    desk.session.save_again()
    assert not path.exists()


def test_a_map_that_waits_for_space_is_written_though_the_next_run_has_none(tmp_path):
    """The result of the next run is no map: it must not take the place of one."""
    path = tmp_path / "no" / "map.json"
    desk = Desk(save_path=str(path), result_folder=str(tmp_path))
    desk.take(views_of(run_id=str(START_NS)))
    desk.session.take_command(command(1, run_id=str(START_NS + 1)))
    desk.take(views_of(run_id=str(START_NS + 1))[:1])
    told = desk.session.diagnosis()
    assert f"the map is not saved: {path}" in told.message
    path.parent.mkdir()
    desk.hands.pass_time(RETRY_S)
    desk.session.save_again()
    written = json.loads(path.read_text())
    assert written["run_id"] == str(START_NS)
    assert written["observability"]["identifiable"]
    told = desk.session.diagnosis()
    assert "not saved" not in told.message and told.values["saved"] == ""


def test_a_map_that_cannot_be_written_keeps_no_other_from_its_file(tmp_path):
    """A folder has the name of the first run's file."""
    runs = [str(START_NS), str(START_NS + 1)]
    first, second = (tmp_path / f"map_{run}.json" for run in runs)
    first.mkdir()
    desk = Desk(
        save_path=str(tmp_path / "map_{run_id}.json"), result_folder=str(tmp_path)
    )
    desk.take(views_of(run_id=runs[0]))
    desk.session.take_command(command(1, run_id=runs[1]))
    desk.take(views_of(run_id=runs[1]))
    assert json.loads(second.read_text())["run_id"] == runs[1]
    assert "the map is not saved" in desk.session.diagnosis().message
    first.rmdir()
    desk.hands.pass_time(RETRY_S)
    desk.session.save_again()
    assert json.loads(first.read_text())["run_id"] == runs[0]
    assert "not saved" not in desk.session.diagnosis().message


def test_only_regular_files_are_loaded(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, problem in (
        (tmp_path / "pipe", "is not a regular file"),
        ("/dev/zero", "is not a regular file"),
        (tmp_path, "is a folder, and no map"),
        ("", "is empty"),
        (tmp_path / "no", "no such file; check the path"),
        ("a\0b", "cannot be read"),
    ):
        with pytest.raises(InputError, match=problem):
            read_result(str(path))


def test_a_file_beyond_any_result_is_not_read(tmp_path):
    """It has no blocks: whoever reads it reads zeros, a GiB of them."""
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate(2**30)
    with pytest.raises(
        InputError, match="has 1073741824 bytes, more than 33554432; name"
    ):
        read_result(str(tmp_path / "huge.json"))


def test_a_map_is_saved_into_a_file_or_a_new_one_alone(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    (tmp_path / "old.json").touch()
    for path, problem in (
        ("pipe", "^pipe: is not a regular file; name another file$"),
        ("folder", "is not a regular file"),
        ("", "is empty"),
        ("a\0b", "is not a file name"),
        ("../x", "lies outside"),
    ):
        with pytest.raises(InputError, match=problem):
            result_file(path, str(tmp_path))
    for path in ("old.json", "new.json"):
        assert result_file(path, str(tmp_path)) == tmp_path / path


def test_a_number_of_400_digits_is_refused(tmp_path):
    desk = Desk(result_folder=str(tmp_path))
    desk.take(views_of())
    desk.session.save("map.json")
    text = (tmp_path / "map.json").read_text()
    data = json.loads(text)
    data["error_map"]["gx"][0][0] = int("9" * 400)
    (tmp_path / "map.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"map\.json"):
        desk.session.load(str(tmp_path / "map.json"))


def test_a_map_tells_run_and_verdict(desk):
    desk.take(views_of(run_id="7"))
    published, summary = desk.hands.of("map")[-1], desk.hands.of("summary")[-1]
    assert (published["qualified"], published["run_id"]) == (True, "7")
    assert (summary["qualified"], summary["run_id"], summary["causes"]) == (
        True,
        "7",
        [],
    )
    assert to_model.error_map(message("ErrorMap", published)).artifact == PLAN.artifact


def test_what_is_noted_of_the_session_is_a_warning_of_the_result(desk):
    first, *others = views_of()
    first.session_notes = ["the clock stepped \x1b[2J"] + ["more"] * 30
    desk.take([*others, first])
    assert desk.session.result.warnings[-20:] == (
        r"the clock stepped \x1b[2J",
        *["more"] * 19,
    )
    first.session_notes = []
    desk.take([first])  # the newest word counts
    assert "more" not in desk.session.result.warnings


FAULTS = """
import resource
import numpy as np
from selfcal_ros.nodes.sessions.solving import keep_freed_memory

def faults():
    def work():
        return [np.ones(12_500) for _ in range(200)]
    work()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(5):
        work()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

print(faults())
keep_freed_memory()
print(faults())
"""
"""Five times twenty megabytes in small blocks, taken and freed: pages that come anew."""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_memory_that_is_freed_is_kept_for_the_next_solution():
    done = subprocess.run(
        [sys.executable, "-c", FAULTS], capture_output=True, text=True, check=True
    )
    before, after = map(int, done.stdout.split())
    assert before > 1000 > 100 > after  # how many depends on the free end of the heap


NOW = START_NS
DAY_NS = 86400 * 10**9


def test_a_saved_map_names_its_run_and_a_newer_one_that_is_not_in_it(tmp_path):
    desk = Desk(result_folder=str(tmp_path))
    desk.session.take_command(command(4, run_id=str(NOW)))
    desk.take(views_of(run_id=str(NOW)))
    line, _ = desk.session.save("map.json")
    assert f": plan '{PLAN.plan_id}', run {NOW}; readings " in line
    assert "WARNING" not in line
    # an older one, heard late
    desk.session.take_command(command(4, run_id=str(NOW - 5)))
    # of a clock that is ahead
    desk.session.take_command(command(4, run_id=str(NOW + DAY_NS)))
    assert "WARNING" not in desk.session.save("map.json")[0]
    desk.session.take_command(command(4, run_id=str(NOW + 7)))
    line, _ = desk.session.save("map.json")
    assert line.endswith(
        f"; WARNING: the newer run {NOW + 7} of plan '{PLAN.plan_id}' is not in this map: none of "
        "its readings has arrived; the health of measurement_collector says why"
    )
    assert desk.session.diagnosis().level == Level.OK  # it may be measured just now
    desk.session.take_command(command(4, run_id=str(NOW + 7), phase=Phase.DONE))
    told = desk.session.diagnosis()
    assert told.level == Level.WARN and told.message.startswith(
        f"the newer run {NOW + 7} of plan"
    )
    desk.take(views_of(run_id=str(NOW + 7)))
    assert desk.session.diagnosis().level == Level.OK
    assert "WARNING" not in desk.session.save("map.json")[0]


def test_a_saved_map_tells_that_it_is_not_qualified_and_what_it_lacks(tmp_path):
    desk = Desk(result_folder=str(tmp_path))
    views = views_of()
    views[1].dx[3] += 5e-6
    desk.take(views)
    shown = desk.session.shown
    assert not shown.result.verdict.qualified
    lacking = replace(shown.result, warnings=("one view is partly in the map",))
    desk.session.shown = replace(shown, result=lacking)
    assert desk.session.save("map.json")[0].endswith(
        f"; WARNING: {lacking.verdict.sentence}; WARNING: one view is partly in the map"
    )


def test_a_saved_map_tells_of_views_whose_readings_never_came(tmp_path):
    """They were lost on the way, or their collector died before this solver was started."""
    desk = Desk(result_folder=str(tmp_path))
    views = views_of(small_plan("0, 90, tx, ty"))
    desk.session.take_command(command(len(views), plan_id=views[0].plan_id))
    desk.take(views[:3] + views[4:])
    assert desk.session.result.verdict.qualified
    line, _ = desk.session.save("map.json")
    assert (
        "; WARNING: 4 of 5 views of the plan are in this map: the readings of" in line
    )
    desk.take(views)
    assert "WARNING" not in desk.session.save("map.json")[0]
    desk.session.load(str(tmp_path / "map.json"))
    assert "WARNING" not in desk.session.save("map.json")[0]


def test_readings_of_a_run_of_the_future_are_refused(desk):
    desk.take(views_of(run_id=str(NOW)))
    with pytest.raises(
        InputError, match="begins in the future of this node's clock; set the"
    ):
        desk.take(views_of(run_id=str(NOW + DAY_NS)))
    assert desk.session.shown.run.run_id == str(NOW)


def test_a_run_from_before_the_clock_was_set_back_gives_way(desk):
    desk.hands.seconds += 86400
    desk.take(views_of(run_id=str(NOW + DAY_NS)))
    desk.hands.seconds -= 86400
    desk.take(views_of(run_id=str(NOW)))
    assert desk.hands.of("summary")[-1]["run_id"] == str(NOW)
    assert desk.session.diagnosis().values["left_aside"] == 0


@pytest.mark.parametrize("phase", [Phase.MEASURE, Phase.DONE])
def test_while_views_are_to_come_no_view_is_advised(desk, phase):
    """After DONE they are missing as well: what was skipped may be measured in a redo."""
    views = views_of()
    desk.session.take_command(command(4))
    desk.take(views[:1])
    assert desk.hands.of("summary")[-1]["advice"] == ["3 views to come"]
    desk.take(views[1:2])
    assert desk.hands.of("summary")[-1]["advice"][0] == "2 views to come"
    short = Desk()
    short.session.take_command(command(1))
    short.take(views[:1])
    assert "add a view turned by 90" in short.hands.of("summary")[-1]["advice"][0]


def test_the_cells_of_an_image_are_solved_together():
    plan = image_plan(5, count=8)
    _, measurements, progress = collected(events_of(plan))
    messages = [
        message(
            "ViewMeasurement",
            from_model.view_measurement(
                replace(view, readings=part), measurements, 10 + index, "stage"
            ),
        )
        for index, view in progress.items()
        for part in view.readings.parts
    ]
    assert len(messages) == 9 + 9 + 1
    desk = Desk()
    for item in messages[::-1][:-1]:
        desk.session.take_measurement(item)
    assert not desk.solve()  # a cell of the first view is still to come
    desk.take(messages[:1])
    assert desk.session.shown.views_done == 3
    expected = calibrate(measurements)
    np.testing.assert_array_equal(
        desk.session.result.error_map.gx, expected.error_map.gx
    )
    np.testing.assert_array_equal(
        desk.session.result.error_map.u_gx, expected.error_map.u_gx
    )
    assert desk.session.digest() == session_digest(
        {
            index: view_digest(view.readings.parts, measurements.rejected)
            for index, view in progress.items()
        }
    )
