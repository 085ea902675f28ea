# SPDX-License-Identifier: Apache-2.0
"""The example of every verb's help in a terminal, where bars, colours and widths differ."""

import json
import re
import shlex
import subprocess
import sys

import pytest

from selfcal_ros.cli.verbs import EXAMPLES
from test.support.sources import ROOT
from test.support.terminals import SELFCAL, in_terminal
from tools.mistakes import desk

ELSEWHERE = {
    "up": "needs ROS",
    "monitor": "needs ROS",
    "call": "needs a cell",
    "cell check": "needs a cell",
    "cell try": "asks before each motion",
    "measure": "test/cli/test_measure.py",
    "replay": "test/tools/test_demo.py",
    "camera init": "needs a bag of its own",
    "recheck": "test/cli/test_recheck.py",
    "diff": "below",
    "combine": "below",
    "verify": "test/cli/test_verify.py",
    "history": "test/cli/test_history.py",
    "reproduce": "slow: test/cli/test_reproduce_verb.py",
}
"""Verbs whose example is not run here, and why."""
SHORTER = {"plan new": " --minutes 30"}
"""What spares an example a search."""
BAR = r"\x1b\[[\d;?]*[a-zA-Z]|\r"
"""Ends a piece of what is drawn over."""
ALL = """
import json, shlex, sys
from selfcal_ros.cli.main import main
print("TERMINAL", sys.stdout.isatty(), sys.stderr.isatty(), sys.stdin.isatty())
for line in json.load(open("commands.json")):
    print("CODE", main(shlex.split(line)[1:]), line, flush=True)
"""


def test_examples_run_in_a_terminal():
    """First those that write what others read."""
    first = ("solve", "cal export")
    rest = sorted(EXAMPLES.keys() - ELSEWHERE.keys() - {*first})
    lines = [EXAMPLES[verb] + SHORTER.get(verb, "") for verb in (*first, *rest)]
    with desk() as folder:
        (folder / "stage.cal").unlink()
        (folder / "commands.json").write_text(json.dumps(lines))
        code, said = in_terminal(
            [sys.executable, "-c", ALL], columns=300, folder=folder
        )
    assert code == 0, said[-3000:]
    assert "TERMINAL True True True" in said and "Traceback" not in said
    ended = re.findall(r"CODE (\d) (.*)\r\n", said)
    assert ended == [("0", line) for line in lines]


@pytest.mark.ros
def test_the_monitor_in_a_terminal_ends_by_its_key():
    code, said = in_terminal([*SELFCAL, "monitor"], keys=b"q")
    assert code == 0 and "Traceback" not in said


@pytest.mark.ros
def test_a_cell_is_brought_up_on_a_terminal_and_ends_by_its_key(tmp_path):
    plan = shlex.split(EXAMPLES["up"])[3]
    with desk():
        code, said = in_terminal(
            [*SELFCAL, "up", "--plan", plan, "--simulate", "--results", str(tmp_path)],
            keys=b"q",
        )
    assert code == 0, said[-2000:]
    assert "Traceback" not in said


@pytest.mark.parametrize(
    "words",
    [
        ("solve", "bags/hu_noise", "--budget"),
        ("plan", "check", "config/plans/hu.yaml"),
        ("iso230", "R.json", "--radius", "20mm"),
    ],
    ids=" ".join,
)
def test_lines_fit_a_terminal_of_eighty_columns_and_break_no_number(words):
    """A pipe gets each line whole."""
    piped = subprocess.run(
        [*SELFCAL, *words], cwd=ROOT, capture_output=True, check=False
    )
    code, said = in_terminal([*SELFCAL, *words], columns=80, folder=ROOT)
    assert code == piped.returncode
    # what a bar has drawn is removed again
    lines = [re.split(BAR, line)[-1] for line in said.split("\r\n")]
    assert max(map(len, lines)) <= 80
    whole = (piped.stdout + piped.stderr).decode()
    assert max(map(len, whole.splitlines())) > 100
    assert " ".join(lines).split() == whole.split()
