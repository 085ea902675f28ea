# SPDX-License-Identifier: Apache-2.0
"""``--onto``: the table that replaces an active one, on machines that read the text themselves."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.cli.main import main
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from test.support.machines import READERS, Machine, cal
from test.support.maps import random_map, result_of

PLATE = Artifact(5, 0.01, 0, 7)
G = random_map(PLATE, 8, gain=20.0)


OLD = """; nodes of its own, some um
:START2D {row} {column} {column} {row} 14 -13 4
:START2D POSUNIT=PRIMARY
:START2D CORUNIT=PRIMARY/1000
:START2D OFFSETROW=31
:START2D OFFSETCOL=-20
 3.1 -2.0  0.4 1.5  -2.6 2.2  1.0 -3.0
-1.2  2.7  2.9 0.3   1.1 -1.8 -2.4 0.9
 0.5 -0.6 -3.0 2.8   2.0  1.4  0.2 -2.2
-2.1  1.9  1.3 -2.5 -0.7  0.8  2.6 1.2
 1.6  0.1 -0.9 3.0   2.3 -1.1 -1.7 2.4
:END
"""


def machine_of(options, **kwargs):
    """Return the machine with the error G that is wired as the options say."""
    given = dict(re.findall(r"--(home-\w|unit) (\S+)", options))
    unit_m = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "in": 0.0254}[given.get("unit", "mm")]
    nodes = [half * np.linspace(-1, 1, n) for half, n in ((0.02, 5), (0.03, 7))]
    return Machine(
        nodes,
        np.stack([kwargs["emap"].gx, kwargs["emap"].gy]),
        [float(given.get(f"home-{axis}", 0)) * unit_m for axis in "xy"],
        [-1 if f"--reverse-{axis}" in options else 1 for axis in "xy"],
        unit_m,
    )


def measured(machine, table):
    """Write what a calibration finds while a table is active, without noise."""
    points = np.stack(np.meshgrid(*machine.nodes, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    gx, gy = (machine.shown(points, table) - points).T.reshape(2, *PLATE.shape)
    write_json("R.json", result_to_dict(result_of(replace(G, gx=gx, gy=gy))))


@pytest.mark.parametrize(
    "options",
    [
        "",
        "--home-x -10 --home-y 20",
        "--reverse-x",
        "--reverse-y --home-x 10 --x-axis 3 --y-axis 1",
    ],
)
def test_cal_export_replaces_the_active_table(tmp_path, monkeypatch, capsys, options):
    """Noise-free: what is left at the nodes is the rounding of 0.01 nm, of x, y and home."""
    monkeypatch.chdir(tmp_path)
    column, row = (3, 1) if "axis" in options else (1, 2)
    text, machine = OLD.format(row=row, column=column), machine_of(options, emap=G)
    Path("old.cal").write_text(text)
    old = cal([text], None)
    measured(machine, old)
    words = f"R.json -o new.cal --onto old.cal {options}".split()
    assert main(["cal", "export", *words]) == 0
    assert "is curved between the nodes" in capsys.readouterr().err
    text = Path("new.cal").read_text()
    new = cal([text], None)
    assert f":START2D {row} {column} {column} {row} " in text
    assert machine.off(old) > 1e-6  # the stage as it was calibrated
    assert machine.off(new) < 2e-11
    assert machine.off(new, sense=-1) > 1e-6
    wrong = "--reverse-y" if "--reverse-y" not in options else "--home-y 1"
    assert main(["cal", "export", *words, *wrong.split(), "--force"]) == 0
    assert machine.off(cal([Path("new.cal").read_text()], None)) > 1e-7


def sayable(name, emap):
    """Return the part of a map that a format can hold."""
    gx, gy = emap.gx, emap.gy
    if name == "siemens":
        gx, gy = (g[:, :1] + g[:1] - g[0, 0] for g in (gx, gy))
    if name == "linuxcnc":
        gx, gy = gx[:, :1] + 0 * gx, gy[:1] + 0 * gy
    return replace(emap, gx=gx, gy=gy)


WIRED = [
    "",
    "--home-x {-10} --home-y {20} --reverse-x",
    "--reverse-y --home-x {10}",
    "--home-x {5} --reverse-x --reverse-y",
    "--x-axis 3 --y-axis 1 --home-y {-15}",
]
"""Lengths in braces are mm."""
ACTIVE = {
    "of the same nodes": (Artifact(5, 0.01, 0, 7), ""),
    "of a finer pitch": (Artifact(13, 0.005, 0, 17), ""),
    "of a wider field": (Artifact(5, 0.0175, 0, 7), ""),
    "of a part of the field": (Artifact(3, 0.0125, 0, 5), ""),
    "of another origin": (Artifact(7, 0.01, 0, 9), "--home-x {2} --home-y {-3.5}"),
}


PAIRS = [
    (w, a)
    for w in range(len(WIRED))
    for a, _ in enumerate(ACTIVE)
    if (w + 2 * a) % 5 < 2
]
"""Each wiring with two of the tables, each table with two of the wirings."""


def options_of(text, unit):
    """Return options with their lengths in a unit."""
    per = {"m": 1e3, "mm": 1.0, "um": 1e-3, "in": 25.4}[unit]
    return re.sub(r"\{(\S+)\}", lambda m: f"{float(m[1]) / per:.15g}", text)


@pytest.mark.parametrize(("wired", "active"), PAIRS)
@pytest.mark.parametrize("name", READERS)
def test_a_replaced_table_leaves_the_rounding_of_its_digits(
    tmp_path, monkeypatch, capsys, name, wired, active
):
    """Measured with a table active, whatever its nodes; at the nodes of the map and between."""
    monkeypatch.chdir(tmp_path)
    units = ["mm", "um", "m", *(["in"] if name != "cal" else [])]
    unit = units[(wired + active) % len(units)]
    plate, *texts = (
        [*ACTIVE.values()][active][0],
        WIRED[wired],
        [*ACTIVE.values()][active][1],
    )
    options, moved = (options_of(text, unit) for text in texts)
    options += f" --unit {unit}"
    machine = machine_of(options, emap=sayable(name, G))
    counts = [2e6 * machine.unit_m / 1e-3] * 2
    if name == "pmac":
        options += "".join(
            f" --counts-per-unit {axis}={counts[0]!r}"
            for axis in ((3, 1) if "axis" in options else (1, 2))
        )
    subtract = (
        {"subtract": True} if name in ("beckhoff", "siemens") and wired % 2 else {}
    )
    more = [*options.split(), *(["--negate"] if subtract else [])]
    verb = ["cal", "export"] if name == "cal" else ["export", name]

    def machine_s(file):
        files = sorted(Path().glob(f"{file}*.txt"))
        unit = {"unit_m": machine.unit_m} if name == "beckhoff" else {}
        return [str(path) for path in files], READERS[name](
            [path.read_text() for path in files], counts, **unit, **subtract
        )

    write_json(
        "Old.json",
        result_to_dict(result_of(sayable(name, random_map(plate, 5, gain=20)))),
    )
    assert main([*verb, "Old.json", "-o", "old.txt", *more, *moved.split()]) == 0
    files, old = machine_s("old")
    measured(machine, old)
    before = machine.off(old)
    assert before > 1e-6
    assert main([*verb, "R.json", "-o", "new.txt", "--onto", *files, *more]) == 0
    _, new = machine_s("new")
    bound = 8e-11 if name == "pmac" else 3e-11
    assert machine.off(new) < bound
    assert machine.off(new, between=True) < bound
    assert machine.off(new, sense=-1) > 1e-6
    assert main([*verb, "R.json", "-o", "alone.txt", *more]) == 0
    # what the old one corrected is lost
    assert machine.off(machine_s("alone")[1]) > 1e-6
    capsys.readouterr()


@pytest.mark.parametrize("verb", [["export", "kmotion"], ["cal", "export"]])
def test_a_table_that_does_not_fit_is_refused_as_such(
    tmp_path, monkeypatch, capsys, verb
):
    """Of KMotion beyond a field of 40 um; of .cal with a wrong unit of corrections."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(random_map(Artifact(5, 0.01), 3))))
    write_json(
        "S.json", result_to_dict(result_of(random_map(Artifact(5, 1e-5), 4, gain=0.5)))
    )
    assert (
        main(
            [
                *verb,
                "S.json",
                "-o",
                "small",
                *(["--unit", "mm"] if "kmotion" in verb else []),
            ]
        )
        == 0
    )
    if "cal" in verb:
        text = Path("small").read_text().replace("PRIMARY/1000", "PRIMARY/0.01")
        Path("small").write_text(
            text.replace("2D 2 1 1 2 0.01 0.01", "2D 2 1 1 2 10 10")
        )
    capsys.readouterr()
    assert (
        main(
            [
                *verb,
                "R.json",
                "-o",
                "new",
                "--onto",
                "small",
                *(["--unit", "mm"] if "kmotion" in verb else []),
            ]
        )
        == 2
    )
    where = (
        "the active table covers only part of the field: x from -0.02 to 0.02, y from "
        "-0.02 to 0.02 mm, the map x from -20 to 20, y from -20 to 20; beyond it the table "
        if "kmotion" in verb
        else "the active table "
    )
    mend = (
        "name the table of this stage, in this unit (--unit)"
        if "kmotion" in verb
        else "is it that of this stage, in this unit?"
    )
    assert re.fullmatch(
        rf"selfcal (cal export|export): --onto: {re.escape(where)}changes by up to "
        rf"[\d.e+]+ mm between "
        rf"neighbouring sites 10 mm apart; {re.escape(mend)}\n",
        capsys.readouterr().err,
    )
    assert not Path("new").exists()


