# SPDX-License-Identifier: Apache-2.0
"""examples/cell.py, as a reader would run it, is calibrated by the real nodes."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from selfcal_msgs.msg import ViewCommand

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.messages import from_model
from selfcal_ros.model.artifact import Artifact, MapGrid
from selfcal_ros.model.view import View
from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver

EXAMPLE = Path(__file__).parents[2] / "examples/cell.py"
PLAN = """
plan_id: example
artifact: {grid_size: SIZE, grid_pitch: 0.01, angular_count: 8}
check_stops: {marks: 5, offset: 20e-6}
views:
  - {name: identity, repeats: 2}
  - {name: rot90, rotation_deg: 90, repeats: 2}
  - {name: one_line, rotation_deg: 45, grid: false, repeats: 2}
  - {name: shift, translation_pitch: [1, 0], repeats: 2}
"""


def example():
    found = importlib.util.spec_from_file_location("cell", EXAMPLE)
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


@pytest.mark.parametrize("size", [5, 4])
def test_the_example_is_calibrated_to_its_true_error(graph, tmp_path, size):
    (tmp_path / "plan.yaml").write_text(PLAN.replace("SIZE", str(size)))
    cell = example().Cell(context=graph.context)
    graph.add(cell)
    summaries, maps = graph.listen(names.SUMMARY), graph.listen(names.ERROR_MAP)
    statuses = graph.listen(names.STATUS)
    # the cell tells the time of the clock, and a busy machine may stop it for longer than 0.1 s
    graph.node(MeasurementCollector, max_encoder_gap=10.0)
    graph.node(Solver)
    graph.node(PoseSequencer, plan=str(tmp_path / "plan.yaml"), auto_confirm=True,
               auto_start=True)
    graph.until(lambda: summaries and summaries[-1].views_done == 4 and maps
                and maps[-1].header.stamp == summaries[-1].header.stamp, "the final map")
    assert summaries[-1].identifiable, summaries[-1].state
    assert {(status.view_index, status.check_expected, status.check_done)
            for status in statuses if status.complete} == {
        (0, 5, 5), (1, 5, 5), (2, 0, 0), (3, 5, 5)}
    # what a machine that is busy makes of samples a second apart; the cell sees these marks again
    assert {reason for status in statuses for reason in status.reject_reasons} <= {
        "no_encoder_sample_near", "stage_moving"}
    found = maps[-1]
    index = np.arange(size) - (size - 1) / 2
    x, y = (0.01 * part.ravel() for part in np.meshgrid(index, index, indexing="ij"))
    true = np.array([cell.machine.error(*at) for at in zip(x, y, strict=True)]).T
    difference = np.stack([np.array(found.gx), np.array(found.gy)]) - true
    # no view tells a translation, a rotation and a magnification of the field
    columns = np.array([np.r_[x * 0 + 1, y * 0], np.r_[x * 0, y * 0 + 1], np.r_[-y, x],
                        np.r_[x, y]]).T
    rest = difference.ravel() - columns @ np.linalg.lstsq(
        columns, difference.ravel(), rcond=None)[0]
    assert np.abs(true).max() > 1e-7
    assert np.abs(rest).max() < 2e-8
    k = np.arange(8) * np.pi / 4
    turn = np.array(found.g_theta) - 2e-5 * np.sin(k)
    assert np.abs(turn - turn.mean()).max() < 1e-6


def test_a_shifted_view_has_a_row_less():
    view = ViewCommand(grid_size=5, grid_pitch=0.01, translation_x=0.01, rotation=np.pi / 2)
    sites = list(example().grid_sites(view))
    assert len(sites) == 20
    assert all(n >= -1 for _, n, _ in sites)  # turned by 90 degrees, -n runs along x
    assert (2, 2, (-0.01, 0.02, 0.0)) in [(m, n, tuple(np.round(p, 12))) for m, n, p in sites]


@pytest.mark.parametrize("view", [View("", 0.0), View("", np.pi), View("", 0.0, (0.0, -0.01)),
                                  View("", np.pi, (0.01, 0.0))])
def test_marks_of_a_rectangular_plate(view):
    plate = Artifact(5, 0.01, 0, 7)
    m, n = (index.ravel() for index in np.meshgrid(plate.m, plate.n, indexing="ij"))
    i, j = view.lattice_pose(plate).site_of(m, n)
    inside = (abs(i) <= 2) & (abs(j) <= 3)
    wanted = {(int(a), int(b)): (c * 0.01, d * 0.01) for a, b, c, d in zip(
        m[inside], n[inside], i[inside], j[inside], strict=True)}
    command = ViewCommand(grid_size=5, grid_size_y=7, grid_pitch=0.01, rotation=view.rotation_rad,
                          translation_x=view.translation_m[0], translation_y=view.translation_m[1])
    found = {(m, n): p[:2] for m, n, p in example().grid_sites(command)}
    assert found.keys() == wanted.keys()
    assert all(found[mark] == pytest.approx(wanted[mark]) for mark in wanted)


def test_marks_of_a_plate_off_the_lattice():
    """Over a map that is smaller than the plate in x, and larger in y."""
    plate = Artifact(5, 0.01, map_grid=MapGrid(3, 0.015, size_y=5))
    view = View("", np.deg2rad(37), (0.013, -0.007))
    fields = from_model.command(Command(0, Phase.MEASURE, "p", 0, view, plate), "stage")
    del fields["header"]
    found = {(m, n): complex(*p[:2]) for m, n, p in example().grid_sites(ViewCommand(**fields))}
    inside = view.pose.in_field(plate)
    marks = list(zip(plate.m[inside].tolist(), plate.n[inside].tolist(), strict=True))
    assert list(found) == marks
    np.testing.assert_allclose([*found.values()], view.pose.places(plate, plate.m, plate.n)[inside])


def test_a_command_latched_anew_is_not_carried_out_again(graph):
    cell = example().Cell(context=graph.context)
    graph.add(cell)
    commands = graph.publisher(names.COMMAND)
    message = ViewCommand(phase=ViewCommand.MEASURE, grid=True, grid_size=5, grid_pitch=0.01,
                          repeats=1)
    message.header.stamp.sec = 7
    marks = graph.listen(names.DETECTIONS)
    commands.publish(message)
    graph.until(lambda: len(marks) > 3, "the first marks")
    commands.publish(message)
    graph.until(lambda: len(marks) == 25, "all marks")
    assert [(mark.m, mark.n) for mark in marks] == [
        (m, n) for m in range(-2, 3) for n in range(-2, 3)]
    message.header.stamp.sec = 8  # another one is
    commands.publish(message)
    graph.until(lambda: len(marks) == 50, "all marks again")


@pytest.mark.parametrize("min_repeats", [0, 1])
def test_a_view_with_a_detection_that_is_an_outlier_comes_to_its_end(
        graph, tmp_path, monkeypatch, min_repeats):
    """The cell sees the mark again; with `min_repeats` it need not."""
    (tmp_path / "plan.yaml").write_text(
        "plan_id: one\nartifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 0}\n"
        "views: [{name: identity, angular: false, repeats: 3}]\n")
    module, seen = example(), []
    monkeypatch.setattr(module, "REVISIT_TICKS", 10**9 if min_repeats else 50)

    class Spoilt(module.Machine):
        def see_mark(self, m, n, view):
            seen.append((m, n))
            x, y = super().see_mark(m, n, view)
            return (x + 3e-4 * (seen.count((m, n)) == 1 and (m, n) == (1, 2)), y)

    graph.add(module.Cell(Spoilt(), context=graph.context))
    commands = graph.listen(names.COMMAND)
    graph.node(MeasurementCollector, max_encoder_gap=10.0, min_repeats=min_repeats)
    graph.node(Solver)
    graph.node(PoseSequencer, plan=str(tmp_path / "plan.yaml"), auto_confirm=True,
               auto_start=True)
    graph.until(lambda: commands and commands[-1].phase == ViewCommand.DONE, "the end")
    assert seen.count((1, 2)) > 3 if not min_repeats else len(seen) == 75
