# SPDX-License-Identifier: Apache-2.0
"""The changes that `make mutants` tries: what they are, where they are made, which tests watch."""

import ast
import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tools import watched

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("mutants", ROOT / "tools/mutants.py")
mutants = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(mutants)

TEXT = '''"""Text - with a sign."""
from b import c


def f(a: int = 3) -> "c < d":
    """Return a - b."""
    if not a or a == 0.5:
        raise ValueError(f"{a + 1} is" + "not 4")
    return -a if a < 1 else max(a, "µ") * a
'''


def changed_lines():
    out = set()
    for mutant in mutants.mutants_of("a.py", TEXT):
        after = mutant.applied(TEXT)
        ast.parse(after)
        ((line, new),) = [
            (i, two)
            for i, (one, two) in enumerate(
                zip(TEXT.splitlines(), after.splitlines(), strict=True), 1
            )
            if one != two
        ]
        assert line == mutant.line
        out.add(new.strip())
    return out


def test_code_is_changed_and_text_is_not():
    assert changed_lines() == {
        'def f(a: int = (3 * 2)) -> "c < d":',
        "if (a) or a == 0.5:",
        "if not a and a == 0.5:",
        "if not a or a != 0.5:",
        "if not a or a == (0.5 * 2):",
        'return (a) if a < 1 else max(a, "µ") * a',
        'return -a if a <= 1 else max(a, "µ") * a',
        'return -a if a < 0 else max(a, "µ") * a',
        'return -a if a < 1 else min(a, "µ") * a',
        'return -a if a < 1 else max(a, "µ") / a',
    }


def test_a_sample_is_the_same_for_the_same_seed():
    one, same, other = (
        mutants.sample(20, seed, ["selfcal_ros/model"]) for seed in (1, 1, 2)
    )
    assert one == same != other
    assert all(m.path.startswith("selfcal_ros/model/") for m in one)


def test_text_and_plots_are_changed_only_where_it_is_asked_for(tmp_path):
    names = [
        "cli/a.py",
        "reporting/figures/a.py",
        "estimation/a.py",
        "laser/a.py",
        "units.py",
        "files.py",
    ]
    for name in names:
        path = tmp_path / "selfcal_ros" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x = 3 * a\n")

    def sampled(*only):
        return {
            m.path.removeprefix("selfcal_ros/")
            for m in mutants.sample(100, 0, list(only), root=tmp_path)
        }

    assert sampled() == {"estimation/a.py", "laser/a.py", "files.py"}
    assert sampled("selfcal_ros/cli", "selfcal_ros/laser/") == {
        "cli/a.py",
        "laser/a.py",
    }
    for module in mutants.LEFT_OUT:
        assert (mutants.PACKAGE / module).exists()


def test_what_changes_elsewhere_leaves_the_sample_as_it_was(tmp_path):
    folder = tmp_path / "selfcal_ros" / "model"
    folder.mkdir(parents=True)

    def lines(number):
        return [
            (m.path, (tmp_path / m.path).read_text().splitlines()[m.line - 1], m.new)
            for m in mutants.sample(number, 0, [], root=tmp_path)
        ]

    (folder / "a.py").write_text(
        "".join(f"x = {i} * a + {i}\nx = {i} * a + {i}\n" for i in range(2, 30))
    )
    before = lines(10**6)
    (folder / "a.py").write_text("y = 1\nz = -3 < y\n" + (folder / "a.py").read_text())
    (folder / "b.py").write_text("b = 3 + 4\n")
    after = lines(10**6)
    old = [one for one in after if one[1].startswith("x")]
    assert old == before and len(before) == 2 * 4 * 28 and len(after) > len(before)
    assert lines(20) == after[:20] != sorted(after)[:20]


FILE = """LIMIT = 3


class Plan:
    size: int = 2

    def check(self):
        return sum(self.size < one for one in range(LIMIT))


def other():
    return 4
"""


def noted(tmp_path):
    """Return a tree of one module, and which of its functions five tests entered."""
    (tmp_path / "selfcal_ros/model").mkdir(parents=True)
    (tmp_path / "selfcal_ros/model/plan.py").write_text(FILE)
    name = "selfcal_ros/model/plan.py"
    check, other, third = (
        f"{name}:Plan.check",
        f"{name}:other",
        "selfcal_ros/files.py:third",
    )
    (tmp_path / "gw0.json").write_text(
        json.dumps(
            {
                "seconds": {
                    "test/a.py::one": 2,
                    "test/a.py::two": 1,
                    "test/model/test_plan_more.py::one": 50,
                },
                "entered": {
                    "": [third],
                    "test/a.py": [third],
                    "test/a.py::one": [check, other],
                    "test/model/test_plan_more.py::one": [check, other, third],
                },
            }
        )
    )
    (tmp_path / "gw1.json").write_text(
        json.dumps(
            {
                "seconds": {"test/nodes/b.py::one": 3, "test/c.py::one": 40},
                "entered": {"test/nodes/b.py": [], "test/c.py::one": [check]},
            }
        )
    )
    return name, watched.Watched(tmp_path, tmp_path)


@pytest.mark.parametrize(
    ("line", "functions"),
    [
        (1, ["Plan.check"]),
        (5, ["Plan.check"]),
        (8, ["Plan.check"]),
        (12, ["other"]),
        (10, ["Plan.check", "other"]),
    ],
)
def test_a_line_is_used_by_the_function_around_it_or_those_that_name_it(
    tmp_path, line, functions
):
    name, _ = noted(tmp_path)
    assert watched.functions_at(name, line, tmp_path) == {
        f"{name}:{one}" for one in functions
    }


