#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Change the code a little, run the tests that watch it, and print the changes that no test sees.

    python -m tools.mutants [--number N] [--seed S] [--only PATH]... [--skip N] [--watch]

A sample of small changes (a sign, a comparison, a factor, sin for cos, min for max, an index) over
selfcal_ros, without text and plots. Each is made in a copy of the tree, never in the tree itself.
Only tests that enter the changed function run (tools/watched.py notes them once, in the time of the
whole suite), those of the module's own test file first, in one process and up to the first that
fails. A change that makes the tests hang counts as seen; a test that fails without any change does
not count.
"""

import argparse
import ast
import contextlib
import hashlib
import importlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from operator import itemgetter
from pathlib import Path

import pytest

from tools.watched import KEPT, Watched

for _libraries in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_libraries, "1")

for _name in ("scipy.linalg", "scipy.sparse.linalg", "scipy.stats"):
    importlib.import_module(_name)  # once, for every fork

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "selfcal_ros"
LEFT_OUT = ("cli", "reporting", "start.py", "__main__.py", "units.py", "errors.py")
"""Text, plots, and what is nothing but names."""

TEST_CPU_S = 120
"""Processor time of one test beyond which it hangs."""

TIMEOUT_S = 3600
"""Time of a group of tests beyond which it waits for what does not come."""

COMPARE = {
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
}
ARITHMETIC = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
}
NAMES = {
    "sin": "cos",
    "cos": "sin",
    "min": "max",
    "max": "min",
    "any": "all",
    "all": "any",
    "minimum": "maximum",
    "maximum": "minimum",
    "argmax": "argmin",
    "argmin": "argmax",
}


@dataclass(frozen=True)
class Mutant:
    """A change: the text from `start` to `stop` of a file becomes `new`."""

    path: str
    start: int
    stop: int
    new: str
    line: int

    def applied(self, text: str) -> str:
        """Return the text of the file with the change."""
        data = text.encode()
        return (data[: self.start] + self.new.encode() + data[self.stop :]).decode()


class Source:
    """The text of a file, and where its nodes stand in it, in bytes."""

    def __init__(self, text: str) -> None:
        self.text, self.data = text, text.encode()
        self.offsets = [0]
        for line in self.data.split(b"\n"):
            self.offsets.append(self.offsets[-1] + len(line) + 1)

    def place(self, node: ast.AST) -> tuple[int, int]:
        """Return where a node begins and ends."""
        return (
            self.offsets[node.lineno - 1] + node.col_offset,
            self.offsets[node.end_lineno - 1] + node.end_col_offset,
        )

    def sign(self, left: ast.AST, right: ast.AST, old: str, new: str) -> tuple | None:
        """Return the change of the operator that stands between two nodes."""
        at = self.data.find(old.encode(), self.place(left)[1], self.place(right)[0])
        return (at, at + len(old), new) if at >= 0 else None

    def inner(self, node: ast.AST) -> str:
        """Return the text of a node in brackets."""
        return f"({ast.get_source_segment(self.text, node)})"


def _operator(node: ast.AST, source: Source) -> tuple | None:
    if (
        isinstance(node, ast.BinOp)
        and type(node.op) in ARITHMETIC
        and not _is_text(node)
    ):
        return source.sign(node.left, node.right, *ARITHMETIC[type(node.op)])
    if (
        isinstance(node, ast.Compare)
        and len(node.ops) == 1
        and type(node.ops[0]) in COMPARE
    ):
        return source.sign(node.left, node.comparators[0], *COMPARE[type(node.ops[0])])
    if isinstance(node, ast.BoolOp):
        words = ("and", "or") if isinstance(node.op, ast.And) else ("or", "and")
        return source.sign(node.values[0], node.values[1], *words)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
        return (*source.place(node), source.inner(node.operand))
    return None


def _name_or_number(node: ast.AST, source: Source) -> tuple | None:
    if isinstance(node, ast.Name) and node.id in NAMES:
        return (*source.place(node), NAMES[node.id])
    if isinstance(node, ast.Attribute) and node.attr in NAMES:
        stop = source.place(node)[1]
        return (stop - len(node.attr), stop, NAMES[node.attr])
    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        return (
            *source.place(node),
            {0: "1", 1: "0"}.get(node.value, f"({node.value} * 2)"),
        )
    return None


@cache
def mutants_of(path: str, text: str) -> list[Mutant]:
    """Return all changes of one file."""
    source = Source(text)
    found = (
        (node, _operator(node, source) or _name_or_number(node, source))
        for node in _code(ast.parse(text))
    )
    return [Mutant(path, *change, node.lineno) for node, change in found if change]


def _is_text(node: ast.BinOp) -> bool:
    sides = (node.left, node.right)
    return any(
        isinstance(side, ast.JoinedStr)
        or (isinstance(side, ast.Constant) and isinstance(side.value, str))
        for side in sides
    )


def _code(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that decide what is computed: no messages, types, defaults of decorators."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(
            child, ast.Raise | ast.JoinedStr | ast.arg | ast.Import | ast.ImportFrom
        ):
            continue
        if isinstance(tree, ast.FunctionDef) and child in (
            tree.returns,
            *tree.decorator_list,
        ):
            continue
        if isinstance(tree, ast.ClassDef) and child in tree.decorator_list:
            continue
        if isinstance(tree, ast.AnnAssign) and child is tree.annotation:
            continue
        yield child
        yield from _code(child)


def sample(
    number: int, seed: int, only: list[str], *, root: Path = ROOT
) -> list[Mutant]:
    """Return a seeded sample, as many from a long module as its length asks for."""
    found: list[tuple[str, Mutant]] = []
    package = root / PACKAGE.name
    for path in sorted(package.rglob("*.py")):
        name = str(path.relative_to(root))
        inner = path.relative_to(package).parts[0]
        if (
            any(name.startswith(part.rstrip("/")) for part in only)
            if only
            else inner not in LEFT_OUT
        ):
            found += _in_lot(seed, name, path.read_text())
    return [mutant for _, mutant in sorted(found, key=itemgetter(0))[:number]]


def _in_lot(seed: int, name: str, text: str) -> list[tuple[str, Mutant]]:
    """Return the mutants of a file, each with its lot.

    It is drawn from the line itself: what is changed elsewhere leaves the sample as it was.
    """
    lines, met, out = text.splitlines(), Counter(), []
    for mutant in mutants_of(name, text):
        what = (seed, name, lines[mutant.line - 1].strip(), mutant.new)
        met[what] += 1
        lot = hashlib.sha256(repr((*what, met[what])).encode()).hexdigest()
        out.append((lot, mutant))
    return out


def _in_a_fork(run: Callable[[], int], cwd: Path) -> int | None:
    """Return what `run` returns in a process of its own, None if it takes too long.

    A fork has pytest and the numerical libraries already: starting them anew for each change
    takes longer than most tests. What it prints is lost.
    """
    child = os.fork()
    if child == 0:
        os.setsid()
        os.chdir(cwd)
        # of those who run this by pytest, as colcon does
        os.environ.pop("PYTEST_ADDOPTS", None)
        # bytecode of the same second and size as a change would be taken for that of the change
        os.environ["PYTHONDONTWRITEBYTECODE"], sys.dont_write_bytecode = "1", True
        status = 1
        try:
            with open(os.devnull, "w") as nowhere:
                sys.stdout = sys.stderr = nowhere
                for stream in (1, 2):
                    os.dup2(nowhere.fileno(), stream)
                status = int(run())
        finally:
            os._exit(status)
    stop = time.monotonic() + TIMEOUT_S
    try:
        while time.monotonic() < stop:
            done, status = os.waitpid(child, os.WNOHANG)
            if done:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.05)
        return None
    finally:
        with contextlib.suppress(ProcessLookupError):  # and what the tests have started
            os.killpg(child, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):
            os.waitpid(child, 0)


class FirstFailed:
    """A plugin of pytest: runs chosen tests, ends those that hang, keeps the first that fails."""

    def __init__(self, tests: Sequence[str], path: Path) -> None:
        self.tests, self.path = set(tests), path

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Leave out what was not chosen."""
        items[:] = [item for item in items if item.nodeid in self.tests]

    def pytest_runtest_setup(self) -> None:
        """Give the next test its processor time."""
        used = resource.getrusage(resource.RUSAGE_SELF)
        limit = int(used.ru_utime + used.ru_stime) + TEST_CPU_S
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep a test that failed."""
        self._keep(report)

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        """Keep a file that could not be read."""
        self._keep(report)

    def _keep(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.failed and not self.path.exists():
            self.path.write_text(report.nodeid)


class Tree:
    """A copy of the files that git knows, in which changes are tried one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.sound: dict[str, bool] = {}  # test: whether it passes without any change
        names = subprocess.run(
            ["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True
        ).stdout.split("\n")
        for name in filter(None, names):
            if (ROOT / name).is_file():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, folder / name)

    def failing(self, tests: list[str]) -> str | None:
        """Return the first test that fails, or "time" if they take too long; None if all pass."""
        tests = [test for test in tests if self.sound.get(test, True)]
        files = list(dict.fromkeys(test.split("::")[0] for test in tests))
        options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist"]
        first = self.folder.with_name("first_failed")
        first.unlink(missing_ok=True)
        status = _in_a_fork(
            lambda: pytest.main(
                [*options, *files], plugins=[FirstFailed(tests, first)]
            ),
            self.folder,
        )
        if status in (None, -signal.SIGXCPU):
            return "time"
        if status in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            return None
        return first.read_text() if first.exists() else "start"

    def survives(self, mutant: Mutant, groups: list[list[str]]) -> bool:
        """Return whether none of the tests sees the change."""
        path = self.folder / mutant.path
        text = path.read_text()
        for group in groups:
            while True:
                path.write_text(mutant.applied(text))
                try:
                    failed = self.failing(group)
                finally:
                    path.write_text(text)
                if failed is None:
                    break
                if failed == "start" and self.failing(group) == "start":
                    raise SystemExit(
                        f"the tests do not start, also without a change: {group}"
                    )
                if failed in ("time", "start") or self._is_sound(failed):
                    return False
        return True

    def _is_sound(self, test: str) -> bool:
        """Return whether a test passes without any change; it is left out from now on if not."""
        if test not in self.sound:
            self.sound[test] = self.failing([test]) is None
        return self.sound[test]


