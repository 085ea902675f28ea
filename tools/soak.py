# SPDX-License-Identifier: Apache-2.0
"""`make soak`: a whole shift through the real nodes, as fast as they take it without a loss.

An encoder at 1 kHz and a detection a second by their stamps; collector with a journal, solver and
sequencer as processes of their own. Two parts run in real time and tell the collector's share of a
core: when the first view begins, and before the last one ends. At the end the map is compared with
that of the journal.

    make soak [HOURS=8] [SIZE=101]
"""

import argparse
import contextlib
import os
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import rclpy
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from selfcal_msgs.srv import SaveMap
from std_srvs.srv import Trigger

from selfcal_ros.applications.papers.readings import hu_plan, simulate_measurements
from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.schemas import typestore
from selfcal_ros.bagio.writer import build
from selfcal_ros.cli.processes import domain, process
from selfcal_ros.collection.inputs import Phase
from selfcal_ros.files import read_json
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.view import Plan
from selfcal_ros.nodes import names
from selfcal_ros.simulation.machine import random_truth

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "test" / "bench")]

from ingest import PITCH_M  # noqa: E402
from ingest_bags import FRONT, Recording, detection_rows, encoder_rows, recording  # noqa: E402

FOLDER = ROOT / "build" / "soak"
ENCODER_NS, SIGMA_M = 1_000_000, 2e-8
WINDOW, BATCH = 1500, 100
PATIENCE_S = 300.0
MARGIN_S = 5.0
"""Time by the stamps between the part in real time and the end of the last view."""
STAND_BACK = 5
"""Priority below that of the nodes: no cell takes their processors, this one would."""
TICKS = os.sysconf("SC_CLK_TCK")
NODES = ("measurement_collector", "solver", "pose_sequencer")


def five_views(size: int) -> Plan:
    """Return Hu's grid views and two more: from the third on, each gives a map."""
    plan = hu_plan(Artifact(size, PITCH_M))
    first = plan.views[0]
    return replace(
        plan,
        views=(
            *plan.views,
            replace(first, name="rot180", rotation_rad=np.pi),
            replace(first, name="shift_y", translation_m=(0.0, PITCH_M)),
        ),
    )


def shift(hours: float, size: int) -> Recording:
    """Return a run of five views, a detection a second on average, with noise."""
    plan, rng = five_views(size), np.random.default_rng(size)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    measurements = simulate_measurements(truth, plan, rng)
    marks = sum(len(view.m) for view in measurements.views)
    repeats = max(1, round(3600 * hours / marks))
    plan = replace(
        plan, views=tuple(replace(view, repeats=repeats) for view in plan.views)
    )
    part = recording(
        plan,
        measurements,
        repeats=repeats,
        encoder_ns=ENCODER_NS,
        visit_ns=max(round(3600e9 * hours / marks), 50_000_000),
    )
    rng = np.random.default_rng(1)
    for axis in ("x", "y"):
        part.detections[axis] += rng.normal(0, SIGMA_M, len(part.detections[axis]))
    first, last = part.commands[0].stamp_ns, part.commands[-1].stamp_ns
    # between views as well
    return replace(part, stamps_ns=np.arange(first, last, ENCODER_NS))


def payloads(rows: np.ndarray) -> list[bytes]:
    """Return the CDR bytes in message records."""
    return [row.tobytes()[FRONT.itemsize :] for row in rows]