def test_only_tests_that_enter_the_function_run_and_its_mirror_first(tmp_path):
    name, kept = noted(tmp_path)
    mirror = "test/model/test_plan_more.py::one"
    assert kept.groups(name, 8, 600) == [[mirror, "test/c.py::one", "test/a.py::one"]]
    assert kept.groups(name, 12, 600) == [[mirror, "test/a.py::one"]]
    assert kept.groups(name, 8, 45) == [["test/c.py::one", "test/a.py::one"]]  # in 45 s
    (tmp_path / "selfcal_ros/files.py").write_text("def third():\n    return 1\n")
    assert kept.groups(
        "selfcal_ros/files.py", 2, 600
    ) == [  # entered by the fixtures of a.py
        ["test/a.py::two", "test/a.py::one", mirror]
    ]


def test_tests_that_start_processes_watch_their_whole_package(tmp_path):
    _, kept = noted(tmp_path)
    (tmp_path / "selfcal_ros/nodes").mkdir()
    (tmp_path / "selfcal_ros/nodes/solver.py").write_text("def spin():\n    return 1\n")
    assert kept.groups("selfcal_ros/nodes/solver.py", 2, 600) == [
        ["test/nodes/b.py::one"]
    ]


def test_the_first_files_are_tried_before_many_others(tmp_path):
    (tmp_path / "selfcal_ros").mkdir()
    (tmp_path / "selfcal_ros/files.py").write_text("def third():\n    return 1\n")
    tests = [f"test/{number:02}.py::one" for number in range(9)]
    (tmp_path / "main.json").write_text(
        json.dumps(
            {
                "seconds": dict.fromkeys(tests, 6),
                "entered": {
                    test: ["selfcal_ros/files.py:third"] * (1 + number)
                    for number, test in enumerate(tests)
                },
            }
        )
    )
    assert watched.Watched(tmp_path, tmp_path).groups(
        "selfcal_ros/files.py", 2, 600
    ) == [tests[:4], tests[4:]]


WATCHING = """
import sys
from pathlib import Path
import pytest
import tools.watched as watched
here = Path(sys.argv[1])
watched.ROOT, watched.PACKAGE, watched.KEPT = here, f"{here}/package/", here / "kept"
sys.path.insert(0, str(here))
options = ["-q", "-p", "no:cacheprovider", f"--rootdir={here}"]
sys.exit(pytest.main([*options, str(here)], plugins=[watched.Watch()]))
"""
PACKAGE = """
def double(x):
    return sum(2 * one for one in [x])


def at_import():
    return 3


def in_fixture():
    return 4
"""
TESTS = """
import pytest
from package.sums import at_import, double, in_fixture

THREE = at_import()


@pytest.fixture(scope="module")
def four():
    return in_fixture()


def test_one(four):
    assert double(2) == four


def test_two(four):
    assert double(2) == four


def test_three():
    assert THREE == 3
"""


def test_what_tests_their_fixtures_and_their_file_enter_is_noted(tmp_path):
    (tmp_path / "package").mkdir()
    (tmp_path / "package/sums.py").write_text(PACKAGE)
    (tmp_path / "test_sums.py").write_text(TESTS)
    subprocess.run(
        [sys.executable, "-c", WATCHING, str(tmp_path)],
        cwd=ROOT,
        check=True,
        stdout=subprocess.DEVNULL,
    )
    kept = watched.Watched(tmp_path / "kept", tmp_path)
    tests = [f"test_sums.py::test_{name}" for name in ("one", "two", "three")]
    assert set(kept.seconds) == set(tests)
    assert kept.tests["package/sums.py:double"] == set(tests[:2])
    assert kept.tests["package/sums.py:at_import"] == set(tests)
    assert kept.tests["package/sums.py:in_fixture"] == set(tests)


def small_tree(tmp_path, monkeypatch, test):
    """Return a copy in which `half` of a module is watched by one test."""
    monkeypatch.setattr(
        mutants.Tree,
        "__init__",
        lambda self, folder: self.__dict__.update(folder=folder, sound={}),
    )
    folder = tmp_path / "tree"
    (folder / "test").mkdir(parents=True)
    # also turns off plugins of an installed ROS
    shutil.copy2(ROOT / "pyproject.toml", folder)
    (folder / "half.py").write_text(HALF)
    (folder / "test/test_half.py").write_text(test)
    return mutants.Tree(folder)


HALF = "def half(x):\n    return x / 2\n"
GOOD = (
    "import sys\nfrom pathlib import Path\nsys.path.insert(0, str(Path(__file__).parents[1]))\n"
    "from half import half\n\n\ndef test_half():\n    assert half({}) == {}\n"
)
RED = "\n\ndef test_red():\n    assert half(2) is None\n"


@pytest.mark.parametrize(
    ("test", "survives"),
    [
        (GOOD.format(3, 1.5), False),
        (GOOD.format(0, 0), True),
        (GOOD.format(3, 1.5) + RED, False),
        (GOOD.format(0, 0) + RED, True),
    ],
)
def test_a_change_survives_what_does_not_see_it_and_what_fails_anyway(
    tmp_path, monkeypatch, test, survives
):
    # colcon test gives its options that way
    monkeypatch.setenv("PYTEST_ADDOPTS", "-n 2")
    # of no use here; 0.5 s a start
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    tree = small_tree(tmp_path, monkeypatch, test)
    (divided,) = (m for m in mutants.mutants_of("half.py", HALF) if m.new == "*")
    tests = ["test/test_half.py::test_half", "test/test_half.py::test_red"]
    assert tree.survives(divided, [tests]) is survives
    assert (tree.folder / "half.py").read_text() == HALF  # as before
    # it could be taken for that of the next change
    assert not [*tree.folder.rglob("*.pyc")]
    assert [name for name, sound in tree.sound.items() if not sound] == (
        ["test/test_half.py::test_red"] if "test_red" in test and survives else []
    )