def main() -> int:
    """Run the sample and print the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--number", type=int, default=40, help="changes to try (default: 40)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--only",
        action="append",
        default=[],
        metavar="PATH",
        help="file or folder, e.g. selfcal_ros/estimation; may be repeated",
    )
    parser.add_argument(
        "--skip", type=int, default=0, help="leave out the first of the sample"
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=600,
        help="time of the tests of one change, as in the suite (default: 600)",
    )
    parser.add_argument(
        "--watch",
        action="store_true",
        help="note anew which functions each test enters",
    )
    args = parser.parse_args()
    if args.watch or not list(KEPT.glob("*.json")):
        shutil.rmtree(KEPT, ignore_errors=True)
        print(
            "noting which functions each test enters: in the time of the whole suite",
            flush=True,
        )
        subprocess.run(
            [
                sys.executable,
                "-m",
                "pytest",
                "-p",
                "tools.watched",
                "-q",
                "-n",
                "2",
                "--dist",
                "loadfile",
            ],
            cwd=ROOT,
            stdout=subprocess.DEVNULL,
            check=False,
        )
    survivors = 0
    with tempfile.TemporaryDirectory(prefix="mutants") as folder:
        tree = Tree(Path(folder) / "tree")
        watched = Watched(KEPT, tree.folder)
        chosen = sample(args.number, args.seed, args.only, root=tree.folder)[
            args.skip :
        ]
        for number, mutant in enumerate(chosen, args.skip + 1):
            line = (
                (tree.folder / mutant.path)
                .read_text()
                .splitlines()[mutant.line - 1]
                .strip()
            )
            alive = tree.survives(
                mutant, watched.groups(mutant.path, mutant.line, args.seconds)
            )
            survivors += alive
            print(
                f"{number}/{args.number} {'SURVIVED' if alive else 'seen'}: {mutant.path}:"
                f"{mutant.line}: {line}  -> {mutant.new}",
                flush=True,
            )
        for test in sorted(test for test, sound in tree.sound.items() if not sound):
            print(f"not counted, fails without any change: {test}")
    print(f"{survivors} of {len(chosen)} changes survived (seed {args.seed})")
    return int(survivors > 0)


if __name__ == "__main__":
    sys.exit(main())
