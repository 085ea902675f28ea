# SPDX-License-Identifier: Apache-2.0
"""CELL.yaml: a machine, its limits, how it settles, its detector, and who places the plate."""

import importlib
import importlib.metadata
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, cast

from selfcal_ros.errors import InputError, first_line, known_are
from selfcal_ros.files import read_text, read_yaml, refuse_unknown
from selfcal_ros.machine.calling import called
from selfcal_ros.machine.interface import Machine, MachineError
from selfcal_ros.model.readings import Sense
from selfcal_ros.outputs import write_text
from selfcal_ros.settings.detector import DetectorSettings
from selfcal_ros.settings.parameter import Parameter

AXES = ("x", "y", "theta")
ENTRY_POINTS = "selfcal.machines"
SHIPPED = {
    "simulated": "selfcal_ros.machine.simulated:SimulatedMachine",
    "gcode": "selfcal_ros.machine.gcode:GcodeMachine",
    "joint_trajectory": "selfcal_ros.nodes.joint_trajectory:JointTrajectoryMachine",
    "ophyd": "selfcal_ros.machine.ophyd:OphydMachine",
    "micromanager": "selfcal_ros.machine.micromanager:MicroManagerMachine",
}
"""Machines of this package; further ones are entry points of the group ``selfcal.machines``."""
FOLDER = "folder"
"""Key of a machine that gets the folder of CELL.yaml unless the file gives it."""
DEFAULT_STEP_M = 1e-4
"""First move where the size of the marks is not known."""
FIRST_TURN_RAD = 0.01
"""First move of a rotary axis."""
LONGEST_WAIT_S = 3600.0
"""Longest wait for rest."""
LONGEST_M = 20.0
"""Limits beyond are in another unit."""
ASTRAY_M = 1.0
"""Distance from the limits from which a position is in another unit: 5 mm read as 5 m."""
PLACERS = ("person", "robot")
NOT_OF_A_CELL = ("autostart", "hardware_id", "transport", "max_waiting", "frame_id")
"""Parameters of the node mark_detector that a cell does not have."""


@dataclass(frozen=True)
class Settle:
    """When the stage is at rest at its target; lengths in m, times in s, angles in rad.

    Attributes
    ----------
    time : float
        Waiting time after every move.
    within, within_theta : float
        Largest difference of two successive readings at rest.
    arrival, arrival_theta : float
        Largest distance of the indicated position from the commanded one.
    patience : float
        Longest wait for rest.
    """

    time: float = 0.0
    within: float = 1e-6
    within_theta: float = 1e-5
    arrival: float = 2e-5
    arrival_theta: float = 1e-3
    patience: float = 10.0

    def of(self, axis: str, name: str) -> float:
        """Return `within` or `arrival` of an axis."""
        return float(getattr(self, f"{name}_theta" if axis == "theta" else name))