def batches(part: Recording) -> Iterator[tuple[object, list[tuple[str, bytes]]]]:
    """Yield all messages in the order of their stamps, a tenth of a second at a time.

    With each batch comes the command before which a view is over, or None.
    """
    marks = part.detections["stamp"]
    edges = [command.stamp_ns for command in part.commands] + [np.iinfo(np.int64).max]
    for command, end in zip(part.commands, edges[1:], strict=True):
        message = build(
            typestore(),
            "selfcal_msgs/msg/ViewCommand",
            from_model.command(command, "stage"),
        )
        yield (
            command,
            [
                (
                    "command",
                    bytes(
                        typestore().serialize_cdr(
                            message, "selfcal_msgs/msg/ViewCommand"
                        )
                    ),
                )
            ],
        )
        first, last = np.searchsorted(part.stamps_ns, (command.stamp_ns, end))
        for start in range(int(first), int(last), BATCH):
            stamps = part.stamps_ns[start : min(start + BATCH, last)]
            chosen = slice(
                *np.searchsorted(marks, (stamps[0], stamps[-1] + ENCODER_NS)).tolist()
            )
            found = [
                (int(t), "encoder", data)
                for t, data in zip(
                    stamps, payloads(encoder_rows(part, stamps, 1)), strict=True
                )
            ]
            found += [
                (int(t), "detection", data)
                for t, data in zip(
                    marks[chosen],
                    payloads(detection_rows(part, chosen, 2)),
                    strict=True,
                )
            ]
            yield None, [item[1:] for item in sorted(found, key=lambda item: item[0])]


class Cell:
    """Publishes what a cell would, and listens to what the nodes tell."""

    def __init__(self) -> None:
        rclpy.init()
        self.node, self.executor = Node("soak"), EventsExecutor()
        self.executor.add_node(self.node)
        self.publishers = {
            kind: self.node.create_publisher(topic.type, topic.name, topic.qos)
            for kind, topic in (
                ("encoder", names.ENCODER),
                ("command", names.COMMAND),
                ("detection", names.DETECTIONS),
            )
        }
        self.sent = dict.fromkeys(("encoder", "detection", "command"), 0)
        self.heard = (0, 0, 0)
        self.health: dict[str, str] = {}
        self.status_ms: list[float] = []
        self.worst_ms, self.worst_cpu_ms, self.warned = 0.0, 0.0, set()
        self.views_solved, self.has_map = 0, False
        self.heard_s = self.map_s = 0.0  # of the newest summary and map
        for topic, take in (
            (names.of_node(NODES[0], names.RECEIVED), self._on_received),
            (names.of_node(NODES[0], names.HEALTH), self._on_health),
            (names.SUMMARY, self._on_summary),
            (names.ERROR_MAP, self._on_map),
        ):
            self.node.create_subscription(topic.type, topic.name, take, topic.qos)

    def _on_received(self, message: object) -> None:
        self.heard = tuple(message.data)

    def _on_health(self, status: object) -> None:
        self.health = {item.key: item.value for item in status.values}
        if status.level != b"\0":
            self.warned.add(status.message)
        if float(self.health.get("status_ms", 0)) > 0:
            self.status_ms.append(float(self.health["status_ms"]))
            self.worst_ms = max(self.worst_ms, float(self.health["status_ms_max"]))
            self.worst_cpu_ms = max(
                self.worst_cpu_ms, float(self.health["status_cpu_ms_max"])
            )

    def _on_summary(self, message: object) -> None:
        if message.views_done > self.views_solved:
            self.heard_s = time.monotonic()
        self.views_solved, self.has_map = message.views_done, message.identifiable

    def _on_map(self, _: object) -> None:
        self.map_s = time.monotonic()

    def until(self, condition: Callable[[], bool], what: str) -> None:
        """Spin until `condition` holds."""
        end = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > end:
                raise SystemExit(f"soak: waited in vain for {what}")
            self.executor.spin_once(timeout_sec=0.002)

    @property
    def under_way(self) -> int:
        """Messages that the collector has not told as received."""
        return sum(self.sent.values()) - sum(self.heard)

    def publish(self, batch: list[tuple[str, bytes]]) -> None:
        """Publish a batch once the collector has kept up."""
        self.until(lambda: self.under_way < WINDOW, "the collector")
        for kind, data in batch:
            self.publishers[kind].publish(data)
            self.sent[kind] += 1

    def call(self, kind: type, name: str, **fields: object) -> object:
        """Call a service and return its answer."""
        client = self.node.create_client(kind, name)
        self.until(client.service_is_ready, name)
        future = client.call_async(kind.Request(**fields))
        self.until(future.done, f"the answer of {name}")
        return future.result()


