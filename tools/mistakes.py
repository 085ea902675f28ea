# SPDX-License-Identifier: Apache-2.0
"""`make mistakes`: what newcomers type wrong, and whether one line names the remedy.

Each mistake is a command with its exit code and a part of the line on stderr; no other line may
stand there.
"""

import contextlib
import io
import os
import re
import shlex
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from selfcal_ros.cli.main import main as selfcal

ROOT = Path(__file__).parents[1]
LEFT_OF_FILE = 400
"""Characters of a file that was cut off while it was copied."""

PLAN = """plan_id: mine
artifact: {grid_size: 5, grid_pitch: 0.01, angular_count: 0}
views:
  - {name: a}
  - {name: b, rotation_deg: 90}
  - {name: c, translation_pitch: [1, 0]}
"""
PLANS = {
    "indent": PLAN.replace("  - {name: b", " - {name: b"),
    "tab": PLAN.replace("  - {name: a}", "\t- {name: a}"),
    "pitch_mm": PLAN.replace("grid_pitch: 0.01", "grid_pitch: 10"),
    "even": PLAN.replace("grid_size: 5", "grid_size: five"),
    "two_a": PLAN.replace("name: b", "name: a"),
    "no_views": PLAN.partition("views:")[0],
    "misspelt": PLAN.replace("rotation_deg", "rotation_degrees"),
    "radians": PLAN.replace("rotation_deg: 90", "rotation_rad: 1.5708"),
    "turn_rad": PLAN.replace("rotation_deg: 90", "rotation_deg: 1.5708"),
    "comma": PLAN.replace("0.01", "0,01"),
    "zero": PLAN.replace("{name: a}", "{name: a, repeats: 0}"),
    "tiny": PLAN.replace("grid_size: 5", "grid_size: 2"),
    "huge": PLAN.replace("grid_size: 5", "grid_size: 4001"),
    "negative": PLAN.replace("grid_pitch: 0.01", "grid_pitch: -0.01"),
    "half": PLAN.replace("[1, 0]", "[1]"),
    "um": PLAN.replace("0.01", "10000"),
    "quoted": PLAN.replace("0.01", "'0,01'"),
    "unit": PLAN.replace("0.01", "10mm"),
    "term": PLAN + "model_terms: drift\n",
    "twice": PLAN + "views: []\n",
    "list": "- a\n- b\n",
    "empty": "",
}
"""Name of a plan -> its text, each with one mistake."""
TABLES = {
    "semicolons": "x;y\n0;0\n",
    "decimal": "x;y\n0,01;0,02\n",
    "mm": "x,y\n10,20\n30,40\n",
    "headless": "0,0\n0.01,0\n",
    "other": "east,north\n0,0\n",
    "text": "x,y\n0,left\n",
    "short": "x,y\n0\n",
    "none": "",
    "nan": "x,y\n0,nan\n",
    "degrees": "x,y,theta\n0,0,45\n",
}
CELLS = {
    "machine": "machine: simulatd\nsimulatd: {}\n",
    "limits_mm": "machine: simulated\nlimits: {x: [-60, 60], y: [-60, 60]}\n",
    "falling": "machine: simulated\nlimits: {x: [0.1, -0.1], y: [-0.1, 0.1]}\n",
}
"""Name of a CELL.yaml -> its text, each with one mistake."""


class Mistake(NamedTuple):
    """A command, its exit code, and what its line says (a regular expression)."""

    command: str
    code: int
    says: str


