# SPDX-License-Identifier: Apache-2.0
"""`selfcal measure` killed with SIGKILL at given points of its run, and resumed.

The plate stays where it lay, as in a power cut; the process begins anew.
"""

import contextlib
import json
import multiprocessing
import os
import random
import signal
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from selfcal_ros.bagio.reader import BagReader
from selfcal_ros.topics import DETECTION_TOPIC
from test.support.cells import PLAN, SIMULATION

PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(
    ["selfcal_ros.cli.measure", "selfcal_ros.machine.simulated"]
)
CELL = """
machine: surviving_stage:SurvivingStage
SurvivingStage: {}
limits: {x: [-0.01, 0.01], y: [-0.01, 0.01], theta: [-7, 7]}
placing: robot
"""
STAGE = """
import json
import os
from pathlib import Path

from selfcal_ros.collection.inputs import Command, Phase
from selfcal_ros.machine.simulated import SimulatedMachine


class SurvivingStage(SimulatedMachine):
    '''Its plate lies as it did when the process was killed.'''

    def __init__(self, folder):
        super().__init__("sim.yaml", folder)
        self._note = Path(folder, "lies.json")
        if self._note.exists():
            index = json.loads(self._note.read_text())
            self._lay(Command(0, Phase.PLACE, self._plan.plan_id, index, self._plan.views[index],
                              self._plan.artifact, len(self._plan.views)))

    def place(self, placing):
        super().place(placing)
        half = self._note.with_suffix(".half")
        half.write_text(json.dumps(placing.command.view_index))
        os.replace(half, self._note)
"""
POINTS = (
    "in a move",
    "between two moves",
    "in an exposure",
    "half of a message written",
    "before a file is on the disk",
    "before a file has its name",
)


class Cut(NamedTuple):
    """Where a run is killed: at the `number`-th passage of a point, from 1."""

    point: str
    number: int


class Ended(NamedTuple):
    """How a run has ended, and what it said."""

    returncode: int
    stderr: str


def prepare(folder: Path, marks: int = 5) -> None:
    """Write the plan of so many marks a side, machine and simulation into a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("plan.yaml", PLAN.replace("grid_size: 3", f"grid_size: {marks}")),
        ("sim.yaml", SIMULATION),
        ("cell.yaml", CELL),
        ("surviving_stage.py", STAGE),
    ):
        (folder / name).write_text(text)


def measured(folder: Path, cut: Cut | None = None) -> Ended:
    """Run ``selfcal measure`` in a process of its own, killed at a cut.

    An interrupted run is resumed.
    """
    process = PROCESSES.Process(target=main, args=(folder, cut))
    process.start()
    process.join()
    return Ended(process.exitcode, Path(folder, "said.txt").read_text())


def passages(folder: Path) -> dict[str, int]:
    """Return how often an undisturbed run passed each point."""
    return json.loads((folder / "passages.json").read_text())


def cuts(count: int, seed: int, passed: dict[str, int]) -> Iterator[Cut]:
    """Yield seeded cuts, each point in turn."""
    draw = random.Random(seed)
    for number in range(count):
        point = POINTS[number % len(POINTS)]
        yield Cut(point, draw.randint(1, passed[point]))


def detections(folder: Path) -> list[bytes]:
    """Return all detections of the bag of a run, in a form that can be compared."""
    bag = folder / "bag"
    if not any(bag.glob("*.mcap")):
        return []
    return [
        row.tobytes()
        for topic, item in BagReader(bag).columns()
        if topic.strip("/") == DETECTION_TOPIC
        for row in item
    ]


class Outcome(NamedTuple):
    """What a run that was killed and resumed has come to."""

    lost: int
    """Detections that were in the bag after the kill and are not in it at the end."""
    doubled: int
    away: float
    """Largest difference of its map from that of the undisturbed run, over u of the difference."""
    away_m: float
    qualified: bool


def outcome(folder: Path, whole: Path, before: list[bytes]) -> Outcome:
    """Compare the map of a resumed run with that of an undisturbed one."""
    after = Counter(detections(folder))
    result, other = (
        json.loads((each / "bag.json").read_text()) for each in (folder, whole)
    )
    away, u = [], []
    for axis in ("gx", "gy"):
        away.append(np.subtract(result["error_map"][axis], other["error_map"][axis]))
        u.append(
            np.hypot(result["error_map"][f"u_{axis}"], other["error_map"][f"u_{axis}"])
        )
    distance = np.abs(np.array(away))
    return Outcome(
        (Counter(before) - after).total(),
        sum(n - 1 for n in after.values()),
        float((distance / np.array(u)).max()),
        float(distance.max()),
        bool(result["verdict"]["qualified"]),
    )


def main(folder: Path, cut: Cut | None) -> None:
    """Run ``selfcal measure`` here; kill this process at a cut, or count all passages."""
    from selfcal_ros.cli.main import main as selfcal
    from selfcal_ros.machine.simulated import SimulatedMachine

    passed: Counter[str] = Counter()

    def is_due(here: str) -> bool:
        passed[here] += 1
        return cut == (here, passed[here])

    def kill() -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def cut_before(owner: object, name: str, here: str) -> None:
        """Let a method kill this process before it acts."""
        function = getattr(owner, name)

        def acting(*args):
            if is_due(here):
                kill()
            return function(*args)

        setattr(owner, name, acting)

    write = os.write

    def writing(descriptor, data):
        if is_due("half of a message written"):
            write(descriptor, data[: len(data) // 2])
            kill()
        return write(descriptor, data)

    os.write = writing
    cut_before(SimulatedMachine, "move_to", "in a move")
    cut_before(SimulatedMachine, "position", "between two moves")
    cut_before(SimulatedMachine, "offsets", "in an exposure")
    cut_before(os, "fsync", "before a file is on the disk")
    cut_before(Path, "replace", "before a file has its name")
    with (
        contextlib.chdir(folder),
        Path("said.txt").open("w") as said,
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        resume = ["--resume"] if Path("bag").exists() else []
        code = selfcal(
            ["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", *resume]
        )
        Path("passages.json").write_text(json.dumps(passed))
    raise SystemExit(code)
