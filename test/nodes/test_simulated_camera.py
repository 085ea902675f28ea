# SPDX-License-Identifier: Apache-2.0
"""The simulated cell with a camera: from its images to the map, live as offline."""

from pathlib import Path

import numpy as np

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_yaml
from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_recorder import BagRecorder
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from selfcal_ros.nodes.stage_simulator import StageSimulator
from selfcal_ros.settings.nodes import CollectorSettings

CONFIG = Path(__file__).parents[2] / "config"
CAMERA, PLAN = (
    str(CONFIG / folder / "camera.yaml") for folder in ("simulations", "plans")
)


def parameters(node: str) -> dict:
    return read_yaml(CONFIG / "params/simulated_camera.yaml")[f"/**/{node}"][
        "ros__parameters"
    ]


def test_the_shipped_camera_cell_is_calibrated_live_as_offline(graph, tmp_path):
    recorder = graph.node(BagRecorder, bag=str(tmp_path / "bag"))
    summaries, maps = graph.listen(names.SUMMARY), graph.listen(names.ERROR_MAP)
    cell = graph.node(StageSimulator, camera=CAMERA, **parameters("stage_simulator"))
    detector = graph.node(MarkDetectorNode, **parameters("mark_detector"))
    graph.node(MeasurementCollector, **parameters("measurement_collector"))
    graph.node(Solver)
    graph.node(PoseSequencer, plan=PLAN, **parameters("pose_sequencer"))
    graph.until(
        lambda: (
            summaries
            and summaries[-1].views_done == 2
            and maps
            and maps[-1].header.stamp == summaries[-1].header.stamp
        ),
        "the final map",
    )
    assert summaries[-1].identifiable, summaries[-1].state
    # more than the plan's 100 where a busy machine was late, and marks were asked for again
    graph.until(
        lambda: (
            int(detector.session.diagnosis().values["images"])
            == cell.diagnosis().values["image_sent"]
            >= 100
        ),
        "all images",
    )
    counts = detector.session.diagnosis().values
    # 25 stops, at the edges fewer than nine marks
    assert int(counts["marks"]) >= 2 * 2 * 169
    recorder.close()
    assert not detector.losses.counts
    live = np.array([maps[-1].gx, maps[-1].gy])
    session = collect_bag(tmp_path / "bag", CollectorSettings.checked({}, "test"))
    offline = calibrate(session.measurements).error_map
    np.testing.assert_array_equal(live, [offline.gx.ravel(), offline.gy.ravel()])
    true = cell.machine.truth.g.reshape(2, -1)
    sites, one, zero = offline.artifact.field, np.ones(25), np.zeros(25)
    x, y = sites.x_m.ravel(), sites.y_m.ravel()
    # the datum takes out origin, turn and scale
    columns = np.array([[*one, *zero], [*zero, *one], [*-y, *x], [*x, *y]]).T
    away = (live - true).ravel()
    away -= columns @ np.linalg.lstsq(columns, away, rcond=None)[0]
    assert np.abs(away).max() < 0.03e-6 < 0.1 * np.ptp(true)
