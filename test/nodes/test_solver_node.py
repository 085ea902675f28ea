# SPDX-License-Identifier: Apache-2.0
"""solver: maps from readings, the services, and a plan that does not identify the stage."""

import json
import threading
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from selfcal_msgs.srv import LoadMap, SaveMap
from visualization_msgs.msg import Marker

from selfcal_ros.bagio.messages import from_model, to_model
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.collection.reduce import with_collected
from selfcal_ros.errors import ExitCode, NotIdentifiableError, NotSettledError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.options import Options
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.model.view import Plan
from selfcal_ros.nodes import names
from selfcal_ros.nodes import solver as solver_module
from selfcal_ros.nodes.filling import fill, map_geometry
from selfcal_ros.nodes.sessions.compensating import read_result
from selfcal_ros.nodes.sessions.solving import SolvingOutcome
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.summary.sections import state_line
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.reporting.words.observability import with_advice
from test.support.maps import random_map, result_of
from test.support.sessions import START_NS, collected, events_of, small_plan

PLAN = small_plan()


@cache
def readings(plan: Plan, seed: int) -> tuple:
    """Return the readings of a plan and how far each of its views is; nobody changes them."""
    return collected(events_of(plan, seed))[1:]


def measured(plan: Plan = PLAN, seed: int = 5) -> tuple:
    """Return ViewMeasurement messages of a plan, and the readings behind them."""
    measurements, progress = readings(plan, seed)
    return [
        fill(
            names.MEASUREMENT.type(),
            from_model.view_measurement(view, measurements, 10 + index, "stage"),
        )
        for index, view in progress.items()
    ], measurements


@pytest.fixture
def solve(graph, tmp_path):
    """Return a function that gives a fresh solver the views of a plan and waits for its word."""

    def run(plan=PLAN, **parameters):
        graph.node(Solver, result_folder=str(tmp_path), **parameters)
        maps, summaries = graph.listen(names.ERROR_MAP), graph.listen(names.SUMMARY)
        messages, measurements = measured(plan)
        publisher = graph.publisher(names.MEASUREMENT)
        for message in messages:
            publisher.publish(message)
        graph.until(
            lambda: summaries and summaries[-1].views_done == len(messages), "all views"
        )
        return maps, summaries, measurements

    return run


def same_map(message, error_map) -> None:
    found = to_model.error_map(message)
    for name in ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta"):
        np.testing.assert_array_equal(getattr(found, name), getattr(error_map, name))
    assert found.nonorthogonality == error_map.nonorthogonality
    assert found.scale_difference == error_map.scale_difference
    assert found.datum_theta == error_map.datum_theta


def test_the_map_is_that_of_the_readings_bit_for_bit(solve, graph):
    maps, summaries, measurements = solve()
    result = calibrate(measurements)
    graph.until(lambda: maps, "a map")
    same_map(maps[-1], result.error_map)
    assert maps[-1].identifiable
    assert maps[-1].plan_id == PLAN.plan_id
    last = summaries[-1]
    assert (last.identifiable, last.rank_deficiency) == (True, 0)
    norm = np.hypot(result.error_map.gx, result.error_map.gy)
    assert last.max_error_um == pytest.approx(norm.max() * 1e6, rel=1e-12)


def test_topic_echo_shows_the_figures_of_the_state_whole(solve):
    _, summaries, measurements = solve()
    assert summaries[-1].state == state_line(worded(calibrate(measurements)))
    figures, assumed, _ = summaries[-1].state.partition(
        "; U assumes a plate that bends by "
    )
    assert assumed and len(figures) <= 128


def test_a_solution_wakes_the_node_that_waits_for_it(solve, graph, monkeypatch):
    monkeypatch.setattr(solver_module, "SWEEP_S", 3600.0)
    maps, _, measurements = solve()
    graph.until(lambda: maps, "a map")
    same_map(maps[-1], calibrate(measurements).error_map)


def test_what_solving_needs_is_loaded_before_there_is_another_thread_then_its_memory(
    graph, monkeypatch
):
    calls: list[tuple[tuple, str, list[str]]] = []
    monkeypatch.setattr(
        solver_module,
        "warm_up",
        lambda *marks: calls.append(
            (
                marks,
                threading.current_thread().name,
                [one.name for one in threading.enumerate()],
            )
        ),
    )
    graph.node(Solver)
    graph.until(lambda: len(calls) == 2, "both")
    (first, main, before), (then, worker, _) = calls
    assert (first, main) == ((), "MainThread")
    assert not [name for name in before if name.startswith("solver")]
    assert then == (21,) and worker.startswith("solver")


