# SPDX-License-Identifier: Apache-2.0
"""Cells whose messages are lost, doubled and late, and whose nodes are killed, side by side.

In one cell messages only overtake each other and come twice; in the other some are lost or spoiled
as well and the clock steps, back or ahead. Somebody listened to everything in either cell before
its nodes were there. Collectors and solvers are killed (SIGKILL) at random moments and
started again. Every detection that was sent must be used, or rejected by reason; the map must be
the one of the same messages in a quiet process and, in the first cell, that of the undisturbed
run, bit for bit. The disk of a third cell is full for a while; in a fourth one, which follows
commands, sequencers are killed; in a fifth a run was stamped a day ahead before. In a sixth,
strangers publish maps that would harm, images that would start a program or fill the memory, and
play a bag; another recorder writes beside the journals, and the disk has no space for the result.
"""

import contextlib
import io
import math
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rclpy.node import Node
from selfcal_msgs.msg import ViewCommand
from std_srvs.srv import Trigger

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.bagio.writer import BagWriter
from selfcal_ros.collection.expected import ViewProgress
from selfcal_ros.collection.inputs import Command, Detection
from selfcal_ros.errors import ExitCode, SelfcalError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.files import read_json
from selfcal_ros.model.view import Plan
from selfcal_ros.nodes import names
from selfcal_ros.nodes.bag_player import BagPlayer
from selfcal_ros.nodes.compensator import CompensatorNode
from selfcal_ros.nodes.filling import fill
from selfcal_ros.nodes.mark_detector import MarkDetectorNode
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.simulation.cell import Event
from selfcal_ros.simulation.spec import Faults, apply_faults
from selfcal_ros.topics import INPUT_TOPICS
from selfcal_ros.units import NS_PER_S
from test.support.bench_cell import largest_deviation
from test.support.cameras import DETECTS
from test.support.forked import Forks
from test.support.independent_cell import IndependentCell
from test.support.killed import Cell
from test.support.maps import random_map, result_of
from test.support.ros import Graph
from test.support.sessions import (
    cdr_of,
    collected,
    decoded,
    events_of,
    plan_file,
    small_bag,
    small_plan,
)

HARMLESS = Faults(duplicated=0.05, delay_s=0.05)
HARMFUL = Faults(
    lost=0.05,
    duplicated=0.05,
    outliers=0.03,
    low_score=0.02,
    not_finite=0.02,
    unknown_mark=0.02,
    delay_s=0.05,
    clock_step_s=0.2,
    encoder_gap_s=0.3,
)
CELLS = ("quiet_messages", "lost_messages")
STEPS_S = (-5.0, -0.2, 0.2, 5.0)
"""By how much the clock of the second cell is set back, one in each round; < 0 = ahead."""
NODES = ("measurement_collector", "solver")
DAY_NS = 86_400 * NS_PER_S
COMPARED = ("gx", "gy", "u_gx", "u_gy", "g_theta", "u_g_theta")
FEWEST_MARKS, FEWEST_LINES = 20, 8
"""Exposures of a view between which sequencers are killed."""
NOISE_M, NOISE_RAD = 2e-8, 1e-6
"""Largest deviations from the truth that the noise of the cell that follows commands gives."""
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
        rejected = sum(
            count
            for reason, count in found["rejected"].items()
            if not reason.startswith(("command_", "encoder_sample_"))
        )
        if used + rejected != sent:
            self.faults.append(
                f"{sent} detections sent, {used} used and {rejected} rejected"
            )
        self._compare(found, calibrate(measurements).error_map, "these messages")
        destroyed = sum(isinstance(event, Detection) for event in self.measured) - len(
            {id(event) for event in self.arriving if isinstance(event, Detection)}
        )
        if not set(self.ledger) - {"duplicated"}:
            self._compare(
                found,
                calibrate(collected(self.measured)[1]).error_map,
                "the undisturbed run",
            )
        return (
            f"{sent} detections = {used} used + {rejected} rejected; "
            f"{max(destroyed, 0)} lost before, {named_missing(progress)} named as "
            f"missing; killed {', '.join(node for _, node in self.kills)}"
        )

    def _refused(self, message: str, measurements: object) -> str:
        try:
            calibrate(measurements)
            self.faults.append(f"no map: {message}")
        except SelfcalError as error:
            if str(error) not in message:
                self.faults.append(f"refused with '{message}' instead of '{error}'")
        return f"refused: {message}"

    def _compare(self, found: dict, expected: object, what: str) -> None:
        for name in COMPARED:
            if not np.array_equal(
                np.array(found["error_map"][name], dtype=float),
                getattr(expected, name),
                equal_nan=True,
            ):
                self.faults.append(f"{name} is not that of {what}")


