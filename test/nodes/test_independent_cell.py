# SPDX-License-Identifier: Apache-2.0
"""A cell that shares no code with the package is calibrated, whatever happens on the way."""

from functools import partial

import pytest
from std_srvs.srv import Trigger

from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.pose_sequencer import PoseSequencer
from selfcal_ros.nodes.solver import Solver
from test.support.bench_cell import largest_deviation
from test.support.independent_cell import IndependentCell

PLAN = """
plan_id: independent
artifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 8}
views:
  - {name: identity, repeats: REPEATS}
  - {name: rot90, rotation_deg: 90, repeats: REPEATS}
  - {name: one_line, rotation_deg: 45, grid: false, repeats: REPEATS}
  - {name: shift, translation_pitch: [1, 0], repeats: REPEATS}
"""
VIEWS, MARKS = 4, (33, 33, 8, 28)
NEAR_M, NEAR_RAD = 5e-8, 1e-6
"""Largest effect on a map of the cell's noise, and of a microscope whose scale the stops do not
show beyond the noise of the encoders (u up to 10 nm); its errors are above 4e-7 m and 5e-5 rad."""


class Site:
    """A cell and the nodes that calibrate it, in a namespace."""

    def __init__(self, graph, folder, namespace="", *, repeats=1, **cell):
        self.graph, self.folder, self.namespace = graph, folder, namespace
        self.nodes = {}
        folder.mkdir(exist_ok=True)
        (folder / "plan.yaml").write_text(PLAN.replace("REPEATS", str(repeats)))
        self.marks = [repeats * marks for marks in MARKS]
        self.maps, self.summaries, self.commands, self.statuses = (
            graph.listen(self.topic(topic))
            for topic in (names.ERROR_MAP, names.SUMMARY, names.COMMAND, names.STATUS)
        )
        self.parameters = {
            MeasurementCollector: {
                "journal": str(folder),
                "status_period": 0.05,
                "measurement_sense": "plate_moves"
                if cell.get("plate_moves")
                else "microscope_moves",
            },
            # its stage stops on the marks: nothing in the readings shows the offsets' sign
            Solver: {"model_terms": ["microscope:0.01:0.01:0.002"]},
            PoseSequencer: {
                "plan": str(folder / "plan.yaml"),
                "auto_confirm": True,
                "settle_time": 0.0,
            },
        }
        self.cell_options = cell

    def topic(self, topic):
        return names.Topic(
            f"/{self.namespace}/{topic.name}".replace("//", "/"), topic.type, topic.qos
        )

    def start_cell(self):
        self.cell = self.graph.add(
            IndependentCell(
                context=self.graph.context,
                namespace=self.namespace,
                **self.cell_options,
            )
        )

    def start(self, *kinds):
        for kind in kinds:
            self.nodes[kind] = self.graph.node(
                partial(kind, namespace=self.namespace), **self.parameters[kind]
            )
        return self

    def begin(self, hold_at=None):
        """Bring everything up and start a run; the cell waits in a view, after some exposures."""
        self.start_cell()
        self.cell.hold_at = hold_at
        self.start(MeasurementCollector, Solver, PoseSequencer)
        assert self.ask("start").success
        return self

    def restart(self, kind):
        self.graph.remove(self.nodes.pop(kind))
        self.start(kind)

    def ask(self, service):
        return self.graph.call(
            Trigger, f"/{self.namespace}/pose_sequencer/{service}".replace("//", "/")
        )

    def until_held(self):
        """Wait until the cell waits and the collector has what was sent."""
        self.graph.until(lambda: self.cell.held, "the middle of a view")
        received = self.nodes[MeasurementCollector].session.collector.received
        self.graph.until(
            lambda: (
                received["detection"]
                == sum(self.marks[: self.cell.view]) + self.cell.exposed
            ),
            "what was sent",
        )

    def release(self):
        self.cell.hold_at = None

    def until_done(self):
        self.graph.until(
            lambda: (
                self.commands and self.commands[-1].phase == names.COMMAND.type.DONE
            ),
            "the end of the plan",
        )
        run = self.commands[-1].run_id
        self.graph.until(
            lambda: (
                self.summaries
                and self.summaries[-1].views_done == VIEWS
                and self.summaries[-1].run_id == run
                and self.maps
                and self.maps[-1].header.stamp == self.summaries[-1].header.stamp
            ),
            "the final map",
        )
        assert self.summaries[-1].qualified, self.summaries[-1].state

    def check(self, size=1.0):
        self.until_done()
        off_m, off_rad = largest_deviation(self.maps[-1], size)
        assert off_m < NEAR_M
        assert off_rad < NEAR_RAD

    def check_that_all_was_used(self):
        """Check that each view was measured once, and no reading rejected."""
        assert self.measured() == [0, 1, 2, 3]
        assert self.nodes[MeasurementCollector].session.collector.unusable == {}
        assert sum(sum(status.reject_counts) for status in self.statuses) == 0

    def measured(self):
        """Return the commanded views in their order."""
        return [
            command.view_index
            for command in self.commands
            if command.phase == names.COMMAND.type.MEASURE
        ]