MISTAKES = [
    Mistake(*row)
    for row in (
        # verbs and options
        ("slove bags/demo", 2, "did you mean 'solve'"),
        ("calibrate bags/demo", 2, "'calibrate' is unknown; "),
        ("solve", 2, "BAG is missing; see selfcal solve --help"),
        (
            "solve bags/demo bags/hu_exact",
            2,
            "'bags/hu_exact' is one argument too many",
        ),
        ("solve bags/demo --ouput r.json", 2, "did you mean '--output'"),
        (
            "solve bags/demo --method least_squares",
            2,
            "'least_squares' is unknown; known are joint",
        ),
        ("solve bags/demo --theta-datum zeromean", 2, "did you mean 'zero_mean'"),
        ("solve bags/demo --sense plate", 2, "'plate' is unknown; "),
        ("solve bags/demo -o", 2, "-o/--output: expected one argument"),
        ("solve --output r.json", 2, "BAG is missing"),
        ("plan", 2, "new|check|suggest.* is missing"),
        ("plan config/plans/hu.yaml", 2, "'config/plans/hu.yaml' is a file, and "),
        ("plan chek config/plans/hu.yaml", 2, "did you mean 'check'"),
        ("cal", 2, "WHAT is missing: one of "),
        ("call go", 2, "'go' is unknown; known are start, confirm"),
        ("reproduce", 2, "hu, qiao|is missing"),
        ("report", 2, "RESULT.json is missing"),
        ("plan check config/plans/hu.yaml --sigma 20furlong", 2, "20furlong"),
        ("plan check config/plans/hu.yaml --sigma -5nm", 2, "sigma"),
        (
            "plan check config/plans/hu.yaml --sigma 20",
            2,
            "'20' is 20 m, .* one of m, mm, um, nm",
        ),
        (
            "plan check config/plans/hu.yaml --placing 90",
            2,
            "'90' is 90 rad, .* one of rad, .*deg",
        ),
        (
            "detect bags/camera -o marks --pixel-size 6um",
            2,
            "'6um' is not a number; .* a unit",
        ),
        (
            "plan check config/plans/hu.yaml --repeats 0",
            2,
            "--repeats: 0 is not positive",
        ),
        ("plan check config/plans/hu.yaml --repeats many", 2, "'many'"),
        # files that are not there, or of another kind
        ("solve no_such_bag", 2, "no_such_bag: no such file or folder; check the path"),
        ("solve bags", 2, r"bags: no \.mcap file in this folder"),
        (
            "solve R.json",
            2,
            "is a result, and a bag is needed here; `selfcal report R.json`",
        ),
        ("solve config/plans/hu.yaml", 2, "is a plan, and a bag is needed here"),
        ("solve points.csv", 2, "is a table of numbers, and a bag is needed here"),
        ("solve cut.mcap", 2, "cut.mcap"),
        ("solve bags/demo -o no/where/r.json", 2, "name an existing, writable folder"),
        (
            "solve bags/demo -o R.json",
            2,
            "the file exists; name another file, or .* --force",
        ),
        (
            "solve bags/demo -o result.csv",
            2,
            "RESULT.json is written .* end the name in .json",
        ),
        ("report newer.json", 2, "not a result of schema selfcal.result/1"),
        ("gcode none.nc R.json -o o.nc --dialect grbl", 2, "the file is empty"),
        ("solve bags/demo -o bags", 2, "bags: it is a folder; name a file"),
        ("report no.json", 2, "no.json: no such file; check the path"),
        (
            "report bags/demo",
            2,
            "a map is computed from it with `selfcal solve bags/demo",
        ),
        ("report config/plans/hu.yaml", 2, "is a plan, and a result is needed here"),
        (
            "report bags/demo/truth.json",
            2,
            "not a result.*RESULT.json that `selfcal solve` wrote",
        ),
        ("report cut.json", 2, "cut.json:"),
        ("report R.json -o report.docx", 2, "report.docx: .*html"),
        ("plot R.json -o map.gif", 2, "name a file that ends in .png, .svg or .pdf"),
        ("plot R.json", 2, "-o or --output is missing"),
        ("table R.json -o map.xlsx", 2, "name a file that ends in .csv or .npz"),
        ("table bags/demo -o t.csv", 2, "is a bag, and a result is needed here"),
        ("diff R.json", 2, "B.json is missing"),
        ("diff R.json bags/demo", 2, "is a bag, and a result is needed here"),
        ("diff R.json small.json", 2, "small.json"),
        ("plan check R.json", 2, "is a result, and a plan is needed here"),
        (
            "plan check config/simulations/demo.yaml",
            2,
            "`selfcal simulate config/.* writes its bag",
        ),
        ("plan check config/params/cell.yaml", 2, "give it with --params"),
        ("plan check bags/demo", 2, "is a bag, and a plan is needed here"),
        (
            "simulate config/plans/hu.yaml -o b",
            2,
            "is a plan, and a simulation is needed here",
        ),
        (
            "simulate config/simulations/demo.yaml -o bags/demo",
            2,
            "bags/demo: exists already",
        ),
        ("simulate config/simulations/demo.yaml", 2, "-o or --output is missing"),
        (
            "solve bags/demo --params config/plans/hu.yaml",
            2,
            "a parameter file of nodes is needed",
        ),
        ("solve bags/demo --params no.yaml", 2, "no.yaml: no such file"),
        # arguments that are swapped
        (
            "apply points.csv R.json -o o.csv",
            2,
            "swapped; write `selfcal apply R.json points.csv",
        ),
        (
            "recheck bags/demo R.json",
            2,
            "swapped; write `selfcal recheck R.json bags/demo`",
        ),
        (
            "gcode R.json part.nc -o o.nc --dialect linuxcnc",
            2,
            "swapped; write `selfcal gcode part",
        ),
        (
            "cal verify stage.cal R.json",
            2,
            "swapped; write `selfcal cal verify R.json stage.cal`",
        ),
        (
            "measure config/cells/simulated.yaml mine.yaml -o m",
            2,
            "swapped; write `selfcal measure mine.yaml config/cells/simulated.yaml -o m`",
        ),
        ("cell try mine.yaml", 2, "is a plan, and a cell is needed here"),
        (
            "measure mine.yaml machine.cell.yaml -o m --yes",
            2,
            "did you mean 'simulated'",
        ),
        (
            "measure mine.yaml limits_mm.cell.yaml -o m --yes",
            2,
            "limits: x: .* is it in mm",
        ),
        ("measure mine.yaml falling.cell.yaml -o m --yes", 2, "two rising numbers"),
        ("export R.json siemens -o t.ini --unit mm", 2, "'R.json' is a file, and "),
        (
            "certificate config/certificates/details.yaml R.json -o c.xml",
            2,
            "details.yaml",
        ),
        # plans
        *(
            (f"plan check {name}.yaml", code, says)
            for name, code, says in (
                ("indent", 2, r"indent.yaml:\d+:\d+"),
                ("tab", 2, r"tab.yaml:4:\d+.*tab|\\t"),
                ("pitch_mm", 2, "pitch.*10.*(mm|m)"),
                ("even", 2, "grid_size.*'five'"),
                ("two_a", 2, "two_a.yaml: .*'a'"),
                ("no_views", 2, "no_views.yaml: .*views"),
                (
                    "misspelt",
                    2,
                    "rotation_degrees: unknown key; did you mean 'rotation_deg'",
                ),
                ("radians", 2, "rotation_rad: .*rotation_deg"),
                ("turn_rad", 2, "is it in rad.*give 90"),
                ("comma", 2, "comma.yaml"),
                ("zero", 2, "repeats.*0"),
                ("tiny", 2, "grid_size.*2"),
                ("huge", 2, "grid_size.*4001|401"),
                ("negative", 2, "grid_pitch.*-0.01"),
                ("half", 2, "translation_pitch"),
                ("um", 2, "is it in µm"),
                ("quoted", 2, "write 0.01, with a decimal point"),
                ("unit", 2, "without a unit"),
                ("term", 2, r"write \[drift\]"),
                ("twice", 2, "'views' is given twice"),
                ("list", 2, "list.yaml"),
                ("empty", 2, "empty.yaml"),
                ("no", 2, "no such file"),
            )
        ),
        # measurements that do not determine the stage, images, other faults of a recording
        ("solve bags/deficient", 3, r"shifted by \+1 pitch along X"),
        ("solve bags/camera", 4, "selfcal detect"),
        ("solve bags/demo --model plate", 2, "plate"),
        ("solve bags/demo --model drift:fast", 2, "drift:fast|'fast'"),
        (
            "solve bags/demo --reference artifact",
            2,
            "is not KIND:ERROR:U; write e.g. artifact:",
        ),
        ("solve bags/demo --certificate PTB", 2, "name the length with --reference"),
        ("solve bags/demo --microscope 1:2:3:4", 2, "--microscope"),
        ("solve bags/demo --map big", 2, "--map"),
        ("solve bags/demo --namespace cell9", 4, "cell9|namespace"),
        # tables of numbers
        *(
            (f"apply R.json {name}.csv -o o.csv", 2, says)
            for name, says in (
                ("semicolons", "semicolons"),
                ("decimal", "semicolons"),
                ("mm", "is it in mm"),
                ("headless", "headless.csv:1"),
                ("other", "other.csv:1.*x"),
                ("text", "text.csv:2"),
                ("short", "short.csv:2"),
                ("none", "none.csv"),
                ("nan", "nan.csv:2"),
                ("degrees", "is it in degrees"),
            )
        ),
        ("apply R.json no.csv -o o.csv", 2, "no.csv: no such file"),
        # controllers
        (
            "export heidenhain R.json -o t.txt --unit mm",
            2,
            "'heidenhain' is unknown; known are ",
        ),
        ("export siemens R.json --unit mm", 2, "-o or --output is missing"),
        ("export siemens R.json -o t.ini --unit inch", 2, "'inch' is unknown; "),
        ("cal export R.json -o s.cal --x-axis 1 --y-axis 1", 2, "axis"),
        ("cal export R.json -o s.cal --x-axis X", 2, "--x-axis: .*'X'"),
        ("cal eval stage.cal --position 1", 2, "--position"),
        ("cal eval stage.cal --position 1=ten", 2, "'ten'"),
        (
            "cal eval stage.cal --position 1=10,5",
            2,
            "'10,5' is not a number; .* 1=10.5",
        ),
        ("cal check R.json", 2, "is a result, and a calibration file is needed here"),
        ("cal check no.cal", 2, "no.cal: no such file"),
        ("gcode part.nc R.json -o o.nc", 2, "dialect"),
        ("certificate R.json no.yaml -o c.xml", 2, "no.yaml: no such file"),
        ("detect bags/camera -o marks", 2, "--pixel-size and --mark-size"),
        ("detect bags/demo -o marks --pixel-size 6e-6 --mark-size 72e-6", 4, "image"),
        (
            "detect bags/camera -o marks --pixel-size 6 --mark-size 72",
            2,
            "--pixel-size: 6.0 is outside 0.0 to 1.0 m",
        ),
        (
            "camera init bags/demo -o n.yaml --mark-size 72e-6 --mark-pixels 12",
            4,
            "image",
        ),
        ("step-diagonal points.csv --method new", 2, "the column 'block' is missing"),
        ("batch no_folder -o out", 2, "no_folder: no such file or folder"),
        ("batch config -o out", 4, "no bag in it"),
        ("combine R.json -o mean.json", 2, "combine"),
    )
]


