# SPDX-License-Identifier: Apache-2.0
"""Everything that goes wrong in a cell, with a ledger of what was done to which message."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from selfcal_ros.collection.messages import Detection, EncoderSample, Kind
from selfcal_ros.errors import InputError
from selfcal_ros.simulation.cell import Event
from selfcal_ros.units import M_PER_UM, NS_PER_S, RAD_PER_MRAD

PARTS = ("lost", "outliers", "low_score", "not_finite", "unknown_mark", "duplicated")
"""Faults that meet a part of the detections, one at most each; in the order of the draw."""


@dataclass(frozen=True)
class Faults:
    """What goes wrong: parts of the detections (0..1), times in s.

    Attributes
    ----------
    lost, duplicated, outliers : float
        Parts of the detections that never arrive, arrive twice, or lie off by 1 to 20 um
        (angular: by 1 to 20 mrad).
    low_score, not_finite, unknown_mark : float
        Parts with a score of 0.1, a NaN offset, or an id off the plate.
    delay_s : float
        Delay of arrival, drawn from an exponential distribution with a fifth of this as its mean;
        messages overtake each other.
    clock_step_s : float
        In the middle of the recording the cell's clock steps back by this much; 0 = never.
    encoder_gap_s : float
        Length of a hole in the encoder stream, at a third of the recording; 0 = none.

    Raises
    ------
    InputError
        If the parts add up to more than 1.
    """

    lost: float = 0.0
    duplicated: float = 0.0
    outliers: float = 0.0
    low_score: float = 0.0
    not_finite: float = 0.0
    unknown_mark: float = 0.0
    delay_s: float = 0.0
    clock_step_s: float = 0.0
    encoder_gap_s: float = 0.0

    def __post_init__(self) -> None:
        """Refuse parts that cannot all be: a detection has one fault at most."""
        total = sum(getattr(self, name) for name in PARTS)
        if total > 1 + 1e-9:
            raise InputError("faults", f"the parts of the detections add up to {total:g}",
                             "keep the sum at 1 or below: a detection has one fault at most")


def apply_faults(events: Sequence[Event], faults: Faults, rng: np.random.Generator,
                 ) -> tuple[list[tuple[int, Event]], dict[str, int]]:
    """Return (time of arrival in ns, message) in the order of arrival, and the ledger.

    Parameters
    ----------
    events : sequence
        Messages in the order of their stamps.
    faults : Faults
        What goes wrong.
    rng : numpy.random.Generator
        Source of chance.
    """
    ledger: Counter = Counter()
    first, last = events[0].stamp_ns, events[-1].stamp_ns
    gap = first + (last - first) // 3
    step_at = first + (last - first) // 2
    step = round(faults.clock_step_s * NS_PER_S)
    out: list[tuple[int, Event]] = []
    for event in events:
        arrival = event.stamp_ns
        if faults.delay_s:
            arrival += round(rng.exponential(faults.delay_s / 5) * NS_PER_S)
        if isinstance(event, EncoderSample) and gap <= event.stamp_ns < gap + round(
                faults.encoder_gap_s * NS_PER_S):
            ledger["encoder_samples_lost"] += 1
            continue
        if step and event.stamp_ns >= step_at:
            event = replace(event, stamp_ns=event.stamp_ns - step)
            ledger["stamped_by_the_stepped_clock"] += 1
        for item in _spoil(event, faults, rng, ledger):
            out.append((arrival, item))
    out.sort(key=lambda item: item[0])
    return out, dict(ledger)


def _spoil(event: Event, faults: Faults, rng: np.random.Generator, ledger: Counter) -> list[Event]:
    if not isinstance(event, Detection):
        return [event]
    chance = rng.random()
    for name in PARTS:
        part = getattr(faults, name)
        if chance < part:
            ledger[name] += 1
            return _one_fault(event, name, rng)
        chance -= part
    return [event]


def _one_fault(event: Detection, name: str, rng: np.random.Generator) -> list[Event]:
    if name == "lost":
        return []
    if name == "duplicated":
        return [event, event]
    if name == "low_score":
        return [replace(event, score=0.1)]
    if name == "not_finite":
        return [replace(event, offset_x=float("nan"), offset_theta=float("nan"))]
    if name == "unknown_mark":
        return [replace(event, has_id=True, m=9999, n=0, k=2**31)]
    size, angle = rng.uniform(1, 20), rng.uniform(0, 2 * np.pi)
    if event.kind == Kind.ANGULAR:
        return [replace(event, offset_theta=event.offset_theta
                        + np.sign(np.cos(angle)) * size * RAD_PER_MRAD)]
    return [replace(event, offset_x=event.offset_x + size * M_PER_UM * np.cos(angle),
                    offset_y=event.offset_y + size * M_PER_UM * np.sin(angle))]
