# SPDX-License-Identifier: Apache-2.0
import json
from pathlib import Path

import numpy as np
import pytest

from selfcal_ros.applications.laser.simulation import (
    LaserNoise,
    Measurement,
    SetUp,
    random_machine,
    simulate_step_diagonal,
)
from selfcal_ros.applications.laser.table import write_table
from selfcal_ros.cli.main import main

CONFIG = Path(__file__).parents[2] / "config" / "step_diagonal"
EXAMPLE = CONFIG / "case_study.csv"


def run(capsys, *args):
    code = main(["step-diagonal", *map(str, args)])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_table_1_case_c_through_the_command(tmp_path, capsys):
    # Laser along the machine's own diagonals, a = b = 10 mm, Ex(y) = 0.1 mm.
    r_pp, r_np = np.hypot(10.1, 10), np.hypot(9.9, 10)
    row = (
        10.1 * 10 / r_pp,
        (10.1 * 0.1 + 100) / r_pp,
        9.9 * 10 / r_np,
        (100 - 9.9 * 0.1) / r_np,
    )
    table, out = tmp_path / "c.csv", tmp_path / "out.json"
    table.write_text(
        "block,rx_pp,ry_pp,rx_np,ry_np\n1," + ",".join(f"{r:.9f}" for r in row)
    )
    code, text, _ = run(capsys, table, "--method", "conventional", "-o", out)
    result = json.loads(out.read_text())
    assert code == 0 and text.startswith("conventional formulation, 1 block,")
    found = [result[key][0] for key in ("ex_x", "ey_x", "ex_y", "ey_y")]
    np.testing.assert_allclose(found, [-0.0002, 0, 0.1, 0.0002], atol=5e-5)
    assert result["squareness"] == pytest.approx(0.1, abs=5e-5)


@pytest.mark.parametrize("method", ["conventional", "new"])
def test_the_example_gives_what_its_truth_says(method, tmp_path, capsys):
    truth = json.loads((CONFIG / "case_study_truth.json").read_text())
    out = tmp_path / "out.json"
    code, _, err = run(
        capsys,
        EXAMPLE,
        "--method",
        method,
        "--step-x",
        "10",
        "--step-y",
        "10",
        "-o",
        out,
    )
    result = json.loads(out.read_text())
    assert code == 0
    assert ("the linear errors, which have no u" in err) == (method == "conventional")
    for key in ("squareness", "straightness_x", "straightness_y"):
        assert abs(result[key] - truth[key]) < 20e-6
        assert 0 < result[f"u_{key}"] < 20e-6
    errors = {key: np.sum(result[key]) - np.sum(truth[key]) for key in ("ex_x", "ey_y")}
    worst = 20e-6 if method == "new" else 1.0
    assert max(map(abs, errors.values())) < worst
    if method == "conventional":
        assert errors["ex_x"] == pytest.approx(-errors["ey_y"], abs=50e-6)
        assert abs(errors["ex_x"]) > 10e-3
    for key in ("ex_x", "ey_x", "ex_y", "ey_y"):
        told = method == "new" or key in ("ey_x", "ex_y")
        assert len(result[key]) == 6 and len(result[f"u_{key}"] or ()) == 6 * told
    assert result["ey_x"][0] == 0
    assert (
        result["input"]["file"] == str(EXAMPLE) and len(result["input"]["sha256"]) == 64
    )


def test_without_an_output_file_the_json_is_printed(capsys):
    code, text, _ = run(
        capsys, EXAMPLE, "--method", "new", "--form", "printed", "--line", "end"
    )
    result = json.loads(text)
    assert code == 0 and result["form"] == "printed" and result["line"] == "end"
    assert len(result["profiles"]["py_x"]["error"]) == 7


