# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed at any moment: the run goes on, and the map is the undisturbed one."""

import contextlib
import os
import signal
import subprocess
import sys
from operator import ge

import numpy as np
import pytest
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.collection.messages import Command, Detection, EncoderSample, Phase
from selfcal_ros.collection.parameters import parameter_values
from selfcal_ros.estimation.api import Options, calibrate
from selfcal_ros.files import read_json
from selfcal_ros.nodes import names
from test.support.sessions import cdr_of, collected, events_of, small_plan

VALUES = parameter_values("measurement_collector", {}, "test")
ROLES = {EncoderSample: names.ENCODER, Detection: names.DETECTIONS, Command: names.COMMAND}
KINDS = tuple(ROLES)
"""In the order in which the collector tells its counts."""


class Cell:
    """Plays a run into node processes; repeats what the collector had not told as received.

    A cell whose detections nobody takes waits: it goes on when the collector is back.
    """

    def __init__(self, graph, environment, folder):
        self.graph, self.environment, self.folder = graph, environment, folder
        self.running = {}
        self.told = (0, 0, 0)
        graph.hand.create_subscription(
            names.RECEIVED.type, "measurement_collector/received", self._on_told,
            names.RECEIVED.qos)
        self.publishers = {kind: graph.hand.create_publisher(topic.type, topic.name, topic.qos)
                           for kind, topic in ROLES.items()}

    def _on_told(self, message):
        self.told = tuple(message.data)

    def start(self, node, **parameters):
        arguments = [word for key, value in parameters.items()
                     for word in ("-p", f"{key}:={value}")]
        self.running[node] = subprocess.Popen(
            [sys.executable, "-m", f"selfcal_ros.nodes.{node}", "--ros-args", *arguments],
            env=self.environment, stderr=subprocess.PIPE, text=True, start_new_session=True)

    def start_collector(self):
        before, self.told = self.told, (-1, -1, -1)
        self.start("measurement_collector", journal=self.folder, status_period=0.1)
        self.graph.until(lambda: all(self.publishers[kind].get_subscription_count()
                                     for kind in (EncoderSample, Detection)), "the collector")
        if sum(before):
            self.graph.until(lambda: all(map(ge, self.told, before)), "what the journal holds")

    def kill(self, node):
        process = self.running.pop(node)
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()

    def send(self, events, *, first=0):
        """Publish events, those of which the collector has told nothing; commands are latched."""
        number = dict.fromkeys(KINDS, 0)
        for index, event in enumerate(events):
            kind = type(event)
            number[kind] += 1
            new = index >= first if kind is Command else number[kind] > self.told[
                KINDS.index(kind)]
            if new:
                self.publishers[kind].publish(cdr_of(event))

    def until_told(self, events, but=0):
        """Wait until all samples and detections but some are told as received."""
        counts = [sum(isinstance(event, kind) for event in events) - but for kind in KINDS[:2]]
        self.graph.until(lambda: all(map(ge, self.told, counts)), "what was sent")

    def saved(self):
        path = self.folder / "map.json"
        assert self.graph.call(Trigger, "measurement_collector/finish").success
        answer = self.graph.call(SaveMap, "solver/save_map", path=str(path))
        return read_json(path)["error_map"] if answer.success else answer.message

    def close(self):
        for node in list(self.running):
            with contextlib.suppress(ProcessLookupError):
                self.kill(node)


@pytest.fixture
def cell(graph, ros_environment, tmp_path):
    cell = Cell(graph, ros_environment, tmp_path)
    yield cell
    cell.close()


def undisturbed(events):
    return calibrate(collected(events)[1], Options()).error_map


def same(found, expected):
    for name in ("gx", "gy", "u_gx", "g_theta"):
        np.testing.assert_array_equal(np.array(found[name], dtype=float),
                                      getattr(expected, name))


@pytest.fixture(scope="module")
def run():
    return events_of(small_plan("0, 90, tx", repeats=1))


def test_a_collector_killed_again_and_again_goes_on_in_it_and_the_map_is_the_same(cell, run):
    cell.start("solver", result_folder=cell.folder)
    cell.start_collector()
    done, rng = 0, np.random.default_rng(4)
    for cut in (np.arange(1, 3) * len(run) // 3 + rng.integers(0, 60, 2)).tolist():
        cell.send(run[:cut], first=done)
        cell.until_told(run[:cut], but=3)  # the last are still on their way
        cell.kill("measurement_collector")
        cell.start_collector()
        done, newest = cut, [event for event in run[:cut] if isinstance(event, Command)][-1]
        heard = cell.graph.listen(names.of_node("measurement_collector", names.HEALTH))
        cell.graph.until(lambda newest=newest, heard=heard: any(
            {"phase": Phase(newest.phase).name, "view": str(newest.view_index)}.items()
            <= {value.key: value.value for value in message.values}.items()
            for message in heard), "the view in which it was")
    cell.send(run, first=done)
    cell.until_told(run)
    same(cell.saved(), undisturbed(run))
    [journal] = (path for path in cell.folder.iterdir() if path.name.startswith("journal_"))
    cell.kill("measurement_collector")
    offline = collect_bag(journal, VALUES)
    assert [line.partition(",")[0] for line in offline.lost] == [
        "the file ends without its footer"]
    same(read_json(cell.folder / "map.json")["error_map"],
         calibrate(offline.measurements, Options()).error_map)


def test_a_solver_killed_after_a_view_gets_all_readings_again(cell, run):
    second = next(n for n, event in enumerate(run) if isinstance(event, Command)
                  and (event.phase, event.view_index) == (Phase.PLACE, 1))
    cell.start("solver", result_folder=cell.folder)
    cell.start_collector()
    measured = cell.graph.listen(names.MEASUREMENT)
    cell.send(run[:second + 1])
    cell.graph.until(lambda: measured, "the first view")
    cell.kill("solver")
    cell.start("solver", result_folder=cell.folder)
    cell.send(run, first=second + 1)
    cell.until_told(run)
    solved = cell.graph.listen(names.of_node("solver", names.SOLVED))
    answer = cell.graph.call(Trigger, "measurement_collector/finish")
    cell.graph.until(lambda: answer.message in {message.data for message in solved}, "the map")
    same(cell.saved(), undisturbed(run))


def test_a_second_collector_on_one_journal_is_refused(cell):
    cell.start_collector()
    cell.graph.until(lambda: any(cell.folder.glob("journal_*/metadata.yaml")), "the journal")
    first = cell.running.pop("measurement_collector")
    cell.start("measurement_collector", journal=cell.folder)
    _, err = cell.running["measurement_collector"].communicate(timeout=120)
    cell.running["measurement_collector"] = first
    [line] = [text for text in err.splitlines() if text.startswith("selfcal: ")]
    assert line.endswith("another process writes this journal; end it or name another folder")
