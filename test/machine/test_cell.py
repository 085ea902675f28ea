# SPDX-License-Identifier: Apache-2.0
"""CELL.yaml: keys, machines by name, values written into it."""

from pathlib import Path

import pytest

from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.machine import MachineError
from selfcal_ros.machine.cell import (
    check_keys,
    class_of,
    open_machine,
    read_cell,
    with_values,
)
from selfcal_ros.machine.simulated import SimulatedMachine
from selfcal_ros.model.readings import Sense
from test.support.cells import CELL, write_cell

OWN = """
class Mine:
    axes = ("x", "y")

    def __init__(self, port, speed=1.0):
        self.port, self.speed = port, speed

    def position(self): return (0.0, 0.0)
    def move_to(self, position): pass
    def image(self): return None
    def offsets(self): return []
    def stop(self): pass
    def close(self): pass
"""
LIMITS = "limits: {x: [-1, 1], y: [-1, 1]}\n"


def test_a_cell_with_all_its_keys(tmp_path):
    (tmp_path / "cell.yaml").write_text(
        CELL
        + (
            "sense: plate_moves\norigin: {x: 0.1}\ndetector: {mark: ring, mark_size: 4.0e-5}\n"
        )
    )
    cell = read_cell(tmp_path / "cell.yaml")
    assert (cell.machine, cell.sense, cell.placing) == (
        "simulated",
        Sense.PLATE_MOVES,
        "robot",
    )
    assert cell.limits["x"] == (-0.01, 0.01)
    assert cell.to_machine("x", 0.25) == 0.35
    assert cell.to_stage("x", 0.35) == pytest.approx(0.25)
    assert cell.to_machine("y", 0.25) == 0.25
    assert (cell.detector.mark, cell.settle.patience) == ("ring", 1.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("machine: simulated\n", "cell.yaml: limits: the travel of x is not limited"),
        (LIMITS, "the key 'machine' is missing"),
        (
            f"{LIMITS}machine: simulated\nlimit: 3\n",
            "limit: unknown key; did you mean 'limits'?",
        ),
        (
            f"{LIMITS}machine: simulated\nsettle: {{tim: 3}}\n",
            "tim: unknown key; did you mean 'time'?",
        ),
        (
            f"{LIMITS}machine: simulated\nsettle: {{time: -3}}\n",
            "settle: time: -3.0 is below 0.0; correct the value",
        ),
        (
            f"{LIMITS}machine: simulated\nsettle: {{arrival: 20}}\n",
            "settle: arrival: 20 m would hide a stage that stands still: is it in µm",
        ),
        (
            f"{LIMITS}machine: simulated\nsettle: {{within_theta: 0.5}}\n",
            "within_theta: 0.5 rad would hide an axis that stands still: is it in deg",
        ),
        (
            f"{LIMITS}machine: simulated\nsettle: {{patience: .inf}}\n",
            "settle: patience: inf s are more than 3600 s",
        ),
        (
            f"{LIMITS}machine: simulated\norigin: {{x: low}}\n",
            "'low' is not of type float",
        ),
        (f"{LIMITS}machine: simulated\nplacing: hand\n", "choose one of person, robot"),
        (
            f"{LIMITS}machine: simulated\nplacing: {{command: }}\n",
            "placing: command: None is not of type str",
        ),
        (
            f"{LIMITS}machine: simulated\ndetector: {{autostart: true}}\n",
            "autostart: unknown key",
        ),
        (
            "machine: simulated\nlimits: {x: [1, -1], y: [-1, 1]}\n",
            "[1, -1] is not [low, high]",
        ),
        (
            "machine: simulated\nlimits: {x: [-1, mm, 1], y: [-1, 1]}\n",
            "[-1, 'mm', 1] is not [low, high]",
        ),
        (
            "machine: simulated\nlimits: {x: [-1, 1], y: [false, true]}\n",
            "[False, True] is not [low, high]",
        ),
    ],
)
def test_a_wrong_key_is_named(tmp_path, text, said):
    (tmp_path / "cell.yaml").write_text(text)
    with pytest.raises(InputError) as error:
        read_cell(tmp_path / "cell.yaml")
    assert said in str(error.value)