def test_body_diagonals_are_told_by_their_columns(tmp_path, capsys):
    rng = np.random.default_rng(3)
    machine = random_machine((0.01, 0.02, 0.005), 4, rng)
    setups = {"npp": SetUp(mirror_rad=(1e-3, -1e-3))}
    data = simulate_step_diagonal(
        machine, Measurement(setups, LaserNoise(repeats=2)), rng
    )
    table, out = tmp_path / "d.csv", tmp_path / "out.json"
    write_table(table, data)
    code, text, err = run(
        capsys,
        table,
        "--method",
        "new",
        "--step-x",
        10,
        "--step-y",
        20,
        "--step-z",
        5,
        "-o",
        out,
    )
    result = json.loads(out.read_text())
    assert code == 0 and "squareness_xz" in text and "straightness_z_in_x" in text
    assert "repeats are identical" in err
    for j, axis in enumerate("xyz"):
        for c, direction in enumerate("xyz"):
            np.testing.assert_allclose(
                result[f"e{direction}_{axis}"],
                machine.errors_m[j, :, c] * 1e3,
                atol=1e-6,
            )


def test_one_diagonal_on_request(capsys):
    code, text, _ = run(capsys, EXAMPLE, "--method", "new", "--diagonals", "pp")
    result = json.loads(text)
    assert (
        code == 0
        and result["diagonals"] == ["pp"]
        and result["closure"]["lengths"] is None
    )
    code, text, err = run(
        capsys, EXAMPLE, "--method", "conventional", "--diagonals", "np"
    )
    assert code == 2 and not text
    assert err == (
        "selfcal step-diagonal: diagonals: only np measured; the conventional "
        "formulation needs every diagonal; measure the others\n"
    )


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        (
            ("--step-x", "-10"),
            "--step-x: -10 mm is not a length; give the nominal step in mm, greater",
        ),
        (("--step-y", "0"), "--step-y: 0 mm is not a length"),
        (("--step-y", "nan"), "--step-y: nan mm is not a length"),
        (("--step-x", "1e-320"), "--step-x: 9.99989e-321 mm is not a length"),
        (("--step-x", "inf"), "--step-x: inf mm is not a length"),
        (("--step-x", "20"), "case_study.csv:8: rx_pp: "),
        (("--diagonals", "pp,qq"), "--diagonals: 'qq' is unknown or named twice"),
        (("--diagonals", "pp,pp"), "--diagonals: 'pp' is unknown or named twice"),
    ],
)
def test_bad_arguments_are_one_line_and_exit_code_2(capsys, extra, message):
    code, text, err = run(capsys, EXAMPLE, "--method", "new", *extra)
    assert code == 2 and not text and err.count("\n") == 1
    assert message in err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("d.csv", "--method", "new", "-o", "d.csv"), "d.csv: would be overwritten"),
        (
            ("d.csv", "--method", "new", "-o", "a.json", "--cal", "a.json"),
            "a.json: would be over",
        ),
        (
            ("d.csv", "--method", "new", "-o", "no/a.json", "--cal", "a.cal"),
            "no/a.json: cannot be wr",
        ),
        (
            (
                "d.csv",
                "--method",
                "new",
                "-o",
                "a.json",
                "--plot",
                "a.png",
                "--cal",
                "old.cal",
            ),
            "old.cal: the file exists",
        ),
        (
            ("d.csv", "--method", "new", "--save-csv", "a.csv"),
            "--save-csv: nothing would be written",
        ),
        (
            ("d.csv", "--method", "new", "--truth", "a.json"),
            "--truth: nothing would be written",
        ),
        (("--simulate", "s.yaml", "-o", "s.yaml"), "s.yaml: would be overwritten"),
        (
            ("--simulate", "s.yaml", "-o", "a.csv", "--truth", "./a.csv"),
            "./a.csv: would be over",
        ),
        (
            ("--simulate", "s.yaml", "--plot", "a.png"),
            "--plot: nothing would be written",
        ),
        (("--simulate", "s.yaml", "--cal", "a.cal"), "--cal: nothing would be written"),
    ],
)
def test_outputs_are_refused_before_anything_is_written(
    tmp_path, monkeypatch, capsys, args, message
):
    monkeypatch.chdir(tmp_path)
    for name, text in (
        ("d.csv", EXAMPLE.read_text()),
        ("old.cal", "old"),
        ("s.yaml", EXAMPLE.with_suffix(".yaml").read_text()),
    ):
        (tmp_path / name).write_text(text)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    code, _, err = run(capsys, *args)
    assert code == 2 and message in err and err.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    "extra",
    [
        ("--laser-topic", "/l"),
        ("--laser-field", "data"),
        ("--laser-unit", "mm"),
        ("--laser-sign", "-1"),
        ("--position-topic", "/p"),
        ("--joints", "a,b"),
        ("--rest-tolerance", "3"),
        ("--min-rest", "1"),
        ("--settle", "0.2"),
        ("--step-z", "5"),
        ("--x-axis", "3"),
        ("--y-axis", "3"),
        ("--unit", "um"),
        ("--home-x", "0"),
        ("--home-y", "1"),
        ("--reverse-x",),
        ("--reverse-y",),
        ("--force",),
    ],
)
def test_options_that_would_do_nothing_are_refused(capsys, extra):
    """A sign or unit of the laser that is given and not used looks as if the result had it."""
    code, out, err = run(capsys, EXAMPLE, "--method", "new", *extra)
    assert (code, out) == (2, "") and err.count("\n") == 1
    assert err.startswith(f"selfcal step-diagonal: {extra[0]}: ")
    assert err.endswith("omit it\n")