def cpu_s(pid: int) -> float:
    """Return the CPU time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def peak_mb(pid: int) -> float:
    """Return the largest resident memory of a process."""
    [line] = (
        line
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("VmHWM")
    )
    return int(line.split()[1]) / 1024


def in_time(cell: Cell, stream: Iterator, seconds: float, pid: int) -> float:
    """Publish for some seconds in real time; return the collector's share of a core."""
    began, used = time.monotonic(), cpu_s(pid)
    while time.monotonic() < began + seconds:
        for _ in paced(cell, next(stream)[1]):
            pass
    return (cpu_s(pid) - used) / (time.monotonic() - began)


def paced(cell: Cell, batch: list[tuple[str, bytes]]) -> Iterator[str]:
    """Publish a batch in real time; yield the kind of each message once it is published."""
    began, step_s = time.monotonic(), BATCH * ENCODER_NS * 1e-9 / len(batch)
    for number, item in enumerate(batch):
        cell.publish([item])
        yield item[0]
        due = began + (number + 1) * step_s
        while time.monotonic() < due:
            cell.executor.spin_once(timeout_sec=max(due - time.monotonic(), 0))


def run_shift(
    cell: Cell, part: Recording, pid: int, realtime_s: float
) -> dict[str, object]:
    """Feed the shift; return what was measured on the way."""
    stream, last = (
        batches(part),
        [
            int(part.detections["stamp"].searchsorted(c.stamp_ns))
            for c in part.commands[2:]
        ],
    )
    ends = set(last)
    shares, latencies = [], []
    end_ns = part.detections["stamp"][max(last) - 1]
    late = int(
        part.stamps_ns.searchsorted(end_ns - round((realtime_s + MARGIN_S) * 1e9))
    )
    in_time_s, began = 0.0, time.monotonic()
    for command, batch in stream:
        closing = any(
            cell.sent["detection"] + number + 1 in ends
            for number in range(sum(kind == "detection" for kind, _ in batch))
        )
        if closing:
            latencies.append(closing_view(cell, batch, stream, ends))
        else:
            cell.publish(batch)
        if (
            command is not None
            and command.phase == Phase.MEASURE
            and command.view_index == 0
        ):
            shares.append(in_time(cell, stream, realtime_s, pid))
            began = time.monotonic()
        elif len(shares) == 1 and cell.sent["encoder"] >= late:
            shares.append(in_time(cell, stream, realtime_s, pid))
            in_time_s += realtime_s
    cell.until(lambda: cell.under_way <= 0, "the last messages")
    return {
        "shares": shares,
        "latencies": latencies,
        "seconds": time.monotonic() - began - in_time_s,
    }


def closing_view(
    cell: Cell, batch: list[tuple[str, bytes]], stream: Iterator, ends: set[int]
) -> tuple[bool, float]:
    """Publish the batch with the last reading of a view in real time, and what follows it.

    Return whether it gave a map, and the time from that reading to the map, or to the summary that
    says why there is none.
    """
    cell.until(lambda: cell.under_way <= 0, "all but the last reading")
    views, began = cell.views_solved, 0.0

    def solved() -> bool:
        return cell.views_solved > views and (not cell.has_map or cell.map_s > began)

    end = time.monotonic() + PATIENCE_S
    while batch:
        if time.monotonic() > end:
            raise SystemExit("soak: waited in vain for the solution of a view")
        for kind in paced(cell, batch):
            if not began and kind == "detection" and cell.sent["detection"] in ends:
                began = time.monotonic()
        _, batch = (None, []) if solved() else next(stream, (None, []))
    cell.until(solved, "the solution")
    return cell.has_map, (cell.map_s if cell.has_map else cell.heard_s) - began


def same_maps(live: Path, journal: Path) -> bool:
    """Return whether a saved map is, bit for bit, that of the journal.

    Stamps that run faster than the clock, and at last in real time, would look like steps of it.
    """
    out, params = FOLDER / "offline.json", FOLDER / "params.yaml"
    params.write_text(
        "measurement_collector: {ros__parameters: {clock_limit: 3600.0}}\n"
    )
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "selfcal_ros",
            "solve",
            str(journal),
            "--quiet",
            "--params",
            str(params),
            "--force",
            "-o",
            str(out),
        ],
        check=False,
    )
    if done.returncode not in (0, 5):
        raise SystemExit(
            f"soak: selfcal solve {journal} ends with code {done.returncode}"
        )
    return read_json(live)["error_map"] == read_json(out)["error_map"]


