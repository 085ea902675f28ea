# SPDX-License-Identifier: Apache-2.0
"""``selfcal plan new``: what it writes is accepted by all that read plans, and true."""

import json
import re
from argparse import Namespace
from functools import cache
from importlib import import_module
from inspect import signature
from pathlib import Path

import pytest

from selfcal_ros.cli import plan_new
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.files import read_yaml
from selfcal_ros.machine.cell import FOLDER, SHIPPED, read_cell
from selfcal_ros.settings.estimator import read_plan
from test.support.disks import files_no_larger_than
from test.support.terminals import SELFCAL, in_terminal

STAGE = ["--travel", "50mm", "--marks", "5", "--pitch", "10mm"]
CAMERA = ["--travel", "2mm", "--marks", "3", "--pitch", "0.2mm", "--field", "0.6x0.3mm"]

ONCE = {
    name: cache(getattr(plan_new, name))  # the same plates in all tests
    for name in ("best_plan", "_u_of_reading", "_budget", "_next")
}

CELLS = Path(__file__).parents[2] / "config/cells"
PAGES = Path(__file__).parents[2] / "docs/start"


def new(*options):
    return main(["plan", "new", "-o", "plan.yaml", *options])


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch, jumping_clocks):
    monkeypatch.chdir(tmp_path)
    for name, known in ONCE.items():
        monkeypatch.setattr(plan_new, name, known)


