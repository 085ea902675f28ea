# SPDX-License-Identifier: Apache-2.0
"""`selfcal replay`: over DDS, at any pace and in any order, the map of `selfcal solve`."""

import re

import pytest

from selfcal_ros.cli.main import main as selfcal
from test.support.bags import Foreign
from test.support.sessions import events_of, small_bag, small_plan


def undated(text: str) -> str:
    """Return the text of a result without the instant at which it was made."""
    assert text.count('"created": "') == 1
    return re.sub('"created": "[^"]*"', '"created": ""', text)


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """Return a bag and the text of the result that `selfcal solve` writes for it."""
    folder = tmp_path_factory.mktemp("replay")
    bag = small_bag(folder)
    assert selfcal(["solve", str(bag), "--quiet", "-o", str(folder / "solved.json")]) in (0, 5)
    return bag, undated((folder / "solved.json").read_text())


@pytest.mark.parametrize("options", [["--fast"], ["--rate", "50"], ["--fast", "--shuffle", "3"]],
                         ids=" ".join)
def test_replay_gives_the_result_of_solve_bit_for_bit(
        ros_environment, solved, tmp_path, options, capfd):
    bag, expected = solved
    output = tmp_path / "replayed.json"
    assert selfcal(["replay", str(bag), *options, "--quiet", "-o", str(output)]) in (0, 5)
    assert undated(output.read_text()) == expected
    said = capfd.readouterr()
    assert "ERROR" not in said.out + said.err
    assert "Traceback" not in said.out + said.err


@pytest.mark.parametrize(("cell", "without"), [("/", False), ("cell2", True)])
def test_one_of_two_cells_is_played(ros_environment, tmp_path, capfd, cell, without):
    for name, plan in (("", "0, 90, tx"), ("/cell2", "0, 90, ty")):
        Foreign(namespace=name).write(tmp_path / "bag" / f"x{name.strip('/')}.mcap",
                                      events_of(small_plan(plan, repeats=1)))
    bag, replayed, solved = (str(tmp_path / name) for name in ("bag", "replayed", "solved"))
    if without:
        assert selfcal(["replay", bag, "--fast", "--quiet"]) == 2
        assert "choose one with --namespace" in capfd.readouterr().err
    for verb, output in ((["replay", "--fast"], replayed), (["solve"], solved)):
        assert selfcal([*verb, bag, "--namespace", cell, "--quiet", "-o", output]) == 0
    replayed, solved = ((tmp_path / name).read_text() for name in ("replayed", "solved"))
    assert undated(replayed) == undated(solved)


def test_a_deficient_bag_ends_with_code_3_and_says_why(ros_environment, tmp_path, capfd):
    bag = small_bag(tmp_path, small_plan("0, 90"))
    assert selfcal(["replay", str(bag), "--fast", "--quiet"]) == 3
    [line] = [text for text in capfd.readouterr().err.splitlines() if "selfcal replay: " in text]
    solve = selfcal(["solve", str(bag), "--quiet"])
    assert solve == 3
    [same] = [text for text in capfd.readouterr().err.splitlines() if "selfcal solve: " in text]
    assert line.removeprefix("selfcal replay: ") == same.removeprefix("selfcal solve: ")


@pytest.mark.parametrize("options, problem", [
    (["--rate", "0"], "--rate: 0 is not a speed; give a number above 0")])
def test_a_rate_must_be_above_zero(options, problem, capsys):
    assert selfcal(["replay", "bag", *options]) == 2
    assert problem in capsys.readouterr().err


def test_what_follows_the_five_arguments_of_a_session_is_for_ros(monkeypatch):
    from selfcal_ros.nodes import replay_session

    given = []
    monkeypatch.setattr(replay_session, "run", lambda make, args: given.append(args) or 3)
    for more in ([], ["--ros-args", "-p", "a:=1", "-p", "b:=2", "-p", "c:=3", "-p", "d:=4"]):
        monkeypatch.setattr("sys.argv", ["session", "bag", "2.0", "-1", "r.json", "/cell", *more])
        with pytest.raises(SystemExit) as ended:
            replay_session.main()
        assert ended.value.code == 3 and given.pop() == more