def test_a_solution_that_was_ready_while_the_node_was_not_active_is_taken_later(
    graph, monkeypatch
):
    gate, plain = threading.Event(), solver_module.solve
    monkeypatch.setattr(
        solver_module, "solve", lambda job: gate.wait(300) and plain(job)
    )
    monkeypatch.setattr(solver_module, "SWEEP_S", 0.02)
    node = graph.node(Solver)
    summaries = graph.listen(names.SUMMARY)
    graph.publisher(names.MEASUREMENT).publish(measured()[0][0])
    graph.until(lambda: node._running is not None, "a job")
    node.trigger_deactivate()
    gate.set()
    graph.until(node._running.done, "the solution")
    assert node.session.shown.problem is None
    node.trigger_activate()
    graph.until(lambda: summaries, "the summary")


def test_save_map_waits_for_the_readings_that_came_before_while_the_node_works_on(
    graph, tmp_path, monkeypatch
):
    gate, jobs, plain = threading.Event(), [], solver_module.solve

    def wait_and_solve(job):
        jobs.append(job)
        assert gate.wait(300)
        return plain(job)

    monkeypatch.setattr(solver_module, "solve", wait_and_solve)
    node = graph.node(Solver, result_folder=str(tmp_path))
    publisher, (messages, measurements) = graph.publisher(names.MEASUREMENT), measured()
    publisher.publish(messages[0])
    graph.until(lambda: jobs, "a first job")
    for message in messages[1:]:
        publisher.publish(message)
    graph.until(lambda: len(node.session._messages) == len(messages), "all views")
    client = graph.hand.create_client(SaveMap, "solver/save_map")
    graph.until(client.service_is_ready, "save_map")
    path = tmp_path / "map.json"
    future = client.call_async(SaveMap.Request(path=str(path)))
    graph.until(lambda: node._waiting, "the request")
    # others are answered meanwhile
    refused = graph.call(LoadMap, "solver/load_map", path="")
    assert refused.message == "path: is empty; name a file"
    assert not future.done()
    assert not path.exists()
    gate.set()
    answer = graph.finish(future, "the answer")
    assert (answer.success, answer.path) == (True, str(path))
    assert [len(job.measurements.views) for job in jobs] == [1, len(messages)]
    np.testing.assert_array_equal(
        np.array(json.loads(path.read_text())["error_map"]["gx"], dtype=float),
        calibrate(measurements).error_map.gx,
    )


def test_a_save_that_waited_is_told_what_the_readings_contradict(
    graph, tmp_path, monkeypatch
):
    gate, plain = threading.Event(), solver_module.solve
    monkeypatch.setattr(
        solver_module, "solve", lambda job: gate.wait(300) and plain(job)
    )
    node = graph.node(Solver, result_folder=str(tmp_path))
    publisher, (messages, _) = graph.publisher(names.MEASUREMENT), measured()
    publisher.publish(messages[0])
    graph.until(lambda: node._running is not None, "a job")
    messages[1].grid_pitch *= 2
    publisher.publish(messages[1])
    graph.until(lambda: node.session.stale, "the other plate")
    client = graph.hand.create_client(SaveMap, "solver/save_map")
    graph.until(client.service_is_ready, "save_map")
    future = client.call_async(SaveMap.Request(path=str(tmp_path / "no.json")))
    graph.until(lambda: node._waiting, "the request")
    gate.set()
    answer = graph.finish(future, "the answer")
    assert (answer.success, answer.error_code, answer.message) == (
        False,
        2,
        "selfcal/view_measurement: views of different plates in one plan; measure one plate",
    )


def test_a_late_joiner_gets_map_and_summary(solve, graph):
    solve()
    maps, summaries = graph.listen(names.ERROR_MAP), graph.listen(names.SUMMARY)
    graph.until(lambda: maps and summaries, "the latched messages")
    assert len(maps) == len(summaries) == 1


def test_what_was_solved_is_told_again_to_who_missed_it(solve, graph, monkeypatch):
    monkeypatch.setattr(solver_module, "SWEEP_S", 0.05)
    solve()
    told = graph.listen(names.of_node("solver", names.SOLVED))
    graph.until(lambda: len(told) > 2, "the same readings again")
    (solver,) = (node for node in graph.nodes if isinstance(node, Solver))
    assert told[-1].data == told[-2].data == solver.session.digest() != ""


