# SPDX-License-Identifier: Apache-2.0
"""One terminal screen of a calibration, drawn from the picture of the monitor process.

It fits any size of the terminal: omissions are stated, and pictures of the plate and the map
become coarser.
"""

import re
from collections.abc import Callable, Sequence
from math import ceil
from typing import Any

from rich.console import Console, Group, RenderableType
from rich.text import Text

from selfcal_ros.errors import printable, some_of

_CONSOLE = Console(width=500, legacy_windows=False)
"""Used for the width of characters; nothing is printed on it."""
KEYS = {"s": "start", "c": "confirm", "r": "redo", "k": "skip", "a": "abort"}
SHADES = " .:-=+*#%@"
LEVELS = {0: ("ok", "green"), 1: ("warn", "yellow"), 2: ("error", "red")}
LEAST = (60, 18)
"""Columns and rows below which only the current task is shown."""
BETWEEN = 3
"""Columns between the two halves of the screen."""
PREFIX = re.compile(r"^\[(\w+)\] \[[\d.]+\] \[([^\]]+)\]: ")
"""Prefix of a node's log lines."""


def wrapped(texts: Sequence[Text], width: int) -> list[Text]:
    """Return texts as rows of at most `width` columns."""
    return [
        row for text in texts for row in text.wrap(_CONSOLE, width, overflow="fold")
    ]


def fitted(rows: list[Text], most: int) -> list[Text]:
    """Return at most `most` rows; the last one states how many were omitted."""
    if len(rows) <= most:
        return rows
    n_omitted = len(rows) - max(most - 1, 0)
    omission = Text(f"... {n_omitted} more row{'s' * (n_omitted > 1)}", style="dim")
    return [*rows[: max(most - 1, 0)], omission][:most]


def last_fitted(texts: Sequence[Text], width: int, most: int) -> list[Text]:
    """Return the last texts that fit into `most` rows; the beginning of one that does not."""
    rows: list[Text] = []
    for text in reversed(texts):
        lines = wrapped([text], width)
        if len(rows) + len(lines) > most:
            return rows or fitted(lines, most)
        rows = lines + rows
    return rows


def headed(title: str, rows: list[Text], width: int) -> list[Text]:
    """Return rows below a title line."""
    head = Text(f"── {title} ", style="bold", no_wrap=True)
    head.truncate(width, overflow="ellipsis")
    head.append("─" * (width - head.cell_len))
    return [head, *rows]


