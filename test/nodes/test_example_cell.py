# SPDX-License-Identifier: Apache-2.0
"""examples/cell.py, as a reader would run it, is calibrated by the real nodes."""

import importlib.util
from pathlib import Path

import numpy as np

from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver

EXAMPLE = Path(__file__).parents[2] / "examples/cell.py"
PLAN = """
plan_id: example
artifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 8}
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


def test_the_example_is_calibrated_to_its_true_error(graph, tmp_path):
    (tmp_path / "plan.yaml").write_text(PLAN)
    cell = example().Cell(context=graph.context)
    graph.add(cell)
    summaries, maps = graph.listen(names.SUMMARY), graph.listen(names.ERROR_MAP)
    graph.node(MeasurementCollector)
    graph.node(Solver)
    graph.node(PoseSequencer, plan=str(tmp_path / "plan.yaml"), auto_confirm=True,
               auto_start=True)
    graph.until(lambda: summaries and summaries[-1].views_done == 4 and maps
                and maps[-1].header.stamp == summaries[-1].header.stamp, "the final map")
    assert summaries[-1].identifiable, summaries[-1].state
    found = maps[-1]
    index = np.arange(5) - 2
    x, y = (0.01 * part.ravel() for part in np.meshgrid(index, index, indexing="ij"))
    true = np.array([cell.machine.error(*at) for at in zip(x, y, strict=True)]).T
    difference = np.stack([np.array(found.gx), np.array(found.gy)]) - true
    # no view tells a translation, a rotation and a magnification of the field
    columns = np.array([np.r_[x * 0 + 1, y * 0], np.r_[x * 0, y * 0 + 1], np.r_[-y, x],
                        np.r_[x, y]]).T
    rest = difference.ravel() - columns @ np.linalg.lstsq(columns, difference.ravel())[0]
    assert np.abs(true).max() > 1e-7
    assert np.abs(rest).max() < 2e-8
    k = np.arange(8) * np.pi / 4
    turn = np.array(found.g_theta) - 2e-5 * np.sin(k)
    assert np.abs(turn - turn.mean()).max() < 1e-6


def test_a_shifted_view_has_a_row_less():
    from selfcal_msgs.msg import ViewCommand

    view = ViewCommand(grid_size=5, grid_pitch=0.01, translation_x=0.01, rotation=np.pi / 2)
    sites = list(example().grid_sites(view))
    assert len(sites) == 20
    assert all(n >= -1 for _, n, _ in sites)  # turned by 90 degrees, -n runs along x
    assert (2, 2, (-0.01, 0.02, 0.0)) in [(m, n, tuple(np.round(p, 12))) for m, n, p in sites]
