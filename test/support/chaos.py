# SPDX-License-Identifier: Apache-2.0
"""Cells whose messages are lost, doubled and late, and whose nodes are killed, side by side.

In one cell messages only overtake each other and come twice; in the other some are lost or spoiled
as well and the clock steps. Collectors and solvers are killed (SIGKILL) at random moments and
started again. Every detection that was sent must be used, or rejected by reason; the map must be
the one of the same messages in a quiet process and, in the first cell, that of the undisturbed
run, bit for bit. The disk of a third cell is full for a while.
"""

import contextlib
import resource
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.messages import Detection
from selfcal_ros.errors import NotIdentifiableError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.nodes import names
from selfcal_ros.simulation.cell import Event
from selfcal_ros.simulation.faults import Faults, apply_faults
from test.support.forked import Forks
from test.support.killed import Cell
from test.support.ros import Graph
from test.support.sessions import collected, events_of, small_plan

HARMLESS = Faults(duplicated=0.05, delay_s=0.05)
HARMFUL = Faults(lost=0.05, duplicated=0.05, outliers=0.03, low_score=0.02, not_finite=0.02,
                 unknown_mark=0.02, delay_s=0.05, clock_step_s=0.2, encoder_gap_s=0.3)
CELLS = {"quiet_messages": HARMLESS, "lost_messages": HARMFUL}
NODES = ("measurement_collector", "solver")
COMPARED = ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta")
WHILE_TRYING = 0.1
"""Share of the messages that may not get into the journal although there is disk again."""


@dataclass
class Story:
    """One cell of one round: what was measured, what arrives, where nodes are killed."""

    cell: Cell
    measured: list[Event]
    arriving: list[Event]
    ledger: dict[str, int]
    kills: list[tuple[int, str]]
    sent: int = 0
    faults: list[str] = field(default_factory=list)

    def play_to(self, share: float) -> None:
        """Send up to this share of the messages, with the kills that lie on the way."""
        end = round(share * len(self.arriving))
        for cut, node in [kill for kill in self.kills if self.sent < kill[0] <= end]:
            self._send(cut)
            self.cell.kill(node)
            self._start(node)
        self._send(end)

    def _send(self, end: int) -> None:
        self.cell.deliver(self.arriving[:end], first=self.sent)
        self.sent = end

    def _start(self, node: str) -> None:
        if node == "solver":
            self.cell.start(node, result_folder=self.cell.folder)
        else:
            self.cell.start_collector()

    def start(self) -> None:
        """Start the nodes."""
        for node in reversed(NODES):
            self._start(node)

    def judge(self) -> str:
        """Save the result, note in `faults` what is wrong with it, return a line for people."""
        found = self.cell.saved()
        sent = sum(isinstance(event, Detection) for event in self.arriving)
        measurements, progress = collected(self.arriving)[1:]
        if isinstance(found, str):
            return self._refused(found, measurements)
        used = sum(view["used"] for view in found["views"])
        rejected = sum(found["rejected"].values())
        if used + rejected != sent:
            self.faults.append(f"{sent} detections sent, {used} used and {rejected} rejected")
        self._compare(found, calibrate(measurements).error_map, "these messages")
        destroyed = sum(isinstance(event, Detection) for event in self.measured) - len(
            {id(event) for event in self.arriving if isinstance(event, Detection)})
        if not set(self.ledger) - {"duplicated"}:
            self._compare(found, calibrate(collected(self.measured)[1]).error_map,
                          "the undisturbed run")
        return (f"{sent} detections = {used} used + {rejected} rejected; {max(destroyed, 0)} lost "
                f"before, {named_missing(progress)} named as missing; "
                f"killed {', '.join(node for _, node in self.kills)}")

    def _refused(self, message: str, measurements: object) -> str:
        try:
            calibrate(measurements)
            self.faults.append(f"no map: {message}")
        except NotIdentifiableError as error:
            if str(error) not in message:
                self.faults.append(f"refused with '{message}' instead of '{error}'")
        return f"refused: {message}"

    def _compare(self, found: dict, expected: object, what: str) -> None:
        for name in COMPARED:
            if not np.array_equal(np.array(found["error_map"][name], dtype=float),
                                  getattr(expected, name), equal_nan=True):
                self.faults.append(f"{name} is not that of {what}")


