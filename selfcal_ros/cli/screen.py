# SPDX-License-Identifier: Apache-2.0
"""One terminal screen of a calibration: drawn from the picture that the monitor process sends."""

from typing import Any

from rich import box
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from selfcal_ros.errors import printable

KEYS = {"s": "start", "c": "confirm", "r": "redo", "k": "skip", "a": "abort"}
SHADES = " .:-=+*#%@"
LEVELS = {0: ("ok", "green"), 1: ("warn", "yellow"), 2: ("error", "red")}
LINES = 6
"""Last lines of the log that are shown."""


def screen(picture: dict[str, Any], log: list[str]) -> RenderableType:
    """Return the screen of a picture and the last lines of the log."""
    left = Group(_task(picture), _coverage(picture), _rejected(picture))
    right = Group(_outcome(picture), _map(picture))
    table = Table.grid(expand=True, padding=(0, 1))
    table.add_column(ratio=1)
    table.add_column(ratio=1)
    table.add_row(left, right)
    keys = "  ".join(f"[{key}] {word}" for key, word in KEYS.items()) + "  [q] quit"
    return Group(table, _health(picture), _lines(log), Text(keys, style="reverse"))


def what_now(picture: dict[str, Any]) -> str:
    """Return in one sentence what the person in front of the screen has to do."""
    told = picture["health"].get("pose_sequencer")
    if told is None:
        return "pose_sequencer is not there: start it, or wait for it."
    command = picture["command"] or {}
    state = _state(told["values"], command)
    if told["message"].startswith("waiting for ") and state in ("IDLE", "DONE", "ABORTED"):
        return f"Nothing: {printable(told['message'])}."
    look = f"Look: {printable(told['message'])}." if told["level"] else ""
    if state == "PLACING":
        x, y = command.get("translation_mm") or (None, None)
        turn = command.get("rotation_deg")
        pose = "" if None in (x, y, turn) else f" turned by {turn:g} deg, at x {x:g} mm, y {y:g} mm"
        name = command.get("view_name") or told["values"].get("view_name", "")
        return f"Place the plate for view '{printable(name)}'{pose}; then press c. {look}".rstrip()
    if state == "MEASURING":
        return look or "Nothing: the view is being measured."
    return {"IDLE": "Press s to start the plan.", "DONE": "Done. s starts another run.",
            "ABORTED": "Aborted. s starts a new run.",
            "FOLLOWING": "Nothing: somebody else commands; a ends that.",
            }.get(state, printable(told["message"]))


def _state(values: dict[str, str], command: dict[str, Any]) -> str:
    """Return the sequencer's state; its newest command tells it earlier than its health."""
    state = values.get("state", "")
    if state not in ("PLACING", "MEASURING") or command.get("plan_id") != values.get("plan_id"):
        return state
    return {"PLACE": "PLACING", "MEASURE": "MEASURING", "DONE": "DONE",
            "ABORT": "ABORTED"}.get(command.get("phase", ""), state)


def _task(picture: dict[str, Any]) -> Panel:
    command, told = picture["command"], picture["health"].get("pose_sequencer")
    values = told["values"] if told else {}
    views = _whole(values.get("views")) or (command or {}).get("views_planned", 0)
    name = (command or {}).get("view_name") or "-"
    index = (command or {}).get("view_index", 0)
    of = f"view {index + 1} of {views}: {printable(name)}" if command and views else "no view yet"
    run = printable(values.get("run_id") or (command or {}).get("run_id") or "-")
    plan = printable(values.get("plan_id") or (command or {}).get("plan_id") or "-")
    return Panel(Group(Text(of, style="bold"), Text(f"plan {plan}, run {run}", style="dim"),
                       Text(what_now(picture), style="bold cyan")), title="now", box=box.ROUNDED)


def _whole(text: Any) -> int:
    """Return the whole number that a node has told, 0 if it is none."""
    text = str(text)
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 10 else 0


