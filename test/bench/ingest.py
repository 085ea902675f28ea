# SPDX-License-Identifier: Apache-2.0
"""How fast bags are read and solved: ours beside the libraries that go through the same file.

Two bags: an encoder at 1 kHz with a few thousand detections, and a plate of 401 x 401 marks with
repeats. Each method runs in a process of its own.
"""

import importlib.util
import json
import resource
import shutil
import subprocess
import sys
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from ingest_bags import Recording, recording, write_bag

from selfcal_ros.model.artifact import Artifact
from test.support.truth import Truth, hu_plan, random_truth, simulate_measurements

PITCH_M = 0.01
ENCODER_NS = 1_000_000
DETECTIONS = "ingest detections"
ENCODER = "ingest"
SOLVE, READ, SOLVE_ONLY = "selfcal solve", "selfcal (reading)", "selfcal (solving)"
MAX_SECONDS = 1200.0


def simulated(size: int, repeats: int) -> tuple:
    """Return plan, truth and readings without noise of Hu's three grid views."""
    plan = hu_plan(Artifact(size, PITCH_M))
    rng = np.random.default_rng(size)
    truth = random_truth(plan.artifact, len(plan.views), rng)
    return plan, truth, simulate_measurements(truth, plan, rng), repeats


def encoder_part(n_samples: int) -> tuple[Recording, Truth]:
    """Return an encoder at 1 kHz with `n_samples` and a detection a second or so."""
    plan, truth, measurements, repeats = simulated(21 if n_samples >= 200_000 else 5, 3)
    n_visits = sum(len(view.m) for view in measurements.views)
    visit_ns = n_samples * ENCODER_NS // n_visits
    return recording(
        plan, measurements, repeats=repeats, visit_ns=visit_ns, encoder_ns=ENCODER_NS
    ), truth


def detection_part(n_detections: int) -> tuple[Recording, Truth]:
    """Return a plate of 401 x 401 marks (21 x 21 for small numbers), each read several times."""
    size = 401 if n_detections >= 10**6 else 21 if n_detections >= 3000 else 5
    plan, truth, measurements, _ = simulated(size, 1)
    repeats = max(
        1, round(n_detections / sum(len(view.m) for view in measurements.views))
    )
    return recording(
        plan, measurements, repeats=repeats, visit_ns=50_000_000, encoder_ns=0
    ), truth


class Taken(NamedTuple):
    """What something took: beside other programs only the processor time says how much it is."""

    wall_s: float
    cpu_s: float


PARTS: dict[str, Callable[[int], tuple[Recording, Truth]]] = {
    ENCODER: encoder_part,
    DETECTIONS: detection_part,
}


MESSAGES = Path(__file__).parents[2] / "msg_defs" / "msg"
"""Definitions of the messages: a bag of older ones is not read by today's."""


def prepared(benchmark: str, number: int, folder: Path) -> tuple[Path, int]:
    """Return the bag of a benchmark and its messages; it is written if it is not there."""
    messages = b"".join(path.read_bytes() for path in sorted(MESSAGES.glob("*.msg")))
    bag = folder / f"{benchmark.replace(' ', '_')}_{number}_{zlib.crc32(messages):08x}"
    done = bag / "done.json"
    if not done.exists():
        shutil.rmtree(bag, ignore_errors=True)
        part, truth = PARTS[benchmark](number)
        total = write_bag(bag, part)
        np.save(bag / "truth.npy", truth.g)
        done.write_text(json.dumps(total))
    return bag, json.loads(done.read_text())


def by_rosbags(bag: Path) -> int:
    """Decode every message with rosbags."""
    from rosbags.rosbag2 import Reader

    from selfcal_ros.bagio.schemas import typestore

    count, store = 0, typestore()
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            store.deserialize_cdr(data, connection.msgtype)
            count += 1
    return count


def by_mcap(bag: Path) -> int:
    """Go through the messages with the mcap library, without decoding them."""
    from mcap.reader import make_reader

    with next(bag.glob("*.mcap")).open("rb") as file:
        return sum(1 for _ in make_reader(file).iter_messages(log_time_order=False))


