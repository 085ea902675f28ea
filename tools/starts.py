# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of a simulated cell together, again and again, beside busy processes.

Each start has a ROS domain of its own; it counts if the map of the whole plan is published.

    .venv/bin/python tools/starts.py --starts 20 --busy 2
"""

import argparse
import contextlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import yaml

from selfcal_ros.cli.processes import domain, process
from selfcal_ros.portable import ended_by_signals

ROOT = Path(__file__).parents[1]
NODES = ("measurement_collector", "solver", "pose_sequencer", "stage_simulator")
PATIENCE_S = 180.0
PLAN = {
    "plan_id": "starts",
    "artifact": {"grid_size": 5, "grid_pitch": 0.01, "angular_count": 8},
    "views": [
        {"name": "identity", "repeats": 2},
        {"name": "turned", "rotation_deg": 90, "repeats": 2},
        {"name": "line", "rotation_deg": 45, "grid": False, "repeats": 2},
        {"name": "shifted", "translation_pitch": [1, 0], "repeats": 2},
    ],
}
BUSY = "while True: sum(range(10000))"


def one_start(folder: Path) -> str:
    """Start all nodes at once; return "" if the whole plan comes through, else what was said."""
    plan, params = folder / "plan.yaml", ROOT / "config/params/simulated_cell.yaml"
    plan.write_text(yaml.safe_dump(PLAN))
    result = folder / "map.json"
    result.unlink(missing_ok=True)
    with domain() as environment, contextlib.ExitStack() as stack:
        nodes = []
        for name in NODES:
            words = {
                "pose_sequencer": ["-p", f"plan:={plan}"],
                "solver": ["-p", f"save_path:={result}"],
            }.get(name, [])
            log = stack.enter_context((folder / f"{name}.log").open("w"))
            nodes.append(
                stack.enter_context(
                    process(
                        f"selfcal_ros.nodes.{name}",
                        ["--ros-args", "--params-file", str(params), *words],
                        environment,
                        stdout=log,
                        stderr=log,
                    )
                )
            )
        done = _ends(folder / "pose_sequencer.log", result)
        for node in nodes:
            node.terminate()
        codes = [node.wait(timeout=60) for node in nodes]
    if done and not any(codes):
        return ""
    logs = "\n".join((folder / f"{name}.log").read_text()[-2000:] for name in NODES)
    return f"exit codes {codes}\n{logs}"


def _ends(log: Path, result: Path) -> bool:
    """Return whether the sequencer says DONE and there is a map before patience ends."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        said = log.read_text()
        if "DONE starts" in said and result.exists():
            return "is not complete in time" not in said
        time.sleep(0.2)
    return False


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--starts", type=int, default=20)
    parser.add_argument(
        "--busy", type=int, default=2, help="busy processes beside the nodes"
    )
    args = parser.parse_args()
    failed = 0
    with contextlib.ExitStack() as stack, ended_by_signals():
        for _ in range(args.busy):
            stack.callback(subprocess.Popen([sys.executable, "-c", BUSY]).kill)
        for number in range(1, args.starts + 1):
            began = time.monotonic()
            with tempfile.TemporaryDirectory() as folder:
                problem = one_start(Path(folder))
            failed += bool(problem)
            print(
                f"start {number}: {'failed' if problem else 'done'} in "
                f"{time.monotonic() - began:.0f} s; load {os.getloadavg()[0]:.1f}",
                flush=True,
            )
            if problem:
                print(problem, flush=True)
    print(f"{args.starts - failed} of {args.starts} starts came through")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
