# SPDX-License-Identifier: Apache-2.0
"""stage_simulator: it measures what a command asks for, from when the command arrives."""

import json
import time
from dataclasses import replace

import pytest
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.collection.inputs import Command, Detection, Phase
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import View
from selfcal_ros.nodes import names
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.stage_simulator import LEAD_NS, StageSimulator
from selfcal_ros.units import NS_PER_S

PLATE = Artifact(3, 0.01, 4)
QUICK = {"exposure_period": 0.005, "encoder_rate": 1000.0}


def now_ns(graph) -> int:
    return graph.hand.get_clock().now().nanoseconds


def measure(graph, view: View, *, late_ns: int = 0, readers: int = 1) -> int:
    """Ask for a view with a command stamped `late_ns` ago, and return when it was sent, ns."""
    publisher = graph.publisher(names.COMMAND, readers=readers)
    sent = now_ns(graph)
    command = Command(sent - late_ns, Phase.MEASURE, "p", 0, view, PLATE, 1)
    publisher.publish(fill(names.COMMAND.type(), from_model.command(command, "stage")))
    return sent


def stamp_ns(message) -> int:
    return message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec


@pytest.mark.parametrize("late_ns", [0, 400_000_000])
def test_nothing_is_stamped_at_a_time_that_had_passed_when_the_command_came(
    graph, late_ns
):
    samples, seen = graph.listen(names.ENCODER), graph.listen(names.DETECTIONS)
    graph.node(StageSimulator, **QUICK)
    sent = measure(graph, View("a"), late_ns=late_ns)
    graph.until(lambda: len(seen) == 13, "9 marks and 4 lines")
    stamps = [stamp_ns(sample) for sample in samples]
    moved = [
        stamp
        for stamp, sample in zip(stamps, samples, strict=True)
        if any(sample.position)
    ]
    assert min(moved) >= sent + LEAD_NS
    assert min(map(stamp_ns, seen)) > sent + LEAD_NS
    assert stamps == sorted(stamps)


def test_the_order_that_a_command_asks_for(graph):
    seen = graph.listen(names.DETECTIONS)
    graph.node(StageSimulator, visit_order="serpentine", **QUICK)
    view = View("a", angular=False)
    measure(graph, replace(view, visit_order="raster"))
    graph.until(lambda: len(seen) == 9, "9 marks")
    assert [(d.m, d.n) for d in seen] == [
        (m, n) for m in (-1, 0, 1) for n in (-1, 0, 1)
    ]
    seen.clear()
    measure(graph, view)
    graph.until(lambda: len(seen) == 9, "9 marks again")
    assert [(d.m, d.n) for d in seen] == [
        (-1, -1),
        (-1, 0),
        (-1, 1),
        (0, 1),
        (0, 0),
        (0, -1),
        (1, -1),
        (1, 0),
        (1, 1),
    ]


def test_the_truth_that_its_parameters_ask_for_is_recorded(graph, tmp_path):
    path = tmp_path / "truth.json"
    node = graph.node(
        StageSimulator,
        truth_path=str(path),
        microscope_rotation=2e-3,
        backlash_y=-1e-8,
        drift_walk=5e-8,
        plate_shape=3e-8,
        stop_sigma=5e-5,
        measurement_sense="plate_moves",
        encoder="independent",
        rotation="finite",
        **QUICK,
    )
    measure(graph, View("a"))
    graph.until(lambda: path.exists(), "the truth")
    truth = json.loads(path.read_text())
    assert truth["microscope"] == [[0.0, -2e-3], [2e-3, 0.0]]
    assert truth["backlash"] == [0.0, -1e-8]
    assert truth["rotation"] == "finite"
    assert truth["drift"] == []
    assert (
        len(truth["drift_walk"]) == len(truth["plate_shape"]) == len(truth["phi"]) == 64
    )
    assert truth["drift_walk"][0][0][-1] == node.machine.truth.walk_m[0, 0, -1] != 0
    assert abs(sum(truth["g_theta"])) < 1e-18
    assert (truth["cell"]["stop_sigma_m"], truth["cell"]["sense"]) == (
        5e-5,
        "plate_moves",
    )
    assert truth["cell"]["exposure_period_s"] == 0.005


def test_a_clock_that_is_set_back_is_followed(graph):
    """At once, so that a start finds samples, and by the next command; a view is given up."""
    samples, seen = graph.listen(names.ENCODER), graph.listen(names.DETECTIONS)
    node = graph.node(StageSimulator, use_sim_time=True, **QUICK)
    publisher = graph.hand.create_publisher(Clock, "/clock", names.STATUS.qos)
    begin, shown = time.monotonic_ns(), [7_200 * NS_PER_S]

    def tick():
        seconds, ns = divmod(shown[0] + time.monotonic_ns() - begin, NS_PER_S)
        publisher.publish(Clock(clock=Time(sec=seconds, nanosec=ns)))

    graph.hand.create_timer(0.005, tick)
    commands = graph.publisher(names.COMMAND)

    def measured() -> None:
        seen.clear()
        command = Command(
            node.get_clock().now().nanoseconds,
            Phase.MEASURE,
            "p",
            0,
            View("a"),
            PLATE,
            1,
        )
        commands.publish(
            fill(names.COMMAND.type(), from_model.command(command, "stage"))
        )
        graph.until(lambda: len(seen) == 13, "9 marks and 4 lines")

    graph.until(lambda: node.get_clock().now().nanoseconds > shown[0], "the time")
    measured()
    shown[0] -= 3_600 * NS_PER_S
    graph.until(
        lambda: stamp_ns(samples[-1]) < 7_000 * NS_PER_S, "a sample by the new time"
    )
    measured()
    assert max(map(stamp_ns, seen)) < 7_000 * NS_PER_S


CHECKED = View("a", angular=False, repeats=2, check_marks=5, check_offset_m=2e-5)


@pytest.mark.parametrize("lost", [3, 12, 29, 30])
def test_what_is_missing_is_seen_again(graph, lost):
    """Lost are repeats of marks or check stops (10 to 29), and a collector says so."""

    class Forgetful(StageSimulator):
        number = 0

        def tell(self, event):
            self.number += isinstance(event, Detection)
            if not isinstance(event, Detection) or self.number != lost:
                super().tell(event)

    statuses, seen = graph.listen(names.STATUS), graph.listen(names.DETECTIONS)
    graph.node(MeasurementCollector, status_period=0.05)
    graph.node(Forgetful, **QUICK)
    measure(graph, CHECKED, readers=2)
    graph.until(lambda: statuses and statuses[-1].complete, "all marks")
    assert (statuses[-1].grid_done, statuses[-1].check_done) == (9, 5)
    assert len(seen) >= 2 * 9 + 20


def test_a_command_is_acted_on_once(graph):
    seen = graph.listen(names.DETECTIONS)
    graph.node(StageSimulator, **QUICK)
    publisher = graph.publisher(names.COMMAND)
    command = Command(
        now_ns(graph), Phase.MEASURE, "p", 0, View("a", angular=False), PLATE, 1
    )
    message = fill(names.COMMAND.type(), from_model.command(command, "stage"))
    publisher.publish(message)
    graph.until(lambda: len(seen) == 9, "9 marks")
    after = replace(command, stamp_ns=command.stamp_ns + 1, view=View("b", grid=False))
    publisher.publish(message)
    publisher.publish(fill(names.COMMAND.type(), from_model.command(after, "stage")))
    graph.until(lambda: len(seen) == 13, "4 lines")
    assert [d.kind for d in seen] == [0] * 9 + [1] * 4