@contextlib.contextmanager
def desk() -> Iterator[Path]:
    """Go to a folder with what the repository has, a result, and faulty files."""
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for part in ("bags", "config"):
            (folder / part).symlink_to(ROOT / part)
        os.chdir(folder)
        try:
            _furnish(folder)
            yield folder
        finally:
            os.chdir(before)


def _furnish(folder: Path) -> None:
    """Write the files that the commands name."""
    _run(["solve", "bags/demo", "--quiet", "-o", "R.json"])
    _run(["cal", "export", "R.json", "-o", "stage.cal"])
    for plan, text in PLANS.items():
        (folder / f"{plan}.yaml").write_text(text)
    for cell, text in CELLS.items():
        (folder / f"{cell}.cell.yaml").write_text(text)
    for table, text in TABLES.items():
        (folder / f"{table}.csv").write_text(text)
    (folder / "points.csv").write_text("x,y\n0,0\n")
    (folder / "none.nc").touch()
    (folder / "part.nc").write_text("G21 G90\nG0 X0 Y0\n")
    (folder / "cut.json").write_text((folder / "R.json").read_text()[:LEFT_OF_FILE])
    (folder / "newer.json").write_text(
        (folder / "R.json")
        .read_text()
        .replace("selfcal.result/1", "selfcal.result/2", 1)
    )
    bag = next((ROOT / "bags/demo").glob("*.mcap")).read_bytes()
    (folder / "cut.mcap").write_bytes(bag[:6])
    (folder / "mine.yaml").write_text(PLAN)
    (folder / "small.sim.yaml").write_text("plan: mine.yaml\nseed: 1\n")
    _run(["simulate", "small.sim.yaml", "-o", "small"])
    _run(["solve", "small", "--quiet", "-o", "small.json"])


def _run(words: list[str]) -> tuple[int, str]:
    """Return exit code and stderr of a command."""
    errors = io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(errors):
        try:
            code = selfcal(words)
        except SystemExit as ended:
            code = int(ended.code or 0)
    return code, errors.getvalue()


def wrong() -> list[str]:
    """Return what is not as expected: a line a mistake."""
    found = []
    with desk():
        for mistake in MISTAKES:
            code, said = _run(shlex.split(mistake.command))
            lines = said.splitlines()
            if (code, len(lines)) != (mistake.code, 1) or not re.search(
                mistake.says, lines[0]
            ):
                found.append(
                    f"selfcal {mistake.command}: code {code}, not {mistake.code}; "
                    f"{len(lines)} lines: {said.strip()!r}"
                )
    return found


def main() -> int:
    """Print what is wrong, and how many are right."""
    lines = wrong()
    print(*lines, sep="\n", end="\n" * bool(lines))
    print(
        f"{len(MISTAKES) - len(lines)} of {len(MISTAKES)} mistakes get one line with the remedy "
        "and the documented exit code"
    )
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