@pytest.mark.parametrize(
    ("verb", "old", "new", "where"),
    [
        ("export kmotion", "--unit in", "--unit mm", "old.txt: it says 'machine: "),
        ("export kmotion", "", "--reverse-y", "old.txt: it says 'machine: "),
        ("cal export", "--reverse-x", "", "old.txt: it says 'machine: "),
        ("export beckhoff", "--x-axis 3", "", "old_x.txt: it says 'machine: "),
        ("export siemens", "--negate", "", "old.txt: it says 'this table: subtracted'"),
        (
            "export pmac",
            "--counts-per-unit 1=2000 --counts-per-unit 2=2000",
            "--counts-per-unit 1=2000 --counts-per-unit 2=4000",
            "old.txt: it says 'this table: counts per unit 2000 and 2000'",
        ),
    ],
)
def test_an_active_table_that_states_another_wiring_is_refused(
    tmp_path, monkeypatch, capsys, verb, old, new, where
):
    """Read with the wrong options it was added where the machine has other errors."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(G)))
    words = [*verb.split(), "R.json", "-o"]
    assert main([*words, "old.txt", *old.split()]) == 0
    files = sorted(str(path) for path in Path().glob("old*.txt"))
    capsys.readouterr()
    assert main([*words, "new.txt", *new.split(), "--onto", *files]) == 2
    err = capsys.readouterr().err
    assert f": {where}" in err and err.count("\n") == 1
    assert not list(Path().glob("new*.txt"))
    assert main([*words, "new.txt", *old.split(), "--onto", *files]) == 0
    assert "--onto" not in capsys.readouterr().err


def test_files_of_x_and_y_are_not_exchanged(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(sayable("linuxcnc", G))))
    words = ["export", "linuxcnc", "R.json", "-o"]
    assert main([*words, "old.txt"]) == 0
    assert main([*words, "new.txt", "--onto", "old_y.txt", "old_x.txt"]) == 2
    err = capsys.readouterr().err
    assert "old_y.txt: it says 'this table: the file of y'" in err
    assert "; name the file of x first\n" in err
    text = Path("old_y.txt").read_text()
    Path("old_y.txt").write_text(text.replace("x-axis=1", "x-axis=3"))
    assert main([*words, "new.txt", "--onto", "old_x.txt", "old_y.txt"]) == 2
    assert "old_y.txt: it says 'machine: x-axis=3" in capsys.readouterr().err


def test_a_table_that_was_written_in_the_wrong_sense_is_replaced(
    tmp_path, monkeypatch, capsys
):
    """The controller subtracts it: it is used with --negate once its comment is gone."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(sayable("siemens", G))))
    words = ["export", "siemens", "R.json", "-o"]
    assert main([*words, "old.txt"]) == 0
    text = Path("old.txt").read_text()
    Path("old.txt").write_text(text.replace("table: added", "table: added  \r"))
    assert main([*words, "same.txt", "--onto", "old.txt"]) == 0
    capsys.readouterr()
    negated = [*words, "new.txt", "--negate", "--onto", "old.txt"]
    assert main(negated) == 2
    assert capsys.readouterr().err == (
        "selfcal export: old.txt: it says 'this table: added', and is taken for 'this table: "
        "subtracted'; give the options with which it was written; if the controller uses it "
        "otherwise, delete this comment first\n"
    )
    kept = [line for line in text.splitlines() if "this table: " not in line]
    Path("old.txt").write_text("\n".join(kept) + "\n")
    assert main(negated) == 0


