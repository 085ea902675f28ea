# SPDX-License-Identifier: Apache-2.0
"""``selfcal combine``: files in, a mean map that the other verbs read, what each run says."""

import json

import numpy as np
import pytest

from selfcal_ros.apply import load
from selfcal_ros.cli.main import main
from selfcal_ros.errors import InputError
from selfcal_ros.estimation.api import calibrate
from selfcal_ros.estimation.recheck.plate import known_plate
from selfcal_ros.files import read_json
from selfcal_ros.model.artifact import Artifact
from selfcal_ros.model.result import result_to_dict
from selfcal_ros.outputs import write_json
from selfcal_ros.reporting.words.findings import worded
from selfcal_ros.results import read_result
from test.support.options import bare
from test.support.truth import hu_plan, random_truth, simulate_measurements


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    artifact = Artifact(5, 0.01, 8)
    truth = random_truth(artifact, 4, np.random.default_rng(1))
    for seed in (1, 2, 3):
        readings = simulate_measurements(
            truth,
            hu_plan(artifact, 2),
            np.random.default_rng(seed),
            sigma_m=2e-8,
            sigma_theta_rad=2e-5,
        )
        write_json(
            folder / f"{seed}.json",
            result_to_dict(worded(calibrate(readings, bare(causes=False)))),
        )
    return folder


@pytest.fixture
def files(folder, monkeypatch):
    monkeypatch.chdir(folder)
    return ["1.json", "2.json", "3.json"]


