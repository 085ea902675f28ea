# SPDX-License-Identifier: Apache-2.0
"""Bench: a live collector through a long shift: cost of a status, memory, and the same readings.

A stage visits the marks of a plate, a detection each period; the encoder sends all the time. The
collector gets it in blocks of a tenth of a second, as a node does, and is asked for a status after
every block of `--status` seconds. Stamps run as fast as the machine allows.

    python test/bench/collecting.py [--hours 8] [--rate 1000] [--views 4]
"""

import argparse
import hashlib
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))

from selfcal_ros.collection.collector import Collector
from selfcal_ros.collection.inputs import DETECTION, Command, EncoderBlock, Kind, Phase
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.readings import readings_digest
from selfcal_ros.model.view import View
from selfcal_ros.settings.nodes import CollectorSettings

SIZE, PITCH_M = 21, 0.01
START_NS, S = 1_700_000_000_000_000_000, 1_000_000_000
JOINTS = ("x", "y", "theta")


def site(number: int) -> np.ndarray:
    """Return where the stage stands at the exposure of a number: raster over the plate, m."""
    m, n = divmod(number % SIZE**2, SIZE)
    n = n if m % 2 == 0 else SIZE - 1 - n
    return (np.array([m, n]) - SIZE // 2) * PITCH_M


def positions(
    since_s: np.ndarray, period_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Return indicated positions (n, 3): at rest in the middle of each period, moving between."""
    number, part = np.divmod(since_s, period_s)
    part = np.clip((part / period_s - 0.7) / 0.3, 0, 1)[:, None]
    known = np.array([site(k) for k in range(int(number[0]), int(number[-1]) + 2)])
    at = (number - number[0]).astype(int)
    xy = known[at] + part * (known[at + 1] - known[at])
    return np.column_stack([xy, np.zeros(len(xy))]) + rng.normal(0, 5e-9, (len(xy), 3))


def detections(
    since_s: np.ndarray, period_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Return the detections of some exposures, in the middle of the time at rest."""
    table = np.zeros(len(since_s), dtype=DETECTION)
    table["stamp"] = START_NS + np.rint((since_s) * S).astype(np.int64)
    marks = np.array([np.rint(site(int(t // period_s)) / PITCH_M) for t in since_s])
    table["m"], table["n"] = marks.astype(int).reshape(-1, 2).T
    table["kind"], table["has_id"], table["score"] = Kind.GRID, True, 0.9
    table["offset_x"], table["offset_y"] = rng.normal(0, 2e-8, (2, len(table)))
    return table


def run(args: argparse.Namespace) -> dict[str, float]:
    """Feed the shift and return the figures."""
    rng = np.random.default_rng(1)
    collector = Collector(CollectorSettings.checked({}, "bench"))
    plate, total = Artifact(SIZE, PITCH_M), round(args.hours * 3600)
    per_view = total // args.views
    costs, cpus, busy, blocks = [], [], 0.0, round(1 / 0.1)
    step = 1 / args.rate
    for second in range(total):
        if second % per_view == 0 and second // per_view < args.views:
            index = second // per_view
            view = View(f"v{index}", 0.0, (0.0, 0.0), angular=False, repeats=10_000)
            for phase, before in ((Phase.PLACE, 2), (Phase.MEASURE, 1)):
                collector.add_command(
                    Command(
                        START_NS + second * S - before,
                        phase,
                        "bench",
                        index,
                        view,
                        plate,
                        args.views,
                        "1",
                    )
                )
        begun = time.process_time()
        for tenth in range(blocks):
            since = (
                second + tenth / blocks + np.arange(round(args.rate / blocks)) * step
            )
            where = positions(since, args.period, rng)
            stamps = START_NS + np.rint(since * S).astype(np.int64)
            collector.add_encoder_block(EncoderBlock(stamps, JOINTS, where, None))
        exposed = np.arange(second, second + 1, args.period) + 0.35 * args.period
        collector.add_detection_block(detections(exposed, args.period, rng))
        busy += time.process_time() - begun
        if second % args.status == args.status - 1 or second == total - 1:
            begun, cpu = time.perf_counter(), time.process_time()
            measurements, progress = collector.collect()
            for item in progress.values():
                readings_digest(item.readings, measurements.rejected)
                item.missing  # noqa: B018 (a status names them)
            costs.append(time.perf_counter() - begun)
            cpus.append(time.process_time() - cpu)
    digest = hashlib.sha256(
        "".join(
            readings_digest(item.readings, measurements.rejected)
            for item in progress.values()
        ).encode()
    ).hexdigest()
    used = sum(view.used for view in measurements.views)
    return {
        "hours": args.hours,
        "rate": args.rate,
        "samples": collector.received["encoder"],
        "detections": collector.received["detection"],
        "used": used,
        "status_median_ms": 1e3 * float(np.median(costs)),
        "status_p99_ms": 1e3 * float(np.quantile(costs, 0.99)),
        "status_max_ms": 1e3 * max(costs),
        "status_cpu_median_ms": 1e3 * float(np.median(cpus)),
        "status_cpu_max_ms": 1e3 * max(cpus),
        "feeding_cpu_s": busy,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "digest": digest[:16],
    }


def main() -> None:
    """Print one line a figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--hours", type=float, default=8.0)
    parser.add_argument(
        "--rate", type=float, default=1000.0, help="encoder samples a second"
    )
    parser.add_argument(
        "--period", type=float, default=1.0, help="seconds between detections"
    )
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument(
        "--status", type=int, default=1, help="seconds between two statuses"
    )
    for name, value in run(parser.parse_args()).items():
        print(
            f"{name:18} {value:.4g}"
            if isinstance(value, float)
            else f"{name:18} {value}"
        )


if __name__ == "__main__":
    main()