def soak(args: argparse.Namespace, environment: dict) -> int:
    """Run the nodes, feed them, print the figures; 1 if something was lost or differs."""
    part = shift(args.hours, args.size)
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    more = {
        "measurement_collector": [f"journal:={FOLDER}"],
        "solver": [f"result_folder:={FOLDER}"],
    }
    with contextlib.ExitStack() as stack:
        running = {
            node: stack.enter_context(
                process(
                    f"selfcal_ros.nodes.{node}",
                    [
                        "--ros-args",
                        "--log-level",
                        "error",
                        *(word for p in more.get(node, []) for word in ("-p", p)),
                    ],
                    environment,
                )
            )
            for node in NODES
        }
        os.nice(STAND_BACK)  # the nodes have been started: they are before the cell
        cell, pid = Cell(), running["measurement_collector"].pid
        for kind, readers in (("encoder", 1), ("detection", 1), ("command", 3)):
            cell.until(
                lambda kind=kind, readers=readers: (
                    cell.publishers[kind].get_subscription_count() >= readers
                ),
                f"subscribers of {kind}",
            )
        used = cpu_s(pid)
        found = run_shift(cell, part, pid, args.realtime)
        used = cpu_s(pid) - used
        finished = cell.call(Trigger, "measurement_collector/finish")
        saved = cell.call(SaveMap, "solver/save_map", path=str(FOLDER / "live.json"))
        lost = sum(cell.sent.values()) - sum(cell.heard)
        memory = {node: peak_mb(child.pid) for node, child in running.items()}
    if not (finished.success and saved.success):
        raise SystemExit(f"soak: {finished.message}; {saved.message}")
    [journal] = FOLDER.glob("journal_*")
    equal = same_maps(FOLDER / "live.json", journal)
    total = sum(cell.sent.values())
    size = sum(file.stat().st_size for file in journal.iterdir()) / 1e9
    print(
        f"hours {args.hours:g}  plate {args.size} x {args.size}  encoder {cell.sent['encoder']}  "
        f"detections {cell.sent['detection']}"
    )
    print(
        f"speed           {total / found['seconds'] / 1e3:.1f} k messages/s, lost {lost}"
    )
    print(
        "memory          "
        + ", ".join(f"{node} {mb:.0f} MB" for node, mb in memory.items())
    )
    print(
        f"status          median {statistics.median(cell.status_ms):.1f} ms, max "
        f"{cell.worst_ms:.1f} ms, {cell.worst_cpu_ms:.1f} ms of CPU"
    )
    print(
        "collector's CPU "
        + ", ".join(f"{100 * share:.1f} %" for share in found["shares"])
        + f" of a core in real time at 1 kHz (first view, last view; {args.realtime:g} s each), "
        f"{1e6 * used / total:.1f} us a message on average"
    )
    for has_map, what in ((True, "map"), (False, "summary of views that give none")):
        print(
            f"latency         last reading to published {what}, ms: "
            + ", ".join(
                f"{1e3 * latency:.0f}"
                for told, latency in found["latencies"]
                if told is has_map
            )
        )
    print(
        f"journal         {size:.2f} GB, lag {cell.health.get('journal_lag_s')} s, lost "
        f"{cell.health.get('journal_lost')}; its map is "
        + ("the live one, bit for bit" if equal else "ANOTHER than the live one")
    )
    for line in sorted(cell.warned):
        print(f"warned          {line}")
    return 0 if equal and not lost else 1


def main() -> int:
    """Read the arguments and run in a ROS domain of its own."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=1.0, help="length by the stamps")
    parser.add_argument(
        "--size", type=int, default=21, help="marks a side of the plate"
    )
    parser.add_argument(
        "--realtime", type=float, default=30.0, help="seconds in real time, s"
    )
    args = parser.parse_args()
    with domain() as environment:
        os.environ.update(environment)
        return soak(args, environment)


if __name__ == "__main__":
    sys.exit(main())
