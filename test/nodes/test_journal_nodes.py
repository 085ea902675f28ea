# SPDX-License-Identifier: Apache-2.0
"""Nodes that are killed at any moment: the run goes on, and the map is the undisturbed one."""

import re
import signal

import numpy as np
import pytest
from std_srvs.srv import Trigger

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.estimation.api import Options, calibrate
from selfcal_ros.files import read_json
from selfcal_ros.nodes import names
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.killed import Cell
from test.support.mark_lists import listed_plan
from test.support.sessions import collected, events_of, small_plan

VALUES = CollectorSettings.checked({}, "test")


@pytest.fixture
def cell(graph, ros_environment, tmp_path, forks):
    cell = Cell(graph, ros_environment, tmp_path, forks=forks)
    yield cell
    cell.close()


def undisturbed(events):
    return calibrate(collected(events)[1], Options()).error_map


def same(found, expected):
    for name in ("gx", "gy", "u_gx", "g_theta"):
        np.testing.assert_array_equal(
            np.array(found[name], dtype=float), getattr(expected, name)
        )


@pytest.fixture(scope="module")
def run():
    return events_of(small_plan("0, 90, tx", repeats=1))


@pytest.fixture(scope="module")
def run_of_list():
    return events_of(listed_plan(repeats=1))


@pytest.mark.parametrize("which", ["run", "run_of_list"])
def test_a_collector_killed_again_and_again_goes_on_in_it_and_the_map_is_the_same(
    cell, which, request
):
    run = request.getfixturevalue(which)
    cell.inside["solver"] = None
    cell.start("solver", result_folder=cell.folder)
    cell.start_collector()
    done, rng = 0, np.random.default_rng(4)
    for cut in (np.arange(1, 3) * len(run) // 3 + rng.integers(0, 60, 2)).tolist():
        cell.send(run[:cut], first=done)
        cell.until_told(run[:cut], but=3)  # the last are still on their way
        cell.kill("measurement_collector")
        cell.start_collector()
        done, newest = (
            cut,
            [event for event in run[:cut] if isinstance(event, Command)][-1],
        )
        heard = cell.graph.listen(names.of_node("measurement_collector", names.HEALTH))
        cell.graph.until(
            lambda newest=newest, heard=heard: any(
                {
                    "phase": Phase(newest.phase).name,
                    "view": str(newest.view_index),
                }.items()
                <= {value.key: value.value for value in message.values}.items()
                for message in heard
            ),
            "the view in which it was",
        )
    cell.send(run, first=done)
    cell.until_told(run)
    same(cell.saved()["error_map"], undisturbed(run))
    [journal] = (
        path for path in cell.folder.iterdir() if path.name.startswith("journal_")
    )
    cell.kill("measurement_collector")
    offline = collect_bag(journal, VALUES)
    # of the last file alone, of which a record may have been cut
    assert all(re.match(r"journal_\w+_2\.mcap: ", line) for line in offline.lost)
    assert any(": the file ends without its footer," in line for line in offline.lost)
    same(
        read_json(cell.folder / "map.json")["error_map"],
        calibrate(offline.measurements, Options()).error_map,
    )


def test_a_solver_killed_after_a_view_gets_all_readings_again(cell, run):
    second = next(
        n
        for n, event in enumerate(run)
        if isinstance(event, Command)
        and (event.phase, event.view_index) == (Phase.PLACE, 1)
    )
    cell.inside["measurement_collector"] = None
    cell.start("solver", result_folder=cell.folder)
    cell.start_collector()
    measured = cell.graph.listen(names.MEASUREMENT)
    cell.send(run[: second + 1])
    cell.graph.until(lambda: measured, "the first view")
    cell.kill("solver")
    cell.start("solver", result_folder=cell.folder)
    cell.send(run, first=second + 1)
    cell.until_told(run)
    solved = cell.graph.listen(names.of_node("solver", names.SOLVED))
    answer = cell.graph.call(Trigger, "measurement_collector/finish")
    cell.graph.until(
        lambda: answer.message in {message.data for message in solved}, "the map"
    )
    same(cell.saved()["error_map"], undisturbed(run))


def test_a_solver_that_hangs_for_a_while_solves_then_what_it_missed(cell, run):
    cell.inside["measurement_collector"] = None
    cell.start("solver", result_folder=cell.folder)
    cell.start_collector()
    half = len(run) // 2
    cell.deliver(run[:half])
    cell.running["solver"].send_signal(signal.SIGSTOP)
    cell.deliver(run, first=half)
    cell.running["solver"].send_signal(signal.SIGCONT)
    same(cell.saved()["error_map"], undisturbed(run))


def test_a_second_collector_on_one_journal_is_refused(cell):
    cell.inside["measurement_collector"] = None
    cell.start_collector()
    cell.graph.until(
        lambda: any(cell.folder.glob("journal_*/metadata.yaml")), "the journal"
    )
    cell.inside.clear()
    cell.start("measurement_collector", journal=cell.folder)
    _, err = cell.running["measurement_collector"].communicate(timeout=300)
    [line] = [text for text in err.splitlines() if text.startswith("selfcal: ")]
    assert line.endswith(
        "another process writes this journal; end it or name another folder"
    )