def named_missing(progress: dict[int, ViewProgress]) -> int:
    """Return how many readings of marks and lines the views say are missing."""
    return sum(view.needed for view in progress.values())


def faults_of(seed: int) -> tuple[Faults, Faults]:
    """Return what goes wrong in the two cells of a round."""
    return HARMLESS, replace(HARMFUL, clock_step_s=STEPS_S[seed % len(STEPS_S)])


def listen(cell: Cell) -> None:
    """Have a stranger listen to everything in a cell, as `ros2 topic echo` and bridges do.

    Before the nodes are there: who takes it for one of them loses what it sends.
    """
    stranger = cell.graph.add(
        Node(f"stranger_{cell.namespace}", context=cell.graph.context)
    )
    for topic in (*names.INPUTS, *names.RESULTS):
        stranger.create_subscription(
            topic.type, cell.name(topic.name), lambda _: None, topic.qos, raw=True
        )
    cell.graph.until(lambda: all(cell.matched.values()), "the stranger")


def story(cell: Cell, faults: Faults, rng: np.random.Generator, kills: int) -> Story:
    """Return what happens to a cell."""
    measured = events_of(small_plan("0, 90, tx", repeats=2), int(rng.integers(2**31)))
    arrivals, ledger = apply_faults(
        sorted(measured, key=lambda e: e.stamp_ns), faults, rng
    )
    arriving = [event for _, event in arrivals]
    cuts = np.sort(rng.integers(len(arriving) // 20, len(arriving), kills))
    return Story(
        cell,
        measured,
        arriving,
        ledger,
        [(int(cut), str(rng.choice(NODES))) for cut in cuts],
    )


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


def one_round(
    seed: int,
    environment: dict,
    folder: Path,
    *,
    kills: int = 3,
    forks: Forks | None = None,
) -> tuple[list[str], list[str]]:
    """Run a round of two cells; return a line for each, and what was wrong.

    With `forks`, nodes that are killed are forks, and those that are not run in this process.
    """
    rng = np.random.default_rng(seed)
    with cells(environment, folder, forks) as running:
        stories = [
            story(cell, faults, rng, kills)
            for cell, faults in zip(running, faults_of(seed), strict=True)
        ]
        for one in stories:
            listen(one.cell)
            if forks:
                one.cell.inside = dict.fromkeys(
                    set(NODES) - {node for _, node in one.kills}
                )
            one.start()
        for share in np.linspace(0, 1, 9)[1:]:
            for one in stories:
                one.play_to(float(share))
        lines = [f"{one.cell.namespace}: {one.judge()}" for one in stories]
        wrong = [
            f"{one.cell.namespace}: {text}" for one in stories for text in one.faults
        ]
    return lines, wrong


def full_disk(
    seed: int, environment: dict, folder: Path, *, forks: Forks | None = None
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
        cell.limit_files(
            "measurement_collector", file.stat().st_size + int(rng.integers(3000))
        )
        one.play_to(last)
        cell.limit_files("measurement_collector", resource.RLIM_INFINITY)
        one.play_to(1.0)
        line = one.judge()
        told.clear()
        graph.until(lambda: told, "the health")
        lost = int({item.key: item.value for item in told[-1].values}["journal_lost"])
        cell.end("measurement_collector")
        kept = sum(
            len(item) if hasattr(item, "__len__") else 1
            for _, item in BagReader(file.parent).columns()
        )
        received = sum(cell.told)
        if (
            kept + lost != received
            or not 0 < lost < (last - first + WHILE_TRYING) * received
        ):
            one.faults.append(
                f"{received} messages received, {kept} in the journal and {lost} told as not in it"
            )
        return f"{line}; {kept} of {received} messages in the journal", one.faults
    finally:
        cell.close()
        graph.close()


def killed_sequencers(
    seed: int,
    environment: dict,
    folder: Path,
    *,
    kills: int = 3,
    forks: Forks | None = None,
) -> tuple[str, list[str]]:
    """Measure in a cell that follows commands and whose sequencers are killed within views.

    Each one that is started takes up the run in its view, by the command that the last one gave;
    the map is the truth to the noise and, bit for bit, that of the journal.
    """
    rng, plan = np.random.default_rng(seed), small_plan("0, 90, tx", repeats=1)
    exposures = [
        (index, number)
        for index, view in enumerate(plan.views)
        for number in range(FEWEST_MARKS * view.grid + FEWEST_LINES * view.angular)
    ]
    stops = [
        exposures[place] for place in np.sort(rng.choice(len(exposures), kills, False))
    ]
    graph = Graph(int(environment["ROS_DOMAIN_ID"]))
    cell = Cell(graph, environment, folder, "killed_sequencers", forks=forks)
    cell.inside = dict.fromkeys(NODES) if forks else {}
    try:
        listen(cell)
        maps = graph.listen(
            replace(names.ERROR_MAP, name=cell.name(names.ERROR_MAP.name))
        )
        cell.start("solver", result_folder=cell.folder)
        cell.start_collector()
        run_id, faults = _taken_up(cell, plan, stops)
        saved = cell.saved()
        graph.until(
            lambda: maps and maps[-1].run_id == run_id and maps[-1].identifiable,
            "the map",
        )
        off_m, off_rad = largest_deviation(maps[-1])
        if off_m > NOISE_M or off_rad > NOISE_RAD:
            faults.append(f"the map is off by {off_m:.1e} m, {off_rad:.1e} rad")
        cell.end("measurement_collector")
        [journal] = folder.glob(f"{cell.namespace}/journal_*")
        offline = collect_bag(journal, CollectorSettings()).measurements
        if (offline.run_id, offline.all_rejected()) != (run_id, {}):
            faults.append(f"run {offline.run_id}, rejected {offline.all_rejected()}")
        expected = calibrate(offline).error_map
        faults += [
            f"{name} is not that of the journal"
            for name in COMPARED
            if not np.array_equal(
                np.array(saved["error_map"][name], dtype=float),
                getattr(expected, name),
                equal_nan=True,
            )
        ]
        return (
            f"killed in views {', '.join(str(view) for view, _ in stops)}; the map is off by "
            f"{off_m:.1e} m, {off_rad:.1e} rad"
        ), faults
    finally:
        cell.close()
        graph.close()


def clock_ahead(
    seed: int,
    environment: dict,
    folder: Path,
    *,
    kills: int = 3,
    forks: Forks | None = None,
) -> tuple[str, list[str]]:
    """Measure in a cell after a run that was stamped a day ahead, and after a restart of its nodes.

    Nothing of that run hides this one, whose map is that of the undisturbed run; the collector
    tells all of that run as received, and the journal has none of it.
    """
    rng = np.random.default_rng(seed)
    graph = Graph(int(environment["ROS_DOMAIN_ID"]))
    cell = Cell(graph, environment, folder, "clock_ahead", forks=forks)
    try:
        listen(cell)
        one = story(cell, HARMLESS, rng, kills)
        one.start()
        ahead_ns = time.time_ns() + DAY_NS - one.measured[0].stamp_ns
        cell.deliver(
            [
                replace(event, stamp_ns=event.stamp_ns + ahead_ns)
                for event in one.measured
            ]
        )
        for node in NODES:
            cell.kill(node)
        cell.told, cell.newest_ns = (0, 0, 0), 0
        one.start()
        one.play_to(1.0)
        line = one.judge()
        cell.end("measurement_collector")
        for journal in folder.glob(f"{cell.namespace}/journal_*"):
            stamps = [
                message.header.stamp.sec for *_, message in decoded(BagReader(journal))
            ]
            if max(stamps, default=0) * NS_PER_S >= one.measured[0].stamp_ns + ahead_ns:
                one.faults.append(
                    f"{journal.name} has messages of the run that was ahead"
                )
        return line, one.faults
    finally:
        cell.close()
        graph.close()


SMALL = 4000
"""Bytes to which files of a solver are limited for a while: less than a result has."""
HARMFUL_VALUES = {"gx": (math.nan, math.inf, 2e-3), "g_theta": (math.inf, 0.5)}
"""What maps of strangers have where they are stated to be known, m and rad."""
EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 99 99\n%%EndComments\nshowpage\n%%EOF\n"
BOMB_SIDE = 8000
"""Pixels of the side of an image of some kB."""


def attacked(
    seed: int, environment: dict, folder: Path, *, forks: Forks | None = None
) -> tuple[str, list[str]]:
    """Measure in a cell among strangers whose messages and files would harm.

    The map is that of the undisturbed run, the compensator corrects by no other, the recording
    beside the journals is as it was, and the result is written once there is space.
    """
    rng, place = np.random.default_rng(seed), folder / "attacked"
    recording = place / "attacked" / "recording"
    recording.parent.mkdir(parents=True)
    graph = Graph(int(environment["ROS_DOMAIN_ID"]))
    cell = Cell(graph, environment, place, "attacked", forks=forks)
    try:
        one = story(cell, HARMLESS, rng, 0)
        before = _recorded(recording, one.measured)
        saved = place / "by_itself.json"
        cell.start("solver", result_folder=place, save_path=saved)
        cell.start_collector()
        compensator = graph.node(
            partial(CompensatorNode, namespace=cell.namespace), require_qualified=False
        )
        cell.limit_files("solver", SMALL)
        one.play_to(rng.uniform(0.3, 0.5))
        _harm(cell, compensator, one.measured, seed)
        _show_images(cell, one.faults)
        _play(cell, place, one.faults)
        one.play_to(1.0)
        if "cannot be written" not in str(cell.saved()) or saved.exists():
            one.faults.append("a result was written on a full disk")
        cell.limit_files("solver", resource.RLIM_INFINITY)
        graph.until(saved.exists, "the result on a disk that has space")
        line = one.judge()
        gx = np.array(read_json(saved)["error_map"]["gx"], dtype=float)
        graph.until(
            lambda: (
                compensator.session.compensator is not None
                and np.array_equal(compensator.session.compensator.error_map.gx, gx)
            ),
            "the map in the compensator",
        )
        if {file: file.read_bytes() for file in recording.iterdir()} != before:
            one.faults.append("the recording beside the journals has changed")
        return line, one.faults
    finally:
        cell.close()
        graph.close()


def _recorded(folder: Path, events: list[Event]) -> dict[Path, bytes]:
    """Return the files of a recording of an unfinished run, as a recorder has written them."""
    with BagWriter(folder) as writer:
        for topic, kind in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", kind, [])
        command = next(event for event in events if isinstance(event, Command))
        writer.write_raw(f"/{names.COMMAND.name}", cdr_of(command), command.stamp_ns)
    return {file: file.read_bytes() for file in folder.iterdir()}


def _speak(cell: Cell, topic: names.Topic) -> Any:
    """Return a publisher of a stranger, once it is heard."""
    publisher = cell.graph.hand.create_publisher(
        topic.type, cell.name(topic.name), topic.qos
    )
    cell.graph.until(publisher.get_subscription_count, topic.name)
    return publisher


def _harm(
    cell: Cell, compensator: CompensatorNode, events: list[Event], seed: int
) -> None:
    """Publish maps that would harm; each of them is refused."""
    publisher, refused = _speak(cell, names.ERROR_MAP), compensator.refusals.counts
    plate = next(event.artifact for event in events if isinstance(event, Command))
    good = from_model.error_map(
        result_of(random_map(plate, seed)), events[-1].stamp_ns, "stage"
    )
    for name, values in HARMFUL_VALUES.items():
        for value in values:
            count = refused[names.ERROR_MAP.name]
            spoilt = np.append(good[name][:-1], value)
            publisher.publish(
                fill(names.ERROR_MAP.type(), good | {"qualified": True, name: spoilt})
            )
            cell.graph.until(
                lambda count=count: refused[names.ERROR_MAP.name] > count,
                f"the refusal of {value} in {name}",
            )
    cell.graph.hand.destroy_publisher(publisher)


def _show_images(cell: Cell, faults: list[str]) -> None:
    """Publish images that must not be decoded; a detector refuses both, and lives."""
    detector = cell.graph.node(
        partial(MarkDetectorNode, namespace=cell.namespace),
        **DETECTS,
        transport="compressed",
    )
    topic = names.image_topics("compressed", 10)[0]
    publisher, bomb = _speak(cell, topic), io.BytesIO()
    Image.new("1", (BOMB_SIDE, BOMB_SIDE)).save(bomb, "PNG")
    for number, data in enumerate((EPS, bomb.getvalue())):
        image = topic.type(format="png", data=data)
        image.header.stamp.sec = number + 1
        publisher.publish(image)
    cell.graph.until(lambda: detector.refusals.counts[topic.name] == 2, "the refusals")
    if detector.diagnose_session().values["images"]:
        faults.append("an image was used that must not be decoded")
    cell.graph.hand.destroy_publisher(publisher)
    cell.graph.remove(detector)


def _play(cell: Cell, folder: Path, faults: list[str]) -> None:
    """Have a player start in the cell, whose stage publishes: it plays nothing."""
    (folder / "other").mkdir()
    player = cell.graph.node(
        partial(BagPlayer, namespace=cell.namespace),
        rate=0.0,
        bag=str(small_bag(folder / "other")),
    )
    cell.graph.until(player.finished.done, "the end of the player")
    if (player.exit_code, player.player.played) != (ExitCode.BAD_INPUT, 0):
        faults.append(f"{player.player.played} messages were played into the cell")
    cell.graph.remove(player)


def _taken_up(
    cell: Cell, plan: Plan, stops: list[tuple[int, int]]
) -> tuple[str, list[str]]:
    """Run a plan with kills of the sequencer; return the run and what was wrong with it."""
    graph, faults, run_ids = cell.graph, [], set()
    machine = graph.add(
        IndependentCell(context=graph.context, namespace=cell.namespace)
    )
    commands = graph.listen(replace(names.COMMAND, name=cell.name(names.COMMAND.name)))
    machine.hold_at = stops[0]
    start_sequencer(cell, plan)
    for stop, after in zip(stops, [*stops[1:], None], strict=True):
        graph.until(lambda: machine.held, "the place of the next kill")
        cell.kill("pose_sequencer")
        last = commands[-1]
        run_ids |= {command.run_id for command in commands}
        commands.clear()
        start_sequencer(cell, plan)
        graph.until(lambda: commands, "the command of the view in which it was")
        # PLACE before the first exposure
        if commands[0] != last or last.view_index != stop[0]:
            faults.append(
                f"killed in view {stop[0]} after {last}, taken up with {commands[0]}"
            )
        machine.hold_at = after
    graph.until(lambda: commands[-1].phase == ViewCommand.DONE, "the end of the plan")
    run_ids |= {command.run_id for command in commands}
    wanted = list(range(stops[-1][0], len(plan.views)))
    measured = [
        item.view_index for item in commands if item.phase == ViewCommand.MEASURE
    ]
    if measured != wanted or len(run_ids) != 1:
        faults.append(
            f"views {measured} of runs {sorted(run_ids)} after the last kill instead of "
            f"{wanted} of one run"
        )
    return last.run_id, faults


def start_sequencer(cell: Cell, plan: Plan) -> None:
    """Start a sequencer and have it begin, or take up, the run of a plan."""
    cell.start(
        "pose_sequencer",
        plan=plan_file(cell.folder, plan),
        auto_confirm=True,
        settle_time=0.0,
    )
    # a second start changes nothing
    cell.answer(Trigger, "pose_sequencer/start", again_s=2.0)
