# SPDX-License-Identifier: Apache-2.0
"""A small calibration with known truth, as events, as readings and as a bag; no middleware."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from selfcal_ros.bagio.messages.from_model import event_fields
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.schemas import ChannelDecoder, typestore
from selfcal_ros.bagio.writer import BagWriter, build
from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.model.plan_form import plan_to_dict
from selfcal_ros.model.readings import Measurements
from selfcal_ros.model.view import Plan
from selfcal_ros.simulation.bag import write_simulation
from selfcal_ros.simulation.cell import CellSettings, Event, plan_events
from selfcal_ros.simulation.spec import Faults, apply_faults, read_simulation
from selfcal_ros.topics import INPUT_TOPICS
from test.support.collecting import gathered
from test.support.plans import plan_of
from test.support.truth import random_truth

START_NS = 1_700_000_000_000_000_000
TAIL = b"\x81\x9f\x93\x01"
"""What the middleware may leave behind a message."""
NOISE = {"sigma_xy_m": 2e-8, "sigma_theta_rad": 2e-5}


def small_plan(text: str = "0, 90, tx", *, repeats: int = 2) -> Plan:
    """Return a plan of a 5 x 5 plate with 8 lines."""
    return plan_of(text, 5, count=8, line=True, repeats=repeats)


def events_of(plan: Plan, seed: int = 5) -> list[Event]:
    """Return all messages of a plan measured on a stage with errors."""
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return list(
        plan_events(
            truth, plan, settings=CellSettings(**NOISE), rng=rng, start_ns=START_NS
        )
    )


def collected(
    events: list[Event],
) -> tuple[Collector, Measurements, dict[int, ViewProgress]]:
    """Return what the collector makes of them without any node."""
    collector = gathered(events)
    return collector, *collector.collect()


def cdr_of(event: Event, frame_id: str = "stage") -> bytes:
    """Return the bytes of an event as a raw subscription of rclpy hands them over."""
    topic, fields = event_fields(event, frame_id)
    name = INPUT_TOPICS[topic]
    return (
        bytes(typestore().serialize_cdr(build(typestore(), name, fields), name)) + TAIL
    )


def decoded(reader: BagReader) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time of logging in ns and message of every input message of a bag."""
    decoders = {
        topic: ChannelDecoder(topic, name, (typestore(),), Counter(), told=True)
        for topic, name in INPUT_TOPICS.items()
    }
    for topic, logged_ns, data in reader.cdr_messages():
        yield topic, logged_ns, decoders[topic].one(data)


def plan_file(folder: Path, plan: Plan) -> str:
    """Write PLAN.yaml and return its path."""
    path = folder / "plan.yaml"
    path.write_text(yaml.safe_dump(plan_to_dict(plan)))
    return str(path)


def small_bag(
    folder: Path, plan: Plan | None = None, *, correlation: float = 0.0, **faults: float
) -> Path:
    """Write a simulated bag with noise and faults, and return its folder.

    The errors of the stage are correlated over as many pitches.
    """
    plan_file(folder, plan or small_plan())
    simulation = folder / "simulation.yaml"
    simulation.write_text(
        yaml.safe_dump(
            {
                "plan": "plan.yaml",
                "seed": 7,
                "noise": {"sigma_xy": 2e-8, "sigma_theta": 2e-5},
                "truth": {"correlation": correlation},
                "faults": {"lost": 0.02, "duplicated": 0.02, "delay": 0.05, **faults},
            }
        )
    )
    write_simulation(read_simulation(simulation), folder / "bag")
    return folder / "bag"


def stepped_bag(folder: Path, step_s: float) -> Path:
    """Write a bag in whose midst the clock of stage and microscope steps back, and return it."""
    arrivals, _ = apply_faults(
        events_of(small_plan()), Faults(clock_step_s=step_s), np.random.default_rng(1)
    )
    with BagWriter(folder / "bag") as writer:
        for topic, typename in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [])
        for arrival_ns, event in arrivals:
            topic, fields = event_fields(event, "stage")
            writer.write(f"/{topic}", fields, arrival_ns)
    return folder / "bag"