def test_bad_tables_are_one_line_with_their_exit_code(tmp_path, capsys):
    table = tmp_path / "d.csv"
    for text, expected, message in (
        ("", 4, "the table is empty"),
        ("block,rx_pp,ry_pp,rx_np,ry_np\n1,7,7,7,7\n", 2, "'ex_x', 'ey_y' is missing"),
        (
            "block,rx_pp,ry_pp,rx_np,ry_np,ex_x,ey_y\n1,7,7,7,7,0,0\n2,7,7,7,7,0,0\n",
            2,
            "equal in every block",
        ),
    ):
        table.write_text(text)
        code, _, err = run(capsys, table, "--method", "new")
        assert code == expected and err.count("\n") == 1 and message in err
    code, _, err = run(capsys, tmp_path / "none.csv", "--method", "new")
    assert code == 2 and "no such file" in err


def test_a_form_belongs_to_the_new_formulation(capsys):
    code, _, err = run(capsys, EXAMPLE, "--method", "conventional", "--form", "printed")
    assert code == 2 and "the conventional formulation has one form only" in err


def test_the_profiles_are_drawn(tmp_path, capsys):
    picture = tmp_path / "profiles.png"
    code, _, _ = run(
        capsys, EXAMPLE, "--method", "new", "--plot", picture, "-o", tmp_path / "o.json"
    )
    assert code == 0 and picture.read_bytes().startswith(b"\x89PNG")


def test_data_and_method_belong_together(capsys):
    for arguments in ((EXAMPLE,), ("--method", "new")):
        code, _, err = run(capsys, *arguments)
        assert code == 2 and "DATA.csv and --method are required" in err
    code, _, err = run(capsys, EXAMPLE, "--simulate", CONFIG / "case_study.yaml")
    assert code == 2 and "reads none" in err


def test_a_picture_has_a_known_format(tmp_path, capsys):
    code, _, err = run(capsys, EXAMPLE, "--method", "new", "--plot", tmp_path / "p.gif")
    assert (
        code == 2
        and "by its suffix; name a file that ends in .png, .svg or .pdf" in err
    )


