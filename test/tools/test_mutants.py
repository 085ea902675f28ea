# SPDX-License-Identifier: Apache-2.0
"""The changes that `make mutants` tries: what they are, where they are made, which tests watch."""

import ast
import importlib.util
import shutil
import sys
from pathlib import Path

import pytest

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
        (line, new), = [(i, two) for i, (one, two) in enumerate(
            zip(TEXT.splitlines(), after.splitlines(), strict=True), 1) if one != two]
        assert line == mutant.line
        out.add(new.strip())
    return out


def test_code_is_changed_and_text_is_not():
    assert changed_lines() == {
        'def f(a: int = (3 * 2)) -> "c < d":',
        "if (a) or a == 0.5:", "if not a and a == 0.5:", "if not a or a != 0.5:",
        "if not a or a == (0.5 * 2):",
        'return (a) if a < 1 else max(a, "µ") * a', 'return -a if a <= 1 else max(a, "µ") * a',
        'return -a if a < 0 else max(a, "µ") * a', 'return -a if a < 1 else min(a, "µ") * a',
        'return -a if a < 1 else max(a, "µ") / a'}


def test_a_sample_is_the_same_for_the_same_seed():
    one, same, other = (mutants.sample(20, seed, ["selfcal_ros/model"]) for seed in (1, 1, 2))
    assert one == same != other
    assert all(m.path.startswith("selfcal_ros/model/") for m in one)


def test_text_and_plots_are_changed_only_where_it_is_asked_for(tmp_path):
    names = ["cli/a.py", "reporting/figures/a.py", "estimation/a.py", "laser/a.py", "units.py",
             "files.py"]
    for name in names:
        path = tmp_path / "selfcal_ros" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("x = 3 * a\n")

    def sampled(*only):
        return {m.path.removeprefix("selfcal_ros/")
                for m in mutants.sample(100, 0, list(only), root=tmp_path)}
    assert sampled() == {"estimation/a.py", "laser/a.py", "files.py"}
    assert sampled("selfcal_ros/cli", "selfcal_ros/laser/") == {"cli/a.py", "laser/a.py"}
    for module in mutants.LEFT_OUT:
        assert (mutants.PACKAGE / module).exists()


def test_what_changes_elsewhere_leaves_the_sample_as_it_was(tmp_path):
    folder = tmp_path / "selfcal_ros" / "model"
    folder.mkdir(parents=True)

    def lines(number):
        return [(m.path, (tmp_path / m.path).read_text().splitlines()[m.line - 1], m.new)
                for m in mutants.sample(number, 0, [], root=tmp_path)]

    (folder / "a.py").write_text("".join(f"x = {i} * a + {i}\nx = {i} * a + {i}\n"
                                         for i in range(2, 30)))
    before = lines(10**6)
    (folder / "a.py").write_text("y = 1\nz = -3 < y\n" + (folder / "a.py").read_text())
    (folder / "b.py").write_text("b = 3 + 4\n")
    after = lines(10**6)
    old = [one for one in after if one[1].startswith("x")]
    assert old == before and len(before) == 2 * 4 * 28 and len(after) > len(before)
    assert lines(20) == after[:20] != sorted(after)[:20]


def test_the_tests_that_mirror_a_module_run_first_and_each_runs_once():
    groups = mutants.tests_for("selfcal_ros/estimation/joint/problem.py")
    assert groups[0] == ["test/estimation/joint/test_problem.py"]
    assert "test/estimation/joint/test_statistics.py" in groups[1]  # imports the module
    assert "test/estimation/joint/test_recovery.py" in groups[2]  # stands beside it
    named = [name for group in groups for name in group]
    assert len(set(named)) == len(named) and all((ROOT / name).is_file() for name in named)
    assert "test/estimation/comparison/test_maps.py" in named  # reaches it through others


def test_near_tests_mirror_or_import_the_module_or_stand_in_its_folder():
    path = "selfcal_ros/estimation/joint/problem.py"
    assert mutants.tests_for(path, near=True) == mutants.tests_for(path)[:2]
    alone = "selfcal_ros/collection/approach.py"
    assert "test/collection/test_approach.py" in mutants.tests_for(alone, near=True)[0]


def test_the_users_of_a_module_are_those_that_import_it_over_some_steps():
    near = mutants.users_of("selfcal_ros/estimation/joint/problem.py", 1)
    assert "test/estimation/joint/test_problem.py" in near
    assert set(near) < set(mutants.users_of("selfcal_ros/estimation/joint/problem.py", 3))
    far = mutants.users_of("selfcal_ros/estimation/joint/problem.py", 99)
    assert "test/model/test_visit_order.py" not in far


def small_tree(tmp_path, monkeypatch, test):
    """Return a copy in which `half` of a module is watched by one test."""
    monkeypatch.setattr(mutants.Tree, "__init__", lambda self, folder: self.__dict__.update(
        folder=folder, sound={}))
    monkeypatch.setattr(mutants, "tests_for", lambda path, near: [["test/test_half.py"]])
    folder = tmp_path / "tree"
    (folder / "test").mkdir(parents=True)
    shutil.copy2(ROOT / "pyproject.toml", folder)  # also turns off plugins of an installed ROS
    (folder / "half.py").write_text(HALF)
    (folder / "test/test_half.py").write_text(test)
    return mutants.Tree(folder)


HALF = "def half(x):\n    return x / 2\n"
GOOD = ("import sys\nfrom pathlib import Path\nsys.path.insert(0, str(Path(__file__).parents[1]))\n"
        "from half import half\n\n\ndef test_half():\n    assert half({}) == {}\n")
RED = "\n\ndef test_red():\n    assert half(2) is None\n"


@pytest.mark.parametrize(("test", "survives"), [
    (GOOD.format(3, 1.5), False), (GOOD.format(0, 0), True),
    (GOOD.format(3, 1.5) + RED, False), (GOOD.format(0, 0) + RED, True)])
def test_a_change_survives_what_does_not_see_it_and_what_fails_anyway(
        tmp_path, monkeypatch, test, survives):
    monkeypatch.setenv("PYTEST_ADDOPTS", "-n 2")  # colcon test gives its options that way
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")  # of no use here; 0.5 s a start
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "")
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    tree = small_tree(tmp_path, monkeypatch, test)
    divided, = (m for m in mutants.mutants_of("half.py", HALF) if m.new == "*")
    assert tree.survives(divided) is survives
    assert (tree.folder / "half.py").read_text() == HALF  # as before
    assert not [*tree.folder.rglob("*.pyc")]  # it could be taken for that of the next change
    assert [name for name, sound in tree.sound.items() if not sound] == (
        ["test/test_half.py::test_red"] if "test_red" in test and survives else [])