@pytest.mark.parametrize(
    ("options", "minutes"),
    [([*STAGE, "--lines", "8"], "26"), (CAMERA, "18")],
    ids=["lines", "camera"],
)
def test_its_plan_is_checked_drawn_and_measured(options, minutes, capsys):
    assert new(*options, "--minutes", minutes, "--json") == 0
    promised = json.loads(capsys.readouterr().out)
    assert main(["plan", "check", "plan.yaml", "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert promised["U_xy"] == pytest.approx(checked["budget"]["U_xy"])
    assert main(["plate", "plan.yaml", "-o", "plate.svg"]) == 0
    capsys.readouterr()
    assert (
        main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--json"]) == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert len(result["views"]) == len(promised["views"]) * (
        3 if options is CAMERA else 1
    )
    assert all(view["rejected"] == 0 for view in result["views"])


def test_a_short_plate_is_stepped_over_a_long_stage(capsys):
    """The map reaches the ends of the travel; it is determined, and all views are measured."""
    long = ["--travel", "100x60mm", "--marks", "5", "--pitch", "10mm"]
    assert new(*long, "--minutes", "8", "--placing", "robot") == 0
    said = capsys.readouterr().out
    assert "the map covers 40 x 40 of 100 x 60 mm" in said
    assert "a plate that grows by 0.07 µm/m (k = 1)" in said
    minutes = re.search(r"all of the travel takes --minutes (\d+)", said)[1]

    assert new(*long, "--minutes", minutes, "--placing", "robot", "--force") == 0
    said = capsys.readouterr().out
    assert "the map covers 98 x 40 of 100 x 60 mm" in said
    assert main(["plan", "check", "plan.yaml", "--json"]) == 0
    checked = json.loads(capsys.readouterr().out)
    assert checked["unknown_sites"] == 0 and not checked["nodes_untested"]
    assert (
        main(["measure", "plan.yaml", "cell.yaml", "-o", "bag", "--yes", "--json"]) == 0
    )
    result = json.loads(capsys.readouterr().out)
    assert all(view["used"] and not view["rejected"] for view in result["views"])


@pytest.mark.parametrize(
    ("travel", "minutes", "line"),
    [
        ("1m", "20", "placed more than 1000 times: take a longer plate"),
        ("59mm", "20", None),
    ],
    ids=["too short a plate", "hardly longer"],
)
def test_a_map_of_the_plate_alone_says_why(travel, minutes, line, capsys):
    options = ["--marks", "5", "--pitch", "10mm", "--minutes", minutes]
    if travel == "1m":
        options[1], options[3] = "3", "1mm"
    assert new("--travel", travel, *options) == 0
    said = capsys.readouterr().out
    assert line in said if line else "all of the travel" not in said
    assert new("--travel", travel, *options, "--force", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert line in found["why_not_wider"] if line else found["why_not_wider"] is None
    plate = 0.002 if travel == "1m" else 0.04
    assert found["covers"] == pytest.approx([plate, plate])


def test_on_a_full_disk_none_of_its_files_is_left(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(plan_new, "_cell_text", lambda *_: "#" * 20_000)
    with files_no_larger_than(10_000):
        assert new(*STAGE, "--minutes", "20") == 2
    assert capsys.readouterr().err == (
        "selfcal plan new: cell.yaml: cannot be written (File too large); "
        "free some space or name another folder\n"
    )
    assert not list(tmp_path.iterdir())


def test_a_camera_shows_an_odd_number_of_marks():
    assert new(*CAMERA, "--minutes", "18") == 0
    assert read_yaml("plan.yaml")["image"] == {"nx": 3, "ny": 1, "pitch_m": 2e-4}


def test_the_time_is_kept_and_used(capsys):
    """More time gives a smaller U; the exposures are counted by hand."""
    found = {}
    for minutes in ("20", "30"):
        assert new(*STAGE, "--minutes", minutes, "--json") == 0
        found[minutes] = json.loads(capsys.readouterr().out)
        assert found[minutes]["minutes"] <= float(minutes)
        for name in ("plan.yaml", "cell.yaml", "cell_simulation.yaml"):
            Path(name).unlink()
    assert found["30"]["U_xy"] < 0.8 * found["20"]["U_xy"]
    views = found["20"]["views"]
    marks = sum(
        view["repeats"] * (25 - 5 * any(view["translation_pitch"])) for view in views
    )
    # 5 marks from four sides
    assert found["20"]["exposures"] == marks + 20 * len(views)
    assert found["20"]["minutes"] == pytest.approx(
        5 * len(views) + found["20"]["exposures"] * 2 / 60
    )


@pytest.mark.parametrize("machine", SHIPPED)
def test_the_cell_of_every_machine_can_be_read(machine):
    assert machine in {"simulated", *plan_new.OWN_KEYS}, (
        "add its keys to OWN_KEYS of cli/plan_new.py"
    )
    assert new(*STAGE, "--minutes", "30", "--machine", machine) == 0
    cell = read_cell("cell.yaml")
    assert cell.machine == machine and cell.limits["x"] == (-0.025, 0.025)
    assert cell.placing == ("robot" if machine == "simulated" else "person")
    assert read_plan("plan.yaml").plan_id == "plan"
    shipped = {path: read_yaml(path) for path in CELLS.glob("*.yaml")}
    own = {
        path: data[machine]
        for path, data in shipped.items()
        if data["machine"] == machine
    }
    assert own, f"add an example with `machine: {machine}` to config/cells"
    written = read_yaml("cell.yaml")[machine]
    assert written.keys() <= next(iter(own.values())).keys()
    module, _, name = SHIPPED[machine].partition(":")
    arguments = signature(getattr(import_module(module), name)).parameters.values()
    needed = {item.name for item in arguments if item.default is item.empty}
    assert needed - {FOLDER} <= written.keys()
    pages = "".join(page.read_text() for page in PAGES.glob("machine*.md"))
    assert any(f"config/cells/{path.name}" in pages for path in own), (
        f"describe it in docs/start/machine_{machine}.md and link that from machines.md"
    )


def test_a_machine_of_another_package_has_its_cell(tmp_path, monkeypatch):
    folder = tmp_path / "my_package-1.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: my_package\n")
    (folder / "entry_points.txt").write_text(
        "[selfcal.machines]\nbench = my_package:Bench\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert new(*STAGE, "--minutes", "30", "--machine", "bench") == 0
    assert (read_cell("cell.yaml").machine, read_yaml("cell.yaml")["bench"]) == (
        "bench",
        {},
    )


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (
            [*STAGE, "--travel", "40mm"],
            "40 mm along x, and 5 marks with their check stops need 40.04 mm; take 4 marks",
        ),
        ([*STAGE, "--travel", "60x30mm"], "30 mm along y"),
        (
            [*STAGE, "--minutes", "3"],
            "the shortest plan takes 20: 3 placings of 5 minutes",
        ),
        ([*STAGE, "--lines", "8", "--field", "30mm"], "lines are not found in images"),
        (
            [*STAGE, "--lines", "8", "--machine", "gcode"],
            "gcode has nothing but a camera",
        ),
        ([*STAGE, "--pitch", "10"], "'10' has no unit; write for example 10mm"),
        (
            [*STAGE, "--pitch", "1cm"],
            "'1cm' is not a positive length; write a number with",
        ),
        ([*STAGE, "--travel", "50x40x5mm"], "'40x5mm' is not a positive length"),
        ([*STAGE, "--marks", "2"], "is not a number from 3"),
        ([*STAGE, "--marks", "٧"], "'٧' is not a whole number"),
        (["--marks", "5"], "--travel: is missing, and there is nobody to ask"),
        ([*STAGE, "--placing", "dog"], "person, robot"),
    ],
)
def test_what_cannot_work_is_refused_in_a_line(options, line, capsys):
    assert new(*options) == 2
    err = capsys.readouterr().err
    assert line in err and err.count("\n") == 1
    assert not Path("plan.yaml").exists()


def test_nothing_is_overwritten(capsys):
    Path("cell.yaml").write_text("mine")
    assert new(*STAGE) == 2
    assert "cell.yaml: the file exists" in capsys.readouterr().err
    assert Path("cell.yaml").read_text() == "mine"
    assert new(*STAGE, "--minutes", "30", "--force") == 0
    assert Path("cell.yaml").read_text().startswith("# From `selfcal plan new`.")


def test_a_cell_that_another_command_wrote_meanwhile_stays(monkeypatch, capsys):
    def written_meanwhile(plan):
        Path("cell.yaml").write_text("theirs")
        return ONCE["_budget"](plan)

    monkeypatch.setattr(plan_new, "_budget", written_meanwhile)
    assert new(*STAGE) == 2
    assert "cell.yaml: was written by another command" in capsys.readouterr().err
    assert Path("cell.yaml").read_text() == "theirs"
    assert not Path("plan.yaml").exists()


def test_a_person_is_asked_in_a_terminal(tmp_path):
    answers = b"fifty\n\n50mm\n5\n10mm\n\n\n\nrobot\n4\n1\n"
    code, said = in_terminal(
        [*SELFCAL, "plan", "new", "-o", "plan.yaml"], folder=tmp_path, keys=answers
    )
    assert code == 0, said
    assert (
        "'fifty' is not a positive length; write a number with m, mm, um" in said
        and "it identifies the stage" in said
    )
    assert "placings of 0.5 minutes" in said and "exposures of 1 s" in said


@pytest.mark.parametrize(
    ("answers", "not_asked"),
    [
        ("50mm 5 10mm gcode none robot 4 1", "angular lines"),
        ("50mm 5 10mm simulated 8 robot 9 1", "what the camera sees"),
        ("30mm 5 10mm", "what is driven"),
    ],
    ids=["a camera finds no lines", "lines without a camera", "too long a plate"],
)
def test_what_is_settled_is_not_asked(answers, not_asked, monkeypatch, capsys):
    """Of a plate that does not fit the rest is not asked: its answers would be lost."""
    given = iter(answers.split())
    monkeypatch.setattr("builtins.input", lambda: next(given))
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    nothing = Namespace(**{item.name: None for item in plan_new.QUESTIONS})
    try:
        known = plan_new._answers(nothing)
    except InputError as error:
        assert "30 mm along x" in str(error) and "take 3 marks" in str(error)
    else:
        assert known.machine == "gcode" or known.lines == 8
    assert not_asked not in capsys.readouterr().err and not list(given)