@dataclass(frozen=True)
class Cell:
    """A parsed CELL.yaml.

    Attributes
    ----------
    path : Path
        The file.
    machine : str
        Name of the machine, or ``package.module:Class``.
    keys : mapping
        The machine's own keys.
    limits : mapping
        Axis -> (low, high) of the machine's position, never left.
    origin : mapping
        Axis -> machine's position at the centre of the field.
    sense : Sense
        What moves.
    settle : Settle
        When the stage is at rest.
    detector : DetectorSettings or None
        How marks are found in images; None without.
    placing : str
        ``person`` or ``robot``; with `place_command` a program is the robot.
    place_command : str
        Command line with {view}, {x}, {y}, {rotation}; empty = the machine's method ``place``.
    """

    path: Path
    machine: str
    keys: Mapping[str, Any]
    limits: Mapping[str, tuple[float, float]]
    origin: Mapping[str, float] = field(default_factory=dict)
    sense: Sense = Sense.MICROSCOPE_MOVES
    settle: Settle = Settle()
    detector: DetectorSettings | None = None
    placing: str = "person"
    place_command: str = ""

    @property
    def first_step_m(self) -> float:
        """Length of the first move, m: the size of a mark, so that it stays in sight."""
        return (self.detector.mark_size if self.detector else 0.0) or DEFAULT_STEP_M

    @property
    def name(self) -> str:
        """The key under which the machine's own keys stand."""
        return self.machine.rpartition(":")[2]

    def to_machine(self, axis: str, value: float) -> float:
        """Return the machine's position of a position in the stage frame."""
        return value + self.origin.get(axis, 0.0)

    def to_stage(self, axis: str, value: float) -> float:
        """Return the position in the stage frame of a machine's position."""
        return value - self.origin.get(axis, 0.0)

    def require_near(self, axis: str, value: float) -> None:
        """Raise MachineError if the machine stands where only another unit can place it.

        A small move from there, and an axis that is to stay, would go as many times as far.
        """
        low, high = self.limits.get(axis, (-math.inf, math.inf))
        if axis != "theta" and max(low - value, value - high) > ASTRAY_M:
            raise MachineError(
                f"it stands at {axis} = {value:.6g} m, far beyond the limits {low:g} to "
                f"{high:g}: is it in mm?",
                f"{self.path}: limits",
                "have the machine tell m, or correct the limits",
            )

    def require_limits(
        self, axis: str, value: float, motion: str, start: float | None = None
    ) -> None:
        """Raise MachineError for a machine's position that is not a number or leaves the limits.

        From a `start` beyond the limits a move back towards them is allowed.
        """
        if not math.isfinite(value):
            raise MachineError(
                f"{motion}: {axis} = {value} is not a position", str(self.path)
            )
        if axis not in self.limits:
            raise MachineError(
                f"{motion} moves {axis}, which has no limits",
                f"{self.path}: limits",
                f"give limits: {{{axis}: [low, high]}}",
            )
        low, high = self.limits[axis]
        if start is not None and (start < value < low or high < value < start):
            return
        if not low <= value <= high:
            raise MachineError(
                f"{motion} is at {axis} = {value:.6g}, beyond the limits {low:g} to {high:g}",
                f"{self.path}: limits",
                "correct limits or origin, or take a smaller plan"
                if start is None
                else "correct limits or origin, or mark_size: first moves are as long as a mark",
            )


def read_cell(path: str | Path) -> Cell:
    """Return the cell in a CELL.yaml.

    Raises
    ------
    InputError
        For an unknown key, a wrong type or a value that cannot be.
    """
    path = Path(path)
    where = str(path)
    data = _mapping(read_yaml(path), where)
    machine = _machine(data.get("machine"), where)
    machine_key = machine.rpartition(":")[2]
    known_keys = (
        "machine",
        machine_key,
        "limits",
        "origin",
        "sense",
        "settle",
        "detector",
        "placing",
        "found",
    )
    refuse_unknown(data, known_keys, where)
    sense = Parameter(
        "sense", str(Sense.MICROSCOPE_MOVES), "", choices=tuple(map(str, Sense))
    )
    placing, place_command = _placing(data.get("placing", "person"), where)
    settle = Settle(
        **_numbers(
            data.get("settle", {}),
            f"{where}: settle",
            {item.name: getattr(Settle(), item.name) for item in fields(Settle)},
            low=0.0,
        )
    )
    cell = Cell(
        path,
        machine,
        _mapping(data.get(machine_key, {}), f"{where}: {machine_key}"),
        _limits(data.get("limits", {}), f"{where}: limits"),
        origin=_numbers(
            data.get("origin", {}), f"{where}: origin", dict.fromkeys(AXES, 0.0)
        ),
        sense=Sense(sense.check(data.get("sense", sense.default), where)),
        settle=settle,
        detector=_detector(data["detector"], where) if "detector" in data else None,
        placing=placing,
        place_command=place_command,
    )
    _check_settle(cell, f"{where}: settle")
    return cell


def _check_settle(cell: Cell, where: str) -> None:
    """Raise InputError for tolerances that hide whether the stage moves, or endless waits."""
    least_move_m = max(cell.first_step_m, DEFAULT_STEP_M)
    for name in ("within", "arrival"):
        length_m, angle = cell.settle.of("x", name), cell.settle.of("theta", name)
        if length_m >= least_move_m:
            raise InputError(
                f"{where}: {name}",
                f"{length_m:g} m would hide a stage that stands still: is it in µm?",
                f"give m, below {least_move_m:g}",
            )
        if angle >= FIRST_TURN_RAD:
            raise InputError(
                f"{where}: {name}_theta",
                f"{angle:g} rad would hide an axis that stands still: is it in degrees?",
                f"give rad, below {FIRST_TURN_RAD:g}",
            )
    for name in ("time", "patience"):
        wait_s = getattr(cell.settle, name)
        if wait_s > LONGEST_WAIT_S:
            raise InputError(
                f"{where}: {name}",
                f"{wait_s:g} s are more than {LONGEST_WAIT_S:g} s",
                "give s",
            )


