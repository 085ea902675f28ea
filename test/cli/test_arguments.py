# SPDX-License-Identifier: Apache-2.0
"""Arguments: no file, no value is replaced unless told; a file of another kind is named."""

import re
import shlex

import pytest

from selfcal_ros.cli.arguments import kind_of
from selfcal_ros.cli.main import build_parser, main
from selfcal_ros.errors import InputError
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import refuse_existing, write_json, write_text
from test.support.results import known_result
from test.support.sources import ROOT


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Go to a folder with a file of each kind, and those of the repository."""
    monkeypatch.chdir(tmp_path)
    for name in ("bags", "config"):
        (tmp_path / name).symlink_to(ROOT / name)
    write_json("R.json", result_to_dict(known_result(5, 8)[0]))
    (tmp_path / "points.csv").write_text("x,y\n0,0\n")
    (tmp_path / "part.nc").write_text("G0 X0 Y0\n")
    (tmp_path / "stage.cal").write_text("; a table\n:START2D 1 2\n")
    return tmp_path


def verb_of(words):
    """Return what an error begins with: of `cal`, `plan` and `camera` the second word, too."""
    first, second, *_ = words.split()
    return (
        f"selfcal {first} {second}"
        if first in ("cal", "camera", "plan")
        else f"selfcal {first}"
    )


@pytest.mark.parametrize(
    "words",
    [
        "plot R.json -o out.svg",
        "table R.json -o out.csv",
        "report R.json -o out.html",
        "apply R.json points.csv -o out.csv",
        "export siemens R.json -o out.ini --unit mm",
        "cal export R.json -o out.cal",
        "solve bags/hu_exact --quiet -o out.json",
        "cal orthogonality R.json -o out.cal",
    ],
)
def test_no_output_replaces_a_file_unless_it_is_told_to(desk, capsys, words):
    out = words.split()[words.split().index("-o") + 1]
    (desk / out).write_text("mine")
    assert main(words.split()) == 2
    assert capsys.readouterr().err == (
        f"{verb_of(words)}: {out}: the file exists; name another file, or replace it with --force\n"
    )
    assert (desk / out).read_text() == "mine"
    assert main([*words.split(), "--force"]) in (0, 5)
    assert (desk / out).read_text() != "mine"


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ("export linuxcnc R.json -o", "--output"),
        ("plan new --travel 80mm --marks 7 --pitch 10mm -o", "--output"),
        ("solve bags/hu_exact --quiet --params", "--params"),
        ("solve bags/hu_exact --quiet --model", "--model"),
        ("plan check config/plans/hu.yaml --sigma", "--sigma"),
        ("solve", "BAG"),
    ],
)
def test_a_name_that_is_empty_is_not_a_default(desk, capsys, words, name):
    """As of a variable of a shell that is not set."""
    before = set(desk.iterdir())
    assert main([*words.split(), ""]) == 2
    assert f": {name}: is empty; give a value" in capsys.readouterr().err
    assert set(desk.iterdir()) == before


@pytest.mark.parametrize(
    "words",
    [
        "export linuxcnc R.json",
        "cal export R.json",
        "cal orthogonality R.json",
        "plate config/plans/hu.yaml",
        "plan new --travel 80mm --marks 7 --pitch 10mm",
        "simulate config/simulations/demo.yaml",
        "batch bags",
    ],
)
def test_a_dash_is_no_file(desk, capsys, words):
    before = set(desk.iterdir())
    assert main([*words.split(), "-o", "-"]) == 2
    assert re.fullmatch(
        rf"{verb_of(words)}: --output -: this cannot be written to stdout; name a "
        r"(file|folder)\n",
        capsys.readouterr().err,
    )
    assert set(desk.iterdir()) == before


def test_a_file_that_is_named_dash_does_not_bar_stdout(desk, capsys):
    (desk / "-").write_text("mine")
    assert main(["table", "R.json", "-o", "-"]) == 0
    assert capsys.readouterr().out.startswith("m,n,x_m")
    assert (desk / "-").read_text() == "mine"


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (
            "apply R.json points.csv -o out.json",
            "OUT.csv .* which is not .json; .* .csv",
        ),
        (
            "certificate R.json d.yaml -o out.txt",
            "DCC.xml .* which is not .txt; .* .xml",
        ),
        ("solve bags/demo -o out.csv", "RESULT.json .* which is not .csv; .* .json"),
        (
            "step-diagonal table.csv -o out.xml",
            "which is not .xml; end the name in .json or .csv",
        ),
    ],
)
def test_the_ending_of_another_kind_is_refused(desk, capsys, words, line):
    assert main(words.split()) == 2
    assert re.search(line, capsys.readouterr().err)


def test_an_empty_file_and_a_device_are_written(desk):
    (desk / "out.csv").touch()
    assert main(["table", "R.json", "-o", "out.csv"]) == 0
    assert main(["table", "R.json", "-o", "/dev/stderr"]) == 2  # its name has no ending


def test_kinds_are_seen_in_the_files(desk):
    assert [
        kind_of(name)
        for name in (
            "bags/demo",
            "bags/demo/demo_0.mcap",
            "R.json",
            "config/plans/hu.yaml",
            "config/simulations/demo.yaml",
            "config/params/cell.yaml",
            "stage.cal",
            "points.csv",
            "part.nc",
            "nothing",
            "config",
            "bags/manifest.yaml",
        )
    ] == [
        "a bag",
        "a bag",
        "a result",
        "a plan",
        "a simulation",
        "a parameter file of nodes",
        "a calibration file",
        "a table of numbers",
        "a G-code program",
        "",
        "",
        "",
    ]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            "apply points.csv R.json -o o.csv",
            "points.csv: is a table of numbers, and R.json is a result: they are "
            "swapped; write `selfcal apply R.json points.csv -o o.csv`",
        ),
        (
            "recheck bags/demo R.json",
            "bags/demo: is a bag, and R.json is a result: they are swapped; write "
            "`selfcal recheck R.json bags/demo`",
        ),
        (
            "cal verify stage.cal R.json",
            "stage.cal: is a calibration file, and R.json is a result: they are "
            "swapped; write `selfcal cal verify R.json stage.cal`",
        ),
        (
            "solve R.json",
            "R.json: is a result, and a bag is needed here; `selfcal report R.json` shows it",
        ),
        (
            "camera init bags/camera --positions R.json --mark-size 1e-5 --mark-pixels 9 -o n.yaml",
            "R.json: is a result, and a table of numbers is needed here; `selfcal report "
            "R.json` shows it",
        ),
        (
            "report bags/demo",
            "bags/demo: is a bag, and a result is needed here; a map is computed "
            "from it with `selfcal solve bags/demo -o RESULT.json`",
        ),
        (
            "plan check config/simulations/demo.yaml",
            "config/simulations/demo.yaml: is a simulation, and a plan is needed "
            "here; `selfcal simulate config/simulations/demo.yaml -o BAG` writes its "
            "bag",
        ),
        (
            "solve bags/demo --params config/plans/hu.yaml",
            "config/plans/hu.yaml: is a plan, and a parameter file of nodes is needed "
            "here; `selfcal plan check config/plans/hu.yaml` says what it determines",
        ),
    ],
)
def test_a_file_in_the_place_of_another_is_named(desk, capsys, words, said):
    assert main(words.split()) == 2
    printed = capsys.readouterr()
    assert printed.err == f"{verb_of(words)}: {said}\n" and not printed.out


def test_a_file_before_the_word_that_chooses(desk, capsys):
    with pytest.raises(SystemExit):
        main(["export", "R.json", "siemens", "-o", "o.ini"])
    assert "'R.json' is a file, and kmotion|pmac|" in capsys.readouterr().err


def test_an_error_of_the_right_file_stays(desk, capsys):
    (desk / "points.csv").write_text("x,z\n0,0\n")
    assert main(["apply", "R.json", "points.csv", "-o", "o.csv"]) == 2
    assert "points.csv:1: " in capsys.readouterr().err


def test_what_is_not_kept_is_said(desk, capsys):
    assert main(["solve", "bags/hu_exact"]) == 0
    assert capsys.readouterr().out.endswith(
        "result: not kept; -o RESULT.json writes it\n"
    )
    assert main(["solve", "bags/hu_exact", "--json"]) == 0
    assert "not kept" not in "".join(capsys.readouterr())


def test_a_file_that_another_command_wrote_meanwhile_stays(tmp_path):
    out = tmp_path / "a.csv"
    refuse_existing([out], force=False)
    out.write_text("theirs")
    with pytest.raises(InputError, match="was written by another command meanwhile"):
        write_text(out, "ours")
    assert out.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [out]
    refuse_existing([out], force=True)
    write_text(out, "ours")
    assert out.read_text() == "ours"
    refuse_existing([tmp_path / "b.csv"], force=False)
    for text in ("first", "second"):
        write_text(tmp_path / "b.csv", text)
    assert (tmp_path / "b.csv").read_text() == "second"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            ["--reference", "artifact:1e-6:1e-7", "--reference", "stage_x:5e-6:1e-7"],
            "--reference: given as artifact:1e-6:1e-7 and as stage_x:5e-6:1e-7; keep one of them",
        ),
        (
            ["--reference-at=20:0.1:8e-6:0", "-o", "a", "--reference-at=21:0.1:8e-6:0"],
            "--reference-at: given as 20:0.1:8e-6:0 and as 21:0.1:8e-6:0; keep one of them",
        ),
    ],
)
def test_of_two_references_none_is_lost(capsys, words, said):
    with pytest.raises(SystemExit) as ended:
        main(["solve", "none.mcap", *words])
    assert ended.value.code == 2
    assert capsys.readouterr().err.startswith(f"selfcal solve: argument {said}")


def test_the_same_value_twice_is_one_value_and_terms_add_up():
    parser = build_parser("solve")
    for _ in range(2):
        args = parser.parse_args(
            shlex.split(
                "solve BAG --microscope 0 --microscope 0 --model drift --model yaw"
            )
        )
        assert (args.microscope, args.model) == ("0", ["drift", "yaw"])