def _coverage(picture: dict[str, Any]) -> Panel:
    view = picture["view"]
    if view is None:
        return Panel(Text("nothing measured yet"), title="coverage", box=box.ROUNDED)
    done = view["grid"][0] + view["angular"][0]
    expected = max(1, view["grid"][1] + view["angular"][1])
    parts: list[RenderableType] = [
        ProgressBar(total=expected, completed=done, width=40),
        Text(f"marks {view['grid'][0]} of {view['grid'][1]}, lines {view['angular'][0]} of "
             f"{view['angular'][1]}" + (", complete" if view["complete"] else "")),
        Text(f"repeatability {_number(view['repeatability_um'], 'um')}, "
             f"{_number(view['repeatability_arcsec'], 'arcsec')}")]
    parts += [Text(" ".join(row), style="green") for row in view["plate"]]
    if view["missing_lines"]:
        lines = ", ".join(map(str, view["missing_lines"][:10]))
        parts.append(Text(f"missing lines {lines}" + " ..." * (len(view["missing_lines"]) > 10)))
    return Panel(Group(*parts), title=f"coverage of {printable(view['view_name'])}",
                 box=box.ROUNDED)


def _rejected(picture: dict[str, Any]) -> Panel:
    view = picture["view"]
    rejected = view["rejected"] if view else {}
    text = "\n".join(f"{count:6d}  {printable(reason)}" for reason, count in sorted(
        rejected.items(), key=lambda item: -item[1])) or "none"
    used = f"{view['used']} used" if view else ""
    return Panel(Text(text), title=f"rejected by reason; {used}", box=box.ROUNDED)


def _outcome(picture: dict[str, Any]) -> Panel:
    summary = picture["summary"]
    if summary is None:
        return Panel(Text("no view has been solved yet"), title="map and verdict", box=box.ROUNDED)
    verdict = Text("qualified", style="bold green") if summary["qualified"] else Text(
        "not qualified" if summary["identifiable"] else "not identified yet", style="bold yellow")
    parts: list[RenderableType] = [
        verdict, Text(printable(summary["state"])),
        Text(f"views {summary['views'][0]} of {summary['views'][1]}; largest error "
             f"{_number(summary['max_error_um'], 'um')}, rms u "
             f"{_number(summary['rms_uncertainty_um'], 'um')}")]
    parts += [Text(f"- {printable(line)}", style="yellow")
              for line in (*summary["causes"], *summary["advice"])[:4]]
    return Panel(Group(*parts), title="map and verdict", box=box.ROUNDED)


def _map(picture: dict[str, Any]) -> Panel:
    told = picture["map"]
    sizes = [value for row in told["um"] for value in row if value is not None] if told else []
    if not sizes:
        return Panel(Text("no map yet"), title="error |G|", box=box.ROUNDED)
    most = max(sizes) or 1.0
    rows = [" ".join("?" if value is None else
                     SHADES[min(len(SHADES) - 1, int(value / most * len(SHADES)))]
                     for value in row) for row in told["um"]]
    return Panel(Text("\n".join(rows), style="magenta"),
                 title=f"error |G|, '@' = {most:.3g} um", box=box.ROUNDED)


def _health(picture: dict[str, Any]) -> Columns:
    parts = []
    for node, told in picture["health"].items():
        word, colour = ("gone", "red") if told is None else LEVELS.get(told["level"],
                                                                       LEVELS[2])
        message = "" if told is None or not told["level"] else f" {printable(told['message'])}"
        parts.append(Text.assemble((f"{node}: ", "bold"), (word, colour), message))
    return Columns(parts, padding=(0, 3))


def _lines(log: list[str]) -> Panel:
    return Panel(Text("\n".join(map(printable, log[-LINES:])) or "-", no_wrap=True,
                      overflow="ellipsis"), title="log", box=box.ROUNDED)


def _number(value: float | None, unit: str) -> str:
    return "-" if value is None else f"{value:.3g} {unit}"