def test_the_corrections_are_written_as_tables(tmp_path, capsys):
    from selfcal_ros.applications.aerotech.read import load_cal

    cal = tmp_path / "s.cal"
    args = (
        EXAMPLE,
        "--method",
        "new",
        "--cal",
        cal,
        "--x-axis",
        3,
        "--y-axis",
        4,
        "-o",
        tmp_path / "o.json",
    )
    assert run(capsys, *args)[0] == 0
    tables = load_cal(cal).tables
    assert [(t.axis, t.reference, len(t.values)) for t in tables] == [
        (3, 3, 7),
        (4, 3, 7),
        (3, 4, 7),
        (4, 4, 7),
    ]
    result = json.loads((tmp_path / "o.json").read_text())
    np.testing.assert_allclose(
        tables[0].values,
        [-1e3 * e for e in result["profiles"]["px_x"]["error"]],
        atol=1e-5,
    )
    code, _, err = run(capsys, *args)
    assert code == 2 and "the file exists" in err
    code, _, err = run(capsys, *args, "--force")
    assert code == 0 and ".bak" in err


def recorded_bag(path, **options):
    from selfcal_ros.applications.laser.simulation import case_study_machine
    from test.support.laser import recorded
    from test.support.laser_bags import write_laser_bag

    setups = {"pp": SetUp(mirror_rad=(5e-4,)), "np": SetUp(mirror_rad=(-5e-4,))}
    return write_laser_bag(
        path,
        recorded(case_study_machine(), setups, rng=np.random.default_rng(4)),
        **options,
    )


def test_the_help_states_from_where_positions_count(capsys):
    with pytest.raises(SystemExit):
        main(["step-diagonal", "--help"])
    printed = " ".join(capsys.readouterr().out.split())
    assert "default 0, the start of the first block" in printed
    assert "centre of the field" not in printed


def test_a_bag_gives_the_same_as_the_table_of_its_blocks(tmp_path, capsys):
    bag, table = recorded_bag(tmp_path / "bag"), tmp_path / "blocks.csv"
    out, again = tmp_path / "a.json", tmp_path / "b.json"
    code, _, err = run(
        capsys,
        bag,
        "--method",
        "new",
        "--laser-topic",
        "/cell/laser",
        "--position-topic",
        "/cell/axes",
        "--save-csv",
        table,
        "-o",
        out,
    )
    assert code == 0 and "complete runs: np 1, pp 1, x 1, y 1" in err
    assert run(capsys, table, "--method", "new", "-o", again)[0] == 0
    one, other = (json.loads(path.read_text()) for path in (out, again))
    for key in (
        "ex_x",
        "ey_x",
        "ex_y",
        "ey_y",
        "squareness",
        "straightness_x",
        "straightness_y",
    ):
        np.testing.assert_allclose(one[key], other[key], atol=1e-7)
    assert one["squareness"] == pytest.approx(-1.22e-3, abs=1e-8)
    assert one["straightness_y"] == pytest.approx(0.11e-3, abs=1e-8)
    assert len(one["input"]["sha256"]) == 64


@pytest.mark.parametrize(
    ("extra", "message"),
    [
        ((), "--laser-topic: a bag needs it; name the topic"),
        (("--laser-topic", "cell/laser"), "--position-topic: a bag needs it"),
        (
            ("--laser-topic", "a", "--position-topic", "b", "--joints", "x"),
            "--joints: 'x' is not two",
        ),
        (
            ("--laser-topic", "a", "--position-topic", "b", "--settle", "nan"),
            "--settle: nan is not",
        ),
    ],
)
def test_bag_options_are_checked(tmp_path, capsys, extra, message):
    (tmp_path / "b.mcap").write_bytes(b"")
    code, _, err = run(capsys, tmp_path / "b.mcap", "--method", "new", *extra)
    assert code == 2 and message in err and err.count("\n") == 1


def test_a_folder_that_is_not_a_bag_is_said_before_topics_are_asked_for(
    tmp_path, capsys
):
    code, _, err = run(capsys, tmp_path, "--method", "new")
    assert code == 2 and str(tmp_path) in err and "topic" not in err