@pytest.mark.parametrize(
    ("verb", "counts"), [("pmac", "1=2000 2=2000"), ("linuxcnc", ""), ("siemens", "")]
)
def test_no_file_is_taken_for_nothing(tmp_path, monkeypatch, capsys, verb, counts):
    """KMotion's file states no part, counts or sense, and PMAC's none without counts."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(sayable(verb, G))))
    words = [
        *["R.json", "-o", "old.txt"],
        *[word for count in counts.split() for word in ("--counts-per-unit", count)],
    ]
    assert main(["export", verb, *words]) == 0
    old = str(min(Path().glob("old*.txt")))
    capsys.readouterr()
    for other in ("pmac", "kmotion"):
        line = ["export", other, "R.json", "-o", "new.txt", "--unit", "mm"]
        assert main([*line, "--onto", old]) == 2
        assert "taken for" not in capsys.readouterr().err


@pytest.mark.parametrize(
    "options", ["--reverse-x", "--home-x 3", "--reverse-y --home-y 2"]
)
def test_a_table_of_measured_errors_states_neither_directions_nor_home(
    tmp_path, monkeypatch, capsys, options
):
    """Its positions are the controller's: each export from a result may replace it."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(G)))
    rows = "".join(f"{p},{(p / 10) ** 2}\n" for p in range(-40, 41, 10))
    Path("d.csv").write_text("position,error\n" + rows)
    square = "orthogonality --measured 5um --over 200mm --travel 300mm --home end"
    for number, words in enumerate(("accuracy d.csv", "straightness d.csv", square)):
        old, new = f"old{number}.cal", f"new{number}.cal"
        assert main(["cal", *words.split(), "-o", old]) == 0
        text = Path(old).read_text()
        assert re.findall("machine: .*", text) == ["machine: x-axis=1 y-axis=2 unit=mm"]
        export = ["cal", "export", "R.json", "--onto", old, *options.split()]
        capsys.readouterr()
        assert main([*export, "-o", new]) == 0
        assert "says" not in capsys.readouterr().err
        assert main([*export, "-o", "other.cal", "--unit", "um"]) == 2
        assert (
            f"{old}: it says 'machine: x-axis=1 y-axis=2 unit=mm', and the options"
            in capsys.readouterr().err
        )


@pytest.mark.parametrize("verb", ["export kmotion", "cal export"])
def test_another_zero_than_that_of_the_active_table_is_said(
    tmp_path, monkeypatch, capsys, verb
):
    """It is right if the plate lay elsewhere on the stage, and wrong if it was forgotten."""
    monkeypatch.chdir(tmp_path)
    write_json("R.json", result_to_dict(result_of(G)))
    words = [*verb.split(), "R.json", "--unit", "mm", "-o"]
    assert main([*words, "old.txt", "--home-x", "2"]) == 0
    capsys.readouterr()
    assert main([*words, "new.txt", "--onto", "old.txt"]) == 0
    err = capsys.readouterr().err
    assert "old.txt says 'machine: " in err and "are offset by this difference" in err
