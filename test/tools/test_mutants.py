# SPDX-License-Identifier: Apache-2.0
"""The changes that `make mutants` tries: what they are, where they are made, which tests watch."""

import ast
import importlib.util
from pathlib import Path

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
    assert len(mutants.sample(10**6, 0, ["selfcal_ros/cli"])) > 100  # where it is asked for
    inner = {Path(m.path).parts[1] for m in mutants.sample(10**6, 0, [])}
    assert not inner & {"cli", "reporting"} and {"estimation", "laser"} <= inner


def test_the_tests_that_mirror_a_module_run_first():
    assert mutants.tests_for("selfcal_ros/estimation/joint/noise.py") == [
        ["test/estimation/joint/test_noise.py"], ["test/estimation/joint"], ["test/estimation"]]