def _machine(name: Any, where: str) -> str:
    """Return the name of a machine that there is, or ``package.module:Class``."""
    known = sorted(known_machines())
    if not isinstance(name, str):
        raise InputError(
            where,
            "the key 'machine' is missing",
            f"name a machine: {', '.join(known)}, or package.module:Class",
        )
    if ":" not in name and name not in known:
        raise InputError(
            f"{where}: machine",
            f"there is no machine '{name}'",
            f"{known_are(name, known)}; or package.module:Class",
        )
    return name


def _limits(data: Any, where: str) -> dict[str, tuple[float, float]]:
    """Return the limits of the axes; those of x and y must be given."""
    limits = {
        axis: _pair(pair, f"{where}: {axis}")
        for axis, pair in _mapping(data, where).items()
    }
    refuse_unknown(limits, AXES, where)
    for axis in AXES[:2]:
        if axis not in limits:
            raise InputError(
                where,
                f"the travel of {axis} is not limited",
                f"give {axis}: [low, high] in m, as the machine indicates them",
            )
        if max(map(abs, limits[axis])) > LONGEST_M:
            raise InputError(
                f"{where}: {axis}", f"{limits[axis]} m: is it in mm?", "give m"
            )
    return limits


def _placing(data: Any, where: str) -> tuple[str, str]:
    """Return who places the plate, and the command line of a robot, "" without one."""
    if isinstance(data, dict) and data:
        refuse_unknown(data, ("command",), f"{where}: placing")
        command = Parameter("command", "", "")
        return "robot", command.check(data["command"], f"{where}: placing")
    placing = Parameter("placing", "person", "", choices=PLACERS)
    return placing.check(data, where), ""


def _detector(data: Any, where: str) -> DetectorSettings:
    section = _mapping(data, f"{where}: detector")
    names = [
        item.name
        for item in DetectorSettings.parameters()
        if item.name not in NOT_OF_A_CELL
    ]
    refuse_unknown(section, names, f"{where}: detector")
    return DetectorSettings.checked(section, f"{where}: detector")


def _mapping(data: Any, where: str) -> dict[str, Any]:
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise InputError(where, "not a mapping", "see docs/start/machines.md")
    return data


def _numbers(
    data: Any, where: str, defaults: Mapping[str, float], low: float | None = None
) -> dict[str, float]:
    section = _mapping(data, where)
    refuse_unknown(section, defaults, where)
    return {
        name: Parameter(name, float(defaults[name]), "", low=low).check(value, where)
        for name, value in section.items()
    }


def _pair(value: Any, where: str) -> tuple[float, float]:
    numbers = value if isinstance(value, list) else []
    if not (
        len(numbers) == 2
        and all(type(item) in (int, float) for item in numbers)
        and numbers[0] < numbers[1]
    ):
        raise InputError(
            where, f"{value!r} is not [low, high]", "give two rising numbers, SI"
        )
    return float(numbers[0]), float(numbers[1])


def known_machines() -> dict[str, str]:
    """Return name -> ``package.module:Class`` of all machines that have a name."""
    plugins = importlib.metadata.entry_points(group=ENTRY_POINTS)
    return {point.name: point.value for point in plugins} | SHIPPED


def open_machine(cell: Cell) -> Machine:
    """Return the machine of a cell, connected.

    Raises
    ------
    InputError
        If there is no such machine or module, its keys are wrong, or it is not a machine.
    MachineError
        If it cannot be reached.
    """
    kind = class_of(cell)
    check_keys(kind, cell)
    keys = dict(cell.keys)
    if FOLDER in inspect.signature(kind).parameters and FOLDER not in keys:
        keys[FOLDER] = str(cell.path.parent)
    machine = called(f"{cell.path}: {cell.machine}", kind, **keys)
    for name in ("axes", "position", "move_to", "image", "offsets", "stop", "close"):
        if not hasattr(machine, name):
            raise InputError(
                f"{cell.path}: machine",
                f"{cell.machine} has no '{name}'",
                "give the class all that selfcal_ros.machine.Machine has",
            )
    axes = tuple(machine.axes)
    if axes not in (AXES[:2], AXES):
        raise InputError(
            f"{cell.path}: machine",
            f"the axes of {cell.machine} are {axes}",
            "let them be ('x', 'y') or ('x', 'y', 'theta')",
        )
    return cast(Machine, machine)


