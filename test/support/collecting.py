# SPDX-License-Identifier: Apache-2.0
"""Messages of a small cell to spoil one by one, and what the collector makes of them."""

from collections.abc import Iterable
from dataclasses import astuple, dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import (
    DETECTION,
    Command,
    Detection,
    EncoderBlock,
    EncoderSample,
    Kind,
)
from selfcal_ros.model.readings import (
    Measurements,
    ViewReadings,
    readings_digest,
    session_digest,
)
from selfcal_ros.model.view import Plan
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.simulation.cell import CellSettings, Event, plan_events
from test.support.plans import plan_of
from test.support.truth import Truth, random_truth

START_NS = 1_700_000_000_000_000_000


@dataclass
class Scene:
    """All messages of a measured plan, by kind, and the truth behind them."""

    plan: Plan
    truth: Truth
    commands: list[Command]
    samples: list[EncoderSample]
    detections: list[Detection]

    @property
    def events(self) -> list[Event]:
        return [*self.commands, *self.samples, *self.detections]

    def grid(self, number: int) -> int:
        """Return the index of the `number`-th grid detection."""
        return [i for i, d in enumerate(self.detections) if d.kind == Kind.GRID][number]

    def angular(self, number: int) -> int:
        """Return the index of the `number`-th angular detection."""
        return [i for i, d in enumerate(self.detections) if d.kind == Kind.ANGULAR][
            number
        ]

    def spoil(self, index: int, **fields: Any) -> None:
        self.detections[index] = replace(self.detections[index], **fields)


def scene(
    text: str | Plan = "0",
    *,
    size: int = 5,
    count: int = 8,
    line: bool = False,
    repeats: int = 1,
    seed: int = 3,
    t_m: tuple[float, float] | None = None,
    **settings: Any,
) -> Scene:
    """Return the messages of a plan, or of one such as '0, 90, tx', on a stage with errors.

    `t_m` is the displacement of the plate in all views, random if not given.
    """
    plan = (
        text
        if isinstance(text, Plan)
        else plan_of(text, size, count=count, line=line, repeats=repeats)
    )
    rng = np.random.default_rng(seed)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    if t_m is not None:
        truth = replace(truth, t_m=np.tile(t_m, (len(truth.t_m), 1)))
    events = list(
        plan_events(
            truth, plan, settings=CellSettings(**settings), rng=rng, start_ns=START_NS
        )
    )
    kinds = [
        [e for e in events if isinstance(e, kind)]
        for kind in (Command, EncoderSample, Detection)
    ]
    return Scene(plan, truth, *kinds)


def gathered(events: Iterable[Event], **parameters: Any) -> Collector:
    """Return a collector that has taken all events in their order, alike ones in blocks."""
    collector = Collector(CollectorSettings.checked(parameters, "test"))
    for (kind, *_), alike in groupby(events, _alike):
        if kind is Command:
            for command in alike:
                collector.add_command(command)
        elif kind is Detection:
            collector.add_detection_block(
                np.array([*map(astuple, alike)], dtype=DETECTION)
            )
        else:
            collector.add_encoder_block(EncoderBlock.of([*alike]))
    return collector


def _alike(event: Event) -> tuple:
    """Return what messages of one block have in common."""
    if not isinstance(event, EncoderSample):
        return (type(event),)
    return type(event), event.names, len(event.positions), len(event.velocities)


def collect(
    events: Iterable[Event], **parameters: Any
) -> tuple[Measurements, dict[int, ViewProgress]]:
    """Return the readings of all events."""
    return gathered(events, **parameters).collect()


def digest(events: Iterable[Event], **parameters: Any) -> str:
    """Return one digest of everything that the events give."""
    measurements, progress = collect(events, **parameters)
    return session_digest(
        {
            index: readings_digest(item.readings, measurements.rejected)
            for index, item in progress.items()
        }
    )


def encoder_block(sample: EncoderSample) -> EncoderBlock:
    """Return a block of one sample."""
    return EncoderBlock.of([sample])


def detection_table(detection: Detection) -> np.ndarray:
    """Return a table of one detection."""
    return np.array([astuple(detection)], dtype=DETECTION)


def table(readings: ViewReadings) -> dict[tuple, tuple]:
    """Return mark -> what was read of it: ('grid', m, n) -> (dx, dy, count), ('line', k) -> ..."""
    grid = zip(
        readings.m.tolist(),
        readings.n.tolist(),
        readings.dx.tolist(),
        readings.dy.tolist(),
        readings.count.tolist(),
        strict=True,
    )
    lines = zip(
        readings.k.tolist(),
        readings.dtheta.tolist(),
        readings.count_theta.tolist(),
        strict=True,
    )
    return {("grid", m, n): (dx, dy, count) for m, n, dx, dy, count in grid} | {
        ("line", k): (value, count) for k, value, count in lines
    }