def named_missing(progress: dict[int, ViewProgress]) -> int:
    """Return how many readings of marks and lines the views say are missing."""
    return sum(view.needed for view in progress.values())


def story(cell: Cell, faults: Faults, rng: np.random.Generator, kills: int) -> Story:
    """Return what happens to a cell."""
    measured = events_of(small_plan("0, 90, tx", repeats=2), int(rng.integers(2**31)))
    arrivals, ledger = apply_faults(sorted(measured, key=lambda e: e.stamp_ns), faults, rng)
    arriving = [event for _, event in arrivals]
    cuts = np.sort(rng.integers(len(arriving) // 20, len(arriving), kills))
    return Story(cell, measured, arriving, ledger,
                 [(int(cut), str(rng.choice(NODES))) for cut in cuts])


@contextlib.contextmanager
def cells(environment: dict, folder: Path, forks: Forks | None) -> Iterator[list[Cell]]:
    """Yield two cells side by side; none of their nodes is left behind."""
    graph, out = Graph(int(environment["ROS_DOMAIN_ID"])), []
    try:
        for name in CELLS:
            (folder / name).mkdir()
            out.append(Cell(graph, environment, folder / name, name, forks=forks))
        yield out
    finally:
        for cell in out:
            cell.close()
        graph.close()


def one_round(seed: int, environment: dict, folder: Path, *, kills: int = 3,
              forks: Forks | None = None) -> tuple[list[str], list[str]]:
    """Run a round of two cells; return a line for each, and what was wrong.

    With `forks`, nodes that are killed are forks, and those that are not run in this process.
    """
    rng = np.random.default_rng(seed)
    with cells(environment, folder, forks) as running:
        stories = [story(cell, faults, rng, kills)
                   for cell, faults in zip(running, CELLS.values(), strict=True)]
        for one in stories:
            if forks:
                one.cell.inside = dict.fromkeys(set(NODES) - {node for _, node in one.kills})
            one.start()
        for share in np.linspace(0, 1, 9)[1:]:
            for one in stories:
                one.play_to(float(share))
        lines = [f"{one.cell.namespace}: {one.judge()}" for one in stories]
        wrong = [f"{one.cell.namespace}: {text}" for one in stories for text in one.faults]
    return lines, wrong


def full_disk(seed: int, environment: dict, folder: Path, *, forks: Forks | None = None,
              ) -> tuple[str, list[str]]:
    """Measure in a cell whose disk is full for a third of the run; return a line, what was wrong.

    Each detection is used or rejected all the same, and each message is in the journal, or told by
    the health as not in it. The disk is a limit to the size of the collector's files.
    """
    rng = np.random.default_rng(seed)
    graph = Graph(int(environment["ROS_DOMAIN_ID"]))
    cell = Cell(graph, environment, folder, "full_disk", forks=forks)
    cell.inside = {"solver": None} if forks else {}
    try:
        one = story(cell, HARMLESS, rng, 0)
        told: list = []
        topic = names.of_node(cell.name("measurement_collector"), names.HEALTH)
        graph.hand.create_subscription(topic.type, topic.name, told.append, topic.qos)
        one.start()
        first, last = rng.uniform(0.2, 0.4), rng.uniform(0.6, 0.8)
        one.play_to(first)
        [file] = folder.glob("full_disk/journal_*/*.mcap")
        cell.limit_files("measurement_collector", file.stat().st_size + int(rng.integers(3000)))
        one.play_to(last)
        cell.limit_files("measurement_collector", resource.RLIM_INFINITY)
        one.play_to(1.0)
        line = one.judge()
        told.clear()
        graph.until(lambda: told, "the health")
        lost = int({item.key: item.value for item in told[-1].values}["journal_lost"])
        cell.end("measurement_collector")
        kept = sum(len(item) if hasattr(item, "__len__") else 1
                   for _, item in BagReader(file.parent).columns())
        received = sum(cell.told)
        if kept + lost != received or not 0 < lost < (last - first + WHILE_TRYING) * received:
            one.faults.append(f"{received} messages received, {kept} in the journal and {lost} "
                              "told as not in it")
        return f"{line}; {kept} of {received} messages in the journal", one.faults
    finally:
        cell.close()
        graph.close()