def test_a_bag_that_is_not_there_is_not_called_a_table(capsys):
    code, _, err = run(capsys, "BAG", "--method", "new", "--laser-topic", "/laser")
    assert code == 2
    assert "--laser-topic: it is for bags, and BAG is not one; name a bag" in err


def test_a_diagonal_that_was_not_run_is_named(tmp_path, capsys):
    bag = recorded_bag(tmp_path / "bag")
    topics = ("--laser-topic", "cell/laser", "--position-topic", "cell/axes")
    code, text, _ = run(capsys, bag, "--method", "new", *topics, "--diagonals", "np")
    assert code == 0 and json.loads(text)["diagonals"] == ["np"]
    code, _, err = run(capsys, bag, "--method", "new", *topics, "--diagonals", "ppp")
    assert code == 2 and "'ppp' is unknown" in err
    code, _, err = run(
        capsys, bag, "--method", "conventional", *topics, "--laser-sign", "-1"
    )
    assert code == 2 and "the sign is wrong" in err


def test_only_force_replaces_a_table_or_a_truth(tmp_path, capsys):
    words = ["--simulate", CONFIG / "case_study.yaml"]
    for option, name in (("-o", "d.csv"), ("--truth", "t.json")):
        path = tmp_path / name
        path.write_text("mine")
        code, _, err = run(capsys, *words, option, path)
        assert code == 2 and f"{path}: the file exists; name another file" in err
        assert path.read_text() == "mine"
        assert run(capsys, *words, option, path, "--force")[0] == 0
        assert path.read_text() != "mine"


def test_the_example_is_what_its_configuration_simulates(tmp_path, capsys):
    table, truth = tmp_path / "d.csv", tmp_path / "t.json"
    assert (
        run(
            capsys,
            "--simulate",
            CONFIG / "case_study.yaml",
            "-o",
            table,
            "--truth",
            truth,
        )[0]
        == 0
    )

    def rows(path):
        return [line for line in path.read_text().splitlines() if line[0] != "#"]

    made, shipped = rows(table), rows(EXAMPLE)
    assert made[0] == shipped[0] and len(made) == len(shipped) == 19
    np.testing.assert_allclose(
        [list(map(float, row.split(","))) for row in made[1:]],
        [list(map(float, row.split(","))) for row in shipped[1:]],
        atol=2e-8,
    )
    shipped_truth = json.loads((CONFIG / "case_study_truth.json").read_text())
    for key in (
        "ex_x",
        "ey_x",
        "ex_y",
        "ey_y",
        "squareness",
        "straightness_x",
        "straightness_y",
    ):
        np.testing.assert_allclose(
            json.loads(truth.read_text())[key], shipped_truth[key], atol=1e-11
        )
    assert run(capsys, "--simulate", CONFIG / "case_study.yaml")[1] == table.read_text()
    code, _, err = run(capsys, EXAMPLE, "--simulate", CONFIG / "case_study.yaml")
    assert code == 2 and "writes data and reads none" in err


def test_the_body_diagonals_of_the_example(tmp_path, capsys):
    table, truth = tmp_path / "d.csv", tmp_path / "t.json"
    assert (
        run(
            capsys,
            "--simulate",
            CONFIG / "body_diagonals.yaml",
            "-o",
            table,
            "--truth",
            truth,
        )[0]
        == 0
    )
    code, text, _ = run(
        capsys, table, "--method", "new", "--step-x", 10, "--step-y", 8, "--step-z", 5
    )
    result, expected = json.loads(text), json.loads(truth.read_text())
    assert code == 0
    for key in (key for key in expected if key.startswith(("e", "sq", "st"))):
        if key == "squareness_rad":
            continue
        off = np.abs(np.array(result[key]) - expected[key])
        u = np.array(result[f"u_{key}"], dtype=float)
        assert (off <= 5 * u + 1e-12).all(), key