def coarser[T](
    cells: Sequence[Sequence[T]], width: int, height: int, worst: Callable[[list[T]], T]
) -> tuple[list[list[T]], int]:
    """Return cells coarsened to fit, blank-separated, and the factor per side.

    Parameters
    ----------
    cells : sequence of sequences
        Rows of equal length.
    width, height : int
        Columns and rows of room, at least 1.
    worst : callable
        Returns the cell that represents a group of cells.
    """
    across = max(map(len, cells), default=0)
    step = max(1, ceil(len(cells) / height), ceil(across / ((width + 1) // 2)))
    return [
        [
            worst(
                [
                    cell
                    for row in cells[top : top + step]
                    for cell in row[left : left + step]
                ]
            )
            for left in range(0, across, step)
        ]
        for top in range(0, len(cells), step)
    ], step


def screen(
    picture: dict[str, Any], log: list[str], size: tuple[int, int] = (80, 24)
) -> RenderableType:
    """Return the screen of a picture and the last lines of the log, for (columns, rows)."""
    width, height = size
    keys = Text(
        "  ".join(f"[{key}] {word}" for key, word in KEYS.items()) + "  [q] quit",
        style="reverse",
        no_wrap=True,
        overflow="ellipsis",
    )
    if width < LEAST[0] or height < LEAST[1]:
        small = Text(
            f"Make this terminal larger: {LEAST[0]} x {LEAST[1]}.", style="yellow"
        )
        return Group(
            *fitted(wrapped([*_task(picture), small], width), max(height - 1, 0)), keys
        )
    now = headed("now", fitted(wrapped(_task(picture), width), height // 4), width)
    nodes = headed(
        "nodes", fitted(wrapped(_health(picture), width), height // 8), width
    )
    log_rows = headed(
        "log",
        last_fitted(
            [_log_line(line) for line in log] or [Text("-")], width, height // 8
        ),
        width,
    )
    rows = height - len(now) - len(nodes) - len(log_rows) - 1
    left = (width - BETWEEN) // 2
    halves = (
        _measured(picture, left, rows),
        _verdict_and_map(picture, width - BETWEEN - left, rows),
    )
    side_by_side = [
        _one_row(width, *(half[row] if row < len(half) else Text() for half in halves))
        for row in range(rows)
    ]
    return Group(*now, *side_by_side, *nodes, *log_rows, keys)


def _one_row(width: int, left: Text, right: Text) -> Text:
    """Return one row of both halves of the screen."""
    first = (width - BETWEEN) // 2
    left, right = left.copy(), right.copy()
    left.truncate(first, overflow="ellipsis", pad=True)
    right.truncate(width - BETWEEN - first, overflow="ellipsis")
    return Text(no_wrap=True).append_text(left).append(" " * BETWEEN).append_text(right)


def what_now(picture: dict[str, Any]) -> str:
    """Return in one sentence what the operator has to do."""
    health = picture["health"].get("pose_sequencer")
    if health is None:
        return "pose_sequencer is not running: start it, or wait for it."
    command = picture["command"] or {}
    state = _state(health["values"], command)
    if health["message"].startswith("waiting for ") and state in (
        "IDLE",
        "DONE",
        "ABORTED",
    ):
        return f"Nothing to do: {health['message']}."
    look = f"Look: {health['message']}." if health["level"] else ""
    if state == "PLACING":
        x, y = command.get("translation_mm") or (None, None)
        turn = command.get("rotation_deg")
        pose = (
            ""
            if None in (x, y, turn)
            else (f" turned by {turn:g}°{_sense_of(turn)}, at x {x:g} mm, y {y:g} mm")
        )
        name = command.get("view_name") or health["values"].get("view_name", "")
        return f"Place the plate for view '{name}'{pose}; then press c. {look}".rstrip()
    if state == "MEASURING":
        return look or "Nothing to do: the view is being measured."
    return {
        "IDLE": "Press s to start the plan.",
        "DONE": "Done. s starts another run.",
        "ABORTED": "Aborted. s starts a new run.",
        "FOLLOWING": "Nothing to do: another sequencer is in command; a ends that.",
    }.get(state, health["message"])


def _sense_of(turn_deg: Any) -> str:
    """Return the direction of a turn, and the resulting position of the first corner."""
    quarters = round(turn_deg / 90)
    if not quarters % 4 or abs(turn_deg - 90 * quarters) > 1:
        return (
            " counter-clockwise"
            if turn_deg > 0
            else " clockwise"
            if turn_deg < 0
            else ""
        )
    corner = ("", "top left", "bottom left", "bottom right")[quarters % 4]
    way = "↺ counter-clockwise" if turn_deg > 0 else "↻ clockwise"
    return f" {way} (the corner at the top right goes to the {corner})"


def saved_as(picture: dict[str, Any]) -> str:
    """Return the file that the solver has written the map to, empty if none."""
    health = picture["health"].get("solver")
    return str(health["values"].get("saved", "")) if health else ""


def _state(values: dict[str, str], command: dict[str, Any]) -> str:
    """Return the sequencer's state; its newest command is earlier than its health."""
    state = values.get("state", "")
    if state not in ("PLACING", "MEASURING") or command.get("plan_id") != values.get(
        "plan_id"
    ):
        return state
    return {
        "PLACE": "PLACING",
        "MEASURE": "MEASURING",
        "DONE": "DONE",
        "ABORT": "ABORTED",
    }.get(command.get("phase", ""), state)


def _task(picture: dict[str, Any]) -> list[Text]:
    """Return view, run and current task."""
    command = picture["command"]
    health = picture["health"].get("pose_sequencer")
    values = health["values"] if health else {}
    views = _whole_number(values.get("views")) or (command or {}).get(
        "views_planned", 0
    )
    name, index = (
        (command or {}).get("view_name", ""),
        (command or {}).get("view_index", 0),
    )
    heading = "no view yet"
    if command and views:
        view = f"view {index + 1} of {views}: {name}"
        heading = {
            "DONE": f"{min(index, views)} of {views} views done",
            "ABORT": f"aborted in {view}",
        }.get(command["phase"], view)
    run = values.get("run_id") or (command or {}).get("run_id") or "-"
    plan = values.get("plan_id") or (command or {}).get("plan_id") or "-"
    return [
        Text.assemble((heading, "bold"), (f"   plan {plan}, run {run}", "dim")),
        Text(what_now(picture), style="bold cyan"),
        *(
            [Text(f"The map is saved as {saved_as(picture)}")]
            if saved_as(picture)
            else []
        ),
    ]


def _whole_number(text: Any) -> int:
    """Return the whole number in a text, 0 if it is none."""
    text = str(text)
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 0


def _measured(picture: dict[str, Any], width: int, rows: int) -> list[Text]:
    """Return coverage of the view and rejections."""
    view = picture["view"]
    if view is None:
        return headed("coverage", [Text("nothing measured yet")], width)
    reasons = [
        Text(f"{count:6d}  {reason}")
        for reason, count in sorted(view["rejected"].items(), key=lambda item: -item[1])
    ] or [Text("none")]
    rejected = headed(
        f"rejected by reason; {view['used']} used",
        fitted(wrapped(reasons, width), max(2, rows // 5)),
        width,
    )
    text = wrapped(_coverage(view, width), width)
    room = rows - 1 - len(text) - len(rejected)
    plate = _plate(view, width, room) if view["plate"] else []
    return fitted(
        [
            *headed(f"coverage of {view['view_name']}", [*text, *plate], width),
            *rejected,
        ],
        rows,
    )


def _coverage(view: dict[str, Any], width: int) -> list[Text]:
    """Return the numbers of a view."""
    counted = [
        ("marks", *view["grid"]),
        ("lines", *view["angular"]),
        ("marks with check stops", *view["checks"]),
    ]
    share = min(
        1.0,
        sum(done for _, done, _ in counted)
        / max(1, sum(wanted for *_, wanted in counted)),
    )
    wide = width - 6
    counts = [f"{what} {done} of {wanted}" for what, done, wanted in counted if wanted]
    texts = [
        Text.assemble(
            ("█" * int(share * wide), "green"),
            "░" * (wide - int(share * wide)),
            f" {int(100 * share):3d} %",
        ),
        Text(", ".join([*counts, *["complete"] * view["complete"]])),
    ]
    noise = [
        _with_unit(view[f"repeatability_{unit}"], unit) for unit in ("um", "arcsec")
    ]
    if noise != ["-", "-"]:
        texts.append(Text(f"repeatability {', '.join(noise)}"))
    if view["missing_lines"]:
        texts.append(Text(f"missing lines {some_of(view['missing_lines'], 10)}"))
    return texts


def _plate(view: dict[str, Any], width: int, room: int) -> list[Text]:
    """Return the plate as a picture: o is read, . is missing."""
    cells, step = coarser(view["plate"], width, max(room - 1, 1), _worst_mark)
    step *= view.get("plate_step", 1)
    what = "a mark" if step == 1 else f"{step} x {step} marks"
    unknown = ", ? unknown" if any("?" in row for row in cells) else ""
    return [
        Text(f"each cell: {what}; . missing{unknown}", style="dim"),
        *(Text(" ".join(row), style="green") for row in cells),
    ]


def _worst_mark(cells: list[str]) -> str:
    return next((sign for sign in ".?o" if sign in cells), " ")


def _verdict_and_map(picture: dict[str, Any], width: int, rows: int) -> list[Text]:
    """Return verdict and map."""
    solved_map = picture["map"]
    um = solved_map["um"] if solved_map else []
    room = min(len(um), max(4, rows // 2 - 1))
    verdict = headed(
        "map and verdict",
        fitted(wrapped(_verdict(picture), width), rows - 2 - room),
        width,
    )
    return [
        *verdict,
        *(
            _map(um, width, rows - len(verdict), solved_map)
            if um
            else [Text("no map yet", style="dim")]
        ),
    ]


def _verdict(picture: dict[str, Any]) -> list[Text]:
    """Return the solver's verdict, the most important first."""
    summary = picture["summary"]
    if summary is None:
        return [Text("no view has been solved yet")]
    word = "not qualified" if summary["identifiable"] else "not identified yet"
    colour = "bold yellow"
    if summary["qualified"]:
        word, colour = (
            ("good within an enlarged U", "bold yellow")
            if summary["enlarged"]
            else ("good", "bold green")
        )
    done, planned = summary["views"]
    run = summary["run_id"]
    now = (picture["command"] or {}).get("run_id", "")
    earlier = "; an earlier run" if run and now and run != now else ""
    texts = [
        Text.assemble((word, colour), f"; views {done} of {planned}{earlier}"),
        Text(summary["state"]),
    ]
    texts += [
        Text(f"- {line}", style="yellow")
        for line in (*summary["causes"], *summary["advice"])
    ]
    if summary["max_error_um"] is None:
        return texts
    return [
        *texts,
        Text(
            f"largest error {_with_unit(summary['max_error_um'], 'um')}, rms u "
            f"{_with_unit(summary['rms_uncertainty_um'], 'um')}"
        ),
    ]


def _map(
    um: list[list[float | None]], width: int, rows: int, solved_map: dict[str, Any]
) -> list[Text]:
    """Return the size of the error at each site as a picture."""
    cells, step = coarser(um, width, max(rows - 1, 1), _worst_error)
    step *= solved_map.get("step", 1)
    most = max(
        (value for row in cells for value in row if value is not None), default=0.0
    )
    signs = [
        [
            "?" if value is None else SHADES[min(9, int(value / (most or 1.0) * 10))]
            for value in row
        ]
        for row in cells
    ]
    title = f"error, '@' = {most:.3g} µm" + (
        f", cell {step} x {step}" if step > 1 else ""
    )
    return headed(title, [Text(" ".join(row), style="magenta") for row in signs], width)


def _worst_error(cells: list[float | None]) -> float | None:
    errors = [value for value in cells if value is not None]
    return max(errors) if len(errors) == len(cells) else None


def _health(picture: dict[str, Any]) -> list[Text]:
    """Return the nodes with a problem, one per line, and those that are well."""
    well, texts = [], []
    for node, health in picture["health"].items():
        if health is not None and not health["level"]:
            well.append(node)
            continue
        word, colour = (
            ("no sign of life", "red")
            if health is None
            else LEVELS.get(health["level"], LEVELS[2])
        )
        message = "" if health is None else f" {health['message']}"
        texts.append(Text.assemble((f"{node}: ", "bold"), (word, colour), message))
    return [
        *texts,
        *([Text.assemble(("ok: ", "green"), ", ".join(well))] if well else []),
    ]


def _log_line(line: str) -> Text:
    """Return a line of the log, without the time for lines of nodes."""
    match = PREFIX.match(line)
    if match is None:
        return Text(printable(line))
    level = "" if match[1] == "INFO" else f"{match[1]} "
    return Text(
        printable(f"{level}{match[2]}: {line[match.end() :]}"),
        style={"WARN": "yellow", "ERROR": "red", "FATAL": "red"}.get(match[1], ""),
    )


def _with_unit(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {'µm' if unit == 'um' else unit}"
