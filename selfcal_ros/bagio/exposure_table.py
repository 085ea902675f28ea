# SPDX-License-Identifier: Apache-2.0
"""Tables of exposures as a bag: of image files with positions, or of readings."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import count, pairwise
from pathlib import Path

import numpy as np

from selfcal_ros.bagio.messages import from_model
from selfcal_ros.bagio.writer import BagWriter, new_bag
from selfcal_ros.collection.inputs import Command, Detection, EncoderSample, Kind, Phase
from selfcal_ros.errors import InputError, NoDataError, known_are
from selfcal_ros.files import csv_rows, read_bytes, read_text
from selfcal_ros.model.view import Plan
from selfcal_ros.plain_numbers import number_of, whole_number_of
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
READING_COLUMNS = ("view", "x", "y")
"""Columns of a table of readings: name of the view, indicated position, m."""
OF_READING = (
    "m",
    "n",
    "offset_x",
    "offset_y",
    "theta",
    "k",
    "offset_theta",
    "sigma",
)
"""Further columns of a table of readings, as in selfcal_msgs/MarkDetection (m, rad), and the
indicated angle; of a line k is given, of a mark it is empty."""
TIME = "time"
"""Column for the times of the exposures, if they are known: ISO 8601 with its zone."""
EARLIEST, LATEST = (
    datetime(1970, 1, 2, tzinfo=UTC),
    datetime(2038, 1, 18, tzinfo=UTC),
)
"""Times that a stamp can hold: seconds since 1970 in 32 bits, and commands are stamped earlier."""
LARGEST_ID = 2**31 - 1
"""Largest number of a mark or a line that a message holds."""
FARTHEST_M = 10.0
FAR = 30
"""Median distance of positions, over that of the plate's edge, which shows another unit than m."""
START_NS = 1_000 * NS_PER_S
"""Stamp of the first command if the times of the exposures are not known: no date."""
STEP_NS = NS_PER_S  # between two stamps of such a bag
BEFORE_NS = {Phase.PLACE: 40_000_000, Phase.MEASURE: 30_000_000}
"""Times of the commands before the first exposure of a view."""
BESIDE_NS = (-20_000_000, -10_000_000, 10_000_000, 20_000_000)
"""Stamps of encoder samples relative to an exposure: the stage rests."""


@dataclass(frozen=True)
class Position:
    """A row: place for messages, its cells, index of the view, position (m, rad), time if known."""

    where: str
    cells: Mapping[str, str]
    view: int
    x_m: float
    y_m: float
    theta_rad: float = 0.0
    stamp_ns: int | None = None

    @property
    def file(self) -> str:
        """The image file."""
        return self.cells["file"]


def read_positions(path: str | Path, plan: Plan | None) -> list[Position]:
    """Return the rows of a table of positions, by view, in the order of the table.

    Raises
    ------
    InputError
        For another heading, a view that the plan does not have, a file that comes twice, a
        position that is none, positions far from the plate of the plan, or times that do not
        increase.
    NoDataError
        If there are no rows.
    """
    rows = _rows(path, plan, COLUMNS)
    first: dict[str, str] = {}
    for row in rows:
        if first.setdefault(row.file, row.where) != row.where:
            raise InputError(
                row.where,
                f"{row.file} is in line {first[row.file].rpartition(':')[2]} as well",
                "give each image once; a repeated mark is another image",
            )
    return rows


def read_readings(path: str | Path, plan: Plan) -> list[Position]:
    """Return the rows of a table of readings, by view, in the order of the table.

    Raises
    ------
    InputError, NoDataError
        As `read_positions`, and for a column that is unknown, or a plan whose images show several
        marks.
    """
    if any(view.image for view in plan.views):
        raise InputError(
            str(path),
            "a table of readings has one mark in each exposure, the images of the plan more",
            "leave image out of the plan",
        )
    return _rows(path, plan, READING_COLUMNS, further=OF_READING)


