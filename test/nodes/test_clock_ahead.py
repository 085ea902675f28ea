# SPDX-License-Identifier: Apache-2.0
"""A run stamped a day ahead, and forged commands, beside honest runs of the real nodes."""

import time
from dataclasses import replace

from selfcal_msgs.srv import SaveMap

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.nodes import names
from selfcal_ros.nodes.measurement_collector import MeasurementCollector
from selfcal_ros.nodes.solver import Solver
from test.support.ports import settings_of
from test.support.ros import publish_events
from test.support.sessions import collected, events_of, small_plan

PLAN = small_plan()
DAY_NS = 86400 * 10**9


def run_of(begin_ns: int, seed: int) -> list:
    """Return the messages of a run that begins then."""
    events = events_of(PLAN, seed)
    by = begin_ns - events[0].stamp_ns
    return [
        replace(
            event,
            stamp_ns=event.stamp_ns + by,
            **({"run_id": str(begin_ns)} if isinstance(event, Command) else {}),
        )
        for event in events
    ]


def test_an_honest_run_after_one_a_day_ahead_is_the_map_that_is_saved(graph, tmp_path):
    now = time.time_ns()
    journals = tmp_path / "journals"
    collector = graph.node(MeasurementCollector, journal=str(journals))
    graph.node(Solver, result_folder=str(tmp_path))
    maps, received = graph.listen(names.ERROR_MAP), collector.session.collector.received
    ahead, honest = run_of(now + DAY_NS, 5), run_of(now - 3600 * 10**9, 6)
    begin = next(
        e for e in honest if isinstance(e, Command) and e.phase == Phase.MEASURE
    )
    forged = [
        replace(begin, stamp_ns=begin.stamp_ns + 10**8, run_id=run_id)
        for run_id in ("", "17")
    ]
    publish_events(graph, ahead)
    graph.until(lambda: sum(received.values()) == len(ahead), "the run that is ahead")
    publish_events(graph, [*honest, *forged])
    graph.until(
        lambda: (
            maps
            and maps[-1].run_id == str(now - 3600 * 10**9)
            and len([*collector.session.collector.timeline.views]) == 4
        ),
        "a map",
    )
    graph.until(
        lambda: sum(received.values()) == len(ahead) + len(honest) + 2, "all of it"
    )
    wanted = calibrate(collected(honest)[1]).error_map
    graph.until(
        lambda: list(maps[-1].gx) == wanted.gx.ravel().tolist(), "the map of the run"
    )
    answer = graph.call(SaveMap, "solver/save_map", path="map.json")
    assert answer.success and f"run {now - 3600 * 10**9}; readings " in answer.message
    assert "newer" not in answer.message and answer.message.count("WARNING") == 1
    assert (
        "stamped more than 60 s ahead of its reception was not used" in answer.message
    )
    assert not collector.session.collector.unusable.keys() ^ {
        "command_from_the_future",
        "encoder_sample_from_the_future",
        "from_the_future",
    }
    graph.remove(collector)
    [journal] = journals.iterdir()
    found = collect_bag(journal, settings_of("measurement_collector")).measurements
    assert calibrate(found).error_map.gx.ravel().tolist() == list(maps[-1].gx)