def by_mcap_ros2(bag: Path) -> int:
    """Decode every message with mcap-ros2-support."""
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with next(bag.glob("*.mcap")).open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        return sum(1 for _ in reader.iter_decoded_messages(log_time_order=False))


def by_pybag(bag: Path) -> int:
    """Decode every message with pybag-sdk."""
    from pybag.mcap_reader import McapFileReader

    with McapFileReader.from_file(next(bag.glob("*.mcap"))) as reader:
        return sum(
            1
            for _ in reader.messages(list(reader.get_topics()), in_log_time_order=False)
        )


def by_us(bag: Path) -> int:
    """Decode every message into columns, without keeping them."""
    from selfcal_ros.bagio.reader import BagReader

    return sum(
        1 if topic.endswith("command") else len(item)
        for topic, item in BagReader(bag).columns()
    )


PEERS: dict[str, tuple[str, Callable[[Path], int]]] = {
    "rosbags": ("rosbags", by_rosbags),
    "mcap (not decoded)": ("mcap", by_mcap),
    "mcap-ros2-support": ("mcap_ros2", by_mcap_ros2),
    "pybag-sdk": ("pybag", by_pybag),
    "selfcal (columns)": ("selfcal_ros", by_us),
}
METHODS = {ENCODER: (SOLVE, *PEERS), DETECTIONS: (READ, SOLVE_ONLY)}


def missing(method: str) -> bool:
    """Return whether the package of a method cannot be imported."""
    return method in PEERS and importlib.util.find_spec(PEERS[method][0]) is None


def worker(benchmark: str, method: str, bag: Path) -> dict:
    """Measure one method in this process."""
    total = json.loads((bag / "done.json").read_text())
    error, who = None, resource.RUSAGE_SELF
    if method == SOLVE:
        who, out = resource.RUSAGE_CHILDREN, bag.with_name(f"{bag.name}_result.json")
        taken, _ = timed(
            lambda: subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "selfcal_ros",
                    "solve",
                    str(bag),
                    "--quiet",
                    "--force",
                    "-o",
                    str(out),
                ],
                check=True,
            )
        )
        error = error_of(json.loads(out.read_text())["error_map"], bag)
    elif method in (READ, SOLVE_ONLY):
        taken, error = in_parts(bag, method)
    else:
        taken, count = timed(lambda: PEERS[method][1](bag))
        if count != total:
            raise RuntimeError(f"{method} met {count} of {total} messages")
    return {
        "benchmark": benchmark,
        "method": method,
        "n": total,
        "seconds": taken.wall_s,
        "peak_mb": round(resource.getrusage(who).ru_maxrss / 1024, 1),
        "max_error": error,
        "cpu_seconds": taken.cpu_s,
    }


def in_parts(bag: Path, method: str) -> tuple[Taken, float | None]:
    """Return the time of reading or of solving, and the error of the map that comes out."""
    from selfcal_ros.bagio.offline import collect_bag
    from selfcal_ros.estimation.api import Options, calibrate
    from selfcal_ros.settings.nodes import CollectorSettings

    values = CollectorSettings.checked({}, "bench")
    reading, (measurements, _, lost, _) = timed(lambda: collect_bag(bag, values))
    assert not lost and not measurements.all_rejected()
    if method == READ:
        return reading, None
    # what is loaded once is not counted
    calibrate(simulated(5, 1)[2], Options(uncertainty=False))
    solving, result = timed(lambda: calibrate(measurements, Options(uncertainty=False)))
    return solving, error_of(
        {"gx": result.error_map.gx, "gy": result.error_map.gy}, bag
    )


def timed(run: Callable) -> tuple[Taken, object]:
    """Return the time that `run` takes and what it gives."""
    began, cpu = time.perf_counter(), cpu_seconds()
    result = run()
    return Taken(time.perf_counter() - began, cpu_seconds() - cpu), result


def cpu_seconds() -> float:
    """Return the processor time of this process and of those it waited for, kernel included."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(
            resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
        )
    )


def error_of(found: dict, bag: Path) -> float:
    """Return the largest difference of a map from the truth beside the bag, m."""
    truth = np.load(bag / "truth.npy")
    return float(
        np.abs(
            np.stack(
                [np.array(found["gx"], dtype=float), np.array(found["gy"], dtype=float)]
            )
            - truth
        ).max()
    )
