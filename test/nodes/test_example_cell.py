# SPDX-License-Identifier: Apache-2.0
"""The machines in examples/, as a reader would run them: without ROS, and by cell_driver."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from selfcal_msgs.msg import ViewCommand

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.cli.main import main
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.errors import InputError
from selfcal_ros.machine.cell import open_machine, read_cell
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View
from selfcal_ros.nodes import names
from selfcal_ros.nodes.cell_driver import CellDriver
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver

EXAMPLES = Path(__file__).parents[2] / "examples"


def away_from(machine, gx, gy, size: int) -> tuple[np.ndarray, float]:
    """Return found minus true map after removal of the datum, and the range of the true one."""
    index = np.arange(size) - (size - 1) / 2
    x, y = (0.01 * part.ravel() for part in np.meshgrid(index, index, indexing="ij"))
    true = np.array([machine.error(*at) for at in zip(x, y, strict=True)]).T.ravel()
    away = np.array([gx, gy]).ravel() - true
    columns = np.array(
        [np.r_[x * 0 + 1, y * 0], np.r_[x * 0, y * 0 + 1], np.r_[-y, x], np.r_[x, y]]
    ).T
    return away - columns @ np.linalg.lstsq(columns, away, rcond=None)[0], float(
        np.ptp(true)
    )


SMALL = EXAMPLES.parent / "config/plans/small.yaml"


@pytest.mark.usefixtures("jumping_clocks")
@pytest.mark.parametrize(
    ("plan", "cell", "size", "most"),
    [(SMALL, "cell", 5, 2e-8), (EXAMPLES / "camera_plan.yaml", "camera_cell", 3, 1e-7)],
)
def test_an_example_is_measured_without_ros(
    tmp_path, monkeypatch, plan, cell, size, most
):
    monkeypatch.chdir(tmp_path)
    path = EXAMPLES / f"{cell}.yaml"
    assert main(["measure", str(plan), str(path), "-o", "bag", "--yes"]) == 0
    result = json.loads(Path("bag.json").read_text())
    away, span = away_from(
        open_machine(read_cell(path)),
        result["error_map"]["gx"],
        result["error_map"]["gy"],
        size,
    )
    assert np.abs(away).max() < most < 0.3 * span


@pytest.mark.parametrize("size", [5, 4])
def test_the_same_class_is_driven_under_ros(graph, tmp_path, size):
    for source, name in (
        (EXAMPLES / "cell.py", "cell.py"),
        (EXAMPLES / "cell.yaml", "cell.yaml"),
        (SMALL, "plan.yaml"),
    ):
        shutil.copy(source, tmp_path / name)
    for name, old in (("cell.yaml", "marks: 5"), ("plan.yaml", "grid_size: 5")):
        path = tmp_path / name
        path.write_text(path.read_text().replace(old, old.replace("5", str(size))))
    summaries, maps = graph.listen(names.SUMMARY), graph.listen(names.ERROR_MAP)
    statuses = graph.listen(names.STATUS)
    driver = graph.node(CellDriver, cell=str(tmp_path / "cell.yaml"))
    try:
        graph.node(MeasurementCollector)
        graph.node(Solver)
        graph.node(
            PoseSequencer,
            plan=str(tmp_path / "plan.yaml"),
            auto_confirm=True,
            auto_start=True,
        )
        graph.until(
            lambda: (
                summaries
                and summaries[-1].views_done == 5
                and maps
                and maps[-1].header.stamp == summaries[-1].header.stamp
            ),
            "the final map",
        )
    finally:
        driver.close()
    assert summaries[-1].identifiable, summaries[-1].state
    assert {
        (status.view_index, status.check_expected, status.check_done)
        for status in statuses
        if status.complete
    } == {(0, 5, 5), (1, 5, 5), (2, 0, 0), (3, 5, 5), (4, 5, 5)}
    machine = open_machine(read_cell(tmp_path / "cell.yaml"))
    away, span = away_from(machine, maps[-1].gx, maps[-1].gy, size)
    assert np.abs(away).max() < 2e-8 < 0.1 * span
    k = np.arange(8) * np.pi / 4
    turn = np.array(maps[-1].g_theta) - 2e-5 * np.sin(k)
    assert np.abs(turn - turn.mean()).max() < 1e-6


def test_a_machine_is_not_driven_in_simulated_time(graph):
    """Its readings have the stamps of the computer's clock; those of commands would not fit."""
    with pytest.raises(InputError, match="start it without use_sim_time"):
        graph.node(CellDriver, cell=str(EXAMPLES / "cell.yaml"), use_sim_time=True)


def test_a_command_latched_anew_is_not_carried_out_again_and_abort_stops(graph):
    driver = graph.node(CellDriver, cell=str(EXAMPLES / "cell.yaml"))
    try:
        commands = graph.publisher(names.COMMAND)
        marks = graph.listen(names.DETECTIONS)

        def command(stamp_ns: int, phase: Phase) -> ViewCommand:
            return fill(
                names.COMMAND.type(),
                from_model.command(
                    Command(
                        stamp_ns,
                        phase,
                        "p",
                        0,
                        View("a", angular=False),
                        Artifact(5, 0.01, 8),
                        1,
                    ),
                    "stage",
                ),
            )

        commands.publish(command(7, Phase.MEASURE))
        graph.until(lambda: len(marks) > 3, "the first marks")
        commands.publish(command(7, Phase.MEASURE))
        graph.until(lambda: len(marks) == 25, "all marks")
        graph.until(lambda: not driver._driver.busy, "rest")
        assert len({(mark.m, mark.n) for mark in marks}) == 25
        commands.publish(command(8, Phase.MEASURE))  # another one is
        graph.until(lambda: len(marks) > 28, "marks again")
        commands.publish(command(9, Phase.ABORT))
        graph.until(lambda: not driver._driver.busy, "rest")
        assert len(marks) < 50
    finally:
        driver.close()


def test_a_machine_that_fails_is_named_in_the_health(graph, tmp_path):
    shutil.copy(EXAMPLES / "cell.py", tmp_path / "cell.py")
    (tmp_path / "cell.yaml").write_text(
        (EXAMPLES / "cell.yaml").read_text().replace("y: [-0.03", "y: [-0.005")
    )
    driver = graph.node(CellDriver, cell=str(tmp_path / "cell.yaml"))
    try:
        commands = graph.publisher(names.COMMAND)
        commands.publish(
            fill(
                names.COMMAND.type(),
                from_model.command(
                    Command(
                        7,
                        Phase.MEASURE,
                        "p",
                        0,
                        View("a", angular=False),
                        Artifact(5, 0.01, 8),
                        1,
                    ),
                    "stage",
                ),
            )
        )
        graph.until(
            lambda: "beyond the limits" in driver.diagnosis().message, "the reason"
        )
        assert driver.diagnosis().level == 2
    finally:
        driver.close()
