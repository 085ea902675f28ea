# SPDX-License-Identifier: Apache-2.0
"""Bench: the joint solver beside other solvers, reading beside other readers; one run, one table.

Same readings, same files. Every measurement is a process of its own with a limit of time and of
memory; what goes beyond is skipped and says so. Writes build/bench.json.

    python test/bench/run.py [--sizes 11,21] [--methods selfcal,"scipy lsmr"]
                             [--ingest MESSAGES] [--detections NUMBER] [--compensate SECONDS]
                             [--images NUMBER] [-o FILE]
"""

import argparse
import json
import os
import resource
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

import compensate  # noqa: E402
import detecting  # noqa: E402
import general  # noqa: E402
import ingest  # noqa: E402
import with_terms  # noqa: E402
from rivals import RIVALS, Rival, installed  # noqa: E402
from timing import median_time  # noqa: E402

from selfcal_ros.errors import InputError  # noqa: E402
from selfcal_ros.outputs import write_json  # noqa: E402

SIZES = (11, 21, 51, 101, 201, 401)
OURS = {
    "solve": "selfcal",
    "without noise": "selfcal",
    "re-solve": "selfcal (factored plan)",
    "uncertainty": "selfcal (uncertainty map)",
    "missing": "selfcal (3 % of the marks missing)",
    "five views": "selfcal (defaults but causes)",
    "terms": "selfcal (all terms)",
    "general": "selfcal (six general views)",
}
MAX_SIZE = {
    "re-solve": 201,
    "uncertainty": 401,
    "five views": 101,
    "terms": 101,
    "general": 101,
}
GENERAL = ("scipy lsmr", "scipy splu")
NOISE_M = 20e-9
MISSING = 0.03
TIME_LIMIT_S = 60.0
MEMORY_LIMIT_MB = 8000


def readings(size: int, missing: float = 0.0, noise_m: float = NOISE_M):
    """Return truth and readings of Hu's three grid views, 10 mm pitch."""
    import numpy as np

    from selfcal_ros.model.artifact import Artifact
    from test.support.truth import Spread, hu_plan, random_truth, simulate_measurements

    plan = hu_plan(Artifact(size, 0.01))
    rng = np.random.default_rng(size)
    # the papers' linear plate, which the rivals' equations know, too
    truth = random_truth(plan.artifact, len(plan.views), rng, Spread(rotation="linear"))
    return truth, simulate_measurements(
        truth, plan, rng, missing=missing, sigma_m=noise_m
    )


def error_of(field, truth) -> float:
    """Return the largest |G - truth| in m in the datum, over the sites that are known."""
    import numpy as np

    from selfcal_ros.estimation.lattice.connectivity import Gauge

    z = (truth.artifact.m + 1j * truth.artifact.n) / truth.artifact.half[0]
    known = np.isfinite(field).all(axis=0)
    gauge = Gauge(z, known, scale=True)
    left = field[0] - truth.g[0] + 1j * (field[1] - truth.g[1])
    left = np.where(known, left, 0.0)
    left = gauge.remove(left, gauge.coefficients(left))[known]
    return float(max(abs(left.real).max(), abs(left.imag).max()))


def ours(benchmark: str, data) -> tuple:
    """Return seconds and G of our own solver."""
    import numpy as np

    from selfcal_ros.estimation.api import calibrate
    from selfcal_ros.estimation.normal.equations import system_of
    from selfcal_ros.estimation.options import Options

    quick = Options(misalignment_model="linear", uncertainty=False, causes=False)

    def cold():
        system_of.cache_clear()
        return calibrate(data, quick).error_map

    if benchmark in ("solve", "without noise", "missing"):
        small = readings(5)[1]
        calibrate(small, quick)
        seconds, found = median_time(cold, once=False)
    elif benchmark == "re-solve":
        calibrate(data, quick)
        seconds, found = median_time(
            lambda: calibrate(data, quick).error_map, once=False
        )
    else:
        calibrate(data, quick)
        seconds, found = median_time(
            lambda: calibrate(data, replace(quick, uncertainty=True)).error_map,
            once=False,
        )
    return seconds, np.stack([found.gx, found.gy])