def _rows(
    path: str | Path,
    plan: Plan | None,
    needed: Sequence[str],
    *,
    further: Sequence[str] | None = None,
) -> list[Position]:
    """Return the rows of a table, by view; `further`: the only other columns that it may have."""
    lines = csv_rows(read_text(path), str(path))
    heading = lines[0][1] if lines else []
    n_cells = len(heading)
    while heading and not heading[-1]:  # columns that a spreadsheet once had
        heading = heading[:-1]
    columns = [column for column in needed if plan or column != "view"]
    columns += [TIME] if TIME in heading else []
    _check_heading(heading, str(path), columns, further)
    if len(lines) == 1:
        raise NoDataError(
            str(path), "no row below the heading", "give one for each exposure"
        )
    names = [view.name for view in plan.views] if plan else [""]
    rows: list[Position] = []
    for where, texts in lines[1:]:
        if len(texts) != n_cells or any(texts[len(heading) :]):
            raise InputError(
                where,
                f"{len(texts)} cells, and the heading names {len(heading)}",
                "give each row a cell of each column",
            )
        cells = dict(zip(heading, texts, strict=False))
        if not all(cells.get(column) for column in columns):
            raise InputError(where, "an empty cell", f"give {', '.join(columns)}")
        view = cells["view"] if plan else ""
        if view not in names:
            raise InputError(
                where, f"the plan has no view '{view}'", known_are(view, names)
            )
        rows.append(
            Position(
                where=where,
                cells=cells,
                view=names.index(view),
                x_m=_metres(cells["x"], where),
                y_m=_metres(cells["y"], where),
                theta_rad=_number(cells, "theta", where) if further else 0.0,
                stamp_ns=_stamp_ns(cells[TIME], where) if TIME in heading else None,
            )
        )
    if plan:
        _check_unit(str(path), rows, plan)
    rows.sort(key=lambda row: row.view)
    for before, row in pairwise(rows):
        if (
            row.stamp_ns is not None
            and row.stamp_ns - (before.stamp_ns or 0) < STEP_NS / 10
        ):
            raise InputError(
                row.where,
                f"not exposed 0.1 s or more after line {before.where.rpartition(':')[2]}",
                "give the times in the order of the exposures, and the views of the "
                "plan in the order in which they were measured; or omit the column",
            )
    return rows


def _check_heading(
    heading: Sequence[str],
    path: str,
    columns: Sequence[str],
    further: Sequence[str] | None,
) -> None:
    """Refuse a heading that lacks a column, or has one that is unknown."""
    for column in columns:
        if column not in heading:
            raise InputError(
                path,
                f"no column '{column}'",
                f"begin with the line {','.join(columns)}",
            )
    if further is None:
        return
    if ("offset_x" in heading) != ("offset_y" in heading):
        raise InputError(
            path,
            "one of offset_x and offset_y without the other, which would count as 0",
            "give both, or neither where each mark was centred",
        )
    known_columns = list(dict.fromkeys([*columns, *further, TIME]))
    for column in heading:
        if not column:
            raise InputError(
                path, "a column without a name", "delete it with its cells, or name it"
            )
        if heading.count(column) > 1:
            raise InputError(path, f"two columns '{column}'", "leave one out")
        if column not in known_columns:
            raise InputError(
                path, f"no column is named '{column}'", known_are(column, known_columns)
            )


def _stamp_ns(text: str, where: str) -> int:
    """Return a time as ns since 1970."""
    with suppress(ValueError):
        if (date := datetime.fromisoformat(text)).tzinfo is not None:
            if not EARLIEST <= date <= LATEST:
                raise InputError(
                    where,
                    f"'{text}' is not between {EARLIEST.date()} and {LATEST.date()}, "
                    "as stamps of messages are",
                    "correct the year, or the clock of the camera; or omit the column",
                )
            return (
                (date - datetime(1970, 1, 1, tzinfo=UTC))
                // timedelta(microseconds=1)
                * 1000
            )
    raise InputError(
        where,
        f"'{text}' is not a time with its zone",
        "write it as 2026-11-21T09:30:00.25+01:00",
    )


def _check_unit(path: str, rows: list[Position], plan: Plan) -> None:
    """Refuse positions in another unit: most of them far from the plate in any of its views."""
    edge_m = plan.artifact.grid_pitch_m * math.hypot(*plan.artifact.reach) + max(
        math.hypot(*view.translation_m) for view in plan.views
    )
    typical_m = float(np.median([math.hypot(row.x_m, row.y_m) for row in rows]))
    if typical_m > FAR * edge_m:
        raise InputError(
            path,
            f"half of the positions are over {typical_m:.3g} m from the origin, "
            f"the marks of the plan within {edge_m:.3g} m",
            "give x and y in m",
        )