def test_save_map_before_a_solution_that_failed_is_taken_says_why(
    graph, monkeypatch, tmp_path
):
    """It takes the solution itself; what that raises ended the node."""
    monkeypatch.setattr(solver_module, "SWEEP_S", 3600.0)
    monkeypatch.setattr(Solver, "_wake", lambda node, solution: None)
    problem = NotSettledError("the readings", "did not converge", "measure anew")
    monkeypatch.setattr(
        solver_module, "solve", lambda job: SolvingOutcome(job, None, problem)
    )
    node = graph.node(Solver, result_folder=str(tmp_path))
    messages, _ = measured(PLAN)
    graph.publisher(names.MEASUREMENT).publish(messages[0])
    graph.until(
        lambda: node._running is not None and node._running.done(), "a solution"
    )
    answer = graph.call(SaveMap, "solver/save_map", path="map.json")
    assert (answer.success, answer.error_code) == (False, ExitCode.BAD_INPUT)
    assert answer.message == str(problem)
    assert node.refusals.counts == {"advance": 1}


def test_save_map_writes_the_result_of_the_readings(solve, graph, tmp_path):
    _, _, measurements = solve()
    path = tmp_path / "map.json"
    answer = graph.call(SaveMap, "solver/save_map", path=str(path))
    assert (answer.success, answer.error_code) == (True, 0)
    assert answer.message.startswith(f"saved to {path}")
    result = with_collected(calibrate(measurements), measurements.views)
    expected = json.loads(json.dumps(result_to_dict(worded(result))))
    saved = json.loads(path.read_text())
    assert saved["provenance"].pop("created")
    expected["provenance"].pop("created")
    assert saved == expected


def test_the_map_is_also_saved_by_itself(solve, graph, tmp_path):
    path = tmp_path / "always.json"
    solve(save_path=str(path))
    graph.until(path.exists, "the file")


def test_a_view_measured_anew_replaces_the_old_one(graph):
    graph.node(Solver)
    maps, summaries = graph.listen(names.ERROR_MAP), graph.listen(names.SUMMARY)
    publisher = graph.publisher(names.MEASUREMENT)
    old, _ = measured(seed=5)
    new, measurements = measured(seed=6)
    for message in [*old, *new]:
        publisher.publish(message)
    wanted = calibrate(measurements).error_map
    graph.until(
        lambda: (
            maps
            and np.array_equal(
                to_model.error_map(maps[-1]).gx, wanted.gx, equal_nan=True
            )
        ),
        "the new map",
    )
    graph.until(
        lambda: summaries and summaries[-1].views_done == len(new), "a summary of all"
    )


def test_a_deficient_plan_is_told_with_advice_and_publishes_no_map(
    solve, graph, tmp_path
):
    maps, summaries, measurements = solve(small_plan("0, 90"))
    with pytest.raises(NotIdentifiableError) as unidentified:
        calibrate(measurements)
    last = summaries[-1]
    assert last.state == str(with_advice(unidentified.value))  # never cut
    assert not last.identifiable
    assert last.rank_deficiency > 0
    assert last.advice
    assert maps == []
    answer = graph.call(SaveMap, "solver/save_map", path=str(tmp_path / "no.json"))
    assert (answer.success, answer.error_code) == (False, 3)
    assert answer.message == last.state
    written = json.loads((tmp_path / "no.json").read_text())
    assert written["observability"]["identifiable"] is False


def test_without_readings_there_is_nothing_to_save(graph, tmp_path):
    graph.node(Solver)
    answer = graph.call(SaveMap, "solver/save_map", path=str(tmp_path / "no.json"))
    assert (answer.success, answer.error_code) == (False, 4)
    assert "there is no map yet" in answer.message


def test_a_path_that_cannot_be_written_is_bad_input(solve, graph, tmp_path):
    solve()
    answer = graph.call(
        SaveMap, "solver/save_map", path=str(tmp_path / "no" / "map.json")
    )
    assert (answer.success, answer.error_code) == (False, 2)
    assert "cannot be written" in answer.message


def test_load_map_publishes_what_the_file_holds(graph, tmp_path):
    graph.node(Solver)
    result = result_of(random_map(Artifact(5, 0.01, 8), 3, unknown=((0, 0),)))
    result.error_map.u_gx[0, 0] = result.error_map.u_gy[0, 0] = np.nan
    path = tmp_path / "map.json"
    path.write_text(json.dumps(result_to_dict(result)))
    maps = graph.listen(names.ERROR_MAP)
    answer = graph.call(LoadMap, "solver/load_map", path=str(path))
    assert (answer.success, answer.error_code) == (True, 0)
    graph.until(lambda: maps, "the map")
    same_map(maps[-1], result.error_map)
    assert maps[-1].valid[0] is False