@pytest.mark.parametrize(
    "cell",
    [
        {"ids": False, "joints": ("spindle", "theta", "y", "z", "x")},
        {"plate_moves": True, "ids": False},
    ],
    ids="-".join,
)
def test_it_is_calibrated_to_its_true_error(graph, tmp_path, cell):
    site = Site(graph, tmp_path, repeats=2, **cell).begin()
    site.check()
    site.check_that_all_was_used()


def test_the_wrong_sense_is_no_map(graph, tmp_path):
    site = Site(graph, tmp_path, plate_moves=True)
    site.parameters[MeasurementCollector]["measurement_sense"] = "microscope_moves"
    site.begin()
    health = graph.listen(names.of_node("measurement_collector", names.HEALTH))
    graph.until(
        lambda: any("measurement_sense plate_moves" in told.message for told in health),
        "the right sense",
    )
    assert site.maps == []


def test_two_cells_side_by_side(graph, tmp_path):
    left = Site(graph, tmp_path / "left", "left", seed=2).begin()
    right = Site(
        graph, tmp_path / "right", "right", size=-2.0, ids=False, seed=3
    ).begin()
    left.check()
    right.check(-2.0)


@pytest.mark.parametrize(
    "kind, view",
    [
        (MeasurementCollector, 0),
        (MeasurementCollector, 3),
        (Solver, 3),
        (PoseSequencer, 3),
    ],
)
def test_a_node_that_is_restarted_within_a_view(graph, tmp_path, kind, view):
    site = Site(graph, tmp_path).begin(hold_at=(view, 4))
    site.until_held()
    site.restart(kind)
    if kind is PoseSequencer:
        # takes up the run, at once or as soon as it has heard all of them
        site.ask("start")
        graph.until(lambda: site.nodes[PoseSequencer].session.run_id, "the run")
    elif kind is MeasurementCollector:
        graph.until(
            lambda: (
                site.cell.marks.get_subscription_count() == 1
                and site.cell.encoder.get_subscription_count() == 1
            ),
            "the new collector",
        )
    site.release()
    site.check()
    assert len({command.run_id for command in site.commands}) == 1


def test_redo_measures_a_view_anew(graph, tmp_path):
    site = Site(graph, tmp_path).begin(hold_at=(0, 7))
    site.until_held()
    assert site.ask("redo_view").success
    site.release()
    site.check()
    assert site.measured() == [0, 0, 1, 2, 3]
    assert site.nodes[MeasurementCollector].session.collector.collect()[0].rejected == {
        "superseded_by_redo": 7
    }


def test_a_run_after_an_abort_is_that_run_alone(graph, tmp_path):
    site = Site(graph, tmp_path).begin(hold_at=(1, 20))
    site.until_held()
    assert site.ask("abort").success
    site.release()
    site.cell.size = 3.0  # whatever is left of the first run would be seen
    assert site.ask("start").success
    site.check(3.0)


def test_a_second_run_is_that_run_alone(graph, tmp_path):
    site = Site(graph, tmp_path).begin()
    site.check()
    site.check_that_all_was_used()
    site.cell.size = -1.0
    assert site.ask("start").success
    graph.until(
        lambda: site.commands[-1].phase != names.COMMAND.type.DONE, "the second run"
    )
    site.check(-1.0)
    assert len({summary.run_id for summary in site.summaries}) == 2


@pytest.mark.usefixtures("quick_beat")
def test_all_of_them_may_come_late(graph, tmp_path):
    site = Site(graph, tmp_path)
    site.parameters[PoseSequencer]["auto_start"] = True
    site.start(PoseSequencer)
    health = graph.listen(names.of_node("pose_sequencer", names.HEALTH))
    for start in (
        partial(site.start, Solver),
        partial(site.start, MeasurementCollector),
        site.start_cell,
    ):
        health.clear()
        graph.until(
            lambda: any("waiting for" in told.message for told in health),
            "a sign of it",
        )
        assert site.commands == []
        start()
    site.check()
    late = graph.listen(names.ERROR_MAP), graph.listen(names.SUMMARY)
    graph.until(lambda: all(late), "what was latched")
    assert late[0][-1] == site.maps[-1]
    assert late[1][-1] == site.summaries[-1]
