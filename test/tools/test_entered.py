# SPDX-License-Identifier: Apache-2.0
"""What `tools/entered.py` counts, on two modules whose calls are known."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("entered", ROOT / "tools/entered.py")
entered = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(entered)

FIRST = """
import second

class Box:
    size = 3

    def __init__(self):
        self.twice = [second.double(value) for value in range(self.size)]

def outer():
    Box()
    second.never_first()
    return inner()

def inner():
    return sorted(second.double(value) for value in (2, 1))

def unused():
    return 0
"""
SECOND = """
def double(value):
    return 2 * value

def never_first():
    return double(1)
"""


@pytest.fixture
def first(tmp_path, monkeypatch):
    (tmp_path / "first.py").write_text(FIRST)
    (tmp_path / "second.py").write_text(SECOND)
    monkeypatch.syspath_prepend(tmp_path)
    return tmp_path


def test_each_function_counts_once_in_the_order_of_first_calls(first):
    def call():
        import first

        first.outer()

    found = entered.walk(call, first)
    assert [name for *_, name in found.functions] == [
        "outer",
        "Box.__init__",
        "double",
        "never_first",
        "inner",
    ]
    assert found.files == {first / "first.py", first / "second.py"}
    assert [path.name for path in found.loaded] == ["first.py", "second.py"]
    assert found.returns == 1  # to `inner`, after first.py was left for second.py
    lines = [line.split() for line in entered.table(found).splitlines()]
    assert ["first", "3", "1", "1", "1"] in lines
    assert ["all", "5", "2", "2", "2"] in lines