@pytest.mark.parametrize("content", ["", "{}", "not json"])
def test_a_file_that_is_no_result_is_refused(graph, tmp_path, content):
    graph.node(Solver)
    path = tmp_path / "map.json"
    path.write_text(content)
    answer = graph.call(LoadMap, "solver/load_map", path=str(path))
    assert (answer.success, answer.error_code) == (False, 2)
    assert str(path) in answer.message


def test_an_empty_path_is_named(solve, graph):
    solve()
    for kind, name in ((SaveMap, "save_map"), (LoadMap, "load_map")):
        answer = graph.call(kind, f"solver/{name}", path="")
        assert (answer.success, answer.error_code) == (False, 2)
        assert answer.message == "path: is empty; name a file"


def test_a_loaded_map_is_not_said_to_come_from_the_readings(solve, graph, tmp_path):
    solve()
    path = str(tmp_path / "map.json")
    assert graph.call(SaveMap, "solver/save_map", path=path).success
    assert graph.call(LoadMap, "solver/load_map", path=path).success
    answer = graph.call(SaveMap, "solver/save_map", path=path)
    assert answer.message == (
        f"saved to {path}: plan '{PLAN.plan_id}', run {START_NS}; readings of a loaded map"
    )


def command_of(plan_id: str, views_planned: int):
    return fill(
        names.COMMAND.type(),
        from_model.command(
            Command(
                1,
                Phase.MEASURE,
                plan_id,
                0,
                PLAN.views[0],
                PLAN.artifact,
                views_planned,
            ),
            "stage",
        ),
    )


@pytest.mark.usefixtures("quick_beat")
def test_the_plan_is_known_whichever_topic_is_heard_first(graph):
    graph.node(Solver)
    summaries, diagnostics = graph.listen(names.SUMMARY), []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 10
    )
    graph.until(lambda: diagnostics, "a sign of life")
    assert diagnostics[-1].status[0].message == "waiting for views"
    readings, commands = (
        graph.publisher(names.MEASUREMENT),
        graph.publisher(names.COMMAND),
    )
    commands.publish(command_of("an earlier plan", 9))
    readings.publish(measured()[0][0])
    graph.until(lambda: summaries, "a summary")
    assert (summaries[-1].views_done, summaries[-1].views_planned) == (1, 0)
    diagnostics.clear()
    commands.publish(command_of(PLAN.plan_id, len(PLAN.views)))
    graph.until(lambda: summaries[-1].views_planned == len(PLAN.views), "the plan")
    line = "1 of 4 views measured, not yet enough to identify the stage."
    assert summaries[-1].state == line
    assert not summaries[-1].identifiable
    graph.until(
        lambda: any(
            s.message == line and s.level == DiagnosticStatus.OK
            for m in diagnostics
            for s in m.status
        ),
        "no alarm",
    )


@pytest.mark.usefixtures("quick_beat")
def test_views_of_two_plates_are_an_alarm(graph, tmp_path):
    graph.node(Solver)
    diagnostics: list = []
    graph.hand.create_subscription(
        DiagnosticArray, "/diagnostics", diagnostics.append, 10
    )
    readings = graph.publisher(names.MEASUREMENT)
    messages, _ = measured()
    messages[1].grid_pitch *= 2
    for message in messages[:2]:
        readings.publish(message)
    line = "selfcal/view_measurement: views of different plates in one plan; measure one plate"
    graph.until(
        lambda: any(
            s.message == line and s.level == DiagnosticStatus.WARN
            for m in diagnostics
            for s in m.status
        ),
        "the alarm",
    )
    answer = graph.call(SaveMap, "solver/save_map", path=str(tmp_path / "no.json"))
    assert (answer.success, answer.error_code, answer.message) == (False, 2, line)


