# SPDX-License-Identifier: Apache-2.0
"""`selfcal batch` on several cores beside one after the other: seconds, CPU seconds, ratio.

bench_batch.py [--bags N] [--plan PLAN.yaml] [--workers N] [--rounds N] [--folder FOLDER]
               [-o FILE.json]

Simulates N bags of a plan (Hu's, 11 x 11 marks, 24 lines; 20 nm), solves them with `selfcal batch
--workers 1`, which is one process and one bag after the other, and with N workers, each as a
command of its own into an empty folder, in turn; tells means over the rounds and compares the
results. The modules are compiled, as where they are installed. Before and after, one process and
then N at once solve one bag over and over, with all loaded: what the cores themselves lose beside
each other.
"""

import argparse
import compileall
import contextlib
import ctypes
import json
import os
import resource
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np

from selfcal_ros.errors import InputError
from selfcal_ros.files import write_yaml
from selfcal_ros.outputs import write_json
from selfcal_ros.parallel import check_workers, mapped
from selfcal_ros.simulation.bag import write_simulation
from selfcal_ros.simulation.spec import read_simulation

ROOT = Path(__file__).parents[1]
PR_SET_CHILD_SUBREAPER = 36
"""Of prctl(2): processes whose parents have ended become ours, and their CPU time is counted."""


def simulate(folder: Path, plan: Path, seed: int) -> None:
    """Write one bag, unless it is there."""
    bag = folder / f"{seed:03}"
    if bag.exists():
        return
    sim = folder / f".{seed:03}.yaml"
    write_yaml(
        sim,
        {
            "plan": str(plan),
            "seed": seed,
            "noise": {"sigma_xy": 2e-8, "sigma_theta": 1.7e-5},
        },
    )
    write_simulation(read_simulation(sim), bag)


def timed(bags: Path, out: Path, workers: int) -> tuple[float, float]:
    """Return wall and CPU seconds of a batch into an empty folder."""
    shutil.rmtree(out, ignore_errors=True)
    known = children()
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "selfcal_ros",
            "batch",
            str(bags),
            "-o",
            str(out),
            "--workers",
            str(workers),
        ],
        stdout=subprocess.DEVNULL,
        check=False,
    )
    wall = time.perf_counter() - began
    for child in children() - known:  # what started the workers: its parent has ended
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    if done.returncode not in (0, 5):
        raise InputError(
            "selfcal batch", f"ended with exit code {done.returncode}", "see above"
        )
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


SOLVER = """
import sys, time
from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.settings.nodes import CollectorSettings
from selfcal_ros.estimation.api import calibrate
def solve():
    calibrate(collect_bag(sys.argv[1], CollectorSettings.checked({}, "bench")).measurements)
solve()
print(flush=True)
sys.stdin.readline()
number, end = 0, time.perf_counter() + float(sys.argv[2])
while time.perf_counter() < end:
    solve()
    number += 1
print(number, flush=True)
"""


def solved_in(bag: Path, processes: int, seconds: float = 4.0) -> float:
    """Return how often each of some processes at once solves a bag in `seconds`, on average."""
    running = [
        subprocess.Popen(
            [sys.executable, "-c", SOLVER, str(bag), str(seconds)],
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for _ in range(processes)
    ]
    for process in running:
        process.stdout.readline()  # it has loaded all
    for process in running:
        process.stdin.write("\n")
        process.stdin.flush()
    return sum(int(process.communicate()[0]) for process in running) / processes


def own_ratio(bag: Path, workers: int) -> float:
    """Return the ratio that the cores allow: wall time of all together to one after the other."""
    return solved_in(bag, 1) / solved_in(bag, workers) / workers


def children() -> set[int]:
    """Return the processes whose parent is this one."""
    task = Path(f"/proc/self/task/{os.getpid()}/children")
    return {int(pid) for pid in task.read_text().split()}


def maps_of(out: Path) -> dict[str, np.ndarray]:
    """Return the maps of a batch by the file name of their results."""
    return {
        path.name: np.array(json.loads(path.read_text())["error_map"]["gx"])
        for path in sorted((out / "results").iterdir())
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--bags", type=int, default=100)
    parser.add_argument("--plan", type=Path, default=ROOT / "config/plans/hu.yaml")
    parser.add_argument("--workers", type=int, help="processes (default: one per core)")
    parser.add_argument(
        "--rounds", type=int, default=1, help="times that both ways are run"
    )
    parser.add_argument("--folder", default=str(ROOT / "build" / "bench_batch"))
    parser.add_argument("-o", "--output", help="write the figures to this file")
    args = parser.parse_args()
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
    folder, workers = Path(args.folder), check_workers(args.workers)
    bags = folder / args.plan.stem
    bags.mkdir(parents=True, exist_ok=True)
    mapped(
        partial(simulate, bags, args.plan.resolve()),
        list(range(args.bags)),
        workers=workers,
    )
    own = [own_ratio(bags / "000", workers)]
    # not all programs may write bytecode
    compileall.compile_dir(ROOT / "selfcal_ros", quiet=1)
    times = [
        (*timed(bags, folder / "alone", 1), *timed(bags, folder / "together", workers))
        for _ in range(max(args.rounds, 1))
    ]
    alone, alone_cpu, together, together_cpu = np.mean(times, axis=0).tolist()
    own.append(own_ratio(bags / "000", workers))
    one, other = maps_of(folder / "alone"), maps_of(folder / "together")
    same = one.keys() == other.keys() and all(
        np.array_equal(one[k], other[k]) for k in one
    )
    figures = {
        "bags": args.bags,
        "plan": args.plan.stem,
        "workers": workers,
        "rounds": times,
        "seconds_alone": alone,
        "seconds_together": together,
        "ratio": together / alone,
        "cpu_s_alone": alone_cpu,
        "cpu_s_together": together_cpu,
        "own_ratio": own,
        "same_maps": same,
    }
    print(
        f"{args.bags} bags, one after the other: {alone:.1f} s ({alone_cpu:.1f} s of CPU)"
    )
    print(
        f"{args.bags} bags, {workers} workers: {together:.1f} s ({together_cpu:.1f} s of CPU)"
    )
    print(
        f"ratio {together / alone:.2f}; CPU shared by {workers}: "
        f"{together_cpu / workers / alone_cpu:.2f}; maps equal: {same}"
    )
    print(
        f"the cores by themselves, without starts and imports: {own[0]:.2f} before, "
        f"{own[1]:.2f} after"
    )
    if args.output:
        write_json(args.output, figures)
    return 0


if __name__ == "__main__":
    sys.exit(main())