def worker(benchmark: str, method: str, size: int) -> dict:
    """Measure one method in this process."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_MB * 2**20,) * 2)
    if benchmark in ("five views", "terms", "general"):
        seconds, error = (
            general.solved(size, method)
            if benchmark == "general"
            else with_terms.solved(size, benchmark == "terms")
        )
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        return {
            "benchmark": benchmark,
            "method": method,
            "n": size,
            "seconds": seconds,
            "peak_mb": round(peak, 1),
            "max_error": error,
        }
    truth, data = readings(
        size,
        MISSING if benchmark == "missing" else 0.0,
        0.0 if benchmark == "without noise" else NOISE_M,
    )
    if method in OURS.values():
        seconds, field = ours(benchmark, data)
    else:
        seconds, field = median_time(Rival(method, data).solve, once=size > 11)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "benchmark": benchmark,
        "method": method,
        "n": size,
        "seconds": seconds,
        "peak_mb": round(peak, 1),
        "max_error": error_of(field, truth),
    }


def measure(benchmark: str, method: str, size: int) -> dict:
    """Run one worker in a process of its own; a row without figures says why."""
    row = {
        "benchmark": benchmark,
        "method": method,
        "n": size,
        "seconds": None,
        "peak_mb": None,
        "max_error": None,
    }
    if not installed(method):
        return {**row, "note": "not installed"}
    command = [sys.executable, __file__, "--worker", benchmark, method, str(size)]
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=TIME_LIMIT_S,
            cwd=ROOT,
            check=False,
            env={**os.environ},
        )
    except subprocess.TimeoutExpired:
        return {**row, "note": f"skipped: more than {TIME_LIMIT_S:.0f} s"}
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        if "MemoryError" in last or "llocate" in last or done.returncode < 0:
            return {
                **row,
                "note": f"skipped: more than {MEMORY_LIMIT_MB / 1000:.0f} GB",
            }
        return {**row, "note": f"failed: {last}"}
    return json.loads(done.stdout.splitlines()[-1])


def jobs(sizes: list[int], methods: list[str]):
    """Yield (benchmark, method, size); a rival that was skipped is not tried at larger sizes."""
    for size in sizes:
        for benchmark, method in OURS.items():
            if "selfcal" not in methods:
                continue
            if size <= MAX_SIZE.get(benchmark, size):
                yield benchmark, method, size
        for method in RIVALS:
            if method in methods:
                yield "solve", method, size
                yield "without noise", method, size
            if method in methods and method in GENERAL and size <= MAX_SIZE["general"]:
                yield "general", method, size


def measure_ingest(benchmark: str, number: int):
    """Yield a row for each way to read the bag of a benchmark."""
    bag, total = ingest.prepared(benchmark, number, ROOT / "build" / "ingest")
    for method in ingest.METHODS[benchmark]:
        row = {
            "benchmark": benchmark,
            "method": method,
            "n": total,
            "seconds": None,
            "peak_mb": None,
            "max_error": None,
        }
        if ingest.missing(method):
            yield {**row, "note": "not installed"}
            continue
        command = [
            sys.executable,
            __file__,
            "--ingest-worker",
            benchmark,
            method,
            str(bag),
        ]
        try:
            done = subprocess.run(
                command,
                capture_output=True,
                text=True,
                check=False,
                cwd=ROOT,
                timeout=ingest.MAX_SECONDS,
            )
        except subprocess.TimeoutExpired:
            yield {**row, "note": f"skipped: more than {ingest.MAX_SECONDS:.0f} s"}
            continue
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        yield (
            json.loads(done.stdout.splitlines()[-1])
            if not done.returncode
            else {**row, "note": f"failed: {last}"}
        )


def measure_compensation(seconds: float):
    """Yield a row for each compensator at each rate."""
    rows = [
        (rate, method) for rate in compensate.RATES for method in compensate.METHODS
    ]
    for rate, method in [*rows, (compensate.STRANGER_RATE, compensate.STRANGERS)]:
        if find_spec("rclpy") is None:
            yield {
                "benchmark": f"compensate {rate} Hz",
                "method": method,
                "n": round(rate * seconds),
                "seconds": None,
                "peak_mb": None,
                "max_error": None,
                "note": "not installed",
            }
        else:
            yield compensate.measured(method, rate, seconds)


def show(row: dict) -> None:
    """Print one line of the table."""
    if row["seconds"] is None:
        figures = f"{row['note']:>36}"
    else:
        error = "" if row["max_error"] is None else f"{row['max_error']:12.1e}"
        cpu = f"{row['cpu_seconds']:10.2f}" if "cpu_seconds" in row else ""
        figures = (
            f"{row['seconds']:12.6f} {row['peak_mb']:10.0f} {error:>12} {cpu}".rstrip()
        )
    print(
        f"{row['benchmark']:<17} {row['method']:<36} {row['n']:>7} {figures}",
        flush=True,
    )


def main() -> int:
    """Measure, print the table and write the JSON file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default=",".join(map(str, SIZES)))
    parser.add_argument("--methods", default=",".join(("selfcal", *RIVALS)))
    parser.add_argument("-o", "--output", default=str(ROOT / "build" / "bench.json"))
    parser.add_argument(
        "--ingest",
        type=int,
        default=3_600_000,
        help="encoder messages of the bag that is read; 0 = leave it out",
    )
    parser.add_argument(
        "--detections",
        type=int,
        default=3_200_000,
        help="detections of the other bag that is read; 0 = leave it out",
    )
    parser.add_argument(
        "--compensate",
        type=float,
        default=5.0,
        metavar="SECONDS",
        help="time for which each compensator gets samples; 0 = leave it out",
    )
    parser.add_argument(
        "--images",
        type=int,
        default=12,
        help="images in which marks are detected; 0 = leave it out",
    )
    parser.add_argument("--ingest-worker", nargs=3, help=argparse.SUPPRESS)
    parser.add_argument("--worker", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        print(json.dumps(worker(args.worker[0], args.worker[1], int(args.worker[2]))))
        return 0
    if args.ingest_worker:
        benchmark, method, bag = args.ingest_worker
        print(json.dumps(ingest.worker(benchmark, method, Path(bag))))
        return 0
    methods = args.methods.split(",")
    for method in methods:
        if method not in ("selfcal", *RIVALS):
            raise InputError("--methods", f"'{method}' is unknown", "see --help")
    print(
        f"{'benchmark':<17} {'method':<36} {'N':>7} {'seconds':>12} {'peak MB':>10} "
        f"{'max error m':>12} {'CPU s':>10}"
    )
    rows, given_up = [], set()
    sizes = [int(size) for size in args.sizes.split(",") if size]
    for benchmark, method, size in jobs(sizes, methods):
        if (benchmark, method) in given_up:
            rows.append(
                {
                    "benchmark": benchmark,
                    "method": method,
                    "n": size,
                    "seconds": None,
                    "peak_mb": None,
                    "max_error": None,
                    "note": "skipped: beyond its limit at a smaller N",
                }
            )
        else:
            rows.append(measure(benchmark, method, size))
            if "skipped" in rows[-1].get("note", ""):
                given_up.add((benchmark, method))
        show(rows[-1])
    for benchmark, number in (
        (ingest.ENCODER, args.ingest),
        (ingest.DETECTIONS, args.detections),
    ):
        for row in measure_ingest(benchmark, number) if number else ():
            rows.append(row)
            show(row)
    for row in measure_compensation(args.compensate) if args.compensate else ():
        rows.append(row)
        (show if row["seconds"] is None else compensate.show)(row)
    detected = chain(detecting.rows(args.images), detecting.rows_of_many())
    for row in detected if args.images else ():
        rows.append(row)
        (show if row["seconds"] is None else detecting.show)(row)
    Path(args.output).parent.mkdir(parents=True, exist_ok=True)
    write_json(args.output, rows)
    print(f"written to {args.output}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