def test_the_mean_is_read_by_the_other_verbs(files, folder, capsys):
    assert main(["combine", *files, "-o", "mean.json", "--force"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(
        "mean of 3 maps: Good: the runs agree within their uncertainties"
    )
    assert "3.json: weight 0.3" in text and "disagrees" not in text
    for command in (
        ["report", "mean.json", "-o", "mean.html"],
        ["plot", "mean.json", "-o", "mean.svg"],
        ["table", "mean.json", "-o", "mean.csv"],
        ["diff", "1.json", "mean.json"],
        ["export", "kmotion", "mean.json", "-o", "mean.txt", "--unit", "mm"],
        [
            "cal",
            "export",
            "mean.json",
            "-o",
            "mean.cal",
            "--x-axis",
            "1",
            "--y-axis",
            "2",
        ],
    ):
        assert main(command) == 0, command
    page = (folder / "mean.html").read_text()
    assert (
        "weighted mean of several calibrations" in page
        and "uncertainties of 3 runs" in page
    )
    # it has no views, readings or noise of its own
    assert "Mean of 3 maps: largest error" in page and "mean of 3 maps</td>" in page
    assert not any(word in page for word in ("0 views", "0 used", "not known"))
    of_one, of_mean = (
        load(name).length_error((0.0, 0.0), (0.02, 0.01))[1]
        for name in ("1.json", "mean.json")
    )
    assert of_mean < of_one
    assert main(["combine", "mean.json", "1.json", "-o", "again.json"]) == 2
    assert "name these runs themselves" in capsys.readouterr().err
    with pytest.raises(
        InputError, match="of several runs, which has no map of a plate"
    ):
        known_plate(read_result("mean.json"), "mean.json")


def test_a_map_of_other_origin_is_one_of_them(files, tmp_path, capsys):
    table = str(tmp_path / "other.csv")
    assert main(["table", "2.json", "-o", table, "--force"]) == 0
    assert (
        main(["combine", "1.json", table, "-o", "mean.json", "--force", "--json"]) == 0
    )
    said = json.loads(capsys.readouterr().out.partition("\n")[2])
    assert [run["file"] for run in said["runs"]] == ["1.json", table]
    one, other, mean = (
        read_json(name)["error_map"] for name in ("1.json", "2.json", "mean.json")
    )
    weight = said["runs"][0]["weight"]
    np.testing.assert_allclose(
        mean["gx"],
        weight * np.array(one["gx"]) + (1 - weight) * np.array(other["gx"]),
        atol=1e-15,
    )
    assert "xy" not in read_json("mean.json").get("map_covariance", {})
    plain = tmp_path / "plain.csv"
    plain.write_text(
        "x,y,gx,gy,u_gx,u_gy\n0,0,1e-7,2e-7,1e-8,1e-8\n0.01,0,0,0,1e-8,1e-8\n"
        "0,0.01,0,0,1e-8,1e-8\n-0.01,0.02,0,0,1e-8,\n"
    )
    assert main(["combine", "1.json", str(plain), "-o", "mean.json", "--force"]) == 0
    assert (
        np.isfinite(np.array(read_json("mean.json")["error_map"]["gx"], float)).sum()
        == 3
    )
    assert "unknown in the mean: 22" in capsys.readouterr().out


def test_a_table_of_one_of_the_runs_is_the_same_recording(files, tmp_path, capsys):
    """Its map is equal, to a few digits too."""
    own = str(tmp_path / "own.csv")
    assert main(["table", "1.json", "-o", own, "--force"]) == 0
    assert main(["combine", "1.json", own, "-o", "mean.json", "--force"]) == 2
    assert "own.csv: of the same readings as 1.json" in capsys.readouterr().err
    head, *rows = (tmp_path / "own.csv").read_text().splitlines()
    short = tmp_path / "short.csv"
    short.write_text(
        "\n".join(
            [
                head,
                *(
                    ",".join(cell and f"{float(cell):.5g}" for cell in row.split(","))
                    for row in rows
                ),
            ]
        )
    )
    assert main(["combine", "1.json", str(short), "-o", "mean.json", "--force"]) == 2
    assert "short.csv: of the same readings as 1.json" in capsys.readouterr().err


def negated(text, columns):
    """Return a table with the sign of some of its columns turned."""
    head, *rows = text.splitlines()
    names = head.split(",")
    return (
        "\n".join(
            [
                head,
                *(
                    ",".join(
                        repr(-float(cell))
                        if cell and name.rpartition("_")[0] in columns
                        else cell
                        for name, cell in zip(names, row.split(","), strict=True)
                    )
                    for row in rows
                ),
            ]
        )
        + "\n"
    )


@pytest.mark.parametrize(
    ("columns", "refused"),
    [
        (("gx", "gy"), True),
        (("g_theta",), True),
        (("gx", "gy", "g_theta"), True),
        (("gx",), False),
        ((), False),
    ],
)  # an axis alone is wired otherwise: it disagrees
def test_a_map_of_the_opposite_sign_is_refused_as_such(
    files, tmp_path, capsys, columns, refused
):
    table, other = tmp_path / "own.csv", tmp_path / "other.csv"
    assert main(["table", "2.json", "-o", str(table), "--force"]) == 0
    other.write_text(negated(table.read_text(), columns))
    capsys.readouterr()
    for order in (["1.json", "3.json", str(other)], [str(other), "1.json"]):
        assert main(["combine", *order, "-o", "mean.json", "--force"]) == (
            2 if refused else 0
        )
        error = capsys.readouterr().err
        assert (
            error
            == f"selfcal combine: {other}: of the opposite sign to 1.json: its negative "
            "agrees, and it does not; give G = indicated - true\n"
        ) is refused


def test_maps_within_their_u_have_no_sign(files, tmp_path):
    """Errors of 2 u at 25 nodes, and their negative: 3 u are needed to be sure."""
    given = read_json("1.json")["error_map"]
    for factor, code in ((2.0, 0), (4.0, 2)):
        u = {
            name: (np.sqrt(np.mean(np.square(np.array(given[name], float)))) / factor)
            for name in ("gx", "gy")
        }
        rows = [
            f"{(i - 2) * 0.01},{(j - 2) * 0.01},{-given['gx'][i][j]},{-given['gy'][i][j]},"
            f"{u['gx']},{u['gy']}"
            for i in range(5)
            for j in range(5)
        ]
        (tmp_path / "n.csv").write_text("x,y,gx,gy,u_gx,u_gy\n" + "\n".join(rows))
        assert (
            main(
                [
                    "combine",
                    "1.json",
                    str(tmp_path / "n.csv"),
                    "-o",
                    "mean.json",
                    "--force",
                ]
            )
            == code
        )


HEAD = "x,y,gx,gy,u_gx,u_gy\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "x.csv:1: no column x, y, gx, gy, u_gx, u_gy"),
        ("x,y,gx,gy,u_gx\n", "x.csv:1: no column u_gy"),
        (HEAD, "x.csv: no site has an error and its uncertainty"),
        (HEAD + "0,0,0,0,1\n", "x.csv:2: 5 cells, not 6"),
        ("# of May\n" + HEAD + "# 1\n0,0,0,0,1\n", "x.csv:4: 5 cells, not 6"),
        (HEAD + "0,0,a,0,1e-8,1e-8\n", "x.csv:2: a cell is not a number"),
        (HEAD + "0,0,1_0e-9,0,1e-8,1e-8\n", "x.csv:2: a cell is not a number"),
        (HEAD + "0,0,0,0,1e-8,0\n", "x.csv:2: u_gy 0 is not a standard uncertainty"),
        (
            HEAD + "0.001,0,0,0,1e-8,1e-8\n",
            "(0.001, 0) m is not a site of the other maps",
        ),
        (
            HEAD + "0.03,0,0,0,1e-8,1e-8\n",
            "(0.03, 0) m is not a site of the other maps",
        ),
        (HEAD + "0,0,0,0,1e-8,1e-8\n" * 2, "x.csv:3: its site is in the table twice"),
        (HEAD + "0,0,1e9,0,1e-8,1e-8\n", "a value beyond 1000 m or rad"),
        (HEAD + ",,0,0,1e-8,1e-8\n", "neither a site nor an angular line"),
    ],
)
def test_a_table_that_is_no_map_is_one_line(
    files, tmp_path, monkeypatch, capsys, text, message
):
    name = tmp_path / "x.csv"
    name.write_text(text)
    assert main(["combine", "1.json", str(name), "-o", "mean.json", "--force"]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1


def test_maps_alone_give_no_lattice(files, capsys):
    assert main(["combine", "a.csv", "b.csv", "-o", "mean.json", "--force"]) == 2
    assert "no RESULT.json is named" in capsys.readouterr().err
    assert main(["combine", "1.json", "-o", "1.json"]) == 2
    assert "would be overwritten" in capsys.readouterr().err


def test_the_mean_goes_to_stdout(files, capsys):
    assert main(["combine", *files, "-o", "-"]) == 0
    both = capsys.readouterr()
    assert json.loads(both.out)["method"] == "combined" and "mean of 3 maps" in both.err