def _metres(text: str, where: str) -> float:
    try:
        value = number_of(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= FARTHEST_M:
        raise InputError(where, f"'{text}' is not a position", "give x and y in m")
    return value


def _number(cells: Mapping[str, str], column: str, where: str) -> float:
    """Return the number in a column that may be missing, or empty: 0."""
    text = cells.get(column) or "0"
    try:
        value = number_of(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise InputError(where, f"{column}: '{text}' is not a number", "give m and rad")
    return value


def _index(cells: Mapping[str, str], column: str, where: str) -> int | None:
    """Return the whole number in a column; None if it is missing, or empty."""
    text = cells.get(column)
    if not text:
        return None
    try:
        index = whole_number_of(text)
    except ValueError:
        index = LARGEST_ID + 1
    if not (0 if column == "k" else -LARGEST_ID) <= index <= LARGEST_ID:
        raise InputError(
            where,
            f"{column}: '{text}' is not an id",
            "give the whole number of the mark",
        )
    return index


def _reading(row: Position, stamp_ns: int) -> Detection:
    """Return the detection of a mark, with its id (m, n) or without, or of a line."""
    m, n, k = (_index(row.cells, column, row.where) for column in ("m", "n", "k"))
    if (m is None) != (n is None) or (m is not None and k is not None):
        raise InputError(
            row.where,
            "neither a mark nor a line",
            "give m and n of a mark, or neither, or k of a line",
        )
    if k is not None and "theta" not in row.cells:
        raise InputError(
            row.where, "a line without the indicated angle", "add a column theta"
        )
    of_kind = ("offset_x", "offset_y") if k is None else ("theta", "offset_theta")
    for column in of_kind:
        if row.cells.get(column) == "":
            raise InputError(
                row.where, f"{column} is empty", "leave the row out if nothing was read"
            )
    numbers = {
        column: _number(row.cells, column, row.where)
        for column in ("offset_x", "offset_y", "offset_theta", "sigma")
    }
    return Detection(
        stamp_ns=stamp_ns,
        kind=Kind.GRID if k is None else Kind.ANGULAR,
        has_id=m is not None or k is not None,
        m=m or 0,
        n=n or 0,
        k=k or 0,
        **numbers,
        score=1.0,
    )


def write_readings(
    rows: Sequence[Position], plan: Plan, output: str | Path, *, frame_id: str
) -> None:
    """Write a bag of the commands of a plan and the readings of a table.

    Parameters
    ----------
    rows : sequence of Position
        The exposures, one or more, by view.
    plan : Plan
        The plan.
    output : str or Path
        Bag folder to create.
    frame_id : str
        Frame of the detections.

    Raises
    ------
    InputError
        If a cell is none of its column, or a row is neither of a mark nor of a line.
    """
    _write(
        rows, plan, output, lambda row, stamp_ns: [_reading(row, stamp_ns)], frame_id
    )


def write_pictures(
    folder: Path,
    rows: Sequence[Position],
    plan: Plan,
    output: str | Path,
    *,
    detect: Callable[[bytes, str, int], Iterable[Detection]],
    check: Callable[[], None],
    frame_id: str,
) -> Counter[str]:
    """Write a bag of the commands of a plan, the positions and the detections in the images.

    Parameters
    ----------
    folder : Path
        Folder of the images.
    rows : sequence of Position
        The exposures, one or more, by view.
    plan : Plan
        The plan.
    output : str or Path
        Bag folder to create.
    detect : callable (content of an image file, its name, stamp in ns)
        Returns the detections; may raise InputError.
    check : callable
        Called before the bag is complete; what it raises leaves no bag.
    frame_id : str
        Frame of the detections.

    Returns
    -------
    Counter
        Problem -> number of images that were not used.

    Raises
    ------
    NoDataError
        If a file of the table is not in the folder.
    """
    _require_files(folder, rows)
    problems: Counter[str] = Counter()

    def detected(row: Position, stamp_ns: int) -> Iterable[Detection]:
        try:
            return detect(read_bytes(folder / row.file), row.file, stamp_ns)
        except InputError as error:
            problems[str(error)] += 1
            return ()

    _write(rows, plan, output, detected, frame_id, check)
    return problems


def _write(
    rows: Sequence[Position],
    plan: Plan,
    output: str | Path,
    detect: Callable[[Position, int], Iterable[Detection]],
    frame_id: str,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Write a bag of the commands, the positions, and the detections of each exposure."""
    first_ns = rows[0].stamp_ns
    run_id = str(START_NS if first_ns is None else first_ns - STEP_NS)
    with new_bag(output) as unfinished, BagWriter(unfinished) as writer:
        bag = _ExposureBag(writer, plan, frame_id, run_id)
        for row, commands, exposed_ns in _timed(rows):
            for phase, commanded_ns in commands.items():
                bag.command(phase, row.view, commanded_ns)
            bag.position(row, exposed_ns)
            bag.detections(detect(row, exposed_ns), exposed_ns)
        bag.command(Phase.DONE, len(plan.views), exposed_ns + STEP_NS)
        check()


def _require_files(folder: Path, rows: Sequence[Position]) -> None:
    """Raise NoDataError if images of the table are not in the folder."""
    missing = [row for row in rows if not (folder / row.file).is_file()]
    if not missing:
        return
    number = f" ({len(missing)} of {len(rows)} files are not)"
    raise NoDataError(
        missing[0].where,
        f"{missing[0].file} is not in {folder}{number if len(missing) > 1 else ''}",
        "correct the table, or name the folder of its images",
    )


def _timed(
    rows: Sequence[Position],
) -> Iterator[tuple[Position, dict[Phase, int], int]]:
    """Yield each exposure, the commands before it with their stamps, and its own stamp, ns."""
    clock = count(START_NS + STEP_NS, STEP_NS)
    view = -1
    for row in rows:
        phases = {} if row.view == view else BEFORE_NS
        view = row.view
        if row.stamp_ns is None:
            yield row, {phase: next(clock) for phase in phases}, next(clock)
        else:
            commands = {
                phase: row.stamp_ns - before_ns for phase, before_ns in phases.items()
            }
            yield row, commands, row.stamp_ns


class _ExposureBag:
    """Writes what a cell would have published during the exposures."""

    def __init__(
        self, writer: BagWriter, plan: Plan, frame_id: str, run_id: str
    ) -> None:
        """Announce the topics."""
        self._writer, self._plan = writer, plan
        self._frame_id, self._run_id = frame_id, run_id
        latched = qos_profile(reliable=True, transient_local=True, depth=64)
        volatile = qos_profile(reliable=True, transient_local=False, depth=5000)
        for topic, typename in INPUT_TOPICS.items():
            profile = latched if topic == COMMAND_TOPIC else volatile
            writer.add_topic(f"/{topic}", typename, [profile])

    def command(self, phase: Phase, view_index: int, stamp_ns: int) -> None:
        """Write a command of the plan."""
        plan = self._plan
        in_plan = view_index < len(plan.views)
        command = Command(
            stamp_ns=stamp_ns,
            phase=phase,
            plan_id=plan.plan_id,
            view_index=view_index,
            view=plan.views[view_index] if in_plan else None,
            artifact=plan.artifact if in_plan else None,
            views_planned=len(plan.views),
            run_id=self._run_id,
            model_terms=plan.model_terms,
        )
        message = from_model.command(command, self._frame_id)
        self._writer.write(f"/{COMMAND_TOPIC}", message, stamp_ns)

    def position(self, row: Position, stamp_ns: int) -> None:
        """Write the position of a stage at rest."""
        for step_ns in BESIDE_NS:
            sample = EncoderSample(
                stamp_ns + step_ns,
                ("x", "y", "theta"),
                (row.x_m, row.y_m, row.theta_rad),
            )
            message = from_model.joint_state(sample, self._frame_id)
            self._writer.write(f"/{ENCODER_TOPIC}", message, stamp_ns + step_ns)

    def detections(self, detections: Iterable[Detection], stamp_ns: int) -> None:
        """Write the detections in an image."""
        for detection in detections:
            message = from_model.detection(detection, self._frame_id)
            self._writer.write(f"/{DETECTION_TOPIC}", message, stamp_ns)