@contextmanager
def connected(cell: Cell, say: Callable[[str], None]) -> Iterator[Machine]:
    """Yield the machine of a cell and release it; `say` takes a line if that fails.

    Raises like `open_machine`.
    """
    machine = open_machine(cell)
    try:
        yield machine
    finally:
        try:
            machine.close()
        except Exception as error:
            say(f"note: machine.close: {type(error).__name__}: {first_line(error)}")


def class_of(cell: Cell) -> Any:
    """Return the class of a cell's machine; raises InputError like `open_machine`."""
    target = (
        cell.machine
        if ":" in cell.machine
        else (SHIPPED.get(cell.machine) or known_machines()[cell.machine])
    )
    where = f"{cell.path}: machine"
    module, _, name = target.partition(":")
    folder = str(cell.path.resolve().parent)
    if folder not in sys.path:
        sys.path.append(folder)
    try:
        loaded = importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name is None or not module.startswith(error.name):
            raise InputError(
                where,
                f"'{cell.machine}' needs the module {error.name}",
                f"pip install 'selfcal_ros[{cell.machine}]'"
                if ":" not in cell.machine
                else f"install {error.name}",
            ) from error
        raise InputError(
            where,
            f"there is no module '{module}'",
            f"put {module.partition('.')[0]}.py beside {cell.path.name}, or install it",
        ) from error
    except Exception as error:
        raise InputError(
            where,
            f"the module '{module}' fails: {type(error).__name__}: {first_line(error)}",
            "correct it",
        ) from error
    if not hasattr(loaded, name):
        path = getattr(loaded, "__file__", None) or "built into Python"
        raise InputError(
            where,
            f"the module '{module}' ({path}) has no '{name}'",
            known_are(name, [key for key in vars(loaded) if not key.startswith("_")]),
        )
    return getattr(loaded, name)


def check_keys(kind: Any, cell: Cell) -> None:
    """Refuse keys that the class does not take, and missing ones."""
    where = f"{cell.path}: {cell.name}"
    parameters = {
        name: item
        for name, item in inspect.signature(kind).parameters.items()
        if item.kind not in (item.VAR_POSITIONAL, item.VAR_KEYWORD)
    }
    takes_any = len(parameters) < len(inspect.signature(kind).parameters)
    if not takes_any:
        refuse_unknown(cell.keys, parameters, where)
    missing = [
        name
        for name, item in parameters.items()
        if item.default is item.empty and name not in {*cell.keys, FOLDER}
    ]
    if missing:
        raise InputError(
            where,
            f"the key '{missing[0]}' is missing",
            f"give {cell.name}: {{{missing[0]}: ...}}",
        )


def with_values(
    path: Path, section: str, values: Mapping[str, Any], notes: Mapping[str, str]
) -> None:
    """Write values into a section of a CELL.yaml, in block style, and keep the rest as it is.

    Parameters
    ----------
    path : Path
        The file.
    section : str
        Its section; keys that `values` does not have are kept.
    values, notes : mapping
        Key -> value, and the comment behind it.
    """
    text = read_text(path)
    old = _mapping((read_yaml(path) or {}).get(section), f"{path}: {section}")
    lines = [f"{section}:"]
    for key, value in (old | dict(values)).items():
        note = f"  # {notes[key]}" if key in notes else ""
        lines.append(f"  {key}: {_as_yaml(value)}{note}")
    block = "\n".join(lines) + "\n"
    pattern = re.compile(rf"^{section}:.*\n(?:(?:[ \t].*)?\n)*", re.MULTILINE)
    text = text if text.endswith("\n") else text + "\n"
    replaced, count = pattern.subn(lambda _: block, text, count=1)
    write_text(path, replaced if count else text + block)


def _as_yaml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        text = repr(value)
        return text if "." in text or "e" not in text else text.replace("e", ".0e")
    if isinstance(value, dict):
        return (
            "{"
            + ", ".join(f"{key}: {_as_yaml(item)}" for key, item in value.items())
            + "}"
        )
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_as_yaml, value)) + "]"
    return str(value)
