# SPDX-License-Identifier: Apache-2.0
"""A folder of image files and a table of stage positions, as the bag of a cell."""

import math
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Phase
from selfcal_ros.errors import InputError, known_are
from selfcal_ros.files import csv_cells, read_bytes, read_text
from selfcal_ros.messages import from_model
from selfcal_ros.model.view import Plan
from selfcal_ros.topics import (
    COMMAND_TOPIC,
    DETECTION_TOPIC,
    ENCODER_TOPIC,
    INPUT_TOPICS,
    qos_profile,
)
from selfcal_ros.units import NS_PER_S

COLUMNS = ("file", "view", "x", "y")
"""Columns of a table of positions: image file, name of the view, indicated position, m. Without a
plan the view is not needed."""
FARTHEST_M = 10.0
START_NS = 1_700_000_000 * NS_PER_S
"""Stamp of the first command: the times of the exposures are not known."""
STEP_NS = NS_PER_S
"""Time between two stamps of such a bag."""
BESIDE_NS = (-20_000_000, -10_000_000, 10_000_000, 20_000_000)
"""Stamps of encoder samples relative to an exposure: the stage rests."""


@dataclass(frozen=True)
class Position:
    """A row of the table: place for messages, image file, index of the view, position in m."""

    where: str
    file: str
    view: int
    x_m: float
    y_m: float


def read_positions(path: str | Path, plan: Plan | None) -> list[Position]:
    """Return the rows of a table of positions, by view, in the order of the table.

    Raises
    ------
    InputError
        For another heading, a view that the plan does not have, or a position that is none.
    """
    lines = [(f"{path}:{number}", line) for number, line in enumerate(
        read_text(path).splitlines(), 1) if line.strip() and not line.startswith("#")]
    heading = csv_cells(lines[0][1], lines[0][0]) if lines else []
    columns = COLUMNS if plan else [column for column in COLUMNS if column != "view"]
    for column in columns:
        if column not in heading:
            raise InputError(str(path), f"no column '{column}'",
                             f"begin with the line {','.join(columns)}")
    names = [view.name for view in plan.views] if plan else [""]
    rows = []
    for where, line in lines[1:]:
        cells = dict(zip(heading, csv_cells(line, where), strict=False))
        if not all(cells.get(column) for column in columns):
            raise InputError(where, "an empty cell", f"give {', '.join(columns)}")
        view = cells["view"] if plan else ""
        if view not in names:
            raise InputError(where, f"the plan has no view '{view}'", known_are(view, names))
        rows.append(Position(where, cells["file"], names.index(view),
                             _metres(cells["x"], where), _metres(cells["y"], where)))
    return sorted(rows, key=lambda row: row.view)


def _metres(text: str, where: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= FARTHEST_M:
        raise InputError(where, f"'{text}' is no position", "give x and y in m")
    return value


def write_pictures(folder: Path, rows: Iterable[Position], plan: Plan, output: str | Path, *,
                   detect: Callable[[bytes, str, int], Iterable[Detection]],
                   frame_id: str) -> Counter[str]:
    """Write a bag of the commands of a plan, the positions and the detections in the images.

    Parameters
    ----------
    folder : Path
        Folder of the images.
    rows : iterable of Position
        The exposures, by view.
    plan : Plan
        The plan.
    output : str or Path
        Bag folder to create.
    detect : callable (content of an image file, its name, stamp in ns)
        Returns the detections; may raise InputError.
    frame_id : str
        Frame of the detections.

    Returns
    -------
    Counter
        Problem -> number of images that were not used.
    """
    problems: Counter[str] = Counter()
    latched = qos_profile(reliable=True, transient_local=True, depth=64)
    volatile = qos_profile(reliable=True, transient_local=False, depth=5000)
    now, view = START_NS, -1

    def command(phase: Phase, index: int) -> None:
        known = plan.views[index] if index < len(plan.views) else None
        writer.write(f"/{COMMAND_TOPIC}", from_model.command(Command(
            now, phase, plan.plan_id, index, known, plan.artifact if known else None,
            len(plan.views), run_id=str(START_NS), model_terms=plan.model_terms), frame_id), now)

    with new_bag(output) as beside, BagWriter(beside) as writer:
        for topic, typename in INPUT_TOPICS.items():
            writer.add_topic(f"/{topic}", typename, [
                latched if topic == COMMAND_TOPIC else volatile])
        for row in rows:
            if row.view != view:
                view = row.view
                for phase in (Phase.PLACE, Phase.MEASURE):
                    command(phase, view)
                    now += STEP_NS
            for step in BESIDE_NS:
                sample = EncoderSample(now + step, ("x", "y", "theta"), (row.x_m, row.y_m, 0.0))
                writer.write(f"/{ENCODER_TOPIC}", from_model.joint_state(sample, frame_id),
                             now + step)
            try:
                found = detect(read_bytes(folder / row.file), row.file, now)
            except InputError as error:
                problems[str(error)] += 1
                found = ()
            for detection in found:
                writer.write(f"/{DETECTION_TOPIC}", from_model.detection(detection, frame_id), now)
            now += STEP_NS
        command(Phase.DONE, len(plan.views))
    return problems
