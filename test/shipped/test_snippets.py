# SPDX-License-Identifier: Apache-2.0
"""The Python of the docs runs; the targets of make in README and docs exist."""

import re
import shlex
import subprocess

import numpy as np
import pytest

from selfcal_ros.bagio.offline import collect_bag
from selfcal_ros.cli.main import main
from selfcal_ros.machine import Machine, MachineError
from selfcal_ros.machine.measuring import Run
from selfcal_ros.settings.estimator import read_plan
from selfcal_ros.settings.nodes import CollectorSettings
from test.support.cells import CELL, Agreeing, Jumping, write_cell
from test.support.pages import PAGES, ROOT, lines_of


def snippets(name: str) -> list[str]:
    """Return the blocks of Python of a page."""
    [page] = (ROOT / "docs").rglob(name)
    text = page.read_text()
    return re.findall(r"```python\n(.*?)```", text, re.S)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return a function that runs the one block of a page in an empty folder; gives its names."""
    monkeypatch.chdir(tmp_path)

    def call(page: str, **given: object) -> dict:
        (block,) = snippets(page)
        exec(compile(block, page, "exec"), given)
        return given

    return call


def test_every_page_with_python_is_run_here():
    assert {page.name for page in PAGES if "```python" in page.read_text()} == {
        "apply.md",
        "machines.md",
    }


def test_machines(run, tmp_path):
    """The class of the page, around a driver in mm, measures a plan to its true map."""
    cell, simulated = write_cell(
        tmp_path, camera=True, cell=CELL + "origin: {x: 0.0}\n"
    )

    class Driver:
        def read_mm(self, letter):
            return 1e3 * simulated.position()["XY".index(letter)]

        def move_mm(self, x, y):
            simulated.move_to((x / 1e3, y / 1e3, 0.0))
            return x < 0.0005  # a fault of the drive at the last column

        def snap(self):
            return simulated.image().pixels

        def stop(self):
            self.stopped = True

        def close(self):
            pass

    machine = run("machines.md", connect=lambda port: Driver())["Stage"]("COM3")
    machine.place = simulated.place
    assert isinstance(machine, Machine)
    measuring = Run(
        read_plan("plan.yaml"), cell, machine, tmp_path / "bag", Agreeing(), Jumping()
    )
    with pytest.raises(
        MachineError, match="stage: the drive reports an error; reset it"
    ):
        measuring.measure()
    assert machine._driver.stopped
    assert (
        collect_bag(tmp_path / "bag", CollectorSettings())
        .measurements.views[0]
        .count.sum()
        > 5
    )


def test_apply(run):
    assert (
        main(["solve", str(ROOT / "bags/hu_noise"), "--quiet", "-o", "RESULT.json"])
        == 0
    )
    found = run("apply.md")
    np.testing.assert_allclose(
        (found["x_true"], found["y_true"]), (0.01, -0.005), atol=1e-15
    )
    assert found["covariance"].shape == (4, 4) and found["qualified"]


def targets() -> set[str]:
    return set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.M))


def test_make_has_the_targets_that_are_named_and_no_others():
    named = lines_of("make")
    assert {line.split()[1] for line in named} == targets()
    for line in named:
        words = shlex.split(line)
        assert words[1] in targets(), line
        # what is said beside the target is a variable that the Makefile reads
        for word in words[2:]:
            assert re.search(
                rf"\$[({{](or \$\()?{word.split('=')[0]}\b",
                (ROOT / "Makefile").read_text(),
            ), line


def test_make_help_names_every_target():
    said = subprocess.run(
        ["make", "-s", "help"], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout
    assert set(re.findall(r"^make ([a-z0-9-]+) +\S", said, re.M)) == targets()
