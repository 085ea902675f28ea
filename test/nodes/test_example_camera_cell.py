# SPDX-License-Identifier: Apache-2.0
"""examples/camera_cell.py publishes images only; the real nodes calibrate it."""

import importlib.util
from pathlib import Path

import numpy as np

from selfcal_ros.model.artifact import Artifact
from selfcal_ros.nodes import names
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver

EXAMPLES = Path(__file__).parents[2] / "examples"
PLAN = """
plan_id: camera_example
artifact: {grid_size: 3, grid_pitch: 0.01, angular_count: 0}
views:
  - {name: identity, repeats: 2}
  - {name: rot90, rotation_deg: 90, repeats: 2}
  - {name: shift, translation_pitch: [1, 0], repeats: 2}
"""


def example(monkeypatch):
    monkeypatch.syspath_prepend(str(EXAMPLES))
    found = importlib.util.spec_from_file_location("camera_cell", EXAMPLES / "camera_cell.py")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module


def test_the_example_is_calibrated_from_its_images(graph, tmp_path, monkeypatch):
    (tmp_path / "plan.yaml").write_text(PLAN)
    cell = example(monkeypatch).CameraCell(context=graph.context)
    graph.add(cell)
    summaries, maps = graph.listen(names.SUMMARY), graph.listen(names.ERROR_MAP)
    graph.node(MarkDetectorNode, pixel_size=2e-6, mark_size=50e-6)
    # the cell tells the time of the clock, and a busy machine may stop it for longer than 0.1 s
    graph.node(MeasurementCollector, max_encoder_gap=10.0)
    graph.node(Solver)
    graph.node(PoseSequencer, plan=str(tmp_path / "plan.yaml"), auto_confirm=True,
               auto_start=True)
    graph.until(lambda: summaries and summaries[-1].views_done == 3 and maps
                and maps[-1].header.stamp == summaries[-1].header.stamp, "the final map")
    assert summaries[-1].identifiable, summaries[-1].state
    sites = Artifact(3, 0.01, 0).field
    true = np.array([cell.machine.error(x, y) for x, y in zip(
        sites.x_m.ravel(), sites.y_m.ravel(), strict=True)]).T
    found = np.array([maps[-1].gx, maps[-1].gy])
    # the datum takes out origin, turn and scale
    x, y, one, zero = sites.x_m.ravel(), sites.y_m.ravel(), np.ones(9), np.zeros(9)
    columns = np.array([[*one, *zero], [*zero, *one], [*-y, *x], [*x, *y]]).T
    away = np.concatenate(found - true)
    away -= columns @ np.linalg.lstsq(columns, away, rcond=None)[0]
    assert np.abs(away).max() < 0.1e-6 < 0.3 * np.ptp(true)