def test_the_map_is_shown_as_markers_in_the_frame_of_the_map(solve, graph):
    _, _, measurements = solve(frame_id="cell")
    arrays = graph.listen(names.MAP_MARKERS)
    graph.until(lambda: arrays, "the latched markers")
    result = calibrate(measurements)
    shape = map_geometry(result.error_map)
    vectors, uncertainty, legend = arrays[-1].markers
    assert {m.header.frame_id for m in arrays[-1].markers} == {"cell"}
    assert (vectors.type, uncertainty.type, legend.type) == (
        Marker.LINE_LIST,
        Marker.CUBE_LIST,
        Marker.TEXT_VIEW_FACING,
    )
    np.testing.assert_array_equal([(p.x, p.y, p.z) for p in vectors.points], shape.ends)
    np.testing.assert_array_equal(
        [(p.x, p.y) for p in uncertainty.points], shape.sites[:, :2]
    )
    np.testing.assert_allclose(
        [(c.r, c.g, c.b) for c in uncertainty.colors], shape.colours, rtol=1e-6
    )
    assert all(0 < m.color.a == m.pose.orientation.w for m in arrays[-1].markers)
    assert vectors.scale.x > 0 < legend.scale.z
    assert legend.text == shape.legend


def test_rejected_detections_are_shown_until_their_view_is_measured_without(
    graph, tmp_path
):
    graph.node(Solver, frame_id="cell", result_folder=str(tmp_path))
    arrays = graph.listen(names.MAP_MARKERS)
    readings = graph.publisher(names.MEASUREMENT)
    messages, _ = measured()
    messages[1].reject_reasons, messages[1].reject_counts = ["low_score"], [2]
    messages[1].rejected_reason = [0, 0]
    messages[1].rejected_x, messages[1].rejected_y = [0.01, np.nan], [-0.02, 0.0]
    for message in messages:
        readings.publish(message)
    graph.until(
        lambda: arrays and len(arrays[-1].markers) == 4, "the rejected detection"
    )
    shown = arrays[-1].markers[-1]
    assert (shown.ns, shown.id, shown.type, shown.action) == (
        "rejected",
        1,
        Marker.POINTS,
        Marker.ADD,
    )
    assert [(p.x, p.y) for p in shown.points] == [
        (0.01, -0.02)
    ] and shown.color.r > shown.color.g
    assert shown.header.frame_id == "cell"
    again, _ = measured()
    again[1].sigma_xy *= 1.01  # another measurement
    readings.publish(again[1])
    graph.until(
        lambda: arrays[-1].markers[-1].action == Marker.DELETE, "the view without"
    )


def test_rejected_detections_of_an_earlier_run_are_deleted(graph):
    graph.node(Solver)
    arrays = graph.listen(names.MAP_MARKERS)
    readings = graph.publisher(names.MEASUREMENT)
    plan, with_rejected = small_plan("0, 90, tx, ty"), 3
    messages, _ = measured(plan)
    for message in messages:
        message.run_id = "1"
    messages[with_rejected].rejected_reason = [0]
    messages[with_rejected].rejected_x = [0.01]
    messages[with_rejected].rejected_y = [-0.02]
    messages[with_rejected].reject_reasons = ["low_score"]
    messages[with_rejected].reject_counts = [1]
    for message in messages:
        readings.publish(message)
    graph.until(
        lambda: arrays and arrays[-1].markers[-1].ns == "rejected", "the first run"
    )
    assert arrays[-1].markers[-1].action == Marker.ADD
    again, _ = measured(plan)
    for message in again:
        message.run_id = "2"
        if message.view_index != with_rejected:
            readings.publish(message)
    graph.until(
        lambda: arrays[-1].markers[-1].action == Marker.DELETE, "the second run"
    )


def test_a_malformed_measurement_does_not_end_the_solver(graph):
    node = graph.node(Solver)
    summaries = graph.listen(names.SUMMARY)
    messages, _ = measured()
    publisher = graph.publisher(names.MEASUREMENT)
    bad, _ = measured()
    bad[0].dx = bad[0].dx[:-1]
    bad[1].measurement_sense = "sideways"
    bad[2].reject_reasons = ["a reason without a count"]
    for message in [*bad, *messages]:
        publisher.publish(message)
    graph.until(
        lambda: (
            summaries
            and summaries[-1].identifiable
            and summaries[-1].views_done == len(messages)
        ),
        "the good views",
    )
    assert node.session.result is not None


def test_a_known_plate_gives_what_the_bag_gives(solve, graph, tmp_path):
    path = tmp_path / "first.json"
    write_json(path, result_to_dict(worded(calibrate(measured()[1]))))
    plan = replace(PLAN, plan_id="again", views=PLAN.views[:1], artifact_from=str(path))
    maps, summaries, measurements = solve(plan)
    graph.until(lambda: maps, "a map")
    assert measurements.artifact_from == str(path)
    known = read_result(str(path))
    same_map(maps[-1], calibrate(measurements, Options(plate=known)).error_map)
    assert summaries[-1].state.startswith(("Still good", "Changed", "Scale changed"))
