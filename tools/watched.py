# SPDX-License-Identifier: Apache-2.0
"""A plugin of pytest that notes which functions of the package each test enters.

    .venv/bin/python -m pytest -p tools.watched -n 2 --dist loadfile

Each process of the tests writes one file below build/watched: of every test its duration and the
functions that it enters, of every test file those that its collection and its fixtures enter. What
tests do in other processes is not noted.
"""

import ast
import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import CodeType

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = f"{ROOT / 'selfcal_ros'}{os.sep}"
KEPT = ROOT / "build/watched"
WITH_PROCESSES = ("nodes", "cli")
"""Packages whose tests start processes, which are not watched."""

TOOL = 4
"""Number for `sys.monitoring`: not one of those that have a purpose, which tests use."""


def function_name(qualname: str) -> str:
    """Return the dotted name of the function that a lambda or a generator belongs to."""
    return ".".join(part for part in qualname.split(".") if not part.startswith("<"))


@cache
def _spans(path: Path) -> list[tuple[str, int, int]]:
    """Return the functions and classes of a module: name, first and last line, outer ones first."""
    out = []

    def walk(node: ast.AST, name: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = name
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                inner = f"{name}.{child.name}".removeprefix(".")
                if not isinstance(child, ast.ClassDef):
                    out.append((inner, child.lineno, child.end_lineno))
            walk(child, inner)

    walk(ast.parse(path.read_text()), "")
    return out


def functions_at(name: str, line: int, root: Path) -> set[str]:
    """Return the functions, as `path:name`, that use what stands in a line of a file.

    That is the innermost function around it; of a constant all functions that name it, or else all
    of its module.
    """
    spans = _spans(root / name)
    around = [function for function, first, last in spans if first <= line <= last]
    if around:
        return {f"{name}:{around[-1]}"}
    text = (root / name).read_text()
    names = {
        target.id
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Assign | ast.AnnAssign)
        and node.lineno <= line <= node.end_lineno
        for target in getattr(node, "targets", [getattr(node, "target", None)])
        if isinstance(target, ast.Name)
    }
    found = set()
    for path in sorted((root / "selfcal_ros").rglob("*.py")) if names else []:
        lines = path.read_text().splitlines()
        word = re.compile(rf"\b({'|'.join(sorted(names))})\b")
        found |= {
            f"{path.relative_to(root)}:{function}"
            for function, first, last in _spans(path)
            if any(word.search(line) for line in lines[first - 1 : last])
        }
    return found or {f"{name}:{function}" for function, *_ in spans}


class Watched:
    """The functions that each test enters, and how long it takes, as tools/watched.py notes them.

    Functions that fixtures or the collection of a file enter count for all tests of the file.
    `root` is the tree that holds the files.
    """

    def __init__(self, folder: Path, root: Path) -> None:
        self.root = root
        self.seconds: dict[str, float] = {}
        self.size: dict[str, int] = {}
        self.tests: dict[str, set[str]] = defaultdict(set)
        of_files: dict[str, set[str]] = defaultdict(set)
        for kept in sorted(folder.glob("*.json")):
            noted = json.loads(kept.read_text())
            self.seconds |= noted["seconds"]
            for name, functions in noted["entered"].items():
                self.size[name] = len(functions)
                for function in functions:
                    (self.tests if "::" in name else of_files)[function].add(name)
        by_file: dict[str, list[str]] = defaultdict(list)
        for test in self.seconds:
            by_file[test.split("::")[0]].append(test)
        for function, files in of_files.items():
            self.tests[function].update(
                test for file in files for test in by_file[file]
            )

    def groups(self, name: str, line: int, seconds: float) -> list[list[str]]:
        """Return the tests that watch a line of a file, the likeliest first, in up to 3 groups.

        First come the files that mirror the module, then those whose tests enter the fewest other
        functions. Tests of the module's package that start processes are added, as what they enter
        is not noted. `seconds` limits the time of all tests together.
        """
        parts = Path(name).with_suffix("").parts[1:]
        mirror = "/".join(("test", *parts[:-1], f"test_{parts[-1]}"))
        files: dict[str, list[str]] = defaultdict(list)
        for test in set().union(
            *(self.tests[one] for one in functions_at(name, line, self.root))
        ):
            files[test.split("::")[0]].append(test)
        if parts[0] in WITH_PROCESSES:
            for test in self.seconds:
                if test.startswith(f"test/{parts[0]}/"):
                    files[test.split("::")[0]].append(test)

        def place(file: str) -> tuple[bool, float]:
            sizes = [self.size.get(test, 0) for test in files[file]]
            return not file.startswith(mirror), sum(sizes) / len(sizes)

        groups: list[list[str]] = [[], [], []]
        spent = 0.0
        for count, file in enumerate(sorted(files, key=place)):
            for test in sorted(set(files[file]), key=lambda test: self.seconds[test]):
                if spent + self.seconds[test] < seconds:
                    spent += self.seconds[test]
                    groups[0 if count < 4 else 1 if spent < 30 else 2].append(test)
        return [group for group in groups if group]


class Watch:
    """Notes the functions that run, under the test or the test file that makes them run."""

    def __init__(self) -> None:
        self.entered: dict[str, set[str]] = defaultdict(set)
        self.seconds: dict[str, float] = defaultdict(float)
        self.current = self.entered[""]
        self.process = os.getpid()
        monitoring = sys.monitoring
        monitoring.use_tool_id(TOOL, "watched")
        monitoring.register_callback(TOOL, monitoring.events.PY_START, self._note)
        monitoring.set_events(TOOL, monitoring.events.PY_START)

    def _note(self, code: CodeType, _: int) -> object:
        if code.co_filename.startswith(PACKAGE):
            self.current.add(
                f"{code.co_filename.removeprefix(f'{ROOT}/')}:{function_name(code.co_qualname)}"
            )
        return sys.monitoring.DISABLE

    def _under(self, name: str) -> None:
        self.current = self.entered[name]
        sys.monitoring.restart_events()

    @pytest.hookimpl(wrapper=True)
    def pytest_make_collect_report(self, collector: pytest.Collector) -> Iterator[None]:
        """Note what the collection of a test file enters."""
        if isinstance(collector, pytest.Module):
            self._under(collector.nodeid)
        return (yield)

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Note what fixtures enter: other tests of the file may use them too."""
        self._under(item.nodeid.split("::")[0])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> None:
        """Note what the test itself enters."""
        self._under(item.nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep how long a test takes."""
        self.seconds[report.nodeid] += report.duration

    def pytest_sessionfinish(self) -> None:
        """Write what was noted."""
        sys.monitoring.set_events(TOOL, 0)
        if not self.seconds or os.getpid() != self.process:
            return
        KEPT.mkdir(parents=True, exist_ok=True)
        name = os.environ.get("PYTEST_XDIST_WORKER", "main")
        (KEPT / f"{name}.json").write_text(
            json.dumps(
                {
                    "seconds": self.seconds,
                    "entered": {
                        name: sorted(names) for name, names in self.entered.items()
                    },
                }
            )
        )


def pytest_configure(config: pytest.Config) -> None:
    """Watch where tests run: not in the process that only hands them out."""
    if getattr(config.option, "numprocesses", None) is None or hasattr(
        config, "workerinput"
    ):
        config.pluginmanager.register(Watch())
