# SPDX-License-Identifier: Apache-2.0
"""The linters of ament with the configuration stated in setup.cfg; skipped where they are not."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CHECKED = ["selfcal_ros", "launch", "tools", "setup.py", "test"]
DOCSTRINGS = ["D213", "D401", "D402", "D403", "D413", "D417"]
"""Of the ament convention: numpydoc has the summary on the first line, a property is a noun."""


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_flake8(monkeypatch):
    linter = pytest.importorskip(
        "ament_flake8.main", reason="needs ament_flake8 of ROS 2"
    )
    monkeypatch.chdir(ROOT)
    code, found = linter.main_with_errors(
        argv=["--config", "setup.cfg", "--", *CHECKED]
    )
    assert code == 0, "\n".join(found)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_pep257(monkeypatch):
    linter = pytest.importorskip(
        "ament_pep257.main", reason="needs ament_pep257 of ROS 2"
    )
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr("sys.argv", ["ament_pep257"])
    assert linter.main(argv=["--add-ignore", *DOCSTRINGS, "--", *CHECKED[:-1]]) == 0


def test_setup_cfg_leaves_out_of_the_ament_docstrings_what_is_left_out_here():
    line = next(
        line
        for line in (ROOT / "setup.cfg").read_text().splitlines()
        if line.startswith("extend-ignore")
    )
    assert set(DOCSTRINGS) <= set(line.split("=")[1].strip().split(","))
