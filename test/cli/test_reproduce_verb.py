# SPDX-License-Identifier: Apache-2.0
"""``selfcal reproduce``: prints, saves plots, refuses nonsense."""

import json

import pytest

from selfcal_ros.cli.main import main

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("paper", "figures", "word"),
    [
        ("hu", ["4", "5", "6", "7", "8", "9"], "Table 2"),
        ("qiao", ["3", "4"], "ranks as printed"),
        ("ibaraki", [], "conventional:"),
    ],
)
def test_text_and_plots_and_the_same_bytes_for_the_same_seed(
    paper, figures, word, tmp_path, capsys
):
    out = tmp_path / "new" / "folder"
    assert (
        main(["reproduce", paper, "--draws", "3", "--seed", "5", "--out", str(out)])
        == 0
    )
    printed = capsys.readouterr().out
    assert word in printed
    assert (out / f"{paper}.txt").read_text() == printed.split("wrote ")[0]
    names = [f"{paper}_figure_{number}.png" for number in figures]
    assert sorted(path.name for path in out.glob("*.png")) == names
    assert all((out / name).read_bytes().startswith(PNG) for name in names)
    if paper == "qiao":  # same seed, same bytes
        again = tmp_path / "again"
        assert (
            main(
                [
                    "reproduce",
                    paper,
                    "--draws",
                    "3",
                    "--seed",
                    "5",
                    "--out",
                    str(again),
                    "--json",
                ]
            )
            == 0
        )
        told = capsys.readouterr()
        numbers = json.loads(told.out)
        assert (numbers["paper"], numbers["draws"], numbers["seed"]) == ("qiao", 3, 5)
        assert len(numbers) > 3 and told.err.count("wrote") == 2
        assert {path.name: path.read_bytes() for path in again.iterdir()} == {
            path.name: path.read_bytes() for path in out.iterdir()
        }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--draws", "0"], "--draws: 0 is not positive; give 1 or more"),
        (["--seed", "-1"], "--seed: -1 is negative"),
        (["--workers", "0", "--draws", "2"], "--workers: 0 is not a number of workers"),
        (["--out", "/proc/nothing"], "cannot be created"),
    ],
)
def test_bad_arguments(arguments, message, capsys):
    assert main(["reproduce", "qiao", *arguments]) == 2
    assert message in capsys.readouterr().err