def test_a_class_beside_the_file_gets_the_keys_under_its_name(tmp_path):
    (tmp_path / "my_own_stage.py").write_text(OWN)
    (tmp_path / "cell.yaml").write_text(
        f"machine: my_own_stage:Mine\nMine: {{port: COM3, speed: 2.0}}\n{LIMITS}"
    )
    machine = open_machine(read_cell(tmp_path / "cell.yaml"))
    assert (machine.port, machine.speed) == ("COM3", 2.0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "machine: simulatd\n",
            "there is no machine 'simulatd'; did you mean 'simulated'?",
        ),
        ("machine: no_such_module:Mine\n", "put no_such_module.py beside cell.yaml"),
        ("machine: own_stage:Yours\n", "own_stage.py) has no 'Yours'"),
        (
            "machine: own_stage:Mine\nMine: {prot: 1}\n",
            "prot: unknown key; did you mean 'port'?",
        ),
        ("machine: own_stage:Mine\n", "Mine: the key 'port' is missing"),
        (
            "machine: code:Stage\n",
            "code.py) has no 'Stage'",
        ),  # of Python, not beside the file
        (
            "machine: own_stage:Far\n",
            "JSONDecodeError: Expecting value: line 1 column 1 (char 0) (own_stage.py, line ",
        ),
        ("machine: own_stage:Deaf\n", "RuntimeError: no answer (own_stage.py, line "),
        ("machine: own_stage:Half\n", "own_stage:Half has no 'move_to'"),
        ("machine: own_stage:Odd\n", "the axes of own_stage:Odd are ('y', 'x')"),
        ("machine: broken_stage:Mine\n", "ZeroDivisionError"),
        ("machine: lacking_stage:Mine\n", "needs the module not_installed_anywhere"),
    ],
)
def test_a_machine_that_cannot_be_had(tmp_path, monkeypatch, text, said):
    (tmp_path / "own_stage.py").write_text(
        OWN + "\nclass Half:\n    axes = ('x', 'y')\n    position = 1\n"
        "\nclass Far(Mine):\n    def __init__(self): import json; json.loads('')\n"
        "\nclass Deaf(Mine):\n    def __init__(self): import driver_of_apt; driver_of_apt.ask()\n"
        "\nclass Odd(Mine):\n    axes = ('y', 'x')\n    def __init__(self): pass\n"
    )
    (tmp_path / "dist-packages").mkdir()
    monkeypatch.syspath_prepend(tmp_path / "dist-packages")
    (tmp_path / "dist-packages/driver_of_apt.py").write_text(
        "def ask():\n    raise RuntimeError('no answer')\n"
    )
    (tmp_path / "broken_stage.py").write_text("1 / 0\n")
    (tmp_path / "lacking_stage.py").write_text("import not_installed_anywhere\n")
    (tmp_path / "cell.yaml").write_text(text + LIMITS)
    with pytest.raises(InputError) as error:
        open_machine(read_cell(tmp_path / "cell.yaml"))
    assert said in str(error.value)


def test_the_simulated_machine_is_found_by_its_name(tmp_path):
    assert isinstance(write_cell(tmp_path)[1], SimulatedMachine)


def test_values_are_written_and_the_rest_is_kept(tmp_path):
    path = tmp_path / "cell.yaml"
    path.write_text(
        "# my cell\nmachine: simulated  # here\n"
        "detector: {mark_size: 5.0e-5, turn: 1}\nlimits:\n  x: [-1, 1]  # of the nut\n"
        "  y: [-1, 1]\n"
    )
    with_values(path, "detector", {"turn": 2.5, "mirror": True}, {"turn": "u 0.1"})
    with_values(path, "found", {"backlash_x": {"value": 1e-6, "u": 2e-8}}, {})
    assert path.read_text() == (
        "# my cell\nmachine: simulated  # here\ndetector:\n  mark_size: 5.0e-05\n"
        "  turn: 2.5  # u 0.1\n  mirror: true\nlimits:\n  x: [-1, 1]  # of the nut\n"
        "  y: [-1, 1]\nfound:\n  backlash_x: {value: 1.0e-06, u: 2.0e-08}\n"
    )
    assert read_yaml(path)["found"]["backlash_x"]["u"] == 2e-8
    assert read_cell(path).detector.turn == 2.5


@pytest.mark.parametrize(
    ("axis", "value", "said"),
    [
        ("x", 0.0101, "beyond the limits -0.01 to 0.01"),
        ("x", -0.0101, "beyond the limits"),
        ("y", float("nan"), "not a position"),
        ("z", 0.0, "moves z, which has no limits"),
    ],
)
def test_limits(tmp_path, axis, value, said):
    (tmp_path / "cell.yaml").write_text(CELL)
    cell = read_cell(tmp_path / "cell.yaml")
    cell.require_limits("x", 0.01, "a move")
    with pytest.raises(MachineError, match=said):
        cell.require_limits(axis, value, "a move")


@pytest.mark.parametrize(
    "path",
    sorted((Path(__file__).parents[2] / "config/cells").glob("*.yaml")),
    ids=lambda path: path.name,
)
def test_the_shipped_cells_have_only_known_keys(path):
    cell = read_cell(path)
    check_keys(class_of(cell), cell)
